//! The final verification of every method on depth: ICP of the rendered mesh against the depth image, then the scores of
//! [`crate::verification`] (dissertation, sections 5.2.5 and 5.3.3).

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
/// The same as published: 30 iterations with the mesh rendered once (dissertation, section 5.3.3). The text does not give the
/// rejection distance.
const PUBLISHED_LEVELS: [(f64, usize); 1] = [(2.0, 30)];
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

/// The dissertation's form of [`verify`] (section 5.3.3): all poses are scored as they are, and the `most` best of them are refined
/// by up to 30 iterations of ICP and scored again. Returns these, best before refinement first, with their numbers in `poses`; of
/// poses with the same score the earlier one is better.
pub fn verify_published(
    image: &PreparedDepth,
    mesh: &Mesh,
    poses: &[Pose],
    most: usize,
    threshold: f64,
    options: &VerificationOptions,
) -> Vec<(usize, VerifiedPose)> {
    let scores: Vec<f64> = poses
        .par_iter()
        .map_init(Verifier::default, |verifier, pose| {
            verifier.score(image, mesh, pose, threshold, options).total
        })
        .collect();
    let mut order: Vec<usize> = (0..poses.len()).collect();
    order.sort_by(|&a, &b| scores[b].total_cmp(&scores[a]).then(a.cmp(&b)));
    order.truncate(most);
    order
        .into_par_iter()
        .map_init(Verifier::default, |verifier, i| {
            let pose = refine_by(verifier, image, mesh, &poses[i], threshold, &PUBLISHED_LEVELS);
            let score = verifier.score(image, mesh, &pose, threshold, options);
            (i, VerifiedPose { camera_from_object: pose, score })
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
    refine_by(verifier, image, mesh, start, threshold, &LEVELS)
}

/// As [`refine`], by levels of rejection distance (multiples of `threshold`) and iterations.
fn refine_by(
    verifier: &mut Verifier,
    image: &PreparedDepth,
    mesh: &Mesh,
    start: &Pose,
    threshold: f64,
    levels: &[(f64, usize)],
) -> Pose {
    let target = DepthTarget { depth: image.depth(), normals: image.normals(), camera: image.camera() };
    let mut pose = *start;
    for &(factor, iterations) in levels {
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

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::{Camera, DepthImage, Vec3, nalgebra::UnitQuaternion};
    use sixfold_render::render_depth;

    use crate::prepared::DepthOptions;

    /// A block of 6 x 5 x 4 cm.
    fn block() -> Mesh {
        let side = |bit: usize, i: usize| if i >> bit & 1 == 1 { 1.0 } else { -1.0 };
        let corner = |i| Vec3::new(0.03 * side(0, i), 0.025 * side(1, i), 0.02 * side(2, i));
        let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles = sides.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        Mesh::new((0..8).map(corner).collect(), triangles).unwrap()
    }

    /// Of poses off by 4, 60, 8, and 6 mm the best two by their own scores are refined, and are right then.
    #[test]
    fn as_published_the_best_poses_are_refined() {
        let mesh = block();
        let camera = Camera::new(500.0, 500.0, 159.5, 119.5, 320, 240).unwrap();
        let rotation = UnitQuaternion::from_euler_angles(0.7, 0.5, 0.3);
        let truth = Pose::new(rotation, Vec3::new(0.02, -0.01, 0.7));
        let rendered = render_depth(&mesh, &truth, &camera);
        let depth = DepthImage::from_fn(320, 240, |x, y| {
            let z = rendered[(x, y)];
            if z > 0.0 { z } else { 0.9 }
        });
        let options = DepthOptions { remove_plane: false, ..DepthOptions::default() };
        let image = PreparedDepth::new(&depth, &camera, &options).unwrap();
        let off =
            |mm: f64| truth.with_translation(truth.translation() + Vec3::new(0.8, -0.6, 0.0) * mm * 1e-3);
        let poses = [4.0, 60.0, 8.0, 6.0].map(off);
        let options = VerificationOptions::default();
        let found = verify_published(&image, &mesh, &poses, 2, 0.01, &options);
        assert_eq!(found.iter().map(|f| f.0).collect::<Vec<_>>(), [0, 3]);
        let mut verifier = Verifier::default();
        for (i, refined) in found {
            let before = verifier.score(&image, &mesh, &poses[i], 0.01, &options).total;
            let error = refined.camera_from_object.distance_to(&truth);
            assert!(
                error < 1e-3 && refined.score.total > before,
                "{i}: {error} {before} {:?}",
                refined.score
            );
        }
        assert_eq!(verify_published(&image, &mesh, &poses, 15, 0.01, &options).len(), 4);
    }
}
