//! The world of photographs without a board: the plane on which the object stands, z up, origin below the point at which the cameras look.

use sixfold_geometry::nalgebra::{Rotation3, UnitQuaternion};
use sixfold_geometry::stats::median;
use sixfold_geometry::{Mat3, Plane, PlaneOptions, PointCloud, Pose, Vec3, dominant_plane, fit_plane};

/// Points within this distance of a plane count as its inliers in the search, as a fraction of the cameras' distance.
/// Chosen by hand.
const THICKNESS: f64 = 0.008;
/// Only points within this distance of the point at which the cameras look count, as a fraction of the cameras' distance: points
/// beyond the table carry no information about it. Chosen by hand.
const REACH: f64 = 0.8;
/// Number of planes that are tried, the one with most points first: a side of a box may have more points than the table.
const TRIES: usize = 4;
/// Maximum fraction of points below a table; such points are wrong. Chosen by hand.
const BELOW: f64 = 0.05;
/// Minimum fraction of the points on a table. Chosen by hand.
const ON_TABLE: f64 = 0.1;
/// Passes of the fit to the points within three standard deviations.
const PASSES: usize = 5;

/// An upright frame in the unit of length of the reconstruction.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Upright {
    /// Takes points of the reconstruction to the frame.
    pub world_from_scene: Pose,
    /// Whether the points contain the plane `z = 0`.
    pub on_table: bool,
}

/// The upright frame from the points and cameras of a scene.
pub(crate) fn upright(points: &[Vec3], camera_from_scene: &[Pose]) -> Upright {
    let eyes: Vec<Vec3> = camera_from_scene.iter().map(|p| p.inverse().translation()).collect();
    let centre = meeting_point(camera_from_scene, &eyes).unwrap_or_else(|| centroid(points));
    let mut distances: Vec<f64> = eyes.iter().map(|e| (e - centre).norm()).collect();
    let distance = median(&mut distances).unwrap_or(1.0);
    let near: Vec<Vec3> =
        points.iter().filter(|p| (*p - centre).norm() < REACH * distance).copied().collect();
    let table = table(&near, &eyes, THICKNESS * distance);
    let (up, origin) = match table {
        Some(plane) => (plane.normal, centre - plane.normal * plane.distance(&centre)),
        None => {
            // Photographs are held upright: y of an image points down.
            let down = |p: &Pose| p.inverse().transform_direction(&Vec3::y());
            let sum: Vec3 = camera_from_scene.iter().map(|p| -down(p)).sum();
            (sum.try_normalize(1e-9).unwrap_or(Vec3::z()), centre)
        }
    };
    let right = camera_from_scene.first().map_or(Vec3::x(), |p| p.inverse().transform_direction(&Vec3::x()));
    let across = |v: Vec3| (v - up * up.dot(&v)).try_normalize(1e-6);
    let x = across(right).or_else(|| across(Vec3::x())).or_else(|| across(Vec3::y())).unwrap_or(Vec3::x());
    let rows = Mat3::from_rows(&[x.transpose(), up.cross(&x).transpose(), up.transpose()]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rows));
    Upright { world_from_scene: Pose::new(rotation, -(rotation * origin)), on_table: table.is_some() }
}

fn centroid(points: &[Vec3]) -> Vec3 {
    let of = |axis: usize| median(&mut points.iter().map(|p| p[axis]).collect::<Vec<f64>>()).unwrap_or(0.0);
    Vec3::new(of(0), of(1), of(2))
}

/// The point nearest to the optical axes: least squares, reweighted by the inverse of the distances.
fn meeting_point(poses: &[Pose], eyes: &[Vec3]) -> Option<Vec3> {
    let axes: Vec<Vec3> = poses.iter().map(|p| p.inverse().transform_direction(&Vec3::z())).collect();
    let mut weights = vec![1.0; axes.len()];
    let mut point = Vec3::zeros();
    for _ in 0..10 {
        let (mut left, mut right) = (Mat3::zeros(), Vec3::zeros());
        for ((axis, eye), weight) in axes.iter().zip(eyes).zip(&weights) {
            let across = (Mat3::identity() - axis * axis.transpose()) * *weight;
            left += across;
            right += across * eye;
        }
        let values = left.symmetric_eigenvalues();
        if !(values.min() > 1e-3 * values.max()) {
            return None;
        }
        point = left.cholesky()?.solve(&right);
        for ((axis, eye), weight) in axes.iter().zip(eyes).zip(&mut weights) {
            let towards = point - eye;
            *weight = 1.0 / (towards.cross(axis).norm() / towards.norm() + 1e-2);
        }
    }
    let before = axes.iter().zip(eyes).filter(|(axis, eye)| (point - **eye).dot(axis) > 0.0).count();
    (point.iter().all(|v| v.is_finite()) && 2 * before > axes.len()).then_some(point)
}

/// The plane with the most points that has all cameras on one side and nothing on the other; its normal points to the cameras'
/// side.
fn table(points: &[Vec3], eyes: &[Vec3], thickness: f64) -> Option<Plane> {
    let centroid = eyes.iter().sum::<Vec3>() / eyes.len().max(1) as f64;
    let options = PlaneOptions {
        threshold: thickness,
        iterations: 1000,
        min_fraction: ON_TABLE,
        ..PlaneOptions::default()
    };
    let mut left = points.to_vec();
    for seed in 0..TRIES as u64 {
        let cloud = PointCloud { points: left.clone(), normals: vec![] };
        let found = dominant_plane(&cloud, &options, seed)?.facing(&centroid);
        let below = points.iter().filter(|p| found.distance(p) < -3.0 * thickness).count();
        let held = points.iter().filter(|p| found.distance(p).abs() < thickness).count() as f64;
        let above = eyes.iter().all(|eye| found.distance(eye) > thickness);
        if above && below as f64 <= BELOW * points.len() as f64 && held >= ON_TABLE * points.len() as f64 {
            return Some(fitted(found, points, &centroid, thickness));
        }
        left.retain(|p| found.distance(p).abs() >= thickness);
    }
    None
}

/// The plane fitted to the points within three standard deviations of it.
fn fitted(plane: Plane, points: &[Vec3], above: &Vec3, thickness: f64) -> Plane {
    let mut plane = plane;
    for _ in 0..PASSES {
        let mut distances: Vec<f64> =
            points.iter().map(|p| plane.distance(p).abs()).filter(|d| *d < thickness).collect();
        let Some(deviation) = median(&mut distances).map(|m| 1.4826 * m) else { break };
        let limit = (3.0 * deviation).min(thickness);
        let on: Vec<Vec3> = points.iter().filter(|p| plane.distance(p).abs() <= limit).copied().collect();
        let Some(next) = fit_plane(&on) else { break };
        plane = next.facing(above);
    }
    plane
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::looking_at;

    /// A table with a box on it and, far behind and below, a floor; cameras around.
    fn scene() -> (Vec<Vec3>, Vec<Pose>) {
        let mut points = vec![];
        for i in 0..400 {
            let t = f64::from(i);
            let (a, b) = ((1.7 * t).sin(), (2.3 * t).cos());
            points.push(Vec3::new(0.3 * a, 0.3 * b, 0.0005 * (5.1 * t).sin()));
            points.push(Vec3::new(0.04, 0.03 * a, 0.06 + 0.06 * b));
            points.push(Vec3::new(0.04 * a, 0.03 * b, 0.12));
            points.push(Vec3::new(3.0 + a, b, -0.7));
        }
        let poses =
            (0..9).map(|i| looking_at(&Vec3::new(0.0, 0.0, 0.05), 40.0 * f64::from(i), 40.0, 0.6, 3.0));
        (points, poses.collect())
    }

    #[test]
    fn the_frame_is_on_the_table_for_any_frame_of_the_reconstruction() {
        let (points, poses) = scene();
        let scene_from_truth = Pose::exp(&[0.3, -2.0, 1.0, 1.0, -0.4, 2.0].into());
        let moved: Vec<Vec3> = points.iter().map(|p| scene_from_truth.transform_point(p)).collect();
        let cameras: Vec<Pose> = poses.iter().map(|p| p * &scene_from_truth.inverse()).collect();
        let found = upright(&moved, &cameras);
        assert!(found.on_table);
        let world_from_truth = found.world_from_scene * scene_from_truth;
        assert!(world_from_truth.translation().norm() < 1e-3, "{world_from_truth:?}");
        let up = world_from_truth.transform_direction(&Vec3::z());
        assert!(up.z > 0.99999, "{up:?}");
    }

    #[test]
    fn without_a_table_up_comes_from_the_photographs() {
        let (_, poses) = scene();
        let ball: Vec<Vec3> = (0..600)
            .map(|i| {
                let t = f64::from(i);
                let v = Vec3::new((1.1 * t).sin(), (1.9 * t).cos(), (2.7 * t).sin());
                v.normalize() * 0.05 + Vec3::new(0.0, 0.0, 0.05)
            })
            .collect();
        let found = upright(&ball, &poses);
        assert!(!found.on_table);
        assert!(found.world_from_scene.transform_direction(&Vec3::z()).z > 0.9);
        let centre = found.world_from_scene.transform_point(&Vec3::new(0.0, 0.0, 0.05));
        assert!(centre.norm() < 0.01, "{centre:?}");
    }
}
