//! Data of an object for a network: the normalisation of its coordinates and its symmetries.

use serde::{Deserialize, Serialize};
use sixfold_geometry::{Camera, KdTree, Pose, Vec2, Vec3};
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_render::BoundingBoxScale;

/// One object of a model, as stored in the weight file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ObjectEntry {
    /// Id in the dataset.
    pub id: u32,
    /// Diameter in metres.
    pub diameter: f64,
    /// Centre of the coordinates, metres.
    pub centre: [f64; 3],
    /// Divisor of the coordinates, metres per axis.
    pub half_size: [f64; 3],
    /// Outlier thresholds on the expected error that are tried, the dissertation's theta_o.
    pub thresholds: Vec<f32>,
    /// Systematic error of aligned poses.
    #[serde(default)]
    pub correction: Correction,
}

/// Smallest and largest diameters and sides, metres.
const SMALLEST: f64 = 0.001;
const LARGEST: f64 = 10.0;
/// Maximum number of outlier thresholds of an object: each of them is tried.
const MAX_THRESHOLDS: usize = 16;

/// The bounding boxes of mesh and model may differ by this fraction of the diameter: BOP's meshes for evaluation are simplified.
const SAME_BOX: f64 = 0.05;

/// A mesh that is not the one of the training.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "its box measures {} mm, that of object {object_id} in the model {} mm, and corners differ by {:.1} mm: another object, \
     unit or origin? Give the mesh that the model was trained on",
    millimetres(found),
    millimetres(expected),
    1000.0 * off
)]
pub struct OtherMesh {
    /// The object that the mesh should show.
    pub object_id: u32,
    /// Sides of the bounding box in the training, metres.
    pub expected: [f64; 3],
    /// Sides of the mesh's bounding box, metres.
    pub found: [f64; 3],
    /// Largest difference of a corner's coordinate, metres.
    pub off: f64,
}

fn millimetres(sides: &[f64; 3]) -> String {
    sides.map(|side| format!("{:.1}", 1000.0 * side)).join(" x ")
}

impl ObjectEntry {
    /// The entry of an object with the thresholds of the BOP entries (section 3.4.5).
    pub fn new(id: u32, info: &ModelInfo, scale: &BoundingBoxScale) -> Self {
        Self {
            id,
            diameter: info.diameter,
            centre: scale.centre.into(),
            half_size: scale.half_size.into(),
            thresholds: BOP_THRESHOLDS.to_vec(),
            correction: Correction::default(),
        }
    }

    /// Tests that its numbers are valid for an object; otherwise returns the invalid field, the expected values and the value
    /// found.
    ///
    /// # Errors
    /// Field, expected, found.
    pub fn check(&self) -> Result<(), (&'static str, &'static str, String)> {
        let length = |v: &f64| *v > 0.0 && *v <= LARGEST;
        if !(self.diameter >= SMALLEST && self.diameter <= LARGEST) {
            return Err(("objects.diameter", "metres from 0.001 to 10", self.diameter.to_string()));
        }
        if !self.half_size.iter().all(length) {
            return Err((
                "objects.half_size",
                "three lengths above 0 up to 10 m",
                format!("{:?}", self.half_size),
            ));
        }
        if !self.centre.iter().all(|c| c.abs() <= 1000.0) {
            return Err(("objects.centre", "coordinates within 1000 m", format!("{:?}", self.centre)));
        }
        let count = self.thresholds.len();
        if !(1..=MAX_THRESHOLDS).contains(&count) {
            return Err(("objects.thresholds", "1 to 16 thresholds", format!("{count} thresholds")));
        }
        if !self.thresholds.iter().all(|t| *t > 0.0 && *t <= 1.0) {
            return Err(("objects.thresholds", "numbers above 0 up to 1", format!("{:?}", self.thresholds)));
        }
        let Correction { shift, depth } = self.correction;
        if !(shift.iter().all(|s| s.abs() <= 10_000.0) && depth.abs() < 1.0) {
            let expected = "a shift within 10000 pixels, a depth above -1 and below 1";
            return Err(("objects.correction", expected, format!("{shift:?} and {depth}")));
        }
        Ok(())
    }

    /// Returns an error unless the mesh is that of the object: with the same size and position in its frame.
    ///
    /// # Errors
    /// [`OtherMesh`].
    pub fn check_mesh(&self, mesh: &Mesh) -> Result<(), OtherMesh> {
        let scale = self.scale();
        let (low, high) = mesh.bounding_box();
        let low_off = low - (scale.centre - scale.half_size);
        let high_off = high - (scale.centre + scale.half_size);
        let off = low_off.amax().max(high_off.amax());
        if off <= SAME_BOX * self.diameter {
            return Ok(());
        }
        let expected = (2.0 * scale.half_size).into();
        Err(OtherMesh { object_id: self.id, expected, found: (high - low).into(), off })
    }

    /// How coordinates are normalised.
    pub fn scale(&self) -> BoundingBoxScale {
        BoundingBoxScale { centre: Vec3::from(self.centre), half_size: Vec3::from(self.half_size) }
    }
}

/// Mean error of aligned poses on the photographs of the training. Causes are annotations made in another sensor's image, an error
/// of the principal point, or a mesh that is slightly too large.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Correction {
    /// Error of the object's position in the image, pixels.
    pub shift: [f64; 2],
    /// Error of its distance, as a fraction of the distance.
    pub depth: f64,
}

impl Correction {
    /// The corrected pose; the rotation is unchanged.
    pub fn apply(&self, camera: &Camera, camera_from_object: &Pose) -> Pose {
        let t = camera_from_object.translation();
        let Some(pixel) = camera.project(&t) else { return *camera_from_object };
        let depth = t.z * (1.0 - self.depth);
        let moved = camera.unproject(&(pixel - Vec2::from(self.shift)), depth);
        Pose::new(camera_from_object.rotation(), moved)
    }
}

/// Outlier thresholds of the entries to the BOP challenge (section 3.4.5).
pub(crate) const BOP_THRESHOLDS: [f32; 3] = [0.15, 0.25, 0.35];

/// A symmetry as a map of normalised coordinates: `linear * n + offset`.
///
/// The transformation is applied in metres and normalised again, because the axes have different scales; multiplying
/// normalised coordinates by the rotation, as the author's code does, is right only for axes of equal scale or half
/// turns about the centre.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SymmetryMap {
    /// Row-major.
    pub linear: [[f32; 3]; 3],
    /// Added.
    pub offset: [f32; 3],
}

impl SymmetryMap {
    /// The map of a transformation under which the object looks the same.
    pub fn new(object_from_object: &Pose, scale: &BoundingBoxScale) -> Self {
        let map = |n: Vec3| scale.normalise(&object_from_object.transform_point(&scale.restore(&n)));
        let offset = map(Vec3::zeros());
        let columns = [Vec3::x(), Vec3::y(), Vec3::z()].map(|axis| map(axis) - offset);
        Self {
            linear: std::array::from_fn(|row| std::array::from_fn(|column| columns[column][row] as f32)),
            offset: std::array::from_fn(|row| offset[row] as f32),
        }
    }

    /// The transformed coordinates.
    pub fn apply(&self, n: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|row| {
            let line = self.linear[row];
            line[0] * n[0] + line[1] * n[1] + line[2] * n[2] + self.offset[row]
        })
    }

    /// The identity and all discrete symmetries of an object. Continuous ones are removed from the targets instead.
    pub fn pool(info: &ModelInfo, scale: &BoundingBoxScale) -> Vec<Self> {
        let discrete = ModelInfo { symmetries_continuous: Vec::new(), ..info.clone() };
        discrete.symmetry_poses(0.01).iter().map(|pose| Self::new(pose, scale)).collect()
    }
}

/// Mean distance in metres from the moved surface to the surface itself, over 500 of its points: near zero if the object has the
/// symmetry.
pub fn symmetry_deviation(mesh: &Mesh, object_from_object: &Pose) -> f64 {
    let surface = mesh.sample_surface(5000, 0).points;
    let tree = KdTree::new(&surface);
    let probes = surface.iter().step_by(10);
    let distances =
        probes.filter_map(|p| tree.nearest(&object_from_object.transform_point(p))).map(|n| n.distance);
    let (sum, count) = distances.fold((0.0, 0usize), |(sum, n), d| (sum + d, n + 1));
    sum / count.max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_correction_moves_the_object_in_the_image_and_along_its_view() {
        let camera = Camera::new(500.0, 520.0, 320.0, 240.0, 640, 480).unwrap();
        let pose = Pose::exp(&[0.1, -0.05, 0.9, 0.4, 0.2, -0.1].into());
        let correction = Correction { shift: [1.0, -2.0], depth: 0.01 };
        let moved = correction.apply(&camera, &pose);
        let (before, after) =
            (camera.project(&pose.translation()).unwrap(), camera.project(&moved.translation()).unwrap());
        assert!((before - after - Vec2::new(1.0, -2.0)).norm() < 1e-9);
        assert!((moved.translation().z - 0.99 * pose.translation().z).abs() < 1e-12);
        assert_eq!(moved.rotation(), pose.rotation());
        let none = Correction::default().apply(&camera, &pose);
        assert!((none.translation() - pose.translation()).norm() < 1e-12);
        // Behind the camera there is no correction.
        let behind = Pose::from_translation(Vec3::new(0.0, 0.0, -1.0));
        assert_eq!(correction.apply(&camera, &behind), behind);
    }

    #[test]
    fn a_mesh_of_another_size_or_place_is_refused() {
        let corners = [Vec3::new(0.0, 0.0, 0.0), Vec3::new(0.2, 0.0, 0.0), Vec3::new(0.0, 0.1, 0.05)];
        let mesh = Mesh::new(corners.to_vec(), vec![[0, 1, 2]]).unwrap();
        let info = ModelInfo::of_mesh(&mesh);
        let (low, high) = mesh.bounding_box();
        let entry = ObjectEntry::new(7, &info, &BoundingBoxScale::of_corners(&low, &high));
        assert_eq!(entry.check_mesh(&mesh), Ok(()));
        assert_eq!(entry.check_mesh(&mesh.scaled(1.02)), Ok(()));
        let error = entry.check_mesh(&mesh.scaled(1000.0)).unwrap_err().to_string();
        assert!(error.contains("object 7") && error.contains("200.0 x 100.0 x 50.0 mm"), "{error}");
        let moved = mesh.transformed(&Pose::from_translation(Vec3::new(0.0, 0.03, 0.0)));
        assert!((entry.check_mesh(&moved).unwrap_err().off - 0.03).abs() < 1e-9);
    }

    #[test]
    fn a_rotation_by_90_degrees_of_a_box_with_unequal_sides_is_applied_in_metres() {
        let scale =
            BoundingBoxScale { centre: Vec3::new(0.01, -0.02, 0.0), half_size: Vec3::new(0.1, 0.2, 0.05) };
        let turn = Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, std::f64::consts::FRAC_PI_2].into());
        let point = Vec3::new(0.03, 0.05, -0.01);
        let map = SymmetryMap::new(&turn, &scale);
        let normalised = scale.normalise(&point);
        let found = map.apply([normalised.x as f32, normalised.y as f32, normalised.z as f32]);
        let expected = scale.normalise(&turn.transform_point(&point));
        for (f, e) in found.iter().zip(expected.iter()) {
            assert!((f64::from(*f) - e).abs() < 1e-5, "{found:?} {expected:?}");
        }
    }
}
