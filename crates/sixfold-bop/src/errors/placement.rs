//! A pose as a matrix and a vector, the way a result file has it.

use sixfold_geometry::{Mat3, Pose, Vec3};

/// The placement of an object: `rotation * point + translation`, metres.
///
/// The official evaluation uses the nine numbers of a result file unchanged, even where rounding or a network's
/// arithmetic left them up to a hundredth away from a rotation. This changes an error by up to half a millimetre, so the
/// errors here use the numbers unchanged too.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    /// The rotation, or nearly one.
    pub rotation: Mat3,
    /// The translation in metres.
    pub translation: Vec3,
}

impl From<Pose> for Placement {
    fn from(pose: Pose) -> Self {
        Placement { rotation: pose.rotation_matrix(), translation: pose.translation() }
    }
}

impl From<&Pose> for Placement {
    fn from(pose: &Pose) -> Self {
        Placement::from(*pose)
    }
}

impl From<&Placement> for Placement {
    fn from(placement: &Placement) -> Self {
        *placement
    }
}

impl Placement {
    /// The symmetry of the object first, then this placement.
    pub(crate) fn after(&self, symmetry: &Placement) -> Placement {
        Placement {
            rotation: self.rotation * symmetry.rotation,
            translation: self.rotation * symmetry.translation + self.translation,
        }
    }

    pub(crate) fn distance_to(&self, other: &Placement) -> f64 {
        (self.translation - other.translation).norm()
    }
}
