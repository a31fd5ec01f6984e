//! Poses from depth, verification, your own method.
//!
//! # A pose from depth, without training
//!
//! Every method is a [`PoseEstimator`](crate::estimator::PoseEstimator): it prepares an object once and answers queries.
//!
//! ```
//! use sixfold::align::DepthOptions;
//! use sixfold::mesh::ModelInfo;
//! use sixfold::prelude::*;
//! use sixfold::render::render_depth;
//! use sixfold::synth::primitives::mug;
//!
//! let camera = Camera::new(300.0, 300.0, 79.5, 59.5, 160, 120)?;
//! let mesh = mug(0.04, 0.10, 0.004, 0.03)?;
//! let truth = Pose::exp(&[0.0, 0.0, 0.0, 1.9, 0.3, 0.4].into()).with_translation(Vec3::new(0.02, 0.0, 0.5));
//! let depth = render_depth(&mesh, &truth, &camera); // stands for an image of a depth camera
//!
//! // There is no table in this image: its largest plane is kept.
//! let depth_options = DepthOptions { remove_plane: false, ..DepthOptions::default() };
//! let method = PpfEstimator { depth: depth_options, ..PpfEstimator::default() };
//! let info = ModelInfo::of_mesh(&mesh);
//! let diameter = info.diameter;
//! let object = method.prepare(&Object::of_mesh("mug", mesh, info))?;
//! let prepared = PreparedDepth::new(&depth, &camera, &method.depth_options())?;
//! let query = Query { depth: Some(&prepared), ..Query::new(&camera) };
//! let found = method.estimate(object.as_ref(), &query)?;
//! let best = &found[0];
//! assert!(best.camera_from_object.distance_to(&truth) < 0.1 * diameter);
//! assert!(best.camera_from_object.rotation_angle_to(&truth) < 0.1);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Search in a region only
//!
//! The region can be a box from a person or a detector, or a mask.
//!
//! ```
//! use sixfold::align::DepthOptions;
//! use sixfold::geometry::Rect;
//! use sixfold::mesh::ModelInfo;
//! use sixfold::prelude::*;
//! use sixfold::render::{VisibilityBuffer, RenderOptions, SceneObject};
//! use sixfold::runner::{ImageRun, pose_table};
//! use sixfold::synth::primitives::mug;
//!
//! let camera = Camera::new(300.0, 300.0, 79.5, 59.5, 160, 120)?;
//! let mesh = mug(0.035, 0.08, 0.004, 0.025)?;
//! let at = |x: f64| Pose::exp(&[0.0, 0.0, 0.0, 1.9, 0.3, 0.4].into()).with_translation(Vec3::new(x, 0.0, 0.5));
//! let two = [-0.06, 0.06].map(|x| SceneObject { mesh: &mesh, camera_from_object: at(x) });
//! let mut frame = VisibilityBuffer::new(&camera);
//! frame.render(&two, &RenderOptions::default());
//!
//! // There is no table in this image: its largest plane is kept.
//! let depth_options = DepthOptions { remove_plane: false, ..DepthOptions::default() };
//! let method = PpfEstimator { depth: depth_options, ..PpfEstimator::default() };
//! let prepared = PreparedDepth::new(&frame.depth(), &camera, &method.depth_options())?;
//! let left = Region::of_box(Rect { x: 0.0, y: 0.0, width: 75.0, height: 120.0 });
//! let query = Query { depth: Some(&prepared), region: Some(&left), ..Query::new(&camera) };
//! let run = ImageRun { estimator: &method, query };
//! let found = run.find(&Object::of_mesh("mug", mesh.clone(), ModelInfo::of_mesh(&mesh)))?;
//! assert!(found.estimates[0].camera_from_object.translation().x < 0.0);
//! assert!(pose_table(&run.report(&[found])).contains("mug"));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Verify a pose by rendering
//!
//! ```
//! use sixfold::align::{VerificationOptions, Verifier};
//! use sixfold::prelude::*;
//! use sixfold::render::render_depth;
//! use sixfold::synth::primitives::mug;
//!
//! let camera = Camera::new(300.0, 300.0, 79.5, 59.5, 160, 120)?;
//! let mesh = mug(0.04, 0.10, 0.004, 0.03)?;
//! let truth = Pose::exp(&[0.0, 0.0, 0.0, 1.9, 0.3, 0.4].into()).with_translation(Vec3::new(0.02, 0.0, 0.5));
//! let depth = render_depth(&mesh, &truth, &camera);
//! let image = PreparedDepth::new(&depth, &camera, &PpfEstimator::default().depth_options())?;
//! let options = VerificationOptions::default();
//! let threshold = options.threshold_for(mesh.diameter());
//! let mut verifier = Verifier::default();
//! let good = verifier.score(&image, &mesh, &truth, threshold, &options);
//! let shifted = truth.with_translation(truth.translation() + Vec3::new(0.03, 0.0, 0.0));
//! let bad = verifier.score(&image, &mesh, &shifted, threshold, &options);
//! assert!(good.total > bad.total);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # A method of your own
//!
//! It needs two main functions. `examples/own_method.rs` runs one on a dataset and scores it.
//!
//! ```
//! use sixfold::estimator::{EstimatorError, Need, Needs};
//! use sixfold::mesh::ModelInfo;
//! use sixfold::prelude::*;
//!
//! struct Known(String);
//! impl PreparedObject for Known {
//!     fn name(&self) -> &str { &self.0 }
//!     fn mesh(&self) -> Option<&Mesh> { None }
//! }
//!
//! /// Always a metre in front of the camera.
//! struct OneMetre;
//! impl PoseEstimator for OneMetre {
//!     fn name(&self) -> &'static str { "one-metre" }
//!     fn needs(&self) -> Needs { Needs { object: Need::Required, ..Needs::default() } }
//!     fn prepare(&self, object: &Object) -> Result<Box<dyn PreparedObject>, EstimatorError> {
//!         Ok(Box::new(Known(object.name.clone())))
//!     }
//!     fn estimate(&self, _: &dyn PreparedObject, _: &Query<'_>) -> Result<Vec<PoseEstimate>, EstimatorError> {
//!         Ok(vec![PoseEstimate::new(Pose::from_translation(Vec3::z()), 1.0)])
//!     }
//! }
//!
//! let camera = Camera::new(300.0, 300.0, 79.5, 59.5, 160, 120)?;
//! let mesh = sixfold::synth::primitives::cup(0.04, 0.10, 0.004)?;
//! let object = OneMetre.prepare(&Object::of_mesh("cup", mesh.clone(), ModelInfo::of_mesh(&mesh)))?;
//! let found = OneMetre.estimate(object.as_ref(), &Query::new(&camera))?;
//! assert_eq!(found[0].camera_from_object.translation().z, 1.0);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
