//! From a matched template to a pose: aligns the template's own surface with the scene.
//!
//! The dissertation takes the centre of the visible part as the object's centre, and names the shift that results under occlusion
//! as its main failure (section 5.3.3). Here the template's points are aligned with those of the scene, first along the ray, then
//! by ICP, so hidden parts cause no shift.

use sixfold_align::DepthRegion;
use sixfold_geometry::{DepthTarget, IcpLevel, IcpOptions, PointCloud, Pose, Vec2, Vec3, icp};

/// Levels of the ICP: rejection distance as a multiple of the depth tolerance, and iterations. Chosen by hand; not swept.
const LEVELS: [(f64, usize); 3] = [(1.5, 4), (0.8, 5), (0.5, 5)];
/// Iterations before a region may be rejected (dissertation: 3).
#[cfg(feature = "network")]
const SHORT: usize = 3;
/// Largest angle between the normals of a correspondence, degrees; chosen by hand, not swept.
const MAX_ANGLE: f64 = 50.0;
/// A level stops when a step is smaller than this, metres and radians; chosen by hand, below the noise of depth.
const CONVERGENCE: f64 = 2e-4;
/// Fewest correspondences of the ICP; chosen by hand, not swept.
const MIN_CORRESPONDENCES: usize = 10;
/// An ICP that moves a template by more than this multiple of the tolerance has slid to another surface; chosen by hand, not swept.
const MAX_SHIFT: f64 = 4.0;
/// The same for rotations, radians: views are about 8 degrees apart, with in-plane rotations in steps of 15. Chosen by hand; not
/// swept.
const MAX_ROTATION: f64 = 0.7;
/// Only differences along the ray below this multiple of the tolerance count: larger ones are not the object's. Chosen by hand; not
/// swept.
const NEAR: f64 = 1.5;
/// With fewer differences the distance is not corrected; chosen by hand, not swept.
const MIN_DIFFERENCES: usize = 8;

/// Aligns a template's points (view frame) with the scene. The initial pose must be right within a few times `tolerance` metres.
pub fn align(scene: &DepthRegion, cloud: &PointCloud, camera_from_view: &Pose, tolerance: f64) -> Pose {
    let start = along_the_ray(scene, cloud, camera_from_view, tolerance);
    let target = DepthTarget { depth: scene.depth(), normals: scene.normals(), camera: scene.camera() };
    let level =
        |(fraction, iterations)| IcpLevel { rejection_distance: fraction * tolerance, iterations, stride: 1 };
    let options = IcpOptions {
        levels: LEVELS.map(level).to_vec(),
        max_angle: MAX_ANGLE.to_radians(),
        convergence: CONVERGENCE,
        min_correspondences: MIN_CORRESPONDENCES,
    };
    let Ok(report) = icp(cloud, &target, &start, &options) else { return start };
    let moved = report.target_from_source.distance_to(camera_from_view);
    if moved < MAX_SHIFT * tolerance
        && report.target_from_source.rotation_angle_to(camera_from_view) < MAX_ROTATION
    {
        report.target_from_source
    } else {
        start
    }
}

/// Three iterations of ICP alone, after which the dissertation decides whether to reject a region (section 5.2.5).
#[cfg(feature = "network")]
pub(crate) fn align_shortly(
    scene: &DepthRegion,
    cloud: &PointCloud,
    camera_from_view: &Pose,
    tolerance: f64,
) -> Pose {
    let target = DepthTarget { depth: scene.depth(), normals: scene.normals(), camera: scene.camera() };
    let rejection_distance = LEVELS[0].0 * tolerance;
    let options = IcpOptions {
        levels: vec![IcpLevel { rejection_distance, iterations: SHORT, stride: 1 }],
        max_angle: MAX_ANGLE.to_radians(),
        convergence: CONVERGENCE,
        min_correspondences: MIN_CORRESPONDENCES,
    };
    icp(cloud, &target, camera_from_view, &options).map_or(*camera_from_view, |r| r.target_from_source)
}

/// Moves the points along the ray by the median of the differences to the scene that are small enough to belong to the object.
fn along_the_ray(scene: &DepthRegion, cloud: &PointCloud, camera_from_view: &Pose, tolerance: f64) -> Pose {
    let camera = scene.camera();
    let centre = camera_from_view.translation();
    let ray = centre.normalize();
    let mut off: Vec<f64> = cloud
        .points
        .iter()
        .filter_map(|p| {
            let p = camera_from_view.transform_point(p);
            let pixel = camera.project(&p)?;
            let (x, y) = (pixel.x.round(), pixel.y.round());
            if x < 0.0 || y < 0.0 {
                return None;
            }
            let z = f64::from(*scene.depth().get(x as usize, y as usize)?);
            let seen = camera.unproject(&Vec2::new(x, y), z);
            let off = ray.dot(&(seen - p));
            (z > 0.0 && off.abs() < NEAR * tolerance).then_some(off)
        })
        .collect();
    if off.len() < MIN_DIFFERENCES {
        return *camera_from_view;
    }
    let half = off.len() / 2;
    let shift = *off.select_nth_unstable_by(half, f64::total_cmp).1;
    camera_from_view.with_translation(centre + ray * shift)
}

/// The pose of a template's reference point for a match: the view rotated by `turn` in the region's frame.
pub fn camera_from_view(camera_from_roi: &Pose, turn: f64) -> Pose {
    let rotated = sixfold_geometry::nalgebra::UnitQuaternion::from_axis_angle(&Vec3::z_axis(), turn);
    *camera_from_roi * Pose::new(rotated, Vec3::zeros())
}
