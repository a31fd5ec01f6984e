//! Simple closed shapes with known sizes, for tests and for trying a gripper: boxes and lathed shapes (solids of revolution). All
//! stand on `z = 0`, except the cuboid, which is centred on the origin.

use sixfold_geometry::Vec3;
use sixfold_mesh::{Mesh, MeshError};

use crate::profiles;
use crate::shapes::solids::{band, rings};

/// Sides of a lathed shape.
const SIDES: usize = 48;

/// A box with these side lengths in metres, centred on the origin.
///
/// # Errors
/// [`MeshError::NotFinite`].
pub fn cuboid(size: Vec3) -> Result<Mesh, MeshError> {
    const QUADS: [[u32; 4]; 6] =
        [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let vertices = (0..8)
        .map(|i| Vec3::from_fn(|k, _| if i >> k & 1 == 1 { 0.5 * size[k] } else { -0.5 * size[k] }))
        .collect();
    let faces = QUADS.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect();
    Mesh::new(vertices, faces)
}

/// The shape that a profile of (radius, height) points sweeps about the z axis, metres. The profile runs with the solid
/// on its left hand when seen with the radius to the right and the height up (a solid cylinder: from the axis at the
/// bottom outwards, up, and back to the axis).
///
/// # Errors
/// [`MeshError`] for numbers that are not finite or a profile without points.
pub(crate) fn lathed(profile: &[(f64, f64)]) -> Result<Mesh, MeshError> {
    let mut faces = vec![];
    for (row, pair) in profile.windows(2).enumerate() {
        for [lower, upper] in band(row * SIDES, (row + 1) * SIDES, SIDES) {
            // Points on the axis coincide: the triangle there has no area.
            if pair[0].0 > 0.0 {
                faces.push(lower);
            }
            if pair[1].0 > 0.0 {
                faces.push(upper);
            }
        }
    }
    Mesh::new(rings(profile, SIDES).collect(), faces)
}

/// A solid cylinder.
///
/// # Errors
/// [`MeshError`].
pub fn cylinder(radius: f64, height: f64) -> Result<Mesh, MeshError> {
    lathed(&profiles::cylinder(radius, height))
}

/// A cup without a handle: a cylinder with a wall and a floor of thickness `wall`.
///
/// # Errors
/// [`MeshError`].
pub fn cup(radius: f64, height: f64, wall: f64) -> Result<Mesh, MeshError> {
    lathed(&profiles::cup(radius, radius, height, wall, wall))
}

/// A bowl whose wall rises as a quarter of an ellipse, with a flat foot of a third of its radius.
///
/// # Errors
/// [`MeshError`].
pub fn bowl(radius: f64, height: f64, wall: f64) -> Result<Mesh, MeshError> {
    let arc = |r: f64, low: f64| {
        (0..=8).map(move |k| {
            let a = std::f64::consts::FRAC_PI_2 * f64::from(k) / 8.0;
            (r / 3.0 + r * 2.0 / 3.0 * a.sin(), low + (height - low) * (1.0 - a.cos()))
        })
    };
    let mut profile = vec![(0.0, 0.0)];
    profile.extend(arc(radius, 0.0));
    profile.extend(arc(radius - wall, wall).rev());
    profile.push((0.0, wall));
    lathed(&profile)
}

/// A bottle: a body, a shoulder and a neck of a third of its radius, solid.
///
/// # Errors
/// [`MeshError`].
pub fn bottle(radius: f64, height: f64) -> Result<Mesh, MeshError> {
    lathed(&[
        (0.0, 0.0),
        (radius, 0.0),
        (radius, 0.65 * height),
        (0.75 * radius, 0.72 * height),
        (0.4 * radius, 0.8 * height),
        (0.4 * radius, height),
        (0.0, height),
    ])
}

/// A cup with a handle in the direction of the x axis: a square ring with bars as thick as `handle`.
///
/// # Errors
/// [`MeshError`].
pub fn mug(radius: f64, height: f64, wall: f64, handle: f64) -> Result<Mesh, MeshError> {
    let cup = cup(radius, height, wall)?;
    let (reach, span) = (0.55 * radius, 0.6 * height);
    // Bars begin inside the wall, so that there is no gap.
    let start = radius - 0.5 * wall;
    let place = |mesh: Mesh, x: f64, z: f64| {
        mesh.transformed(&sixfold_geometry::Pose::from_translation(Vec3::new(x, 0.0, z)))
    };
    let bar = cuboid(Vec3::new(reach, handle, handle))?;
    let post = cuboid(Vec3::new(handle, handle, span))?;
    let (low, high) = (0.5 * (height - span) + 0.5 * handle, 0.5 * (height + span) - 0.5 * handle);
    Mesh::merged(&[
        cup,
        place(bar.clone(), start + 0.5 * reach, low),
        place(bar, start + 0.5 * reach, high),
        place(post, start + reach, 0.5 * height),
    ])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Signed volume: positive when the faces face outwards (divergence theorem).
    fn volume(mesh: &Mesh) -> f64 {
        (0..mesh.faces().len())
            .map(|f| {
                let [a, b, c] = mesh.triangle(f);
                a.dot(&b.cross(&c)) / 6.0
            })
            .sum()
    }

    #[test]
    fn shapes_are_closed_and_as_large_as_they_say() {
        let pi = std::f64::consts::PI;
        assert!((volume(&cuboid(Vec3::new(0.1, 0.2, 0.3)).unwrap()) - 0.006).abs() < 1e-9);
        let solid = volume(&cylinder(0.05, 0.1).unwrap());
        assert!((solid - pi * 0.0025 * 0.1).abs() < 0.01 * solid, "{solid}");
        let walls = volume(&cup(0.05, 0.1, 0.005).unwrap());
        let expected = solid - pi * 0.045f64.powi(2) * 0.095;
        assert!((walls - expected).abs() < 0.02 * expected, "{walls} {expected}");
        assert!(volume(&bowl(0.07, 0.05, 0.004).unwrap()) > 0.0);
        assert!(volume(&bottle(0.03, 0.2).unwrap()) > 0.0);
        let mug = mug(0.04, 0.09, 0.004, 0.008).unwrap();
        let (low, high) = mug.bounding_box();
        assert!(high.x > 0.06 && low.x > -0.041 && low.z == 0.0);
    }
}
