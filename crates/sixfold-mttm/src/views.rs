//! Viewing directions of templates: the vertices of a subdivided icosahedron (dissertation, section 5.3.1, after Hinterstoisser et
//! al. 2012), and in-plane rotations.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use sixfold_geometry::nalgebra::{Rotation3, UnitQuaternion};
use sixfold_geometry::{Mat3, Vec3};

/// Directions from which an object is seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ViewCoverage {
    /// From above, the camera held upright within 45 degrees: 305 directions with 7 in-plane rotations, 2135 templates
    /// (dissertation: 301 and 2107). For objects that stand on a table with their z axis up.
    Above,
    /// From all directions and with any roll of the camera: 642 directions with 24 in-plane rotations.
    Around,
}

impl ViewCoverage {
    /// In-plane rotations, radians.
    pub fn turns(self) -> Vec<f64> {
        let (count, first) = match self {
            ViewCoverage::Above => (7, -45.0),
            ViewCoverage::Around => (24, -180.0),
        };
        (0..count).map(|k| (first + 15.0 * f64::from(k)).to_radians()).collect()
    }

    /// Its name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            ViewCoverage::Above => "above",
            ViewCoverage::Around => "around",
        }
    }
}

/// Unit vectors from the object to the camera: the vertices of an icosahedron subdivided three times, all 642 or the 305 above the
/// horizon (the dissertation has 301 and does not give the orientation of its icosahedron).
pub fn view_directions(coverage: ViewCoverage) -> Vec<Vec3> {
    let phi = (1.0 + 5f64.sqrt()) / 2.0;
    let mut corners: Vec<Vec3> = vec![];
    for (a, b) in [(1.0, phi), (-1.0, phi), (1.0, -phi), (-1.0, -phi)] {
        corners.push(Vec3::new(0.0, a, b).normalize());
        corners.push(Vec3::new(a, b, 0.0).normalize());
        corners.push(Vec3::new(b, 0.0, a).normalize());
    }
    // Faces: triples of neighbouring vertices (an edge is 63.4 degrees long).
    let near = |a: &Vec3, b: &Vec3| a.dot(b) > 0.4;
    let mut faces = vec![];
    for i in 0..12 {
        for j in i + 1..12 {
            for k in j + 1..12 {
                if near(&corners[i], &corners[j])
                    && near(&corners[j], &corners[k])
                    && near(&corners[i], &corners[k])
                {
                    faces.push([i, j, k]);
                }
            }
        }
    }
    for _ in 0..3 {
        let mut midpoints: BTreeMap<(usize, usize), usize> = BTreeMap::new();
        let mut finer = Vec::with_capacity(4 * faces.len());
        for [a, b, c] in faces {
            let mut midpoint = |i: usize, j: usize| {
                *midpoints.entry((i.min(j), i.max(j))).or_insert_with(|| {
                    corners.push((corners[i] + corners[j]).normalize());
                    corners.len() - 1
                })
            };
            let (ab, bc, ca) = (midpoint(a, b), midpoint(b, c), midpoint(c, a));
            finer.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
        }
        faces = finer;
    }
    match coverage {
        ViewCoverage::Above => corners.into_iter().filter(|d| d.z > 1e-9).collect(),
        ViewCoverage::Around => corners,
    }
}

/// The rotation view from object of a camera that looks along `-direction`, the object's z axis up in the image (its y
/// axis, where the view is along z).
pub fn view_rotation(direction: &Vec3) -> UnitQuaternion<f64> {
    let forward = -direction.normalize();
    let up = if forward.z.abs() > 0.999 { Vec3::y() } else { Vec3::z() };
    let down = -(up - forward * up.dot(&forward)).normalize();
    let right = down.cross(&forward);
    let object_from_view = Mat3::from_columns(&[right, down, forward]);
    // Orthonormal by construction.
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(object_from_view.transpose()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn views_are_dense_and_as_many_as_said() {
        assert_eq!(view_directions(ViewCoverage::Around).len(), 642);
        let above = view_directions(ViewCoverage::Above);
        assert_eq!(above.len() * ViewCoverage::Above.turns().len(), 2135);
        // No direction from above is further than 6 degrees from one of them.
        for d in sixfold_geometry::sphere_directions(500).iter().filter(|d| d.z > 0.1) {
            let best = above.iter().map(|v| v.dot(d)).fold(-1.0, f64::max);
            assert!(best > 6f64.to_radians().cos(), "{d:?} {best}");
        }
    }

    #[test]
    fn the_object_is_upright_in_the_view() {
        for d in view_directions(ViewCoverage::Around) {
            let r = view_rotation(&d);
            // The camera is in the given direction, on the view's negative z axis.
            assert!((r * d + Vec3::z()).norm() < 1e-9);
            if d.z.abs() < 0.99 {
                let up = r * Vec3::z();
                assert!(up.x.abs() < 1e-9 && up.y < 0.0, "{up:?}");
            }
        }
    }
}
