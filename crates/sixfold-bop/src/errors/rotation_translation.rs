//! Rotation and translation error, with symmetries.

use sixfold_geometry::Pose;

/// The angle in radians between the rotations of two poses, under the symmetry for which it is smallest.
/// Infinite for an empty list of symmetries.
pub fn rotation_error(estimate: &Pose, ground_truth: &Pose, symmetries: &[Pose]) -> f64 {
    symmetries
        .iter()
        .map(|symmetry| estimate.rotation_angle_to(&(ground_truth * symmetry)))
        .fold(f64::INFINITY, f64::min)
}

/// The distance in metres between the origins of two poses, under the symmetry for which it is smallest.
/// Infinite for an empty list of symmetries.
pub fn translation_error(estimate: &Pose, ground_truth: &Pose, symmetries: &[Pose]) -> f64 {
    symmetries
        .iter()
        .map(|symmetry| estimate.distance_to(&(ground_truth * symmetry)))
        .fold(f64::INFINITY, f64::min)
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::Vec3;
    use sixfold_geometry::nalgebra::UnitQuaternion;

    #[test]
    fn angles_and_distances_by_hand() {
        let about_z = |angle: f64, x: f64| {
            Pose::new(UnitQuaternion::from_scaled_axis(Vec3::z() * angle), Vec3::x() * x)
        };
        let (e, g) = (about_z(3.0, 0.5), about_z(0.0, 0.2));
        let identity = Pose::identity();
        assert!((rotation_error(&e, &g, &[identity]) - 3.0).abs() < 1e-12);
        let half_turn = about_z(std::f64::consts::PI, 0.1);
        let off = std::f64::consts::PI - 3.0;
        assert!((rotation_error(&e, &g, &[identity, half_turn]) - off).abs() < 1e-12);
        assert!((translation_error(&e, &g, &[identity]) - 0.3).abs() < 1e-12);
        assert!((translation_error(&e, &g, &[identity, half_turn]) - 0.2).abs() < 1e-12);
        assert_eq!(rotation_error(&e, &g, &[]), f64::INFINITY);
    }
}
