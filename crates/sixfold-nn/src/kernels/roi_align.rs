//! RoIAlign (He et al. 2017, section 3): resamples boxes of a feature map to a common size by bilinear samples in every bin, and
//! its gradient.
//!
//! As in torchvision without `aligned`: a box's coordinates times the scale are positions in the map, pixel centres are at whole
//! numbers, a box has at least one pixel, and samples more than one pixel outside the map are 0.

use rayon::prelude::*;

/// Boxes to be pooled, and the options.
#[derive(Debug, Clone, PartialEq)]
pub struct Regions {
    /// Left, top, right and bottom in the image's pixels.
    pub boxes: Vec<[f32; 4]>,
    /// Pixels of the map per pixel of the image.
    pub scale: f32,
    /// Bins along each side of the output.
    pub side: usize,
    /// Samples along each side of a bin; `None`: one per pixel of the map.
    pub samples: Option<usize>,
}

/// Four neighbours of a sample in the map and their weights; all 0 for a sample outside.
#[derive(Debug, Clone, Copy)]
struct Sample {
    at: [u32; 4],
    weights: [f32; 4],
}

/// The samples of a box, bin by bin, and their number per bin.
struct Grid {
    samples: Vec<Sample>,
    per_bin: usize,
}

/// Neighbours of a position along one side and the weight of the second; `None` outside.
fn along(place: f32, side: usize) -> Option<(usize, usize, f32)> {
    // NaN counts as outside, too.
    if !(place >= -1.0 && place <= side as f32) {
        return None;
    }
    let place = place.max(0.0);
    let low = place as usize;
    if low + 1 >= side { Some((side - 1, side - 1, 0.0)) } else { Some((low, low + 1, place - low as f32)) }
}

fn sample(x: f32, y: f32, [height, width]: [usize; 2]) -> Sample {
    let (Some((x0, x1, fx)), Some((y0, y1, fy))) = (along(x, width), along(y, height)) else {
        return Sample { at: [0; 4], weights: [0.0; 4] };
    };
    Sample {
        at: [y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1].map(|i| i as u32),
        weights: [(1.0 - fy) * (1.0 - fx), (1.0 - fy) * fx, fy * (1.0 - fx), fy * fx],
    }
}

impl Regions {
    fn grid(&self, corners: &[f32; 4], size: [usize; 2]) -> Grid {
        let [left, top, right, bottom] = corners.map(|v| v * self.scale);
        let bins = self.side as f32;
        let (width, height) = ((right - left).max(1.0), (bottom - top).max(1.0));
        let (bin_width, bin_height) = (width / bins, height / bins);
        let count = |bin: f32| self.samples.unwrap_or_else(|| (bin.ceil() as usize).max(1));
        let (columns, rows) = (count(bin_width), count(bin_height));
        let place = |first: f32, bin: usize, extent: f32, i: usize, count: usize| {
            first + bin as f32 * extent + (i as f32 + 0.5) * extent / count as f32
        };
        let mut samples = Vec::with_capacity(self.side * self.side * rows * columns);
        for v in 0..self.side {
            for u in 0..self.side {
                for row in 0..rows {
                    let y = place(top, v, bin_height, row, rows);
                    for column in 0..columns {
                        samples.push(sample(place(left, u, bin_width, column, columns), y, size));
                    }
                }
            }
        }
        Grid { samples, per_bin: rows * columns }
    }

    /// Every bin as a weighted sum of the map's pixels, term by term: of all bins the pixel and its weight. Boxes with fewer samples
    /// have terms of weight 0.
    pub(crate) fn terms(&self, size: [usize; 2]) -> Vec<(Vec<i32>, Vec<f32>)> {
        let grids: Vec<Grid> = self.boxes.iter().map(|b| self.grid(b, size)).collect();
        let per_bin = grids.iter().map(|g| g.per_bin).max().unwrap_or(0);
        let bins = self.side * self.side;
        let mut terms = vec![(vec![0; grids.len() * bins], vec![0.0; grids.len() * bins]); 4 * per_bin];
        for (number, grid) in grids.iter().enumerate() {
            for (bin, samples) in grid.samples.chunks_exact(grid.per_bin).enumerate() {
                for (i, sample) in samples.iter().enumerate() {
                    for (j, (at, weight)) in sample.at.into_iter().zip(sample.weights).enumerate() {
                        let (pixels, weights) = &mut terms[4 * i + j];
                        pixels[number * bins + bin] = at as i32;
                        weights[number * bins + bin] = weight / grid.per_bin as f32;
                    }
                }
            }
        }
        terms
    }
}

/// Computes `boxes x channels x side x side` from a map of `channels x size`.
pub fn roi_align_forward(map: &[f32], channels: usize, size: [usize; 2], regions: &Regions) -> Vec<f32> {
    let (plane, bins) = (size[0] * size[1], regions.side * regions.side);
    let mut out = vec![0.0; regions.boxes.len() * channels * bins];
    if out.is_empty() || plane == 0 {
        return out;
    }
    out.par_chunks_mut(channels * bins).zip(&regions.boxes).for_each(|(out, corners)| {
        let grid = regions.grid(corners, size);
        let count = grid.per_bin as f32;
        for (out, map) in out.chunks_exact_mut(bins).zip(map.chunks_exact(plane)) {
            for (value, samples) in out.iter_mut().zip(grid.samples.chunks_exact(grid.per_bin)) {
                let mut sum = 0.0;
                for s in samples {
                    let [a, b, c, d] = s.at.map(|i| map[i as usize]);
                    sum += s.weights[0] * a + s.weights[1] * b + s.weights[2] * c + s.weights[3] * d;
                }
                *value = sum / count;
            }
        }
    });
    out
}

/// Gradient of [`roi_align_forward`] with respect to the map.
pub(crate) fn roi_align_backward(
    dout: &[f32],
    channels: usize,
    size: [usize; 2],
    regions: &Regions,
) -> Vec<f32> {
    let (plane, bins) = (size[0] * size[1], regions.side * regions.side);
    let mut dmap = vec![0.0; channels * plane];
    if dmap.is_empty() || regions.boxes.is_empty() {
        return dmap;
    }
    let grids: Vec<Grid> = regions.boxes.par_iter().map(|b| regions.grid(b, size)).collect();
    // The boxes of a channel are summed in order on one thread, independent of the number of threads.
    dmap.par_chunks_mut(plane).enumerate().for_each(|(channel, dmap)| {
        for (number, grid) in grids.iter().enumerate() {
            let dout = &dout[(number * channels + channel) * bins..][..bins];
            for (d, samples) in dout.iter().zip(grid.samples.chunks_exact(grid.per_bin)) {
                let d = d / grid.per_bin as f32;
                for s in samples {
                    for (i, w) in s.at.iter().zip(&s.weights) {
                        dmap[*i as usize] += d * w;
                    }
                }
            }
        }
    });
    dmap
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The definition, one sample after the other.
    fn naive(map: &dyn Fn(i64, i64) -> f64, [height, width]: [i64; 2], r: &Regions, b: usize) -> Vec<f64> {
        let corners = r.boxes[b].map(|v| f64::from(v) * f64::from(r.scale));
        let extent = [(corners[2] - corners[0]).max(1.0), (corners[3] - corners[1]).max(1.0)];
        let bin = extent.map(|e| e / r.side as f64);
        let n = bin.map(|e| r.samples.unwrap_or(e.ceil() as usize));
        let mut out = vec![];
        for v in 0..r.side {
            for u in 0..r.side {
                let mut sum = 0.0;
                for j in 0..n[1] {
                    for i in 0..n[0] {
                        let x = corners[0] + bin[0] * (u as f64 + (i as f64 + 0.5) / n[0] as f64);
                        let y = corners[1] + bin[1] * (v as f64 + (j as f64 + 0.5) / n[1] as f64);
                        if x < -1.0 || y < -1.0 || x > width as f64 || y > height as f64 {
                            continue;
                        }
                        let (x, y) = (x.clamp(0.0, (width - 1) as f64), y.clamp(0.0, (height - 1) as f64));
                        // The tent function around each pixel.
                        for py in [y.floor() as i64, y.floor() as i64 + 1] {
                            for px in [x.floor() as i64, x.floor() as i64 + 1] {
                                if px < width && py < height {
                                    let tent = |a: f64, p: i64| 1.0 - (a - p as f64).abs();
                                    sum += tent(x, px) * tent(y, py) * map(px, py);
                                }
                            }
                        }
                    }
                }
                out.push(sum / (n[0] * n[1]) as f64);
            }
        }
        out
    }

    fn regions(samples: Option<usize>) -> Regions {
        let boxes = vec![
            [3.0, 2.0, 37.0, 21.0],
            [0.0, 0.0, 48.0, 40.0],
            [10.2, 11.7, 10.4, 11.9],
            [40.0, -9.0, 60.0, 50.0],
            [-30.0, -30.0, -20.0, -20.0],
        ];
        Regions { boxes, scale: 0.25, side: 3, samples }
    }

    #[test]
    fn it_agrees_with_the_definition() {
        let size = [10, 12];
        let map: Vec<f32> = (0..2 * 120).map(|i| ((i * i) as f32 * 0.37).sin()).collect();
        for samples in [Some(2), None, Some(3)] {
            let regions = regions(samples);
            let out = roi_align_forward(&map, 2, size, &regions);
            assert_eq!(out.len(), 5 * 2 * 9);
            for b in 0..5 {
                for c in 0..2 {
                    let pixel = |x: i64, y: i64| f64::from(map[c * 120 + (y * 12 + x) as usize]);
                    let expected = naive(&pixel, [10, 12], &regions, b);
                    for (i, e) in expected.iter().enumerate() {
                        let found = f64::from(out[(b * 2 + c) * 9 + i]);
                        assert!((found - e).abs() < 1e-5, "{samples:?} box {b} bin {i}: {found} {e}");
                    }
                }
            }
        }
    }

    #[test]
    fn an_even_slope_stays_one_and_no_box_gives_nothing() {
        // f(x, y) = x: a bin's value is its centre.
        let map: Vec<f32> = (0..64).map(|i| (i % 8) as f32).collect();
        let regions = Regions { boxes: vec![[1.0, 1.0, 5.0, 5.0]], scale: 1.0, side: 2, samples: Some(2) };
        assert_eq!(roi_align_forward(&map, 1, [8, 8], &regions), [2.0, 4.0, 2.0, 4.0]);
        let none = Regions { boxes: vec![], ..regions };
        assert!(roi_align_forward(&map, 1, [8, 8], &none).is_empty());
        assert_eq!(roi_align_backward(&[], 1, [8, 8], &none), [0.0; 64]);
    }

    #[test]
    fn the_gradient_is_that_of_finite_differences_on_any_number_of_threads() {
        let size = [10, 12];
        let map: Vec<f32> = (0..2 * 120).map(|i| (i as f32 * 0.7).sin()).collect();
        let regions = regions(Some(2));
        let weights: Vec<f32> = (0..5 * 2 * 9).map(|i| (i as f32 * 1.9).cos()).collect();
        let value = |map: &[f32]| -> f64 {
            let out = roi_align_forward(map, 2, size, &regions);
            out.iter().zip(&weights).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
        };
        let gradient = roi_align_backward(&weights, 2, size, &regions);
        for (i, expected) in gradient.iter().enumerate() {
            let (mut up, mut down) = (map.clone(), map.clone());
            up[i] += 0.5;
            down[i] -= 0.5;
            let slope = value(&up) - value(&down);
            assert!((slope - f64::from(*expected)).abs() < 1e-4, "{i}: {slope} {expected}");
        }
        let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert!(one.install(|| roi_align_backward(&weights, 2, size, &regions)) == gradient);
    }
}
