//! Template matching on frames of a BOP dataset, with ablations and times:
//! `cargo run --release -p sixfold-mttm --example bench_mttm -- DATASET TARGETS.json EVERY [WEIGHTS]`. WEIGHTS adds the network.
//! Every EVERY-th image of the targets. Prints for each object the fraction of targets whose mask overlaps the visible truth by more
//! than half, and whose pose is right within a tenth of the diameter (ADD, ADI for symmetric objects).

use std::collections::BTreeMap;
use std::path::Path;

use sixfold_align::{DepthOptions, DepthRegion, verification_mesh};
use sixfold_bop::{BopDataset, Models};
use sixfold_geometry::{KdTree, Pose, Vec3};
use sixfold_mttm::model::MttmModel;
use sixfold_mttm::{KnownObject, MatchedBy, MttmOptions, ObjectTemplates, Search, Stages, TemplateOptions};
use sixfold_render::render_depth;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().collect();
    let [_, root, targets, every, weights @ ..] = &arguments[..] else {
        return Err("DATASET TARGETS.json EVERY [WEIGHTS]".into());
    };
    let network = match weights {
        [file, ..] => Some(std::sync::Arc::new(MttmModel::load(Path::new(file))?)),
        [] => None,
    };
    let dataset = BopDataset::open(Path::new(root), "test")?;
    let targets = dataset.object_targets(&dataset.targets(Some(Path::new(targets)))?)?;
    let infos = dataset.models_info(Models::Rendering)?.ok_or("no models_info.json")?;
    let mut known: BTreeMap<u32, KnownObject> = BTreeMap::new();
    let mut images: BTreeMap<(u32, u32), Vec<u32>> = BTreeMap::new();
    for t in targets.iter().filter_map(|t| t.object.map(|o| (t, o))) {
        images.entry((t.0.scene_id, t.0.im_id)).or_default().push(t.1.obj_id);
    }
    let started = std::time::Instant::now();
    for id in targets.iter().filter_map(|t| t.object).map(|o| o.obj_id) {
        if let std::collections::btree_map::Entry::Vacant(place) = known.entry(id) {
            let mesh = dataset.model(id, Models::Rendering)?;
            let templates = ObjectTemplates::from_mesh(&mesh, &TemplateOptions::default())?;
            let model = verification_mesh(&mesh)?;
            let mut object = KnownObject::new(templates, Some(model));
            if let Some(network) = &network {
                object = object.with_network(network.clone());
            }
            place.insert(object);
        }
    }
    println!("{:.1} s for {} objects", started.elapsed().as_secs_f64(), known.len());
    let plain = MttmOptions { min_score: 0.0, ..MttmOptions::default() };
    let by = |matched_by, predicted_pose| MttmOptions { matched_by, predicted_pose, ..plain };
    let all: Vec<(&str, bool, MttmOptions)> = vec![
        ("points", true, by(MatchedBy::Points, true)),
        ("points, no mesh", false, by(MatchedBy::Points, true)),
        ("nearest", false, MttmOptions { align: false, ..by(MatchedBy::Points, true) }),
        ("network", true, by(MatchedBy::Network, true)),
        ("network, template's pose", true, by(MatchedBy::Network, false)),
        ("network, no mesh", false, by(MatchedBy::Network, true)),
        ("network's nearest", false, MttmOptions { align: false, ..by(MatchedBy::Network, false) }),
        ("both", true, by(MatchedBy::Both, true)),
        ("both, template's pose", true, by(MatchedBy::Both, false)),
        ("both, no mesh", false, by(MatchedBy::Both, true)),
    ];
    let only = std::env::var("ONLY").unwrap_or_default();
    let variants: Vec<_> = all
        .into_iter()
        .filter(|(name, _, o)| {
            (network.is_some() || o.matched_by == MatchedBy::Points)
                && (only.is_empty() || only.split(';').any(|part| part == *name))
        })
        .collect();
    let mut counts: BTreeMap<(usize, u32), [usize; 3]> = BTreeMap::new();
    let mut sums: Vec<Stages> = vec![Stages::default(); variants.len()];
    let mut done = 0;
    for ((scene_id, im_id), ids) in images.iter().step_by(every.parse()?) {
        let scene = dataset.scene(*scene_id)?;
        let image = scene.image(*im_id)?;
        let (camera, Some(depth)) = (scene.camera(*im_id)?, scene.depth(*im_id)?) else { continue };
        let prepared = DepthRegion::from_depth(&depth, &camera, None, &DepthOptions::default())?;
        done += 1;
        for (v, (name, with_mesh, options)) in variants.iter().enumerate() {
            let search = Search::new(&prepared);
            for id in ids {
                let object = known[id].clone();
                let object = if *with_mesh { object } else { object.without_mesh() };
                let (found, stages) = search.estimate(&object, options);
                let s = &mut sums[v];
                s.matching += stages.matching;
                s.masks += stages.masks;
                s.rematching += stages.rematching;
                s.verification += stages.verification;
                s.sampled += stages.sampled;
                let Some(truth) = image.ground_truth.iter().find(|g| g.obj_id == *id) else { continue };
                let truth = truth.camera_from_object;
                let mesh = dataset.model(*id, Models::Rendering)?;
                let drawn = render_depth(&mesh, &truth, &camera);
                let visible = |i: usize| {
                    let (a, b) = (drawn.as_slice()[i], depth.as_slice()[i]);
                    a > 0.0 && b > 0.0 && (a - b).abs() < 0.02
                };
                let total = (0..drawn.as_slice().len()).filter(|&i| visible(i)).count();
                let count = counts.entry((v, *id)).or_default();
                count[0] += 1;
                let Some(best) = found.first() else { continue };
                let common = best.mask.iter().filter(|&&p| visible(p as usize)).count();
                count[1] += usize::from(2 * common > total + best.mask.len() - common);
                let info = &infos.0[id];
                let right =
                    error(&mesh, &truth, &best.camera_from_object, info.is_symmetric()) < 0.1 * info.diameter;
                count[2] += usize::from(right);
                if !right && std::env::var_os("SHOW").is_some() {
                    println!(
                        "{name} {scene_id}/{im_id} object {id} wrong, confidence {:.2}",
                        best.confidence
                    );
                }
            }
        }
    }
    for (v, (name, ..)) in variants.iter().enumerate() {
        let mut all = [0; 3];
        print!("{name:<26}");
        for ((_, id), c) in counts.iter().filter(|((w, _), _)| *w == v) {
            print!(
                " {id}: {:.0}/{:.0}",
                100.0 * c[1] as f64 / c[0] as f64,
                100.0 * c[2] as f64 / c[0] as f64
            );
            all = std::array::from_fn(|k| all[k] + c[k]);
        }
        let n = all[0].max(1) as f64;
        println!("\n  all {}: IoU {:.3} ADD(-S) {:.3}", all[0], all[1] as f64 / n, all[2] as f64 / n);
        let (s, d) = (&sums[v], f64::from(done));
        println!(
            "  seconds an image: matching {:.2} masks {:.2} rematching {:.2} verification {:.2}; {:.0} regions an object",
            s.matching / d,
            s.masks / d,
            s.rematching / d,
            s.verification / d,
            s.sampled as f64 / n
        );
    }
    Ok(())
}

fn error(mesh: &sixfold_mesh::Mesh, truth: &Pose, found: &Pose, symmetric: bool) -> f64 {
    let points: Vec<Vec3> =
        mesh.vertices().iter().step_by(mesh.vertices().len() / 500 + 1).copied().collect();
    let moved = |pose: &Pose| points.iter().map(|p| pose.transform_point(p)).collect::<Vec<_>>();
    let (a, b) = (moved(truth), moved(found));
    let sum: f64 = if symmetric {
        let all: Vec<Vec3> = mesh.vertices().iter().map(|p| found.transform_point(p)).collect();
        let tree = KdTree::new(&all);
        a.iter().filter_map(|p| tree.nearest(p)).map(|n| n.distance).sum()
    } else {
        a.iter().zip(&b).map(|(p, q)| (p - q).norm()).sum()
    };
    sum / points.len() as f64
}
