//! Encoded photographs: colours and reduced maps that can be sampled at any position.

use sixfold_nn::kernels::neighbours;

use crate::network::{COLOURS, FEATURES};
use crate::samples::relative;

/// Values on a grid, `channels x rows x columns`.
#[derive(Debug, Clone)]
pub(crate) struct Map {
    pub channels: usize,
    pub size: [usize; 2],
    pub values: Vec<f32>,
}

/// The encoder's output for a [`SourceView`](crate::SourceView), kept for many target views.
#[derive(Debug, Clone)]
pub struct SourceFeatures {
    /// Side of the crop, pixels.
    pub(crate) side: usize,
    /// Colours first, then the reduced maps from fine to coarse.
    pub(crate) maps: Vec<Map>,
}

impl SourceFeatures {
    /// Number of channels: 3 colours (-1 to 1) and 13 features, the first sixteen channels of X^S.
    pub fn channels(&self) -> usize {
        COLOURS + FEATURES
    }

    /// Bilinear values at a pixel of the crop (pixel centres at whole numbers); beyond the border the values of the outer pixels
    /// are repeated.
    ///
    /// # Panics
    /// If `out` is shorter than [`Self::channels`].
    pub fn sample(&self, x: f32, y: f32, out: &mut [f32]) {
        let (x, y) = (relative(x, self.side), relative(y, self.side));
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
}
