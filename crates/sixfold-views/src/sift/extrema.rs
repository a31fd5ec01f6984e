//! Extrema of the differences of Gaussians, located between pixels and levels (Lowe 2004, sections 3.1 and 4; Brown and Lowe 2002).

use rayon::prelude::*;
use sixfold_geometry::nalgebra::{Matrix3, Vector3};

use super::pyramid::{LEVELS, Octave, Plane, SIGMA};

/// Smallest difference at an extremum, of grey values from 0 to 1, in all levels together.
const CONTRAST: f32 = 0.04;
/// Largest ratio of the principal curvatures: an extremum on an edge has a larger one.
const EDGE: f32 = 10.0;
/// Pixels from the border without extrema.
const BORDER: usize = 5;
/// Steps to the neighbouring pixel or level before an extremum is given up.
const STEPS: usize = 5;

/// An extremum of an octave.
pub(super) struct Extremum {
    /// Position, pixels of the octave.
    pub x: f32,
    pub y: f32,
    /// The nearest level.
    pub level: usize,
    /// Its blur, pixels of the octave.
    pub sigma: f32,
    /// Difference of Gaussians there, positive.
    pub contrast: f32,
}

/// The extrema of an octave, by level, row and column.
pub(super) fn extrema(octave: &Octave) -> Vec<Extremum> {
    let d = &octave.differences;
    let (width, height) = (d[0].width, d[0].height);
    if width.min(height) <= 2 * BORDER {
        return vec![];
    }
    let rows: Vec<(usize, usize)> =
        (1..=LEVELS).flat_map(|level| (BORDER..height - BORDER).map(move |y| (level, y))).collect();
    let of_row = |(level, y): (usize, usize)| {
        let mut found = Vec::new();
        for x in BORDER..width - BORDER {
            let value = d[level].at(x, y);
            if value.abs() > 0.5 * CONTRAST / LEVELS as f32 && extreme(d, level, x, y, value) {
                found.extend(located(d, level, x, y));
            }
        }
        found
    };
    rows.into_par_iter().flat_map_iter(of_row).collect()
}

/// Whether no neighbour in the three levels is above a positive value, or below a negative one.
fn extreme(d: &[Plane], level: usize, x: usize, y: usize, value: f32) -> bool {
    let sign = value.signum();
    d[level - 1..=level + 1].iter().all(|plane| {
        (y - 1..=y + 1).all(|v| {
            let row = &plane.data[v * plane.width + x - 1..v * plane.width + x + 2];
            row.iter().all(|other| other * sign <= value * sign)
        })
    })
}

/// The extremum of the quadratic through a pixel's neighbours; `None` if it is weak, on an edge, or leaves the pixel's surroundings.
fn located(d: &[Plane], level: usize, x: usize, y: usize) -> Option<Extremum> {
    let (width, height) = (d[0].width, d[0].height);
    let (mut level, mut x, mut y) = (level, x, y);
    for _ in 0..STEPS {
        let at = |dx: isize, dy: isize, dl: isize| {
            d[level.wrapping_add_signed(dl)].at(x.wrapping_add_signed(dx), y.wrapping_add_signed(dy))
        };
        let value = at(0, 0, 0);
        let slope = Vector3::new(
            0.5 * (at(1, 0, 0) - at(-1, 0, 0)),
            0.5 * (at(0, 1, 0) - at(0, -1, 0)),
            0.5 * (at(0, 0, 1) - at(0, 0, -1)),
        );
        let (xx, yy, ll) = (
            at(1, 0, 0) + at(-1, 0, 0) - 2.0 * value,
            at(0, 1, 0) + at(0, -1, 0) - 2.0 * value,
            at(0, 0, 1) + at(0, 0, -1) - 2.0 * value,
        );
        let xy = 0.25 * (at(1, 1, 0) + at(-1, -1, 0) - at(1, -1, 0) - at(-1, 1, 0));
        let xl = 0.25 * (at(1, 0, 1) + at(-1, 0, -1) - at(1, 0, -1) - at(-1, 0, 1));
        let yl = 0.25 * (at(0, 1, 1) + at(0, -1, -1) - at(0, 1, -1) - at(0, -1, 1));
        let offset = Matrix3::new(xx, xy, xl, xy, yy, yl, xl, yl, ll).lu().solve(&-slope)?;
        if offset.iter().all(|v| v.abs() < 0.5) {
            let contrast = (value + 0.5 * slope.dot(&offset)).abs();
            let (trace, determinant) = (xx + yy, xx * yy - xy * xy);
            let edge = determinant <= 0.0 || trace * trace * EDGE >= (EDGE + 1.0).powi(2) * determinant;
            if contrast * (LEVELS as f32) < CONTRAST || edge {
                return None;
            }
            let sigma = SIGMA * 2.0f32.powf((level as f32 + offset.z) / LEVELS as f32);
            return Some(Extremum { x: x as f32 + offset.x, y: y as f32 + offset.y, level, sigma, contrast });
        }
        let moved = |from: usize, by: f32, low: usize, high: usize| {
            let to = from as f32 + by.round();
            (to >= low as f32 && to <= high as f32).then_some(to as usize)
        };
        x = moved(x, offset.x, BORDER, width - BORDER - 1)?;
        y = moved(y, offset.y, BORDER, height - BORDER - 1)?;
        level = moved(level, offset.z, 1, LEVELS)?;
    }
    None
}
