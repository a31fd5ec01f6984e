//! The loss of the alignment of two views: it starts from the decoder's coordinates, and from the same moved away at random.

use burn::tensor::{Tensor, TensorData};
use rand_chacha::ChaCha8Rng;
use sixfold_geometry::nalgebra::{Unit, UnitQuaternion};
use sixfold_geometry::random::stream;
use sixfold_geometry::{Mat3, Vec3};
use sixfold_nn::layers::normal;

use crate::networks::{Alignment, NODES, Pairs, ROUNDS, interpolated, moved, numbers};

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
    /// The first views, `pairs x 6 x side x side`, and their features.
    pub views: Tensor<4>,
    pub feature: Tensor<2>,
    /// The second views' VD-NOC, `pairs x 3 x side x side`.
    pub vd_noc: Tensor<4>,
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

/// The loss for a batch (`target`: `pairs x 3 x side x side`, `mask`: `pairs x 1 x side x side`), where `seed` and `step` choose the
/// starts. No gradients reach the decoder and the encoders.
pub(crate) fn alignment_loss(
    alignment: &Alignment,
    decoded: Decoded,
    target: &Tensor<4>,
    mask: &Tensor<4>,
    (seed, step): (u64, u64),
) -> AlignmentLoss {
    let [pairs, _, height, width] = target.dims();
    let (batch, device) = (pairs * STARTS, target.device());
    let random = &mut stream(seed ^ SEED, step);
    let affine: Vec<f32> = (0..pairs).flat_map(|_| away(random)).collect();
    let affine = Tensor::<2>::from_data(TensorData::new(affine, [pairs, 12]), &device);
    let second = moved(decoded.coordinates.clone(), affine) * mask.clone();
    let mut coordinates = numbers(&Tensor::cat(vec![decoded.coordinates, second], 0));
    let both = |images: Tensor<4>| images.repeat_dim(0, STARTS);
    let of_starts =
        Pairs::new(&both(decoded.views), decoded.feature.repeat_dim(0, STARTS), &both(decoded.vd_noc));
    let target = numbers(&both(target.clone()));
    let error = |off: &Tensor<3>| off.clone().abs().narrow(0, 0, pairs).mean();
    let mut sum = Tensor::<1>::zeros([1], &device);
    let (mut before, mut after) = (None, sum.clone());
    for _ in 0..ROUNDS {
        let field = alignment.field(&coordinates, &of_starts);
        let samples = Samples::of(&coordinates, &of_starts.objects, &target, height * width);
        let tensor =
            |values, rows| Tensor::<3>::from_data(TensorData::new(values, [batch, rows, SAMPLES]), &device);
        let (weights, missing) = (tensor(samples.weights, NODES * NODES), tensor(samples.missing, 3));
        before.get_or_insert_with(|| error(&missing));
        let off = field.clone().reshape([batch, 3, NODES * NODES]).matmul(weights) - missing;
        after = error(&off);
        sum = sum + off.abs().mean();
        of_starts.shift(&mut coordinates, &field);
    }
    AlignmentLoss { sum, before: before.unwrap_or_else(|| after.clone()), after }
}

/// Pixels of the object, the same number for every pair, at which the loss compares shifts.
struct Samples {
    /// Weights of the field's nodes at each: `batch x nodes x samples`.
    weights: Vec<f32>,
    /// Shifts from the coordinates to the target: `batch x 3 x samples`.
    missing: Vec<f32>,
}

impl Samples {
    fn of(coordinates: &[f32], objects: &[Vec<usize>], target: &[f32], pixels: usize) -> Samples {
        let images = coordinates.chunks_exact(3 * pixels).zip(target.chunks_exact(3 * pixels));
        let (mut weights, mut missing) = (vec![], vec![]);
        for ((coordinates, target), object) in images.zip(objects) {
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

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;
    use crate::networks::{FEATURE, VIEW};

    #[test]
    fn every_round_goes_on_where_the_one_before_ended() {
        let (device, side, shift) = (Device::flex(), 32, [0.05f32, -0.03, 0.02]);
        let pixels = side * side;
        let planes =
            |values: Vec<f32>| Tensor::<4>::from_data(TensorData::new(values, [1, 3, side, side]), &device);
        let start: Vec<f32> = (0..3 * pixels)
            .map(|i| {
                let [x, y] = [i % side, i / side % side].map(|c| c as f32 / side as f32 - 0.5);
                [x, y, x * y][i / pixels]
            })
            .collect();
        // After each round the same shift is missing once less; after the last nothing.
        let target = (0..3 * pixels).map(|i| start[i] + ROUNDS as f32 * shift[i / pixels]).collect();
        let decoded = Decoded {
            coordinates: planes(start.clone()),
            views: Tensor::ones([1, VIEW, side, side], &device),
            feature: Tensor::zeros([1, FEATURE], &device),
            vd_noc: planes(start),
        };
        let mask = Tensor::ones([1, 1, side, side], &device);
        let alignment = Alignment::constant(shift, &device);
        let loss = alignment_loss(&alignment, decoded, &planes(target), &mask, (0, 0));
        let [before, after] = [loss.before, loss.after].map(|error| numbers(&error)[0]);
        let mean = shift.iter().map(|s| s.abs()).sum::<f32>() / 3.0;
        assert!((before - ROUNDS as f32 * mean).abs() < 1e-4, "{before}");
        assert!(after < 0.01 * mean, "{after}");
    }
}
