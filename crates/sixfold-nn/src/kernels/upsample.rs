//! Doubling an image by repeating pixels, and its gradient.

use rayon::prelude::*;

/// Every pixel becomes 2x2 pixels. `x` holds planes of `height x width`.
pub(crate) fn upsample_2x(x: &[f32], [height, width]: [usize; 2]) -> Vec<f32> {
    let mut out = vec![0.0; x.len() * 4];
    out.par_chunks_mut(4 * height * width).zip(x.par_chunks(height * width)).with_min_len(16).for_each(
        |(out, x)| {
            for (rows, line) in out.chunks_exact_mut(4 * width).zip(x.chunks_exact(width)) {
                let (first, second) = rows.split_at_mut(2 * width);
                for (pair, v) in first.chunks_exact_mut(2).zip(line) {
                    pair.fill(*v);
                }
                second.copy_from_slice(first);
            }
        },
    );
    out
}

/// Gradient of [`upsample_2x`]: sums of 2x2 pixels. `height` and `width` are those of the small image.
pub(crate) fn upsample_2x_backward(dy: &[f32], [height, width]: [usize; 2]) -> Vec<f32> {
    let mut out = vec![0.0; dy.len() / 4];
    out.par_chunks_mut(height * width).zip(dy.par_chunks(4 * height * width)).with_min_len(16).for_each(
        |(out, dy)| {
            for (line, rows) in out.chunks_exact_mut(width).zip(dy.chunks_exact(4 * width)) {
                let (first, second) = rows.split_at(2 * width);
                for ((o, a), b) in line.iter_mut().zip(first.chunks_exact(2)).zip(second.chunks_exact(2)) {
                    *o = (a[0] + a[1]) + (b[0] + b[1]);
                }
            }
        },
    );
    out
}
