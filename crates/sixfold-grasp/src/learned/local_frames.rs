//! GPD's candidates (Ten Pas et al. 2017, section 4): a point of the cloud, its frame of normal and curvature axis, rotations about
//! that axis and placements along the closing direction, each pushed forward until the hand touches something.

use std::f64::consts::PI;

use rand::RngExt;
use rayon::prelude::*;
use sixfold_geometry::nalgebra::SymmetricEigen;
use sixfold_geometry::random::stream;
use sixfold_geometry::{KdTree, Mat3, Vec3};

use super::push::Pusher;
use crate::{Grasp, GraspView, Gripper};

/// How candidates are sampled. The defaults are those of the paper's code unless stated otherwise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LocalFrameOptions {
    /// Points that are sampled.
    pub samples: usize,
    /// Rotations about the curvature axis, over 180 degrees.
    pub rotations: usize,
    /// Placements of the hand along its closing direction.
    pub placements: usize,
    /// Radius of the neighbourhood from which a frame is computed, metres.
    pub radius: f64,
    /// Seed of the samples.
    pub seed: u64,
}

impl Default for LocalFrameOptions {
    fn default() -> Self {
        // 5 placements where the paper has 10, chosen by hand; not swept.
        LocalFrameOptions { samples: 100, rotations: 8, placements: 5, radius: 0.01, seed: 0 }
    }
}

/// Openings of the hand as fractions of its maximum: GPD's hand has one opening, about equal to the second.
const OPENINGS: [f64; 2] = [1.0, 0.5];

/// Candidates on the object of a view, in the order of their samples: free of collisions with measured points, with something
/// between the pads, and approaching from above the horizontal. The same seed gives the same candidates at any number of threads.
pub fn local_frame_grasps(view: &GraspView, gripper: &Gripper, options: &LocalFrameOptions) -> Vec<Grasp> {
    let cloud = &view.object;
    if cloud.is_empty() || cloud.normals.len() != cloud.len() {
        return vec![];
    }
    let pusher = Pusher::new(view, gripper);
    let tree = KdTree::new(&cloud.points);
    let found: Vec<Vec<Grasp>> = (0..options.samples)
        .into_par_iter()
        .map(|sample| {
            let mut random = stream(options.seed, sample as u64);
            let point = random.random_range(0..cloud.len());
            let opening = gripper.max_opening * OPENINGS[sample % OPENINGS.len()];
            let Some((normal, axis)) = local_frame(&pusher, &tree, point, options.radius) else {
                return vec![];
            };
            of_frame(&pusher, &cloud.points[point], &normal, &axis, opening, options)
        })
        .collect();
    found.into_iter().flatten().collect()
}

/// The outward normal and the axis of least curvature at a point of the cloud.
fn local_frame(pusher: &Pusher<'_>, tree: &KdTree, point: usize, radius: f64) -> Option<(Vec3, Vec3)> {
    let cloud = &pusher.view.object;
    let near = tree.within(&cloud.points[point], radius);
    // Normals vary least along the axis of least curvature.
    let scatter: Mat3 =
        near.iter().map(|n| cloud.normals[n.index] * cloud.normals[n.index].transpose()).sum();
    let eigen = SymmetricEigen::new(scatter);
    let normal = cloud.normals[point];
    let axis: Vec3 = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    let axis = (axis - normal * axis.dot(&normal)).try_normalize(1e-6)?;
    Some((normal, axis))
}

/// The candidates of one frame: the hand's plane contains the normal and the direction of largest curvature.
fn of_frame(
    pusher: &Pusher<'_>,
    point: &Vec3,
    normal: &Vec3,
    axis: &Vec3,
    opening: f64,
    options: &LocalFrameOptions,
) -> Vec<Grasp> {
    let (down, side) = (pusher.down(), axis.cross(normal));
    let mut grasps = vec![];
    for k in 0..options.rotations {
        let angle = PI * ((k as f64 + 0.5) / options.rotations as f64 - 0.5);
        let approach = -normal * angle.cos() + side * angle.sin();
        if approach.dot(&down) < 0.0 {
            continue;
        }
        let closing = approach.cross(axis);
        for place in 0..options.placements {
            let along = opening * ((place as f64 + 0.5) / options.placements as f64 - 0.5);
            grasps.extend(pusher.push(&(point + closing * along), &approach, &closing, opening));
        }
    }
    grasps
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::PointCloud;

    use super::*;

    #[test]
    fn a_lying_cylinder_is_held_across_its_axis() {
        // A cylinder of 4 cm diameter along x on a table, with the camera looking straight down: its upper half is visible.
        let mut object = PointCloud::default();
        for i in 0..=60 {
            for k in 0..=24 {
                let angle = PI * f64::from(k) / 24.0;
                let normal = Vec3::new(0.0, angle.cos(), -angle.sin());
                object.points.push(Vec3::new(0.003 * f64::from(i) - 0.09, 0.0, 0.58) + normal * 0.02);
                object.normals.push(normal);
            }
        }
        let view = GraspView::from_above(object, 0.6, 0.003);
        let gripper = Gripper::built_in("jaws-85").unwrap();
        let options = LocalFrameOptions::default();
        let grasps = local_frame_grasps(&view, &gripper, &options);
        assert!(grasps.len() > 20, "{}", grasps.len());
        let across = grasps.iter().filter(|g| g.closing().y.abs() > 0.6).count();
        assert!(10 * across > 8 * grasps.len(), "{across} of {}", grasps.len());
        assert!(grasps.iter().all(|g| g.approach().z >= -1e-9), "from above");
        assert_eq!(grasps, local_frame_grasps(&view, &gripper, &options));
    }
}
