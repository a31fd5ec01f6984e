//! Refines the poses of a result file in the colour images of a dataset: DATASET RESULTS.csv OUT.csv
//!
//! Scores are kept, so that `sixfold eval` compares both files.
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::Path;
use std::sync::Arc;

use sixfold_bop::{BopDataset, Models, read_results, write_results};
use sixfold_estimator::{PoseRefiner, RefinedObject};
use sixfold_views::ViewsRefiner;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [dataset, results, out] = &arguments[..] else { return Err("DATASET RESULTS.csv OUT.csv".into()) };
    let dataset = BopDataset::open(Path::new(dataset), "test")?;
    let refiner = ViewsRefiner::shipped()?;
    let mut estimates = read_results(Path::new(results))?;
    let mut objects: BTreeMap<u32, Arc<dyn RefinedObject>> = BTreeMap::new();
    for e in &mut estimates {
        let object = match objects.entry(e.obj_id) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(free) => free.insert(refiner.object(&dataset.model(e.obj_id, Models::Rendering)?)),
        };
        let scene = dataset.scene(e.scene_id)?;
        let Some(image) = scene.rgb(e.im_id)? else { continue };
        let refined = object.refine(&image, &scene.camera(e.im_id)?, &e.camera_from_object)?;
        if let Some(refined) = refined {
            e.camera_from_object = refined.camera_from_object;
            e.rotation_as_written = None;
        }
    }
    Ok(write_results(Path::new(out), &estimates)?)
}
