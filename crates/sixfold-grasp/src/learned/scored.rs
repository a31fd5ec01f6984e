//! Grasps with the score of any planner, and their clusters.

use crate::{ClusterOptions, Grasp, GraspCluster};

/// A grasp with its planner's score.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScoredGrasp {
    /// The grasp.
    pub grasp: Grasp,
    /// The planner's score, 0 to 1: higher is better.
    pub score: f64,
}

/// Clusters grasps greedily by score: the best remaining grasp takes all that are close to it. The clusters are sorted by their
/// summed score, the highest first; ties by their best members.
pub fn cluster_scored(grasps: &[ScoredGrasp], options: &ClusterOptions) -> Vec<GraspCluster> {
    let mut clusters = best_of_clusters(grasps, options);
    clusters.sort_by(|a, b| b.score.total_cmp(&a.score));
    clusters
}

/// As [`cluster_scored`], sorted by their best members: the grasp with the highest score, which HAF executes, is first.
pub fn best_of_clusters(grasps: &[ScoredGrasp], options: &ClusterOptions) -> Vec<GraspCluster> {
    let mut order: Vec<usize> = (0..grasps.len()).collect();
    order.sort_by(|&a, &b| grasps[b].score.total_cmp(&grasps[a].score).then(a.cmp(&b)));
    let mut left = vec![true; grasps.len()];
    let mut clusters = vec![];
    for &seed in &order {
        if !left[seed] {
            continue;
        }
        let ScoredGrasp { grasp: best, score: best_score } = grasps[seed];
        let mut cluster = GraspCluster { best, best_score, members: 0, score: 0.0 };
        for &i in &order {
            if !left[i] {
                continue;
            }
            let (distance, angle) = best.difference(&grasps[i].grasp);
            if distance <= options.distance && angle <= options.angle {
                left[i] = false;
                cluster.members += 1;
                cluster.score += grasps[i].score;
            }
        }
        clusters.push(cluster);
    }
    clusters
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::AntipodalQuality;
    use sixfold_geometry::Pose;

    #[test]
    fn the_best_grasp_comes_first_or_the_largest_sum() {
        let quality = AntipodalQuality { alignment: 0.0, support: 0.0, centring: 0.5, observed: 1.0 };
        let scored = |x: f64, score: f64| {
            let camera_from_gripper = Pose::exp(&[x, 0.0, 0.5, 0.0, 0.0, 0.0].into());
            ScoredGrasp { grasp: Grasp { camera_from_gripper, opening: 0.1, width: 0.03, quality }, score }
        };
        let grasps = [scored(0.0, 0.6), scored(0.02, 0.5), scored(0.3, 0.9)];
        let options = ClusterOptions::default();
        let of = |clusters: Vec<GraspCluster>| {
            clusters.iter().map(|c| (c.members, c.best_score)).collect::<Vec<_>>()
        };
        assert_eq!(of(cluster_scored(&grasps, &options)), [(2, 0.6), (1, 0.9)]);
        assert_eq!(of(best_of_clusters(&grasps, &options)), [(1, 0.9), (2, 0.6)]);
    }
}
