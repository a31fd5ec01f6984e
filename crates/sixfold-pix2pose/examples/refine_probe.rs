//! How well alignment with the image mends disturbed ground-truth poses: DATASET FRAMES.json [image weight]...
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sixfold_bop::{BopDataset, Models, VISIBILITY_DELTA, ground_truth_visibility};
use sixfold_geometry::{Pose, Rect, Vec3};
use sixfold_pix2pose::estimate::{Found, ThresholdHypothesis, View};
use sixfold_pix2pose::model::Prediction;
use sixfold_pix2pose::refine::{OutlineRefinementOptions, refine};
use std::collections::BTreeMap;
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let dataset = BopDataset::open(Path::new(&arguments[0]), "test")?;
    let frames = dataset.targets(Some(Path::new(&arguments[1])))?;
    let infos = dataset.models_info(Models::Rendering)?.unwrap_or_default();
    let mut meshes = BTreeMap::new();
    for id in infos.0.keys() {
        meshes.insert(*id, dataset.model(*id, Models::Rendering)?);
    }
    let scale: f64 = arguments.get(2).map_or(1.0, |s| s.parse().unwrap());
    let options = OutlineRefinementOptions::default();
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut normal =
        move || rng.random_range(-1.0..1.0f64) + rng.random_range(-1.0..1.0) + rng.random_range(-1.0..1.0);
    let mut all: BTreeMap<u32, Vec<[f64; 4]>> = BTreeMap::new();
    let mut seconds = 0.0;
    for target in frames {
        let scene = dataset.scene(target.scene_id)?;
        let frame = scene.image(target.im_id)?;
        let camera = scene.camera(target.im_id)?;
        let image = scene.rgb(target.im_id)?.unwrap();
        let placed: Vec<_> =
            frame.ground_truth.iter().map(|g| (&meshes[&g.obj_id], g.camera_from_object)).collect();
        let visible = ground_truth_visibility(&placed, &camera, None, VISIBILITY_DELTA);
        for (g, v) in frame.ground_truth.iter().zip(visible) {
            if v.info.visib_fract < 0.3 {
                continue;
            }
            let Some(b) = v.info.bbox_visib else { continue };
            let side = 1.5 * b.width.max(b.height);
            let window = Rect {
                x: b.x + 0.5 * b.width - 0.5 * side,
                y: b.y + 0.5 * b.height - 0.5 * side,
                width: side,
                height: side,
            };
            let n = 64;
            let visible: Vec<f32> = (0..n * n)
                .map(|i| {
                    let x = window.x + ((i % n) as f64 + 0.5) / n as f64 * side - 0.5;
                    let y = window.y + ((i / n) as f64 + 0.5) / n as f64 * side - 0.5;
                    f32::from(
                        v.mask_visible
                            .get(x.round().max(0.0) as usize, y.round().max(0.0) as usize)
                            .copied()
                            .unwrap_or(false),
                    )
                })
                .collect();
            let t = g.camera_from_object.translation();
            // Turn about the centre, shift across and along the view.
            let twist = [
                0.003 * normal(),
                0.003 * normal(),
                0.02 * t.z * normal(),
                0.05 * normal(),
                0.05 * normal(),
                0.05 * normal(),
            ]
            .map(|v| v * scale);
            let centre = Pose::from_translation(t);
            let initial = centre * Pose::exp(&twist.into()) * centre.inverse() * g.camera_from_object;
            let view = View {
                window,
                input: image.clone(),
                prediction: Prediction { side: n, coordinates: vec![], error: vec![], visible },
            };
            let found = Found {
                hypotheses: vec![ThresholdHypothesis {
                    camera_from_object: initial,
                    threshold: 0.2,
                    inliers: 1,
                    score: 1.0,
                }],
                open_view: view.clone(),
                first_view: view.clone(),
                view,
                object_points: vec![],
                image_points: vec![],
            };
            let mesh = &meshes[&g.obj_id];
            let began = std::time::Instant::now();
            let refined = refine(&image, &camera, mesh, &found, &options);
            seconds += began.elapsed().as_secs_f64();
            let add = |pose: &Pose| {
                let points: Vec<Vec3> = mesh.vertices().iter().step_by(10).copied().collect();
                points
                    .iter()
                    .map(|p| (pose.transform_point(p) - g.camera_from_object.transform_point(p)).norm())
                    .sum::<f64>()
                    / points.len() as f64
                    / infos.0[&g.obj_id].diameter
            };
            let dz = |pose: &Pose| 1000.0 * (pose.translation().z - t.z).abs();
            all.entry(g.obj_id).or_default().push([
                add(&initial),
                add(&refined.camera_from_object),
                dz(&initial),
                dz(&refined.camera_from_object),
            ]);
        }
    }
    let median = |v: &[[f64; 4]], k: usize| {
        let mut v: Vec<f64> = v.iter().map(|e| e[k]).collect();
        v.sort_by(f64::total_cmp);
        v[v.len() / 2]
    };
    let recall = |v: &[[f64; 4]], k: usize| v.iter().filter(|e| e[k] < 0.1).count() as f64 / v.len() as f64;
    let everything: Vec<[f64; 4]> = all.values().flatten().copied().collect();
    for (id, v) in all.iter().map(|(i, v)| (i.to_string(), v)).chain([("all".to_string(), &everything)]) {
        println!(
            "{id:>4}: n {:>3}  ADD/d {:.3} -> {:.3}   recall {:.2} -> {:.2}   dz mm {:.1} -> {:.1}",
            v.len(),
            median(v, 0),
            median(v, 1),
            recall(v, 0),
            recall(v, 1),
            median(v, 2),
            median(v, 3)
        );
    }
    println!("{:.1} ms each", 1000.0 * seconds / everything.len() as f64);
    Ok(())
}
