//! Absolute orientation: the rigid (Kabsch 1976) or similarity (Umeyama 1991) transformation between
//! paired points.

use thiserror::Error;

use crate::pose::nearest_rotation;
use crate::{Mat3, Pose, Vec3};

/// Why no transformation could be found.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum AlignmentError {
    /// The lists have different lengths.
    #[error(
        "{source_points} source points, {target_points} target points, {weights} weights: expected equal \
         numbers"
    )]
    Lengths {
        /// Length of the first list.
        source_points: usize,
        /// Length of the second list.
        target_points: usize,
        /// Number of weights.
        weights: usize,
    },
    /// A weight is negative or not finite, or all are zero, or a point is not finite.
    #[error("{what} at index {index} is not usable: {found}")]
    Value {
        /// Which list.
        what: &'static str,
        /// Index in it.
        index: usize,
        /// What was found.
        found: f64,
    },
    /// Fewer than three points carry weight, or they lie on one line.
    #[error("the points do not determine a rotation: three or more that are not collinear are needed")]
    Degenerate,
}

/// A similarity: `target = scale * rotation * source + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    /// Rotation and translation.
    pub target_from_source: Pose,
    /// Scale, 1 for a rigid transformation.
    pub scale: f64,
}

impl Similarity {
    /// Maps a point.
    pub fn transform_point(&self, p: &Vec3) -> Vec3 {
        self.target_from_source.transform_point(&(p * self.scale))
    }
}

/// The rigid transformation that minimises the weighted squared distances (Kabsch 1976, reflection handled after
/// Umeyama 1991). Without `weights` all are 1.
///
/// # Errors
/// [`AlignmentError`].
pub fn kabsch(source: &[Vec3], target: &[Vec3], weights: Option<&[f64]>) -> Result<Pose, AlignmentError> {
    align(source, target, weights, false).map(|s| s.target_from_source)
}

/// The similarity that minimises the weighted squared distances (Umeyama 1991, equations 40-42).
///
/// # Errors
/// [`AlignmentError`].
pub fn umeyama(
    source: &[Vec3],
    target: &[Vec3],
    weights: Option<&[f64]>,
) -> Result<Similarity, AlignmentError> {
    align(source, target, weights, true)
}

fn align(
    source: &[Vec3],
    target: &[Vec3],
    weights: Option<&[f64]>,
    with_scale: bool,
) -> Result<Similarity, AlignmentError> {
    let n = source.len();
    if target.len() != n || weights.is_some_and(|w| w.len() != n) {
        return Err(AlignmentError::Lengths {
            source_points: n,
            target_points: target.len(),
            weights: weights.map_or(n, <[f64]>::len),
        });
    }
    for (what, points) in [("source point", source), ("target point", target)] {
        if let Some(index) = points.iter().position(|p| !p.iter().all(|c| c.is_finite())) {
            return Err(AlignmentError::Value { what, index, found: f64::NAN });
        }
    }
    if let Some((index, &found)) =
        weights.and_then(|w| w.iter().enumerate().find(|(_, w)| !(w.is_finite() && **w >= 0.0)))
    {
        return Err(AlignmentError::Value { what: "weight", index, found });
    }
    let weight = |i: usize| weights.map_or(1.0, |w| w[i]);
    let total: f64 = (0..n).map(weight).sum();
    if n < 3 || total <= 0.0 {
        return Err(AlignmentError::Degenerate);
    }
    let mean = |points: &[Vec3]| -> Vec3 {
        points.iter().enumerate().map(|(i, p)| p * weight(i)).sum::<Vec3>() / total
    };
    let (mean_source, mean_target) = (mean(source), mean(target));
    let mut covariance = Mat3::zeros();
    let mut spread = 0.0;
    for i in 0..n {
        let (s, t) = (source[i] - mean_source, target[i] - mean_target);
        covariance += t * s.transpose() * (weight(i) / total);
        spread += weight(i) / total * s.norm_squared();
    }
    let singular = covariance.svd(false, false).singular_values;
    let mut sorted = [singular[0], singular[1], singular[2]];
    sorted.sort_by(f64::total_cmp);
    if !(sorted[1] > 1e-12 * sorted[2] && sorted[2] > 0.0) {
        return Err(AlignmentError::Degenerate);
    }
    let rotation = nearest_rotation(&covariance);
    let scale = if with_scale {
        // trace(R^T covariance) is the sum of the singular values with the sign of the reflection.
        (rotation.to_rotation_matrix().matrix().transpose() * covariance).trace() / spread
    } else {
        1.0
    };
    let translation = mean_target - rotation * (mean_source * scale);
    Ok(Similarity { target_from_source: Pose::new(rotation, translation), scale })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn points() -> Vec<Vec3> {
        (0..20)
            .map(|i| {
                let t = f64::from(i);
                Vec3::new((t * 1.3).sin(), (t * 0.7).cos(), (t * 2.1).sin() * 0.5) * 0.1
            })
            .collect()
    }

    proptest! {
        #[test]
        fn a_moved_and_scaled_cloud_is_found_again(t in prop::array::uniform6(-1.5..1.5f64), scale in 0.2..5.0f64) {
            let truth = Similarity { target_from_source: Pose::exp(&t.into()), scale };
            let target: Vec<_> = points().iter().map(|p| truth.transform_point(p)).collect();
            let found = umeyama(&points(), &target, None).unwrap();
            prop_assert!((found.scale - scale).abs() < 1e-9);
            prop_assert!((found.target_from_source.inverse() * truth.target_from_source).log().amax() < 1e-8);
        }
    }

    #[test]
    fn an_outlier_without_weight_does_not_matter() {
        let truth = Pose::exp(&[0.1, 0.2, -0.3, 0.4, -0.5, 0.6].into());
        let mut target: Vec<_> = points().iter().map(|p| truth.transform_point(p)).collect();
        target[3] += Vec3::new(9.0, 9.0, 9.0);
        let mut weights = vec![1.0; 20];
        assert!(kabsch(&points(), &target, Some(&weights)).unwrap().distance_to(&truth) > 0.1);
        weights[3] = 0.0;
        let found = kabsch(&points(), &target, Some(&weights)).unwrap();
        assert!((found.inverse() * truth).log().amax() < 1e-9);
    }

    #[test]
    fn a_flat_cloud_gives_a_rotation_and_never_a_mirror() {
        let flat: Vec<_> = points().iter().map(|p| Vec3::new(p.x, p.y, 0.0)).collect();
        let truth = Pose::exp(&[0.0, 0.0, 0.0, 2.0, 1.0, 0.5].into());
        let target: Vec<_> = flat.iter().map(|p| truth.transform_point(p)).collect();
        let found = kabsch(&flat, &target, None).unwrap();
        assert!((found.inverse() * truth).log().amax() < 1e-8);
    }

    #[test]
    fn lines_and_bad_weights_are_refused() {
        let line: Vec<_> = (0..5).map(|i| Vec3::new(f64::from(i), 0.0, 0.0)).collect();
        assert_eq!(kabsch(&line, &line, None), Err(AlignmentError::Degenerate));
        let w = [1.0, f64::NAN, 1.0, 1.0, 1.0];
        assert!(matches!(kabsch(&line, &line, Some(&w)), Err(AlignmentError::Value { index: 1, .. })));
        assert!(matches!(kabsch(&line, &line[..4], None), Err(AlignmentError::Lengths { .. })));
    }
}
