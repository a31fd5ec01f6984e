//! A method of your own, run on a dataset and scored: `cargo run -p sixfold --example own_method`.
//!
//! The toy method puts the centre of the mesh at the median of the depth points in a region, and never rotates it.

use std::sync::atomic::AtomicBool;

use sixfold::bop::{evaluate, read_results};
use sixfold::estimator::{EstimatorError, Need, Needs, downcast};
use sixfold::geometry::stats::median;
use sixfold::prelude::*;
use sixfold::runner::{DatasetRun, RegionSource, RunOptions};

const METHOD: &str = "median";

/// The data derived once from an object.
struct Centre {
    name: String,
    centre: Vec3,
}

impl PreparedObject for Centre {
    fn name(&self) -> &str {
        &self.name
    }

    fn mesh(&self) -> Option<&Mesh> {
        None
    }
}

struct Median;

impl PoseEstimator for Median {
    fn name(&self) -> &'static str {
        METHOD
    }

    fn needs(&self) -> Needs {
        Needs { depth: Need::Required, region: Need::Required, object: Need::Required, rgb: Need::Unused }
    }

    fn prepare(&self, object: &Object) -> Result<Box<dyn PreparedObject>, EstimatorError> {
        let (low, high) = object.needed_mesh(METHOD)?.bounding_box();
        Ok(Box::new(Centre { name: object.name.clone(), centre: (low + high) / 2.0 }))
    }

    fn estimate(
        &self,
        object: &dyn PreparedObject,
        query: &Query<'_>,
    ) -> Result<Vec<PoseEstimate>, EstimatorError> {
        let object: &Centre = downcast(object, METHOD)?;
        let points = &query.depth_region(METHOD)?.cloud().points;
        let median_of = |k: usize| median(&mut points.iter().map(|p| p[k]).collect::<Vec<f64>>());
        let [Some(x), Some(y), Some(z)] = [0, 1, 2].map(median_of) else { return Ok(vec![]) };
        let pose = Pose::from_translation(Vec3::new(x, y, z) - object.centre);
        Ok(vec![PoseEstimate::new(pose, 1.0)])
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let dataset = BopDataset::open(concat!(env!("CARGO_MANIFEST_DIR"), "/../../data/demo").as_ref(), "test")?;
    let targets = dataset.object_targets(&dataset.targets(None)?)?;
    let folder = tempfile::tempdir()?;
    let results = folder.path().join("median_demo-test.csv");
    let run = DatasetRun {
        estimator: &Median,
        dataset: &dataset,
        targets: &targets,
        regions: &RegionSource::GroundTruth,
        min_confidence: None,
        cache: &Cache::none(),
        options: &RunOptions::default(),
    };
    let summary = run.run(&results, &AtomicBool::new(false), &mut |_| Ok(()))?;
    let scores = evaluate(&dataset, &read_results(&results)?, &targets, &EvalOptions::default(), &())?;
    println!("{} poses, AR {:.3}", summary.poses, scores.ar.ok_or("a score is missing")?);
    Ok(())
}
