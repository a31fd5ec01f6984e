//! The pose of a given mesh in the photographs: many rotations are aligned with the visual hull by ICP, the best of them are
//! compared with the masks, and the poses are refined until their outlines overlap the masks best. Between poses with the same
//! outlines (a box has four) colours decide, if the mesh has them.

use std::f64::consts::{PI, TAU};

use rayon::prelude::*;
use sixfold_geometry::nalgebra::{UnitQuaternion, Vector6};
use sixfold_geometry::{
    IcpLevel, IcpOptions, IndexedCloud, KdTree, Mask, PointCloud, Pose, Progress, Vec3, icp,
};
use sixfold_mesh::{Mesh, simplify};
use sixfold_render::{Light, Material, RenderOptions, SceneObject, VisibilityBuffer, shade};

use crate::error::TeachError;
use crate::shape::step;
use crate::view::View;

/// Directions of the given mesh's z axis that are tried, and rotations about each.
const DIRECTIONS: usize = 60;
const ROTATIONS: usize = 12;
/// Points on each surface while many rotations are compared.
const POINTS: usize = 250;
/// Number of poses that are compared with the masks, and of those that are refined.
const COMPARED: usize = 40;
const REFINED: usize = 4;
/// Steps that are reported.
pub(crate) const PLACING_STEPS: usize = 1 + REFINED;
/// Faces of the mesh while outlines are compared.
const FACES: usize = 4000;
/// First step of the refinement: fraction of the diameter, radians; and how often it is halved.
const FIRST_STEP: [f64; 2] = [0.01, 0.05];
const HALVINGS: usize = 6;
/// Maximum number of steps of one size.
const SWEEPS: usize = 8;
/// Poses that differ by less than this fraction of the diameter are the same.
const SAME: f64 = 0.08;
/// Weight of the agreement of colours relative to that of outlines.
const COLORS: f64 = 0.1;
/// Minimum agreement of the outlines: the right object at the right pose reaches it.
const FITS: f64 = 0.8;
/// Diameters of mesh and hull may differ by this factor: the hull is a little too large, and closed below.
const SIZES: f64 = 1.5;

/// Finds the pose of a mesh in views with masks; `hull` is the visual hull of the masks. Returns the mesh's pose in the world.
pub(crate) fn placed(
    given: &Mesh,
    hull: &Mesh,
    views: &[View],
    masks: &[Mask],
    progress: &dyn Progress,
) -> Result<Pose, TeachError> {
    let (diameter, found) = (given.diameter(), hull.diameter());
    if !(diameter <= SIZES * found && found <= SIZES * diameter) {
        return Err(TeachError::MeshSize { mesh_mm: 1000.0 * diameter, found_mm: 1000.0 * found });
    }
    step(progress, 0, PLACING_STEPS)?;
    let fit = Fit { mesh: simplify(given, FACES), views, masks, diameter };
    let mut rough: Vec<(f64, Pose)> =
        aligned(given, hull).into_par_iter().map(|pose| (fit.overlap(&pose), pose)).collect();
    sort(&mut rough);
    rough.truncate(REFINED);
    let mut refined = vec![];
    for (i, (_, pose)) in rough.iter().enumerate() {
        step(progress, 1 + i, PLACING_STEPS)?;
        let (overlap, pose) = fit.refined(pose);
        refined.push((overlap + COLORS * fit.colors(given, &pose), overlap, pose));
    }
    step(progress, PLACING_STEPS, PLACING_STEPS)?;
    let best = refined.into_iter().max_by(|a, b| a.0.total_cmp(&b.0));
    match best {
        Some((_, overlap, world_from_object)) if overlap >= FITS => Ok(world_from_object),
        other => {
            Err(TeachError::MeshDoesNotFit { percent: 100.0 * other.map_or(0.0, |(_, overlap, _)| overlap) })
        }
    }
}

/// Sorts by falling score; equal scores keep their order.
fn sort(poses: &mut [(f64, Pose)]) {
    poses.sort_by(|a, b| b.0.total_cmp(&a.0));
}

fn cloud(mesh: &Mesh, seed: u64) -> PointCloud {
    let samples = mesh.sample_surface(POINTS, seed);
    PointCloud { points: samples.points, normals: samples.normals }
}

/// Distinct poses at which the surfaces agree, the best first.
fn aligned(given: &Mesh, hull: &Mesh) -> Vec<Pose> {
    let diameter = given.diameter();
    let (source, target) = (cloud(given, 1), cloud(hull, 2));
    let (own_tree, given_centre) = (KdTree::new(&source.points), centre_of(given));
    let Ok(target) = IndexedCloud::new(target) else { return vec![] };
    let there = centre_of(hull);
    let options = IcpOptions {
        levels: vec![
            IcpLevel { rejection_distance: 0.4 * diameter, iterations: 8, stride: 2 },
            IcpLevel { rejection_distance: 0.15 * diameter, iterations: 12, stride: 1 },
        ],
        convergence: 1e-4,
        ..IcpOptions::coarse_to_fine(diameter)
    };
    let mut all: Vec<(f64, Pose)> = rotations()
        .into_par_iter()
        .map(|rotation| {
            let start = Pose::new(rotation, there - rotation * given_centre);
            let pose = icp(&source, &target, &start, &options).map_or(start, |r| r.target_from_source);
            let back = pose.inverse();
            let near = |tree: &KdTree, p: &Vec3| tree.nearest(p).map_or(diameter, |n| n.distance);
            let out: Vec<f64> =
                source.points.iter().map(|p| near(target.tree(), &pose.transform_point(p))).collect();
            let home: Vec<f64> =
                target.cloud().points.iter().map(|p| near(&own_tree, &back.transform_point(p))).collect();
            // Hollows of the mesh are filled in the hull, so distances from the mesh to the hull count less than those from the
            // hull to the mesh.
            (-(0.5 * mean(&out).unwrap_or(diameter) + mean(&home).unwrap_or(diameter)), pose)
        })
        .collect();
    sort(&mut all);
    let mut distinct: Vec<Pose> = vec![];
    let corners = given.box_corners();
    for (_, pose) in all {
        let is_new = |other: &Pose| {
            let off = |c: &Vec3| (pose.transform_point(c) - other.transform_point(c)).norm();
            corners.iter().map(off).fold(0.0, f64::max) > SAME * diameter
        };
        if distinct.iter().all(is_new) {
            distinct.push(pose);
            if distinct.len() == COMPARED {
                break;
            }
        }
    }
    distinct
}

/// Evenly spaced rotations: directions on a spiral over the sphere, and a full turn in steps about each.
fn rotations() -> Vec<UnitQuaternion<f64>> {
    let golden = PI * (3.0 - 5f64.sqrt());
    let mut all = vec![];
    for i in 0..DIRECTIONS {
        let z = 1.0 - 2.0 * (i as f64 + 0.5) / DIRECTIONS as f64;
        let (angle, radius) = (golden * i as f64, (1.0 - z * z).sqrt());
        let direction = Vec3::new(radius * angle.cos(), radius * angle.sin(), z);
        let to = UnitQuaternion::rotation_between(&Vec3::z(), &direction)
            .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vec3::x_axis(), PI));
        for k in 0..ROTATIONS {
            let about = TAU * k as f64 / ROTATIONS as f64;
            all.push(to * UnitQuaternion::from_axis_angle(&Vec3::z_axis(), about));
        }
    }
    all
}

fn centre_of(mesh: &Mesh) -> Vec3 {
    let (low, high) = mesh.bounding_box();
    0.5 * (low + high)
}

/// Comparison of outlines with masks.
struct Fit<'a> {
    mesh: Mesh,
    views: &'a [View],
    masks: &'a [Mask],
    diameter: f64,
}

impl Fit<'_> {
    fn buffer(&self, mesh: &Mesh, view: &View, pose: &Pose) -> (VisibilityBuffer, Pose) {
        let camera_from_object = view.camera_from_world * *pose;
        let mut buffer = VisibilityBuffer::new(&view.camera);
        buffer.render(&[SceneObject { mesh, camera_from_object }], &RenderOptions::default());
        (buffer, camera_from_object)
    }

    /// Mean intersection over union of outline and mask over the views.
    fn overlap(&self, pose: &Pose) -> f64 {
        let of_view = |(view, mask): (&View, &Mask)| {
            let (buffer, _) = self.buffer(&self.mesh, view, pose);
            let pairs = || buffer.inverse_depth().iter().zip(mask.as_slice());
            let both = pairs().filter(|(d, m)| **d > 0.0 && **m).count();
            let either = pairs().filter(|(d, m)| **d > 0.0 || **m).count();
            both as f64 / either.max(1) as f64
        };
        // Collected in order, so that the sum is the same for any number of threads.
        let all: Vec<f64> = self.views.par_iter().zip(self.masks).map(of_view).collect();
        mean(&all).unwrap_or(0.0)
    }

    /// Shifts and rotates a pose along and about the axes through the object's centre as long as the overlap improves.
    fn refined(&self, pose: &Pose) -> (f64, Pose) {
        let mut best = (self.overlap(pose), *pose);
        let mut size = [FIRST_STEP[0] * self.diameter, FIRST_STEP[1]];
        for _ in 0..=HALVINGS {
            for _ in 0..SWEEPS {
                let before = best.0;
                for axis in 0..6 {
                    for sign in [-1.0, 1.0] {
                        let moved = self.moved(&best.1, axis, sign * size[usize::from(axis > 2)]);
                        let overlap = self.overlap(&moved);
                        if overlap > best.0 {
                            best = (overlap, moved);
                        }
                    }
                }
                if best.0 <= before {
                    break;
                }
            }
            size = size.map(|s| 0.5 * s);
        }
        best
    }

    fn moved(&self, pose: &Pose, axis: usize, by: f64) -> Pose {
        let mut twist = Vector6::zeros();
        twist[axis] = by;
        let step = Pose::exp(&twist);
        let mesh_centre = pose.transform_point(&centre_of(&self.mesh));
        let shifted = pose.translation() - mesh_centre;
        Pose::new(
            step.rotation() * pose.rotation(),
            step.rotation() * shifted + mesh_centre + step.translation(),
        )
    }

    /// Agreement of the mesh's own colours with the photographs: mean correlation over the views; 0 for a mesh without colours.
    fn colors(&self, given: &Mesh, pose: &Pose) -> f64 {
        if given.colors().is_none() && given.texture().is_none() {
            return 0.0;
        }
        let light = [Light::Ambient { color: [1.0; 3] }];
        let of_view = |view: &View| {
            let (buffer, camera_from_object) = self.buffer(given, view, pose);
            let objects = [SceneObject { mesh: given, camera_from_object }];
            let drawn = shade(&buffer, &objects, &light, &Material::default(), None);
            let (mut a, mut b) = (vec![], vec![]);
            for (i, depth) in buffer.inverse_depth().iter().enumerate() {
                if *depth > 0.0 {
                    a.extend(drawn.as_slice()[i].map(f64::from));
                    b.extend(view.image.as_slice()[i].map(f64::from));
                }
            }
            correlation(&a, &b)
        };
        let all: Vec<f64> = self.views.par_iter().map(of_view).collect();
        mean(&all).unwrap_or(0.0)
    }
}

fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Pearson's correlation; 0 if either is constant.
fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let (Some(ma), Some(mb)) = (mean(a), mean(b)) else { return 0.0 };
    let sum = |f: &dyn Fn(f64, f64) -> f64| a.iter().zip(b).map(|(x, y)| f(x - ma, y - mb)).sum::<f64>();
    let both = (sum(&|x, _| x * x) * sum(&|_, y| y * y)).sqrt();
    if both > 0.0 { sum(&|x, y| x * y) / both } else { 0.0 }
}
