//! BOP datasets, result files, scores, detections.
//!
//! The examples read the three frames of LM-O in the repository's folder `data/demo`.
//!
//! # Read a dataset
//!
//! ```
//! use sixfold::bop::Models;
//! use sixfold::prelude::*;
//!
//! let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../data/demo");
//! let dataset = BopDataset::open(folder.as_ref(), "test")?;
//! assert_eq!(dataset.scene_ids(), [2, 1002]);
//! let scene = dataset.scene(2)?;
//! let (camera, depth) = (scene.camera(3)?, scene.depth(3)?.expect("a depth image"));
//! assert_eq!(depth.size(), (camera.width, camera.height));
//! let first = &scene.image(3)?.ground_truth[0];
//! let mesh = dataset.model(first.obj_id, Models::Rendering)?;
//! assert!(first.camera_from_object.translation().z > mesh.diameter());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Score a result file
//!
//! With the ground truth as estimates, every score is 1.
//!
//! ```
//! use sixfold::bop::{evaluate, read_results, write_results};
//! use sixfold::prelude::*;
//!
//! let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../data/demo");
//! let dataset = BopDataset::open(folder.as_ref(), "test")?;
//! let targets = &dataset.targets(None)?[..2];
//! let mut estimates = vec![];
//! for target in targets {
//!     let (scene, object) = (dataset.scene(target.scene_id)?, target.object.expect("an object"));
//!     for truth in &scene.image(target.im_id)?.ground_truth {
//!         if truth.obj_id == object.obj_id {
//!             let pose = truth.camera_from_object;
//!             estimates.push(Estimate::new(target.scene_id, target.im_id, truth.obj_id, 1.0, pose));
//!         }
//!     }
//! }
//! let out = tempfile::tempdir()?;
//! let results = out.path().join("truth_demo-test.csv");
//! write_results(&results, &estimates)?;
//!
//! let options = EvalOptions { compute_vsd: false, ..EvalOptions::default() };
//! let scores = evaluate(&dataset, &read_results(&results)?, targets, &options, &())?;
//! assert_eq!((scores.ar_mssd, scores.ar_mspd), (Some(1.0), Some(1.0)));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Run a method on a dataset
//!
//! Runs any method and writes a result file, image by image. A stopped run can be resumed.
//!
//! ```
//! use std::sync::atomic::AtomicBool;
//!
//! use sixfold::bop::{evaluate, read_results};
//! use sixfold::prelude::*;
//! use sixfold::runner::{DatasetRun, RegionSource, RunOptions};
//!
//! let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../data/demo");
//! let dataset = BopDataset::open(folder.as_ref(), "test")?;
//! let targets = &dataset.targets(None)?[1..2]; // the watering can
//! let out = tempfile::tempdir()?;
//! let results = out.path().join("ppf_demo-test.csv");
//! let run = DatasetRun {
//!     estimator: &PpfEstimator::default(),
//!     dataset: &dataset,
//!     targets,
//!     regions: &RegionSource::GroundTruth,
//!     min_confidence: None,
//!     cache: &Cache::none(),
//!     options: &RunOptions::default(),
//! };
//! let summary = run.run(&results, &AtomicBool::new(false), &mut |_| Ok(()))?;
//! assert_eq!(summary.poses, 1);
//!
//! let options = EvalOptions { compute_vsd: false, ..EvalOptions::default() };
//! let scores = evaluate(&dataset, &read_results(&results)?, targets, &options, &())?;
//! assert!(scores.ar_mssd > Some(0.5));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Errors of a pose
//!
//! ```
//! use sixfold::bop::{ModelPoints, add, adi};
//! use sixfold::prelude::*;
//! use sixfold::synth::primitives::mug;
//!
//! let mesh = mug(0.04, 0.10, 0.004, 0.03)?;
//! let points = ModelPoints::new(mesh.vertices()).expect("finite points");
//! let truth = Pose::from_translation(Vec3::new(0.0, 0.0, 0.5));
//! let estimate = Pose::from_translation(Vec3::new(0.003, 0.0, 0.504));
//! assert!((add(&points, estimate, truth) - 0.005).abs() < 1e-9);
//! assert!(adi(&points, estimate, truth) <= 0.005);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Detections
//!
//! Boxes and masks as COCO JSON; a dataset run can use them as regions.
//!
//! ```
//! use sixfold::bop::{Detection, ReadDetections, Rle, read_detections, write_detections};
//! use sixfold::geometry::Rect;
//! use sixfold::prelude::*;
//!
//! let mask = Mask::from_fn(160, 120, |x, y| (40..80).contains(&x) && (30..50).contains(&y));
//! let [x, y, width, height] = mask.bounding_box().expect("pixels").map(|v| v as f64);
//! let detection = Detection {
//!     scene_id: 2,
//!     image_id: 3,
//!     category_id: 5,
//!     score: 0.9,
//!     bbox: Some(Rect { x, y, width, height }),
//!     segmentation: Some(Rle::encode(&mask)?),
//!     time: None,
//! };
//! let folder = tempfile::tempdir()?;
//! let file = folder.path().join("detections.json");
//! write_detections(&file, &[detection])?;
//! let read = read_detections(&file, &ReadDetections::default())?.detections;
//! assert_eq!(read[0].segmentation.as_ref().map(Rle::decode), Some(mask));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
