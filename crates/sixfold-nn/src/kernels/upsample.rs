//! Upsampling an image by two, by repeating pixels or bilinearly, and the gradients.

use super::shared::vectorised;
use rayon::prelude::*;

/// Interpolation between the pixels of the small image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Upsampling {
    /// Copies: every pixel becomes 2x2 pixels.
    Repeated,
    /// Three quarters of the nearest pixel and one of the next one in each direction; beyond the border its pixels are repeated.
    Bilinear,
}

/// Upsamples to twice the rows and columns. `x` has planes of `height x width`.
pub(crate) fn upsample_2x(x: &[f32], [height, width]: [usize; 2], kind: Upsampling) -> Vec<f32> {
    let mut out = vec![0.0; x.len() * 4];
    let planes = out.par_chunks_mut(4 * height * width).zip(x.par_chunks(height * width));
    match kind {
        Upsampling::Repeated => planes.with_min_len(16).for_each(|(out, x)| repeat(out, x, width)),
        Upsampling::Bilinear => planes.for_each(|(out, x)| {
            let mut line = vec![0.0; width];
            for (row, out) in out.chunks_exact_mut(2 * width).enumerate() {
                let [near, next] = rows(row, height).map(|y| &x[y * width..][..width]);
                blend(&mut line, near, next);
                double(out, &line);
            }
        }),
    }
    out
}

/// Gradient of [`upsample_2x`]. `height` and `width` are those of the small image.
pub(crate) fn upsample_2x_backward(dy: &[f32], [height, width]: [usize; 2], kind: Upsampling) -> Vec<f32> {
    let mut out = vec![0.0; dy.len() / 4];
    let planes = out.par_chunks_mut(height * width).zip(dy.par_chunks(4 * height * width));
    match kind {
        Upsampling::Repeated => planes.with_min_len(16).for_each(|(out, dy)| add_repeated(out, dy, width)),
        Upsampling::Bilinear => planes.for_each(|(out, dy)| {
            let mut line = vec![0.0; width];
            for (row, dy) in dy.chunks_exact(2 * width).enumerate() {
                halve(&mut line, dy);
                for (y, part) in rows(row, height).into_iter().zip([0.75, 0.25]) {
                    out[y * width..][..width].iter_mut().zip(&line).for_each(|(o, v)| *o += part * v);
                }
            }
        }),
    }
    out
}

fn repeat(out: &mut [f32], x: &[f32], width: usize) {
    for (rows, line) in out.chunks_exact_mut(4 * width).zip(x.chunks_exact(width)) {
        let (first, second) = rows.split_at_mut(2 * width);
        for (pair, v) in first.chunks_exact_mut(2).zip(line) {
            pair.fill(*v);
        }
        second.copy_from_slice(first);
    }
}

/// Sums of 2x2 pixels.
fn add_repeated(out: &mut [f32], dy: &[f32], width: usize) {
    for (line, rows) in out.chunks_exact_mut(width).zip(dy.chunks_exact(4 * width)) {
        let (first, second) = rows.split_at(2 * width);
        for ((o, a), b) in line.iter_mut().zip(first.chunks_exact(2)).zip(second.chunks_exact(2)) {
            *o = (a[0] + a[1]) + (b[0] + b[1]);
        }
    }
}

/// The nearest row of the small image and the next one, for a row of the large image.
fn rows(row: usize, height: usize) -> [usize; 2] {
    let near = row / 2;
    let next = if row.is_multiple_of(2) { near.saturating_sub(1) } else { (near + 1).min(height - 1) };
    [near, next]
}

vectorised! {
    fn blend(out: &mut [f32], near: &[f32], next: &[f32]) {
        for ((o, a), b) in out.iter_mut().zip(near).zip(next) {
            *o = 0.75 * a + 0.25 * b;
        }
    }
}

vectorised! {
    fn double(out: &mut [f32], line: &[f32]) {
        let width = line.len();
        out[0] = line[0];
        out[2 * width - 1] = line[width - 1];
        for (pair, v) in out[1..2 * width - 1].chunks_exact_mut(2).zip(line.windows(2)) {
            pair[0] = 0.75 * v[0] + 0.25 * v[1];
            pair[1] = 0.25 * v[0] + 0.75 * v[1];
        }
    }
}

/// The transpose of [`double`].
fn halve(line: &mut [f32], dy: &[f32]) {
    let width = line.len();
    line.fill(0.0);
    line[0] = dy[0];
    line[width - 1] += dy[2 * width - 1];
    for (i, pair) in dy[1..2 * width - 1].chunks_exact(2).enumerate() {
        line[i] += 0.75 * pair[0] + 0.25 * pair[1];
        line[i + 1] += 0.25 * pair[0] + 0.75 * pair[1];
    }
}
