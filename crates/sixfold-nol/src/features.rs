//! Encoded photographs: colours and reduced maps that are looked up at any place, with or without the slope.

use sixfold_nn::kernels::neighbours;

use crate::network::{COLOURS, FEATURES};
use crate::samples::share;

/// Values on a grid, `channels x rows x columns`.
#[derive(Debug, Clone)]
pub(crate) struct Map {
    pub channels: usize,
    pub size: [usize; 2],
    pub values: Vec<f32>,
}

/// What the encoder makes of a [`SourceView`](crate::SourceView): kept for many target views and for refinement.
#[derive(Debug, Clone)]
pub struct SourceFeatures {
    /// Side of the crop, pixels.
    pub(crate) side: usize,
    /// Colours first, then the reduced maps from fine to coarse.
    pub(crate) maps: Vec<Map>,
}

impl SourceFeatures {
    /// Values at a place: 3 colours (-1 to 1) and 13 features, the first sixteen channels of X^S.
    pub fn channels(&self) -> usize {
        COLOURS + FEATURES
    }

    /// Bilinear values at a pixel of the crop (pixel centres at whole numbers); the outer pixels' values go on beyond them.
    ///
    /// # Panics
    /// If `out` is shorter than [`Self::channels`].
    pub fn sample(&self, x: f32, y: f32, out: &mut [f32]) {
        let (x, y) = (share(x, self.side), share(y, self.side));
        let mut rest = out;
        for map in &self.maps {
            let (at, weights) = neighbours(x, y, map.size);
            let planes = map.values.chunks_exact(map.size[0] * map.size[1]);
            let (mine, others) = rest.split_at_mut(map.channels);
            for (value, plane) in mine.iter_mut().zip(planes) {
                *value = at.iter().zip(&weights).map(|(i, w)| plane[*i] * w).sum();
            }
            rest = others;
        }
    }

    /// [`Self::sample`] and the values' slopes along x and y, per pixel of the crop.
    ///
    /// # Panics
    /// If a slice is shorter than [`Self::channels`].
    pub fn sample_with_gradient(&self, x: f32, y: f32, out: &mut [f32], dx: &mut [f32], dy: &mut [f32]) {
        let mut first = 0;
        for map in &self.maps {
            let [height, width] = map.size;
            let (to_x, to_y) = (width as f32 / self.side as f32, height as f32 / self.side as f32);
            let (u, v) =
                (share(x, self.side) * width as f32 - 0.5, share(y, self.side) * height as f32 - 0.5);
            let (u_in, v_in) = (u.clamp(0.0, (width - 1) as f32), v.clamp(0.0, (height - 1) as f32));
            // Beyond the outer pixels nothing changes.
            let (to_x, to_y) = (if u == u_in { to_x } else { 0.0 }, if v == v_in { to_y } else { 0.0 });
            // At the last pixel the cell before it is taken, which has a slope.
            let x0 = (u_in as usize).min(width.saturating_sub(2));
            let y0 = (v_in as usize).min(height.saturating_sub(2));
            let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
            let (fx, fy) = (u_in - x0 as f32, v_in - y0 as f32);
            for (c, plane) in map.values.chunks_exact(height * width).enumerate() {
                let at = |x: usize, y: usize| plane[y * width + x];
                let (a, b, c_, d) = (at(x0, y0), at(x1, y0), at(x0, y1), at(x1, y1));
                let (top, bottom) = (a + (b - a) * fx, c_ + (d - c_) * fx);
                out[first + c] = top + (bottom - top) * fy;
                dx[first + c] = to_x * ((b - a) * (1.0 - fy) + (d - c_) * fy);
                dy[first + c] = to_y * (bottom - top);
            }
            first += map.channels;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slopes_are_those_of_the_values() {
        let map = |channels: usize, side: usize| Map {
            channels,
            size: [side, side],
            values: (0..channels * side * side).map(|i| (i as f32 * 0.37).sin()).collect(),
        };
        let maps = vec![map(3, 16), map(4, 8), map(3, 4), map(3, 2), map(3, 1)];
        let features = SourceFeatures { side: 16, maps };
        let n = features.channels();
        assert_eq!(n, 16);
        let [mut a, mut b, mut v, mut dx, mut dy] = [0; 5].map(|_| vec![0.0; n]);
        for (x, y) in [(3.3, 7.2), (0.2, 14.6), (9.9, 9.1)] {
            features.sample_with_gradient(x, y, &mut v, &mut dx, &mut dy);
            features.sample(x, y, &mut a);
            assert!(v.iter().zip(&a).all(|(v, a)| (v - a).abs() < 1e-5));
            let h = 0.01;
            for (slope, ahead, behind) in [(&dx, (x + h, y), (x - h, y)), (&dy, (x, y + h), (x, y - h))] {
                features.sample(ahead.0, ahead.1, &mut a);
                features.sample(behind.0, behind.1, &mut b);
                for c in 0..n {
                    let expected = (a[c] - b[c]) / (2.0 * h);
                    assert!((slope[c] - expected).abs() < 2e-3, "{c}: {} {expected}", slope[c]);
                }
            }
        }
    }
}
