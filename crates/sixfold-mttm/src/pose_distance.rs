//! How different two poses of an object are to a depth camera (dissertation, equations 5.1 and 5.2): poses that look the same have
//! distance 0, so symmetric objects need no special treatment.

use sixfold_geometry::nalgebra::UnitQuaternion;

use crate::template::{SIDE, Template};

/// Mean differences of depth below this count as 0, metres.
pub(crate) const LOWER: f64 = 0.1;
/// Mean differences of depth above this count as the maximum, metres.
pub(crate) const UPPER: f64 = 0.5;

/// Equation 5.1 for two views of one object from the same distance: the mean difference of depth over the pixels that show it in at
/// least one of them, where the background has depth 0; 0 below [`LOWER`], 1 above [`UPPER`].
pub(crate) fn appearance_distance(a: &Template, b: &Template) -> f64 {
    let (mut sum, mut pixels) = (0.0, 0usize);
    for y in 0..SIDE {
        for x in 0..SIDE {
            let depth = |t: &Template| t.relative_depth(x, y).map(|z| t.distance + z);
            match (depth(a), depth(b)) {
                (None, None) => continue,
                (p, q) => sum += (p.unwrap_or(0.0) - q.unwrap_or(0.0)).abs(),
            }
            pixels += 1;
        }
    }
    match sum / pixels.max(1) as f64 {
        mean if mean < LOWER => 0.0,
        mean if mean > UPPER => 1.0,
        mean => mean,
    }
}

/// Equation 5.2: the angle between two rotations (half of it, as a quaternion's product gives it), radians, times their
/// [`appearance_distance`].
pub(crate) fn pose_distance(
    a: (&UnitQuaternion<f64>, &Template),
    b: (&UnitQuaternion<f64>, &Template),
) -> f64 {
    let dot = a.0.coords.dot(&b.0.coords).abs().min(1.0);
    dot.acos() * appearance_distance(a.1, b.1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::from_mesh::draw_rotated;
    use sixfold_geometry::Vec3;
    use sixfold_mesh::Mesh;

    /// A prism with `sides` sides, 12 cm high.
    fn prism(sides: u32, radius: impl Fn(u32) -> f64) -> Mesh {
        let ring = |z: f64| {
            (0..sides)
                .map(|k| {
                    let (s, c) = (std::f64::consts::TAU * f64::from(k) / f64::from(sides)).sin_cos();
                    Vec3::new(radius(k) * c, radius(k) * s, z)
                })
                .collect::<Vec<_>>()
        };
        let mut vertices = ring(0.0);
        vertices.extend(ring(0.12));
        let faces = (0..sides)
            .flat_map(|k| {
                let n = (k + 1) % sides;
                [[k, n, sides + n], [k, sides + n, sides + k]]
            })
            .chain((1..sides - 1).flat_map(|k| [[0, k + 1, k], [sides, sides + k, sides + k + 1]]))
            .collect();
        Mesh::new(vertices, faces).unwrap()
    }

    fn distance(mesh: &Mesh, turn: f64) -> f64 {
        let upright = crate::views::view_rotation(&Vec3::new(1.0, 0.0, 0.3));
        let rotated = upright * UnitQuaternion::from_axis_angle(&Vec3::z_axis(), turn);
        let size = 1.2 * mesh.diameter();
        let [a, b] = [upright, rotated].map(|r| draw_rotated(mesh, r, size, 0.8).unwrap());
        pose_distance((&upright, &a), (&rotated, &b))
    }

    #[test]
    fn an_invisible_rotation_is_no_distance() {
        let round = prism(48, |_| 0.04);
        assert_eq!(distance(&round, 1.0), 0.0);
        // A blade: from its narrow side it covers half as many pixels.
        let blade = prism(24, |k| if k % 12 == 0 { 0.06 } else { 0.02 });
        let far = distance(&blade, 1.5);
        assert!(far > 0.15, "{far}");
        assert_eq!(distance(&blade, 0.0), 0.0);
    }
}
