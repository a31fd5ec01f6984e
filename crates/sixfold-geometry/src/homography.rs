//! Maps between planes: the direct linear transformation with normalised points (Hartley and Zisserman 2004, algorithm 4.2).

use nalgebra::{SMatrix, SVector, SymmetricEigen};

use crate::{Mat3, Vec2, Vec3};

/// The map (norm 1) that takes each first point to the second, all in one unit of length or pixels; `None` for fewer than four points or points on a line.
pub fn homography(pairs: &[(Vec2, Vec2)]) -> Option<Mat3> {
    if pairs.len() < 4 {
        return None;
    }
    let from = normalisation(pairs.iter().map(|p| p.0))?;
    let to = normalisation(pairs.iter().map(|p| p.1))?;
    let mut sum = SMatrix::<f64, 9, 9>::zeros();
    for (a, b) in pairs {
        let (a, b) = (apply(&from, a)?, apply(&to, b)?);
        for row in [
            [-a.x, -a.y, -1.0, 0.0, 0.0, 0.0, b.x * a.x, b.x * a.y, b.x],
            [0.0, 0.0, 0.0, -a.x, -a.y, -1.0, b.y * a.x, b.y * a.y, b.y],
        ] {
            let row = SVector::<f64, 9>::from(row);
            sum += row * row.transpose();
        }
    }
    let eigen = SymmetricEigen::new(sum);
    let mut order: Vec<usize> = (0..9).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    // A second solution means that the points do not determine the map.
    if !(eigen.eigenvalues[order[1]] > 1e-9 * eigen.eigenvalues[order[8]]) {
        return None;
    }
    let h = eigen.eigenvectors.column(order[0]);
    let map = to.try_inverse()? * Mat3::from_row_slice(h.as_slice()) * from;
    let norm = map.norm();
    (norm.is_finite() && norm > 0.0).then(|| map / norm)
}

/// The image of a point under a map; `None` for points on the horizon and behind it.
pub fn apply(map: &Mat3, point: &Vec2) -> Option<Vec2> {
    let p = map * Vec3::new(point.x, point.y, 1.0);
    (p.z.abs() > 1e-12).then(|| Vec2::new(p.x / p.z, p.y / p.z))
}

/// Moves the mean to the origin and the mean distance to the square root of two.
fn normalisation(points: impl Iterator<Item = Vec2> + Clone) -> Option<Mat3> {
    let count = points.clone().count() as f64;
    let mean = points.clone().sum::<Vec2>() / count;
    let distance = points.map(|p| (p - mean).norm()).sum::<f64>() / count;
    let scale = std::f64::consts::SQRT_2 / distance;
    let matrix = Mat3::new(scale, 0.0, -scale * mean.x, 0.0, scale, -scale * mean.y, 0.0, 0.0, 1.0);
    scale.is_finite().then_some(matrix)
}
