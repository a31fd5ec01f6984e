//! Pix2Pose, the detector, template matching, views by NOL.
//!
//! `sixfold train` makes the weight files of Pix2Pose and the detector; the repository's `weights/` contains those for LM-O.
//!
//! # Template matching: objects never trained on
//!
//! Templates are cropped from depth images here; [`from_mesh`](crate::mttm::ObjectTemplates::from_mesh) renders them.
//!
//! ```
//! use sixfold::mttm::{DepthView, ObjectTemplates, TemplateOptions};
//! use sixfold::prelude::*;
//! use sixfold::render::render_depth;
//! use sixfold::synth::primitives::mug;
//!
//! let camera = Camera::new(300.0, 300.0, 79.5, 59.5, 160, 120)?;
//! let mesh = mug(0.04, 0.10, 0.004, 0.03)?;
//! let poses: Vec<Pose> =
//!     (0..6).map(|k| Pose::exp(&[0.0, 0.0, 0.0, 2.0, 0.0, 0.5 * f64::from(k)].into()).with_translation(Vec3::new(0.0, 0.0, 0.5))).collect();
//! let depths: Vec<DepthImage> = poses.iter().map(|pose| render_depth(&mesh, pose, &camera)).collect();
//! let masks: Vec<Mask> = depths.iter().map(|depth| depth.map(|z| *z > 0.0)).collect();
//! let views: Vec<DepthView<'_>> = (0..6)
//!     .map(|k| DepthView {
//!         depth: &depths[k],
//!         camera: &camera,
//!         mask: &masks[k],
//!         camera_from_object: Some(poses[k]),
//!     })
//!     .collect();
//! let templates = ObjectTemplates::from_depth(&views, &TemplateOptions::default())?;
//! assert_eq!(templates.templates.len(), 6);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! The estimator renders the templates of a mesh itself.
//!
//! ```no_run
//! use std::sync::Arc;
//!
//! use sixfold::mesh::{ModelInfo, read_mesh};
//! use sixfold::mttm::MttmEstimator;
//! use sixfold::mttm::model::MttmModel;
//! use sixfold::prelude::*;
//!
//! # fn example(depth: &DepthImage, camera: &Camera) -> Result<(), Box<dyn std::error::Error>> {
//! let network = MttmModel::shipped()?;
//! let method = MttmEstimator { network: Some(Arc::new(network)), ..MttmEstimator::default() };
//! let mesh = read_mesh("mug.ply", Unit::Millimetre)?;
//! let info = ModelInfo::of_mesh(&mesh);
//! let object = method.prepare(&Object::of_mesh("mug", mesh, info))?;
//! let prepared = PreparedDepth::new(depth, camera, &method.depth_options())?;
//! let query = Query { depth: Some(&prepared), ..Query::new(camera) };
//! let found = method.estimate(object.as_ref(), &query)?;
//! # Ok(())
//! # }
//! ```
//!
//! # Pix2Pose: a pose from colour in a box
//!
//! ```no_run
//! use sixfold::geometry::Rect;
//! use sixfold::pix2pose::estimator::Pix2PoseEstimator;
//! use sixfold::prelude::*;
//!
//! # fn example(rgb: &RgbImage, camera: &Camera) -> Result<(), Box<dyn std::error::Error>> {
//! let method = Pix2PoseEstimator::load("weights/pix2pose-lmo.safetensors".as_ref())?;
//! let object = method.prepare(&Object::of_model(Some(5)))?;
//! let region = Region::of_box(Rect { x: 190.0, y: 120.0, width: 110.0, height: 90.0 });
//! let query = Query { rgb: Some(rgb), region: Some(&region), ..Query::new(camera) };
//! for found in method.estimate(object.as_ref(), &query)? {
//!     assert!(found.confidence > 0.0);
//! }
//! # Ok(())
//! # }
//! ```
//!
//! # Detect objects in a colour image
//!
//! ```no_run
//! use sixfold::detect::detector::TrainedDetector;
//! use sixfold::estimator::ObjectDetector;
//! use sixfold::io::read_rgb;
//!
//! let detector = TrainedDetector::load("weights/detector-lmo.safetensors".as_ref())?;
//! let image = read_rgb("data/demo/test/000002/rgb/000003.png".as_ref())?;
//! for found in detector.detect(&image)? {
//!     let b = found.region.bbox;
//!     assert!(b.width > 0.0 && found.region.score <= 1.0);
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # New views of an object from posed images
//!
//! ```
//! use std::sync::Arc;
//!
//! use sixfold::data::PosedImage;
//! use sixfold::nol::SourceView;
//! use sixfold::nol::synthesis::{ViewMaker, Weighting};
//! use sixfold::prelude::*;
//! use sixfold::synth::primitives::mug;
//!
//! let camera = Camera::new(300.0, 300.0, 79.5, 59.5, 160, 120)?;
//! let mesh = mug(0.04, 0.10, 0.004, 0.03)?;
//! let pose = |angle: f64| Pose::exp(&[0.0, 0.0, 0.0, 2.0, 0.0, angle].into()).with_translation(Vec3::new(0.0, 0.0, 0.5));
//! let image = Arc::new(RgbImage::filled(160, 120, [200, 40, 40])); // stands for a photograph
//! let posed = PosedImage::new("photograph", 1, image, camera, pose(0.0))?;
//! let sources = vec![SourceView::new(&posed, &mesh, 64)?];
//! let maker = ViewMaker::new(&mesh, sources, Weighting::Best, 1)?;
//! let view = maker.render(&camera, &pose(0.3));
//! assert!(view.unseen_fraction() < 1.0);
//! let (width, height) = view.mask.size();
//! assert_eq!((width, height), (160, 120));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
