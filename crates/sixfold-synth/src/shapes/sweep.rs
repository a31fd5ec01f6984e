//! The one kind of solid for toys: a section (ellipse to rectangle) of varying size along a straight or bent path.
//! Ellipsoids, superquadrics (Barr 1981, "Superquadrics and angle-preserving transformations"), bars, cones and lathed
//! shapes differ only in their profiles.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use sixfold_geometry::Vec3;
use sixfold_mesh::{Mesh, MeshError};

/// A solid of length 1 that starts at the origin along z and bends in the xz plane.
#[derive(Debug, Clone)]
pub(super) struct Sweep {
    /// (fraction of the path, fraction of the radii), from the beginning to the end.
    pub profile: Vec<(f64, f64)>,
    /// Largest half widths along x and y, as fractions of the length.
    pub radii: (f64, f64),
    /// Exponent of the section: 1 an ellipse, towards 0 a rectangle, 2 a rhombus.
    pub section: f64,
    /// Angle by which the path bends towards x, radians.
    pub bend: f64,
}

impl Sweep {
    /// The profile of a superquadric: `exponent` 1 an ellipsoid, towards 0 a cylinder, 2 a double cone.
    pub(crate) fn round_profile(exponent: f64, rows: usize) -> Vec<(f64, f64)> {
        (0..=rows)
            .map(|k| {
                let angle = -FRAC_PI_2 + PI * (k as f64 + 0.7) / (rows as f64 + 1.4);
                (0.5 + 0.5 * power(angle.sin(), exponent), power(angle.cos(), exponent))
            })
            .collect()
    }

    /// A profile through some (fraction of the path, fraction of the radii) points.
    pub(crate) fn profile_through(points: &[(f64, f64)], rows: usize) -> Vec<(f64, f64)> {
        (0..=rows)
            .map(|k| {
                let s = k as f64 / rows as f64;
                let radius = points.windows(2).find(|pair| s <= pair[1].0).map_or(0.05, |pair| {
                    let t = (s - pair[0].0) / (pair[1].0 - pair[0].0).max(1e-9);
                    // Zero slope at both ends of each segment, for smooth profiles.
                    let t = t * t * (3.0 - 2.0 * t);
                    pair[0].1 + t * (pair[1].1 - pair[0].1)
                });
                (s, radius)
            })
            .collect()
    }

    /// The path's point, and the direction perpendicular to the path in the plane of the bend.
    fn at(&self, s: f64) -> (Vec3, Vec3) {
        let angle = self.bend * s;
        let point = if self.bend.abs() < 1e-6 {
            Vec3::new(0.0, 0.0, s)
        } else {
            Vec3::new(1.0 - angle.cos(), 0.0, angle.sin()) / self.bend
        };
        (point, Vec3::new(angle.cos(), 0.0, -angle.sin()))
    }

    /// Its closed surface; the faces face outwards.
    pub(crate) fn mesh(&self, sides: usize) -> Result<Mesh, MeshError> {
        let mut vertices = Vec::with_capacity(self.profile.len() * sides + 2);
        for &(s, radius) in &self.profile {
            let (point, across) = self.at(s);
            for k in 0..sides {
                let angle = TAU * k as f64 / sides as f64;
                let (x, y) = (power(angle.cos(), self.section), power(angle.sin(), self.section));
                vertices.push(
                    point + across * (self.radii.0 * radius * x) + Vec3::y() * (self.radii.1 * radius * y),
                );
            }
        }
        let mut faces = vec![];
        let at = |row: usize, k: usize| (row * sides + k % sides) as u32;
        for row in 0..self.profile.len().saturating_sub(1) {
            for k in 0..sides {
                let [a, b, c, d] = [at(row, k), at(row, k + 1), at(row + 1, k + 1), at(row + 1, k)];
                faces.extend([[a, b, c], [a, c, d]]);
            }
        }
        let last = self.profile.len().saturating_sub(1);
        for (row, s) in [(0, 0.0), (last, 1.0)] {
            let tip = vertices.len() as u32;
            vertices.push(self.at(s).0);
            for k in 0..sides {
                let (a, b) = (at(row, k), at(row, k + 1));
                faces.push(if s > 0.5 { [tip, a, b] } else { [tip, b, a] });
            }
        }
        Mesh::new(vertices, faces)
    }
}

/// A power that keeps the sign.
fn power(value: f64, exponent: f64) -> f64 {
    value.signum() * value.abs().powf(exponent)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn volume(mesh: &Mesh) -> f64 {
        (0..mesh.faces().len())
            .map(|f| {
                let [a, b, c] = mesh.triangle(f);
                a.dot(&b.cross(&c)) / 6.0
            })
            .sum()
    }

    #[test]
    fn a_ball_a_bar_and_a_bent_bar_have_their_volumes() {
        let ball =
            Sweep { profile: Sweep::round_profile(1.0, 30), radii: (0.5, 0.5), section: 1.0, bend: 0.0 };
        assert!((volume(&ball.mesh(40).unwrap()) - PI / 6.0).abs() < 0.01);
        let profile = Sweep::profile_through(&[(0.0, 1.0), (1.0, 1.0)], 20);
        let bar = Sweep { profile, radii: (0.1, 0.2), section: 1.0, bend: 0.0 };
        let expected = PI * 0.02;
        assert!((volume(&bar.mesh(40).unwrap()) - expected).abs() < 0.03 * expected);
        // Pappus' theorem: the volume is the section's area times the path length of its centre.
        let bent = Sweep { bend: 1.5, ..bar };
        assert!((volume(&bent.mesh(40).unwrap()) - expected).abs() < 0.03 * expected);
    }
}
