//! The loss of the alignment of two views: it starts from the decoder's coordinates, and from the same moved away at random.

use burn::tensor::{Tensor, TensorData};
use rand_chacha::ChaCha8Rng;
use sixfold_geometry::nalgebra::{Unit, UnitQuaternion};
use sixfold_geometry::random::stream;
use sixfold_geometry::{Mat3, Vec3};
use sixfold_nn::layers::normal;

use crate::networks::{
    Encoded, NODES, Network, ROUNDS, VIEW, interpolated, moved, numbers, on_object, shifted,
};

/// The second start: the decoder's coordinates rotated by an angle of this standard deviation, radians, ...
const ANGLE: f64 = 0.25;
/// ... with axes scaled and shifted by numbers of these standard deviations.
const SCALE: f64 = 0.08;
const SHIFT: f64 = 0.08;
/// Both starts.
const STARTS: usize = 2;
/// Pixels of a pair at which shifts are compared.
const SAMPLES: usize = 256;
/// Keeps the random numbers apart from those of the pairs.
const SEED: u64 = 0x0a11_9ed0;

/// What the decoder found for a batch of positive pairs, without gradients.
pub(crate) struct Decoded {
    /// The decoder's coordinates.
    pub coordinates: Tensor<4>,
    /// The first view.
    pub input: Encoded,
    /// The second one.
    pub code: Encoded,
}

/// How far coordinates are off.
pub(crate) struct AlignmentLoss {
    /// The sum of what the fields of all rounds leave, from both starts.
    pub sum: Tensor<1>,
    /// The mean error of the decoder's coordinates.
    pub before: Tensor<1>,
    /// What the field of the last round leaves of it.
    pub after: Tensor<1>,
}

/// The loss for a batch (`target`: `pairs x 3 x side x side`, `mask`: `pairs x 1 x side x side`), where `step` and `seed` choose the
/// starts; `None` for a network without alignment. No gradients reach the decoder and the encoders.
pub(crate) fn alignment_loss(
    network: &Network,
    decoded: Decoded,
    target: &Tensor<4>,
    mask: &Tensor<4>,
    (seed, step): (u64, u64),
) -> Option<AlignmentLoss> {
    let [pairs, _, height, width] = target.dims();
    let device = target.device();
    let random = &mut stream(seed ^ SEED, step);
    let first = decoded.coordinates;
    let affine: Vec<f32> = (0..pairs).flat_map(|_| away(random)).collect();
    let affine = Tensor::<2>::from_data(TensorData::new(affine, [pairs, 12]), &device);
    let second = moved(first.clone(), affine) * mask.clone();
    let mut coordinates = Tensor::cat(vec![first, second], 0);
    let (input, code) = (decoded.input.repeat(STARTS), decoded.code.repeat(STARTS));
    let target = numbers(&target.clone().repeat_dim(0, STARTS));
    let mut sum = Tensor::<1>::zeros([1], &device);
    let (mut before, mut after) = (None, None);
    for _ in 0..ROUNDS {
        let field = network.field(&coordinates, &input, &code)?;
        let samples = Samples::of(&numbers(&coordinates), &numbers(&input.input), &target, height * width);
        let batch = pairs * STARTS;
        let weights = Tensor::<3>::from_data(
            TensorData::new(samples.weights, [batch, NODES * NODES, SAMPLES]),
            &device,
        );
        let missing = Tensor::<3>::from_data(TensorData::new(samples.missing, [batch, 3, SAMPLES]), &device);
        let error = |off: Tensor<3>| off.abs().narrow(0, 0, pairs).mean();
        before = before.or_else(|| Some(error(missing.clone())));
        let off = field.clone().reshape([batch, 3, NODES * NODES]).matmul(weights) - missing;
        after = Some(error(off.clone()));
        sum = sum + off.abs().mean();
        coordinates = shifted(&coordinates, &field, &input.input);
    }
    Some(AlignmentLoss { sum, before: before?, after: after? })
}

/// Pixels of the object, the same number for every pair, at which the loss compares shifts.
struct Samples {
    /// Weights of the field's nodes at each: `batch x nodes x samples`.
    weights: Vec<f32>,
    /// Shifts from the coordinates to the target: `batch x 3 x samples`.
    missing: Vec<f32>,
}

impl Samples {
    fn of(coordinates: &[f32], views: &[f32], target: &[f32], pixels: usize) -> Samples {
        let images = coordinates.chunks_exact(3 * pixels).zip(target.chunks_exact(3 * pixels));
        let (mut weights, mut missing) = (vec![], vec![]);
        for ((coordinates, target), view) in images.zip(views.chunks_exact(VIEW * pixels)) {
            let object: Vec<usize> = (0..pixels).filter(|&i| on_object(view, pixels, i)).collect();
            let at = |sample: usize| object.get(sample * object.len() / SAMPLES).copied();
            let mut of_pair = vec![0.0f32; NODES * NODES * SAMPLES];
            for (sample, i) in (0..SAMPLES).filter_map(|sample| Some((sample, at(sample)?))) {
                for (node, weight) in interpolated(coordinates[i], coordinates[pixels + i]) {
                    of_pair[node * SAMPLES + sample] += weight;
                }
            }
            weights.extend(of_pair);
            missing.extend((0..3).flat_map(|k| {
                (0..SAMPLES).map(move |sample| {
                    at(sample).map_or(0.0, |i| target[k * pixels + i] - coordinates[k * pixels + i])
                })
            }));
        }
        Samples { weights, missing }
    }
}

/// The difference from the identity of a random affine transformation.
fn away(random: &mut ChaCha8Rng) -> [f32; 12] {
    let mut deviation = |of: f64| of * f64::from(normal(random));
    let axis = Vec3::from_fn(|_, _| deviation(1.0));
    let axis = Unit::try_new(axis, 1e-9).unwrap_or_else(Vec3::z_axis);
    let turn = UnitQuaternion::from_axis_angle(&axis, deviation(ANGLE)).to_rotation_matrix();
    let scale = Vec3::from_fn(|_, _| 1.0 + deviation(SCALE));
    let shift = Vec3::from_fn(|_, _| deviation(SHIFT));
    let difference = turn.matrix() * Mat3::from_diagonal(&scale) - Mat3::identity();
    std::array::from_fn(|i| match i % 4 {
        3 => shift[i / 4] as f32,
        column => difference[(i / 4, column)] as f32,
    })
}
