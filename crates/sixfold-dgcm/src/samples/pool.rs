//! A pool of simulated views, generated once before the training (dissertation, section 6.2.2: 166,000 images on disk; here some
//! thousands in memory, combined into new pairs).

use std::sync::Arc;

use rand::{Rng, RngExt};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sixfold_geometry::nalgebra::{UnitQuaternion, Vector3};
use sixfold_geometry::random::stream;
use sixfold_geometry::{Camera, Mask, Mat3, Pose, Progress, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{DepthSensor, RenderOptions, SceneObject, VisibilityBuffer, simulate_depth};

use sixfold_experience::{Crop, CropOptions, Extent};
use sixfold_synth::shapes::{Family, Rest, member};

/// How views are made.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GraspPoolOptions {
    /// Views in the pool.
    pub views: usize,
    /// Views of each member of a family.
    pub views_per_member: usize,
    /// Smallest and largest distance from camera to object, metres (table 6.1: 1 to 1.7 m; ours includes smaller ones).
    pub distance: (f64, f64),
    /// Smallest and largest elevation of the camera above the table, radians.
    pub elevation: (f64, f64),
    /// Largest rotation of the image, radians: slightly more than half the step of the in-plane copies.
    pub roll: f64,
    /// The lowest part of the object up to this height above the table is not in the mask, metres: it is removed together with the
    /// table.
    pub lost_above_table: f64,
    /// Options of the crops.
    pub crop: CropOptions,
    /// Seed of everything.
    pub seed: u64,
}

impl Default for GraspPoolOptions {
    fn default() -> Self {
        GraspPoolOptions {
            views: 6000,
            views_per_member: 4,
            distance: (0.6, 1.3),
            elevation: (20f64.to_radians(), 75f64.to_radians()),
            roll: 25f64.to_radians(),
            lost_above_table: 0.01,
            crop: CropOptions::compact(),
            seed: 0,
        }
    }
}

/// A pixel of a view.
#[derive(Debug, Clone, Copy)]
pub(super) struct SeenPixel {
    /// Its index in the crop, row by row.
    pub index: u16,
    /// The visible face.
    pub face: u16,
    /// Barycentric weights of the face's first two vertices, in 255ths.
    pub weights: [u8; 2],
    /// The normal, in 127ths.
    pub normal: [i8; 3],
    /// VD-NOC, in 127ths.
    pub vd_noc: [i8; 3],
}

/// One view of one member.
#[derive(Debug, Clone)]
pub struct View {
    /// The member's family.
    pub family: Family,
    /// Its resting pose.
    pub rest: Rest,
    /// The extent of the visible points.
    pub extent: Extent,
    mesh: Arc<Mesh>,
    camera_from_object: Pose,
    pub(super) pixels: Vec<SeenPixel>,
    /// A bit for every vertex: whether it belongs to a visible face.
    visible: Vec<u64>,
}

impl View {
    /// Overlap of the visible vertices of two views, 0 to 1 (Dice's coefficient).
    pub fn shared(&self, other: &View) -> f64 {
        let count = |bits: &[u64]| bits.iter().map(|b| b.count_ones()).sum::<u32>();
        let common: u32 = self.visible.iter().zip(&other.visible).map(|(a, b)| (a & b).count_ones()).sum();
        2.0 * f64::from(common) / f64::from((count(&self.visible) + count(&other.visible)).max(1))
    }

    /// The VD-NOC in this view of the point of its object that corresponds to a pixel of a view of the same family.
    pub(super) fn counterpart(&self, pixel: &SeenPixel) -> Vec3 {
        let [a, b, c] = self.mesh.triangle(usize::from(pixel.face));
        let [u, v] = pixel.weights.map(|w| f64::from(w) / 255.0);
        let point = a * u + b * v + c * (1.0 - u - v);
        self.extent.normalise(&self.camera_from_object.transform_point(&point))
    }
}

/// Views, grouped by kind.
#[derive(Debug)]
pub struct Pool {
    views: Vec<View>,
    /// Numbers of the views of every family and resting pose.
    groups: Vec<Vec<usize>>,
    /// The group of every view.
    group_of: Vec<usize>,
    options: GraspPoolOptions,
}

impl Pool {
    /// Makes the views, the same for the same options at any number of threads; `progress` is called for them. `None` if it stopped
    /// the run.
    pub fn new(options: &GraspPoolOptions, progress: &dyn Progress) -> Option<Pool> {
        let members = options.views.div_ceil(options.views_per_member.max(1));
        let count = std::sync::atomic::AtomicUsize::new(0);
        let made: Option<Vec<Vec<View>>> = (0..members)
            .into_par_iter()
            .map(|number| {
                let views = views_of_member(options, number as u64);
                let before = count.fetch_add(views.len(), std::sync::atomic::Ordering::Relaxed);
                progress.report(before + views.len(), options.views).then_some(views)
            })
            .collect();
        let views: Vec<View> = made?.into_iter().flatten().take(options.views).collect();
        let mut kinds: Vec<(Family, Rest)> = vec![];
        let mut groups: Vec<Vec<usize>> = vec![];
        let mut group_of = vec![];
        for (i, view) in views.iter().enumerate() {
            let kind = (view.family, view.rest);
            let group = kinds.iter().position(|k| *k == kind).unwrap_or_else(|| {
                kinds.push(kind);
                groups.push(vec![]);
                kinds.len() - 1
            });
            groups[group].push(i);
            group_of.push(group);
        }
        Some(Pool { views, groups, group_of, options: *options })
    }

    /// All views.
    pub fn views(&self) -> &[View] {
        &self.views
    }

    /// The options with which they were made.
    pub fn options(&self) -> &GraspPoolOptions {
        &self.options
    }

    /// The other views of the same family and resting pose.
    pub(super) fn group(&self, view: usize) -> &[usize] {
        &self.groups[self.group_of[view]]
    }
}

fn views_of_member(options: &GraspPoolOptions, number: u64) -> Vec<View> {
    let mut random = stream(options.seed, number);
    let family = Family::ALL[(number % Family::ALL.len() as u64) as usize];
    let rests = family.rests();
    let rest = rests[random.random_range(0..rests.len())];
    let Ok(member) = member(family, &mut random) else { return vec![] };
    let mesh = Arc::new(member.mesh);
    // A few more trials than views: an object may be seen edge-on.
    let mut views = vec![];
    for _ in 0..3 * options.views_per_member {
        if views.len() == options.views_per_member {
            break;
        }
        views.extend(view(family, rest, &mesh, options, &mut random));
    }
    views
}

/// One randomly sampled view; `None` when too little is visible.
fn view(
    family: Family,
    rest: Rest,
    mesh: &Arc<Mesh>,
    options: &GraspPoolOptions,
    random: &mut impl Rng,
) -> Option<View> {
    let mut draw = |low: f64, high: f64| low + (high - low) * random.random::<f64>();
    let yaw_range = family.yaw_range(rest);
    let yaw = draw(-yaw_range, yaw_range);
    let elevation = draw(options.elevation.0, options.elevation.1);
    let distance = draw(options.distance.0, options.distance.1);
    let roll = draw(-options.roll, options.roll);
    let aside = Vec3::new(draw(-0.05, 0.05), draw(-0.05, 0.05), 0.0);
    let lost = draw(0.0, options.lost_above_table);
    let noise: u64 = random.random();

    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
    let mut world_from_object = Pose::new(turn, Vec3::zeros()) * rest.rotation();
    let (low, high) = mesh.transformed(&world_from_object).bounding_box();
    let box_centre = (low + high) * 0.5;
    world_from_object = world_from_object
        .with_translation(world_from_object.translation() - Vec3::new(box_centre.x, box_centre.y, low.z));
    let target = aside + Vec3::z() * (0.5 * (high.z - low.z));
    let camera_from_world = camera_from_world(elevation, distance, roll, &target);
    let camera_from_object = camera_from_world * world_from_object;

    // Only the part of the image around the object is rendered.
    const FOCAL: f64 = 575.0;
    let side = ((options.crop.size + 0.14) * FOCAL / distance).ceil() as usize;
    let centre = 0.5 * (side as f64 - 1.0);
    let camera = Camera::new(FOCAL, FOCAL, centre, centre, side, side).ok()?;
    let objects = [SceneObject { mesh, camera_from_object }];
    let mut frame = VisibilityBuffer::new(&camera);
    frame.render(&objects, &RenderOptions { parallel: false, ..RenderOptions::default() });
    let surfaces = frame.surfaces(&objects);
    let ideal = frame.depth();
    let depth = simulate_depth(&ideal, &frame.normals(&objects), &DepthSensor::kinect(), noise);
    let world_from_camera = camera_from_world.inverse();
    let mask = Mask::from_fn(side, side, |x, y| {
        let z = f64::from(depth[(x, y)]);
        let pixel = sixfold_geometry::Vec2::new(x as f64, y as f64);
        z > 0.0
            && surfaces[(x, y)].is_some()
            && world_from_camera.transform_point(&camera.unproject(&pixel, z)).z > lost
    });
    let crop = Crop::new(&depth, &camera, &mask, &options.crop).ok()?;
    let mut visible = vec![0u64; mesh.vertices().len().div_ceil(64)];
    for surface in surfaces.as_slice().iter().flatten() {
        for v in mesh.faces()[surface.face as usize] {
            visible[v as usize / 64] |= 1 << (v % 64);
        }
    }
    let byte = |v: f32| (v.clamp(-1.0, 1.0) * 127.0).round() as i8;
    let pixels: Vec<SeenPixel> = crop
        .pixels()
        .filter_map(|i| {
            let surface = surfaces.as_slice()[crop.source[i] as usize]?;
            Some(SeenPixel {
                index: i as u16,
                face: surface.face as u16,
                weights: [0, 1].map(|k| (surface.barycentric[k].clamp(0.0, 1.0) * 255.0).round() as u8),
                normal: crop.normals[i].map(byte),
                vd_noc: crop.vd_noc[i].map(byte),
            })
        })
        .collect();
    (pixels.len() >= 4 * options.crop.min_pixels).then(|| View {
        family,
        rest,
        extent: crop.extent,
        mesh: mesh.clone(),
        camera_from_object,
        pixels,
        visible,
    })
}

/// A camera on the side of the negative y axis, aimed at `target`, its image rotated by `roll`.
fn camera_from_world(elevation: f64, distance: f64, roll: f64, target: &Vec3) -> Pose {
    let back = Vec3::new(0.0, -elevation.cos(), elevation.sin());
    let (right, z) = (Vec3::x(), -back);
    let down = z.cross(&right);
    let world_from_camera =
        Pose::from_parts(&Mat3::from_columns(&[right, down, z]), target + back * distance)
            .unwrap_or_else(|_| Pose::identity());
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), roll);
    Pose::new(turn, Vec3::zeros()) * world_from_camera.inverse()
}
