//! Distances between model points at two poses: MSSD, ADD and ADI.

use sixfold_geometry::{Mat3, Pose, Vec3};

use super::Placement;
use crate::points::ModelPoints;

/// Maximum Symmetry-Aware Surface Distance in metres (BOP Challenge 2019; Hodan et al. 2020, section 2.2): the
/// largest distance between corresponding vertices, under the symmetry for which it is smallest.
///
/// `symmetries` must hold the identity; an empty list gives infinity.
pub fn mssd(
    points: &ModelPoints,
    estimate: impl Into<Placement>,
    ground_truth: impl Into<Placement>,
    symmetries: &[Pose],
) -> f64 {
    let (estimate, ground_truth) = (estimate.into(), ground_truth.into());
    let mut best = f64::INFINITY;
    for symmetry in symmetries {
        let equivalent = ground_truth.after(&symmetry.into());
        let a = estimate.rotation - equivalent.rotation;
        let b = estimate.translation - equivalent.translation;
        best = best.min(points.largest_squared(&a, &b, best));
    }
    best.sqrt()
}

/// Average Distance between corresponding model points in metres (Hinterstoisser et al. 2012).
pub fn add(points: &ModelPoints, estimate: impl Into<Placement>, ground_truth: impl Into<Placement>) -> f64 {
    let (estimate, ground_truth) = (estimate.into(), ground_truth.into());
    let a = estimate.rotation - ground_truth.rotation;
    points.mean_norm(&a, &(estimate.translation - ground_truth.translation))
}

/// ADD(-S): [`adi`] for symmetric objects, [`add`] for others.
pub fn add_s(
    points: &ModelPoints,
    symmetric: bool,
    estimate: impl Into<Placement>,
    ground_truth: impl Into<Placement>,
) -> f64 {
    if symmetric { adi(points, estimate, ground_truth) } else { add(points, estimate, ground_truth) }
}

/// Average Distance of model points in metres, each point at the ground-truth pose to the nearest point at the
/// estimated pose (Hinterstoisser et al. 2012; also written ADD-S). Exact.
pub fn adi(points: &ModelPoints, estimate: impl Into<Placement>, ground_truth: impl Into<Placement>) -> f64 {
    let (estimate, ground_truth) = (estimate.into(), ground_truth.into());
    let back = estimate.rotation.transpose();
    if (back * estimate.rotation - Mat3::identity()).amax() > 1e-6 {
        // The matrix is not exactly a rotation and changes distances, so the points have to be transformed by
        // it.
        let placed: Vec<Vec3> = (0..points.len()).map(|i| estimate.rotation * points.point(i)).collect();
        if let Some(placed) = ModelPoints::new(&placed) {
            let translation = ground_truth.translation - estimate.translation;
            return placed.mean_nearest(points, &ground_truth.rotation, &translation);
        }
    }
    // Distances do not change under the inverse of the estimate, so one tree in the object's frame serves all.
    let translation = back * (ground_truth.translation - estimate.translation);
    points.mean_nearest(points, &(back * ground_truth.rotation), &translation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::nalgebra::UnitQuaternion;

    /// Two points 0.2 m apart on the x axis.
    fn dumbbell() -> ModelPoints {
        ModelPoints::new(&[Vec3::new(0.1, 0.0, 0.0), Vec3::new(-0.1, 0.0, 0.0)]).unwrap()
    }

    fn rotated_about_z(angle: f64) -> Pose {
        Pose::new(UnitQuaternion::from_scaled_axis(Vec3::z() * angle), Vec3::new(0.0, 0.0, 1.0))
    }

    #[test]
    fn a_rotation_of_a_dumbbell_by_180_degrees_by_hand() {
        let points = dumbbell();
        let (e, g) = (rotated_about_z(std::f64::consts::PI), rotated_about_z(0.0));
        let half_turn =
            Pose::new(UnitQuaternion::from_scaled_axis(Vec3::z() * std::f64::consts::PI), Vec3::zeros());
        assert!((add(&points, e, g) - 0.2).abs() < 1e-12);
        assert!(adi(&points, e, g) < 1e-12);
        assert!((mssd(&points, e, g, &[Pose::identity()]) - 0.2).abs() < 1e-12);
        assert!(mssd(&points, e, g, &[Pose::identity(), half_turn]) < 1e-12);
        assert_eq!(mssd(&points, e, g, &[]), f64::INFINITY);
    }

    #[test]
    fn a_rotation_of_a_dumbbell_by_90_degrees_by_hand() {
        // Each end moves along the chord of a quarter circle of radius 0.1 m, to either end of the other pose.
        let points = dumbbell();
        let (e, g) = (rotated_about_z(std::f64::consts::FRAC_PI_2), rotated_about_z(0.0));
        let chord = 0.1 * 2f64.sqrt();
        assert!((add(&points, e, g) - chord).abs() < 1e-12);
        assert!((adi(&points, e, g) - chord).abs() < 1e-12);
    }

    #[test]
    fn the_mean_and_the_maximum_differ_as_computed_by_hand() {
        // The estimate is shifted by 30 mm in x and rotated by half a turn: ends move by 0.2 - 0.03 and 0.2 +
        // 0.03.
        let points = dumbbell();
        let g = rotated_about_z(0.0);
        let e = rotated_about_z(std::f64::consts::PI).with_translation(Vec3::new(0.03, 0.0, 1.0));
        assert!((mssd(&points, e, g, &[Pose::identity()]) - 0.23).abs() < 1e-12);
        assert!((add(&points, e, g) - 0.2).abs() < 1e-12);
        assert!((adi(&points, e, g) - 0.03).abs() < 1e-12);
    }

    #[test]
    fn numbers_that_are_not_quite_a_rotation_are_taken_as_they_are() {
        // A rotation a thousandth too large moves the end at 0.1 m by 0.1 mm; all errors report that, with
        // symmetries or without.
        let points = dumbbell();
        let g = Placement::from(rotated_about_z(0.0));
        let e = Placement { rotation: g.rotation * 1.001, ..g };
        for error in [mssd(&points, e, g, &[Pose::identity()]), add(&points, e, g), adi(&points, e, g)] {
            assert!((error - 1e-4).abs() < 1e-12, "{error}");
        }
    }
}
