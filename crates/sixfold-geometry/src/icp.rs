//! Point-to-plane ICP (Chen and Medioni 1992) with a rejection distance, coarse to fine.
//!
//! Correspondences come from a [`CorrespondenceSource`]: a cloud with a k-d tree ([`IndexedCloud`]), or a depth
//! image read at the projection of the point ([`DepthTarget`], projective association, Blais and Levine 1995),
//! measured or rendered.

use thiserror::Error;

use crate::nearest::KdTree;
use crate::solver::NormalEquations;
use crate::{Camera, DepthImage, NormalImage, PointCloud, Pose, Vec2, Vec3};

/// Why two clouds could not be aligned.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum IcpError {
    /// Too few points have a correspondence.
    #[error(
        "{found} of {points} points have a correspondence within {distance:.4} m, at least {needed} are \
         needed: start from a better pose or raise the rejection distance"
    )]
    TooFewCorrespondences {
        /// Pairs found.
        found: usize,
        /// Number of source points used.
        points: usize,
        /// Rejection distance in metres.
        distance: f64,
        /// Pairs needed.
        needed: usize,
    },
    /// The object can slide on the surface (a plane, a sphere), so the pose is not determined.
    #[error("the correspondences do not determine all six degrees of freedom")]
    Degenerate,
    /// The target has no normals.
    #[error("the target cloud has {normals} normals for {points} points: point-to-plane needs one each")]
    NoNormals {
        /// Normals found.
        normals: usize,
        /// Points.
        points: usize,
    },
    /// An option is out of range.
    #[error("option {option}: found {found}, expected {expected}")]
    Option {
        /// Name of the option.
        option: &'static str,
        /// Its value.
        found: f64,
        /// The expected value.
        expected: &'static str,
    },
}

/// One level of a coarse-to-fine schedule.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IcpLevel {
    /// Pairs further apart than this are left out, metres.
    pub rejection_distance: f64,
    /// Maximum number of iterations on this level.
    pub iterations: usize,
    /// Every n-th source point is used.
    pub stride: usize,
}

/// Options of the alignment.
#[derive(Debug, Clone, PartialEq)]
pub struct IcpOptions {
    /// The levels, coarse first.
    pub levels: Vec<IcpLevel>,
    /// Normals of a pair must agree within this angle, radians (where the source has normals).
    pub max_angle: f64,
    /// A level ends when a step is smaller than this (metres and radians).
    pub convergence: f64,
    /// Minimum number of pairs.
    pub min_correspondences: usize,
}

impl IcpOptions {
    /// Three levels from `rejection_distance` metres down to a quarter of it.
    pub fn coarse_to_fine(rejection_distance: f64) -> Self {
        let level = |fraction: f64, iterations, stride| IcpLevel {
            rejection_distance: rejection_distance * fraction,
            iterations,
            stride,
        };
        IcpOptions {
            levels: vec![level(1.0, 10, 4), level(0.5, 10, 2), level(0.25, 20, 1)],
            max_angle: 60f64.to_radians(),
            convergence: 1e-6,
            min_correspondences: 10,
        }
    }

    /// Tests every field.
    ///
    /// # Errors
    /// [`IcpError::Option`].
    pub fn check(&self) -> Result<(), IcpError> {
        if self.levels.is_empty() {
            return Err(IcpError::Option { option: "levels", found: 0.0, expected: "at least one" });
        }
        for level in &self.levels {
            if !(level.rejection_distance > 0.0) {
                let found = level.rejection_distance;
                return Err(IcpError::Option { option: "rejection_distance", found, expected: "above 0 m" });
            }
            if level.stride == 0 {
                return Err(IcpError::Option { option: "stride", found: 0.0, expected: "at least 1" });
            }
        }
        if !(self.max_angle > 0.0) {
            return Err(IcpError::Option { option: "max_angle", found: self.max_angle, expected: "above 0" });
        }
        Ok(())
    }
}

/// The result of an alignment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IcpReport {
    /// The pose that maps the source onto the target.
    pub target_from_source: Pose,
    /// Pairs in the last iteration.
    pub inliers: usize,
    /// Root mean square of the point-to-plane distances of these pairs, metres.
    pub rms: f64,
    /// Iterations over all levels.
    pub iterations: usize,
    /// Whether the last level ended because its steps became small.
    pub converged: bool,
}

/// Finds the target point for a source point that was moved into the target's frame.
pub trait CorrespondenceSource {
    /// Point and unit normal of the correspondence; `None` when there is none within `max_distance` metres.
    fn partner(&self, point: &Vec3, max_distance: f64) -> Option<(Vec3, Vec3)>;
}

/// A cloud with normals and a k-d tree over its points.
#[derive(Debug)]
pub struct IndexedCloud {
    cloud: PointCloud,
    tree: KdTree,
}

impl IndexedCloud {
    /// Builds the tree.
    ///
    /// # Errors
    /// [`IcpError::NoNormals`] unless there is a normal for every point.
    pub fn new(cloud: PointCloud) -> Result<Self, IcpError> {
        if cloud.normals.len() != cloud.points.len() {
            return Err(IcpError::NoNormals { normals: cloud.normals.len(), points: cloud.points.len() });
        }
        let tree = KdTree::new(&cloud.points);
        Ok(IndexedCloud { cloud, tree })
    }

    /// The points and normals.
    pub fn cloud(&self) -> &PointCloud {
        &self.cloud
    }

    /// The tree over the points.
    pub fn tree(&self) -> &KdTree {
        &self.tree
    }
}

impl CorrespondenceSource for IndexedCloud {
    fn partner(&self, point: &Vec3, max_distance: f64) -> Option<(Vec3, Vec3)> {
        let near = self.tree.nearest(point)?;
        (near.distance <= max_distance)
            .then(|| (self.cloud.points[near.index], self.cloud.normals[near.index]))
    }
}

/// A depth image with normals, measured or rendered: a point corresponds to the surface at its pixel.
#[derive(Debug, Clone, Copy)]
pub struct DepthTarget<'a> {
    /// Depth in metres.
    pub depth: &'a DepthImage,
    /// Normals of the same image.
    pub normals: &'a NormalImage,
    /// The camera of both.
    pub camera: &'a Camera,
}

impl CorrespondenceSource for DepthTarget<'_> {
    fn partner(&self, point: &Vec3, max_distance: f64) -> Option<(Vec3, Vec3)> {
        let pixel = self.camera.project(point)?;
        let (x, y) = (pixel.x.round(), pixel.y.round());
        if x < 0.0 || y < 0.0 {
            return None;
        }
        let (x, y) = (x as usize, y as usize);
        let z = f64::from(*self.depth.get(x, y)?);
        let n = *self.normals.get(x, y)?;
        if !(z > 0.0) || n == [0.0; 3] {
            return None;
        }
        let q = self.camera.unproject(&Vec2::new(x as f64, y as f64), z);
        ((q - point).norm() <= max_distance).then(|| (q, Vec3::from(n.map(f64::from))))
    }
}

/// Aligns `source` with `target`, starting from `initial`. Pairs are weighted by Tukey's biweight of their
/// point-to-plane distance over the rejection distance.
///
/// # Errors
/// [`IcpError`].
pub fn icp(
    source: &PointCloud,
    target: &impl CorrespondenceSource,
    initial: &Pose,
    options: &IcpOptions,
) -> Result<IcpReport, IcpError> {
    options.check()?;
    let with_normals = source.normals.len() == source.points.len();
    let cosine = options.max_angle.cos();
    let mut pose = *initial;
    let mut report = IcpReport {
        target_from_source: pose,
        inliers: 0,
        rms: f64::INFINITY,
        iterations: 0,
        converged: false,
    };
    for level in &options.levels {
        report.converged = false;
        for _ in 0..level.iterations {
            let mut equations = NormalEquations::default();
            let mut squares = 0.0;
            let mut examined = 0;
            for i in (0..source.len()).step_by(level.stride) {
                examined += 1;
                let p = pose.transform_point(&source.points[i]);
                let Some((q, n)) = target.partner(&p, level.rejection_distance) else { continue };
                if with_normals && pose.transform_direction(&source.normals[i]).dot(&n) < cosine {
                    continue;
                }
                let residual = n.dot(&(p - q));
                let fraction = residual / level.rejection_distance;
                let weight = (1.0 - fraction * fraction).powi(2);
                let turn = p.cross(&n);
                equations.add(&[n.x, n.y, n.z, turn.x, turn.y, turn.z], residual, weight);
                squares += residual * residual;
            }
            if equations.count < options.min_correspondences {
                return Err(IcpError::TooFewCorrespondences {
                    found: equations.count,
                    points: examined,
                    distance: level.rejection_distance,
                    needed: options.min_correspondences,
                });
            }
            let step = equations.solve(1e-6).ok_or(IcpError::Degenerate)?;
            pose = Pose::exp(&step) * pose;
            report.iterations += 1;
            report.inliers = equations.count;
            report.rms = (squares / equations.count as f64).sqrt();
            report.target_from_source = pose;
            if step.amax() < options.convergence {
                report.converged = true;
                break;
            }
        }
    }
    Ok(report)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Points and normals of a box with sides of 10, 6 and 4 cm.
    fn box_cloud(step: f64) -> PointCloud {
        let half = [0.05, 0.03, 0.02];
        let mut cloud = PointCloud::default();
        for axis in 0..3 {
            let (a, b) = ((axis + 1) % 3, (axis + 2) % 3);
            let (na, nb) = ((2.0 * half[a] / step) as i32, (2.0 * half[b] / step) as i32);
            for side in [-1.0, 1.0] {
                for i in 0..=na {
                    for j in 0..=nb {
                        let mut p = [0.0; 3];
                        p[axis] = side * half[axis];
                        p[a] = -half[a] + step * f64::from(i);
                        p[b] = -half[b] + step * f64::from(j);
                        let mut n = [0.0; 3];
                        n[axis] = side;
                        cloud.points.push(p.into());
                        cloud.normals.push(n.into());
                    }
                }
            }
        }
        cloud
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn a_moved_box_is_found_again(t in prop::array::uniform3(-0.008..0.008f64), w in prop::array::uniform3(-0.1..0.1f64)) {
            let start = Pose::from_translation(Vec3::new(0.1, -0.05, 0.7));
            let truth = start * Pose::exp(&[t[0], t[1], t[2], w[0], w[1], w[2]].into());
            let target = IndexedCloud::new(box_cloud(0.002).transformed(&truth)).unwrap();
            let report = icp(&box_cloud(0.005), &target, &start, &IcpOptions::coarse_to_fine(0.03)).unwrap();
            prop_assert!(report.target_from_source.distance_to(&truth) < 5e-4, "{report:?}");
            prop_assert!(report.target_from_source.rotation_angle_to(&truth) < 0.01, "{report:?}");
        }
    }

    #[test]
    fn points_beyond_the_rejection_distance_are_left_out() {
        let truth = Pose::from_translation(Vec3::new(0.002, 0.001, -0.001));
        let mut cloud = box_cloud(0.002).transformed(&truth);
        // Clutter 5 cm above one face must not pull.
        for i in 0..2000 {
            cloud.points.push(Vec3::new(
                f64::from(i % 50) * 0.002 - 0.05,
                f64::from(i / 50) * 0.002 - 0.04,
                0.07,
            ));
            cloud.normals.push(Vec3::z());
        }
        let target = IndexedCloud::new(cloud).unwrap();
        let report =
            icp(&box_cloud(0.004), &target, &Pose::identity(), &IcpOptions::coarse_to_fine(0.02)).unwrap();
        assert!(report.target_from_source.distance_to(&truth) < 3e-4, "{report:?}");
    }

    #[test]
    fn failures_are_reported() {
        let target = IndexedCloud::new(box_cloud(0.01)).unwrap();
        let far = Pose::from_translation(Vec3::new(1.0, 0.0, 0.0));
        let options = IcpOptions::coarse_to_fine(0.02);
        assert!(matches!(
            icp(&box_cloud(0.01), &target, &far, &options),
            Err(IcpError::TooFewCorrespondences { found: 0, .. })
        ));
        let bad = IcpOptions { max_angle: f64::NAN, ..options };
        assert!(matches!(
            icp(&box_cloud(0.01), &target, &far, &bad),
            Err(IcpError::Option { option: "max_angle", .. })
        ));
        let bare = PointCloud { points: vec![Vec3::zeros()], normals: vec![] };
        assert!(matches!(IndexedCloud::new(bare), Err(IcpError::NoNormals { normals: 0, points: 1 })));
    }
}
