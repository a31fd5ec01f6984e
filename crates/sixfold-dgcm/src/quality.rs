//! How well a network predicts coordinates of objects that it was not trained on: the error of equation 6.3 on the object
//! (dissertation, section 6.2.2).

use std::collections::BTreeMap;

use burn::tensor::{Tensor, TensorData};
use serde::{Deserialize, Serialize};

use crate::networks::{Network, VIEW, numbers};
use crate::samples::{PairOptions, Pool};
use sixfold_nn::device;

/// Pairs per forward pass.
const AT_A_TIME: usize = 16;

/// Accuracy of a network on positive pairs of views. Errors are mean absolute differences of one coordinate on the object; all
/// coordinates of a view range from -1 to 1.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// Number of pairs.
    pub pairs: usize,
    /// Error of the prediction (equation 6.3).
    pub coordinates: f64,
    /// Error of the decoder, before the alignment of both views.
    pub decoded: f64,
    /// Error if the view's own coordinates are taken as they are.
    pub own: f64,
    /// Error of the prediction for each family.
    pub families: BTreeMap<String, f64>,
}

impl Quality {
    /// Names and values, for display.
    pub fn scores(&self) -> [(&'static str, f64); 3] {
        [
            ("mean error of a coordinate (range -1 to 1)", self.coordinates),
            ("the same before the alignment", self.decoded),
            ("the same if the view's own coordinates are taken", self.own),
        ]
    }
}

/// Measures a network on `pairs` positive pairs of a pool.
pub fn quality(network: &Network, pool: &Pool, pairs: usize) -> Quality {
    let (device, side) = (device::chosen(), network.side());
    let pixels = side * side;
    let options = PairOptions::default();
    let mut errors: BTreeMap<String, (f64, usize)> = BTreeMap::new();
    let (mut own, mut before) = (0.0, 0.0);
    for start in (0..pairs).step_by(AT_A_TIME) {
        let batch: Vec<_> = (start..(start + AT_A_TIME).min(pairs))
            .map(|number| pool.pair(true, &options, 0x9a, number as u64))
            .collect();
        let planes = |values: Vec<f32>, channels: usize| {
            let shape = [batch.len(), channels, side, side];
            Tensor::<4>::from_data(TensorData::new(values, shape), &device)
        };
        let input = network.geometry(planes(batch.iter().flat_map(|p| p.input.clone()).collect(), VIEW));
        let experience =
            network.geometry(planes(batch.iter().flat_map(|p| p.experience.clone()).collect(), VIEW));
        let code = network.vd_noc(planes(batch.iter().flat_map(|p| p.vd_noc.clone()).collect(), 3));
        let decoded = network.decode(&input, experience.feature, &code);
        let found = network.aligned(&decoded, &input, &code);
        let decoded = numbers(&decoded);
        let results = found.chunks_exact(3 * pixels).zip(decoded.chunks_exact(3 * pixels));
        for (pair, (found, decoded)) in batch.iter().zip(results) {
            let error = |of: &[f32]| {
                let on_object = (0..3 * pixels).filter(|i| pair.mask[i % pixels] > 0.0);
                let (sum, count) = on_object.fold((0.0, 0usize), |(sum, count), i| {
                    (sum + f64::from((of[i] - pair.target[i]).abs()), count + 1)
                });
                sum / count.max(1) as f64
            };
            let family = errors.entry(pair.families.0.name().to_owned()).or_default();
            *family = (family.0 + error(found), family.1 + 1);
            own += error(&pair.input[3 * pixels..]);
            before += error(decoded);
        }
    }
    let sum: f64 = errors.values().map(|e| e.0).sum();
    Quality {
        pairs,
        coordinates: sum / pairs.max(1) as f64,
        decoded: before / pairs.max(1) as f64,
        own: own / pairs.max(1) as f64,
        families: errors.into_iter().map(|(family, (sum, count))| (family, sum / count as f64)).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::networks::CompactConfig;
    use crate::samples::GraspPoolOptions;
    use burn::tensor::Device;

    #[test]
    fn a_network_that_keeps_the_views_own_coordinates_is_as_good_as_these() {
        let pool = Pool::new(&GraspPoolOptions { views: 64, ..GraspPoolOptions::default() }, &()).unwrap();
        // With random weights the transformation is near the identity, and the difference from it is small.
        let network = Network::Compact(CompactConfig.init(1, &Device::flex()));
        let quality = quality(&network, &pool, 20);
        assert!((quality.decoded - quality.own).abs() < 0.3 * quality.own, "{quality:?}");
        let of_families: f64 = quality.families.values().sum::<f64>() / quality.families.len() as f64;
        assert!(quality.own > 0.05 && (of_families - quality.coordinates).abs() < 0.15, "{quality:?}");
        assert!(quality.coordinates != quality.decoded, "the alignment is measured: {quality:?}");
        assert_eq!(quality.pairs, 20);
    }
}
