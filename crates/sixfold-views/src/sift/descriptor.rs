//! Orientations and descriptors of keypoints (Lowe 2004, sections 5 and 6).

use std::f32::consts::TAU;

use super::extrema::Extremum;
use super::pyramid::Plane;

/// Bins of the histogram of orientations.
const BINS: usize = 36;
/// Standard deviation of its window relative to the keypoint's blur.
const WINDOW: f32 = 1.5;
/// Peaks of at least this fraction of the highest one are orientations too.
const PEAK: f32 = 0.8;
/// Cells of a descriptor along each side.
const CELLS: usize = 4;
/// Orientations of each cell.
const ORIENTATIONS: usize = 8;
/// Side of a cell relative to the keypoint's blur.
const CELL: f32 = 3.0;
/// No number of a normalised descriptor is larger: a few strong edges would decide alone.
const LARGEST: f32 = 0.2;

/// Length of a descriptor.
pub(crate) const LENGTH: usize = CELLS * CELLS * ORIENTATIONS;

/// The orientations of an extremum, radians from 0 to `TAU`.
pub(super) fn orientations(level: &Plane, at: &Extremum) -> Vec<f32> {
    let sigma = WINDOW * at.sigma;
    let mut bins = [0.0f32; BINS];
    around(level, at, 3.0 * sigma, |dx, dy, [gx, gy]| {
        let weight = (-(dx * dx + dy * dy) / (2.0 * sigma * sigma)).exp();
        let bin = (gy.atan2(gx).rem_euclid(TAU) / TAU * BINS as f32).round() as usize % BINS;
        bins[bin] += weight * gx.hypot(gy);
    });
    let near = |bins: &[f32; BINS], i: usize, by: usize| bins[(i + BINS + by - 2) % BINS];
    let smooth: [f32; BINS] = std::array::from_fn(|i| {
        let b = |by| near(&bins, i, by);
        (b(0) + b(4)) / 16.0 + (b(1) + b(3)) / 4.0 + b(2) * 3.0 / 8.0
    });
    let highest = smooth.iter().copied().fold(0.0, f32::max);
    let peak = |i: usize| {
        let (left, middle, right) = (near(&smooth, i, 1), smooth[i], near(&smooth, i, 3));
        if middle <= 0.0 || middle < PEAK * highest || middle <= left || middle <= right {
            return None;
        }
        let between = 0.5 * (left - right) / (left - 2.0 * middle + right);
        Some(((i as f32 + between) / BINS as f32 * TAU).rem_euclid(TAU))
    };
    (0..BINS).filter_map(peak).collect()
}

/// The descriptor at an orientation: histograms of gradients, of length 1 after the square root of each number (Arandjelovic and
/// Zisserman 2012), which compares them better.
pub(super) fn descriptor(level: &Plane, at: &Extremum, orientation: f32) -> [f32; LENGTH] {
    let (sin, cos) = orientation.sin_cos();
    let cell = CELL * at.sigma;
    let half = 0.5 * CELLS as f32;
    let reach = cell * (half + 0.5) * std::f32::consts::SQRT_2;
    let mut bins = [0.0f32; LENGTH];
    around(level, at, reach, |dx, dy, [gx, gy]| {
        let (u, v) = ((cos * dx + sin * dy) / cell, (cos * dy - sin * dx) / cell);
        if u.abs().max(v.abs()) >= half + 0.5 {
            return;
        }
        let weight = (-(u * u + v * v) / (2.0 * half * half)).exp() * gx.hypot(gy);
        let angle = (gy.atan2(gx) - orientation).rem_euclid(TAU) / TAU * ORIENTATIONS as f32;
        shared(&mut bins, [u + half - 0.5, v + half - 0.5, angle], weight);
    });
    let unit = |bins: &mut [f32; LENGTH]| {
        let length = bins.iter().map(|b| b * b).sum::<f32>().sqrt().max(1e-12);
        bins.iter_mut().for_each(|b| *b /= length);
    };
    unit(&mut bins);
    bins.iter_mut().for_each(|b| *b = b.min(LARGEST));
    let sum = bins.iter().sum::<f32>().max(1e-12);
    bins.map(|b| (b / sum).sqrt())
}

/// Adds a weight to the bins around a position: columns, rows and orientations, trilinear.
fn shared(bins: &mut [f32; LENGTH], [x, y, angle]: [f32; 3], weight: f32) {
    let (x0, y0, t0) = (x.floor(), y.floor(), angle.floor());
    for (row, wy) in [(y0, 1.0 - (y - y0)), (y0 + 1.0, y - y0)] {
        if row < 0.0 || row >= CELLS as f32 {
            continue;
        }
        for (column, wx) in [(x0, 1.0 - (x - x0)), (x0 + 1.0, x - x0)] {
            if column < 0.0 || column >= CELLS as f32 {
                continue;
            }
            let first = (row as usize * CELLS + column as usize) * ORIENTATIONS;
            let t = t0 as usize;
            bins[first + t % ORIENTATIONS] += weight * wy * wx * (1.0 - (angle - t0));
            bins[first + (t + 1) % ORIENTATIONS] += weight * wy * wx * (angle - t0);
        }
    }
}

/// Calls `add` with the offset and the gradient of every inner pixel within `reach` of an extremum.
fn around(level: &Plane, at: &Extremum, reach: f32, mut add: impl FnMut(f32, f32, [f32; 2])) {
    let range = |centre: f32, length: usize| {
        let low = (centre - reach).ceil().max(1.0) as usize;
        let high = (centre + reach).floor().min(length as f32 - 2.0);
        low..(high + 1.0).max(0.0) as usize
    };
    for y in range(at.y, level.height) {
        for x in range(at.x, level.width) {
            let (dx, dy) = (x as f32 - at.x, y as f32 - at.y);
            if dx * dx + dy * dy <= reach * reach {
                add(dx, dy, level.gradient(x, y));
            }
        }
    }
}
