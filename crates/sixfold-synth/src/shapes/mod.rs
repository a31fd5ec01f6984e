//! Families of procedural objects: can, mug, cup, bottle, bowl, box, clamp and drill. DGCM-Net is trained only on them,
//! NOL on painted versions of them, and a simulated robot collects its first experience with them.
//!
//! The dissertation trains on scanned objects whose axes are stretched at random (section 6.2.2). Here the members of a
//! family also differ in taper, handle, neck and more, yet every face of one member has its counterpart on another
//! (`solids.rs`). Real objects are therefore all held out. [`toy`] makes objects that belong to no family.

pub(crate) mod solids;
mod sweep;
mod symmetry;
mod toy;

use std::f64::consts::{FRAC_PI_2, PI};

use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};
use sixfold_geometry::nalgebra::{UnitQuaternion, Vector3};
use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::{Mesh, MeshError};

use crate::profiles;
use solids::Builder;

pub use toy::toy;

/// Sides of lathed solids.
const SIDES: usize = 40;

/// A family of objects.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Family {
    /// A closed cylinder.
    Can,
    /// A cup with a handle.
    Mug,
    /// A tapered cup without one.
    Cup,
    /// A body, a shoulder and a neck.
    Bottle,
    /// A bowl, down to the depth of a plate.
    Bowl,
    /// A box.
    Box,
    /// A C-shaped clamp with its screw, lying flat.
    Clamp,
    /// A body with a chuck, a handle and a battery.
    Drill,
}

impl Family {
    /// All families.
    pub const ALL: [Family; 8] = [
        Family::Can,
        Family::Mug,
        Family::Cup,
        Family::Bottle,
        Family::Bowl,
        Family::Box,
        Family::Clamp,
        Family::Drill,
    ];

    /// Its name in lists and files.
    pub fn name(self) -> &'static str {
        match self {
            Family::Can => "can",
            Family::Mug => "mug",
            Family::Cup => "cup",
            Family::Bottle => "bottle",
            Family::Bowl => "bowl",
            Family::Box => "box",
            Family::Clamp => "clamp",
            Family::Drill => "drill",
        }
    }

    /// The ways in which its members come to rest on a table.
    pub fn rests(self) -> &'static [Rest] {
        match self {
            Family::Mug | Family::Cup | Family::Bowl | Family::Box => &[Rest::Upright],
            Family::Can | Family::Bottle => &[Rest::Upright, Rest::Lying],
            Family::Clamp => &[Rest::Upright],
            Family::Drill => &[Rest::Lying, Rest::LyingOther, Rest::Upright],
        }
    }

    /// The range of yaw angles over which views of it differ, radians: 0 for objects that look the same from all sides,
    /// a quarter turn for boxes (a further rotation gives another box: the ambiguity of section 6.3.2), half a turn for
    /// lying objects.
    pub fn yaw_range(self, rest: Rest) -> f64 {
        match (self, rest) {
            (Family::Can | Family::Bottle | Family::Cup | Family::Bowl, Rest::Upright) => 0.0,
            (Family::Box, _) => 0.25 * PI,
            (Family::Can, _) => FRAC_PI_2,
            _ => PI,
        }
    }
}

/// The resting orientation of an object on the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rest {
    /// Its z axis points up.
    Upright,
    /// Its y axis points up.
    Lying,
    /// Its y axis points down.
    LyingOther,
}

impl Rest {
    /// The rotation from the object's frame to the world's.
    pub fn rotation(self) -> Pose {
        let angle = match self {
            Rest::Upright => 0.0,
            Rest::Lying => FRAC_PI_2,
            Rest::LyingOther => -FRAC_PI_2,
        };
        let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), angle);
        Pose::new(turn, Vec3::zeros())
    }
}

/// A member of a family.
#[derive(Debug, Clone)]
pub struct Member {
    /// Its family.
    pub family: Family,
    /// Its surface, metres, in its own frame.
    pub mesh: Mesh,
    /// Names of its parts, each with the index of the first face after it.
    pub parts: Vec<(&'static str, usize)>,
}

impl Member {
    /// The part that a face belongs to.
    pub(crate) fn part_of_face(&self, face: usize) -> &'static str {
        self.parts.iter().find(|(_, end)| face < *end).map_or("body", |(name, _)| name)
    }

    /// The part nearest to a point of the object's frame, by the midpoints of its faces.
    pub fn part_at(&self, point: &Vec3) -> &'static str {
        let distance = |face: usize| {
            let [a, b, c] = self.mesh.triangle(face);
            ((a + b + c) / 3.0 - point).norm_squared()
        };
        (0..self.mesh.faces().len())
            .min_by(|a, b| distance(*a).total_cmp(&distance(*b)))
            .map_or("body", |face| self.part_of_face(face))
    }
}

/// Range of the factors by which the axes of a member are stretched: table 6.1.
pub(crate) const AXIS_SCALE: (f64, f64) = (0.8, 1.5);

/// Makes a random member of a family.
///
/// # Errors
/// [`MeshError`]: never with these numbers.
pub fn member(family: Family, random: &mut impl Rng) -> Result<Member, MeshError> {
    let mut between = |low: f64, high: f64| low + (high - low) * random.random::<f64>();
    let mut b = Builder::default();
    let mut parts = vec![];
    match family {
        Family::Can => {
            let (r, h, rim) = (between(0.025, 0.036), between(0.05, 0.11), between(0.0, 0.003));
            b.lathed(
                &[(0.0, 0.0), (r, 0.0), (r, h), (r - 0.003, h), (r - 0.003, h - rim), (0.0, h - rim)],
                SIDES,
                5,
            );
            parts.push(("body", b.faces()));
        }
        Family::Cup => {
            let (r, h) = (between(0.026, 0.036), between(0.05, 0.09));
            vessel(&mut b, r, h, between(0.65, 1.0), between(0.0025, 0.004));
            parts.push(("body", b.faces()));
        }
        Family::Mug => {
            let (r, h) = (between(0.026, 0.036), between(0.05, 0.085));
            vessel(&mut b, r, h, between(0.8, 1.0), between(0.003, 0.0045));
            parts.push(("body", b.faces()));
            let (reach, span) = (between(0.018, 0.032), h * between(0.5, 0.75));
            let (half_way, squareness) = (h * between(0.47, 0.58), between(0.5, 1.0));
            // A half superellipse of random fullness, beginning inside the wall.
            let path: Vec<Vec3> = (0..=14)
                .map(|k| {
                    let angle = PI * (f64::from(k) / 14.0 - 0.5);
                    let full = |v: f64| v.signum() * v.abs().powf(squareness);
                    let x = 0.93 * r + reach * full(angle.cos());
                    Vec3::new(x, 0.0, half_way + 0.5 * span * full(angle.sin()))
                })
                .collect();
            let thick = between(0.0035, 0.0055);
            b.tube(&path, &Vec3::y(), (thick, thick * between(1.0, 1.8)), 8);
            parts.push(("handle", b.faces()));
        }
        Family::Bottle => {
            let (r, h, neck) = (between(0.02, 0.032), between(0.11, 0.17), between(0.3, 0.55));
            let shoulder = between(0.55, 0.75);
            let (top, foot) = (shoulder + between(0.06, 0.15), between(0.85, 1.0));
            b.lathed(
                &[
                    (0.0, 0.0),
                    (foot * r, 0.0),
                    (r, shoulder * h),
                    (neck * r, top * h),
                    (neck * r, h),
                    (0.0, h),
                ],
                SIDES,
                5,
            );
            parts.push(("body", b.faces()));
        }
        Family::Bowl => {
            let r = between(0.045, 0.065);
            let (h, wall) = (r * between(0.3, 0.85), between(0.003, 0.0045));
            let foot = between(0.3, 0.6);
            let arc = |r: f64, low: f64| {
                (0..=8).map(move |k| {
                    let a = FRAC_PI_2 * f64::from(k) / 8.0;
                    (r * foot + r * (1.0 - foot) * a.sin(), low + (h - low) * (1.0 - a.cos()))
                })
            };
            let mut profile = vec![(0.0, 0.0)];
            profile.extend(arc(r, 0.0));
            profile.extend(arc(r - wall, wall).rev());
            profile.push((0.0, wall));
            b.lathed(&profile, SIDES, 2);
            parts.push(("body", b.faces()));
        }
        Family::Box => {
            let size = Vec3::new(between(0.03, 0.11), between(0.03, 0.11), between(0.025, 0.13));
            b.cuboid(&size, &Pose::from_translation(Vec3::z() * (0.5 * size.z)), 10);
            parts.push(("body", b.faces()));
        }
        Family::Clamp => {
            let (gap, depth) = (between(0.03, 0.07), between(0.035, 0.06));
            let (bar, thick) = (between(0.012, 0.02), between(0.012, 0.02));
            let at = |x: f64, y: f64| Pose::from_translation(Vec3::new(x, y, 0.5 * thick));
            b.cuboid(&Vec3::new(bar, gap + 2.0 * bar, thick), &at(0.0, 0.0), 6);
            for side in [-1.0, 1.0] {
                let y = side * 0.5 * (gap + bar);
                b.cuboid(&Vec3::new(depth, bar, thick), &at(0.5 * (depth + bar) - 0.002, y), 6);
            }
            parts.push(("frame", b.faces()));
            let (start, out) = (0.35 * gap, between(0.02, 0.04));
            let screw: Vec<Vec3> = (0..=6)
                .map(|k| {
                    let y = start + (0.5 * gap + bar + out - start) * f64::from(k) / 6.0;
                    Vec3::new(depth - 0.004, y, 0.5 * thick)
                })
                .collect();
            let radius = 0.3 * thick;
            b.tube(&screw, &Vec3::z(), (radius, radius), 8);
            let bar_at = at(depth - 0.004, 0.5 * gap + bar + out);
            b.cuboid(&Vec3::new(between(0.025, 0.045), 0.009, 0.8 * thick), &bar_at, 3);
            parts.push(("screw", b.faces()));
        }
        Family::Drill => {
            let (length, radius) = (between(0.09, 0.13), between(0.018, 0.024));
            let (grip, tilt) = (between(0.06, 0.085), between(-0.1, 0.3));
            let (width, thick) = (between(0.024, 0.032), between(0.02, 0.026));
            let (foot, base) = (between(0.04, 0.065), between(0.016, 0.028));
            let top = grip + base + radius;
            let body: Vec<Vec3> =
                (0..=6).map(|k| Vec3::new(-0.45 * length + length * f64::from(k) / 6.0, 0.0, top)).collect();
            b.tube(&body, &Vec3::y(), (radius, radius), 16);
            let chuck: Vec<Vec3> =
                (0..=3).map(|k| Vec3::new(0.5 * length + 0.035 * f64::from(k) / 3.0, 0.0, top)).collect();
            b.tube(&chuck, &Vec3::y(), (0.5 * radius, 0.5 * radius), 12);
            parts.push(("body", b.faces()));
            let lean = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), tilt);
            let place = Pose::new(lean, Vec3::new(-0.2 * length, 0.0, base + 0.5 * grip));
            b.cuboid(&Vec3::new(width, thick, grip + 0.5 * radius), &place, 6);
            parts.push(("handle", b.faces()));
            let below = Vec3::new(-0.2 * length - 0.5 * grip * tilt.sin(), 0.0, 0.5 * base);
            b.cuboid(&Vec3::new(foot, 1.5 * thick, base), &Pose::from_translation(below), 6);
            parts.push(("battery", b.faces()));
        }
    }
    let (low, high) = AXIS_SCALE;
    let mut scale = Vec3::from_fn(|_, _| between(low, high));
    let round = matches!(family, Family::Can | Family::Cup | Family::Mug | Family::Bottle | Family::Bowl);
    if round && between(0.0, 1.0) < 0.6 {
        scale.y = scale.x;
    } else if round {
        scale.y = (scale.x * between(0.8, 1.25)).clamp(low, high);
    }
    Ok(Member { family, mesh: b.finish(&scale)?, parts })
}

/// A cup whose foot is narrower than the rim by `taper`.
fn vessel(b: &mut Builder, r: f64, h: f64, taper: f64, wall: f64) {
    let floor = 1.5 * wall;
    b.lathed(&profiles::cup(taper * r, r, h, wall, floor), SIDES, 6);
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn volume(mesh: &Mesh) -> f64 {
        (0..mesh.faces().len())
            .map(|f| {
                let [a, b, c] = mesh.triangle(f);
                a.dot(&b.cross(&c)) / 6.0
            })
            .sum()
    }

    #[test]
    fn members_of_a_family_have_the_same_faces_and_look_outwards() {
        for family in Family::ALL {
            let draw = |seed| member(family, &mut ChaCha8Rng::seed_from_u64(seed)).unwrap();
            let (a, b) = (draw(1), draw(2));
            assert_eq!(a.mesh.faces(), b.mesh.faces(), "{family:?}");
            assert_ne!(a.mesh.vertices(), b.mesh.vertices());
            assert_eq!(a.parts, b.parts);
            assert_eq!(a.parts.last().map(|p| p.1), Some(a.mesh.faces().len()));
            for m in [a, b] {
                let (low, high) = m.mesh.bounding_box();
                let size = high - low;
                assert!(size.max() < 0.3 && size.min() > 0.008, "{family:?} {size:?}");
                // Every part is closed and its faces face outwards.
                let mut start = 0;
                for (name, end) in &m.parts {
                    let part = Mesh::new(m.mesh.vertices().to_vec(), m.mesh.faces()[start..*end].to_vec());
                    assert!(volume(&part.unwrap()) > 1e-6, "{family:?} {name}");
                    start = *end;
                }
            }
        }
    }

    #[test]
    fn parts_are_found_by_their_place() {
        let mug = member(Family::Mug, &mut ChaCha8Rng::seed_from_u64(3)).unwrap();
        let (low, high) = mug.mesh.bounding_box();
        assert_eq!(mug.part_at(&Vec3::new(high.x, 0.0, 0.5 * high.z)), "handle");
        assert_eq!(mug.part_at(&Vec3::new(low.x, 0.0, 0.5 * high.z)), "body");
        assert_eq!(Rest::Lying.rotation().transform_direction(&Vec3::y()).z.round(), 1.0);
    }
}
