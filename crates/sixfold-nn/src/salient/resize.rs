//! Resizing with a triangle filter whose width depends on the scale: bilinear for enlarging, without aliasing for shrinking.

use sixfold_geometry::Image;

/// Weights of the values of a line in one value of the resized line: the index of the first, and the weights.
struct Taps(usize, Vec<f32>);

/// The taps for all values of a line resized from `from` to `to` values.
fn taps(from: usize, to: usize) -> Vec<Taps> {
    let scale = from as f64 / to as f64;
    let reach = scale.max(1.0);
    (0..to)
        .map(|i| {
            let centre = (i as f64 + 0.5) * scale;
            let first = (centre - reach).floor().max(0.0) as usize;
            let last = ((centre + reach).ceil() as usize).min(from);
            let weight = |at: usize| (1.0 - ((at as f64 + 0.5 - centre) / reach).abs()).max(0.0);
            let sum: f64 = (first..last).map(weight).sum();
            Taps(first, (first..last).map(|at| (weight(at) / sum) as f32).collect())
        })
        .collect()
}

/// The image with another number of columns and rows. Neither image is empty.
pub(super) fn resized(image: &Image<f32>, [width, height]: [usize; 2]) -> Image<f32> {
    let horizontal = taps(image.width(), width);
    let vertical = taps(image.height(), height);
    let mut narrow = Vec::with_capacity(width * image.height());
    for y in 0..image.height() {
        let row = image.row(y);
        narrow.extend(
            horizontal
                .iter()
                .map(|Taps(first, w)| w.iter().zip(&row[*first..]).map(|(w, v)| w * v).sum::<f32>()),
        );
    }
    let mut out = Image::filled(width, height, 0.0);
    for (line, Taps(first, weights)) in out.as_mut_slice().chunks_exact_mut(width).zip(&vertical) {
        for (weight, row) in weights.iter().zip(narrow[first * width..].chunks_exact(width)) {
            line.iter_mut().zip(row).for_each(|(o, v)| *o += weight * v);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn growing_is_bilinear_and_shrinking_averages() {
        let ramp = Image::from_fn(4, 1, |x, _| x as f32);
        let grown = resized(&ramp, [8, 2]);
        let expected = [0.0, 0.25, 0.75, 1.25, 1.75, 2.25, 2.75, 3.0].repeat(2);
        for (found, expected) in grown.as_slice().iter().zip(expected) {
            assert!((found - expected).abs() < 1e-6, "{found}, not {expected}");
        }
        // Pillow 13's `resize((2, 1), BILINEAR)` of a floating-point image.
        let shrunk = resized(&Image::from_fn(5, 1, |x, _| [3.0, 7.0, 1.0, 9.0, 4.0][x]), [2, 1]);
        for (found, expected) in shrunk.as_slice().iter().zip(PILLOW) {
            assert!((found - expected).abs() < 1e-5, "{found}, not {expected}");
        }
        assert_eq!(resized(&ramp, [4, 1]), ramp);
    }

    const PILLOW: [f32; 2] = [4.45455, 5.50000];
}
