//! Bilinear sampling of feature maps at given positions, and its gradient. The cost depends only on the number of positions.

use rayon::prelude::*;

/// A pixel to be filled, and the position of its value in the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SampledPixel {
    /// Number of the pixel, row by row.
    pub pixel: u32,
    /// Column in the map as a fraction of its width: 0 at the left border of the first pixel, 1 at the right border of the last.
    pub x: f32,
    /// Row in the map as a fraction of its height.
    pub y: f32,
}

/// The sampling positions for a batch of images: for every image the positions in its map; pixels without a position are 0.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Places {
    /// Rows and columns of the output images.
    pub size: [usize; 2],
    /// Positions of every image.
    pub images: Vec<Vec<SampledPixel>>,
}

/// The four neighbours of a position in a map of `height x width`, and their weights. Beyond the outer pixels' centres the border
/// values are repeated.
#[inline]
pub fn neighbours(x: f32, y: f32, [height, width]: [usize; 2]) -> ([usize; 4], [f32; 4]) {
    let u = (x * width as f32 - 0.5).clamp(0.0, (width - 1) as f32);
    let v = (y * height as f32 - 0.5).clamp(0.0, (height - 1) as f32);
    let (x0, y0) = (u as usize, v as usize);
    let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
    let (fx, fy) = (u - x0 as f32, v - y0 as f32);
    (
        [y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1],
        [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy],
    )
}

/// Fills images (`images x channels x rows x columns` of `places`) from maps (`images x channels x size`).
pub(crate) fn gather_forward(maps: &[f32], channels: usize, size: [usize; 2], places: &Places) -> Vec<f32> {
    let (small, large) = (size[0] * size[1], places.size[0] * places.size[1]);
    let mut out = vec![0.0; places.images.len() * channels * large];
    if out.is_empty() {
        return out;
    }
    out.par_chunks_mut(channels * large).zip(maps.par_chunks(channels * small)).zip(&places.images).for_each(
        |((out, map), places)| {
            for place in places {
                let (at, weights) = neighbours(place.x, place.y, size);
                for c in 0..channels {
                    let plane = &map[c * small..(c + 1) * small];
                    out[c * large + place.pixel as usize] =
                        at.iter().zip(&weights).map(|(i, w)| plane[*i] * w).sum();
                }
            }
        },
    );
    out
}

/// Gradient of [`gather_forward`] with respect to the maps.
pub(crate) fn gather_backward(dout: &[f32], channels: usize, size: [usize; 2], places: &Places) -> Vec<f32> {
    let (small, large) = (size[0] * size[1], places.size[0] * places.size[1]);
    let mut dmaps = vec![0.0; places.images.len() * channels * small];
    if dmaps.is_empty() {
        return dmaps;
    }
    // The positions of an image are summed in order on one thread, independent of the number of threads.
    dmaps
        .par_chunks_mut(channels * small)
        .zip(dout.par_chunks(channels * large))
        .zip(&places.images)
        .for_each(|((dmap, dout), places)| {
            for place in places {
                let (at, weights) = neighbours(place.x, place.y, size);
                for c in 0..channels {
                    let d = dout[c * large + place.pixel as usize];
                    for (i, w) in at.iter().zip(&weights) {
                        dmap[c * small + i] += d * w;
                    }
                }
            }
        });
    dmaps
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixel_centres_give_pixels_and_the_gradient_is_that_of_finite_differences() {
        let size = [3, 4];
        let map: Vec<f32> = (0..2 * 12).map(|i| (i as f32 * 0.7).sin()).collect();
        let exact = Places {
            size: [1, 2],
            images: vec![vec![SampledPixel { pixel: 1, x: 2.5 / 4.0, y: 1.5 / 3.0 }]],
        };
        let out = gather_forward(&map, 2, size, &exact);
        assert_eq!(out[0], 0.0);
        assert!((out[1] - map[6]).abs() < 1e-6 && (out[3] - map[18]).abs() < 1e-6);
        let images = vec![
            (0..5).map(|i| SampledPixel { pixel: i, x: 0.21 * i as f32, y: 0.9 - 0.17 * i as f32 }).collect(),
        ];
        let places = Places { size: [2, 3], images };
        let weights: Vec<f32> = (0..12).map(|i| (i as f32 * 1.9).cos()).collect();
        let value = |map: &[f32]| -> f64 {
            let out = gather_forward(map, 2, size, &places);
            out.iter().zip(&weights).map(|(a, b)| f64::from(a * b)).sum()
        };
        let gradient = gather_backward(&weights, 2, size, &places);
        for (i, expected) in gradient.iter().enumerate() {
            let (mut up, mut down) = (map.clone(), map.clone());
            up[i] += 0.1;
            down[i] -= 0.1;
            let slope = (value(&up) - value(&down)) / 0.2;
            assert!((slope - f64::from(*expected)).abs() < 1e-4, "{i}: {slope} {expected}");
        }
    }
}
