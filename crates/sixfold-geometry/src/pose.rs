//! Rigid transformations in SE(3), in `f64`, with exponential and logarithm.
//!
//! The twist of [`Pose::exp`] is `(v, w)`: translation part first, then the rotation vector. Formulas from Barfoot,
//! *State Estimation for Robotics* (2017), section 7.1.

use std::ops::Mul;

use nalgebra::{Isometry3, Matrix3, Matrix4, Rotation3, Translation3, UnitQuaternion, Vector6};
use thiserror::Error;

use crate::{Mat3, Vec3};

/// Why numbers do not describe a rigid transformation.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum PoseError {
    /// The 3x3 part is not a rotation.
    #[error(
        "the 3x3 part is not a rotation: R^T R differs from the identity by up to {orthogonality:.2e} \
         (at most {tolerance:.0e} is accepted) and its determinant is {determinant:.6} (expected 1)"
    )]
    NotARotation {
        /// Largest absolute entry of `R^T R - I`.
        orthogonality: f64,
        /// The determinant of `R`.
        determinant: f64,
        /// The tolerance.
        tolerance: f64,
    },
    /// A number is NaN or infinite.
    #[error("{what} has a number that is not finite")]
    NotFinite {
        /// Which part.
        what: &'static str,
    },
    /// The last row of a 4x4 matrix is not `0 0 0 1`.
    #[error("the last row of the 4x4 matrix is {found:?}, expected [0, 0, 0, 1]")]
    LastRow {
        /// The row found.
        found: [f64; 4],
    },
}

/// A rigid transformation. Name variables by their spaces: `camera_from_object` maps a point in the
/// object's frame (metres) to the camera's frame.
///
/// ```
/// use sixfold_geometry::{Pose, Vec3};
/// let camera_from_object = Pose::exp(&[0.0, 0.0, 1.0, 0.0, 0.0, 0.3].into());
/// let point_in_camera = camera_from_object.transform_point(&Vec3::new(0.1, 0.0, 0.0));
/// let back = camera_from_object.inverse().transform_point(&point_in_camera);
/// assert!((back - Vec3::new(0.1, 0.0, 0.0)).norm() < 1e-12);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose(Isometry3<f64>);

impl Default for Pose {
    fn default() -> Self {
        Pose::identity()
    }
}

impl Pose {
    /// Largest deviation of `R^T R` from the identity that [`Pose::from_parts`] accepts: the published ground truth
    /// of LM-O contains rotations that deviate by 0.009.
    pub const ROTATION_TOLERANCE: f64 = 2e-2;

    /// The identity transformation.
    pub fn identity() -> Self {
        Pose(Isometry3::identity())
    }

    /// From a quaternion and a translation in metres.
    pub fn new(rotation: UnitQuaternion<f64>, translation: Vec3) -> Self {
        Pose(Isometry3::from_parts(Translation3::from(translation), rotation))
    }

    /// A pure translation, in metres.
    pub fn from_translation(translation: Vec3) -> Self {
        Pose::new(UnitQuaternion::identity(), translation)
    }

    /// From a rotation matrix and a translation in metres; a rotation with rounding errors is replaced by the
    /// nearest exact one.
    ///
    /// # Errors
    /// [`PoseError`] when a number is not finite or `rotation` is further from a rotation than
    /// [`Pose::ROTATION_TOLERANCE`].
    pub fn from_parts(rotation: &Mat3, translation: Vec3) -> Result<Self, PoseError> {
        if !rotation.iter().all(|v| v.is_finite()) {
            return Err(PoseError::NotFinite { what: "the rotation" });
        }
        if !translation.iter().all(|v| v.is_finite()) {
            return Err(PoseError::NotFinite { what: "the translation" });
        }
        let orthogonality = (rotation.transpose() * rotation - Mat3::identity()).amax();
        let determinant = rotation.determinant();
        if orthogonality > Self::ROTATION_TOLERANCE || determinant < 0.0 {
            return Err(PoseError::NotARotation {
                orthogonality,
                determinant,
                tolerance: Self::ROTATION_TOLERANCE,
            });
        }
        Ok(Pose::new(nearest_rotation(rotation), translation))
    }

    /// From a 4x4 matrix, translation in metres.
    ///
    /// # Errors
    /// As [`Pose::from_parts`], and [`PoseError::LastRow`].
    pub fn from_matrix(matrix: &Matrix4<f64>) -> Result<Self, PoseError> {
        let last = [matrix[(3, 0)], matrix[(3, 1)], matrix[(3, 2)], matrix[(3, 3)]];
        if last.iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(a, b)| !((a - b).abs() < 1e-6)) {
            return Err(PoseError::LastRow { found: last });
        }
        Pose::from_parts(
            &matrix.fixed_view::<3, 3>(0, 0).into_owned(),
            matrix.fixed_view::<3, 1>(0, 3).into_owned(),
        )
    }

    /// From the rows of a 4x4 matrix, as JSON files hold it.
    ///
    /// # Errors
    /// As [`Pose::from_matrix`].
    pub fn from_rows(rows: &[[f64; 4]; 4]) -> Result<Self, PoseError> {
        Pose::from_matrix(&Matrix4::from_fn(|i, k| rows[i][k]))
    }

    /// The 4x4 matrix.
    pub fn to_matrix(&self) -> Matrix4<f64> {
        self.0.to_homogeneous()
    }

    /// The 4x4 matrix by rows.
    pub fn rows(&self) -> [[f64; 4]; 4] {
        let m = self.to_matrix();
        std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)]))
    }

    /// The rotation as a quaternion.
    pub fn rotation(&self) -> UnitQuaternion<f64> {
        self.0.rotation
    }

    /// The rotation as a matrix.
    pub fn rotation_matrix(&self) -> Mat3 {
        self.0.rotation.to_rotation_matrix().into_inner()
    }

    /// The translation in metres.
    pub fn translation(&self) -> Vec3 {
        self.0.translation.vector
    }

    /// The same rotation with another translation.
    pub fn with_translation(&self, translation: Vec3) -> Self {
        Pose::new(self.0.rotation, translation)
    }

    /// The inverse transformation.
    pub fn inverse(&self) -> Self {
        Pose(self.0.inverse())
    }

    /// Maps a point.
    pub fn transform_point(&self, point: &Vec3) -> Vec3 {
        self.0.rotation * point + self.0.translation.vector
    }

    /// Maps a direction (rotation only).
    pub fn transform_direction(&self, direction: &Vec3) -> Vec3 {
        self.0.rotation * direction
    }

    /// The exponential map: twist `(v, w)` to pose, `v` in metres, `w` a rotation vector in radians.
    pub fn exp(twist: &Vector6<f64>) -> Self {
        let v = Vec3::new(twist[0], twist[1], twist[2]);
        let w = Vec3::new(twist[3], twist[4], twist[5]);
        let rotation = UnitQuaternion::from_scaled_axis(w);
        Pose::new(rotation, left_jacobian(&w) * v)
    }

    /// The logarithm, inverse of [`Pose::exp`] for rotation angles below pi.
    pub fn log(&self) -> Vector6<f64> {
        let w = self.0.rotation.scaled_axis();
        let v = left_jacobian_inverse(&w) * self.translation();
        Vector6::new(v.x, v.y, v.z, w.x, w.y, w.z)
    }

    /// The angle in radians between the rotations of two poses, in `0..=pi`.
    pub fn rotation_angle_to(&self, other: &Pose) -> f64 {
        self.0.rotation.angle_to(&other.0.rotation)
    }

    /// The distance in metres between the translations of two poses.
    pub fn distance_to(&self, other: &Pose) -> f64 {
        (self.translation() - other.translation()).norm()
    }
}

impl Mul for Pose {
    type Output = Pose;
    fn mul(self, rhs: Pose) -> Pose {
        Pose(self.0 * rhs.0)
    }
}

impl Mul for &Pose {
    type Output = Pose;
    fn mul(self, rhs: &Pose) -> Pose {
        Pose(self.0 * rhs.0)
    }
}

/// The rotation closest to `matrix` in the Frobenius norm (Umeyama 1991).
pub(crate) fn nearest_rotation(matrix: &Mat3) -> UnitQuaternion<f64> {
    let svd = matrix.svd(true, true);
    let (Some(u), Some(vt)) = (svd.u, svd.v_t) else {
        return UnitQuaternion::identity();
    };
    let mut r = u * vt;
    if r.determinant() < 0.0 {
        // The singular values are sorted in descending order: flip the smallest.
        let flip = Matrix3::from_diagonal(&Vec3::new(1.0, 1.0, -1.0));
        r = u * flip * vt;
    }
    let mut q = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(r));
    q.renormalize();
    q
}

fn left_jacobian(w: &Vec3) -> Mat3 {
    let theta = w.norm();
    let k = w.cross_matrix();
    if theta < 1e-5 {
        return Mat3::identity() + 0.5 * k + k * k / 6.0;
    }
    let t2 = theta * theta;
    Mat3::identity() + (1.0 - theta.cos()) / t2 * k + (theta - theta.sin()) / (t2 * theta) * k * k
}

fn left_jacobian_inverse(w: &Vec3) -> Mat3 {
    let theta = w.norm();
    let k = w.cross_matrix();
    if theta < 1e-5 {
        return Mat3::identity() - 0.5 * k + k * k / 12.0;
    }
    let half = 0.5 * theta;
    let c = (1.0 - half * half.cos() / half.sin()) / (theta * theta);
    Mat3::identity() - 0.5 * k + c * k * k
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn twist() -> impl Strategy<Value = Vector6<f64>> {
        (prop::array::uniform3(-2.0..2.0f64), prop::array::uniform3(-1.0..1.0f64), 0.0..3.1f64).prop_map(
            |(v, axis, angle)| {
                let axis = Vec3::from(axis).try_normalize(1e-6).unwrap_or(Vec3::x());
                let w = axis * angle;
                Vector6::new(v[0], v[1], v[2], w.x, w.y, w.z)
            },
        )
    }

    proptest! {
        #[test]
        fn log_after_exp_is_the_twist(t in twist()) {
            let back = Pose::exp(&t).log();
            prop_assert!((back - t).amax() < 1e-7, "{} {}", back, t);
        }

        #[test]
        fn composing_with_the_inverse_gives_the_identity(t in twist()) {
            let p = Pose::exp(&t);
            prop_assert!((p * p.inverse()).log().amax() < 1e-9);
        }

        #[test]
        fn composition_applies_in_sequence(a in twist(), b in twist(), x in prop::array::uniform3(-1.0..1.0f64)) {
            let (a, b, x) = (Pose::exp(&a), Pose::exp(&b), Vec3::from(x));
            let in_turn = a.transform_point(&b.transform_point(&x));
            prop_assert!(((a * b).transform_point(&x) - in_turn).norm() < 1e-12);
        }

        #[test]
        fn matrix_round_trip(t in twist()) {
            let p = Pose::exp(&t);
            let back = Pose::from_matrix(&p.to_matrix()).unwrap();
            let matrix = p.to_matrix();
            let rows = std::array::from_fn(|i| std::array::from_fn(|k| matrix[(i, k)]));
            prop_assert_eq!(Pose::from_rows(&rows).unwrap(), back);
            prop_assert!((p.inverse() * back).log().amax() < 1e-9);
        }
    }

    #[test]
    fn exp_of_a_screw_by_hand() {
        // A rotation by 90 degrees about z with v = (1, 0, 0) moves the origin to (2/pi, 2/pi, 0).
        let half_pi = std::f64::consts::FRAC_PI_2;
        let p = Pose::exp(&Vector6::new(1.0, 0.0, 0.0, 0.0, 0.0, half_pi));
        let expected = Vec3::new(1.0 / half_pi, 1.0 / half_pi, 0.0);
        assert!((p.translation() - expected).norm() < 1e-12);
        assert!((p.transform_direction(&Vec3::x()) - Vec3::y()).norm() < 1e-12);
    }

    #[test]
    fn a_mirror_and_a_scaled_matrix_are_no_rotations() {
        let mirror = Mat3::from_diagonal(&Vec3::new(1.0, 1.0, -1.0));
        assert!(matches!(Pose::from_parts(&mirror, Vec3::zeros()), Err(PoseError::NotARotation { .. })));
        assert!(matches!(
            Pose::from_parts(&(Mat3::identity() * 1.02), Vec3::zeros()),
            Err(PoseError::NotARotation { .. })
        ));
        let nan = Mat3::from_element(f64::NAN);
        assert_eq!(Pose::from_parts(&nan, Vec3::zeros()), Err(PoseError::NotFinite { what: "the rotation" }));
    }
}
