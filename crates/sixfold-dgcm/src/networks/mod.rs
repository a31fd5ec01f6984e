//! DGCM-Net (dissertation, section 6.2.2, figure 6.3): a geometry encoder, a VD-NOC encoder and a VD-NOC decoder.

mod alignment;
mod compact;
mod paper;

use burn::module::Module;
use burn::tensor::{Device, Tensor};

pub use alignment::Alignment;
pub(crate) use alignment::{NODES, Pairs, interpolated};
pub use compact::Compact;
pub(crate) use compact::CompactConfig;
pub use paper::Paper;
pub(crate) use paper::PaperConfig;

/// Length of features and codes.
pub(crate) const FEATURE: usize = sixfold_experience::FEATURE;

/// Planes of a view: three of normals, three of its own VD-NOC.
pub(crate) const VIEW: usize = 6;

/// Rounds of alignment.
pub(crate) const ROUNDS: usize = 3;

/// An encoder's output for a batch.
#[derive(Debug, Clone)]
pub struct Encoded {
    /// The encoder's input, `batch x channels x side x side`.
    pub input: Tensor<4>,
    /// `batch x 256`, each value from -1 to 1.
    pub feature: Tensor<2>,
    /// Maps at 1/2, 1/4, ... of the resolution, `batch x channels x height x width`.
    pub maps: Vec<Tensor<4>>,
}

impl Encoded {
    /// A part of the batch.
    pub fn narrow(&self, start: usize, count: usize) -> Encoded {
        Encoded {
            input: self.input.clone().narrow(0, start, count),
            feature: self.feature.clone().narrow(0, start, count),
            maps: self.maps.iter().map(|m| m.clone().narrow(0, start, count)).collect(),
        }
    }

    /// A batch of one, repeated.
    pub fn repeat(&self, count: usize) -> Encoded {
        Encoded {
            input: self.input.clone().repeat_dim(0, count),
            feature: self.feature.clone().repeat_dim(0, count),
            maps: self.maps.iter().map(|m| m.clone().repeat_dim(0, count)).collect(),
        }
    }
}

/// The first half of a map's channels: the input of a skip connection.
fn half(map: &Tensor<4>) -> Tensor<4> {
    let channels = map.dims()[1];
    map.clone().narrow(1, 0, channels / 2)
}

/// One of the networks.
#[derive(Module, Debug)]
#[module(custom_display)]
#[allow(clippy::large_enum_variant)]
pub enum Network {
    /// Small enough to train on two processor cores.
    Compact(Compact),
    /// The dissertation's network.
    Paper(Paper),
}

sixfold_nn::displayed_by_name!(Network);

impl Network {
    /// Side of the input in pixels.
    pub fn side(&self) -> usize {
        match self {
            Network::Compact(_) => CompactConfig::SIDE,
            Network::Paper(_) => PaperConfig::SIDE,
        }
    }

    /// Its name in weight files.
    pub fn architecture(&self) -> &'static str {
        match self {
            Network::Compact(_) => "dgcm-compact",
            Network::Paper(_) => "dgcm-paper",
        }
    }

    /// A network of this name with random weights, whose weights are to be loaded from a file.
    pub fn of_architecture(name: &str, device: &Device) -> Option<Network> {
        match name {
            "dgcm-compact" => Some(Network::Compact(CompactConfig.init(0, device))),
            "dgcm-paper" => Some(Network::Paper(PaperConfig.init(0, device))),
            _ => None,
        }
    }

    /// Views to features: normals and the view's own VD-NOC, `batch x 6 x side x side`. The dissertation's network sees the normals
    /// alone.
    pub fn geometry(&self, views: Tensor<4>) -> Encoded {
        match self {
            Network::Compact(n) => n.geometry(views),
            Network::Paper(n) => n.geometry(views.narrow(1, 0, 3)),
        }
    }

    /// VD-NOC (`batch x 3 x side x side`) to codes.
    pub fn vd_noc(&self, vd_noc: Tensor<4>) -> Encoded {
        match self {
            Network::Compact(n) => n.vd_noc(vd_noc),
            Network::Paper(n) => n.vd_noc(vd_noc),
        }
    }

    /// The VD-NOC of the input's pixels in the experience's frame, `batch x 3 x side x side`, from the input's and the
    /// experience's features (`batch x 256`) and the experience's code.
    pub fn decode(&self, input: &Encoded, experience: Tensor<2>, code: &Encoded) -> Tensor<4> {
        match self {
            Network::Compact(n) => n.decode(input, experience, code),
            Network::Paper(n) => n.decode(input, experience, code),
        }
    }

    /// The alignment of both views; the dissertation's network has none.
    pub(crate) fn alignment(&self) -> Option<&Alignment> {
        match self {
            Network::Compact(n) => Some(&n.alignment),
            Network::Paper(_) => None,
        }
    }

    /// The values of the decoder's coordinates after the rounds of alignment, if the network has one.
    pub(crate) fn aligned(&self, decoded: &Tensor<4>, input: &Encoded, code: &Encoded) -> Vec<f32> {
        let mut coordinates = numbers(decoded);
        if let Some(alignment) = self.alignment() {
            let pairs = Pairs::new(&input.input, input.feature.clone(), &code.input);
            for _ in 0..ROUNDS {
                let field = alignment.field(&coordinates, &pairs);
                pairs.shift(&mut coordinates, &field);
            }
        }
        coordinates
    }
}

/// The values of a tensor.
pub(crate) fn numbers<const D: usize>(tensor: &Tensor<D>) -> Vec<f32> {
    let values = tensor.clone().into_data().try_to_vec();
    values.unwrap_or_else(|error| unreachable!("f32 tensor: {error:?}"))
}

/// 1 where a view (`batch x 6 x side x side`) shows the object.
fn shown(view: Tensor<4>) -> Tensor<4> {
    view.narrow(1, 0, 3).square().sum_dim(1).greater_elem(0.0).float()
}

/// Coordinates (`batch x 3 x side x side`) after an affine transformation each, given by its difference from the identity: the rows of
/// its matrix, each followed by the translation (`batch x 12`).
pub(crate) fn moved(coordinates: Tensor<4>, affine: Tensor<2>) -> Tensor<4> {
    let [batch, _, height, width] = coordinates.dims();
    let affine = affine.reshape([batch, 3, 4]);
    let (matrix, translation) = (affine.clone().narrow(2, 0, 3), affine.narrow(2, 3, 1));
    let flat = coordinates.reshape([batch, 3, height * width]);
    (flat.clone() + matrix.matmul(flat) + translation).reshape([batch, 3, height, width])
}

#[cfg(test)]
mod tests {
    use burn::tensor::TensorData;

    use super::*;

    #[test]
    fn an_affine_transformation_moves_every_pixel() {
        let device = Device::flex();
        // Two pixels, (1, 2, 3) and (4, 5, 6).
        let points = vec![1.0f32, 4.0, 2.0, 5.0, 3.0, 6.0];
        let points = Tensor::<4>::from_data(TensorData::new(points, [1, 3, 1, 2]), &device);
        // x + 2 y + 0.5, y, z - x.
        let affine = vec![0.0f32, 2.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0];
        let affine = Tensor::<2>::from_data(TensorData::new(affine, [1, 12]), &device);
        let found: Vec<f32> = moved(points, affine).into_data().try_to_vec().unwrap();
        assert_eq!(found, [5.5, 14.5, 2.0, 5.0, 2.0, 2.0]);
    }

    fn shapes(network: &Network, batch: usize) {
        let device = Device::flex();
        let side = network.side();
        let x = Tensor::<4>::ones([batch, VIEW, side, side], &device) * 0.3;
        let f = network.geometry(x.clone());
        let c = network.vd_noc(x.narrow(1, 0, 3));
        assert_eq!(f.feature.dims(), [batch, FEATURE]);
        assert_eq!(c.feature.dims(), [batch, FEATURE]);
        let out = network.decode(&f.narrow(0, 1).repeat(batch), f.feature.clone(), &c);
        assert_eq!(out.dims(), [batch, 3, side, side]);
        let values: Vec<f32> = f.feature.into_data().try_to_vec().unwrap();
        assert!(values.iter().all(|v| v.abs() <= 1.0));
    }

    #[test]
    fn the_compact_network_is_small() {
        let network = Network::of_architecture("dgcm-compact", &Device::flex()).unwrap();
        assert!(network.num_params() < 5_000_000, "{}", network.num_params());
        shapes(&network, 2);
    }

    #[test]
    fn the_papers_network_has_its_sizes() {
        let network = Network::of_architecture("dgcm-paper", &Device::flex()).unwrap();
        shapes(&network, 1);
        assert!(Network::of_architecture("other", &Device::flex()).is_none());
    }
}
