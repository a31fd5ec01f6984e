//! From a box to a pose: both passes and PnP, alignment of the outline, refinement, and correction of the model's systematic error.
//!
//! A box shows where the object is visible, but only its pose gives its full size, including occluded parts. Further iterations in
//! the box of the aligned pose are optional. They help with inaccurate boxes (LM-O, boxes moved and scaled by up to 20 %: recall of
//! ADD(-S) 0.48 against 0.44); with accurate ones they take twice the time without improving poses.

use crate::estimate::{EstimateError, Found, Pix2PoseOptions, estimate};
use crate::model::Pix2PoseModel;
use crate::object::Correction;
use crate::refine::{OutlineRefinementOptions, refine};
use sixfold_align::outline::projected_box;
use sixfold_data::PosedImage;
use sixfold_estimator::{EstimatorError, RefinedObject};
use sixfold_geometry::stats::upper_median;
use sixfold_geometry::{Camera, OptionError, Pose, Progress, Rect, RgbImage, Vec2};
use sixfold_mesh::{Mesh, ModelInfo};
use std::collections::BTreeMap;

/// Options of the estimation with alignment.
#[derive(Debug, Clone, PartialEq)]
pub struct AlignOptions {
    /// Both passes and PnP.
    pub estimate: Pix2PoseOptions,
    /// The alignment.
    pub refine: OutlineRefinementOptions,
    /// Maximum number of iterations: each after the first uses the box of the previous pose; they stop when the box does not
    /// change.
    pub passes: usize,
    /// Number of boxes from which a pose is estimated: the given one and copies of it of other sizes. The pose with which the image
    /// agrees best is kept; without a refiner, the one with the highest score. Helps with inaccurate boxes and against wrong
    /// rotations, and takes that many times as long.
    pub starts: usize,
    /// Weight of the refiner's pose, 0 to 1, in the final one; the rest is that of the aligned outline. Their errors are different,
    /// so that a mean is nearer than either. 0: the refiner is not used. Chosen by ADD(-S)
    /// recall on 602 targets of 84 LM-O development frames, ground-truth boxes: with 0, 0.3, 0.4, 0.5 .518, .548, .548, .565;
    /// larger ones were not measured since the refiner's distances are corrected.
    pub refiner_weight: f64,
    /// Correct the model's systematic error for the object.
    pub correct: bool,
}

/// Sizes of the boxes of [`AlignOptions::starts`], relative to the given one.
const START_SIZES: [f64; 5] = [1.0, 0.8, 1.25, 0.64, 1.5];
/// Largest number of starts.
pub const MAX_STARTS: usize = START_SIZES.len();

impl Default for AlignOptions {
    fn default() -> Self {
        Self {
            estimate: Pix2PoseOptions::default(),
            refine: OutlineRefinementOptions::default(),
            passes: 1,
            starts: 1,
            refiner_weight: 0.5,
            correct: true,
        }
    }
}

impl AlignOptions {
    /// The dissertation's form: its two stages with its parameters, one pass, no correction.
    pub fn published() -> AlignOptions {
        AlignOptions {
            estimate: Pix2PoseOptions::published(),
            passes: 1,
            correct: false,
            ..AlignOptions::default()
        }
    }

    /// Checks every field, including those of both passes and of the alignment.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        self.estimate.check()?;
        self.refine.check()?;
        OptionError::unless_fraction("refiner_weight", self.refiner_weight)?;
        OptionError::unless_some("passes", self.passes)?;
        OptionError::unless_within("starts", self.starts, 1..=MAX_STARTS, "1 to 5")
    }
}

/// A pose aligned with the image.
#[derive(Debug, Clone, PartialEq)]
pub struct Aligned {
    /// The pose.
    pub camera_from_object: Pose,
    /// Score of the last iteration, 0 to 1.
    pub score: f64,
    /// Whether enough of the outline was found to align it.
    pub improved: bool,
    /// Agreement of the image with the refined pose, 0 to 1, if there is one.
    pub agreement: Option<f64>,
    /// Result of the last iteration.
    pub found: Found,
}

/// An object of a model, with what poses are aligned by.
#[derive(Clone, Copy)]
pub struct AlignedObject<'a> {
    /// Its number in the model.
    pub id: u32,
    /// Its mesh by [`sixfold_align::outline::outline_mesh`].
    pub outline: &'a Mesh,
    /// Refines its poses.
    pub refiner: Option<&'a dyn RefinedObject>,
}

/// Estimates the pose of one object in a box of a pinhole image and aligns it. `None` if the object's pixels are not in the box.
///
/// # Errors
/// As [`estimate`], and [`EstimateError::Refiner`].
pub fn estimate_aligned(
    model: &Pix2PoseModel,
    image: &RgbImage,
    camera: &Camera,
    object: AlignedObject<'_>,
    region: &Rect,
    options: &AlignOptions,
) -> Result<Option<Aligned>, EstimateError> {
    let search = Search { model, image, camera, object, options };
    let mut best = search.from(region)?;
    for size in &START_SIZES[1..options.starts.clamp(1, MAX_STARTS)] {
        // A copy of the box can lie outside the image although the box does not.
        let Ok(Some(other)) = search.from(&scaled(region, *size)) else { continue };
        if best.as_ref().is_none_or(|best| other.value() > best.value()) {
            best = Some(other);
        }
    }
    if let Some(best) = best.as_mut().filter(|best| options.correct && best.improved) {
        let correction = model.object(object.id)?.1.correction;
        best.camera_from_object = correction.apply(camera, &best.camera_from_object);
    }
    Ok(best)
}

/// A box of the same centre, its sides multiplied by a factor.
fn scaled(region: &Rect, factor: f64) -> Rect {
    let (width, height) = (factor * region.width, factor * region.height);
    let (x, y) = (region.x + 0.5 * (region.width - width), region.y + 0.5 * (region.height - height));
    Rect { x, y, width, height }
}

impl Aligned {
    /// By which the pose from several boxes is chosen: the agreement; the score where there is no refiner.
    fn value(&self) -> (f64, f64) {
        (self.agreement.unwrap_or(0.0), self.score)
    }
}

/// The search for one object in one image.
struct Search<'a> {
    model: &'a Pix2PoseModel,
    image: &'a RgbImage,
    camera: &'a Camera,
    object: AlignedObject<'a>,
    options: &'a AlignOptions,
}

impl Search<'_> {
    /// The aligned and refined pose from a box, before the correction.
    fn from(&self, region: &Rect) -> Result<Option<Aligned>, EstimateError> {
        let Some(mut best) = self.pass(region)? else { return Ok(None) };
        let mut last_box = *region;
        for _ in 1..self.options.passes.max(1) {
            let Some(whole) = projected_box(self.object.outline, self.camera, &best.camera_from_object)
            else {
                break;
            };
            if !best.improved || !alike(&whole, region) || same(&whole, &last_box) {
                break;
            }
            let Ok(Some(again)) = self.pass(&whole) else { break };
            if !again.improved {
                break;
            }
            (best, last_box) = (again, whole);
        }
        if let Some(refiner) = self.object.refiner.filter(|_| self.options.refiner_weight > 0.0) {
            let aligned = best.camera_from_object;
            let refined = refiner.refine(self.image, self.camera, &aligned).map_err(refiner_error)?;
            best.agreement = refined.map(|r| r.agreement);
            if let Some(refined) = refined {
                let weight = self.options.refiner_weight;
                best.camera_from_object = between(&aligned, &refined.camera_from_object, weight);
            }
        }
        Ok(Some(best))
    }

    /// Both passes of the network, PnP, and the alignment of the outline.
    fn pass(&self, region: &Rect) -> Result<Option<Aligned>, EstimateError> {
        let Search { model, image, camera, object, options } = *self;
        let Some(found) = estimate(model, image, camera, object.id, region, &options.estimate)? else {
            return Ok(None);
        };
        let refined = refine(image, camera, object.outline, &found, &options.refine);
        let score = found.hypotheses.first().map_or(0.0, |h| h.score);
        let (camera_from_object, improved) = (refined.camera_from_object, refined.improved);
        Ok(Some(Aligned { camera_from_object, score, improved, agreement: None, found }))
    }
}

fn refiner_error(error: EstimatorError) -> EstimateError {
    EstimateError::Refiner(Box::new(error))
}

/// A pose on the way from one to another, `weight` of it.
fn between(from: &Pose, to: &Pose, weight: f64) -> Pose {
    *from * Pose::exp(&((from.inverse() * *to).log() * weight))
}

/// Whether the box of a pose can be that of an object visible in `region`: it covers most of it, and is not many times larger.
fn alike(whole: &Rect, region: &Rect) -> bool {
    let common = whole.intersect(region).map_or(0.0, |r| r.width * r.height);
    common > 0.5 * region.width * region.height
        && whole.width.max(whole.height) < 4.0 * region.width.max(region.height)
}

/// Whether two boxes are almost equal, so that another iteration would change nothing.
fn same(a: &Rect, b: &Rect) -> bool {
    let near = |a: f64, b: f64| (a - b).abs() < 0.02 * b.abs().max(10.0);
    let apart = (a.x + 0.5 * a.width - b.x - 0.5 * b.width).abs()
        + (a.y + 0.5 * a.height - b.y - 0.5 * b.height).abs();
    near(a.width, b.width) && near(a.height, b.height) && apart < 0.02 * b.width.max(b.height).max(10.0)
}

/// Fewest photographs to measure the shift, and fewest of an object to measure the error of its distance.
const MIN_PHOTOGRAPHS: usize = 5;
/// Poses with a larger rotation error than this are wrong and not used, radians.
const SAME_ROTATION: f64 = 0.26;
/// Steps of a continuous symmetry, as a fraction of the diameter.
const SYMMETRY_STEP: f64 = 0.1;

/// Measures the systematic error of aligned poses on posed images, per object. The shift is common to all objects, because it comes
/// from camera and annotations; errors of the distance are shrunk towards zero according to their scatter (empirical Bayes, James
/// and Stein 1961). `objects` are meshes from [`sixfold_align::outline::outline_mesh`], with their symmetries. `progress` is called
/// for every image; `None` if it stopped the run.
///
/// # Errors
/// As [`estimate`], for objects that are not in the model.
pub(crate) fn measure_corrections(
    model: &Pix2PoseModel,
    photographs: &[PosedImage],
    objects: &BTreeMap<u32, (Mesh, ModelInfo)>,
    progress: &dyn Progress,
) -> Result<Option<BTreeMap<u32, Correction>>, EstimateError> {
    let options = AlignOptions { correct: false, ..AlignOptions::default() };
    let mut shifts = Vec::new();
    let mut depths: BTreeMap<u32, Vec<f64>> = objects.keys().map(|id| (*id, Vec::new())).collect();
    for (number, photograph) in photographs.iter().enumerate() {
        if !progress.report(number + 1, photographs.len()) {
            return Ok(None);
        }
        let id = photograph.object_id();
        let Some((mesh, info)) = objects.get(&id) else { continue };
        let camera = photograph.camera();
        let Some(region) = photograph.visible_box() else { continue };
        let object = AlignedObject { id, outline: mesh, refiner: None };
        let aligned = estimate_aligned(model, photograph.image(), camera, object, &region, &options)?;
        let Some(aligned) = aligned else { continue };
        let found = aligned.camera_from_object;
        // The nearest of the symmetric poses.
        let away = |pose: &Pose| found.rotation().angle_to(&pose.rotation());
        let alike = info.symmetry_poses(SYMMETRY_STEP).into_iter();
        let truth = alike.map(|symmetry| *photograph.camera_from_object() * symmetry);
        let Some(truth) = truth.min_by(|a, b| away(a).total_cmp(&away(b))) else { continue };
        if !aligned.improved || away(&truth) > SAME_ROTATION {
            continue;
        }
        let (here, there) = (camera.project(&found.translation()), camera.project(&truth.translation()));
        if let (Some(here), Some(there)) = (here, there) {
            shifts.push(here - there);
        }
        depths.entry(id).or_default().push(found.translation().z / truth.translation().z - 1.0);
    }
    Ok(Some(corrections(&shifts, depths)))
}

/// Corrections from the `shifts` of all photographs (pixels) and the relative errors of every object's distance.
fn corrections(shifts: &[Vec2], depths: BTreeMap<u32, Vec<f64>>) -> BTreeMap<u32, Correction> {
    let shift = if shifts.len() < MIN_PHOTOGRAPHS {
        [0.0; 2]
    } else {
        [0, 1].map(|axis| median(&mut shifts.iter().map(|s| s[axis]).collect::<Vec<_>>()))
    };
    let ids: Vec<u32> = depths.keys().copied().collect();
    // Median, and the square of its standard error.
    let measured: BTreeMap<u32, (f64, f64)> = depths
        .into_iter()
        .filter(|(_, values)| values.len() >= MIN_PHOTOGRAPHS)
        .map(|(id, mut values)| {
            let typical = median(&mut values);
            let mut away: Vec<f64> = values.iter().map(|v| (v - typical).abs()).collect();
            let error = 1.2533 * 1.4826 * median(&mut away) / (values.len() as f64).sqrt();
            (id, (typical, error * error))
        })
        .collect();
    let count = measured.len().max(1) as f64;
    let scatter = measured.values().map(|(m, _)| m * m).sum::<f64>() / count;
    let noise = measured.values().map(|(_, e)| e).sum::<f64>() / count;
    let between = (scatter - noise).max(0.0);
    let correction = |id: u32| {
        let depth = measured.get(&id).map_or(0.0, |(typical, error)| {
            let total = between + error;
            if total > 0.0 { typical * between / total } else { 0.0 }
        });
        Correction { shift, depth }
    };
    ids.into_iter().map(|id| (id, correction(id))).collect()
}

/// The median, 0 if there are no values.
fn median(values: &mut [f64]) -> f64 {
    upper_median(values).unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::Vec3;
    use sixfold_geometry::nalgebra::UnitQuaternion;

    #[test]
    fn distances_count_if_significant_against_their_scatter() {
        let shifts: Vec<Vec2> = [0.9, 1.0, 1.1, 1.2, 30.0].map(|x| Vec2::new(x, -x)).to_vec();
        let around = |centre: f64, scatter: f64| -> Vec<f64> {
            (-4..=4).map(|i| centre + 0.25 * scatter * f64::from(i)).collect()
        };
        let known = BTreeMap::from([
            (1, around(0.02, 0.001)),
            (2, around(0.02, 0.06)),
            (3, vec![0.5; MIN_PHOTOGRAPHS - 1]),
        ]);
        let found = corrections(&shifts, known.clone());
        // The outlier has no influence, and the shift is the same for all.
        assert!(found.values().all(|c| c.shift == [1.1, -1.1]), "{found:?}");
        // A certain error is corrected completely, an uncertain one in part, one measured on too few photographs not at all.
        assert!((0.0199..0.02).contains(&found[&1].depth), "{found:?}");
        assert!((0.001..0.015).contains(&found[&2].depth), "{found:?}");
        assert_eq!(found[&3].depth, 0.0);
        // With too few photographs the shift is not corrected either.
        let few = corrections(&shifts[..MIN_PHOTOGRAPHS - 1], known);
        assert!(few.values().all(|c| c.shift == [0.0; 2]), "{few:?}");
        assert_eq!(few[&1].depth, found[&1].depth);
    }

    #[test]
    fn options_out_of_range_are_named() {
        let options = AlignOptions::default();
        assert_eq!(options.check(), Ok(()));
        let named = |options: AlignOptions| options.check().unwrap_err().option;
        assert_eq!(named(AlignOptions { passes: 0, ..options.clone() }), "passes");
        assert_eq!(named(AlignOptions { starts: 0, ..options.clone() }), "starts");
        assert_eq!(named(AlignOptions { starts: MAX_STARTS + 1, ..options.clone() }), "starts");
        assert_eq!(named(AlignOptions { refiner_weight: 1.5, ..options.clone() }), "refiner_weight");
        let estimate = Pix2PoseOptions { thresholds: vec![0.1, f32::NAN], ..options.estimate.clone() };
        assert_eq!(named(AlignOptions { estimate, ..options.clone() }), "thresholds");
        let estimate = Pix2PoseOptions { crop_factor: f64::NAN, ..options.estimate.clone() };
        assert_eq!(named(AlignOptions { estimate, ..options.clone() }), "crop_factor");
        let refine = OutlineRefinementOptions { edges: f64::NAN, ..options.refine.clone() };
        assert_eq!(named(AlignOptions { refine, ..options.clone() }), "refine.edges");
        let refine = OutlineRefinementOptions { first_pass: 1.5, ..options.refine.clone() };
        assert_eq!(named(AlignOptions { refine, ..options }), "refine.first_pass");
    }

    #[test]
    fn a_pose_between_two_others() {
        let from = Pose::new(UnitQuaternion::from_euler_angles(0.1, 0.2, 0.3), Vec3::new(0.02, -0.01, 0.6));
        let to = Pose::new(UnitQuaternion::from_euler_angles(0.15, 0.1, 0.35), Vec3::new(0.03, -0.01, 0.63));
        let near = |a: &Pose, b: &Pose| a.distance_to(b) < 1e-9 && a.rotation_angle_to(b) < 1e-7;
        assert!(near(&between(&from, &to, 0.0), &from) && near(&between(&from, &to, 1.0), &to));
        let third = between(&from, &to, 0.3);
        let (whole, angle) = (from.distance_to(&to), from.rotation_angle_to(&to));
        assert!(
            (third.distance_to(&from) / whole - 0.3).abs() < 0.01,
            "{}",
            third.distance_to(&from) / whole
        );
        assert!((third.rotation_angle_to(&from) / angle - 0.3).abs() < 1e-6);
    }

    #[test]
    fn a_second_look_needs_a_box_about_the_first() {
        let region = Rect { x: 100.0, y: 100.0, width: 40.0, height: 40.0 };
        let of = |x: f64, side: f64| Rect { x, y: x, width: side, height: side };
        assert!(alike(&of(90.0, 80.0), &region));
        assert!(!alike(&of(130.0, 40.0), &region));
        assert!(!alike(&of(60.0, 200.0), &region));
    }
}
