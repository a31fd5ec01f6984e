//! Which parts of an image may show an object: features of EfficientNet-Lite0 (Tan and Le 2019), as trained on ImageNet, of the
//! object's views and of the image. Unlike the features that correspondences are found with, they describe what kind of thing and
//! material a part shows.

use burn::tensor::{Device, Tensor, TensorData};
use sixfold_nn::lite0::{Lite0, imagenet_encoder};

use crate::error::ViewsError;
use crate::matching::{best_of, near};

/// Side of a cell, pixels.
pub(crate) const CELL: usize = 16;
/// Numbers of a feature.
pub(crate) const CHANNELS: usize = 112;
/// Stages of the network that are computed; the last one's features are used.
const STAGES: usize = 5;
/// Largest distance of a feature from its position in the view, cells.
const REACH: usize = 1;
/// Crops per forward pass.
const BATCH: usize = 8;

/// The network, ready to run.
#[derive(Debug)]
pub(crate) struct Recogniser {
    network: Lite0,
    device: Device,
}

/// Features of a square crop, row by row, each of length 1.
#[derive(Debug, Clone)]
pub(crate) struct Recognised {
    /// Cells along each side.
    pub cells: usize,
    /// [`CHANNELS`] numbers per cell.
    pub features: Vec<f32>,
}

/// Features of an object's view, each of length 1.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Appearance {
    /// Cells that show mostly the object.
    pub cells: Vec<u16>,
    /// Their features.
    pub features: Vec<f32>,
}

impl Recogniser {
    /// The network as shipped.
    pub(crate) fn shipped() -> Result<Recogniser, ViewsError> {
        let device = Device::default();
        Ok(Recogniser { network: imagenet_encoder(&device)?, device })
    }

    /// Features of colour crops of `side` x `side` pixels, three planes from 0 to 1 each.
    pub(crate) fn features(&self, crops: &[&[f32]], side: usize) -> Result<Vec<Recognised>, ViewsError> {
        let cells = side / CELL;
        let mut out = Vec::with_capacity(crops.len());
        for batch in crops.chunks(BATCH) {
            // The network was trained on `(value - 127) / 128` of 8-bit values.
            let data: Vec<f32> = batch.iter().flat_map(|c| c.iter().map(|v| (v * 255.0 - 127.0) / 128.0)).collect();
            let data = TensorData::new(data, [batch.len(), 3, side, side]);
            let mut maps = self.network.forward_stages(Tensor::<4>::from_data(data, &self.device), STAGES);
            let Some(last) = maps.pop() else { break };
            let seen =
                last.try_into_vec_as::<f32>().map_err(|e| ViewsError::Network { reason: e.to_string() })?;
            out.extend(seen.chunks_exact(CHANNELS * cells * cells).map(|planes| of_planes(planes, cells)));
        }
        Ok(out)
    }
}

/// Features cell by cell, of length 1.
fn of_planes(planes: &[f32], cells: usize) -> Recognised {
    let count = cells * cells;
    let mut features = vec![0.0f32; CHANNELS * count];
    for (cell, feature) in features.chunks_exact_mut(CHANNELS).enumerate() {
        feature.iter_mut().enumerate().for_each(|(c, v)| *v = planes[c * count + cell]);
        let length = feature.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
        feature.iter_mut().for_each(|v| *v /= length);
    }
    Recognised { cells, features }
}

impl Appearance {
    /// The features of a view on the cells of which more than half the pixels are `shown`.
    pub(crate) fn new(map: &Recognised, shown: impl Fn(usize) -> bool) -> Appearance {
        let side = map.cells * CELL;
        let mostly = |cell: &usize| {
            let (x, y) = (cell % map.cells * CELL, cell / map.cells * CELL);
            let pixels = (y..y + CELL).flat_map(|v| (x..x + CELL).map(move |u| v * side + u));
            2 * pixels.filter(|i| shown(*i)).count() > CELL * CELL
        };
        let cells: Vec<usize> = (0..map.cells * map.cells).filter(mostly).collect();
        let features = cells.iter().flat_map(|c| map.features[c * CHANNELS..][..CHANNELS].iter().copied());
        Appearance { features: features.collect(), cells: cells.iter().map(|c| *c as u16).collect() }
    }

    /// Mean over the view's features of the best product with a feature of the crop near the same position; 0 for a view without
    /// features.
    pub(crate) fn similarity(&self, crop: &Recognised) -> f32 {
        let mut sum = 0.0;
        for (cell, feature) in self.cells.iter().zip(self.features.chunks_exact(CHANNELS)) {
            sum += best_of(feature, &crop.features, near(crop.cells, usize::from(*cell), REACH)).1;
        }
        sum / self.cells.len().max(1) as f32
    }
}
