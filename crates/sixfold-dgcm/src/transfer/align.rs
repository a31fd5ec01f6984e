//! One experience, aligned with the object: the region of interest is located by its VD-NOC, rotation by the singular value
//! decomposition of equation 6.5, translation by extents, then iterative closest points.
//!
//! An object that appears wider here than in the experience may be a wider object, or the same object rotated: normalised
//! coordinates cannot distinguish these cases (which is why the dissertation's boxes fail, section 6.3.2). Both are tried. The
//! first hypothesis aligns normalised coordinates, as equation 6.5 does; the second aligns metres.

use serde::{Deserialize, Serialize};
use sixfold_geometry::{
    IcpLevel, IcpOptions, IndexedCloud, KdTree, OptionError, PointCloud, Pose, Vec3, icp, kabsch,
};

use sixfold_experience::{Crop, Extent};

/// Options of the alignment of an experience.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExperienceAlignmentOptions {
    /// Largest distance of a pixel's VD-NOC from those of the experience's region: theta_c.
    pub threshold: f64,
    /// Minimum number of pixels of a region.
    pub min_pixels: usize,
    /// Predicted coordinates whose alignment has a larger residual (root mean square, in units of VD-NOC) are not used.
    pub max_residual: f64,
    /// Largest translation of the alignment by ICP, metres.
    pub icp_distance: f64,
    /// Largest rotation of the alignment by ICP, radians.
    pub icp_angle: f64,
    /// Align only normalised coordinates (equation 6.5); otherwise also metric coordinates, and the object's own VD-NOC.
    pub only_scaled: bool,
}

impl Default for ExperienceAlignmentOptions {
    fn default() -> Self {
        ExperienceAlignmentOptions {
            threshold: 0.3,
            min_pixels: 20,
            max_residual: 0.3,
            icp_distance: 0.03,
            icp_angle: 25f64.to_radians(),
            only_scaled: false,
        }
    }
}

impl ExperienceAlignmentOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_positive("align.threshold", self.threshold, "a distance of VD-NOC above 0")?;
        OptionError::unless_some("align.min_pixels", self.min_pixels)?;
        OptionError::unless_weight("align.max_residual", self.max_residual)?;
        OptionError::unless_weight("align.icp_distance", self.icp_distance)?;
        OptionError::unless_weight("align.icp_angle", self.icp_angle)
    }
}

/// The assumption when two extents differ.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AlignmentHypothesis {
    /// The object has another size: equation 6.5.
    Scaled,
    /// The object is rotated.
    Turned,
    /// The object is seen from the same side: its own VD-NOC are used, and there is no rotation before ICP.
    SameSide,
    /// The object stands upright, rotated about the vertical and stretched: determined by its shape, without the network.
    Upright,
}

impl AlignmentHypothesis {
    /// Its name in files.
    pub fn name(self) -> &'static str {
        match self {
            AlignmentHypothesis::Scaled => "scaled",
            AlignmentHypothesis::Turned => "turned",
            AlignmentHypothesis::SameSide => "same_side",
            AlignmentHypothesis::Upright => "upright",
        }
    }
}

/// The pose of an experience's camera frame in the current view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Transferred {
    /// Takes points of the experience's camera frame to the current camera frame.
    pub camera_from_experience: Pose,
    /// The assumption.
    pub hypothesis: AlignmentHypothesis,
    /// Pixels of the region in the current view.
    pub pixels: usize,
    /// Root mean square of the point-to-plane distances after ICP, metres; `None` if the result of ICP was not used, because it had
    /// too few correspondences or moved too far.
    pub rms: Option<f64>,
    /// Size of the region here relative to that in the experience, along the experience's camera axes.
    pub scale: Vec3,
}

/// Aligns an experience (its crop and region) with an object (its crop and cloud), given the VD-NOC of the object's pixels in the
/// experience's frame as the network predicts them. Up to three alignments, one per hypothesis; none when the region is not
/// located.
pub fn transfer(
    input: &Crop,
    cloud: &IndexedCloud,
    coordinates: &[[f32; 3]],
    experience: &Crop,
    region: &[bool],
    options: &ExperienceAlignmentOptions,
) -> Vec<Transferred> {
    let wanted: Vec<usize> =
        (0..region.len().min(experience.mask.len())).filter(|&i| region[i] && experience.mask[i]).collect();
    if wanted.len() < options.min_pixels {
        return vec![];
    }
    // A subset of the region's points suffices: theta_c is far larger than their distances.
    let stride = wanted.len().div_ceil(150);
    let anchors: Vec<Vec3> = wanted.iter().step_by(stride).map(|&i| noc(&experience.vd_noc[i])).collect();
    let experience_points: Vec<Vec3> = wanted.iter().map(|&i| experience.point(i)).collect();
    let mut found: Vec<Transferred> = vec![];
    let hypotheses =
        [AlignmentHypothesis::Scaled, AlignmentHypothesis::Turned, AlignmentHypothesis::SameSide];
    for hypothesis in hypotheses.into_iter().take(if options.only_scaled { 1 } else { hypotheses.len() }) {
        let own = hypothesis == AlignmentHypothesis::SameSide;
        let coordinates = if own { &input.vd_noc } else { coordinates };
        let here = pixels_near(input, coordinates, &anchors, options.threshold);
        if here.len() < options.min_pixels {
            continue;
        }
        let points: Vec<Vec3> = here.iter().map(|&i| input.point(i)).collect();
        let restored: Vec<Vec3> =
            here.iter().map(|&i| experience.extent.restore(&noc(&coordinates[i]))).collect();
        let Some(rotation) = rotation(hypothesis, &restored, &points, experience, input, options) else {
            continue;
        };
        if found.iter().any(|f| f.camera_from_experience.rotation_angle_to(&rotation) < 4f64.to_radians()) {
            continue;
        }
        let rotated: Vec<Vec3> = experience_points.iter().map(|p| rotation.transform_point(p)).collect();
        let (Some(source), Some(target)) = (Extent::of(&rotated, 0.02), Extent::of(&points, 0.02)) else {
            continue;
        };
        let start = rotation.with_translation(target.centre - source.centre);
        let scale = target.half.component_div(&source.half);
        let (pose, rms) = refine(experience, &wanted, cloud, &start, options);
        found.push(Transferred { camera_from_experience: pose, hypothesis, pixels: here.len(), rms, scale });
    }
    found
}

/// Limit of the distances in [`misfit`], metres.
const FARTHEST: f64 = 0.02;
/// Every how many pixels of a crop their distance is measured.
const MEASURED: usize = 3;

/// Mean distance of an experience's visible surface, at a pose, to the object's, plus that of the object's to the experience's, metres;
/// each distance counts at most [`FARTHEST`].
pub(super) fn misfit(
    input: &Crop,
    cloud: &IndexedCloud,
    experience: &Crop,
    camera_from_experience: &Pose,
) -> f64 {
    let points = |crop: &Crop| -> Vec<Vec3> {
        let all: Vec<usize> = crop.pixels().collect();
        all.iter().step_by(MEASURED).map(|&i| crop.point(i)).collect()
    };
    let there = points(experience);
    let there: Vec<Vec3> = there.iter().map(|p| camera_from_experience.transform_point(p)).collect();
    let mean = |points: &[Vec3], tree: &KdTree| {
        let distance = |p: &Vec3| tree.nearest(p).map_or(FARTHEST, |near| near.distance.min(FARTHEST));
        points.iter().map(distance).sum::<f64>() / points.len().max(1) as f64
    };
    mean(&there, cloud.tree()) + mean(&points(input), &KdTree::new(&there))
}

pub(super) fn noc(v: &[f32; 3]) -> Vec3 {
    Vec3::from_fn(|k, _| f64::from(v[k]))
}

/// The region of interest in the current view: pixels whose VD-NOC are within `threshold` of one of the experience's region.
pub(super) fn pixels_near(
    input: &Crop,
    coordinates: &[[f32; 3]],
    anchors: &[Vec3],
    threshold: f64,
) -> Vec<usize> {
    let limit = threshold * threshold;
    input
        .pixels()
        .filter(|&i| {
            let v = noc(&coordinates[i]);
            anchors.iter().any(|a| (a - v).norm_squared() < limit)
        })
        .collect()
}

/// The rotation from the experience's camera to the object's under a hypothesis; `None` if the coordinates do not agree with any
/// rotation.
fn rotation(
    hypothesis: AlignmentHypothesis,
    restored: &[Vec3],
    points: &[Vec3],
    experience: &Crop,
    input: &Crop,
    options: &ExperienceAlignmentOptions,
) -> Option<Pose> {
    let normalised = |points: &[Vec3], extent: &Extent| -> Vec<Vec3> {
        points.iter().map(|p| (p - extent.centre).component_div(&extent.half)).collect()
    };
    let (source, target) = match hypothesis {
        AlignmentHypothesis::SameSide | AlignmentHypothesis::Upright => return Some(Pose::identity()),
        AlignmentHypothesis::Scaled => {
            (normalised(restored, &experience.extent), normalised(points, &input.extent))
        }
        AlignmentHypothesis::Turned => (restored.to_vec(), points.to_vec()),
    };
    let pose = kabsch(&source, &target, None).ok()?;
    let squares: f64 =
        source.iter().zip(&target).map(|(s, t)| (pose.transform_point(s) - t).norm_squared()).sum();
    let residual = (squares / source.len() as f64).sqrt();
    let unit = if hypothesis == AlignmentHypothesis::Turned { input.extent.half.mean() } else { 1.0 };
    (residual <= options.max_residual * unit).then(|| pose.with_translation(Vec3::zeros()))
}

/// ICP of the experience's region on the object's cloud. The result is rejected if it slid along a surface that does not constrain
/// it.
fn refine(
    experience: &Crop,
    wanted: &[usize],
    cloud: &IndexedCloud,
    start: &Pose,
    options: &ExperienceAlignmentOptions,
) -> (Pose, Option<f64>) {
    let stride = wanted.len().div_ceil(250);
    let chosen: Vec<usize> = wanted.iter().step_by(stride).copied().collect();
    let source = PointCloud {
        points: chosen.iter().map(|&i| experience.point(i)).collect(),
        normals: chosen.iter().map(|&i| Vec3::from_fn(|k, _| f64::from(experience.normals[i][k]))).collect(),
    };
    let level = |rejection_distance, iterations| IcpLevel { rejection_distance, iterations, stride: 1 };
    let icp_options = IcpOptions {
        levels: vec![level(0.03, 6), level(0.015, 6), level(0.008, 8)],
        max_angle: 60f64.to_radians(),
        convergence: 1e-5,
        min_correspondences: 10,
    };
    match icp(&source, cloud, start, &icp_options) {
        Ok(report) => {
            let source_centroid = source.centroid().unwrap_or_else(Vec3::zeros);
            let moved = (report.target_from_source.transform_point(&source_centroid)
                - start.transform_point(&source_centroid))
            .norm();
            let rotated = report.target_from_source.rotation_angle_to(start);
            if moved <= options.icp_distance && rotated <= options.icp_angle {
                (report.target_from_source, Some(report.rms))
            } else {
                (*start, None)
            }
        }
        Err(_) => (*start, None),
    }
}

#[cfg(test)]
mod tests {
    use sixfold_experience::CropOptions;
    use sixfold_geometry::{Camera, Image, Mask};

    use super::*;

    /// The crop of a step at 0.7 m, whose left half is 3 cm nearer; with or without its right half.
    fn step(whole: bool) -> Crop {
        let camera = Camera::new(575.0, 575.0, 159.5, 119.5, 320, 240).unwrap();
        let right = if whole { 210 } else { 160 };
        let inside = |x: usize, y: usize| (110..right).contains(&x) && (90..150).contains(&y);
        let depth = Image::from_fn(320, 240, |x, y| {
            let z = if x < 160 { 0.67 } else { 0.7 };
            if inside(x, y) { z } else { 0.0 }
        });
        Crop::new(&depth, &camera, &Mask::from_fn(320, 240, inside), &CropOptions::compact()).unwrap()
    }

    #[test]
    fn surfaces_that_lie_apart_or_are_missing_do_not_fit() {
        let (whole, half) = (step(true), step(false));
        let cloud = |crop: &Crop| {
            let points: Vec<Vec3> = crop.pixels().map(|i| crop.point(i)).collect();
            IndexedCloud::new(PointCloud { normals: vec![Vec3::z(); points.len()], points }).unwrap()
        };
        let at = |input: &Crop, experience: &Crop, z: f64| {
            misfit(input, &cloud(input), experience, &Pose::from_translation(Vec3::z() * z))
        };
        let same = at(&whole, &whole, 0.0);
        assert!(same < 0.002, "{same}");
        let apart = at(&whole, &whole, 0.012);
        assert!((0.018..0.026).contains(&apart), "1.2 cm in both directions: {apart}");
        // What is missing in either counts.
        let missing = [at(&whole, &half, 0.0), at(&half, &whole, 0.0)];
        assert!(missing.iter().all(|m| (0.006..0.013).contains(m)), "{missing:?}");
        assert!(at(&whole, &whole, 1.0) <= 2.0 * FARTHEST + 1e-9);
    }
}
