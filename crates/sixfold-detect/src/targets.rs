//! Training targets of an image: which locations represent which object.
//!
//! An object's locations are those on its visible mask that are nearest to the mask's centre of mass. Masks do not overlap, so no
//! location is ambiguous between two objects, as with boxes (Tian et al. 2019, section 3.2).

use crate::network::{DetectorConfig, MASK_STRIDE};

/// Maximum number of locations of an object on a level.
const MAX_LOCATIONS: usize = 9;
/// Number of locations of an object whose masks are learned.
const MASK_LOCATIONS: usize = 3;
/// Pixel label of areas that are neither background nor to be learned.
pub(crate) const IGNORED: u8 = 255;

/// An object in a training image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Instance {
    /// Its class.
    pub class: usize,
    /// First and last visible pixel: left, top, right, bottom.
    pub corners: [f32; 4],
}

/// The objects of an image and their visible pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Annotation {
    /// Columns and rows.
    pub size: [usize; 2],
    /// For every pixel 0 for background, the object's number from 1, or `IGNORED`.
    pub labels: Vec<u8>,
    /// The objects; at most 254.
    pub instances: Vec<Instance>,
}

/// A location that represents an object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Positive {
    /// Level of the pyramid.
    pub level: usize,
    /// Number of the location on its level, row by row.
    pub location: usize,
    /// Number of the object, from 0.
    pub instance: usize,
}

/// An object's mask at the resolution of the prototypes, around its bounding box.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct MaskTarget {
    /// First column and row.
    pub corner: [usize; 2],
    /// Columns and rows.
    pub size: [usize; 2],
    /// Fraction of each block of pixels that shows the object.
    pub fractions: Vec<f32>,
}

/// Targets of one image.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Targets {
    /// Columns and rows of every level.
    pub grids: Vec<[usize; 2]>,
    /// Locations that represent objects.
    pub positives: Vec<Positive>,
    /// For every level: locations that are ignored.
    pub ignored: Vec<Vec<bool>>,
    /// The objects.
    pub instances: Vec<Instance>,
    /// Their masks.
    pub masks: Vec<MaskTarget>,
    /// Positives (by their numbers) whose masks are learned.
    pub mask_positives: Vec<usize>,
}

/// Smallest and largest size (square root of the box's area, pixels) of objects on a level; neighbours overlap.
fn sizes(config: &DetectorConfig, level: usize) -> [f32; 2] {
    let stride = config.stride(level) as f32;
    let minimum = if level == 0 { 0.0 } else { 3.5 * stride };
    let greatest = if level + 1 == config.levels { f32::INFINITY } else { 10.0 * stride };
    [minimum, greatest]
}

/// The pixel at the centre of a location.
fn centre(location: usize, stride: usize) -> usize {
    location * stride + stride / 2
}

impl Targets {
    /// Targets of an image whose sides are multiples of [`DetectorConfig::alignment`].
    pub(crate) fn new(annotation: &Annotation, config: &DetectorConfig) -> Targets {
        let [width, height] = annotation.size;
        let count = annotation.instances.len();
        let mut sums = vec![[0.0f64; 3]; count];
        for (row, y) in annotation.labels.chunks_exact(width).zip(0..) {
            for (label, x) in row.iter().zip(0..) {
                if let Some(sum) = usize::from(*label).checked_sub(1).and_then(|i| sums.get_mut(i)) {
                    *sum = [sum[0] + f64::from(x), sum[1] + f64::from(y), sum[2] + 1.0];
                }
            }
        }
        let mut targets = Targets {
            grids: vec![],
            positives: vec![],
            ignored: vec![],
            instances: annotation.instances.clone(),
            masks: vec![],
            mask_positives: vec![],
        };
        let mut of_instance: Vec<Vec<(f32, usize)>> = vec![vec![]; count];
        for level in 0..config.levels {
            let stride = config.stride(level);
            let grid = [width / stride, height / stride];
            let label = |x: usize, y: usize| annotation.labels[centre(y, stride) * width + centre(x, stride)];
            let mut on_mask: Vec<Vec<(f32, usize)>> = vec![vec![]; count];
            let mut ignored = vec![false; grid[0] * grid[1]];
            for y in 0..grid[1] {
                for x in 0..grid[0] {
                    let location = y * grid[0] + x;
                    match label(x, y) {
                        0 => {}
                        IGNORED => ignored[location] = true,
                        number => {
                            let Some(sum) = sums.get(usize::from(number) - 1) else { continue };
                            let away = |at: usize, sum: f64| centre(at, stride) as f64 - sum;
                            let (dx, dy) = (away(x, sum[0] / sum[2]), away(y, sum[1] / sum[2]));
                            on_mask[usize::from(number) - 1].push(((dx * dx + dy * dy) as f32, location));
                        }
                    }
                }
            }
            let mut taken = vec![false; grid[0] * grid[1]];
            for (index, (instance, mut locations)) in annotation.instances.iter().zip(on_mask).enumerate() {
                let [left, top, right, bottom] = instance.corners;
                let size = ((right - left).max(1.0) * (bottom - top).max(1.0)).sqrt();
                let [minimum, greatest] = sizes(config, level);
                if !(minimum..greatest).contains(&size) || sums[index][2] == 0.0 {
                    continue;
                }
                if locations.is_empty() {
                    // The object is so small or thin that it contains no location's centre.
                    let at = |sum: f64, side: usize| ((sum / sums[index][2]) as usize / stride).min(side - 1);
                    let location = at(sums[index][1], grid[1]) * grid[0] + at(sums[index][0], grid[0]);
                    if !taken[location] {
                        locations.push((0.0, location));
                    }
                }
                locations.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
                for (distance, location) in locations.into_iter().take(MAX_LOCATIONS) {
                    taken[location] = true;
                    ignored[location] = false;
                    of_instance[index].push((distance, targets.positives.len()));
                    targets.positives.push(Positive { level, location, instance: index });
                }
            }
            targets.grids.push(grid);
            targets.ignored.push(ignored);
        }
        for (index, mut positives) in of_instance.into_iter().enumerate() {
            positives.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            targets.mask_positives.extend(positives.iter().take(MASK_LOCATIONS).map(|p| p.1));
            targets.masks.push(mask_target(annotation, index));
        }
        targets
    }
}

/// Fraction of each block that shows the object, in its bounding box extended by two blocks.
fn mask_target(annotation: &Annotation, index: usize) -> MaskTarget {
    let [width, height] = annotation.size;
    let [left, top, right, bottom] = annotation.instances[index].corners;
    let limits = [width / MASK_STRIDE, height / MASK_STRIDE];
    let span = |low: f32, high: f32, limit: usize| {
        let first = (low.max(0.0) as usize / MASK_STRIDE).saturating_sub(2).min(limit - 1);
        let end = (high.max(0.0) as usize / MASK_STRIDE + 3).clamp(first + 1, limit);
        (first, end)
    };
    let ((x0, x1), (y0, y1)) = (span(left, right, limits[0]), span(top, bottom, limits[1]));
    let mut fractions = Vec::with_capacity((x1 - x0) * (y1 - y0));
    for y in y0..y1 {
        for x in x0..x1 {
            let rows = (0..MASK_STRIDE).map(|row| (y * MASK_STRIDE + row) * width + x * MASK_STRIDE);
            let inside: usize = rows
                .map(|start| {
                    let block = &annotation.labels[start..start + MASK_STRIDE];
                    block.iter().filter(|l| usize::from(**l) == index + 1).count()
                })
                .sum();
            fractions.push(inside as f32 / (MASK_STRIDE * MASK_STRIDE) as f32);
        }
    }
    MaskTarget { corner: [x0, y0], size: [x1 - x0, y1 - y0], fractions }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two objects side by side, a third that hides a part of the first, and an ignored area.
    fn annotation() -> Annotation {
        let size = [128, 96];
        let mut labels = vec![0u8; size[0] * size[1]];
        let mut fill = |label: u8, [x0, y0, x1, y1]: [usize; 4]| {
            for y in y0..=y1 {
                labels[y * 128 + x0..=y * 128 + x1].fill(label);
            }
        };
        fill(1, [10, 10, 49, 49]);
        fill(2, [60, 20, 119, 89]);
        fill(3, [30, 10, 32, 12]);
        fill(IGNORED, [0, 80, 20, 95]);
        let instance = |class, corners| Instance { class, corners };
        let instances = vec![
            instance(0, [10.0, 10.0, 49.0, 49.0]),
            instance(2, [60.0, 20.0, 119.0, 89.0]),
            instance(1, [30.0, 10.0, 32.0, 12.0]),
        ];
        Annotation { size, labels, instances }
    }

    #[test]
    fn locations_are_on_their_objects_near_the_centre() {
        let annotation = annotation();
        let config = DetectorConfig::compact(3);
        let targets = Targets::new(&annotation, &config);
        assert_eq!(targets.grids, [[16, 12], [8, 6], [4, 3]]);
        // 39 pixels: level 0 only; 64 pixels: levels 0 and 1; 2 pixels: one location of level 0.
        let count = |level: usize, instance: usize| {
            targets.positives.iter().filter(|p| p.level == level && p.instance == instance).count()
        };
        assert_eq!([count(0, 0), count(1, 0), count(0, 1), count(1, 1), count(2, 1)], [9, 0, 9, 9, 0]);
        assert_eq!([count(0, 2), count(1, 2)], [1, 0]);
        for p in targets.positives.iter().filter(|p| p.instance < 2) {
            let (stride, width) = (config.stride(p.level), targets.grids[p.level][0]);
            let (x, y) = (centre(p.location % width, stride), centre(p.location / width, stride));
            assert_eq!(usize::from(annotation.labels[y * 128 + x]), p.instance + 1);
            let [left, top, right, bottom] = annotation.instances[p.instance].corners;
            let off = (x as f32 - 0.5 * (left + right)).hypot(y as f32 - 0.5 * (top + bottom));
            assert!(off < 2.2 * stride as f32, "{off}");
        }
        // No location twice on a level.
        let mut places: Vec<_> = targets.positives.iter().map(|p| (p.level, p.location)).collect();
        places.sort_unstable();
        places.dedup();
        assert_eq!(places.len(), targets.positives.len());
        assert_eq!(targets.mask_positives.len(), 3 + 3 + 1);
        assert!(targets.ignored[0][11 * 16] && !targets.ignored[0][0]);
    }

    #[test]
    fn masks_are_fractions_of_blocks() {
        let targets = Targets::new(&annotation(), &DetectorConfig::compact(3));
        let mask = &targets.masks[1];
        assert_eq!((mask.corner, mask.size), ([13, 3], [19, 21]));
        let area: f32 = mask.fractions.iter().sum();
        assert_eq!(area * 16.0, 60.0 * 70.0);
        // The first object without the part that the third hides.
        assert_eq!(targets.masks[0].fractions.iter().sum::<f32>() * 16.0, 1600.0 - 9.0);
    }
}
