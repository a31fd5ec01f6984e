//! The symmetries of a family's members, which follow from their construction.

use std::f64::consts::PI;

use sixfold_geometry::nalgebra::{Unit, UnitQuaternion};
use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::{ContinuousSymmetry, ModelInfo};

use super::{Family, Member};

impl Member {
    /// Diameter, box and symmetries. A lathed solid that is stretched along one axis keeps only the rotation by
    /// 180 degrees.
    pub fn info(&self) -> ModelInfo {
        let mut info = ModelInfo::of_mesh(&self.mesh);
        let (low, high) = self.mesh.bounding_box();
        let (size, centre) = (high - low, (low + high) * 0.5);
        let half_turn = |axis: Vec3| {
            let rotation = UnitQuaternion::from_axis_angle(&Unit::new_normalize(axis), PI);
            Pose::new(rotation, centre - rotation * centre)
        };
        match self.family {
            Family::Can | Family::Cup | Family::Bottle | Family::Bowl if (size.x - size.y).abs() < 1e-6 => {
                let axis = ContinuousSymmetry { axis: Vec3::z(), offset: Vec3::zeros() };
                info.symmetries_continuous.push(axis);
            }
            Family::Can | Family::Cup | Family::Bottle | Family::Bowl => {
                info.symmetries_discrete.push(half_turn(Vec3::z()));
            }
            Family::Box => {
                info.symmetries_discrete.extend([Vec3::x(), Vec3::y(), Vec3::z()].map(half_turn));
            }
            Family::Mug | Family::Clamp | Family::Drill => {}
        }
        info
    }
}
