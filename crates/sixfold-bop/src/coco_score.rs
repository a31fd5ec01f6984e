//! COCO's average precision and recall for boxes and masks, number for number what pycocotools 2.0.11 computes
//! (Lin et al. 2014; cocodataset.org, "Detection evaluation").

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;
use sixfold_geometry::Rect;

use crate::coco::{Annotation, CocoGroundTruth, Detection};
use crate::rle::Rle;

/// Whether boxes or masks are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum IouType {
    /// Boxes; a detection without box counts with the box around its mask.
    Box,
    /// Masks; detections without mask are left out.
    Mask,
}

/// COCO's twelve numbers, in `0..=1`; `None` where there is no ground truth of that size (pycocotools prints -1).
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CocoScores {
    /// Mean over overlaps .50 to .95, recalls, objects; at most 100 detections an image.
    pub ap: Option<f64>,
    /// At overlap .50.
    pub ap50: Option<f64>,
    /// At overlap .75.
    pub ap75: Option<f64>,
    /// Objects below 32 x 32 pixels.
    pub ap_small: Option<f64>,
    /// Objects from 32 x 32 to 96 x 96 pixels.
    pub ap_medium: Option<f64>,
    /// Larger objects.
    pub ap_large: Option<f64>,
    /// Recall with one detection an image.
    pub ar1: Option<f64>,
    /// Recall with ten.
    pub ar10: Option<f64>,
    /// Recall with a hundred.
    pub ar100: Option<f64>,
    /// Recall with a hundred, small objects.
    pub ar_small: Option<f64>,
    /// Recall with a hundred, medium objects.
    pub ar_medium: Option<f64>,
    /// Recall with a hundred, large objects.
    pub ar_large: Option<f64>,
}

const AREAS: [(f64, f64); 4] =
    [(0.0, 1e10), (0.0, 32.0 * 32.0), (32.0 * 32.0, 96.0 * 96.0), (96.0 * 96.0, 1e10)];
const MAX_DETECTIONS: [usize; 3] = [1, 10, 100];
const OVERLAPS: usize = 10;

/// `count` numbers from `start` to `stop` as numpy's `linspace` computes them: every bit matters in comparisons.
fn linspace(start: f64, stop: f64, count: usize) -> Vec<f64> {
    let step = (stop - start) / (count - 1) as f64;
    (0..count).map(|i| if i + 1 == count { stop } else { i as f64 * step + start }).collect()
}

struct Candidate<'a> {
    score: f64,
    area: f64,
    bbox: Rect,
    mask: Option<&'a Rle>,
}

/// The result of one image for one object and one range of areas.
struct ImageResult {
    scores: Vec<f64>,
    /// By overlap threshold, then by detection: whether it is matched, and whether it is ignored.
    matched: Vec<Vec<bool>>,
    ignored: Vec<Vec<bool>>,
    /// Number of ground-truth objects that count.
    positives: usize,
}

/// Scores detections. Images and objects without ground truth entries in `ground_truth` are left out.
pub fn evaluate_coco(
    ground_truth: &CocoGroundTruth,
    detections: &[Detection],
    iou_type: IouType,
) -> CocoScores {
    let images: BTreeSet<(u32, u32)> = ground_truth.images.iter().copied().collect();
    let categories: BTreeSet<u32> = ground_truth.annotations.iter().map(|a| a.category_id).collect();
    let mut annotated: BTreeMap<Key, Vec<&Annotation>> = BTreeMap::new();
    for a in &ground_truth.annotations {
        annotated.entry((a.category_id, (a.scene_id, a.image_id))).or_default().push(a);
    }
    let detected = candidates(detections, iou_type);

    let overlaps = linspace(0.5, 0.95, OVERLAPS);
    let recalls = linspace(0.0, 1.0, 101);
    let mut curves = Curves::new();
    for &category in &categories {
        let with_overlaps: Vec<_> = images
            .iter()
            .filter_map(|&image| {
                let gts = annotated.get(&(category, image)).map_or(&[][..], Vec::as_slice);
                let dts = detected.get(&(category, image)).map_or(&[][..], Vec::as_slice);
                (!gts.is_empty() || !dts.is_empty()).then(|| (gts, dts, all_overlaps(gts, dts, iou_type)))
            })
            .collect();
        for (a, &area) in AREAS.iter().enumerate() {
            let results: Vec<ImageResult> = with_overlaps
                .iter()
                .map(|(gts, dts, ious)| match_image(gts, dts, ious, area, &overlaps))
                .collect();
            curves.add(a, &results, &recalls);
        }
    }
    curves.scores()
}

/// An object and an image.
type Key = (u32, (u32, u32));

/// The detections of every object in every image by decreasing score, at most as many as are scored. Detections without a box or,
/// where masks are compared, without a mask are left out.
fn candidates(detections: &[Detection], iou_type: IouType) -> BTreeMap<Key, Vec<Candidate<'_>>> {
    let mut detected: BTreeMap<Key, Vec<Candidate<'_>>> = BTreeMap::new();
    for d in detections {
        let mask = d.segmentation.as_ref();
        let Some(bbox) = d.bbox.or_else(|| mask.map(Rle::bounding_box)) else { continue };
        if iou_type == IouType::Mask && mask.is_none() {
            continue;
        }
        // pycocotools takes the area of the box if there is one, also for masks.
        let area = match (d.bbox, mask) {
            (None, Some(mask)) => mask.area() as f64,
            _ => bbox.width * bbox.height,
        };
        let candidate = Candidate { score: d.score, area, bbox, mask };
        detected.entry((d.category_id, (d.scene_id, d.image_id))).or_default().push(candidate);
    }
    for candidates in detected.values_mut() {
        candidates.sort_by(|a, b| b.score.total_cmp(&a.score));
        candidates.truncate(MAX_DETECTIONS[2]);
    }
    detected
}

/// Precision and recall of all objects; objects without ground truth of an area count nothing.
struct Curves {
    /// Per area and overlap: the precisions at 101 recalls of every object.
    precision: Vec<Vec<Vec<f64>>>,
    /// Per area, number of detections and overlap: the recall of every object.
    recall: Vec<Vec<Vec<Vec<f64>>>>,
}

impl Curves {
    fn new() -> Curves {
        Curves {
            precision: vec![vec![Vec::new(); OVERLAPS]; AREAS.len()],
            recall: vec![vec![vec![Vec::new(); OVERLAPS]; MAX_DETECTIONS.len()]; AREAS.len()],
        }
    }

    /// Adds the images of one object, matched for the area with number `area`.
    fn add(&mut self, area: usize, results: &[ImageResult], recalls: &[f64]) {
        let positives: usize = results.iter().map(|r| r.positives).sum();
        if positives == 0 {
            return;
        }
        for (m, &most) in MAX_DETECTIONS.iter().enumerate() {
            let mut order: Vec<(f64, usize, usize)> = Vec::new();
            for (i, result) in results.iter().enumerate() {
                order.extend(result.scores.iter().take(most).enumerate().map(|(d, &s)| (s, i, d)));
            }
            order.sort_by(|a, b| b.0.total_cmp(&a.0));
            for t in 0..OVERLAPS {
                let (p, r) = precision_and_recall(results, &order, t, positives, recalls);
                self.recall[area][m][t].push(r);
                if most == MAX_DETECTIONS[2] {
                    self.precision[area][t].extend(p);
                }
            }
        }
    }

    fn scores(&self) -> CocoScores {
        let ap = |area: usize| mean(self.precision[area].iter());
        let ar = |area: usize, most: usize| mean(self.recall[area][most].iter());
        CocoScores {
            ap: ap(0),
            ap50: mean(self.precision[0].iter().take(1)),
            ap75: mean(self.precision[0].iter().skip(5).take(1)),
            ap_small: ap(1),
            ap_medium: ap(2),
            ap_large: ap(3),
            ar1: ar(0, 0),
            ar10: ar(0, 1),
            ar100: ar(0, 2),
            ar_small: ar(1, 2),
            ar_medium: ar(2, 2),
            ar_large: ar(3, 2),
        }
    }
}

/// Mean of all numbers; `None` without any.
fn mean<'a>(lists: impl Iterator<Item = &'a Vec<f64>>) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0usize);
    for list in lists {
        sum += list.iter().sum::<f64>();
        count += list.len();
    }
    (count > 0).then(|| sum / count as f64)
}

/// Overlap of every detection with every ground truth; with a crowd, of the detection's own area.
fn all_overlaps(gts: &[&Annotation], dts: &[Candidate<'_>], iou_type: IouType) -> Vec<Vec<f64>> {
    let box_overlap = |d: &Rect, g: &Rect, crowd: bool| {
        let w = (d.x + d.width).min(g.x + g.width) - d.x.max(g.x);
        let h = (d.y + d.height).min(g.y + g.height) - d.y.max(g.y);
        if w <= 0.0 || h <= 0.0 {
            return 0.0;
        }
        let (common, area) = (w * h, d.width * d.height);
        common / if crowd { area } else { area + g.width * g.height - common }
    };
    let overlap = |d: &Candidate<'_>, g: &Annotation| match iou_type {
        IouType::Box => box_overlap(&d.bbox, &g.bbox, g.iscrowd),
        IouType::Mask => {
            let (Some(dm), Some(gm)) = (d.mask, g.segmentation.as_ref()) else { return 0.0 };
            // Masks of different sizes never match; an empty intersection needs no division.
            let common = dm.intersection(gm).unwrap_or(0);
            if common == 0 {
                return 0.0;
            }
            let union = if g.iscrowd { dm.area() } else { dm.area() + gm.area() - common };
            common as f64 / union as f64
        }
    };
    dts.iter().map(|d| gts.iter().map(|g| overlap(d, g)).collect()).collect()
}

fn match_image(
    gts: &[&Annotation],
    dts: &[Candidate<'_>],
    ious: &[Vec<f64>],
    (low, high): (f64, f64),
    overlaps: &[f64],
) -> ImageResult {
    let outside = |area: f64| area < low || area > high;
    let is_ignored = |g: &Annotation| g.iscrowd || outside(g.area);
    // Ground truth that counts comes first, each part in the order of the file.
    let mut order: Vec<usize> = (0..gts.len()).collect();
    order.sort_by_key(|&g| is_ignored(gts[g]));
    let positives = gts.iter().filter(|g| !is_ignored(g)).count();
    let (mut matched, mut ignored) = (Vec::new(), Vec::new());
    for &threshold in overlaps {
        let mut taken = vec![false; gts.len()];
        let (mut matched_here, mut ignored_here) = (Vec::new(), Vec::new());
        for (d, candidate) in dts.iter().enumerate() {
            let mut best = threshold.min(1.0 - 1e-10);
            let mut found: Option<usize> = None;
            for &g in &order {
                if taken[g] && !gts[g].iscrowd {
                    continue;
                }
                // A match with ground truth that counts is not replaced by one that does not count.
                if found.is_some_and(|f| !is_ignored(gts[f])) && is_ignored(gts[g]) {
                    break;
                }
                if ious[d][g] < best {
                    continue;
                }
                best = ious[d][g];
                found = Some(g);
            }
            if let Some(g) = found {
                taken[g] = true;
            }
            matched_here.push(found.is_some());
            ignored_here.push(found.map_or(outside(candidate.area), |g| is_ignored(gts[g])));
        }
        matched.push(matched_here);
        ignored.push(ignored_here);
    }
    ImageResult { scores: dts.iter().map(|d| d.score).collect(), matched, ignored, positives }
}

/// Precision at the given recalls (made monotone), and the final recall.
fn precision_and_recall(
    results: &[ImageResult],
    order: &[(f64, usize, usize)],
    overlap: usize,
    positives: usize,
    at_recalls: &[f64],
) -> (Vec<f64>, f64) {
    let (mut right, mut wrong) = (0.0, 0.0);
    let (mut recall, mut precision) = (Vec::new(), Vec::new());
    for &(_, image, d) in order {
        if !results[image].ignored[overlap][d] {
            if results[image].matched[overlap][d] {
                right += 1.0;
            } else {
                wrong += 1.0;
            }
        }
        recall.push(right / positives as f64);
        precision.push(right / (wrong + right + f64::EPSILON));
    }
    for i in (1..precision.len()).rev() {
        if precision[i] > precision[i - 1] {
            precision[i - 1] = precision[i];
        }
    }
    let at = |&r: &f64| {
        let i = recall.partition_point(|&found| found < r);
        precision.get(i).copied().unwrap_or(0.0)
    };
    (at_recalls.iter().map(at).collect(), recall.last().copied().unwrap_or(0.0))
}
