//! From an image to boxes: resizing and padding, decoding, non-maximum suppression with box voting as an option (Gidaris and
//! Komodakis 2015), masks.

use crate::loss::{cell_centre, distance};
use crate::network::{DetectorConfig, FINEST_STRIDE, MASK_STRIDE};
use sixfold_geometry::stats::sigmoid;
use sixfold_geometry::{Mask, Rect, RgbImage};
use sixfold_synth::augment::{AffineMap, Patch};

/// Upper bound of the number of detections per image, of one object or of all.
const MAX_DETECTIONS: usize = 10_000;

/// Upper bound of [`DetectOptions::scales`]: the last image has an eighth of the first one's side.
pub const MAX_SCALES: usize = 7;

/// Which detections are returned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DetectOptions {
    /// Detections with a lower score are left out.
    pub threshold: f32,
    /// Of two boxes of a class with a larger intersection over union, the one with the lower score is left out.
    pub overlap: f32,
    /// Maximum number of detections of a class, the best ones.
    pub per_class: usize,
    /// Maximum number of detections of an image, the best ones.
    pub max_detections: usize,
    /// Number of sizes at which the network processes the image, each smaller by the square root of two: a detector of any object
    /// finds large ones better in a reduced image. Networks with anchors accept 1 only.
    pub scales: usize,
    /// Whether a box is the mean of all boxes that it suppresses, weighted by their scores (box voting, Gidaris and Komodakis 2015,
    /// "Object detection via a multi-region and semantic segmentation-aware CNN model", section 5). Networks with anchors ignore it.
    pub voting: bool,
    /// Also compute masks.
    pub masks: bool,
}

impl Default for DetectOptions {
    /// For display and for poses: only confident detections.
    fn default() -> Self {
        DetectOptions {
            threshold: 0.4,
            overlap: 0.5,
            per_class: 100,
            max_detections: 100,
            scales: 1,
            voting: false,
            masks: true,
        }
    }
}

impl DetectOptions {
    /// For average precision, which also needs uncertain detections.
    pub fn for_scores() -> Self {
        DetectOptions { threshold: 0.02, ..DetectOptions::default() }
    }

    /// Tests every field.
    ///
    /// # Errors
    /// A text with the field, its value and the values allowed.
    pub fn check(&self) -> Result<(), String> {
        for (field, value) in [("threshold", self.threshold), ("overlap", self.overlap)] {
            if !(0.0..=1.0).contains(&value) {
                return Err(format!("detection option {field}: found {value}, expected 0 to 1"));
            }
        }
        for (field, value) in
            [("per_class (--per-object)", self.per_class), ("max_detections", self.max_detections)]
        {
            if !(1..=MAX_DETECTIONS).contains(&value) {
                return Err(format!(
                    "detection option {field}: found {value}, expected 1 to {MAX_DETECTIONS}"
                ));
            }
        }
        if !(1..=MAX_SCALES).contains(&self.scales) {
            return Err(format!(
                "detection option scales: found {}, expected 1 to {MAX_SCALES}",
                self.scales
            ));
        }
        Ok(())
    }
}

/// A detected object.
#[derive(Debug, Clone, PartialEq)]
pub struct Detected {
    /// Index of its class in the network.
    pub class: usize,
    /// Confidence, 0..1: the expected overlap of the box with the true one.
    pub score: f32,
    /// Box of the visible part in the image's pixels: first pixel, last minus first, as BOP's `bbox_visib`.
    pub bbox: Rect,
    /// Mask of the visible part, of the image's size, if requested.
    pub mask: Option<Mask>,
}

/// An image at the network's scale.
#[derive(Debug, Clone)]
pub struct NetworkImage {
    /// 3 x height x width, scaled for the encoder.
    pub values: Vec<f32>,
    /// Columns, multiple of the alignment.
    pub width: usize,
    /// Rows, multiple of the alignment.
    pub height: usize,
    /// Columns and rows that show the image; the rest is grey.
    pub filled: [usize; 2],
    /// Image pixels per network pixel along a side.
    pub step: f32,
}

impl NetworkImage {
    /// An image reduced to at most `longest_side` pixels along its longer side (never enlarged), with grey to the right
    /// and below. `None` for an image without pixels.
    pub fn new(image: &RgbImage, config: &DetectorConfig, longest_side: usize) -> Option<NetworkImage> {
        let (w, h) = image.size();
        if w == 0 || h == 0 {
            return None;
        }
        let step = (w.max(h) as f32 / longest_side.max(1) as f32).max(1.0);
        let filled = [w, h].map(|side| ((side as f32 / step).round() as usize).max(1));
        let alignment = config.alignment();
        let [width, height] = filled.map(|side| side.next_multiple_of(alignment));
        let mut values = vec![0.5; 3 * width * height];
        if step == 1.0 {
            for (y, row) in (0..h).map(|y| (y, image.row(y))) {
                for (x, rgb) in row.iter().enumerate() {
                    for c in 0..3 {
                        values[(c * height + y) * width + x] = f32::from(rgb[c]) * (1.0 / 255.0);
                    }
                }
            }
        } else {
            let offset = 0.5 * (step - 1.0);
            let map = AffineMap { x: [step, 0.0, offset], y: [0.0, step, offset] };
            let (patch, _) = Patch::warp(image, &map, filled[0], filled[1], [0.5; 3]);
            for c in 0..3 {
                for y in 0..filled[1] {
                    values[(c * height + y) * width..][..filled[0]]
                        .copy_from_slice(&patch.data[(c * filled[1] + y) * filled[0]..][..filled[0]]);
                }
            }
        }
        config.input(&mut values, width * height);
        Some(NetworkImage { values, width, height, filled, step })
    }
}

/// Network output of one image as plain numbers.
#[derive(Debug, Clone)]
pub struct Numbers {
    /// Logits of every level.
    pub scores: Vec<Vec<f32>>,
    /// Sides, coefficients, bias of every level.
    pub boxes: Vec<Vec<f32>>,
    /// Prototypes.
    pub prototypes: Vec<f32>,
}

/// A box before suppression.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    class: usize,
    score: f32,
    /// Left, top, right, bottom in pixels of the first scale.
    corners: [f32; 4],
    scale: usize,
    level: usize,
    location: usize,
}

fn overlap(a: &[f32; 4], b: &[f32; 4]) -> f32 {
    let w = a[2].min(b[2]) - a[0].max(b[0]);
    let h = a[3].min(b[3]) - a[1].max(b[1]);
    if w <= 0.0 || h <= 0.0 {
        return 0.0;
    }
    let area = |r: &[f32; 4]| (r[2] - r[0]) * (r[3] - r[1]);
    w * h / (area(a) + area(b) - w * h)
}

/// Non-maximum suppression for each class separately: in order of decreasing score, boxes that overlap a kept box of their class by
/// more than `overlap` are left out; at most `per_class` of a class and `max_detections` in total are kept. Equal scores keep their
/// order. With `voting` the boxes are then means.
fn suppress(mut candidates: Vec<Candidate>, options: &DetectOptions) -> Vec<Candidate> {
    let DetectOptions { overlap: most_overlap, per_class, max_detections, voting, .. } = *options;
    candidates.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut kept: Vec<Candidate> = vec![];
    for c in &candidates {
        if kept.len() == max_detections {
            break;
        }
        let mut same = kept.iter().filter(|k| k.class == c.class);
        if same.clone().count() < per_class && !same.any(|k| overlap(&k.corners, &c.corners) > most_overlap) {
            kept.push(*c);
        }
    }
    if voting {
        let voted: Vec<[f32; 4]> = kept.iter().map(|k| voted(k, &candidates, most_overlap)).collect();
        kept.iter_mut().zip(voted).for_each(|(k, corners)| k.corners = corners);
    }
    kept
}

/// The mean of all boxes of the class that overlap a box by more than `most_overlap`, itself included, weighted by their scores.
fn voted(of: &Candidate, candidates: &[Candidate], most_overlap: f32) -> [f32; 4] {
    let mut sum = [0.0f32; 4];
    let mut weight = 0.0;
    for c in candidates {
        if c.class == of.class && overlap(&of.corners, &c.corners) > most_overlap {
            sum.iter_mut().zip(c.corners).for_each(|(sum, side)| *sum += c.score * side);
            weight += c.score;
        }
    }
    // Without a vote (an overlap of 1, scores of 0) the box stays.
    if weight > 0.0 { sum.map(|side| side / weight) } else { of.corners }
}

/// Pixels of one scale in those of another whose pixels are `1 / ratio` times as large; a ratio of 1 changes nothing.
fn rescaled(corners: [f32; 4], ratio: f32) -> [f32; 4] {
    if ratio == 1.0 { corners } else { corners.map(|v| (v + 0.5) * ratio - 0.5) }
}

/// The boxes of one scale with at least the threshold's score, best first, in its own pixels.
fn candidates(
    raw: &Numbers,
    image: &NetworkImage,
    scale: usize,
    config: &DetectorConfig,
    threshold: f32,
) -> Vec<Candidate> {
    /// Maximum number of candidates of a scale.
    const MAX_CANDIDATES: usize = 2000;
    let threshold = threshold.clamp(1e-4, 1.0 - 1e-6);
    let min_logit = (threshold / (1.0 - threshold)).ln();
    let limits = image.filled.map(|side| side as f32 - 0.5);
    let mut candidates = vec![];
    for level in 0..config.levels {
        let stride = config.stride(level);
        let width = image.width / stride;
        let locations = width * (image.height / stride);
        for (index, logit) in raw.scores[level].iter().enumerate() {
            if *logit < min_logit {
                continue;
            }
            let (class, location) = (index / locations, index % locations);
            let [x, y] = cell_centre(location, width, stride as f32);
            let far: [f32; 4] =
                std::array::from_fn(|i| distance(raw.boxes[level][i * locations + location], stride as f32));
            let corners = [
                (x - far[0]).clamp(-0.5, limits[0]),
                (y - far[1]).clamp(-0.5, limits[1]),
                (x + far[2]).clamp(-0.5, limits[0]),
                (y + far[3]).clamp(-0.5, limits[1]),
            ];
            if corners[2] - corners[0] >= 1.0 && corners[3] - corners[1] >= 1.0 {
                candidates.push(Candidate { class, score: sigmoid(*logit), corners, scale, level, location });
            }
        }
    }
    candidates.sort_by(|a, b| b.score.total_cmp(&a.score));
    candidates.truncate(MAX_CANDIDATES);
    candidates
}

/// Detections in an image of `size` (columns, rows), best first, from the network's output at one or more scales. Boxes of all scales
/// are suppressed together: one that is suppressed by a box that is itself suppressed would be lost.
pub fn decode(
    scales: &[(NetworkImage, Numbers)],
    size: (usize, usize),
    config: &DetectorConfig,
    options: &DetectOptions,
) -> Vec<Detected> {
    let Some(first) = scales.first().map(|(image, _)| image.step) else { return vec![] };
    let ratio = |scale: usize| scales[scale].0.step / first;
    let all = scales.iter().enumerate().flat_map(|(scale, (image, raw))| {
        let found = candidates(raw, image, scale, config, options.threshold);
        found.into_iter().map(move |c| Candidate { corners: rescaled(c.corners, ratio(scale)), ..c })
    });
    let to_image =
        |v: f32, last: usize| f64::from(((v + 0.5) * first - 0.5).clamp(0.0, last.saturating_sub(1) as f32));
    suppress(all.collect(), options)
        .into_iter()
        .map(|c| {
            let [left, top, right, bottom] = c.corners;
            let (x, y) = (to_image(left, size.0), to_image(top, size.1));
            let bbox =
                Rect { x, y, width: to_image(right, size.0) - x, height: to_image(bottom, size.1) - y };
            let mask = options.masks.then(|| {
                let (image, raw) = &scales[c.scale];
                let own = Candidate { corners: rescaled(c.corners, 1.0 / ratio(c.scale)), ..c };
                mask_of(raw, image, size, config, &own)
            });
            Detected { class: c.class, score: c.score, bbox, mask }
        })
        .collect()
}

/// A candidate's mask in the image: the sum of prototypes within its box, one block of prototype pixels wider.
fn mask_of(
    raw: &Numbers,
    image: &NetworkImage,
    size: (usize, usize),
    config: &DetectorConfig,
    c: &Candidate,
) -> Mask {
    let stride = FINEST_STRIDE << c.level;
    let locations = (image.width / stride) * (image.height / stride);
    let numbers: Vec<f32> =
        (0..=config.prototypes).map(|k| raw.boxes[c.level][(4 + k) * locations + c.location]).collect();
    let (width, height) = (image.width / MASK_STRIDE, image.height / MASK_STRIDE);
    let span = |low: f32, high: f32, limit: usize| {
        let first = (low.max(0.0) as usize / MASK_STRIDE).saturating_sub(1).min(limit - 1);
        (first, (high.max(0.0) as usize / MASK_STRIDE + 2).clamp(first + 1, limit))
    };
    let (x0, x1) = span(c.corners[0], c.corners[2], width);
    let (y0, y1) = span(c.corners[1], c.corners[3], height);
    let (columns, rows) = (x1 - x0, y1 - y0);
    let mut logits = vec![numbers[config.prototypes]; columns * rows];
    for (k, number) in numbers[..config.prototypes].iter().enumerate() {
        for row in 0..rows {
            let source = &raw.prototypes[(k * height + y0 + row) * width + x0..][..columns];
            let target = &mut logits[row * columns..][..columns];
            target.iter_mut().zip(source).for_each(|(t, s)| *t += number * s);
        }
    }
    let at = |x: usize, y: usize| logits[y.min(rows - 1) * columns + x.min(columns - 1)];
    let mut mask = Mask::filled(size.0, size.1, false);
    let span = |low: f32, high: f32, limit: usize| {
        let at = |v: f32| ((v + 0.5) * image.step).clamp(0.0, limit as f32);
        at(low - 0.5).floor() as usize..at(high + 0.5).ceil() as usize
    };
    let per_mask = MASK_STRIDE as f32;
    for y in span(c.corners[1], c.corners[3], size.1) {
        // Position of the pixel between the centres of the prototypes' pixels.
        let v = (((y as f32 + 0.5) / image.step) / per_mask - 0.5 - y0 as f32).max(0.0);
        for x in span(c.corners[0], c.corners[2], size.0) {
            let u = (((x as f32 + 0.5) / image.step) / per_mask - 0.5 - x0 as f32).max(0.0);
            let (i, j) = (u as usize, v as usize);
            let (fx, fy) = (u - i as f32, v - j as f32);
            let top = at(i, j) * (1.0 - fx) + at(i + 1, j) * fx;
            let bottom = at(i, j + 1) * (1.0 - fx) + at(i + 1, j + 1) * fx;
            mask[(x, y)] = top * (1.0 - fy) + bottom * fy > 0.0;
        }
    }
    mask
}

#[cfg(test)]
mod tests {
    use super::*;

    fn candidate(class: usize, score: f32, corners: [f32; 4]) -> Candidate {
        Candidate { class, score, corners, scale: 0, level: 0, location: 0 }
    }

    #[test]
    fn of_overlapping_boxes_of_a_class_the_best_stays() {
        let all = vec![
            candidate(0, 0.5, [0.0, 0.0, 10.0, 10.0]),
            candidate(0, 0.9, [1.0, 0.0, 11.0, 10.0]),
            candidate(1, 0.4, [0.0, 0.0, 10.0, 10.0]),
            candidate(0, 0.6, [20.0, 0.0, 30.0, 10.0]),
        ];
        let scores = |kept: Vec<Candidate>| kept.iter().map(|c| c.score).collect::<Vec<_>>();
        let options = DetectOptions::default();
        assert_eq!(scores(suppress(all.clone(), &options)), [0.9, 0.6, 0.4]);
        assert_eq!(scores(suppress(all.clone(), &DetectOptions { per_class: 1, ..options })), [0.9, 0.4]);
        assert_eq!(scores(suppress(all.clone(), &DetectOptions { max_detections: 1, ..options })), [0.9]);
        assert_eq!(scores(suppress(all, &DetectOptions { overlap: 0.9, ..options })), [0.9, 0.6, 0.5, 0.4]);
    }

    #[test]
    fn with_voting_a_box_is_the_mean_of_those_that_it_suppresses() {
        let all = vec![
            candidate(0, 0.25, [0.0, 0.0, 10.0, 10.0]),
            candidate(0, 0.75, [1.0, 0.0, 11.0, 12.0]),
            candidate(1, 0.5, [0.0, 0.0, 10.0, 10.0]),
            candidate(0, 0.5, [20.0, 0.0, 30.0, 10.0]),
        ];
        let corners = |options: &DetectOptions| {
            suppress(all.clone(), options).iter().map(|c| c.corners).collect::<Vec<_>>()
        };
        let options = DetectOptions { voting: true, ..DetectOptions::default() };
        let others = [[0.0, 0.0, 10.0, 10.0], [20.0, 0.0, 30.0, 10.0]];
        assert_eq!(corners(&options), [[0.75, 0.0, 10.75, 11.5], others[0], others[1]]);
        assert_eq!(corners(&DetectOptions { voting: false, ..options })[0], all[1].corners);
        // Nothing overlaps by more than 1, not even a box with itself.
        assert_eq!(corners(&DetectOptions { overlap: 1.0, ..options })[0], all[1].corners);
    }

    /// An image of 128x128 pixels at the scale `step`, whose network finds one object at a location of the finest level: its score's
    /// logit, column and row, and the distance of its four sides.
    fn seen(step: f32, found: &[(f32, [usize; 2], f32)]) -> (NetworkImage, Numbers) {
        let side = (128.0 / step) as usize;
        let image = NetworkImage { values: vec![], width: side, height: side, filled: [side; 2], step };
        let sizes = [8, 16, 32].map(|stride| (side / stride) * (side / stride));
        let mut raw = Numbers {
            scores: sizes.iter().map(|n| vec![-9.0; *n]).collect(),
            boxes: sizes.iter().map(|n| vec![0.0; 6 * n]).collect(),
            prototypes: vec![1.0; (side / 4) * (side / 4)],
        };
        for (logit, [column, row], far) in found {
            let location = row * (side / 8) + column;
            raw.scores[0][location] = *logit;
            (0..4).for_each(|i| raw.boxes[0][i * sizes[0] + location] = (far / 8.0).ln());
            raw.boxes[0][4 * sizes[0] + location] = 1.0;
        }
        (image, raw)
    }

    #[test]
    fn detections_of_several_scales_are_suppressed_as_those_of_one() {
        let config = DetectorConfig { prototypes: 1, ..DetectorConfig::compact(1) };
        // At both scales an object around (35.5, 35.5), 32 pixels wide; at the coarser one it is 34 pixels wide. Another at each.
        let scales = [
            seen(1.0, &[(2.0, [4, 4], 16.0), (0.5, [12, 4], 16.0)]),
            seen(2.0, &[(1.0, [2, 2], 8.5), (1.5, [6, 6], 8.0)]),
        ];
        let detect = |options: &DetectOptions| decode(&scales, (128, 128), &config, options);
        let options = DetectOptions { overlap: 0.6, ..DetectOptions::default() };
        let scores = |found: &[Detected]| found.iter().map(|d| (10.0 * d.score).round()).collect::<Vec<_>>();
        let found = detect(&options);
        assert_eq!(scores(&found), [9.0, 8.0, 6.0]);
        let close = |d: &Detected, expected: [f64; 4]| {
            let found = [d.bbox.x, d.bbox.y, d.bbox.width, d.bbox.height];
            assert!(found.iter().zip(expected).all(|(f, e)| (f - e).abs() < 1e-3), "{found:?}");
        };
        close(&found[0], [19.5, 19.5, 32.0, 32.0]);
        // Location (6, 6) of the coarser scale: its centre 51.5 is 103.5 in the image.
        close(&found[1], [87.5, 87.5, 32.0, 32.0]);
        // Its mask fills its box, read from the prototypes of its own scale.
        let mask = found[1].mask.as_ref().unwrap();
        let count = mask.as_slice().iter().filter(|inside| **inside).count();
        assert!(mask[(103, 103)] && !mask[(80, 103)] && (32 * 32..36 * 36).contains(&count), "{count}");
        assert_eq!(detect(&DetectOptions { max_detections: 2, ..options }).len(), 2);
        assert_eq!(detect(&DetectOptions { overlap: 0.95, ..options }).len(), 4);
        // With voting the boxes of both scales count: 19.5 to 51.5 with a score of 0.881, and 22.5 to 56.5 with 0.731.
        let voted = &detect(&DetectOptions { voting: true, ..options });
        assert_eq!(scores(voted), [9.0, 8.0, 6.0]);
        close(&voted[0], [20.861, 20.861, 32.907, 32.907]);
        close(&voted[1], [87.5, 87.5, 32.0, 32.0]);
        for scales in [0, MAX_SCALES + 1] {
            let message = DetectOptions { scales, ..options }.check().unwrap_err();
            assert!(message.contains("scales") && message.contains("1 to 7"), "{message}");
        }
    }

    #[test]
    fn a_location_becomes_a_box_and_a_mask_in_the_image() {
        let config = DetectorConfig { prototypes: 1, ..DetectorConfig::compact(2) };
        // An image of twice the network's size: 160x128 to 80x64, padded to 96x64.
        let image = RgbImage::filled(160, 128, [127; 3]);
        let input = NetworkImage::new(&image, &config, 80).unwrap();
        assert_eq!((input.width, input.height, input.filled, input.step), (96, 64, [80, 64], 2.0));
        assert!(input.values.iter().all(|v| v.abs() < 0.01));
        let sizes = [12 * 8, 6 * 4, 3 * 2];
        let mut raw = Numbers {
            scores: sizes.iter().map(|n| vec![-9.0; 2 * n]).collect(),
            boxes: sizes.iter().map(|n| vec![0.0; 6 * n]).collect(),
            prototypes: vec![0.0; 24 * 16],
        };
        // Location (4, 3) of level 0, centre (35.5, 27.5): class 1, 8 pixels up, 16 to the other sides.
        let location = 3 * 12 + 4;
        raw.scores[0][96 + location] = 2.0;
        for i in [0, 2, 3] {
            raw.boxes[0][i * 96 + location] = 2.0f32.ln();
        }
        raw.boxes[0][4 * 96 + location] = 1.0;
        raw.boxes[0][5 * 96 + location] = -0.5;
        // The prototype is positive in its left half, up to network pixel 35.
        for row in raw.prototypes.chunks_exact_mut(24) {
            row[..9].fill(1.0);
        }
        let found = decode(&[(input, raw)], image.size(), &config, &DetectOptions::default());
        assert_eq!(found.len(), 1);
        let d = &found[0];
        assert_eq!(d.class, 1);
        assert!((d.score - sigmoid(2.0)).abs() < 1e-6);
        let expected = [39.5, 39.5, 64.0, 48.0];
        let found = [d.bbox.x, d.bbox.y, d.bbox.width, d.bbox.height];
        assert!(found.iter().zip(expected).all(|(f, e)| (f - e).abs() < 1e-3), "{found:?}");
        let mask = d.mask.as_ref().unwrap();
        let columns: Vec<usize> = (0..160).filter(|x| mask[(*x, 60)]).collect();
        assert_eq!((columns[0], columns[columns.len() - 1]), (39, 71));
        assert!((0..128).all(|y| !mask[(50, y)] || (39..=88).contains(&y)));
    }

    #[test]
    fn images_of_any_size() {
        let config = DetectorConfig::compact(1);
        for (w, h) in [(1, 1), (33, 700), (2000, 10), (640, 480)] {
            let image = NetworkImage::new(&RgbImage::filled(w, h, [9; 3]), &config, 640).unwrap();
            assert!(
                image.width.is_multiple_of(32)
                    && image.height.is_multiple_of(32)
                    && image.width.max(image.height) <= 640
            );
        }
        assert!(NetworkImage::new(&RgbImage::filled(0, 0, [9; 3]), &config, 640).is_none());
    }
}
