//! The gripper: two parallel fingers on a palm, as boxes.

use serde::Serialize;
use sixfold_geometry::Vec3;
use sixfold_mesh::{Mesh, MeshError};

use crate::gripper_file::{GripperError, parse_gripper};

/// A parallel-jaw gripper. All parts are boxes along the axes of the gripper's frame (see the crate documentation).
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Gripper {
    /// Name of the gripper.
    pub name: String,
    /// Largest distance between the finger pads, metres.
    pub max_opening: f64,
    /// From the palm to the finger tips (along z), metres.
    pub finger_length: f64,
    /// Width of the pads (along y), metres.
    pub finger_width: f64,
    /// Thickness of a finger behind its pad (along x), metres.
    pub finger_thickness: f64,
    /// Size of the palm along x, metres.
    pub palm_width: f64,
    /// Size of the palm along y, metres.
    pub palm_depth: f64,
    /// Size of the palm along z, including parts mounted behind it that must not collide, metres.
    pub palm_height: f64,
    /// Largest force of one finger, newtons.
    pub force: f64,
    /// Coulomb friction coefficient of the pads on an object.
    pub friction: f64,
}

/// A part of the gripper: a box along the axes of the gripper's frame, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GripperBox {
    /// The corner with the smallest coordinates.
    pub low: Vec3,
    /// The corner with the largest coordinates.
    pub high: Vec3,
}

impl GripperBox {
    /// Whether a point of the gripper's frame is inside, or at most `margin` metres outside each side.
    pub fn contains(&self, p: &Vec3, margin: f64) -> bool {
        (0..3).all(|k| p[k] > self.low[k] - margin && p[k] < self.high[k] + margin)
    }

    /// The eight corners.
    pub fn corners(&self) -> [Vec3; 8] {
        std::array::from_fn(|i| {
            Vec3::from_fn(|k, _| if i >> k & 1 == 1 { self.high[k] } else { self.low[k] })
        })
    }

    /// The centre.
    pub fn centre(&self) -> Vec3 {
        (self.low + self.high) * 0.5
    }

    /// Half of each side's length.
    pub fn half_size(&self) -> Vec3 {
        (self.high - self.low) * 0.5
    }
}

impl Gripper {
    /// Whether a point of the gripper's frame is between the pads, `opening` metres apart.
    pub fn is_between_pads(&self, p: &Vec3, opening: f64) -> bool {
        p.x.abs() < 0.5 * opening
            && p.y.abs() < 0.5 * self.finger_width
            && p.z < 0.0
            && p.z > -self.finger_length
    }

    /// Names of the built-in grippers. Their sizes are round numbers of their class (strokes of 140 mm and of 85 mm), not
    /// measurements of a product.
    pub const BUILT_IN: [&'static str; 2] = ["jaws-140", "jaws-85"];

    /// A built-in gripper by name.
    pub fn built_in(name: &str) -> Option<Gripper> {
        let text = match name {
            "jaws-140" => include_str!("../grippers/jaws-140.json"),
            "jaws-85" => include_str!("../grippers/jaws-85.json"),
            _ => return None,
        };
        parse_gripper(text, name).ok()
    }

    /// Tests every field.
    ///
    /// # Errors
    /// [`GripperError::Field`] with `file`, the field, its value and the values allowed.
    pub fn check(&self, file: &str) -> Result<(), GripperError> {
        let sizes = [
            ("max_opening", self.max_opening, 0.001, 1.0),
            ("finger_length", self.finger_length, 0.005, 0.5),
            ("finger_width", self.finger_width, 0.001, 0.2),
            ("finger_thickness", self.finger_thickness, 0.001, 0.1),
            ("palm_width", self.palm_width, 0.005, 1.0),
            ("palm_depth", self.palm_depth, 0.005, 0.5),
            ("palm_height", self.palm_height, 0.005, 1.0),
        ];
        for (field, found, low, high) in sizes {
            if !(found >= low && found <= high) {
                let advice = if found > high && found / 1000.0 >= low && found / 1000.0 <= high {
                    format!(": sizes are in metres; if the file is in millimetres, write {}", found / 1000.0)
                } else {
                    String::new()
                };
                return Err(GripperError::Field {
                    file: file.to_owned(),
                    field,
                    found: found.to_string(),
                    expected: format!("{low} to {high} m{advice}"),
                });
            }
        }
        for (field, found, low, high, unit) in
            [("force", self.force, 0.1, 1000.0, " N"), ("friction", self.friction, 0.01, 2.0, "")]
        {
            if !(found >= low && found <= high) {
                return Err(GripperError::Field {
                    file: file.to_owned(),
                    field,
                    found: found.to_string(),
                    expected: format!("{low} to {high}{unit}"),
                });
            }
        }
        Ok(())
    }

    /// The two fingers and the palm with the pads `opening` metres apart, in the gripper's frame. The first finger is at negative
    /// x.
    pub fn boxes(&self, opening: f64) -> [GripperBox; 3] {
        let (half, width) = (opening / 2.0, self.finger_width / 2.0);
        let finger = |x0: f64, x1: f64| GripperBox {
            low: Vec3::new(x0, -width, -self.finger_length),
            high: Vec3::new(x1, width, 0.0),
        };
        let palm = GripperBox {
            low: Vec3::new(
                -self.palm_width / 2.0,
                -self.palm_depth / 2.0,
                -self.finger_length - self.palm_height,
            ),
            high: Vec3::new(self.palm_width / 2.0, self.palm_depth / 2.0, -self.finger_length),
        };
        [finger(-half - self.finger_thickness, -half), finger(half, half + self.finger_thickness), palm]
    }

    /// The gripper as a mesh in its own frame, for images. The palm is drawn at a third of its height, so that it hides less.
    ///
    /// # Errors
    /// [`MeshError::NotFinite`] for a gripper whose sizes are not finite, which [`Gripper::check`] refuses.
    pub fn mesh(&self, opening: f64) -> Result<Mesh, MeshError> {
        const QUADS: [[u32; 4]; 6] =
            [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let mut boxes = self.boxes(opening);
        boxes[2].low.z = boxes[2].high.z - self.palm_height / 3.0;
        let mut vertices = vec![];
        let mut faces = vec![];
        for part in boxes {
            let first = vertices.len() as u32;
            vertices.extend(part.corners());
            for q in QUADS {
                let q = q.map(|i| first + i);
                faces.extend([[q[0], q[1], q[2]], [q[0], q[2], q[3]]]);
            }
        }
        Mesh::new(vertices, faces)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn built_in_grippers_are_valid_and_know_their_names() {
        for name in Gripper::BUILT_IN {
            let gripper = Gripper::built_in(name).unwrap();
            assert_eq!(gripper.name, name);
            gripper.check(name).unwrap();
        }
        assert!(Gripper::built_in("hand").is_none());
    }

    #[test]
    fn the_pads_are_as_far_apart_as_the_opening_and_touch_the_palm() {
        let gripper = Gripper::built_in("jaws-85").unwrap();
        let [left, right, palm] = gripper.boxes(0.06);
        assert!((right.low.x - left.high.x - 0.06).abs() < 1e-12);
        assert_eq!((left.high.z, left.low.z), (0.0, palm.high.z));
        assert!(left.contains(&Vec3::new(-0.031, 0.0, -0.01), 0.0));
        assert!(!left.contains(&Vec3::new(-0.029, 0.0, -0.01), 0.0));
        assert!(left.contains(&Vec3::new(-0.029, 0.0, -0.01), 0.002));
        assert_eq!(gripper.mesh(0.06).unwrap().faces().len(), 36);
    }
}
