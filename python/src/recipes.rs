//! `train_pix2pose`, `train_detector`, `train_dgcm`, `train_mttm`, `train_nol`, `train_views`, `train_refiner`,
//! `train_proposals`: from training data to a model file. They report their progress. Ctrl-C stops them after the current step,
//! and a call with the same arguments resumes. An argument that is missing or None has the default of the recipe.

use std::path::PathBuf;

use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{positive, whole};
use crate::bop::json_to_python;
use crate::training::{Source, checked, choice, count, run, single, steps, summary};

/// Trains Pix2Pose (dissertation, chapter 3) on photographs with known poses and on renders of objects. Pix2Pose.load reads the
/// model.
///
/// Returns a dict with model (its path), steps, seconds, losses.
///
/// material: the folder of a BOP dataset, a bop.Dataset, or {id: Mesh} to train on renders only.
/// out: a folder. It gets model.safetensors, and in training/ checkpoints, log.jsonl and curves.png.
/// ids: objects of the dataset. None: all.
/// frames: photographs to train on, as pairs (scene_id, im_id). None: all of the split.
/// split: the split of the dataset. None: that of the bop.Dataset, or "test".
/// renders_only: True uses no photographs.
/// network: "compact", which trains on two cores, or the dissertation's "paper" and "resnet50" for one object.
/// steps, per_object (images of every object in a step), learning_rate: None uses the network's default.
/// adversarial: train against a discriminator. None: for all networks except the compact one.
/// frozen_stages: number of frozen stages of the ImageNet encoder, of five.
/// render_fraction: fraction of renders among the images, 0 to 1.
/// near_photographs: fraction of renders whose pose is near that of a photograph, 0 to 1.
/// rotation: largest rotation of photographs in the image plane, radians. None: 45 degrees.
/// size: side of the network's input in pixels, a multiple of 32.
/// init: a model to continue from.
/// encoder: torchvision's ResNet-50 weights for "resnet50".
/// backgrounds: a folder of photographs. None: procedural textures.
/// mesh_colors: False renders the meshes in random colours.
/// convex_hull: train on the coordinates of the meshes' convex hulls.
/// transformer_loss: the loss for symmetric objects (equation 3.2); False uses plain L1.
/// view_limits: plain L1, with one side of a symmetric object for all equivalent ones.
/// preset: symmetries, thresholds and occlusion of one of the dissertation's experiments, "bop", "linemod", "lmo" or "tless"; or
///     "published" for the dissertation's
///     samples, loss and choice of the threshold, by default with network "paper" and no renders.
/// progress: called with a dict: stage ("training" or "measuring"), done, total; while training also seconds, learning_rate,
///     samples_per_second, losses.
///
/// Ctrl-C, or an error of the callback, ends the training after the current step, which is saved. The same call resumes it, with
/// the same result as without the interruption. A symmetry that a mesh does not have causes a warning.
///
/// Raises OSError or ValueError for data that cannot be read, options out of range, and a folder that holds another training.
///
/// >>> trained = train_pix2pose("data/demo", "out/pix2pose", ids=[8], steps=200, progress=print)  # doctest: +SKIP
/// >>> pix2pose = Pix2Pose.load(trained["model"])  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (material, out, *, ids=None, frames=None, split=None, renders_only=false, network=None, steps=None, per_object=None, learning_rate=None, adversarial=None, frozen_stages=None, render_fraction=None, near_photographs=None, rotation=None, size=None, init=None, encoder=None, backgrounds=None, mesh_colors=None, convex_hull=None, transformer_loss=None, view_limits=None, preset=None, progress=None, seed=None))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn train_pix2pose<'py>(
    py: Python<'py>,
    material: &Bound<'py, PyAny>,
    out: PathBuf,
    ids: Option<&Bound<'py, PyAny>>,
    frames: Option<&Bound<'py, PyAny>>,
    split: Option<String>,
    renders_only: bool,
    network: Option<&str>,
    steps: Option<i64>,
    per_object: Option<i64>,
    learning_rate: Option<f64>,
    adversarial: Option<bool>,
    frozen_stages: Option<i64>,
    render_fraction: Option<f64>,
    near_photographs: Option<f64>,
    rotation: Option<f64>,
    size: Option<i64>,
    init: Option<PathBuf>,
    encoder: Option<PathBuf>,
    backgrounds: Option<PathBuf>,
    mesh_colors: Option<bool>,
    convex_hull: Option<bool>,
    transformer_loss: Option<bool>,
    view_limits: Option<bool>,
    preset: Option<&str>,
    progress: Option<Py<PyAny>>,
    seed: Option<i64>,
) -> PyResult<Bound<'py, PyDict>> {
    use sixfold::pix2pose::preset::Preset;
    use sixfold::pix2pose::recipe::{MIN_VISIBILITY, Pix2PoseRecipe};
    let published = preset == Some("published");
    let default = if published { Pix2PoseRecipe::published() } else { Pix2PoseRecipe::default() };
    let recipe = checked(Pix2PoseRecipe {
        network: choice("network", network, default.network)?,
        steps: self::steps(steps)?,
        per_object: per_object.map(|n| whole("per_object", n, 0)).transpose()?,
        learning_rate,
        adversarial,
        encoder,
        frozen_stages: count("frozen_stages", frozen_stages, default.frozen_stages)?,
        render_fraction: single(render_fraction, default.render_fraction),
        near_photographs: single(near_photographs, default.near_photographs),
        rotation: single(rotation, default.rotation),
        size: count("size", size, default.size)?,
        init,
        mesh_colors: mesh_colors.unwrap_or(default.mesh_colors),
        convex_hull: convex_hull.unwrap_or(default.convex_hull),
        transformer_loss: transformer_loss.unwrap_or(default.transformer_loss),
        view_limits: view_limits.unwrap_or(default.view_limits),
        preset: preset
            .filter(|_| !published)
            .map(|name| choice("preset", Some(name), Preset::Bop))
            .transpose()?,
        published,
        backgrounds,
        seed: count("seed", seed, default.seed as usize)? as u64,
        command: "sixfold.train_pix2pose".to_owned(),
    })?;
    let material = Source::new(material, ids, frames, split, renders_only)?.read(py, MIN_VISIBILITY)?;
    summary(py, run(py, progress, recipe, material, out)?)
}

/// Trains a detector of known objects on photographs with their ground truth and on renders. Detector.load reads the model.
///
/// Returns a dict with model (its path), steps, seconds, losses.
///
/// material, out, ids, frames, split, renders_only, init, backgrounds, progress, interruption and resuming: as train_pix2pose.
/// network: "compact", "retinanet" (without anchors), or the dissertation's "faster-rcnn", "mask-rcnn" and "retinanet-anchors".
///     The last three need backbone="lite0" (EfficientNet-Lite0), or encoder, or init.
/// encoder: torchvision's weights of ResNet-50; for the dissertation's networks also those of the same network.
/// batch: number of images in a step.
/// encoder_rate: learning rate of the pretrained encoder as a fraction of the learning rate, 0 to 1.
/// frozen_stages: number of frozen stages of the ImageNet encoder, of five.
/// size: side of the training images in pixels, a multiple of 32.
/// photograph_fraction: fraction of training images that are parts of photographs, 0 to 1.
/// render_fraction: fraction of renders among pasted objects that have photographs, 0 to 1.
/// rotation: largest rotation in the image plane, radians. None: 15 degrees.
/// longest_side: before detection, larger images are reduced to this many pixels along their longer side.
/// threshold: default score below which detections are left out, 0 to 1.
/// mesh_colors: False renders the meshes in random colours.
///
/// Raises OSError or ValueError for data that cannot be read, options out of range, and a folder that holds another training.
///
/// >>> trained = train_detector("data/demo", "out/detector", steps=200)  # doctest: +SKIP
/// >>> detector = Detector.load(trained["model"])  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (material, out, *, ids=None, frames=None, split=None, renders_only=false, network=None, backbone=None, steps=None, batch=None, learning_rate=None, encoder_rate=None, frozen_stages=None, size=None, photograph_fraction=None, render_fraction=None, rotation=None, longest_side=None, threshold=None, init=None, encoder=None, backgrounds=None, mesh_colors=None, progress=None, seed=None))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn train_detector<'py>(
    py: Python<'py>,
    material: &Bound<'py, PyAny>,
    out: PathBuf,
    ids: Option<&Bound<'py, PyAny>>,
    frames: Option<&Bound<'py, PyAny>>,
    split: Option<String>,
    renders_only: bool,
    network: Option<&str>,
    backbone: Option<&str>,
    steps: Option<i64>,
    batch: Option<i64>,
    learning_rate: Option<f64>,
    encoder_rate: Option<f64>,
    frozen_stages: Option<i64>,
    size: Option<i64>,
    photograph_fraction: Option<f64>,
    render_fraction: Option<f64>,
    rotation: Option<f64>,
    longest_side: Option<i64>,
    threshold: Option<f64>,
    init: Option<PathBuf>,
    encoder: Option<PathBuf>,
    backgrounds: Option<PathBuf>,
    mesh_colors: Option<bool>,
    progress: Option<Py<PyAny>>,
    seed: Option<i64>,
) -> PyResult<Bound<'py, PyDict>> {
    use sixfold::detect::network::EncoderKind;
    use sixfold::detect::recipe::{DetectorRecipe, MIN_VISIBILITY};
    let default = DetectorRecipe::default();
    let recipe = checked(DetectorRecipe {
        network: choice("network", network, default.network)?,
        backbone: backbone.map(|name| choice("backbone", Some(name), EncoderKind::Lite0)).transpose()?,
        steps: self::steps(steps)?.unwrap_or(default.steps),
        batch: count("batch", batch, default.batch)?,
        learning_rate: learning_rate.unwrap_or(default.learning_rate),
        encoder_rate: encoder_rate.unwrap_or(default.encoder_rate),
        frozen_stages: count("frozen_stages", frozen_stages, default.frozen_stages)?,
        encoder,
        size: count("size", size, default.size)?,
        photograph_fraction: single(photograph_fraction, default.photograph_fraction),
        render_fraction: single(render_fraction, default.render_fraction),
        rotation: single(rotation, default.rotation),
        mesh_colors: mesh_colors.unwrap_or(default.mesh_colors),
        longest_side: count("longest_side", longest_side, default.longest_side)?,
        threshold: single(threshold, default.threshold),
        init,
        backgrounds,
        seed: count("seed", seed, default.seed as usize)? as u64,
        command: "sixfold.train_detector".to_owned(),
    })?;
    let material = Source::new(material, ids, frames, split, renders_only)?.read(py, MIN_VISIBILITY)?;
    summary(py, run(py, progress, recipe, material, out)?)
}

/// Trains the network for grasps from experience (dissertation, chapter 6) on synthetic objects. DgcmNet.load reads the model.
///
/// Returns a dict with model (its path), steps, seconds, losses, quality. quality is measured on pairs of views of objects that were
/// not used in the training: pairs (their number), coordinates (mean error of one coordinate, range -1 to 1), decoded (the same
/// before the alignment of both views), own (the same if the view's own coordinates are taken), families (coordinates for each
/// family).
///
/// out, progress, interruption and resuming: as train_pix2pose. The first stage is "preparing".
/// network: "compact" or the dissertation's "paper".
/// steps, pairs (positive pairs in a step), learning_rate, lambda_ (weight of the coordinates' loss): None uses the network's
///     default.
/// views: number of simulated views to train on.
/// encoder: torchvision's ResNet-50 weights for "paper".
///
/// Raises OSError or ValueError for data that cannot be read, options out of range, and a folder that holds another training.
///
/// >>> network = DgcmNet.load(train_dgcm("out/dgcm", steps=100, views=500)["model"])  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (out, *, network=None, steps=None, pairs=None, learning_rate=None, lambda_=None, views=None, encoder=None, progress=None, seed=None))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn train_dgcm<'py>(
    py: Python<'py>,
    out: PathBuf,
    network: Option<&str>,
    steps: Option<i64>,
    pairs: Option<i64>,
    learning_rate: Option<f64>,
    lambda_: Option<f64>,
    views: Option<i64>,
    encoder: Option<PathBuf>,
    progress: Option<Py<PyAny>>,
    seed: Option<i64>,
) -> PyResult<Bound<'py, PyDict>> {
    use sixfold::dgcm::recipe::DgcmRecipe;
    let default = DgcmRecipe::default();
    let recipe = checked(DgcmRecipe {
        network: choice("network", network, default.network)?,
        encoder,
        init: None,
        alignment_only: false,
        steps: self::steps(steps)?,
        pairs: pairs.map(|n| whole("pairs", n, 0)).transpose()?,
        learning_rate,
        lambda: lambda_.map(|weight| positive("lambda_", weight)).transpose()?,
        views: count("views", views, default.views)?,
        seed: count("seed", seed, default.seed as usize)? as u64,
        command: "sixfold.train_dgcm".to_owned(),
    })?;
    let trained = run(py, progress, recipe, (), out)?;
    let quality = json_to_python(py, &trained.report)?;
    let dict = summary(py, trained)?;
    dict.set_item("quality", quality)?;
    Ok(dict)
}

/// Trains the network that matches regions of depth images with templates (dissertation, chapter 5) on synthetic objects that
/// fall on a table. Mttm takes the model as weights.
///
/// Returns a dict with model (its path), steps, seconds, losses, quality. quality is measured on objects that were not used in
/// the training:
///
/// regions: number of regions.
/// nearest: fraction of regions whose own template is the nearest of 40.
/// masks: fraction of masks with an intersection over union above 0.5.
/// matching: fraction of pairs classified correctly.
/// rotation (radians), offset (fraction of a patch): median errors of the own template, and after the network's correction.
///
/// Arguments:
///
/// out, progress, interruption and resuming: as train_pix2pose. The first stage is "preparing", and out gets an image of the
///     first regions, samples.png.
/// network: "compact", which trains on two cores, or the dissertation's "paper".
/// steps, anchors (regions with an object in a step), learning_rate: None uses the network's default.
/// objects: number of synthetic objects, 16 or more.
/// scenes: number of scenes of these objects, 4 or more, each rendered for five cameras.
/// encoder: torchvision's ResNet-50 weights for "paper".
///
/// Raises OSError or ValueError for data that cannot be read, options out of range, and a folder that holds another training.
///
/// >>> trained = train_mttm("out/mttm", steps=100, objects=32, scenes=16)  # doctest: +SKIP
/// >>> known = Mttm(mesh, weights=trained["model"])  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (out, *, network=None, steps=None, anchors=None, learning_rate=None, objects=None, scenes=None, encoder=None, progress=None, seed=None))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn train_mttm<'py>(
    py: Python<'py>,
    out: PathBuf,
    network: Option<&str>,
    steps: Option<i64>,
    anchors: Option<i64>,
    learning_rate: Option<f64>,
    objects: Option<i64>,
    scenes: Option<i64>,
    encoder: Option<PathBuf>,
    progress: Option<Py<PyAny>>,
    seed: Option<i64>,
) -> PyResult<Bound<'py, PyDict>> {
    use sixfold::mttm::recipe::MttmRecipe;
    let default = MttmRecipe::default();
    let recipe = checked(MttmRecipe {
        network: choice("network", network, default.network)?,
        encoder,
        steps: self::steps(steps)?,
        anchors: anchors.map(|n| whole("anchors", n, 0)).transpose()?,
        learning_rate,
        objects: count("objects", objects, default.objects)?,
        scenes: count("scenes", scenes, default.scenes)?,
        seed: count("seed", seed, default.seed as usize)? as u64,
        command: "sixfold.train_mttm".to_owned(),
    })?;
    let trained = run(py, progress, recipe, (), out)?;
    let quality = json_to_python(py, &trained.report)?;
    let dict = summary(py, trained)?;
    dict.set_item("quality", quality)?;
    Ok(dict)
}

/// Trains the network of Neural Object Learning (dissertation, chapter 4) on synthetic objects. synthesize takes the model as
/// weights.
///
/// Returns a dict with model (its path), steps, seconds, losses, quality. quality is the similarity of rendered views to the
/// ground truth, for objects that were not used in the training, compared with plain averaging.
///
/// out, progress, interruption and resuming: as train_pix2pose.
/// network: "compact" or the dissertation's "paper".
/// steps, learning_rate: None uses the network's default.
/// backgrounds: a folder of photographs for textures. None: procedural ones only.
/// lstm: False integrates the photographs' features by their mean.
/// decoder: False leaves the decoder out.
/// encoder: torchvision's DenseNet-121 weights for "paper".
///
/// Raises OSError or ValueError for data that cannot be read, options out of range, and a folder that holds another training.
///
/// >>> trained = train_nol("out/nol", steps=100)  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (out, *, network=None, steps=None, learning_rate=None, backgrounds=None, lstm=None, decoder=None, encoder=None, progress=None, seed=None))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn train_nol<'py>(
    py: Python<'py>,
    out: PathBuf,
    network: Option<&str>,
    steps: Option<i64>,
    learning_rate: Option<f64>,
    backgrounds: Option<PathBuf>,
    lstm: Option<bool>,
    decoder: Option<bool>,
    encoder: Option<PathBuf>,
    progress: Option<Py<PyAny>>,
    seed: Option<i64>,
) -> PyResult<Bound<'py, PyDict>> {
    use sixfold::nol::network::{IntegratorKind, Parts};
    use sixfold::nol::recipe::NolRecipe;
    let default = NolRecipe::default();
    let integrator = lstm.map(|lstm| if lstm { IntegratorKind::Lstm } else { IntegratorKind::Average });
    let recipe = checked(NolRecipe {
        network: choice("network", network, default.network)?,
        encoder,
        parts: Parts {
            integrator: integrator.unwrap_or(default.parts.integrator),
            decoder: decoder.unwrap_or(default.parts.decoder),
        },
        losses: default.losses,
        backgrounds,
        steps: self::steps(steps)?,
        learning_rate,
        seed: count("seed", seed, default.seed as usize)? as u64,
        command: "sixfold.train_nol".to_owned(),
    })?;
    let trained = run(py, progress, recipe, (), out)?;
    let scores = trained.report.scores();
    let dict = summary(py, trained)?;
    dict.set_item("quality", scores)?;
    Ok(dict)
}

/// Trains the network that matches rendered views of any object with colour images, on synthetic objects.
///
/// Returns a dict with model (its path), steps, seconds, losses.
///
/// out, progress, interruption and resuming: as train_pix2pose.
/// backgrounds: a folder of photographs for textures, backgrounds and occluders. None: procedural ones only.
/// batch: number of objects in a step.
///
/// Raises OSError or ValueError for data that cannot be read, options out of range, and a folder that holds another training.
///
/// >>> trained = train_views("out/views", steps=100)  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (out, *, steps=None, learning_rate=None, batch=None, backgrounds=None, progress=None, seed=None))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn train_views<'py>(
    py: Python<'py>,
    out: PathBuf,
    steps: Option<i64>,
    learning_rate: Option<f64>,
    batch: Option<i64>,
    backgrounds: Option<PathBuf>,
    progress: Option<Py<PyAny>>,
    seed: Option<i64>,
) -> PyResult<Bound<'py, PyDict>> {
    use sixfold::views::recipe::ViewsRecipe;
    let mut recipe =
        ViewsRecipe { backgrounds, command: "sixfold.train_views".to_owned(), ..ViewsRecipe::default() };
    let common = recipe.options.common.clone();
    let seed = count("seed", seed, common.seed as usize)? as u64;
    recipe.options.common = common.with(self::steps(steps)?, learning_rate, seed);
    recipe.options.batch = count("batch", batch, recipe.options.batch)?;
    summary(py, run(py, progress, checked(recipe)?, (), out)?)
}

/// Trains the network that refines poses of any object in colour images, on synthetic objects.
///
/// Returns a dict with model (its path), steps, seconds, losses.
///
/// out, progress, interruption and resuming: as train_pix2pose.
/// backgrounds: a folder of photographs for textures, backgrounds and occluders. None: procedural ones only.
/// init: a model to continue from.
/// batch: number of objects in a step, each with four poses.
///
/// Raises OSError or ValueError for data that cannot be read, options out of range, and a folder that holds another training.
///
/// >>> trained = train_refiner("out/refiner", steps=100)  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (out, *, steps=None, learning_rate=None, batch=None, backgrounds=None, init=None, progress=None, seed=None))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn train_refiner<'py>(
    py: Python<'py>,
    out: PathBuf,
    steps: Option<i64>,
    learning_rate: Option<f64>,
    batch: Option<i64>,
    backgrounds: Option<PathBuf>,
    init: Option<PathBuf>,
    progress: Option<Py<PyAny>>,
    seed: Option<i64>,
) -> PyResult<Bound<'py, PyDict>> {
    use sixfold::views::refiner::recipe::RefinerRecipe;
    let mut recipe = RefinerRecipe {
        backgrounds,
        init,
        command: "sixfold.train_refiner".to_owned(),
        ..RefinerRecipe::default()
    };
    let common = recipe.options.common.clone();
    let seed = count("seed", seed, common.seed as usize)? as u64;
    recipe.options.common = common.with(self::steps(steps)?, learning_rate, seed);
    recipe.options.batch = count("batch", batch, recipe.options.batch)?;
    summary(py, run(py, progress, checked(recipe)?, (), out)?)
}

/// Trains a detector of any object in colour images, on synthetic objects. Without boxes, the method "views" uses its proposals.
///
/// Returns a dict with model (its path), steps, seconds, losses.
///
/// out, progress, interruption and resuming: as train_pix2pose.
/// backgrounds: a folder of photographs for textures and backgrounds. None: procedural ones only.
/// batch: number of images in a step.
/// objects: number of synthetic objects to train on.
/// size: side of the training images in pixels, a multiple of 32.
///
/// Raises OSError or ValueError for data that cannot be read, options out of range, and a folder that holds another training.
///
/// >>> trained = train_proposals("out/proposals", steps=100)  # doctest: +SKIP
#[pyfunction]
#[pyo3(signature = (out, *, steps=None, learning_rate=None, batch=None, objects=None, size=None, backgrounds=None, progress=None, seed=None))]
#[allow(clippy::too_many_arguments)]
pub(crate) fn train_proposals<'py>(
    py: Python<'py>,
    out: PathBuf,
    steps: Option<i64>,
    learning_rate: Option<f64>,
    batch: Option<i64>,
    objects: Option<i64>,
    size: Option<i64>,
    backgrounds: Option<PathBuf>,
    progress: Option<Py<PyAny>>,
    seed: Option<i64>,
) -> PyResult<Bound<'py, PyDict>> {
    use sixfold::detect::proposals::ProposalsRecipe;
    let mut recipe = ProposalsRecipe {
        backgrounds,
        command: "sixfold.train_proposals".to_owned(),
        ..ProposalsRecipe::default()
    };
    let common = recipe.options.common.clone();
    let seed = count("seed", seed, common.seed as usize)? as u64;
    recipe.options.common = common.with(self::steps(steps)?, learning_rate, seed);
    recipe.options.batch = count("batch", batch, recipe.options.batch)?;
    recipe.objects = count("objects", objects, recipe.objects)?;
    recipe.size = count("size", size, recipe.size)?;
    summary(py, run(py, progress, checked(recipe)?, (), out)?)
}
