//! Separable Gaussian blur of one plane, borders repeated.

/// Sigmas below this change no pixel by a visible amount.
pub(crate) const MIN_SIGMA: f32 = 0.2;

/// Blurs a row-major plane in place.
pub(crate) fn gaussian(plane: &mut [f32], width: usize, height: usize, sigma: f32) {
    if sigma.is_nan() || sigma < MIN_SIGMA || width == 0 || height == 0 {
        return;
    }
    let radius = ((2.5 * sigma).ceil() as usize).clamp(1, 24);
    let mut kernel: Vec<f32> =
        (0..=radius).map(|i| (-0.5 * (i as f32 / sigma) * (i as f32 / sigma)).exp()).collect();
    let sum = kernel[0] + 2.0 * kernel[1..].iter().sum::<f32>();
    kernel.iter_mut().for_each(|k| *k /= sum);

    let mut padded = vec![0.0f32; width + 2 * radius];
    for row in plane.chunks_exact_mut(width) {
        padded[..radius].fill(row[0]);
        padded[radius..radius + width].copy_from_slice(row);
        padded[radius + width..].fill(row[width - 1]);
        let centre = &padded[radius..radius + width];
        row.iter_mut().zip(centre).for_each(|(o, c)| *o = c * kernel[0]);
        for (i, k) in kernel.iter().enumerate().skip(1) {
            let left = &padded[radius - i..radius - i + width];
            let right = &padded[radius + i..radius + i + width];
            for ((o, l), r) in row.iter_mut().zip(left).zip(right) {
                *o += k * (l + r);
            }
        }
    }
    let source = plane.to_vec();
    let row_of = |y: isize| {
        let y = y.clamp(0, height as isize - 1) as usize;
        &source[y * width..(y + 1) * width]
    };
    for (y, row) in plane.chunks_exact_mut(width).enumerate() {
        row.iter_mut().for_each(|o| *o *= kernel[0]);
        for (i, k) in kernel.iter().enumerate().skip(1) {
            let (above, below) = (row_of(y as isize - i as isize), row_of(y as isize + i as isize));
            for ((o, a), b) in row.iter_mut().zip(above).zip(below) {
                *o += k * (a + b);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_constant_stays_and_a_dot_keeps_its_sum() {
        let mut flat = vec![0.3f32; 12 * 7];
        gaussian(&mut flat, 12, 7, 1.5);
        assert!(flat.iter().all(|v| (v - 0.3).abs() < 1e-5));
        let mut dot = vec![0.0f32; 31 * 31];
        dot[15 * 31 + 15] = 1.0;
        gaussian(&mut dot, 31, 31, 2.0);
        assert!((dot.iter().sum::<f32>() - 1.0).abs() < 1e-4);
        // The Gaussian's own value two sigma away, up to the cut at 2.5 sigma.
        let ratio = dot[15 * 31 + 19] / dot[15 * 31 + 15];
        assert!((ratio - (-2.0f32).exp()).abs() < 1e-3, "{ratio}");
    }
}
