//! The solids of which families are composed. The numbers of vertices and faces depend only on the requested counts, so
//! that face `k` of one instance corresponds to face `k` of another. This gives exact correspondences between two
//! instances.

use std::f64::consts::TAU;

use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::{Mesh, MeshError};

/// A ring of `sides` vertices about z for each (radius, height) of a profile.
pub(crate) fn rings(profile: &[(f64, f64)], sides: usize) -> impl Iterator<Item = Vec3> {
    profile.iter().flat_map(move |&(radius, height)| {
        (0..sides).map(move |k| {
            let angle = TAU * k as f64 / sides as f64;
            Vec3::new(radius * angle.cos(), radius * angle.sin(), height)
        })
    })
}

/// Faces between two rings of vertices, given by their first vertices. The rings run to the right when seen from outside
/// with the first ring below. For each side, the face with an edge on the lower ring comes first, then the one with an
/// edge on the upper ring.
pub(crate) fn band(below: usize, above: usize, sides: usize) -> impl Iterator<Item = [[u32; 3]; 2]> {
    (0..sides).map(move |k| {
        let next = (k + 1) % sides;
        let [a, b, c, d] = [below + k, below + next, above + next, above + k].map(|i| i as u32);
        [[a, b, c], [a, c, d]]
    })
}

/// A builder of vertices and faces.
#[derive(Debug, Default)]
pub(super) struct Builder {
    vertices: Vec<Vec3>,
    faces: Vec<[u32; 3]>,
}

impl Builder {
    /// Number of faces so far.
    pub(crate) fn faces(&self) -> usize {
        self.faces.len()
    }

    /// The mesh with its vertices stretched along the axes.
    pub(crate) fn finish(self, scale: &Vec3) -> Result<Mesh, MeshError> {
        Mesh::new(self.vertices.iter().map(|v| v.component_mul(scale)).collect(), self.faces)
    }

    /// The shape that a profile of (radius, height) points sweeps about z, the solid on the profile's left hand (radius to
    /// the right, height up). Every segment of the profile is divided into `rows`.
    pub(crate) fn lathed(&mut self, profile: &[(f64, f64)], sides: usize, rows: usize) {
        let mut fine = vec![];
        for pair in profile.windows(2) {
            for k in 0..rows {
                let t = k as f64 / rows as f64;
                fine.push((pair[0].0 + t * (pair[1].0 - pair[0].0), pair[0].1 + t * (pair[1].1 - pair[0].1)));
            }
        }
        fine.extend(profile.last());
        let first = self.vertices.len();
        self.vertices.extend(rings(&fine, sides));
        for row in 0..fine.len().saturating_sub(1) {
            self.band(first + row * sides, first + (row + 1) * sides, sides);
        }
    }

    /// [`band`], added to the faces.
    fn band(&mut self, below: usize, above: usize, sides: usize) {
        // Faces on an axis have no area, but keep the face count constant.
        self.faces.extend(band(below, above, sides).flatten());
    }

    /// A box with these side lengths, centred at `pose`, every side divided into `cells` times `cells`.
    pub(crate) fn cuboid(&mut self, size: &Vec3, pose: &Pose, cells: usize) {
        for axis in 0..3 {
            for sign in [-1.0, 1.0] {
                let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                let first = self.vertices.len();
                for j in 0..=cells {
                    for i in 0..=cells {
                        let mut p = Vec3::zeros();
                        p[axis] = 0.5 * sign * size[axis];
                        p[u] = size[u] * (i as f64 / cells as f64 - 0.5);
                        p[v] = size[v] * (j as f64 / cells as f64 - 0.5);
                        self.vertices.push(pose.transform_point(&p));
                    }
                }
                for j in 0..cells {
                    for i in 0..cells {
                        let at = |i: usize, j: usize| (first + j * (cells + 1) + i) as u32;
                        let (a, b, c, d) = (at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1));
                        if sign > 0.0 {
                            self.faces.extend([[a, b, c], [a, c, d]]);
                        } else {
                            self.faces.extend([[a, c, b], [a, d, c]]);
                        }
                    }
                }
            }
        }
    }

    /// A bar of elliptic section along a path in the plane through `side` (a unit vector): half as wide as `radii.0` in
    /// the plane of the path and `radii.1` along `side`, closed at both ends.
    pub(crate) fn tube(&mut self, path: &[Vec3], side: &Vec3, radii: (f64, f64), sides: usize) {
        let first = self.vertices.len();
        let n = path.len();
        for i in 0..n {
            let along = path[(i + 1).min(n - 1)] - path[i.saturating_sub(1)];
            let across = side.cross(&along).try_normalize(1e-12).unwrap_or_else(Vec3::x);
            for k in 0..sides {
                let angle = TAU * k as f64 / sides as f64;
                self.vertices
                    .push(path[i] + across * (radii.0 * angle.cos()) + side * (radii.1 * angle.sin()));
            }
        }
        for i in 0..n - 1 {
            self.band(first + i * sides, first + (i + 1) * sides, sides);
        }
        for (ring, end, outwards) in [(first, path[0], false), (first + (n - 1) * sides, path[n - 1], true)] {
            let centre = self.vertices.len() as u32;
            self.vertices.push(end);
            for k in 0..sides {
                let (a, b) = ((ring + k) as u32, (ring + (k + 1) % sides) as u32);
                self.faces.push(if outwards { [centre, a, b] } else { [centre, b, a] });
            }
        }
    }
}
