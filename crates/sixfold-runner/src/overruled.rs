//! Poses of different objects that claim the same pixels: the surer one has them.

use std::collections::HashSet;

use sixfold_estimator::PoseEstimate;

/// A pose of which more than this fraction belongs to surer ones is dropped.
const MOST: f64 = 0.5;

/// Which of some poses in one image are left: those most of whose pixels (`mask`) belong to surer ones, by probability, are not. Poses
/// without a probability or a mask stay, and take nothing from others.
pub(crate) fn left_standing(poses: &[&PoseEstimate]) -> Vec<bool> {
    let judged = |i: &usize| Some((poses[*i].probability?, poses[*i].mask.as_ref()?));
    let mut order: Vec<usize> = (0..poses.len()).filter(|i| judged(i).is_some()).collect();
    order.sort_by(|a, b| {
        poses[*b].probability.unwrap_or(0.0).total_cmp(&poses[*a].probability.unwrap_or(0.0))
    });
    let mut stands = vec![true; poses.len()];
    let mut taken: HashSet<u32> = HashSet::new();
    for i in order {
        let Some((_, mask)) = judged(&i) else { continue };
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
            // More than half of it is the second one's.
            pose(Some(0.8), 50..100),
            pose(None, 40..140),
        ];
        let standing = left_standing(&poses.iter().collect::<Vec<_>>());
        assert_eq!(standing, [false, true, true, false, true]);
        // Half of it may be a surer one's, no more.
        assert_eq!(left_standing(&[&poses[0], &poses[3]]), [true, true]);
        assert_eq!(left_standing(&[&poses[0]]), [true]);
    }
}
