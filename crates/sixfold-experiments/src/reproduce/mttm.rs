//! `sixfold reproduce mttm`: masks and poses of template matching per object, compared with its ablations and with point pair
//! features on the same images (dissertation, tables 5.1 and 5.2).
//!
//! The results of every image are stored in `images/`, so that an interrupted run can be resumed.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use clap::Args;
use serde::{Deserialize, Serialize};
use sixfold_align::{DepthOptions, DepthRegion, VerificationOptions};
use sixfold_bop::{BopDataset, ModelPoints, Models, add_s};
use sixfold_estimator::{Cache, Object, PoseEstimator, downcast};
use sixfold_geometry::{Camera, DepthImage, Pose};
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_mttm::model::MttmModel;
use sixfold_mttm::{KnownObject, MaskSource, MatchedBy, MttmEstimator, MttmObject, MttmOptions, Search};
use sixfold_ppf::{ObjectModel, PpfEstimator, PpfObject, PpfOptions};
use sixfold_render::render_depth;

use super::kept::write_table;
use sixfold_shell::Outcome;
use sixfold_shell::datasets;
use sixfold_shell::output::{JsonArguments, write_atomically};
use sixfold_shell::progress::{Progress, check_interrupt};
use sixfold_shell::ranges::folder_name;

/// `sixfold reproduce mttm`.
#[derive(Debug, Args)]
pub(crate) struct ReproduceMttmArguments {
    /// BOP dataset folder with depth, such as one that `sixfold simulate-depth` wrote
    #[arg(long, value_name = "DIR")]
    pub dataset: PathBuf,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Folder of the dataset's models, such as models_cad or models_reconst of T-LESS (default: models, or models_eval without it;
    /// for scores the reverse)
    #[arg(long, value_name = "FOLDER", value_parser = folder_name)]
    pub models: Option<String>,
    /// Targets file of the dataset (default: its test_targets_bop19.json, or all ground truth)
    #[arg(long, value_name = "FILE")]
    pub targets: Option<PathBuf>,
    /// Folder for the table, its JSON, and the results of finished images
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Take every N-th image
    #[arg(long, value_name = "N", default_value = "1")]
    pub every: std::num::NonZeroUsize,
    /// Network to use instead of the built-in one: a file that `sixfold train mttm` wrote
    #[arg(long, value_name = "FILE.safetensors")]
    pub weights: Option<PathBuf>,
    /// Leave out point pair features, for comparison on the same images
    #[arg(long)]
    pub no_ppf: bool,
    /// Measure these rows only, by their keys in the JSON, such as network-masks,both (default: all)
    #[arg(long, value_name = "KEY", value_delimiter = ',', value_parser = ROWS)]
    pub rows: Vec<String>,
}

/// Pixels whose depth is this close to the rendered ground truth belong to the object, metres (dissertation, section 5.3.2).
const TRUTH_DEPTH: f32 = 0.02;

/// A row of the table.
struct Way {
    key: &'static str,
    title: &'static str,
    by: MatchedBy,
    predicted_pose: bool,
    align: bool,
    mesh: bool,
    occluders_have_edges: bool,
    masks: MaskSource,
    published: bool,
}

const fn way(key: &'static str, title: &'static str, by: MatchedBy) -> Way {
    Way {
        key,
        title,
        by,
        predicted_pose: true,
        align: true,
        mesh: true,
        occluders_have_edges: true,
        masks: MaskSource::Aligned,
        published: false,
    }
}

/// Variants of template matching, the default first.
const WAYS: [Way; 14] = [
    way("both", "points and network, aligned, verified with the mesh (default)", MatchedBy::Both),
    Way {
        predicted_pose: false,
        ..way("both-template-pose", "the same without the predicted rotation and place", MatchedBy::Both)
    },
    Way { mesh: false, ..way("both-templates", "the same judged by the templates alone", MatchedBy::Both) },
    Way {
        occluders_have_edges: false,
        ..way(
            "both-printed-score",
            "the same with the published score, which forgives whatever is hidden",
            MatchedBy::Both,
        )
    },
    way("network", "network alone, aligned, verified with the mesh", MatchedBy::Network),
    Way {
        predicted_pose: false,
        ..way(
            "network-template-pose",
            "the same without the predicted rotation and place",
            MatchedBy::Network,
        )
    },
    Way {
        predicted_pose: false,
        align: false,
        mesh: false,
        ..way("network-nearest", "the network's nearest template as it was matched", MatchedBy::Network)
    },
    Way {
        align: false,
        mesh: false,
        masks: MaskSource::Network,
        ..way(
            "network-masks",
            "masks by the network alone, ranked by it, nothing aligned (comparable with table 5.1)",
            MatchedBy::Network,
        )
    },
    Way {
        masks: MaskSource::Network,
        ..way(
            "network-masks-verified",
            "the same masks, ranked by their aligned and verified poses",
            MatchedBy::Network,
        )
    },
    Way {
        occluders_have_edges: false,
        published: true,
        ..way(
            "published",
            "as published: the network alone, its masks before any alignment (comparable with table 5.1)",
            MatchedBy::Network,
        )
    },
    Way {
        occluders_have_edges: false,
        published: true,
        predicted_pose: false,
        ..way("published-template-pose", "the same without the predicted rotation", MatchedBy::Network)
    },
    way("points", "points alone (no network), aligned, verified with the mesh", MatchedBy::Points),
    Way {
        mesh: false,
        ..way("points-templates", "the same judged by the templates alone", MatchedBy::Points)
    },
    Way {
        align: false,
        mesh: false,
        ..way("points-nearest", "the nearest template by points as it was matched", MatchedBy::Points)
    },
];
/// Keys of [`WAYS`].
const ROWS: [&str; WAYS.len()] = {
    let (mut keys, mut k) = ([""; WAYS.len()], 0);
    while k < keys.len() {
        keys[k] = WAYS[k].key;
        k += 1;
    }
    keys
};
/// The row of another method.
const PPF: (&str, &str) = ("ppf", "point pair features");

/// The measurement of one target with one variant.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Outcomes {
    object: u32,
    /// Intersection over union of the mask and the visible ground truth, if there is a mask.
    iou: Option<f64>,
    /// ADD (ADI for symmetric objects) as a fraction of the diameter; `None` when nothing was found.
    error: Option<f64>,
    confidence: Option<f64>,
    /// Seconds until hypotheses, and in verification.
    seconds: [f64; 2],
}

/// One image: results by row.
type Measured = BTreeMap<String, Vec<Outcomes>>;

#[derive(Debug, Clone, Serialize)]
struct Score {
    targets: usize,
    /// Fraction of the targets whose mask overlaps the truth by more than half.
    iou: Option<f64>,
    /// Fraction of the targets within a tenth of the diameter.
    add_s: f64,
}

#[derive(Debug, Serialize)]
struct Row {
    key: &'static str,
    title: &'static str,
    all: Score,
    objects: BTreeMap<u32, Score>,
    /// Mean seconds per image for all of its objects: until hypotheses, and in verification.
    seconds: [f64; 2],
}

#[derive(Debug, Serialize)]
struct Whole {
    dataset: String,
    images: usize,
    rows: Vec<Row>,
    /// Values from the dissertation, trained on these objects, with real depth; not measured here.
    literature: BTreeMap<&'static str, f64>,
}

/// The inputs on which results depend.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Inputs {
    version: String,
    dataset: String,
    split: String,
    #[serde(default)]
    models: Option<String>,
    ppf: bool,
    #[serde(default)]
    rows: Vec<String>,
    /// Fingerprint of the network.
    network: String,
}

struct Known {
    mesh: Mesh,
    info: ModelInfo,
    points: ModelPoints,
    with_mesh: KnownObject,
    alone: KnownObject,
    ppf: ObjectModel,
}

pub(crate) fn run(a: &ReproduceMttmArguments, json: &JsonArguments) -> Result<Outcome> {
    let dataset = datasets::open(&a.dataset, &a.split, a.models.as_deref())?;
    let targets = dataset.object_targets(&dataset.targets(a.targets.as_deref())?)?;
    let model = match &a.weights {
        Some(file) => MttmModel::load(file).context("--weights")?,
        None => MttmModel::shipped().context("the network within the program")?,
    };
    let model = Arc::new(model);
    let inputs = Inputs {
        version: env!("CARGO_PKG_VERSION").into(),
        dataset: a.dataset.display().to_string(),
        split: a.split.clone(),
        models: a.models.clone(),
        ppf: !a.no_ppf,
        rows: a.rows.clone(),
        network: format!("{:016x}", model.fingerprint()),
    };
    same_inputs(&a.out, &inputs)?;
    let mut images: BTreeMap<(u32, u32), Vec<u32>> = BTreeMap::new();
    for (t, o) in targets.iter().filter_map(|t| t.object.map(|o| (t, o))) {
        images.entry((t.scene_id, t.im_id)).or_default().push(o.obj_id);
    }
    let images: Vec<_> = images.into_iter().step_by(a.every.get()).collect();
    let mut known: BTreeMap<u32, Known> = BTreeMap::new();
    let mut progress = Progress::new("images", images.len());
    let mut measured: Vec<Measured> = vec![];
    for ((scene_id, im_id), ids) in &images {
        check_interrupt("the results of finished images are kept; run the same command again to continue")?;
        let kept = a.out.join("images").join(format!("{scene_id:06}_{im_id:06}.json"));
        if let Ok(text) = std::fs::read_to_string(&kept) {
            measured.push(serde_json::from_str(&text).with_context(|| {
                format!("{}: not an image of this version; remove it to have it made again", kept.display())
            })?);
            progress.step(format!("{scene_id}/{im_id} was done"));
            continue;
        }
        for id in ids {
            if let std::collections::btree_map::Entry::Vacant(place) = known.entry(*id) {
                place.insert(know(&dataset, *id, &model)?);
            }
        }
        let scene = dataset.scene(*scene_id)?;
        let Some(depth) = scene.depth(*im_id)? else {
            bail!(
                "image {scene_id}/{im_id} has no depth image, which templates need (simulate it with `sixfold simulate-depth`)"
            )
        };
        let mut truths: BTreeMap<u32, Vec<Pose>> = BTreeMap::new();
        for g in &scene.image(*im_id)?.ground_truth {
            truths.entry(g.obj_id).or_default().push(g.camera_from_object);
        }
        let one = measure(a, &depth, &scene.camera(*im_id)?, ids, &truths, &known)?;
        write_atomically(&kept, serde_json::to_string(&one)?.as_bytes())?;
        measured.push(one);
        progress.step(format!("{scene_id}/{im_id}"));
    }
    progress.finish();
    let rows: Vec<Row> = WAYS
        .iter()
        .map(|w| (w.key, w.title))
        .chain([PPF])
        .filter(|(key, _)| measured.iter().any(|m| m.contains_key(*key)))
        .map(|(key, title)| row(key, title, &measured))
        .collect();
    let whole = Whole {
        dataset: inputs.dataset,
        images: images.len(),
        rows,
        literature: BTreeMap::from([
            ("dissertation, table 5.1: masks before any alignment with IoU above 0.5", 0.788),
            ("dissertation, table 5.2: ADD(-S) below a tenth of the diameter, mean of the objects", 0.529),
        ]),
    };
    write_table(
        &a.out,
        &markdown(&whole),
        &whole,
        "table.md, reproduce.json and the images' outcomes are",
        json,
    )?;
    let any = whole.rows.iter().any(|r| r.all.add_s > 0.0);
    Ok(if any { Outcome::Found } else { Outcome::NothingFound })
}

/// An error if the folder contains images measured with other inputs.
fn same_inputs(folder: &Path, inputs: &Inputs) -> Result<()> {
    let path = folder.join("inputs.json");
    if let Ok(text) = std::fs::read_to_string(&path) {
        let before: Option<Inputs> = serde_json::from_str(&text).ok();
        if before.as_ref() != Some(inputs) {
            bail!(
                "{} was made with other inputs (see {}): remove it or choose another --out",
                folder.display(),
                path.display()
            );
        }
        return Ok(());
    }
    write_atomically(&path, serde_json::to_string_pretty(inputs)?.as_bytes())
}

fn know(dataset: &BopDataset, id: u32, model: &Arc<MttmModel>) -> Result<Known> {
    let mesh = dataset.model(id, Models::Rendering)?;
    let info = dataset
        .models_info(Models::Rendering)?
        .and_then(|all| all.0.get(&id).cloned())
        .unwrap_or_else(|| ModelInfo::of_mesh(&mesh));
    // The folder in which `sixfold estimate` keeps derived data too.
    let folder = Cache::of_user().of_mesh(&mesh, &info)?;
    let object = Object { folder, ..Object::of_mesh(format!("object {id}"), mesh.clone(), info.clone()) };
    let templates = MttmEstimator { network: Some(model.clone()), ..MttmEstimator::default() };
    let templates = templates.prepare(&object)?;
    let features = PpfEstimator::default().prepare(&object)?;
    for note in templates.notes().iter().chain(features.notes()) {
        eprintln!("note: {note}");
    }
    let with_mesh = downcast::<MttmObject>(templates.as_ref(), "mttm")?.known().clone();
    let ppf = downcast::<PpfObject>(features.as_ref(), "ppf")?.model().clone();
    let alone = with_mesh.clone().without_mesh();
    let vertices = dataset.model(id, Models::Evaluation)?;
    let points = ModelPoints::new(vertices.vertices())
        .with_context(|| format!("object {id}: its model for scores has no vertices"))?;
    Ok(Known { mesh, info, points, with_mesh, alone, ppf })
}

fn measure(
    a: &ReproduceMttmArguments,
    depth: &DepthImage,
    camera: &Camera,
    ids: &[u32],
    truths: &BTreeMap<u32, Vec<Pose>>,
    known: &BTreeMap<u32, Known>,
) -> Result<Measured> {
    let scene = DepthRegion::from_depth(depth, camera, None, &DepthOptions::default())?;
    let mut measured = Measured::new();
    // Each variant separately, so that times are not shared.
    let ways: Vec<&Way> =
        WAYS.iter().filter(|w| a.rows.is_empty() || a.rows.iter().any(|key| key == w.key)).collect();
    let searches: Vec<Search<'_>> = ways.iter().map(|_| Search::new(&scene)).collect();
    for id in ids {
        let (Some(k), Some(truths)) = (known.get(id), truths.get(id)) else { continue };
        let instances: Vec<Vec<bool>> =
            truths.iter().map(|truth| visible(&render_depth(&k.mesh, truth, camera), depth)).collect();
        // With several instances, any of them may be found.
        let error = |pose: &Pose| {
            truths.iter().map(|t| pose_error(&k.points, &k.info, t, pose)).fold(f64::INFINITY, f64::min)
        };
        for (way, search) in ways.iter().zip(&searches) {
            let object = if way.mesh { &k.with_mesh } else { &k.alone };
            let (matched_by, predicted_pose, align) = (way.by, way.predicted_pose, way.align);
            let masks = way.masks;
            let verification = VerificationOptions {
                occluders_have_edges: way.occluders_have_edges,
                ..VerificationOptions::default()
            };
            let form = if way.published { MttmOptions::published() } else { MttmOptions::default() };
            let options = MttmOptions {
                matched_by,
                predicted_pose,
                align,
                masks,
                verification,
                min_score: 0.0,
                ..form
            };
            let (found, stages) = search.estimate(object, &options);
            let best = found.first();
            let iou = best.map(|e| instances.iter().map(|i| overlap(&e.mask, i)).fold(0.0, f64::max));
            measured.entry(way.key.into()).or_default().push(Outcomes {
                object: *id,
                iou,
                error: best.map(|e| error(&e.camera_from_object)),
                confidence: best.map(|e| e.confidence),
                seconds: [stages.hypotheses(), stages.verification],
            });
        }
        if !a.no_ppf {
            let start = Instant::now();
            let options = PpfOptions { min_score: 0.0, ..Default::default() };
            let found = sixfold_ppf::estimate(&scene, &k.ppf, &options);
            let best = found.first();
            measured.entry(PPF.0.into()).or_default().push(Outcomes {
                object: *id,
                iou: None,
                error: best.map(|e| error(&e.camera_from_object)),
                confidence: best.map(|e| e.confidence),
                seconds: [start.elapsed().as_secs_f64(), 0.0],
            });
        }
    }
    Ok(measured)
}

/// ADD, or ADI for symmetric objects, of the vertices that `sixfold eval` uses, as a fraction of the diameter.
fn pose_error(points: &ModelPoints, info: &ModelInfo, truth: &Pose, found: &Pose) -> f64 {
    add_s(points, info.is_symmetric(), found, truth) / info.diameter
}

/// The pixels at which a rendered instance is visible.
fn visible(rendered: &DepthImage, depth: &DepthImage) -> Vec<bool> {
    let pairs = rendered.as_slice().iter().zip(depth.as_slice());
    pairs.map(|(z, seen)| *z > 0.0 && *seen > 0.0 && (z - seen).abs() < TRUTH_DEPTH).collect()
}

/// Intersection over union of a mask and the visible pixels.
fn overlap(mask: &[u32], visible: &[bool]) -> f64 {
    let truth = visible.iter().filter(|v| **v).count();
    let common = mask.iter().filter(|p| visible.get(**p as usize) == Some(&true)).count();
    common as f64 / (truth + mask.len() - common).max(1) as f64
}

fn row(key: &'static str, title: &'static str, measured: &[Measured]) -> Row {
    let outcomes: Vec<&Outcomes> = measured.iter().filter_map(|m| m.get(key)).flatten().collect();
    let score = |of: &[&Outcomes]| {
        let fraction = |count: usize| count as f64 / of.len().max(1) as f64;
        Score {
            targets: of.len(),
            iou: (key != PPF.0)
                .then(|| fraction(of.iter().filter(|o| o.iou.is_some_and(|v| v > 0.5)).count())),
            add_s: fraction(of.iter().filter(|o| o.error.is_some_and(|e| e < 0.1)).count()),
        }
    };
    let mut by_object: BTreeMap<u32, Vec<&Outcomes>> = BTreeMap::new();
    for o in &outcomes {
        by_object.entry(o.object).or_default().push(o);
    }
    let mean = |k: usize| outcomes.iter().map(|o| o.seconds[k]).sum::<f64>() / measured.len().max(1) as f64;
    Row {
        key,
        title,
        all: score(&outcomes),
        objects: by_object.iter().map(|(id, of)| (*id, score(of))).collect(),
        seconds: [mean(0), mean(1)],
    }
}

fn markdown(whole: &Whole) -> String {
    let percent = |v: Option<f64>| v.map_or("-".to_string(), |v| format!("{:.1}", 100.0 * v));
    let mut text = format!(
        "# Template matching: {} images of {}\n\nPer cent of the targets whose mask overlaps the visible truth by more than half / \
         whose pose is right within a tenth of the diameter (ADD, ADI for symmetric objects).\n\n| |",
        whole.images, whole.dataset
    );
    let ids: Vec<u32> = whole.rows.first().map(|r| r.objects.keys().copied().collect()).unwrap_or_default();
    for id in &ids {
        text += &format!(" {id} |");
    }
    text += " all | s an image, hypotheses + verification |\n|---|";
    text += &"---|".repeat(ids.len() + 2);
    text += "\n";
    for r in &whole.rows {
        text += &format!("| {} |", r.title);
        for id in &ids {
            match r.objects.get(id) {
                Some(s) => text += &format!(" {} / {} |", percent(s.iou), percent(Some(s.add_s))),
                None => text += " - |",
            }
        }
        text += &format!(
            " {} / {} | {:.2} + {:.2} |\n",
            percent(r.all.iou),
            percent(Some(r.all.add_s)),
            r.seconds[0],
            r.seconds[1]
        );
    }
    let targets = whole.rows.first().map_or(0, |r| r.all.targets);
    text += &format!("\n{targets} targets. Not measured here, real depth, trained on these objects:\n\n");
    for (what, value) in &whole.literature {
        text += &format!("* {what}: {value:.3}\n");
    }
    text
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::Vec3;

    use super::*;

    #[test]
    fn a_row_counts_missing_poses_as_wrong() {
        let outcome =
            |object, iou, error| Outcomes { object, iou, error, confidence: None, seconds: [1.0, 0.5] };
        let image = |all: Vec<Outcomes>| Measured::from([("both".to_string(), all)]);
        let measured = [
            image(vec![outcome(1, Some(0.8), Some(0.05)), outcome(2, None, None)]),
            image(vec![outcome(1, Some(0.4), Some(0.2))]),
        ];
        let r = row("both", "", &measured);
        assert_eq!((r.all.targets, r.all.iou, r.all.add_s), (3, Some(1.0 / 3.0), 1.0 / 3.0));
        assert_eq!((r.objects[&1].add_s, r.objects[&2].add_s), (0.5, 0.0));
        assert_eq!(r.seconds, [1.5, 0.75]);
    }

    #[test]
    fn masks_overlap_by_intersection_over_union() {
        let visible: Vec<bool> = (0..100).map(|i| i < 40).collect();
        let mask: Vec<u32> = (20..60).collect();
        assert!((overlap(&mask, &visible) - 20.0 / 60.0).abs() < 1e-12);
        assert_eq!(overlap(&[], &[false; 4]), 0.0);
    }

    #[test]
    fn the_error_is_a_fraction_of_the_diameter() {
        let vertices = vec![Vec3::zeros(), Vec3::x() * 0.1, Vec3::y() * 0.1, Vec3::z() * 0.1];
        let points = ModelPoints::new(&vertices).unwrap();
        let mesh = Mesh::new(vertices, vec![[0, 1, 2], [0, 2, 3]]).unwrap();
        let info = ModelInfo::of_mesh(&mesh);
        let moved = Pose::from_translation(Vec3::new(0.0, 0.01, 0.0));
        let error = pose_error(&points, &info, &Pose::identity(), &moved);
        assert!((error - 0.01 / info.diameter).abs() < 1e-9, "{error}");
    }
}
