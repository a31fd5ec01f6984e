//! Times MSSD + MSPD + ADD over the targets of a dataset, one estimate each, as `benches/metrics_vs_bop_toolkit.py`
//! does with the official toolkit.
//!
//!     cargo run --release -p sixfold-bop --example bench_metrics -- LMO_DIR RESULTS.csv [ERRORS.csv]
//!
//! Prints JSON: milliseconds for all targets on one thread and on all, best of the repetitions, files and models
//! already read. With ERRORS.csv the errors of every target are written for comparison (metres and pixels).

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::error::Error;
use std::path::Path;
use std::time::Instant;

use rayon::prelude::*;
use sixfold_bop::{BopDataset, Estimate, ModelPoints, Models, Placement, add, mspd, mssd, read_results};
use sixfold_geometry::Camera;

struct Pair {
    im_id: u32,
    obj_id: u32,
    estimate: Placement,
    truth: Placement,
    camera: Camera,
}

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [dataset, results, rest @ ..] = &args[..] else {
        return Err("usage: bench_metrics DATASET RESULTS.csv [ERRORS.csv]".into());
    };
    let dataset = BopDataset::open(Path::new(dataset), "test")?;
    let mut best: BTreeMap<(u32, u32, u32), Estimate> = BTreeMap::new();
    for e in read_results(Path::new(results))? {
        let kept = best.entry((e.scene_id, e.im_id, e.obj_id)).or_insert(e);
        if e.score > kept.score {
            *kept = e;
        }
    }
    let info = dataset.models_info(Models::Evaluation)?.ok_or("no models_info.json")?;
    let mut models = BTreeMap::new();
    let mut pairs = Vec::new();
    for target in dataset.object_targets(&dataset.targets(None)?)? {
        let Some(object) = target.object else { continue };
        let id = object.obj_id;
        if let Entry::Vacant(new) = models.entry(id) {
            let mesh = dataset.model(id, Models::Evaluation)?;
            let points = ModelPoints::new(mesh.vertices()).ok_or("empty model")?;
            new.insert((points, info.0[&id].symmetry_poses(0.01)));
        }
        let scene = dataset.scene(target.scene_id)?;
        let camera = scene.camera(target.im_id)?;
        let image = scene.image(target.im_id)?;
        let truth = image.ground_truth.iter().find(|g| g.obj_id == id).ok_or("no ground truth")?;
        let truth = truth.placement();
        // A target without estimate is compared with its own ground truth: the work is the same.
        let estimate = best.get(&(target.scene_id, target.im_id, id)).map_or(truth, Estimate::placement);
        pairs.push(Pair { im_id: target.im_id, obj_id: id, estimate, truth, camera });
    }

    let errors = |p: &Pair| {
        let (points, symmetries) = &models[&p.obj_id];
        (
            mssd(points, p.estimate, p.truth, symmetries),
            mspd(points, p.estimate, p.truth, &p.camera, symmetries),
            add(points, p.estimate, p.truth),
        )
    };
    let (mut one, mut all) = (f64::INFINITY, f64::INFINITY);
    let mut found = Vec::new();
    for _ in 0..20 {
        let start = Instant::now();
        found = pairs.iter().map(errors).collect::<Vec<_>>();
        one = one.min(start.elapsed().as_secs_f64());
        let start = Instant::now();
        let parallel: Vec<_> = pairs.par_iter().map(errors).collect();
        all = all.min(start.elapsed().as_secs_f64());
        assert_eq!(found, parallel, "the number of threads changed an error");
    }
    if let Some(path) = rest.first() {
        let rows =
            pairs.iter().zip(&found).map(|(p, (a, b, c))| format!("{},{},{a},{b},{c}\n", p.im_id, p.obj_id));
        std::fs::write(path, rows.collect::<String>())?;
    }
    println!(
        "{{\"targets\": {}, \"one_thread_ms\": {:.3}, \"threads\": {}, \"all_threads_ms\": {:.3}}}",
        pairs.len(),
        one * 1e3,
        rayon::current_num_threads(),
        all * 1e3
    );
    Ok(())
}
