//! Clustering of similar pose hypotheses: the votes of a cluster are the sum of its members' votes (Drost et al. 2010, section
//! 3.5).

use nalgebra::UnitQuaternion;
use sixfold_geometry::{OptionError, Pose, Vec3};

use crate::voting::Hypothesis;

/// When two poses belong to one cluster.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClusterOptions {
    /// Largest distance of the object's centres, as a fraction of its diameter.
    pub distance: f64,
    /// Largest rotation between them, radians.
    pub angle: f64,
    /// Maximum number of clusters returned.
    pub max_clusters: usize,
}

/// Largest distance of the centres of poses in a cluster, as a fraction of the diameter; chosen by hand, not swept.
const DISTANCE: f64 = 0.08;
/// Largest rotation between poses in a cluster, degrees; chosen by hand, not swept.
const ANGLE: f64 = 15.0;
/// Maximum number of clusters; chosen by hand, not swept.
const MAX_CLUSTERS: usize = 400;
/// Approximate maximum number of symmetries tried in the clustering: those of a continuous symmetry are then 10 degrees apart.
const MAX_SYMMETRIES: usize = 36;
/// Maximum number of clusters during the clustering, as a multiple of those returned: when it is reached, further (weak) hypotheses
/// can join a cluster but not start a new one. Chosen by hand; not swept.
const FOUNDED: usize = 4;

impl Default for ClusterOptions {
    fn default() -> Self {
        ClusterOptions { distance: DISTANCE, angle: ANGLE.to_radians(), max_clusters: MAX_CLUSTERS }
    }
}

impl ClusterOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        let distance = "a fraction of the diameter above 0";
        OptionError::unless_positive("clustering.distance", self.distance, distance)?;
        let angle = "radians from 0 to half a turn";
        OptionError::unless_within("clustering.angle", self.angle, 0.0..=std::f64::consts::PI, angle)?;
        OptionError::unless_some("clustering.max_clusters", self.max_clusters)
    }
}

/// Clusters the hypotheses, most votes first. `centre` is the object's centre in its frame and `diameter` its size, metres; poses
/// that differ by one of `symmetries` count as equal.
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
    // With a continuous symmetry there are hundreds: a coarse subset suffices for the clustering.
    let stride = symmetries.len().div_ceil(MAX_SYMMETRIES).max(1);
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
        if !joined && clusters.len() < FOUNDED * options.max_clusters {
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
