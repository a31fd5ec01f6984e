//! Time per box of each part of an estimate: DATASET TARGETS.json WEIGHTS.
use sixfold_align::outline::outline_mesh;
use sixfold_bop::{BopDataset, Models, VISIBILITY_DELTA, ground_truth_visibility};
use sixfold_estimator::PoseRefiner;
use sixfold_pix2pose::estimate::{EstimateError, Pix2PoseOptions, estimate};
use sixfold_pix2pose::model::Pix2PoseModel;
use sixfold_pix2pose::refine::{OutlineRefinementOptions, refine};
use sixfold_views::ViewsRefiner;
use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let dataset = BopDataset::open(Path::new(&arguments[0]), "test")?;
    let targets = dataset.targets(Some(Path::new(&arguments[1])))?;
    let model = Pix2PoseModel::load(Path::new(&arguments[2]))?;
    let refiner = ViewsRefiner::shipped()?;
    let mut meshes = BTreeMap::new();
    for object in model.objects() {
        let mesh = dataset.model(object.id, Models::Rendering)?;
        let small = outline_mesh(&mesh);
        let refined = refiner.object(&mesh);
        meshes.insert(object.id, (mesh, small, refined));
    }
    let side = model.sizes().input;
    let crops: Vec<f32> = (0..4 * 3 * side * side).map(|i| (i % 251) as f32 / 251.0).collect();
    for count in [1, 2, 3, 4] {
        let batch = &crops[..count * 3 * side * side];
        let time = |_| {
            let began = Instant::now();
            std::hint::black_box(model.predict(0, batch));
            began.elapsed().as_secs_f64()
        };
        let mut times: Vec<f64> = (0..30).map(time).collect();
        times.sort_by(f64::total_cmp);
        println!("network, {count} crops: {:.1} ms", 1e3 * times[15]);
    }
    let names = ["one stage", "two stages", "alignment, mesh", "alignment, simplified", "refiner"];
    let mut times = [const { Vec::new() }; 5];
    for target in &targets {
        let scene = dataset.scene(target.scene_id)?;
        let frame = scene.image(target.im_id)?;
        let camera = scene.camera(target.im_id)?;
        let Some(image) = scene.rgb(target.im_id)? else { continue };
        let known = |id: u32| meshes.get(&id).map(|m: &(_, _, _)| &m.0);
        let placed: Vec<_> = frame
            .ground_truth
            .iter()
            .filter_map(|g| Some((known(g.obj_id)?, g.camera_from_object)))
            .collect();
        let visible = ground_truth_visibility(&placed, &camera, None, VISIBILITY_DELTA);
        for (truth, visible) in frame.ground_truth.iter().zip(visible) {
            let asked = target.object.is_some_and(|o| o.obj_id == truth.obj_id);
            let (true, Some(region)) = (asked, visible.info.bbox_visib) else {
                continue;
            };
            let (mesh, small, refined) = &meshes[&truth.obj_id];
            let mut clock =
                |part: usize, began: Instant| times[part].push(1e3 * began.elapsed().as_secs_f64());
            let began = Instant::now();
            let one = Pix2PoseOptions { two_stages: false, ..Pix2PoseOptions::default() };
            match estimate(&model, &image, &camera, truth.obj_id, &region, &one) {
                // A sliver at the border of the image.
                Err(EstimateError::Box(_)) => continue,
                found => found?,
            };
            clock(0, began);
            let began = Instant::now();
            let found =
                estimate(&model, &image, &camera, truth.obj_id, &region, &Pix2PoseOptions::default())?;
            clock(1, began);
            let Some(found) = found else { continue };
            for (part, mesh) in [(2, mesh), (3, small)] {
                let began = Instant::now();
                refine(&image, &camera, mesh, &found, &OutlineRefinementOptions::default());
                clock(part, began);
            }
            let Some(best) = found.hypotheses.first() else { continue };
            let began = Instant::now();
            refined.refine(&image, &camera, &best.camera_from_object)?;
            clock(4, began);
        }
    }
    for (name, times) in names.iter().zip(&mut times) {
        times.sort_by(f64::total_cmp);
        let mean = times.iter().sum::<f64>() / times.len() as f64;
        println!(
            "{name}: {} boxes, median {:.1} ms, mean {mean:.1} ms, slowest {:.1} ms",
            times.len(),
            times[times.len() / 2],
            times[times.len() - 1]
        );
    }
    Ok(())
}
