//! Poses, rendering, PnP, ICP, simulated depth cameras.
//!
//! Lengths are in metres, angles in radians. `camera_from_object` takes points of the object's frame to the camera's.
//!
//! # Render depth
//!
//! ```
//! use sixfold::prelude::*;
//! use sixfold::render::render_depth;
//! use sixfold::synth::primitives::mug;
//!
//! let camera = Camera::new(300.0, 300.0, 79.5, 59.5, 160, 120)?;
//! let mesh = mug(0.04, 0.10, 0.004, 0.03)?;
//! let camera_from_object = Pose::from_translation(Vec3::new(0.0, 0.0, 0.5));
//! let depth = render_depth(&mesh, &camera_from_object, &camera);
//! assert_eq!(depth.size(), (160, 120));
//! assert!((depth[(80, 60)] - 0.5).abs() < 1e-3); // the floor of the mug, seen from below
//! assert_eq!(depth[(0, 0)], 0.0); // nothing there
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Render several objects: masks, normals, object coordinates
//!
//! One pass fills a [`VisibilityBuffer`](crate::render::VisibilityBuffer); everything else is read from it.
//!
//! ```
//! use sixfold::prelude::*;
//! use sixfold::render::{VisibilityBuffer, RenderOptions, SceneObject};
//! use sixfold::synth::primitives::{cuboid, cylinder};
//!
//! let camera = Camera::new(300.0, 300.0, 79.5, 59.5, 160, 120)?;
//! let (can, bar) = (cylinder(0.03, 0.1)?, cuboid(Vec3::new(0.2, 0.02, 0.02))?);
//! let at = |z: f64| Pose::from_translation(Vec3::new(0.0, 0.0, z));
//! let objects = [
//!     SceneObject { mesh: &can, camera_from_object: at(0.5) },
//!     SceneObject { mesh: &bar, camera_from_object: at(0.4) },
//! ];
//! let mut frame = VisibilityBuffer::new(&camera);
//! frame.render(&objects, &RenderOptions::default());
//! let (can_mask, bar_mask) = (frame.mask(0), frame.mask(1));
//! assert!(bar_mask[(80, 60)] && !can_mask[(80, 60)]); // the bar is in front
//! assert!(can_mask[(80, 70)]);
//! assert!(frame.normals(&objects)[(80, 60)][2] < -0.99); // facing the camera
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # PnP: a pose from points and their pixels
//!
//! ```
//! use sixfold::geometry::{PnpOptions, pnp_ransac};
//! use sixfold::prelude::*;
//! use sixfold::synth::primitives::mug;
//!
//! let camera = Camera::new(300.0, 300.0, 79.5, 59.5, 160, 120)?;
//! let truth = Pose::exp(&[0.02, -0.01, 0.5, 0.3, -0.4, 0.2].into());
//! let points = mug(0.04, 0.10, 0.004, 0.03)?.sample_surface(60, 0).points;
//! let mut pixels: Vec<_> =
//!     points.iter().filter_map(|p| camera.project(&truth.transform_point(p))).collect();
//! for wrong in pixels.iter_mut().step_by(5) {
//!     wrong.x += 30.0;
//! }
//! let found = pnp_ransac(&points, &pixels, &camera, &PnpOptions::default())?;
//! assert_eq!(found.inlier_count, 48);
//! assert!(found.camera_from_object.rotation_angle_to(&truth) < 1e-6);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # ICP: a cloud aligned with a depth image
//!
//! ```
//! use sixfold::geometry::{DepthTarget, IcpOptions, NormalOptions, PointCloud, icp, normals_from_depth};
//! use sixfold::prelude::*;
//! use sixfold::render::render_depth;
//! use sixfold::synth::primitives::cuboid;
//!
//! let camera = Camera::new(300.0, 300.0, 79.5, 59.5, 160, 120)?;
//! let mesh = cuboid(Vec3::new(0.12, 0.08, 0.05))?;
//! let truth = Pose::exp(&[0.0, 0.0, 0.5, 0.5, 0.4, 0.1].into());
//! let depth = render_depth(&mesh, &truth, &camera);
//! let normals = normals_from_depth(&depth, &camera, &NormalOptions::default());
//! let target = DepthTarget { depth: &depth, normals: &normals, camera: &camera };
//!
//! let start = truth.with_translation(truth.translation() + Vec3::new(0.004, -0.003, 0.005));
//! let seen = PointCloud::from_depth(&depth, Some(&normals), &camera);
//! let source = seen.transformed(&truth.inverse()); // the visible surface in the object's frame
//! let report = icp(&source, &target, &start, &IcpOptions::coarse_to_fine(0.02))?;
//! assert!(report.target_from_source.distance_to(&truth) < 1e-3);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # A simulated depth camera
//!
//! ```
//! use sixfold::geometry::{NormalOptions, normals_from_depth};
//! use sixfold::prelude::*;
//! use sixfold::render::{DepthSensor, render_depth, simulate_depth};
//! use sixfold::synth::primitives::cuboid;
//!
//! let camera = Camera::new(300.0, 300.0, 79.5, 59.5, 160, 120)?;
//! let pose = Pose::from_translation(Vec3::new(0.0, 0.0, 0.8));
//! let ideal = render_depth(&cuboid(Vec3::repeat(0.2))?, &pose, &camera);
//! let normals = normals_from_depth(&ideal, &camera, &NormalOptions::default());
//! let measured = simulate_depth(&ideal, &normals, &DepthSensor::kinect(), 0);
//! assert_ne!(measured, ideal); // noise, steps, lost edges
//! assert!((measured[(80, 60)] - 0.7).abs() < 0.01);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
