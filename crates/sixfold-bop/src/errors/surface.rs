//! Distances between model points at two poses: MSSD, ADD and ADI.

use sixfold_geometry::Pose;

use crate::points::ModelPoints;

/// Maximum Symmetry-Aware Surface Distance in metres (BOP Challenge 2019; Hodan et al. 2020, section 2.2): the
/// largest distance between corresponding vertices, under the symmetry for which it is smallest.
///
/// `symmetries` must hold the identity; an empty list gives infinity.
pub fn mssd(points: &ModelPoints, estimate: &Pose, ground_truth: &Pose, symmetries: &[Pose]) -> f64 {
    let rotation = estimate.rotation_matrix();
    let mut best = f64::INFINITY;
    for symmetry in symmetries {
        let equivalent = ground_truth * symmetry;
        let a = rotation - equivalent.rotation_matrix();
        let b = estimate.translation() - equivalent.translation();
        best = best.min(points.largest_squared(&a, &b, best));
    }
    best.sqrt()
}

/// Average Distance of model points in metres, corresponding points (Hinterstoisser et al. 2012).
pub fn add(points: &ModelPoints, estimate: &Pose, ground_truth: &Pose) -> f64 {
    let a = estimate.rotation_matrix() - ground_truth.rotation_matrix();
    points.mean_norm(&a, &(estimate.translation() - ground_truth.translation()))
}

/// Average Distance of model points in metres, each point at the ground-truth pose to the nearest point at the
/// estimated pose (Hinterstoisser et al. 2012; also written ADD-S). Exact.
pub fn adi(points: &ModelPoints, estimate: &Pose, ground_truth: &Pose) -> f64 {
    // Distances do not change under the inverse of the estimate, so one tree in the object's frame serves all.
    points.mean_nearest_after(&(estimate.inverse() * *ground_truth))
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::Vec3;
    use sixfold_geometry::nalgebra::UnitQuaternion;

    /// Two points 0.2 m apart on the x axis.
    fn dumbbell() -> ModelPoints {
        ModelPoints::new(&[Vec3::new(0.1, 0.0, 0.0), Vec3::new(-0.1, 0.0, 0.0)]).unwrap()
    }

    fn turned_about_z(angle: f64) -> Pose {
        Pose::new(UnitQuaternion::from_scaled_axis(Vec3::z() * angle), Vec3::new(0.0, 0.0, 1.0))
    }

    #[test]
    fn a_half_turn_of_a_dumbbell_by_hand() {
        let points = dumbbell();
        let (e, g) = (turned_about_z(std::f64::consts::PI), turned_about_z(0.0));
        let half_turn =
            Pose::new(UnitQuaternion::from_scaled_axis(Vec3::z() * std::f64::consts::PI), Vec3::zeros());
        assert!((add(&points, &e, &g) - 0.2).abs() < 1e-12);
        assert!(adi(&points, &e, &g) < 1e-12);
        assert!((mssd(&points, &e, &g, &[Pose::identity()]) - 0.2).abs() < 1e-12);
        assert!(mssd(&points, &e, &g, &[Pose::identity(), half_turn]) < 1e-12);
        assert_eq!(mssd(&points, &e, &g, &[]), f64::INFINITY);
    }

    #[test]
    fn a_quarter_turn_of_a_dumbbell_by_hand() {
        // Each end moves along the chord of a quarter circle of radius 0.1 m, to either end of the other pose.
        let points = dumbbell();
        let (e, g) = (turned_about_z(std::f64::consts::FRAC_PI_2), turned_about_z(0.0));
        let chord = 0.1 * 2f64.sqrt();
        assert!((add(&points, &e, &g) - chord).abs() < 1e-12);
        assert!((adi(&points, &e, &g) - chord).abs() < 1e-12);
    }

    #[test]
    fn the_mean_and_the_largest_differ_where_they_should() {
        // The estimate is 30 mm off in x and turned by a half: ends move by 0.2 - 0.03 and 0.2 + 0.03.
        let points = dumbbell();
        let g = turned_about_z(0.0);
        let e = turned_about_z(std::f64::consts::PI).with_translation(Vec3::new(0.03, 0.0, 1.0));
        assert!((mssd(&points, &e, &g, &[Pose::identity()]) - 0.23).abs() < 1e-12);
        assert!((add(&points, &e, &g) - 0.2).abs() < 1e-12);
        assert!((adi(&points, &e, &g) - 0.03).abs() < 1e-12);
    }
}
