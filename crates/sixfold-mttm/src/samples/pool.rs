//! All regions from which a training samples, cut out of simulated scenes once (dissertation, section 5.3.1: about 20,000 scenes).

use std::sync::atomic::{AtomicUsize, Ordering};

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sixfold_align::{DepthOptions, DepthRegion};
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::random::stream;
use sixfold_geometry::{Camera, DepthImage, Mat3, Pose, Progress, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{DepthSensor, RenderOptions, SceneObject, VisibilityBuffer, simulate_depth};

use super::anchor::{Anchor, AnchorOptions, anchor, without_object};

/// Objects on the table z = 0: numbers of meshes with their poses (world from object).
pub(crate) type Arrangement = Vec<(usize, Pose)>;

/// How scenes are rendered.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DepthPoolOptions {
    /// Cameras per arrangement.
    pub views: usize,
    /// Smallest and largest distance of the camera, metres.
    pub distance: (f64, f64),
    /// Smallest and largest elevation of the camera above the table, radians.
    pub elevation: (f64, f64),
    /// Largest rotation of the image, radians.
    pub roll: f64,
    /// Smallest visible fraction of an object; others are left out (dissertation: half).
    pub visible: f64,
    /// Whether a tenth of the views has no noise of a sensor.
    pub some_without_noise: bool,
    /// Regions without an object from each view.
    pub without_object: usize,
    /// How regions are cut out.
    pub anchors: AnchorOptions,
    /// Seed of everything.
    pub seed: u64,
}

impl DepthPoolOptions {
    /// For patches of `side` pixels.
    pub fn for_side(side: usize) -> Self {
        DepthPoolOptions {
            views: 5,
            distance: (0.55, 1.3),
            elevation: (20f64.to_radians(), 80f64.to_radians()),
            roll: 20f64.to_radians(),
            visible: 0.35,
            some_without_noise: true,
            without_object: 4,
            anchors: AnchorOptions::for_side(side),
            seed: 0,
        }
    }
}

/// Regions with their templates.
#[derive(Debug, Clone)]
pub struct Pool {
    options: DepthPoolOptions,
    with_object: Vec<Anchor>,
    without: Vec<Anchor>,
}

impl Pool {
    /// Renders every arrangement from all of its cameras and cuts the regions out. The same input gives the same pool at any number
    /// of threads; `progress` receives every arrangement. `None` when it was stopped.
    ///
    /// # Panics
    /// If an arrangement has a number beyond the meshes.
    pub fn new(
        meshes: &[Mesh],
        arrangements: &[Arrangement],
        options: &DepthPoolOptions,
        progress: &dyn Progress,
    ) -> Option<Pool> {
        let done = AtomicUsize::new(0);
        let per_arrangement: Option<Vec<Vec<Anchor>>> = arrangements
            .par_iter()
            .enumerate()
            .map(|(number, arrangement)| {
                let anchors: Vec<Anchor> = (0..options.views as u64)
                    .flat_map(|view| {
                        let mut random = stream(options.seed, number as u64 * 1000 + view);
                        see(meshes, arrangement, options, &mut random)
                    })
                    .collect();
                let done = done.fetch_add(1, Ordering::Relaxed) + 1;
                progress.report(done, arrangements.len()).then_some(anchors)
            })
            .collect();
        let (with_object, without) = per_arrangement?.into_iter().flatten().partition(|a| a.object.is_some());
        Some(Pool { options: *options, with_object, without })
    }

    /// Its options.
    pub fn options(&self) -> &DepthPoolOptions {
        &self.options
    }

    /// Regions with an object.
    pub(crate) fn with_object(&self) -> &[Anchor] {
        &self.with_object
    }

    /// Regions without one.
    pub fn without_object(&self) -> &[Anchor] {
        &self.without
    }
}

/// One view of an arrangement.
fn see(
    meshes: &[Mesh],
    arrangement: &Arrangement,
    options: &DepthPoolOptions,
    random: &mut ChaCha8Rng,
) -> Vec<Anchor> {
    let Ok(camera) = Camera::new(575.0, 575.0, 319.5, 239.5, 640, 480) else { return vec![] };
    let mut between = |low: f64, high: f64| low + (high - low) * random.random::<f64>();
    let camera_from_world = look_at(
        between(0.0, std::f64::consts::TAU),
        between(options.elevation.0, options.elevation.1),
        between(options.distance.0, options.distance.1),
        between(-options.roll, options.roll),
        &Vec3::new(between(-0.1, 0.1), between(-0.1, 0.1), 0.03),
    );
    let sensor = match random.random_range(0..10u32) {
        0..2 => Some(DepthSensor::kinect()),
        2..7 => Some(DepthSensor::xtion()),
        9 if options.some_without_noise => None,
        _ => Some(DepthSensor::realsense()),
    };
    let table_size = 0.5 + 1.5 * random.random::<f64>();
    let Some(table) = table(table_size) else { return vec![] };
    let noise_seed = random.random();
    let mut objects: Vec<SceneObject<'_>> = arrangement
        .iter()
        .map(|(mesh, pose)| SceneObject {
            mesh: &meshes[*mesh],
            camera_from_object: camera_from_world * *pose,
        })
        .collect();
    objects.push(SceneObject { mesh: &table, camera_from_object: camera_from_world });
    let mut frame = VisibilityBuffer::new(&camera);
    frame.render(&objects, &RenderOptions::default());
    let ideal = frame.depth();
    let depth: DepthImage = match &sensor {
        Some(sensor) => simulate_depth(&ideal, &frame.normals(&objects), sensor, noise_seed),
        None => ideal,
    };
    let prepared = DepthOptions { remove_plane: false, ..DepthOptions::default() };
    let Ok(scene) = DepthRegion::from_depth(&depth, &camera, None, &prepared) else { return vec![] };
    let masks: Vec<_> = (0..arrangement.len()).map(|k| frame.mask(k)).collect();
    let mut anchors = vec![];
    for (k, (number, pose)) in arrangement.iter().enumerate() {
        let seen = masks[k].as_slice().iter().filter(|m| **m).count();
        frame.render(&objects[k..=k], &RenderOptions::default());
        let whole = frame.inverse_depth().iter().filter(|z| **z > 0.0).count();
        if seen < 150 || (seen as f64) < options.visible * whole as f64 {
            continue;
        }
        let camera_from_object = camera_from_world * *pose;
        let mesh = (*number, &meshes[*number]);
        anchors.extend(anchor(&scene, mesh, &camera_from_object, &masks[k], &options.anchors, random));
    }
    // Regions elsewhere: on the table, at edges of objects, between objects.
    for _ in 0..options.without_object {
        let pixel = random.random_range(0..scene.depth().as_slice().len());
        let z = f64::from(scene.depth().as_slice()[pixel]);
        let diameter = 0.08 + 0.17 * random.random::<f64>();
        let (x, y) = ((pixel % camera.width) as f64, (pixel / camera.width) as f64);
        let point = camera.unproject(&sixfold_geometry::Vec2::new(x, y), z);
        let far_from_all = objects[..arrangement.len()]
            .iter()
            .all(|o| (o.camera_from_object.translation() - point).norm() > 0.5 * diameter);
        if z > 0.0 && far_from_all {
            anchors.push(without_object(&scene, &point, diameter, &options.anchors));
        }
    }
    anchors
}

/// A square of the plane z = 0.
fn table(size: f64) -> Option<Mesh> {
    let half = 0.5 * size;
    let corners = [(-half, -half), (half, -half), (half, half), (-half, half)];
    let corners = corners.map(|(x, y)| Vec3::new(x, y, 0.0)).to_vec();
    Mesh::new(corners, vec![[0, 1, 2], [0, 2, 3]]).ok()
}

/// Camera from world of a camera aimed at `target`, its image rotated by `roll`.
fn look_at(azimuth: f64, elevation: f64, distance: f64, roll: f64, target: &Vec3) -> Pose {
    let back = Vec3::new(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin());
    let right = Vec3::new(-azimuth.sin(), azimuth.cos(), 0.0);
    let z = -back;
    let down = z.cross(&right);
    // Orthonormal by construction.
    let world_from_camera =
        Pose::from_parts(&Mat3::from_columns(&[right, down, z]), target + back * distance)
            .unwrap_or_else(|_| Pose::identity());
    let turn = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), roll);
    Pose::new(turn, Vec3::zeros()) * world_from_camera.inverse()
}
