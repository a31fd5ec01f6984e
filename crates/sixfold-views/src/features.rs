//! Features of crops: one unit vector for every 8x8 pixels.

use std::borrow::Borrow;

use burn::tensor::{Device, Tensor, TensorData};
use sixfold_nn::device;
use sixfold_nn::xfeat::{CELL, CHANNELS};

use crate::error::ViewsError;
use crate::network::{INPUTS, ViewNetwork};
use crate::recognition::Recogniser;

/// Crops per forward pass.
const BATCH: usize = 16;

/// The network, ready to run.
#[derive(Debug)]
pub struct Extractor {
    network: ViewNetwork,
    device: Device,
    recogniser: Recogniser,
}

/// Features of a square crop, row by row, each of length 1.
#[derive(Debug, Clone)]
pub struct FeatureMap {
    /// Cells along each side.
    pub cells: usize,
    /// [`CHANNELS`] numbers per cell.
    pub features: Vec<f32>,
}

impl FeatureMap {
    /// The feature of a cell.
    pub fn feature(&self, cell: usize) -> &[f32] {
        &self.features[cell * CHANNELS..(cell + 1) * CHANNELS]
    }
}

impl Extractor {
    /// The shipped network.
    ///
    /// # Errors
    /// [`ViewsError::Weights`].
    pub fn shipped() -> Result<Extractor, ViewsError> {
        let device = device::chosen();
        Extractor::new(ViewNetwork::shipped(&device)?, device)
    }

    /// Another network, on the device of its tensors.
    ///
    /// # Errors
    /// [`ViewsError::Weights`].
    pub fn new(network: ViewNetwork, device: Device) -> Result<Extractor, ViewsError> {
        Ok(Extractor { network, device, recogniser: Recogniser::shipped()? })
    }

    /// The network by which parts of an image are recognised.
    pub(crate) fn recogniser(&self) -> &Recogniser {
        &self.recogniser
    }

    /// Features of crops of `side` x `side` pixels as returned by `crate::network::input`.
    ///
    /// # Errors
    /// [`ViewsError::Network`] if the network's output cannot be read.
    pub fn features<I: Borrow<[f32]>>(
        &self,
        inputs: &[I],
        side: usize,
    ) -> Result<Vec<FeatureMap>, ViewsError> {
        let cells = side / CELL;
        let count = cells * cells;
        let mut maps = Vec::with_capacity(inputs.len());
        for batch in inputs.chunks(BATCH) {
            let data = TensorData::new(batch.concat(), [batch.len(), INPUTS, side, side]);
            let seen = self.network.forward(Tensor::<4>::from_data(data, &self.device));
            let features =
                seen.try_into_vec_as::<f32>().map_err(|e| ViewsError::Network { reason: e.to_string() })?;
            for planes in features.chunks_exact(CHANNELS * count) {
                maps.push(FeatureMap { cells, features: unit_features(planes, count) });
            }
        }
        Ok(maps)
    }
}

/// The features of `count` cells, each of length 1, from a network's output, channel by channel.
pub(crate) fn unit_features(planes: &[f32], count: usize) -> Vec<f32> {
    let channels = planes.len() / count.max(1);
    let mut out = vec![0.0f32; channels * count];
    for (cell, feature) in out.chunks_exact_mut(channels.max(1)).enumerate() {
        let mut square = 0.0;
        for (c, value) in feature.iter_mut().enumerate() {
            *value = planes[c * count + cell];
            square += *value * *value;
        }
        let length = square.sqrt().max(1e-12);
        feature.iter_mut().for_each(|v| *v /= length);
    }
    out
}
