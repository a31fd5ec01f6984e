//! The network of template matching (dissertation, section 5.2.2, figure 5.2): feature maps of regions, a descriptor for each, and
//! for each pair of a region and a template a mask, a rotation, and more.
//!
//! Beyond the dissertation: the input has depth and a plane of measured pixels next to the normals. For a pair the network also
//! predicts the position of the template's reference point (the dissertation uses the visible centroid, its main failure according
//! to section 5.3.3) and the probability that both show the same object in about the same pose.

mod compact;
mod paper;

use burn::module::Module;
use burn::tensor::{Device, Tensor};

pub use compact::{Compact, CompactConfig};
pub use paper::{Paper, PaperConfig};

/// Length of a descriptor.
pub(crate) const DESCRIPTOR: usize = 128;
/// Side of a region's map (dissertation: 14).
pub const MAP: usize = 14;

/// Predictions of the network for pairs.
#[derive(Debug, Clone)]
pub struct Compared {
    /// Logit that each cell of the region belongs to the object: `batch x 1 x 14 x 14`.
    pub mask: Tensor<4>,
    /// The object's rotation in the region from that in the template, a quaternion w, x, y, z that is not yet normalised:
    /// `batch x 4`.
    pub rotation: Tensor<2>,
    /// Position of the template's reference point relative to the region's centre, as a fraction of the patch: `batch x 3`.
    pub offset: Tensor<2>,
    /// Logit that the pair is a match: `batch x 1`.
    pub matching: Tensor<2>,
}

/// One of the networks.
#[derive(Module, Debug)]
#[module(custom_display)]
#[allow(clippy::large_enum_variant)]
pub enum Network {
    /// Small enough to train on two processor cores.
    Compact(Compact),
    /// The dissertation's sizes.
    Paper(Paper),
}

sixfold_nn::displayed_by_name!(Network);

impl Network {
    /// Side of the input patches, pixels.
    pub fn side(&self) -> usize {
        match self {
            Network::Compact(_) => CompactConfig::SIDE,
            Network::Paper(_) => PaperConfig::SIDE,
        }
    }

    /// Its name in weight files.
    pub fn architecture(&self) -> &'static str {
        match self {
            Network::Compact(_) => "mttm-compact",
            Network::Paper(_) => "mttm-paper",
        }
    }

    /// A network of this name with random weights, whose weights are to be loaded from a file.
    pub fn of_architecture(name: &str, device: &Device) -> Option<Network> {
        match name {
            "mttm-compact" => Some(Network::Compact(CompactConfig.init(0, device))),
            "mttm-paper" => Some(Network::Paper(PaperConfig.init(0, device))),
            _ => None,
        }
    }

    /// Patches (`batch x 5 x side x side`, see [`crate::patch`]) to maps (`batch x channels x 14 x 14`).
    pub fn maps(&self, patches: Tensor<4>) -> Tensor<4> {
        match self {
            Network::Compact(n) => n.maps(patches),
            Network::Paper(n) => n.maps(patches),
        }
    }

    /// Maps to descriptors, `batch x 128`.
    pub(crate) fn descriptor(&self, maps: Tensor<4>) -> Tensor<2> {
        match self {
            Network::Compact(n) => n.descriptor(maps),
            Network::Paper(n) => n.descriptor(maps),
        }
    }

    /// Predictions for pairs of maps: of regions, and of templates with zeros outside the object.
    pub fn compare(&self, regions: Tensor<4>, templates: Tensor<4>) -> Compared {
        let (mask, numbers) = match self {
            Network::Compact(n) => n.compare(regions, templates),
            Network::Paper(n) => n.compare(regions, templates),
        };
        Compared {
            mask,
            rotation: numbers.clone().narrow(1, 0, 4).tanh(),
            offset: numbers.clone().narrow(1, 4, 3),
            matching: numbers.narrow(1, 7, 1),
        }
    }
}

/// Maps with zeros outside the object; `mask` is `batch x 1 x 14 x 14` from 0 to 1.
pub fn masked(maps: Tensor<4>, mask: Tensor<4>) -> Tensor<4> {
    maps * mask
}

/// `batch x channels x height x width` to `batch x numbers`.
fn flat(x: Tensor<4>) -> Tensor<2> {
    let [batch, channels, height, width] = x.dims();
    x.reshape([batch, channels * height * width])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::patch::PLANES;

    fn shapes(network: &Network) {
        let device = Device::flex();
        let side = network.side();
        let x = Tensor::<4>::ones([2, PLANES, side, side], &device) * 0.3;
        let maps = network.maps(x);
        let [batch, _, height, width] = maps.dims();
        assert_eq!([batch, height, width], [2, MAP, MAP]);
        assert_eq!(network.descriptor(maps.clone()).dims(), [2, DESCRIPTOR]);
        let pair = network.compare(maps.clone(), maps);
        assert_eq!(pair.mask.dims(), [2, 1, MAP, MAP]);
        let sizes = [pair.rotation.dims(), pair.offset.dims(), pair.matching.dims()];
        assert_eq!(sizes, [[2, 4], [2, 3], [2, 1]]);
    }

    #[test]
    fn the_compact_network_is_small() {
        let network = Network::of_architecture("mttm-compact", &Device::flex()).unwrap();
        assert!(network.num_params() < 1_500_000, "{}", network.num_params());
        shapes(&network);
    }

    #[test]
    fn the_papers_network_has_its_sizes() {
        shapes(&Network::of_architecture("mttm-paper", &Device::flex()).unwrap());
        assert!(Network::of_architecture("other", &Device::flex()).is_none());
    }
}
