//! The integrated features X^I of the projected sources (dissertation, figure 4.3): a convolutional LSTM over the sources (Shi et
//! al. 2015), or their mean.

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use rand_chacha::ChaCha8Rng;
use sixfold_nn::kernels::Activation;
use sixfold_nn::layers::{Conv, ConvConfig};
use sixfold_nn::recurrent::lstm_cell;

use super::{CHANNELS, INTEGRATED, IntegratorKind};

/// Sizes of the integrator.
#[derive(Debug, Clone, Copy)]
pub(super) struct IntegratorConfig {
    pub kind: IntegratorKind,
    /// Channels of the LSTM's layers before the last, which has 16.
    pub hidden: &'static [usize],
}

impl IntegratorConfig {
    pub(crate) fn init(&self, rng: &mut ChaCha8Rng, device: &Device) -> Integrator {
        let mut inputs = CHANNELS;
        let layers = self.hidden.iter().copied().chain([INTEGRATED]);
        match self.kind {
            IntegratorKind::Lstm => Integrator {
                layers: layers
                    .map(|channels| {
                        let gates = lstm_gates(inputs, channels, rng, device);
                        inputs = channels;
                        gates
                    })
                    .collect(),
                average: None,
            },
            IntegratorKind::Average => {
                let config = ConvConfig::new([CHANNELS, INTEGRATED], 3, Activation::Relu);
                Integrator { layers: vec![], average: Some(config.init(2.0, rng, device)) }
            }
        }
    }
}

/// The convolution of input and hidden state to the gates. The forget gate is initialised open (Jozefowicz et al. 2015).
fn lstm_gates(inputs: usize, channels: usize, rng: &mut ChaCha8Rng, device: &Device) -> Conv {
    let config = ConvConfig::new([inputs + channels, 4 * channels], 3, Activation::Linear);
    let conv = config.init(1.0, rng, device);
    let weight: Vec<f32> = conv.weight.val().into_data().try_to_vec().unwrap_or_default();
    let bias = (0..4 * channels).map(|i| f32::from(u8::from(i % 4 == 1))).collect();
    config.with_values(weight, bias, device)
}

/// Integrates projected sources; created by [`IntegratorConfig`].
#[derive(Module, Debug)]
#[module(custom_display)]
pub(super) struct Integrator {
    /// Gates of the LSTM's layers.
    layers: Vec<Conv>,
    average: Option<Conv>,
}

sixfold_nn::displayed_by_name!(Integrator);

impl Integrator {
    /// `K B x 17 x height x width` to `B x 16 x height x width`.
    pub(crate) fn forward(&self, looked_up: Tensor<4>, valid: &Tensor<4>, sources: usize) -> Tensor<4> {
        let [all, channels, height, width] = looked_up.dims();
        let batch = all / sources;
        if let Some(average) = &self.average {
            let each = average.forward(looked_up) * valid.clone();
            let sum = each.reshape([sources, batch * INTEGRATED, height, width]).sum_dim(0);
            let count = valid.clone().reshape([sources, batch, height, width]).sum_dim(0).clamp_min(1.0);
            return sum.reshape([batch, INTEGRATED, height, width])
                / count.reshape([batch, 1, height, width]);
        }
        let mut inputs: Vec<Tensor<4>> =
            (0..sources).map(|k| looked_up.clone().narrow(0, k * batch, batch)).collect();
        let mut inside = channels;
        for gates in &self.layers {
            let outputs = gates.bias.val().dims()[0] / 4;
            let zeros = Tensor::zeros([batch, outputs, height, width], &looked_up.device());
            let (mut hidden, mut state) = (zeros.clone(), zeros);
            for input in &mut inputs {
                let x = Tensor::cat(vec![input.clone(), hidden], 1);
                debug_assert_eq!(x.dims()[1], inside + outputs);
                (hidden, state) = lstm_cell(gates.forward(x), state);
                *input = hidden.clone();
            }
            inside = outputs;
        }
        inputs.pop().unwrap_or_else(|| Tensor::zeros([batch, INTEGRATED, height, width], &looked_up.device()))
    }
}
