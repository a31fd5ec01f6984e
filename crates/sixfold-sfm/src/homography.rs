//! The two camera motions that explain the homography of a plane between two photographs (Ma, Soatto, Košecká and Sastry 2004, "An
//! Invitation to 3-D Vision", section 5.3.3).

use sixfold_geometry::homography::apply;
use sixfold_geometry::nalgebra::{Rotation3, SymmetricEigen, UnitQuaternion};
use sixfold_geometry::{Mat3, Pose, Vec2, Vec3};

/// Squared distance of the second point to the mapped first point.
pub(crate) fn transfer(map: &Mat3, (a, b): &(Vec2, Vec2)) -> f64 {
    apply(map, a).map_or(f64::INFINITY, |p| (p - b).norm_squared())
}

/// The motions (translation of length 1) that a homography allows with all points in front of both cameras: two, or fewer if the
/// homography comes from a pure rotation.
pub(crate) fn motions(map: &Mat3, pairs: &[(Vec2, Vec2)]) -> Vec<Pose> {
    let singular = map.svd(false, false).singular_values;
    let mut sorted = [singular[0], singular[1], singular[2]];
    sorted.sort_by(f64::total_cmp);
    if !(sorted[1] > 1e-12) {
        return vec![];
    }
    let positive = pairs.iter().map(|(a, b)| (b.push(1.0)).dot(&(map * a.push(1.0)))).sum::<f64>() >= 0.0;
    let h = map / sorted[1] * if positive { 1.0 } else { -1.0 };
    let eigen = SymmetricEigen::new(h.transpose() * h);
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
    let [v1, v2, v3]: [Vec3; 3] = order.map(|i| eigen.eigenvectors.column(i).into_owned());
    let (s1, s3) = (eigen.eigenvalues[order[0]], eigen.eigenvalues[order[2]]);
    if !(s1 - s3 > 1e-9) {
        return vec![];
    }
    let (along, across) =
        (((1.0 - s3).max(0.0) / (s1 - s3)).sqrt(), ((s1 - 1.0).max(0.0) / (s1 - s3)).sqrt());
    let of = |sign: f64| {
        let u = (v1 * along + v3 * (sign * across)).try_normalize(0.0)?;
        let (hv, hu) = (h * v2, h * u);
        let from = Mat3::from_columns(&[v2, u, v2.cross(&u)]);
        let to = Mat3::from_columns(&[hv, hu, hv.cross(&hu)]);
        let rotation =
            UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&(to * from.transpose())));
        let mut normal = v2.cross(&u);
        let mut translation = (h - rotation.to_rotation_matrix().into_inner()) * normal;
        let before = pairs.iter().filter(|(a, _)| normal.dot(&a.push(1.0)) > 0.0).count();
        if 2 * before < pairs.len() {
            (normal, translation) = (-normal, -translation);
        }
        let all_before = pairs.iter().filter(|(a, _)| normal.dot(&a.push(1.0)) > 0.0).count();
        let direction = translation.try_normalize(1e-9)?;
        (10 * all_before > 8 * pairs.len()).then(|| Pose::new(rotation, direction))
    };
    [1.0, -1.0].into_iter().filter_map(of).collect()
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::homography::homography;

    use super::*;

    #[test]
    fn a_planes_map_holds_the_true_motion() {
        for k in 0..20 {
            let t = f64::from(k);
            let motion = Pose::exp(&[0.4, 0.2 * t.cos(), -0.2, 0.2 * t.sin(), -0.3, 0.1].into());
            let pairs: Vec<(Vec2, Vec2)> = (0..12)
                .map(|i| {
                    let s = f64::from(i);
                    let p = Vec3::new((1.3 * s).sin(), (2.1 * s).cos(), 0.0);
                    let p = Vec3::new(p.x, p.y, 3.0 + 0.4 * p.x - 0.2 * p.y);
                    let q = motion.transform_point(&p);
                    ((p / p.z).xy(), (q / q.z).xy())
                })
                .collect();
            let map = homography(&pairs).unwrap();
            assert!(pairs.iter().all(|pair| transfer(&map, pair) < 1e-18));
            let truth = motion.with_translation(motion.translation().normalize());
            let best = motions(&map, &pairs)
                .iter()
                .map(|m| (m.inverse() * truth).log().norm())
                .fold(f64::INFINITY, f64::min);
            assert!(best < 1e-5, "{best:e}, {k}");
        }
    }
}
