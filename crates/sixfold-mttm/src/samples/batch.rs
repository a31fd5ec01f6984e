//! The batch of a step: regions, shifted, mirrored, rotated and partly hidden, with their templates.

use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};
use sixfold_geometry::random::stream;

use super::anchor::{Anchor, SeenPatch};
use super::pool::Pool;
use crate::loss::GAMMA;
use crate::network::MAP;
use crate::patch::PLANES;

/// How regions are augmented.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Augmentation {
    /// Largest shift of the centre across the region, as a fraction of the patch (dissertation: "randomly shifted").
    pub shift: f64,
    /// Largest shift along its axis, as a fraction of the patch.
    pub depth: f64,
    /// Probability that a patch and its templates are rotated by 90, 180 or 270 degrees.
    pub rotated: f64,
    /// Whether half of the patches are mirrored with their templates.
    pub mirrored: bool,
    /// Probability of an occluder in front.
    pub hidden: f64,
    /// Probability of a rectangle without measurements.
    pub lost: f64,
}

impl Default for Augmentation {
    fn default() -> Self {
        Augmentation { shift: 0.12, depth: 0.1, rotated: 0.3, mirrored: true, hidden: 0.25, lost: 0.25 }
    }
}

impl Augmentation {
    /// The dissertation's: only a shift of the centre across the region (section 5.3.1; its size is not given).
    pub fn published() -> Self {
        Augmentation {
            depth: 0.0,
            rotated: 0.0,
            mirrored: false,
            hidden: 0.0,
            lost: 0.0,
            ..Augmentation::default()
        }
    }
}

/// Contents of a batch.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PairBatchOptions {
    /// Regions with an object.
    pub anchors: usize,
    /// Regions without one.
    pub without_object: usize,
    /// Fraction of the regions whose negative template shows another object (dissertation: half); for the others it shows the same
    /// object.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub other_objects: f64,
    /// How regions are augmented.
    pub augmentation: Augmentation,
}

impl Default for PairBatchOptions {
    fn default() -> Self {
        PairBatchOptions {
            anchors: 40,
            without_object: 8,
            other_objects: 0.0,
            augmentation: Augmentation::default(),
        }
    }
}

fn is_zero(fraction: &f64) -> bool {
    *fraction == 0.0
}

/// Values of the input tensors: regions with an object first, then those without.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Batch {
    /// Patches of regions.
    pub regions: Vec<f32>,
    /// Patches of templates: the positive ones of the regions with an object, their negative ones (zeros where there is none).
    pub positives: Vec<f32>,
    /// See `positives`.
    pub negatives: Vec<f32>,
    /// For regions with an object, the fraction of every cell that belongs to it, `14 x 14`.
    pub region_masks: Vec<f32>,
    /// The same of both kinds of templates.
    pub positive_masks: Vec<f32>,
    /// See `positive_masks`.
    pub negative_masks: Vec<f32>,
    /// Quaternions w, x, y, z: region from template.
    pub rotations: Vec<f32>,
    /// Positions of the positive templates' reference points.
    pub offsets: Vec<f32>,
    /// Margins of the negative templates (equation 5.4): twice the pose distance for one of the same object, gamma for one of
    /// another; 0 if there is none.
    pub margins: Vec<f32>,
    /// Numbers of the objects.
    pub objects: Vec<usize>,
}

impl Batch {
    /// The batch of a step, a function of pool, options, seed and step.
    pub fn of_step(pool: &Pool, options: &PairBatchOptions, seed: u64, step: u64) -> Batch {
        let mut random = stream(seed, step);
        let mut batch = Batch::default();
        let side = pool.options().anchors.side;
        for _ in 0..options.anchors {
            let anchor = &pool.with_object()[random.random_range(0..pool.with_object().len())];
            batch.add(anchor, side, &options.augmentation, &mut random);
        }
        for _ in 0..options.without_object {
            match pool.without_object() {
                [] => batch.regions.extend(std::iter::repeat_n(0.0, PLANES * side * side)),
                all => {
                    let anchor = &all[random.random_range(0..all.len())];
                    let change = Change::draw(&options.augmentation, side, anchor.region.side, &mut random);
                    batch.regions.extend(change.region(anchor, side).0);
                }
            }
        }
        if options.other_objects > 0.0 {
            batch.take_others(options.other_objects, side, &mut random);
        }
        batch
    }

    /// For a fraction of the regions, uses a positive template of another object in the batch as the negative one.
    fn take_others(&mut self, fraction: f64, side: usize, random: &mut impl Rng) {
        let (patch, cells, count) = (PLANES * side * side, MAP * MAP, self.objects.len());
        for k in 0..count {
            let others: Vec<usize> = (0..count).filter(|&j| self.objects[j] != self.objects[k]).collect();
            if others.is_empty() || !random.random_bool(fraction) {
                continue;
            }
            let j = others[random.random_range(0..others.len())];
            self.negatives[k * patch..][..patch].copy_from_slice(&self.positives[j * patch..][..patch]);
            self.negative_masks[k * cells..][..cells]
                .copy_from_slice(&self.positive_masks[j * cells..][..cells]);
            self.margins[k] = GAMMA as f32;
        }
    }

    fn add(&mut self, anchor: &Anchor, side: usize, how: &Augmentation, random: &mut impl Rng) {
        let change = Change::draw(how, side, anchor.region.side, random);
        let (region, mask) = change.region(anchor, side);
        self.regions.extend(region);
        self.region_masks.extend(to_cells(&mask, side));
        let positive = &anchor.positives[random.random_range(0..anchor.positives.len())];
        let (patch, mask) = change.template(&positive.patch);
        self.positives.extend(patch);
        self.positive_masks.extend(to_cells(&mask, side));
        let q = positive.rotation;
        let turned = change.quarter.quaternion([q.w, q.i, q.j, q.k]);
        let sign = if turned[0] < 0.0 { -1.0 } else { 1.0 };
        self.rotations.extend(turned.map(|v| sign * v));
        let moved = |k: usize| positive.offset[k] - change.shift[k];
        self.offsets.extend(change.quarter.vector([moved(0), moved(1), moved(2)]));
        match &anchor.negative {
            Some(negative) => {
                let (patch, mask) = change.template(&negative.patch);
                self.negatives.extend(patch);
                self.negative_masks.extend(to_cells(&mask, side));
                self.margins.push(2.0 * negative.distance);
            }
            None => {
                self.negatives.extend(std::iter::repeat_n(0.0, PLANES * side * side));
                self.negative_masks.extend(std::iter::repeat_n(0.0, MAP * MAP));
                self.margins.push(0.0);
            }
        }
        self.objects.push(anchor.object.unwrap_or(usize::MAX));
    }
}

/// The mean over each of `14 x 14` cells.
fn to_cells(mask: &[bool], side: usize) -> Vec<f32> {
    let step = side / MAP;
    (0..MAP * MAP)
        .map(|i| {
            let (x, y) = (i % MAP * step, i / MAP * step);
            let inside = (0..step * step).filter(|k| mask[(y + k / step) * side + x + k % step]).count();
            inside as f32 / (step * step) as f32
        })
        .collect()
}

/// Mirroring and quarter turns, which need no interpolation of a patch.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Quarter {
    mirrored: bool,
    turns: u8,
}

impl Quarter {
    /// The image of a direction.
    fn vector(&self, [x, y, z]: [f32; 3]) -> [f32; 3] {
        let x = if self.mirrored { -x } else { x };
        match self.turns {
            0 => [x, y, z],
            1 => [-y, x, z],
            2 => [-x, -y, z],
            _ => [y, -x, z],
        }
    }

    /// The image of a rotation: its axis is transformed, and mirroring reverses its angle.
    fn quaternion(&self, [w, x, y, z]: [f32; 4]) -> [f32; 4] {
        let axis = self.vector([x, y, z]);
        let sign = if self.mirrored { -1.0 } else { 1.0 };
        [w, sign * axis[0], sign * axis[1], sign * axis[2]]
    }

    /// The source pixel of a pixel.
    fn source(&self, x: usize, y: usize, side: usize) -> (usize, usize) {
        let last = side - 1;
        let (x, y) = match self.turns {
            0 => (x, y),
            1 => (y, last - x),
            2 => (last - x, last - y),
            _ => (last - y, x),
        };
        (if self.mirrored { last - x } else { x }, y)
    }
}

/// The augmentation of one region.
struct Change {
    quarter: Quarter,
    /// First column and row of the kept region.
    first: [usize; 2],
    /// Shift of the centre before the rotation, in patch sizes.
    shift: [f32; 3],
    /// Rectangles in the shifted region: x, y, width, height, and the normal and depth of the occluder there (`None`: not
    /// measured).
    rectangles: Vec<([usize; 4], Option<[f32; 4]>)>,
}

impl Change {
    fn draw(how: &Augmentation, side: usize, kept: usize, random: &mut impl Rng) -> Change {
        let border = (kept - side) / 2;
        let most = ((how.shift * side as f64).round() as usize).min(border);
        let first = [0, 1].map(|_| border + random.random_range(0..=2 * most) - most);
        let across = |k: usize| (first[k] as f32 - border as f32) / side as f32;
        let along = (how.depth * (2.0 * random.random::<f64>() - 1.0)) as f32;
        let turns = if random.random_bool(how.rotated) { random.random_range(1..4) } else { 0 };
        let mut rectangles = vec![];
        if random.random_bool(how.lost) {
            let width = random.random_range(1..=side / 3);
            let height = random.random_range(1..=side / 3);
            let at = [random.random_range(0..side - width), random.random_range(0..side - height)];
            rectangles.push(([at[0], at[1], width, height], None));
        }
        if random.random_bool(how.hidden) {
            // The occluder enters from one side of the region.
            let deep = random.random_range(side / 8..=side / 2);
            let area = match random.random_range(0..4u32) {
                0 => [0, 0, deep, side],
                1 => [side - deep, 0, deep, side],
                2 => [0, 0, side, deep],
                _ => [0, side - deep, side, deep],
            };
            let (tilt, to) = (0.8 * random.random::<f32>(), std::f32::consts::TAU * random.random::<f32>());
            let normal = [tilt.sin() * to.cos(), tilt.sin() * to.sin(), -tilt.cos()];
            let depth = -0.3 - 0.6 * random.random::<f32>();
            rectangles.push((area, Some([normal[0], normal[1], normal[2], depth])));
        }
        let quarter = Quarter { mirrored: random.random::<bool>() && how.mirrored, turns };
        Change { quarter, first, shift: [across(0), across(1), along], rectangles }
    }

    /// The region and the pixels of the object.
    fn region(&self, anchor: &Anchor, side: usize) -> (Vec<f32>, Vec<bool>) {
        let kept = anchor.region.side;
        let (mut patch, mut mask) = (vec![0.0; PLANES * side * side], vec![false; side * side]);
        for y in 0..side {
            for x in 0..side {
                let (u, v) = self.quarter.source(x, y, side);
                let i = (v + self.first[1]) * kept + u + self.first[0];
                let mut planes = anchor.region.planes(i, self.shift[2]);
                let mut inside = anchor.mask[i];
                for ([left, top, width, height], what) in &self.rectangles {
                    if !((*left..left + width).contains(&u) && (*top..top + height).contains(&v)) {
                        continue;
                    }
                    inside = false;
                    planes = match what {
                        Some([nx, ny, nz, depth]) => [*nx, *ny, *nz, *depth, 1.0],
                        None => [0.0; PLANES],
                    };
                }
                self.put(&mut patch, y * side + x, side, planes);
                mask[y * side + x] = inside;
            }
        }
        (patch, mask)
    }

    /// A template and its pixels: mirrored and rotated, but neither hidden nor shifted.
    fn template(&self, seen: &SeenPatch) -> (Vec<f32>, Vec<bool>) {
        let side = seen.side;
        let (mut patch, mut mask) = (vec![0.0; PLANES * side * side], vec![false; side * side]);
        for y in 0..side {
            for x in 0..side {
                let (u, v) = self.quarter.source(x, y, side);
                self.put(&mut patch, y * side + x, side, seen.planes(v * side + u, 0.0));
                mask[y * side + x] = seen.known[v * side + u];
            }
        }
        (patch, mask)
    }

    fn put(&self, patch: &mut [f32], pixel: usize, side: usize, planes: [f32; PLANES]) {
        let [x, y, z, depth, known] = planes;
        let [x, y, z] = self.quarter.vector([x, y, z]);
        for (k, v) in [x, y, z, depth, known].into_iter().enumerate() {
            patch[k * side * side + pixel] = v;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::nalgebra::{Quaternion, UnitQuaternion, Vector3};

    #[test]
    fn as_published_regions_are_shifted_and_nothing_else() {
        let random = &mut stream(3, 0);
        let draw = |how: &Augmentation, random: &mut _| Change::draw(how, 56, 80, random);
        let all: Vec<Change> = (0..100).map(|_| draw(&Augmentation::published(), random)).collect();
        let unchanged = Quarter { mirrored: false, turns: 0 };
        assert!(all.iter().all(|c| c.quarter == unchanged && c.rectangles.is_empty() && c.shift[2] == 0.0));
        assert!(all.iter().any(|c| c.shift[0] > 0.05) && all.iter().any(|c| c.shift[1] < -0.05));
        let ours: Vec<Change> = (0..100).map(|_| draw(&Augmentation::default(), random)).collect();
        assert!(ours.iter().any(|c| c.quarter.mirrored) && ours.iter().any(|c| !c.rectangles.is_empty()));
    }

    #[test]
    fn directions_rotations_and_pixels_go_the_same_way() {
        let q = UnitQuaternion::from_euler_angles(0.3f32, -0.2, 0.5);
        for mirrored in [false, true] {
            for turns in 0..4 {
                let quarter = Quarter { mirrored, turns };
                // Transforming a rotated direction equals rotating the transformed direction by the transformed rotation.
                let d = Vector3::new(0.3f32, -0.8, 0.5);
                let changed = quarter.quaternion([q.w, q.i, q.j, q.k]);
                let p = UnitQuaternion::new_unchecked(Quaternion::new(
                    changed[0], changed[1], changed[2], changed[3],
                ));
                let a = Vector3::from(quarter.vector((q * d).into()));
                let b = p * Vector3::from(quarter.vector(d.into()));
                assert!((a - b).norm() < 1e-5, "{quarter:?}");
                // The pixel to the right of the centre moves as the direction to the right does.
                let goes = quarter.vector([1.0, 0.0, 0.0]);
                let (x, y) = ((2.0 + goes[0]) as usize, (2.0 + goes[1]) as usize);
                assert_eq!(quarter.source(x, y, 5), (3, 2), "{quarter:?}");
                let goes = quarter.vector([0.0, 1.0, 0.0]);
                let (x, y) = ((2.0 + goes[0]) as usize, (2.0 + goes[1]) as usize);
                assert_eq!(quarter.source(x, y, 5), (2, 3), "{quarter:?}");
            }
        }
    }

    #[test]
    fn cells_hold_shares() {
        let mut mask = vec![false; 28 * 28];
        (mask[0], mask[1], mask[28]) = (true, true, true);
        let cells = to_cells(&mask, 28);
        assert_eq!((cells[0], cells[1], cells.len()), (0.75, 0.0, 196));
    }
}
