//! `train_pix2pose`, `train_detector`, `train_dgcm`, `train_mttm`, `train_nol`: material in, a model file out. They tell of their progress,
//! stop after the step in which Ctrl-C is heard, and go on when they are called again with the same arguments.

use std::path::PathBuf;

use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{positive, seed, whole};
use crate::bop::json_to_python;
use crate::training::{Source, kind, run, share, steps_of, summary, turn};

/// Trains Pix2Pose (dissertation, chapter 3) on posed photographs and renders of objects; the model is what Pix2Pose.load
/// reads. A dict with model (its path), steps, seconds, losses.
///
/// material: the folder of a BOP dataset, a bop.Dataset, or {id: Mesh} to learn from renders alone. out: a folder that gets
/// model.safetensors, and in training/ checkpoints, log.jsonl and curves.png. ids: objects of the dataset, all if None;
/// frames: pairs (scene_id, im_id) of photographs to learn from, all of the split if None; renders_only=True opens none.
/// network: "compact", which trains on two cores, or the dissertation's "paper" and "resnet50" for one object; steps,
/// per_object (images of every object in a step) and learning_rate have its defaults if None. adversarial: against a
/// discriminator; if None, all but the compact network. render_share and
/// near_photographs: share of renders, and of those near a photograph's pose; rotation: largest turn of photographs in the
/// image plane, radians, 45 degrees if None; size: pixels of the network's input; init: a model to go on from; encoder: torchvision's ResNet-50
/// weights for "resnet50"; backgrounds: a folder of photographs; preset: symmetries, thresholds
/// and occlusion of one of the dissertation's experiments, "bop", "linemod", "lmo" or "tless".
///
/// progress: called with a dict: stage ("training" or "measuring"), done, total, and while training seconds,
/// learning_rate, samples_per_second, losses. Ctrl-C, or an error of the callback, ends the training after the current
/// step, which is kept: the same call goes on, with the same result as if it had not been stopped. Symmetries that a mesh
/// does not have are a warning.
///
/// Raises OSError or ValueError for what cannot be read, options out of range, a folder with another training.
///
/// >>> trained = train_pix2pose("data/demo", "out/pix2pose", ids=[8], steps=200, progress=print)  # doctest: +SKIP
/// >>> pix2pose = Pix2Pose.load(trained["model"])  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (material, out, *, ids=None, frames=None, split=None, renders_only=false, network="compact", steps=None, per_object=None, learning_rate=None, adversarial=None, frozen_stages=2, render_share=0.5, near_photographs=0.5, rotation=None, size=128, init=None, encoder=None, backgrounds=None, mesh_colors=true, convex_hull=false, transformer_loss=true, view_limits=false, preset=None, progress=None, seed=0))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn train_pix2pose<'py>(
    py: Python<'py>,
    material: &Bound<'py, PyAny>,
    out: PathBuf,
    ids: Option<&Bound<'py, PyAny>>,
    frames: Option<&Bound<'py, PyAny>>,
    split: Option<String>,
    renders_only: bool,
    network: &str,
    steps: Option<i64>,
    per_object: Option<i64>,
    learning_rate: Option<f64>,
    adversarial: Option<bool>,
    frozen_stages: i64,
    render_share: f64,
    near_photographs: f64,
    rotation: Option<f64>,
    size: i64,
    init: Option<PathBuf>,
    encoder: Option<PathBuf>,
    backgrounds: Option<PathBuf>,
    mesh_colors: bool,
    convex_hull: bool,
    transformer_loss: bool,
    view_limits: bool,
    preset: Option<&str>,
    progress: Option<Py<PyAny>>,
    seed: i64,
) -> PyResult<Bound<'py, PyDict>> {
    use sixfold_pix2pose::preset::Preset;
    use sixfold_pix2pose::recipe::{LEAST_VISIBLE, NetworkKind, Recipe};
    let recipe = Recipe {
        network: kind("network", network, NetworkKind::ALL, NetworkKind::name)?,
        steps: steps_of(steps)?,
        per_object: per_object.map(|n| whole("per_object", n, 1)).transpose()?,
        learning_rate: learning_rate.map(|rate| positive("learning_rate", rate)).transpose()?,
        adversarial,
        encoder,
        frozen_stages: whole("frozen_stages", frozen_stages, 0)?,
        render_share: share("render_share", render_share)?,
        near_photographs: share("near_photographs", near_photographs)?,
        rotation: turn("rotation", rotation, Recipe::default().rotation)?,
        size: whole("size", size, 32)?,
        init,
        mesh_colors,
        convex_hull,
        transformer_loss,
        view_limits,
        preset: preset.map(|name| kind("preset", name, Preset::ALL, Preset::name)).transpose()?,
        backgrounds,
        seed: self::seed(seed)?,
        command: "sixfold.train_pix2pose".to_owned(),
    };
    let material = Source::new(material, ids, frames, split, renders_only)?.read(py, LEAST_VISIBLE)?;
    let trained = run(py, progress, move |stop, hear| recipe.train(material, &out, stop, hear))?;
    summary(py, trained)
}

/// Trains a detector of known objects on photographs with their ground truth and renders; the model is what Detector.load
/// reads. A dict with model (its path), steps, seconds, losses.
///
/// material, out, ids, frames, split, renders_only, init, backgrounds, progress, Ctrl-C and going on: as train_pix2pose.
/// network: "compact" or the dissertation's "retinanet"; batch: images in a step; encoder_share: the pretrained encoder's
/// share of the learning rate; size: side of the training images in pixels, a multiple of 32; photograph_share: share of
/// training images that are parts of photographs; render_share: share of renders among pasted objects; rotation: largest turn
/// in the image plane, radians, 15 degrees if None; longest_side: larger images are reduced to so many pixels before detection; threshold: score
/// below which detections are left out by default.
///
/// Raises OSError or ValueError for what cannot be read, options out of range, a folder with another training.
///
/// >>> trained = train_detector("data/demo", "out/detector", steps=200)  # doctest: +SKIP
/// >>> detector = Detector.load(trained["model"])  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (material, out, *, ids=None, frames=None, split=None, renders_only=false, network="compact", steps=8000, batch=4, learning_rate=0.002, encoder_share=0.3, frozen_stages=2, size=320, photograph_share=0.45, render_share=0.4, rotation=None, longest_side=640, threshold=0.4, init=None, encoder=None, backgrounds=None, mesh_colors=true, progress=None, seed=0))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn train_detector<'py>(
    py: Python<'py>,
    material: &Bound<'py, PyAny>,
    out: PathBuf,
    ids: Option<&Bound<'py, PyAny>>,
    frames: Option<&Bound<'py, PyAny>>,
    split: Option<String>,
    renders_only: bool,
    network: &str,
    steps: i64,
    batch: i64,
    learning_rate: f64,
    encoder_share: f64,
    frozen_stages: i64,
    size: i64,
    photograph_share: f64,
    render_share: f64,
    rotation: Option<f64>,
    longest_side: i64,
    threshold: f64,
    init: Option<PathBuf>,
    encoder: Option<PathBuf>,
    backgrounds: Option<PathBuf>,
    mesh_colors: bool,
    progress: Option<Py<PyAny>>,
    seed: i64,
) -> PyResult<Bound<'py, PyDict>> {
    use sixfold_detect::recipe::{DetectorKind, LEAST_VISIBLE, Recipe};
    share("encoder_share", encoder_share)?;
    let recipe = Recipe {
        network: kind("network", network, DetectorKind::ALL, DetectorKind::name)?,
        steps: whole("steps", steps, 1)? as u64,
        batch: whole("batch", batch, 1)?,
        learning_rate: positive("learning_rate", learning_rate)?,
        encoder_share,
        frozen_stages: whole("frozen_stages", frozen_stages, 0)?,
        encoder,
        size: whole("size", size, 32)?,
        photograph_share: share("photograph_share", photograph_share)?,
        render_share: share("render_share", render_share)?,
        rotation: turn("rotation", rotation, Recipe::default().rotation)?,
        mesh_colors,
        longest_side: whole("longest_side", longest_side, 32)?,
        threshold: share("threshold", threshold)?,
        init,
        backgrounds,
        seed: self::seed(seed)?,
        command: "sixfold.train_detector".to_owned(),
    };
    let material = Source::new(material, ids, frames, split, renders_only)?.read(py, LEAST_VISIBLE)?;
    let trained = run(py, progress, move |stop, hear| recipe.train(material, &out, stop, hear))?;
    summary(py, trained)
}

/// Trains the network for grasps from experience (dissertation, chapter 6) on made-up objects; the model is what
/// DgcmNet.load reads. A dict with model (its path), steps, seconds, losses.
///
/// out, progress, Ctrl-C and going on: as train_pix2pose; stage "preparing" comes first. network: "compact" or the
/// dissertation's "paper"; steps, pairs (positive ones in a step), learning_rate and lambda_ (weight of the coordinates'
/// loss) have its defaults if None; views: simulated views to learn from; encoder: torchvision's ResNet-50 weights for
/// "paper".
///
/// Raises OSError or ValueError for what cannot be read, options out of range, a folder with another training.
///
/// >>> network = DgcmNet.load(train_dgcm("out/dgcm", steps=100, views=500)["model"])  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (out, *, network="compact", steps=None, pairs=None, learning_rate=None, lambda_=None, views=6000, encoder=None, progress=None, seed=0))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn train_dgcm<'py>(
    py: Python<'py>,
    out: PathBuf,
    network: &str,
    steps: Option<i64>,
    pairs: Option<i64>,
    learning_rate: Option<f64>,
    lambda_: Option<f64>,
    views: i64,
    encoder: Option<PathBuf>,
    progress: Option<Py<PyAny>>,
    seed: i64,
) -> PyResult<Bound<'py, PyDict>> {
    use sixfold_dgcm::recipe::{DgcmKind, Recipe};
    let recipe = Recipe {
        network: kind("network", network, DgcmKind::ALL, DgcmKind::name)?,
        encoder,
        steps: steps_of(steps)?,
        pairs: pairs.map(|n| whole("pairs", n, 1)).transpose()?,
        learning_rate: learning_rate.map(|rate| positive("learning_rate", rate)).transpose()?,
        lambda: lambda_.map(|weight| positive("lambda_", weight)).transpose()?,
        views: whole("views", views, 64)?,
        seed: self::seed(seed)?,
        command: "sixfold.train_dgcm".to_owned(),
    };
    let trained = run(py, progress, move |stop, hear| recipe.train(&out, stop, hear))?;
    summary(py, trained)
}

/// Trains the network that matches regions of depth images with templates (dissertation, chapter 5) on made-up objects that
/// fall on a table; the model is what Mttm takes as weights. A dict with model (its path), steps, seconds, losses, and quality,
/// measured on objects that it was not trained on: regions (their number); shares of them: nearest (own template the nearest of
/// 40), masks (overlap by more than half), matching (pairs told right); medians, of the nearest template and after the network's
/// correction: rotation (radians), offset (share of a patch).
///
/// out, progress, Ctrl-C and going on: as train_pix2pose; stage "preparing" comes first, and out gets a picture of the first
/// regions, samples.png. network: "compact", which trains on two cores, or the dissertation's "paper"; steps, anchors (regions
/// with an object in a step) and learning_rate have its defaults if None; objects: made-up objects, 16 or more; scenes: scenes
/// of them, 4 or more, each seen by five cameras; encoder: torchvision's ResNet-50 weights for "paper".
///
/// Raises OSError or ValueError for what cannot be read, options out of range, a folder with another training.
///
/// >>> trained = train_mttm("out/mttm", steps=100, objects=32, scenes=16)  # doctest: +SKIP
/// >>> known = Mttm(mesh, weights=trained["model"])  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (out, *, network="compact", steps=None, anchors=None, learning_rate=None, objects=300, scenes=500, encoder=None, progress=None, seed=0))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn train_mttm<'py>(
    py: Python<'py>,
    out: PathBuf,
    network: &str,
    steps: Option<i64>,
    anchors: Option<i64>,
    learning_rate: Option<f64>,
    objects: i64,
    scenes: i64,
    encoder: Option<PathBuf>,
    progress: Option<Py<PyAny>>,
    seed: i64,
) -> PyResult<Bound<'py, PyDict>> {
    use sixfold_mttm::recipe::{MttmKind, Recipe};
    let recipe = Recipe {
        network: kind("network", network, MttmKind::ALL, MttmKind::name)?,
        encoder,
        steps: steps_of(steps)?,
        anchors: anchors.map(|n| whole("anchors", n, 2)).transpose()?,
        learning_rate: learning_rate.map(|rate| positive("learning_rate", rate)).transpose()?,
        objects: whole("objects", objects, 16)?,
        scenes: whole("scenes", scenes, 4)?,
        seed: self::seed(seed)?,
        command: "sixfold.train_mttm".to_owned(),
    };
    let (trained, quality) = run(py, progress, move |stop, hear| recipe.train(&out, stop, hear))?;
    let dict = summary(py, trained)?;
    dict.set_item("quality", json_to_python(py, &quality)?)?;
    Ok(dict)
}

/// Trains the network of Neural Object Learning (dissertation, chapter 4) on made-up objects; the model is what synthesize
/// takes as weights. A dict with model (its path), steps, seconds, losses, quality (how like the truth it renders objects
/// that it was not trained on, beside plain averaging).
///
/// out, progress, Ctrl-C and going on: as train_pix2pose. network: "compact" or the dissertation's "paper"; steps and
/// learning_rate have its defaults if None; backgrounds: a folder of photographs for textures, made-up ones only if None;
/// lstm=False integrates the photographs' features by their mean; decoder=False leaves the decoder out; encoder:
/// torchvision's DenseNet-121 weights for "paper".
///
/// Raises OSError or ValueError for what cannot be read, options out of range, a folder with another training.
///
/// >>> trained = train_nol("out/nol", steps=100)  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (out, *, network="compact", steps=None, learning_rate=None, backgrounds=None, lstm=true, decoder=true, encoder=None, progress=None, seed=0))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn train_nol<'py>(
    py: Python<'py>,
    out: PathBuf,
    network: &str,
    steps: Option<i64>,
    learning_rate: Option<f64>,
    backgrounds: Option<PathBuf>,
    lstm: bool,
    decoder: bool,
    encoder: Option<PathBuf>,
    progress: Option<Py<PyAny>>,
    seed: i64,
) -> PyResult<Bound<'py, PyDict>> {
    use sixfold_nol::network::{IntegratorKind, Parts};
    use sixfold_nol::recipe::{NolKind, Recipe};
    let recipe = Recipe {
        network: kind("network", network, NolKind::ALL, NolKind::name)?,
        encoder,
        parts: Parts {
            integrator: if lstm { IntegratorKind::Lstm } else { IntegratorKind::Average },
            decoder,
        },
        backgrounds,
        steps: steps_of(steps)?,
        learning_rate: learning_rate.map(|rate| positive("learning_rate", rate)).transpose()?,
        seed: self::seed(seed)?,
        command: "sixfold.train_nol".to_owned(),
    };
    let (trained, quality) = run(py, progress, move |stop, hear| recipe.train(&out, stop, hear))?;
    let dict = summary(py, trained)?;
    dict.set_item("quality", quality.scores())?;
    Ok(dict)
}
