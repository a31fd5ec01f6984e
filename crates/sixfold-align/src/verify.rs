//! The final verification of every method on depth: ICP of the rendered mesh against the depth image, then the scores of
//! [`crate::verification`].

use rayon::prelude::*;
use sixfold_geometry::{DepthTarget, IcpLevel, IcpOptions, PointCloud, Pose, icp};
use sixfold_mesh::Mesh;

use crate::prepared::PreparedDepth;
use crate::verification::{VerificationOptions, VerificationScore, Verifier};

/// A pose after ICP, with its scores.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VerifiedPose {
    /// The pose after ICP.
    pub camera_from_object: Pose,
    /// The scores of the verification.
    pub score: VerificationScore,
}

/// Levels of the ICP: rejection distance as a multiple of the depth inlier threshold, and iterations. The dissertation uses 30
/// iterations (chapter 5); here the mesh is rendered again between the levels, so fewer suffice. The multiples were chosen by hand;
/// not swept.
const LEVELS: [(f64, usize); 3] = [(2.0, 5), (1.2, 5), (0.8, 8)];
/// Approximate number of points rendered for a level; chosen by hand, not swept.
const POINTS: usize = 600;
/// Rendered points more than this many rejection distances from the measured surface are not used; chosen by hand, not swept.
const NEAR: f64 = 2.0;
/// Largest angle between the normals of a correspondence, degrees; chosen by hand, not swept.
const MAX_ANGLE: f64 = 45.0;
/// A level stops when a step is smaller than this, metres and radians; chosen by hand, well below the depth noise.
const CONVERGENCE: f64 = 1e-5;
/// Fewest correspondences: twice the six degrees of freedom.
const MIN_CORRESPONDENCES: usize = 12;

/// Refines and scores poses of a mesh; the results are in the order of `poses`. `threshold` is the depth inlier threshold in metres
/// ([`VerificationOptions::threshold_for`]); `mesh` should come from [`crate::verification_mesh`].
pub fn verify(
    image: &PreparedDepth,
    mesh: &Mesh,
    poses: &[Pose],
    threshold: f64,
    options: &VerificationOptions,
) -> Vec<VerifiedPose> {
    poses
        .par_iter()
        .map_init(Verifier::default, |verifier, start| {
            let pose = refine(verifier, image, mesh, start, threshold);
            let score = verifier.score(image, mesh, &pose, threshold, options);
            VerifiedPose { camera_from_object: pose, score }
        })
        .collect()
}

/// ICP of the rendered points against the depth image, rendered again between the levels. `threshold` in metres.
pub fn refine(
    verifier: &mut Verifier,
    image: &PreparedDepth,
    mesh: &Mesh,
    start: &Pose,
    threshold: f64,
) -> Pose {
    let target = DepthTarget { depth: image.depth(), normals: image.normals(), camera: image.camera() };
    let mut pose = *start;
    for (factor, iterations) in LEVELS {
        let distance = factor * threshold;
        let points = verifier.visible_points(image, mesh, &pose, NEAR * distance, POINTS);
        let mut source = PointCloud::default();
        for p in points.iter().filter(|p| p.inlier) {
            source.points.push(p.point);
            source.normals.push(p.normal);
        }
        let options = IcpOptions {
            levels: vec![IcpLevel { rejection_distance: distance, iterations, stride: 1 }],
            max_angle: MAX_ANGLE.to_radians(),
            convergence: CONVERGENCE,
            min_correspondences: MIN_CORRESPONDENCES,
        };
        match icp(&source, &target, &pose, &options) {
            Ok(report) => pose = report.target_from_source,
            Err(_) => break,
        }
    }
    pose
}
