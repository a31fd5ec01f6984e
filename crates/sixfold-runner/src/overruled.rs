//! Resolves poses that cover the same pixels: the pixels belong to the more probable pose.

use std::collections::HashSet;

use sixfold_estimator::PoseEstimate;

/// A pose is removed if more than this fraction of its pixels belongs to more probable ones.
const MOST: f64 = 0.5;

/// Which of the poses in one image are kept: a pose is not, if most of its pixels (`mask`) belong to more probable poses, each
/// taken together with its alternatives. Poses without a probability or a mask are kept and take no pixels from others.
pub fn left_standing(poses: &[&PoseEstimate]) -> Vec<bool> {
    let judged = |i| {
        let pose: &PoseEstimate = poses[i];
        Some((i, pose.probability_with_alternatives()?, pose.mask.as_ref()?))
    };
    let mut order: Vec<(usize, f64, &Vec<u32>)> = (0..poses.len()).filter_map(judged).collect();
    order.sort_by(|a, b| b.1.total_cmp(&a.1));
    let mut stands = vec![true; poses.len()];
    let mut taken: HashSet<u32> = HashSet::new();
    for (i, _, mask) in order {
        let shared = mask.iter().filter(|p| taken.contains(*p)).count();
        stands[i] = shared as f64 <= MOST * mask.len() as f64;
        if stands[i] {
            taken.extend(mask);
        }
    }
    stands
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::Pose;

    use super::*;

    fn pose(probability: Option<f64>, mask: std::ops::Range<u32>) -> PoseEstimate {
        let mask = Some(mask.collect());
        PoseEstimate { probability, mask, ..PoseEstimate::new(Pose::identity(), 0.5) }
    }

    #[test]
    fn the_surer_pose_has_the_pixels() {
        let poses = [
            pose(Some(0.6), 0..100),
            pose(Some(0.9), 40..140),
            pose(Some(0.7), 130..200),
            // More than half of its pixels belong to the second pose.
            pose(Some(0.8), 50..100),
            pose(None, 40..140),
        ];
        let standing = left_standing(&poses.iter().collect::<Vec<_>>());
        assert_eq!(standing, [false, true, true, false, true]);
        // Up to half of a pose's pixels may belong to a more probable one.
        assert_eq!(left_standing(&[&poses[0], &poses[3]]), [true, true]);
        assert_eq!(left_standing(&[&poses[0]]), [true]);
        // Together with its alternative the first is more probable than the second.
        let ambiguous = PoseEstimate { alternatives: vec![pose(Some(0.35), 0..100)], ..poses[0].clone() };
        assert_eq!(left_standing(&[&ambiguous, &poses[1]]), [true, false]);
        assert_eq!(left_standing(&[&poses[0], &poses[1]]), [false, true]);
    }
}
