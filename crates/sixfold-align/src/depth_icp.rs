//! Aligns a pose that is accurate across the image but inaccurate along the view axis with a depth image: first its distance, then
//! point-to-plane ICP (Chen and Medioni 1992).
//!
//! Poses from coordinates in colour images are accurate across the image, but their error along the view axis is too large for ICP.
//! The median difference of measured and rendered depth over the object's pixels corrects that (as the author's BOP entry with ICP
//! does); then the visible surface is rendered and aligned with the image, three times.

use sixfold_geometry::{DepthTarget, IcpError, IcpLevel, IcpOptions, PointCloud, Pose, icp};
use sixfold_mesh::Mesh;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

use crate::prepared::PreparedDepth;

/// A pose after alignment with depth.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignedToDepth {
    /// The pose, metres.
    pub camera_from_object: Pose,
    /// Rendered points with a measured correspondence in the last iteration.
    pub inliers: usize,
    /// Root mean square of their distances to the surface, metres.
    pub rms: f64,
}

/// Fewest pixels with depth to correct the distance; chosen by hand, not swept.
const MIN_PIXELS: usize = 20;
/// Rejection distances of the three levels, as fractions of the diameter; chosen by hand, not swept.
const REJECTION: [f64; 3] = [0.15, 0.08, 0.04];
/// Iterations of a level; chosen by hand, not swept.
const ITERATIONS: usize = 8;
/// Approximate number of points of the rendered surface that are used; chosen by hand, not swept.
const POINTS: usize = 1000;
/// Largest angle between the normals of a correspondence, degrees; chosen by hand, not swept.
const MAX_ANGLE: f64 = 45.0;
/// A level stops when a step is smaller than this, metres and radians; chosen by hand, well below the depth noise.
const CONVERGENCE: f64 = 1e-5;
/// Plausible range of the ratio of measured and rendered distance: outside it, something other than the object was measured; chosen
/// by hand, not swept.
const PLAUSIBLE: std::ops::Range<f64> = 0.5..2.0;

/// Aligns a pose; `diameter` in metres. `visible` returns whether a pixel (column, row) shows the object.
///
/// # Errors
/// [`IcpError`] if too little depth is measured on the object, or its surface does not constrain the pose.
pub fn align_to_depth(
    image: &PreparedDepth,
    mesh: &Mesh,
    diameter: f64,
    start: &Pose,
    visible: &dyn Fn(usize, usize) -> bool,
) -> Result<AlignedToDepth, IcpError> {
    let camera = image.camera();
    let mut frame = VisibilityBuffer::new(camera);
    let mut pose = at_measured_distance(image, &mut frame, mesh, diameter, start, visible)?;
    let target = DepthTarget { depth: image.depth(), normals: image.normals(), camera };
    let (mut inliers, mut rms) = (0, 0.0);
    for fraction in REJECTION {
        let objects = [SceneObject { mesh, camera_from_object: pose }];
        frame.render(&objects, &RenderOptions::default());
        let normals = frame.normals(&objects);
        let mut seen = frame.depth();
        for y in 0..seen.height() {
            for x in 0..seen.width() {
                if !visible(x, y) {
                    seen[(x, y)] = 0.0;
                }
            }
        }
        let source = PointCloud::from_depth(&seen, Some(&normals), camera).transformed(&pose.inverse());
        let stride = (source.len() / POINTS).max(1);
        let options = IcpOptions {
            levels: vec![IcpLevel {
                rejection_distance: fraction * diameter,
                iterations: ITERATIONS,
                stride,
            }],
            max_angle: MAX_ANGLE.to_radians(),
            convergence: CONVERGENCE,
            min_correspondences: MIN_PIXELS,
        };
        let report = icp(&source, &target, &pose, &options)?;
        (pose, inliers, rms) = (report.target_from_source, report.inliers, report.rms);
    }
    Ok(AlignedToDepth { camera_from_object: pose, inliers, rms })
}

/// The pose moved along the ray of its centre by the median difference of measured and rendered depth.
fn at_measured_distance(
    image: &PreparedDepth,
    frame: &mut VisibilityBuffer,
    mesh: &Mesh,
    diameter: f64,
    start: &Pose,
    visible: &dyn Fn(usize, usize) -> bool,
) -> Result<Pose, IcpError> {
    frame.render(&[SceneObject { mesh, camera_from_object: *start }], &RenderOptions::default());
    let rendered = frame.depth();
    let mut differences = Vec::new();
    for y in 0..rendered.height() {
        for x in 0..rendered.width() {
            let (expected, measured) = (rendered[(x, y)], image.depth()[(x, y)]);
            if expected > 0.0 && measured > 0.0 && visible(x, y) {
                differences.push(f64::from(measured) - f64::from(expected));
            }
        }
    }
    if differences.len() < MIN_PIXELS {
        let (found, distance) = (differences.len(), diameter);
        return Err(IcpError::TooFewCorrespondences { found, points: found, distance, needed: MIN_PIXELS });
    }
    differences.sort_by(f64::total_cmp);
    let shift = differences[differences.len() / 2];
    let translation = start.translation();
    let factor = 1.0 + shift / translation.z;
    if factor <= PLAUSIBLE.start || factor >= PLAUSIBLE.end || factor.is_nan() {
        return Ok(*start);
    }
    Ok(Pose::new(start.rotation(), translation * factor))
}
