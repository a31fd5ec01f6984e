//! Regions and hypotheses as published (dissertation, section 5.2.4): descriptors alone choose templates, the mask head predicts
//! the object's pixels before any alignment, overlapping masks are merged to one region, and each region has the five nearest
//! templates of a second matching without its background. A region whose first hypothesis does not cover its mask after three
//! iterations of ICP is left out (section 5.2.5); of the others those remain whose first hypothesis has the largest portion of
//! inliers (section 5.3.3).
//!
//! The dissertation does not say how many regions get a mask, nor how the 30 % of overlap are defined: here [`SELECTED`], and
//! intersection over union. A template is placed so that its visible centroid coincides with that of the predicted mask.

use std::sync::Arc;

use rayon::prelude::*;
use sixfold_align::DepthRegion;
use sixfold_geometry::{Pose, Vec2, Vec3};

use crate::align::align_shortly;
use crate::by_network::encode;
use crate::estimate::{KnownObject, MttmOptions, Placed, Stages, place_at};
use crate::judge::judge;
use crate::learned::Learned;
use crate::mask::{Pixels, common, template_mask};
use crate::matching::Entry;
use crate::model::{Encoded, PairOutput};
use crate::network::MAP;
use crate::regions::RegionCache;
use crate::roi::{Roi, UNKNOWN, ray_rotation};
use crate::segmentation::nearest_entries;

/// Regions of the first matching whose masks are predicted: those with the nearest templates. Chosen by hand; not swept.
const SELECTED: usize = 200;
/// Pairs that go through the network at a time; does not affect the result.
const AT_A_TIME: usize = 32;
/// A cell, or a pixel, belongs to the object if its probability is at least this.
const INSIDE: f32 = 0.5;
/// Masks whose intersection exceeds this fraction of the smaller one belong to one object (section 5.2.4).
pub(crate) const MERGED: f64 = 0.5;
/// Regions are left out when their first hypothesis overlaps their mask by less (section 5.2.5).
const MIN_OVERLAP: f64 = 0.3;
/// Masks are compared on every n-th column and row; chosen by hand, not swept.
const STRIDE: usize = 2;
/// Fewest pixels of a mask on these columns and rows; chosen by hand, not swept.
pub(crate) const MIN_MASK: usize = 20;

/// The hypotheses of the at most [`MttmOptions::masked`] regions, aligned with the scene; each has the mask of its region.
pub(crate) fn hypotheses(
    scene: &DepthRegion,
    object: &KnownObject,
    learned: &Learned,
    cache: &RegionCache,
    options: &MttmOptions,
    stages: &mut Stages,
) -> Vec<Placed> {
    let regions = cache.of(scene, learned);
    stages.sampled = regions.sampled;
    let (nearest, mut order) = learned.nearest_first(&regions.descriptors);
    order.truncate(SELECTED);
    // The first mask prediction, and one region of all masks that overlap: the seed has the nearest template.
    let entries: Vec<Entry> = order.iter().map(|&i| object.matcher.entries()[nearest[i].1]).collect();
    let output: Vec<Vec<PairOutput>> = order
        .par_chunks(AT_A_TIME)
        .zip(entries.par_chunks(AT_A_TIME))
        .map(|(rois, entries)| learned.model().compare(&regions.encoded(rois), &learned.templates(entries)))
        .collect();
    let size = learned.size();
    let masks: Vec<(Roi, Pixels)> = order
        .par_iter()
        .zip(output.concat())
        .map(|(&i, output)| {
            (regions.rois[i], mask_pixels(scene, &regions.rois[i], size, &output.mask, STRIDE))
        })
        .collect();
    let centred: Vec<(Roi, Pixels)> = merged(masks)
        .into_iter()
        .filter_map(|(_, mask)| Some((Roi { centre: centroid(scene, &mask)? }, mask)))
        .collect();
    let accepted: Vec<(f64, Region)> = centred
        .par_iter()
        .filter_map(|(roi, mask)| Region::new(scene, object, learned, roi, mask, options))
        .collect();
    let accepted = most_inliers(accepted, options.masked);
    stages.regions = accepted.len();
    accepted.par_iter().map(|r| r.placed(scene, object, learned, options)).collect::<Vec<_>>().concat()
}

/// The masks that are large enough, without those that overlap an earlier one.
fn merged(masks: Vec<(Roi, Pixels)>) -> Vec<(Roi, Pixels)> {
    let mut kept: Vec<(Roi, Pixels)> = vec![];
    for (roi, mask) in masks {
        let known = kept.iter().any(|(_, other)| overlaps(&mask, other, MERGED));
        if mask.len() >= MIN_MASK && !known {
            kept.push((roi, mask));
        }
    }
    kept
}

/// At most `most` regions, given with their portions of inliers: those with the largest first, of equal ones the earlier first.
fn most_inliers<T>(mut regions: Vec<(f64, T)>, most: usize) -> Vec<T> {
    regions.sort_by(|a, b| b.0.total_cmp(&a.0));
    regions.truncate(most);
    regions.into_iter().map(|(_, region)| region).collect()
}

/// Whether the intersection of two masks exceeds a fraction of the smaller one.
pub(crate) fn overlaps(a: &Pixels, b: &Pixels, fraction: f64) -> bool {
    common(a, b) as f64 > fraction * a.len().min(b.len()) as f64
}

/// A region that was not rejected.
#[derive(Debug)]
struct Region {
    roi: Roi,
    encoded: Encoded,
    /// The object's pixels, predicted for the first hypothesis.
    mask: Arc<Pixels>,
    /// Their centroid, camera frame.
    centre: Vec3,
    /// The nearest templates.
    entries: Vec<Entry>,
    /// The pose that the network predicts for the first of them.
    first: Pose,
}

impl Region {
    /// The second matching of one region, with the portion of inliers of its first hypothesis; `None` if that does not cover its
    /// mask.
    fn new(
        scene: &DepthRegion,
        object: &KnownObject,
        learned: &Learned,
        roi: &Roi,
        first_mask: &Pixels,
        options: &MttmOptions,
    ) -> Option<(f64, Region)> {
        let (model, size) = (learned.model(), learned.size());
        let encoded = encode(scene, learned, &[*roi]);
        let bare = model.without_background(&encoded, cells_of(scene, roi, size, first_mask));
        let descriptor = model.describe(&bare).into_iter().next()?;
        let camera_from_roi = roi.camera_from_roi();
        let entries = nearest_entries(object, learned, &camera_from_roi, &descriptor, options.hypotheses);
        let nearest = entries.first()?;
        // The other templates are compared only if the region remains.
        let output = model.compare(&encoded, &learned.templates(&entries[..1])).into_iter().next()?;
        let mask = mask_pixels(scene, roi, size, &output.mask, 1);
        let centre = centroid(scene, &mask)?;
        let first = start(object, &camera_from_roi, &centre, nearest, &output, options);
        let inliers = inliers(scene, object, nearest, &first, &mask, options)?;
        Some((inliers, Region { roi: *roi, encoded, mask: Arc::new(mask), centre, entries, first }))
    }

    /// Its hypotheses, aligned with the scene.
    fn placed(
        &self,
        scene: &DepthRegion,
        object: &KnownObject,
        learned: &Learned,
        options: &MttmOptions,
    ) -> Vec<Placed> {
        let mut poses = vec![self.first];
        let others = &self.entries[1..];
        if !others.is_empty() {
            let regions = Encoded::joined(&vec![self.encoded.clone(); others.len()]);
            let output = learned.model().compare(&regions, &learned.templates(others));
            let camera_from_roi = self.roi.camera_from_roi();
            poses.extend(
                others
                    .iter()
                    .zip(&output)
                    .map(|(e, o)| start(object, &camera_from_roi, &self.centre, e, o, options)),
            );
        }
        let place = |(entry, pose): (&Entry, Pose)| Placed {
            mask: Some(self.mask.clone()),
            ..place_at(scene, object, entry.template, pose, 1.0, options)
        };
        self.entries.iter().zip(poses).map(place).collect()
    }
}

/// The pose of a template whose visible centroid is at `centre`, with the rotation that the network predicts.
pub(crate) fn start(
    object: &KnownObject,
    camera_from_roi: &Pose,
    centre: &Vec3,
    entry: &Entry,
    output: &PairOutput,
    options: &MttmOptions,
) -> Pose {
    let rotated = crate::align::camera_from_view(camera_from_roi, entry.turn);
    let rotation = if options.predicted_pose {
        camera_from_roi.rotation()
            * output.rotation
            * (camera_from_roi.rotation().inverse() * rotated.rotation())
    } else {
        rotated.rotation()
    };
    let of_template = object.surfaces[entry.template].dense.centroid().unwrap_or_else(Vec3::zeros);
    Pose::new(rotation, centre - rotation * of_template)
}

/// The portion of inliers among the points of a template after three iterations of ICP; `None` if it does not cover enough of the
/// mask there.
fn inliers(
    scene: &DepthRegion,
    object: &KnownObject,
    entry: &Entry,
    start: &Pose,
    mask: &Pixels,
    options: &MttmOptions,
) -> Option<f64> {
    let surface = &object.surfaces[entry.template];
    let aligned = align_shortly(scene, &surface.sparse, start, object.matcher.tolerance());
    let template = &object.templates.templates[entry.template];
    let area = template_mask(scene, template, object.templates.size, &aligned, f64::INFINITY, 1);
    if overlap(&area, mask) < MIN_OVERLAP {
        return None;
    }
    let threshold = options.depth_threshold(object.templates.diameter);
    let score = judge(scene, surface, &aligned, threshold, &options.verification);
    Some(score.inliers as f64 / score.rendered.max(1) as f64)
}

/// Intersection over union.
fn overlap(a: &Pixels, b: &Pixels) -> f64 {
    let both = common(a, b);
    both as f64 / (a.len() + b.len() - both).max(1) as f64
}

/// The measured pixels whose cell of a predicted mask (14 x 14) belongs to the object, on every `stride`-th column and row.
pub(crate) fn mask_pixels(scene: &DepthRegion, roi: &Roi, size: f64, mask: &[f32], stride: usize) -> Pixels {
    let camera = scene.camera();
    let rotation = ray_rotation(&roi.centre);
    let (right, down, axis) = (rotation * Vec3::x(), rotation * Vec3::y(), rotation * Vec3::z());
    let distance = roi.centre.norm();
    let half = 0.5 * size;
    let corners = [(-half, -half), (half, -half), (half, half), (-half, half)];
    let (mut low, mut high) = (Vec2::repeat(f64::INFINITY), Vec2::repeat(f64::NEG_INFINITY));
    for (u, v) in corners {
        let Some(p) = camera.project(&(roi.centre + right * u + down * v)) else { return vec![] };
        (low, high) = (low.inf(&p), high.sup(&p));
    }
    let first = |v: f64| (v.floor().max(0.0) as usize).next_multiple_of(stride);
    let last = |v: f64, size: usize| (v.ceil().max(0.0) as usize).min(size);
    let mut pixels = vec![];
    for y in (first(low.y)..last(high.y, camera.height)).step_by(stride) {
        for x in (first(low.x)..last(high.x, camera.width)).step_by(stride) {
            if scene.depth()[(x, y)] <= 0.0 {
                continue;
            }
            // The intersection of the pixel's ray with the region's square.
            let ray = camera.unproject(&Vec2::new(x as f64, y as f64), 1.0);
            let p = ray * (distance / axis.dot(&ray)) - roi.centre;
            let place = [right.dot(&p), down.dot(&p)].map(|along| (along / size + 0.5) * MAP as f64);
            if probability(mask, place).is_some_and(|p| p >= INSIDE) {
                pixels.push((y * camera.width + x) as u32);
            }
        }
    }
    pixels
}

/// The probability at a place in cells, from the left and upper border of a mask, by bilinear interpolation between the centres of its
/// 14 x 14 cells; `None` outside.
fn probability(mask: &[f32], place: [f64; 2]) -> Option<f32> {
    if !place.iter().all(|k| (0.0..MAP as f64).contains(k)) {
        return None;
    }
    let [(x, u), (y, v)] = place.map(|k| {
        let k = (k - 0.5).clamp(0.0, (MAP - 1) as f64);
        let first = (k.floor() as usize).min(MAP - 2);
        (first, (k - first as f64) as f32)
    });
    let at = |x: usize, y: usize| mask[y * MAP + x];
    let upper = at(x, y) * (1.0 - u) + at(x + 1, y) * u;
    let lower = at(x, y + 1) * (1.0 - u) + at(x + 1, y + 1) * u;
    Some(upper * (1.0 - v) + lower * v)
}

/// Which cells of a region show pixels of a mask that has only every [`STRIDE`]-th column and row.
fn cells_of(scene: &DepthRegion, roi: &Roi, size: f64, mask: &Pixels) -> Vec<f32> {
    let width = scene.camera().width;
    let inside = |pixel: usize| {
        let (x, y) = (pixel % width / STRIDE * STRIDE, pixel / width / STRIDE * STRIDE);
        mask.binary_search(&((y * width + x) as u32)).is_ok()
    };
    let cells = roi.cells_on_grid(scene, size, MAP, inside);
    cells.iter().map(|c| f32::from(u8::from(*c != UNKNOWN))).collect()
}

/// The centroid of a mask's points, camera frame: their mean, scaled along its ray to the median depth. The median is robust to the
/// background that a coarse mask of 14 x 14 cells includes. `None` for an empty mask.
fn centroid(scene: &DepthRegion, mask: &Pixels) -> Option<Vec3> {
    let camera = scene.camera();
    let point = |&p: &u32| {
        let (x, y) = (p as usize % camera.width, p as usize / camera.width);
        camera.unproject(&Vec2::new(x as f64, y as f64), f64::from(scene.depth()[(x, y)]))
    };
    let mut depths: Vec<f64> = mask.iter().map(|p| point(p).z).collect();
    let median = sixfold_geometry::stats::upper_median(&mut depths)?;
    let sum: Vec3 = mask.iter().map(point).sum();
    let mean = sum / mask.len() as f64;
    Some(mean * (median / mean.z))
}

/// The centre of the surface shown by the mask's cells of a region, in the region's frame; the region's own centre if they show
/// nothing. For a network that was not trained to predict the position.
pub(crate) fn visible_centre(scene: &DepthRegion, roi: &Roi, size: f64, mask: &[f32]) -> Vec3 {
    let pixels = mask_pixels(scene, roi, size, mask, STRIDE);
    let centre = centroid(scene, &pixels).unwrap_or(roi.centre);
    roi.camera_from_roi().inverse().transform_point(&centre)
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_align::{DepthOptions, PreparedDepth};
    use sixfold_geometry::{Camera, DepthImage};

    /// A wall at 0.8 m with a plate of 10 cm, 5 cm in front of it, about the centre of the image.
    fn scene() -> DepthRegion {
        let camera = Camera::new(500.0, 500.0, 159.5, 119.5, 320, 240).unwrap();
        let on_plate = |x: usize, y: usize| x.abs_diff(160) < 33 && y.abs_diff(120) < 33;
        let depth = DepthImage::from_fn(320, 240, |x, y| if on_plate(x, y) { 0.75 } else { 0.8 });
        let options = DepthOptions { remove_plane: false, ..DepthOptions::default() };
        DepthRegion::whole(&PreparedDepth::new(&depth, &camera, &options).unwrap())
    }

    fn roi(x: f64) -> Roi {
        Roi { centre: Vec3::new(x, 0.0, 0.75) }
    }

    #[test]
    fn a_mask_of_cells_becomes_the_pixels_that_it_covers() {
        let scene = scene();
        // The left half of a region of 20 cm straight ahead: columns 160 - 67 to 160.
        let mask: Vec<f32> = (0..MAP * MAP).map(|i| f32::from(u8::from(i % MAP < MAP / 2))).collect();
        let pixels = mask_pixels(&scene, &roi(0.0), 0.2, &mask, 1);
        let columns: Vec<usize> = pixels.iter().map(|p| *p as usize % 320).collect();
        let (low, high) = (columns.iter().min().unwrap(), columns.iter().max().unwrap());
        assert!(low.abs_diff(93) <= 1 && high.abs_diff(159) <= 1, "{low} {high}");
        assert!(pixels.len().abs_diff(67 * 133) < 300, "{}", pixels.len());
        assert!(mask_pixels(&scene, &roi(0.0), 0.2, &[0.4; MAP * MAP], 1).is_empty());
        // The inverse, in a region 2 cm to the right: the left half ends 1.4 cells further to the left.
        let coarse = mask_pixels(&scene, &roi(0.0), 0.2, &mask, STRIDE);
        let cells = cells_of(&scene, &roi(0.02), 0.2, &coarse);
        let in_row = |v: usize| (0..MAP).filter(|u| cells[v * MAP + u] > 0.5).count();
        assert!((5..=6).contains(&in_row(7)), "{}", in_row(7));
    }

    #[test]
    fn the_centroid_is_on_the_surface_of_most_of_the_mask() {
        let scene = scene();
        let mask: Vec<f32> = (0..MAP * MAP)
            .map(|i| f32::from(u8::from((3..11).contains(&(i % MAP)) && (3..11).contains(&(i / MAP)))))
            .collect();
        let pixels = mask_pixels(&scene, &roi(0.0), 0.2, &mask, 1);
        let centre = centroid(&scene, &pixels).unwrap();
        assert!((centre - Vec3::new(0.0, 0.0, 0.75)).norm() < 3e-3, "{centre}");
        assert!(centroid(&scene, &vec![]).is_none());
        let place = visible_centre(&scene, &roi(0.03), 0.2, &[0.0; MAP * MAP]);
        assert!(place.norm() < 1e-9, "nothing seen: the region's own centre");
    }

    #[test]
    fn masks_that_overlap_by_more_than_half_are_one_region() {
        let mask = |range: std::ops::Range<u32>| (roi(0.0), range.collect::<Pixels>());
        // The second shares 60 of its 100 pixels with the first, the third 40, and the last is too small.
        let masks = vec![mask(0..100), mask(40..140), mask(60..160), mask(500..510)];
        let kept = merged(masks);
        assert_eq!(kept.iter().map(|k| k.1[0]).collect::<Vec<_>>(), [0, 60]);
    }

    #[test]
    fn regions_with_the_largest_portion_of_inliers_remain() {
        let regions = vec![(0.3, 1), (0.8, 2), (0.1, 3), (0.8, 4)];
        assert_eq!(most_inliers(regions.clone(), 3), [2, 4, 1]);
        assert_eq!(most_inliers(regions, 50), [2, 4, 1, 3]);
    }

    #[test]
    fn overlap_is_intersection_over_union() {
        let set = |range: std::ops::Range<u32>| range.collect::<Pixels>();
        assert!((overlap(&set(0..100), &set(50..130)) - 50.0 / 130.0).abs() < 1e-12);
        assert_eq!(overlap(&set(0..10), &set(10..20)), 0.0);
        assert_eq!(overlap(&vec![], &vec![]), 0.0);
    }
}
