//! Distances to the border of a mask (Felzenszwalb and Huttenlocher 2012).

use sixfold_geometry::{Image, Mask};

/// Signed distance of each pixel to the border of a mask, pixels: below zero inside, above zero outside.
pub(crate) fn signed_distance(mask: &Mask) -> Image<f32> {
    let (width, height) = mask.size();
    let outside = squared_distance(mask, true);
    let inside = squared_distance(mask, false);
    Image::from_fn(width, height, |x, y| {
        // The border is between two pixels, half a pixel from each.
        if mask[(x, y)] { 0.5 - inside[(x, y)].sqrt() } else { outside[(x, y)].sqrt() - 0.5 }
    })
}

/// The squared distance to the nearest pixel of a value; the squared diagonal of the image if there is none.
fn squared_distance(mask: &Mask, of: bool) -> Image<f32> {
    let (width, height) = mask.size();
    let far = (width * width + height * height) as f32;
    let mut image = Image::from_fn(width, height, |x, y| if mask[(x, y)] == of { 0.0 } else { far });
    let mut column = vec![0.0; height];
    for x in 0..width {
        (0..height).for_each(|y| column[y] = image[(x, y)]);
        let done = along_line(&column);
        (0..height).for_each(|y| image[(x, y)] = done[y]);
    }
    for y in 0..height {
        let row = &mut image.as_mut_slice()[y * width..(y + 1) * width];
        let done = along_line(row);
        row.copy_from_slice(&done);
    }
    image.map(|v| v.min(far))
}

/// The lower envelope of the parabolas at all pixels of a line.
pub(crate) fn along_line(values: &[f32]) -> Vec<f32> {
    let n = values.len();
    let (mut roots, mut bounds) = (vec![0usize; n], vec![0.0f32; n + 1]);
    let mut last = 0;
    (bounds[0], bounds[1]) = (f32::NEG_INFINITY, f32::INFINITY);
    let square = |i: usize| (i * i) as f32;
    for q in 1..n {
        loop {
            let r = roots[last];
            let s = ((values[q] + square(q)) - (values[r] + square(r))) / (2.0 * (q - r) as f32);
            if s > bounds[last] || last == 0 {
                if s > bounds[last] {
                    last += 1;
                }
                roots[last] = q;
                bounds[last] = if last == 0 { f32::NEG_INFINITY } else { s };
                bounds[last + 1] = f32::INFINITY;
                break;
            }
            last -= 1;
        }
    }
    let mut at = 0;
    (0..n)
        .map(|q| {
            while bounds[at + 1] < q as f32 {
                at += 1;
            }
            (q as f32 - roots[at] as f32).powi(2) + values[roots[at]]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_are_those_of_a_search_over_all_pixels() {
        let mask =
            Image::from_fn(23, 17, |x, y| (x * 7 + y * 5) % 11 < 4 || (x > 5 && x < 12 && y > 3 && y < 14));
        let found = signed_distance(&mask);
        for y in 0..17 {
            for x in 0..23 {
                let mut nearest = f32::INFINITY;
                for v in 0..17 {
                    for u in 0..23 {
                        if mask[(u, v)] != mask[(x, y)] {
                            nearest = nearest
                                .min(((u as f32 - x as f32).powi(2) + (v as f32 - y as f32).powi(2)).sqrt());
                        }
                    }
                }
                let expected = if mask[(x, y)] { 0.5 - nearest } else { nearest - 0.5 };
                assert!((found[(x, y)] - expected).abs() < 1e-3, "{x} {y}: {} {expected}", found[(x, y)]);
            }
        }
        let empty = signed_distance(&Image::filled(5, 4, false));
        assert!(empty.as_slice().iter().all(|d| *d > 5.0));
    }
}
