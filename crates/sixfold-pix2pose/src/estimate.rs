//! Poses from an image and boxes: two passes of the network, PnP with RANSAC, a score (section 3.3).
//!
//! The input of the first pass is the box with its surroundings; it finds the object's pixels, on which the crop is then centred.
//! The input of the second is the crop without background, once for every outlier threshold, all in one batch. The candidate with
//! the most inliers is chosen; the others are kept as hypotheses. [`Pix2PoseOptions::published`] is the dissertation's form.

use crate::model::{ModelError, Pix2PoseModel, Prediction};
use crate::object::ObjectEntry;
use crate::samples::second_stage::GREY;
use rayon::prelude::*;
use sixfold_geometry::{
    Camera, OptionError, PnpOptions, PnpSolver, Pose, Rect, RgbImage, Vec2, Vec3, pnp_ransac,
};
use sixfold_synth::augment::{Patch, Window};

/// Options of the pose estimation. Deviations of the author's code from the dissertation can be enabled for comparisons.
#[derive(Debug, Clone, PartialEq)]
pub struct Pix2PoseOptions {
    /// Outlier thresholds on the expected error; if empty, those of the model's object are used.
    pub thresholds: Vec<f32>,
    /// Whether there are two passes; otherwise poses come from the first.
    pub two_stages: bool,
    /// Ratio of the crop's side to the longer side of the box.
    pub crop_factor: f64,
    /// Expected error below which a pixel of the second pass is a correspondence, the dissertation's theta_i; `None`: the
    /// outlier threshold of the pass, at least 0.3.
    pub inlier_threshold: Option<f32>,
    /// Reprojection error below which a correspondence is an inlier of PnP, the dissertation's theta_re.
    pub reprojection: Reprojection,
    /// The minimal solver of PnP.
    pub solver: PnpSolver,
    /// What the second crop is centred on.
    pub recentring: Recentring,
    /// Whether the second crop with its background is a candidate in addition to those without.
    pub open_candidate: bool,
    /// Seed of RANSAC.
    pub seed: u64,
    /// The author's bugs, one by one.
    pub quirks: Quirks,
}

impl Default for Pix2PoseOptions {
    fn default() -> Self {
        Self {
            thresholds: Vec::new(),
            two_stages: true,
            crop_factor: 1.5,
            inlier_threshold: None,
            reprojection: Reprojection::NetworkPixels(1.5),
            solver: PnpSolver::Ap3p,
            recentring: Recentring::Box,
            open_candidate: true,
            seed: 0,
            quirks: Quirks::default(),
        }
    }
}

/// Unit of the reprojection error's threshold.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Reprojection {
    /// Pixels of the network's output; at least 1.5 image pixels are allowed.
    NetworkPixels(f64),
    /// Pixels of the image.
    ImagePixels(f64),
}

/// What the second crop is centred on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Recentring {
    /// The box of the object's pixels, uncertain ones included; the crop shrinks with it.
    Box,
    /// The centroid of the mask for each outlier threshold; the crop keeps its size.
    Centroid,
}

impl Pix2PoseOptions {
    /// The dissertation's two stages (sections 3.3.1 and 3.3.2) with its standard parameters (section 3.4.1): theta_i = 0.1,
    /// theta_re = 3 pixels, EPnP in RANSAC, the crop centred on the mask's centroid and without background.
    pub fn published() -> Self {
        Self {
            inlier_threshold: Some(0.1),
            reprojection: Reprojection::ImagePixels(3.0),
            solver: PnpSolver::Epnp,
            recentring: Recentring::Centroid,
            open_candidate: false,
            ..Self::default()
        }
    }

    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        for threshold in &self.thresholds {
            if threshold.is_nan() || *threshold <= 0.0 {
                return Err(OptionError::new("thresholds", threshold, "numbers above 0"));
            }
        }
        OptionError::unless_positive("crop_factor", self.crop_factor, "a finite number above 0")?;
        if let Some(threshold) = self.inlier_threshold
            && (threshold.is_nan() || threshold <= 0.0)
        {
            return Err(OptionError::new("inlier_threshold", threshold, "a number above 0"));
        }
        let (Reprojection::NetworkPixels(pixels) | Reprojection::ImagePixels(pixels)) = self.reprojection;
        OptionError::unless_positive("reprojection", pixels, "pixels above 0")
    }
}

/// What the author's code does differently from the dissertation, to measure the effect of each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Quirks {
    /// The second crop's shift is measured in network pixels and added to image pixels.
    pub unscaled_recentring: bool,
    /// Coordinates are quantised to 8 bits.
    pub eight_bits: bool,
    /// The candidate with the smallest (projected centre - mask centroid)^2 / inliers is chosen, instead of the one with the most
    /// inliers.
    pub centre_choice: bool,
    /// EPnP with 5 px, 100 iterations and no final refinement.
    pub plain_pnp: bool,
}

impl Quirks {
    /// All deviations.
    pub fn all() -> Self {
        Self { unscaled_recentring: true, eight_bits: true, centre_choice: true, plain_pnp: true }
    }
}

/// Why the estimation could not run. Finding no object is not an error.
#[derive(Debug, thiserror::Error)]
pub enum EstimateError {
    /// The model was not trained on the object.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A box without area, or with numbers that are not finite.
    #[error("box: found x {x}, y {y}, width {width}, height {height}; expected finite numbers and at least 2 pixels a side", x = .0.x, y = .0.y, width = .0.width, height = .0.height)]
    Box(Rect),
    /// The box is outside the image.
    #[error("box: {box_:?} lies outside the {width}x{height} image")]
    Outside {
        /// The box.
        box_: Rect,
        /// The image's width.
        width: usize,
        /// The image's height.
        height: usize,
    },
    /// Image and camera differ in size.
    #[error("image has {width}x{height} pixels, the camera is for {camera_width}x{camera_height}")]
    Size {
        /// The image's width.
        width: usize,
        /// The image's height.
        height: usize,
        /// The camera's width.
        camera_width: usize,
        /// The camera's height.
        camera_height: usize,
    },
    /// The image has lens distortion.
    #[error("the camera has lens distortion: undistort image and camera first")]
    Distorted,
    /// The refiner failed.
    #[error(transparent)]
    Refiner(Box<sixfold_estimator::EstimatorError>),
}

/// A pose with its inliers and score.
#[derive(Debug, Clone, PartialEq)]
pub struct ThresholdHypothesis {
    /// The pose, metres.
    pub camera_from_object: Pose,
    /// The outlier threshold of its second pass.
    pub threshold: f32,
    /// Number of correspondences that agree with the pose.
    pub inliers: usize,
    /// Ratio of inliers to the object's pixels of the first pass, 0 to 1: the dissertation's score.
    pub score: f64,
}

/// The result for one box.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// Best first, never empty.
    pub hypotheses: Vec<ThresholdHypothesis>,
    /// Input and output of the last pass, for the best hypothesis.
    pub view: View,
    /// The same with the background: a crop without background does not show the object's border. Without
    /// [`Pix2PoseOptions::open_candidate`] it is that of the last outlier threshold.
    pub open_view: View,
    /// Input and output of the first pass: the box as given.
    pub first_view: View,
    /// Object and image points of the best hypothesis' correspondences, metres and pixels.
    pub object_points: Vec<Vec3>,
    /// In the order of `object_points`.
    pub image_points: Vec<Vec2>,
}

/// A crop with its prediction.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// The crop's square in the image.
    pub window: Rect,
    /// The network's input.
    pub input: RgbImage,
    /// Its output.
    pub prediction: Prediction,
}

/// Fewest pixels of an object after the first pass.
const MIN_PIXELS: usize = 10;
/// A visible pixel has at least this probability.
const VISIBLE: f32 = 0.5;

/// Estimates the pose of one object in a box of a pinhole image; `None` if its pixels are not in it.
///
/// # Errors
/// [`EstimateError`] for an object that is not in the model, a box without area or outside the image, and an image of another size
/// than its camera's.
pub fn estimate(
    model: &Pix2PoseModel,
    image: &RgbImage,
    camera: &Camera,
    object_id: u32,
    region: &Rect,
    options: &Pix2PoseOptions,
) -> Result<Option<Found>, EstimateError> {
    let (index, object) = model.object(object_id)?;
    check(image, camera, region)?;
    let centre = Vec2::new(region.x + 0.5 * (region.width - 1.0), region.y + 0.5 * (region.height - 1.0));
    let window = Window { centre, side: region.width.max(region.height).max(8.0) * options.crop_factor };
    let crop = Crop::cut(image, camera, window, model.sizes().input);
    let Some(first) = model.predict(index, &crop.pixels).pop() else { return Ok(None) };
    let mask = object_mask(&first, f32::INFINITY);
    let visible = mask.iter().filter(|m| **m).count();
    if visible < MIN_PIXELS {
        return Ok(None);
    }
    let thresholds = if options.thresholds.is_empty() { &object.thresholds } else { &options.thresholds };
    let context = Context { camera, object, options, visible };
    if !options.two_stages {
        let open = view(&crop, &first);
        return Ok(context.best(vec![(thresholds[thresholds.len() / 2], crop, first)], open.clone(), open));
    }
    let first_view = view(&crop, &first);
    let cut = |window: Window| Crop::cut(image, camera, window, model.sizes().input);
    // The crop follows the object's pixels; it is not enlarged.
    let scaled = cut(recentred(&window, &mask, first.side, options));
    let mut candidates: Vec<(f32, Crop)> = Vec::new();
    for &threshold in thresholds {
        let mask = object_mask(&first, threshold);
        if mask.iter().filter(|m| **m).count() < MIN_PIXELS {
            continue;
        }
        let closed = match options.recentring {
            Recentring::Box => scaled.without_background(&crop.window, &grown(&mask, first.side), first.side),
            Recentring::Centroid => cut(on_centroid(&crop.window, &mask, first.side)).without_background(
                &crop.window,
                &mask,
                first.side,
            ),
        };
        candidates.push((threshold, closed));
    }
    if candidates.is_empty() {
        return Ok(None);
    }
    if options.open_candidate {
        // The last of the batch keeps its background; it is a candidate too.
        candidates.push((thresholds.iter().copied().fold(0.0, f32::max), scaled));
    }
    let batch: Vec<f32> = candidates.iter().flat_map(|(_, crop)| crop.pixels.iter().copied()).collect();
    let predictions = model.predict(index, &batch);
    let views: Vec<(f32, Crop, Prediction)> =
        candidates.into_iter().zip(predictions).map(|((t, crop), p)| (t, crop, p)).collect();
    let Some(open) = views.last().map(|(_, crop, prediction)| view(crop, prediction)) else {
        return Ok(None);
    };
    Ok(context.best(views, first_view, open))
}

fn check(image: &RgbImage, camera: &Camera, region: &Rect) -> Result<(), EstimateError> {
    let (width, height) = image.size();
    if (width, height) != (camera.width, camera.height) {
        let (camera_width, camera_height) = (camera.width, camera.height);
        return Err(EstimateError::Size { width, height, camera_width, camera_height });
    }
    if camera.distortion.is_some() {
        return Err(EstimateError::Distorted);
    }
    let finite = [region.x, region.y, region.width, region.height].iter().all(|v| v.is_finite());
    if !finite || region.width < 2.0 || region.height < 2.0 {
        return Err(EstimateError::Box(*region));
    }
    let whole = Rect { x: 0.0, y: 0.0, width: width as f64, height: height as f64 };
    if region.intersect(&whole).is_none() {
        return Err(EstimateError::Outside { box_: *region, width, height });
    }
    Ok(())
}

/// The object's pixels in the first pass, without uncertain ones.
fn object_mask(prediction: &Prediction, threshold: f32) -> Vec<bool> {
    prediction.visible.iter().zip(&prediction.error).map(|(v, e)| *v > VISIBLE && *e < threshold).collect()
}

/// The mask dilated by its direct neighbours: thresholds remove the most uncertain pixels, which are at the border.
fn grown(mask: &[bool], side: usize) -> Vec<bool> {
    (0..mask.len())
        .map(|i| {
            let (x, y) = (i % side, i / side);
            mask[i]
                || (x > 0 && mask[i - 1])
                || (x + 1 < side && mask[i + 1])
                || (y > 0 && mask[i - side])
                || (y + 1 < side && mask[i + side])
        })
        .collect()
}

/// A crop and its prediction for the caller.
fn view(crop: &Crop, prediction: &Prediction) -> View {
    let side = crop.window.side;
    let corner = crop.window.centre - Vec2::repeat(0.5 * side);
    let window = Rect { x: corner.x, y: corner.y, width: side, height: side };
    View { window, input: crop.picture(), prediction: prediction.clone() }
}

/// The window around the object's pixels: their bounding box times the crop factor, not larger than before.
fn recentred(window: &Window, mask: &[bool], side: usize, options: &Pix2PoseOptions) -> Window {
    let (mut low, mut high) = (Vec2::repeat(f64::INFINITY), Vec2::repeat(f64::NEG_INFINITY));
    for index in (0..mask.len()).filter(|i| mask[*i]) {
        let pixel = Vec2::new((index % side) as f64, (index / side) as f64);
        (low, high) = (low.inf(&pixel), high.sup(&pixel));
    }
    let step = window.side / side as f64;
    let shift = (low + high) * 0.5 - Vec2::repeat(0.5 * (side as f64 - 1.0));
    if options.quirks.unscaled_recentring {
        // In the author's code the network's output has 128 pixels.
        return Window { centre: window.centre + shift * (128.0 / side as f64), side: window.side };
    }
    let longest = (high - low).max() + 1.0;
    let new_side = (longest * step * options.crop_factor).clamp(0.6 * window.side, window.side);
    Window { centre: window.centre + shift * step, side: new_side }
}

/// The window moved to the centroid of the object's pixels (section 3.3.1); its size is unchanged.
fn on_centroid(window: &Window, mask: &[bool], side: usize) -> Window {
    let (mut sum, mut count) = (Vec2::zeros(), 0usize);
    for index in (0..mask.len()).filter(|i| mask[*i]) {
        sum += Vec2::new((index % side) as f64, (index / side) as f64);
        count += 1;
    }
    let shift = sum / count.max(1) as f64 - Vec2::repeat(0.5 * (side as f64 - 1.0));
    Window { centre: window.centre + shift * (window.side / side as f64), side: window.side }
}

/// A square crop with the network's input size.
#[derive(Debug, Clone)]
struct Crop {
    window: Window,
    side: usize,
    pixels: Vec<f32>,
}

impl Crop {
    fn cut(image: &RgbImage, camera: &Camera, window: Window, side: usize) -> Self {
        let (patch, _) = Patch::warp(image, &window.map(camera, side, 0.0), side, side, [GREY; 3]);
        Self { window, side, pixels: patch.data }
    }

    /// The crop with all pixels outside a mask (`side x side` over the square `of`) grey.
    fn without_background(&self, of: &Window, mask: &[bool], side: usize) -> Self {
        let mut pixels = self.pixels.clone();
        let corner = |window: &Window| window.centre - Vec2::repeat(0.5 * window.side);
        let (here, there) = (corner(&self.window), corner(of));
        let inside = |x: usize, y: usize| {
            let image =
                here + Vec2::new(x as f64 + 0.5, y as f64 + 0.5) * (self.window.side / self.side as f64);
            let at = (image - there) * (side as f64 / of.side);
            // Bilinear between the mask's pixels, with a threshold slightly below one half.
            let at = at - Vec2::repeat(0.5);
            let (x, y) = (at.x.floor(), at.y.floor());
            let (fx, fy) = (at.x - x, at.y - y);
            let value = |dx: f64, dy: f64| {
                let (x, y) = (x + dx, y + dy);
                let within = x >= 0.0 && y >= 0.0 && x < side as f64 && y < side as f64;
                if within && mask[y as usize * side + x as usize] { 1.0 } else { 0.0 }
            };
            (1.0 - fy) * ((1.0 - fx) * value(0.0, 0.0) + fx * value(1.0, 0.0))
                + fy * ((1.0 - fx) * value(0.0, 1.0) + fx * value(1.0, 1.0))
                > 0.4
        };
        let area = self.side * self.side;
        for y in 0..self.side {
            for x in 0..self.side {
                if !inside(x, y) {
                    for plane in 0..3 {
                        pixels[plane * area + y * self.side + x] = GREY;
                    }
                }
            }
        }
        Self { pixels, ..*self }
    }

    fn picture(&self) -> RgbImage {
        let area = self.side * self.side;
        RgbImage::from_fn(self.side, self.side, |x, y| {
            [0, 1, 2]
                .map(|c| (self.pixels[c * area + y * self.side + x] * 255.0).round().clamp(0.0, 255.0) as u8)
        })
    }
}

struct Context<'a> {
    camera: &'a Camera,
    object: &'a ObjectEntry,
    options: &'a Pix2PoseOptions,
    /// Number of the object's pixels in the first pass.
    visible: usize,
}

/// A hypothesis with its correspondences and the distance of its centre from the mask's, image pixels.
struct Candidate {
    hypothesis: ThresholdHypothesis,
    object_points: Vec<Vec3>,
    image_points: Vec<Vec2>,
    off_centre: f64,
}

impl Context<'_> {
    fn best(&self, views: Vec<(f32, Crop, Prediction)>, first_view: View, open_view: View) -> Option<Found> {
        // In the order of the views, independent of the number of threads.
        let candidates: Vec<Option<Candidate>> = views
            .par_iter()
            .map(|(threshold, crop, prediction)| self.pose(*threshold, crop, prediction))
            .collect();
        let mut all: Vec<(Candidate, usize)> =
            candidates.into_iter().enumerate().filter_map(|(index, c)| Some((c?, index))).collect();
        if self.options.quirks.centre_choice {
            let cost = |c: &Candidate| c.off_centre.powi(2) / c.hypothesis.inliers.max(1) as f64;
            all.sort_by(|a, b| cost(&a.0).total_cmp(&cost(&b.0)));
        } else {
            all.sort_by_key(|(candidate, _)| std::cmp::Reverse(candidate.hypothesis.inliers));
        }
        let first = all.first()?;
        let (_, crop, prediction) = &views[first.1];
        Some(Found {
            view: view(crop, prediction),
            open_view,
            first_view,
            object_points: first.0.object_points.clone(),
            image_points: first.0.image_points.clone(),
            hypotheses: all.into_iter().map(|(candidate, _)| candidate.hypothesis).collect(),
        })
    }

    fn pose(&self, threshold: f32, crop: &Crop, prediction: &Prediction) -> Option<Candidate> {
        let side = prediction.side;
        let step = crop.window.side / side as f64;
        let corner = crop.window.centre - Vec2::repeat(0.5 * crop.window.side);
        let scale = self.object.scale();
        let mask = object_mask(prediction, self.options.inlier_threshold.unwrap_or(threshold.max(0.3)));
        let (mut object_points, mut image_points) = (Vec::new(), Vec::new());
        for index in (0..mask.len()).filter(|i| mask[*i]) {
            let mut n = prediction.coordinates[index];
            if self.options.quirks.eight_bits {
                n = n.map(|v| ((v.clamp(-1.0, 1.0) + 1.0) * 127.5).floor() / 127.5 - 1.0);
            }
            object_points.push(scale.restore(&Vec3::new(n[0].into(), n[1].into(), n[2].into())));
            let pixel = Vec2::new((index % side) as f64 + 0.5, (index / side) as f64 + 0.5);
            image_points.push(corner + pixel * step);
        }
        let pnp = if self.options.quirks.plain_pnp {
            PnpOptions {
                threshold_px: 5.0,
                max_iterations: 100,
                min_iterations: 100,
                seed: self.options.seed,
                solver: PnpSolver::Epnp,
                local_iterations: 0,
                refine: false,
                noise_window: 0.0,
                ..PnpOptions::default()
            }
        } else {
            PnpOptions {
                threshold_px: match self.options.reprojection {
                    Reprojection::NetworkPixels(pixels) => (pixels * step).max(1.5),
                    Reprojection::ImagePixels(pixels) => pixels,
                },
                max_iterations: 1000,
                seed: self.options.seed,
                solver: self.options.solver,
                ..PnpOptions::default()
            }
        };
        let report = pnp_ransac(&object_points, &image_points, self.camera, &pnp).ok()?;
        let inliers = report.inlier_count;
        let centroid = image_points.iter().sum::<Vec2>() / image_points.len() as f64;
        let centre = self.camera.project(&report.camera_from_object.transform_point(&scale.centre))?;
        let score = (inliers as f64 / self.visible.max(object_points.len()) as f64).min(1.0);
        Some(Candidate {
            hypothesis: ThresholdHypothesis {
                camera_from_object: report.camera_from_object,
                threshold,
                inliers,
                score,
            },
            object_points,
            image_points,
            off_centre: (centre - centroid).norm(),
        })
    }
}

#[cfg(test)]
mod tests;
