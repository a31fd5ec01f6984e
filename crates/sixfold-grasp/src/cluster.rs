//! Clusters of proposals of about the same grasp: within 5 cm and 15 degrees (dissertation, section 6.3.2).
//!
//! The dissertation executes the mean pose of the cluster with the highest summed score. The mean of collision-free poses need not
//! be collision-free, and its fingers need not enclose the object, so here a cluster is represented by its best member.

use crate::learned::{ScoredGrasp, cluster_scored};
use crate::{Grasp, OptionsError};

/// How close two grasps of one cluster are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClusterOptions {
    /// Largest distance of the centres between the tips, metres.
    pub distance: f64,
    /// Largest angle between the orientations, radians; a half turn of the gripper counts as zero.
    pub angle: f64,
}

impl Default for ClusterOptions {
    fn default() -> Self {
        ClusterOptions { distance: 0.05, angle: 15f64.to_radians() }
    }
}

impl ClusterOptions {
    /// Tests every field.
    ///
    /// # Errors
    /// [`OptionsError`]: a distance or an angle that is not finite and positive.
    pub fn check(&self) -> Result<(), OptionsError> {
        for (field, found) in [("distance", self.distance), ("angle", self.angle)] {
            if !(found > 0.0 && found.is_finite()) {
                return Err(OptionsError { field, found, expected: "a finite number above 0" });
            }
        }
        Ok(())
    }
}

/// A cluster of about equal grasps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GraspCluster {
    /// The member with the highest quality, or score.
    pub best: Grasp,
    /// Its quality, or its planner's score.
    pub best_score: f64,
    /// Number of proposals in the cluster.
    pub members: usize,
    /// The sum of their qualities, or scores.
    pub score: f64,
}

/// Clusters grasps greedily by quality: the best remaining grasp takes all that are close to it. The clusters are sorted by their
/// score, the highest first; ties by their best members.
pub fn cluster_grasps(grasps: &[Grasp], options: &ClusterOptions) -> Vec<GraspCluster> {
    let scored: Vec<ScoredGrasp> =
        grasps.iter().map(|&grasp| ScoredGrasp { grasp, score: grasp.quality.total() }).collect();
    cluster_scored(&scored, options)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::AntipodalQuality;
    use sixfold_geometry::Pose;

    fn grasp(twist: [f64; 6], alignment: f64) -> Grasp {
        let quality = AntipodalQuality { alignment, support: 1.0, centring: 1.0, observed: 1.0 };
        Grasp { camera_from_gripper: Pose::exp(&twist.into()), opening: 0.05, width: 0.04, quality }
    }

    #[test]
    fn near_grasps_are_joined_also_if_rotated_by_180_degrees() {
        let pi = std::f64::consts::PI;
        let grasps = [
            grasp([0.0, 0.0, 0.5, 0.0, 0.0, 0.0], 0.5),
            grasp([0.03, 0.0, 0.5, 0.0, 0.0, 0.1], 0.9),
            grasp([0.0, 0.0, 0.5, 0.0, 0.0, pi], 0.4),
            grasp([0.2, 0.0, 0.5, 0.0, 0.0, 0.0], 1.0),
            grasp([0.0, 0.0, 0.5, 0.0, 0.6, 0.0], 0.1),
        ];
        let clusters = cluster_grasps(&grasps, &ClusterOptions::default());
        assert_eq!(clusters.iter().map(|c| c.members).collect::<Vec<_>>(), [3, 1, 1]);
        assert_eq!(clusters[0].best, grasps[1]);
        assert!(cluster_grasps(&[], &ClusterOptions::default()).is_empty());
        let wrong = ClusterOptions { angle: f64::NAN, ..ClusterOptions::default() }.check().unwrap_err();
        assert!(wrong.to_string().contains("angle"), "{wrong}");
    }
}
