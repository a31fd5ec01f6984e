//! Joining similar pose hypotheses: the votes of a cluster are the sum of its members' (Drost et al. 2010,
//! section 3.5).

use nalgebra::UnitQuaternion;
use sixfold_geometry::{Pose, Vec3};

use crate::voting::Hypothesis;

/// When two poses are one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClusterOptions {
    /// Largest distance of the object's centres, as a share of its diameter.
    pub distance: f64,
    /// Largest rotation between them, radians.
    pub angle: f64,
    /// Most clusters returned.
    pub max_clusters: usize,
}

impl Default for ClusterOptions {
    fn default() -> Self {
        ClusterOptions { distance: 0.08, angle: 15f64.to_radians(), max_clusters: 400 }
    }
}

/// Clusters the hypotheses, most votes first. `centre` is the object's centre in its frame and `diameter`
/// its size, metres; poses that differ by one of `symmetries` are the same.
pub fn cluster(
    hypotheses: &[Hypothesis],
    centre: &Vec3,
    diameter: f64,
    symmetries: &[Pose],
    options: &ClusterOptions,
) -> Vec<Hypothesis> {
    struct Cluster {
        seed: Pose,
        seed_centre: Vec3,
        votes: f32,
        point: Vec3,
        rotation: nalgebra::Vector4<f64>,
    }
    let mut order: Vec<usize> = (0..hypotheses.len()).collect();
    order.sort_by(|&a, &b| hypotheses[b].votes.total_cmp(&hypotheses[a].votes).then(a.cmp(&b)));
    let reach = options.distance * diameter;
    // With a continuous symmetry there are hundreds: a coarse subset is enough to join.
    let stride = symmetries.len().div_ceil(36).max(1);
    let symmetries: Vec<&Pose> = symmetries.iter().step_by(stride).collect();
    let cosine = (0.5 * options.angle).cos();
    let mut clusters: Vec<Cluster> = Vec::new();
    for i in order {
        let h = &hypotheses[i];
        let c = h.camera_from_object.transform_point(centre);
        let weight = f64::from(h.votes);
        let mut joined = false;
        for cluster in &mut clusters {
            if (cluster.seed_centre - c).norm_squared() > reach * reach {
                continue;
            }
            let seed = cluster.seed.rotation();
            let Some(same) = symmetries.iter().map(|s| h.camera_from_object * **s).find(|p| {
                p.rotation().coords.dot(&seed.coords).abs() > cosine
                    && (p.transform_point(centre) - cluster.seed_centre).norm_squared() <= reach * reach
            }) else {
                continue;
            };
            let q = same.rotation().coords;
            cluster.rotation += q * weight * q.dot(&seed.coords).signum();
            cluster.point += same.transform_point(centre) * weight;
            cluster.votes += h.votes;
            joined = true;
            break;
        }
        // Weak hypotheses may support a cluster but found none once there are plenty.
        if !joined && clusters.len() < 4 * options.max_clusters {
            clusters.push(Cluster {
                seed: h.camera_from_object,
                seed_centre: c,
                votes: h.votes,
                point: c * weight,
                rotation: h.camera_from_object.rotation().coords * weight,
            });
        }
    }
    let mut found: Vec<Hypothesis> = clusters
        .into_iter()
        .map(|c| {
            let rotation = UnitQuaternion::from_quaternion(nalgebra::Quaternion::from(c.rotation));
            let point = c.point / f64::from(c.votes);
            Hypothesis { camera_from_object: Pose::new(rotation, point - rotation * centre), votes: c.votes }
        })
        .collect();
    found.sort_by(|a, b| b.votes.total_cmp(&a.votes));
    found.truncate(options.max_clusters);
    found
}
