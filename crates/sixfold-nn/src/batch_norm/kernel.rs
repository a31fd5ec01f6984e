//! Batch normalisation on plain `f32` slices (Ioffe and Szegedy 2015), with an added residual and a leaky rectifier in the
//! same pass over memory.
//!
//! Every channel is one task that processes all its pixels while they are in the cache: statistics, then output; in the backward
//! pass sums, then gradient. A channel's sums have a fixed order, so the result does not depend on the number of threads.

use rayon::prelude::*;

use super::NormOptions;

/// Sums are computed in f32 over pieces of this many numbers, and in f64 over the pieces.
const PIECE: usize = 2048;
const LANES: usize = 16;

/// Images, channels and pixels of a tensor `images x channels x rows x columns`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Planes {
    pub(super) images: usize,
    pub(super) channels: usize,
    pub(super) pixels: usize,
}

impl Planes {
    /// Count of the numbers of one channel in the whole batch.
    fn count(&self) -> f64 {
        (self.images * self.pixels) as f64
    }

    /// The planes of one channel, image by image.
    fn of<'a>(&self, values: &'a [f32], channel: usize) -> impl Iterator<Item = &'a [f32]> + use<'a> {
        let Planes { channels, pixels, .. } = *self;
        values.chunks_exact(pixels).skip(channel).step_by(channels)
    }

    /// The planes of every channel, to be written by one task per channel.
    fn by_channel<'a>(&self, values: &'a mut [f32]) -> Vec<Vec<&'a mut [f32]>> {
        let mut channels: Vec<Vec<_>> = (0..self.channels).map(|_| Vec::with_capacity(self.images)).collect();
        for (i, plane) in values.chunks_exact_mut(self.pixels).enumerate() {
            channels[i % self.channels].push(plane);
        }
        channels
    }
}

/// Mean and variance of every channel.
#[derive(Debug, Clone, Default)]
pub(super) struct Statistics {
    pub(super) mean: Vec<f32>,
    pub(super) variance: Vec<f32>,
}

/// A channel's normalisation as `scale * (x - mean) + shift`.
#[derive(Clone, Copy)]
struct Affine {
    mean: f32,
    /// Inverse of the standard deviation.
    inverse: f32,
    scale: f32,
    shift: f32,
}

impl Affine {
    fn new(mean: f32, variance: f32, weight: f32, bias: f32, epsilon: f64) -> Self {
        let inverse = (1.0 / (f64::from(variance) + epsilon).sqrt()) as f32;
        Affine { mean, inverse, scale: weight * inverse, shift: bias }
    }

    fn at(self, x: f32) -> f32 {
        self.scale * (x - self.mean) + self.shift
    }
}

/// Normalises with the statistics of the batch, or with `given` ones, adds the residual (empty for none) and rectifies. Writes to
/// `y` and returns the statistics used.
pub(super) fn forward(
    x: &[f32],
    planes: Planes,
    [weight, bias]: [&[f32]; 2],
    residual: &[f32],
    given: Option<Statistics>,
    options: NormOptions,
    y: &mut [f32],
) -> Statistics {
    let channels = planes.by_channel(y);
    let statistics: Vec<(f32, f32)> = channels
        .into_par_iter()
        .enumerate()
        .map(|(channel, out)| {
            let (mean, variance) = match &given {
                Some(s) => (s.mean[channel], s.variance[channel]),
                None => moments(planes.of(x, channel)),
            };
            let affine = Affine::new(mean, variance, weight[channel], bias[channel], options.epsilon);
            let slope = options.slope;
            if residual.is_empty() {
                for (out, x) in out.into_iter().zip(planes.of(x, channel)) {
                    for (y, x) in out.iter_mut().zip(x) {
                        let z = affine.at(*x);
                        *y = if z > 0.0 { z } else { slope * z };
                    }
                }
            } else {
                let pairs = planes.of(x, channel).zip(planes.of(residual, channel));
                for (out, (x, residual)) in out.into_iter().zip(pairs) {
                    for ((y, x), r) in out.iter_mut().zip(x).zip(residual) {
                        let z = affine.at(*x) + r;
                        *y = if z > 0.0 { z } else { slope * z };
                    }
                }
            }
            (mean, variance)
        })
        .collect();
    let (mean, variance) = statistics.into_iter().unzip();
    Statistics { mean, variance }
}

/// Mean and biased variance of all numbers, combined from pieces by the method of Chan, Golub and LeVeque 1979.
fn moments<'a>(planes: impl Iterator<Item = &'a [f32]>) -> (f32, f32) {
    let (mut count, mut mean, mut squares) = (0.0f64, 0.0f64, 0.0f64);
    for piece in planes.flat_map(|plane| plane.chunks(PIECE)) {
        let n = piece.len() as f64;
        let center = (f64::from(sum(piece)) / n) as f32;
        let [deviation, square] = deviations(piece, center);
        // The sum of deviations corrects the rounding of the piece's mean.
        let piece_mean = f64::from(center) + f64::from(deviation) / n;
        let piece_squares = f64::from(square) - f64::from(deviation) * f64::from(deviation) / n;
        let (total, gap) = (count + n, piece_mean - mean);
        squares += piece_squares + gap * gap * count * n / total;
        mean += gap * n / total;
        count = total;
    }
    (mean as f32, (squares / count).max(0.0) as f32)
}

fn sum(values: &[f32]) -> f32 {
    let (chunks, rest) = values.as_chunks::<LANES>();
    let mut lanes = [0.0f32; LANES];
    for chunk in chunks {
        for (lane, v) in lanes.iter_mut().zip(chunk) {
            *lane += v;
        }
    }
    lanes.iter().chain(rest).sum()
}

/// Sums of `v - center` and of its square.
fn deviations(values: &[f32], center: f32) -> [f32; 2] {
    let (chunks, rest) = values.as_chunks::<LANES>();
    let (mut first, mut second) = ([0.0f32; LANES], [0.0f32; LANES]);
    for chunk in chunks {
        for ((a, b), v) in first.iter_mut().zip(&mut second).zip(chunk) {
            let d = v - center;
            *a += d;
            *b += d * d;
        }
    }
    let mut sums = [first.iter().sum::<f32>(), second.iter().sum::<f32>()];
    for v in rest {
        let d = v - center;
        sums[0] += d;
        sums[1] += d * d;
    }
    sums
}

/// Gradients with respect to weight and bias.
#[derive(Debug, Default)]
pub(super) struct Gradients {
    pub(super) weight: Vec<f32>,
    pub(super) bias: Vec<f32>,
}

/// Inputs and results of the forward pass.
pub(super) struct Forward<'a> {
    pub(super) x: &'a [f32],
    /// The output; used only if there was a residual.
    pub(super) y: &'a [f32],
    pub(super) weight: &'a [f32],
    pub(super) bias: &'a [f32],
    pub(super) statistics: &'a Statistics,
    /// Whether the statistics were given and do not depend on `x`.
    pub(super) given: bool,
}

/// Converts the output's gradient `dy` to the input's, in place. With a residual, the input's gradient is written to `dx` and `dy`
/// becomes the residual's; without one, `dx` is empty.
pub(super) fn backward(
    forward: &Forward<'_>,
    planes: Planes,
    options: NormOptions,
    dy: &mut [f32],
    dx: &mut [f32],
) -> Gradients {
    let residual = !dx.is_empty();
    let outputs: Vec<Vec<&mut [f32]>> =
        if residual { planes.by_channel(dx) } else { (0..planes.channels).map(|_| Vec::new()).collect() };
    let channels = planes.by_channel(dy);
    let gradients: Vec<(f32, f32)> = channels
        .into_par_iter()
        .zip(outputs)
        .enumerate()
        .map(|(channel, (mut dy, dx))| {
            let s = forward.statistics;
            let (weight, bias) = (forward.weight[channel], forward.bias[channel]);
            let affine = Affine::new(s.mean[channel], s.variance[channel], weight, bias, options.epsilon);
            let slope = options.slope;
            let (mut total, mut product) = (0.0f64, 0.0f64);
            for (i, (dy, x)) in dy.iter_mut().zip(planes.of(forward.x, channel)).enumerate() {
                if slope != 1.0 && residual {
                    let y = &forward.y[(i * planes.channels + channel) * planes.pixels..][..planes.pixels];
                    for (d, y) in dy.iter_mut().zip(y) {
                        *d = if *y > 0.0 { *d } else { slope * *d };
                    }
                } else if slope != 1.0 {
                    for (d, x) in dy.iter_mut().zip(x) {
                        *d = if affine.at(*x) > 0.0 { *d } else { slope * *d };
                    }
                }
                for (dy, x) in dy.chunks(PIECE).zip(x.chunks(PIECE)) {
                    let [a, b] = products(dy, x, affine.mean);
                    total += f64::from(a);
                    product += f64::from(b);
                }
            }
            let inverse = f64::from(affine.inverse);
            // Ioffe and Szegedy 2015, section 3; with given statistics only the first term remains.
            let of_x = if forward.given { 0.0 } else { product * inverse * inverse / planes.count() };
            let constant = if forward.given { 0.0 } else { total / planes.count() };
            let (of_x, constant) = (of_x as f32, constant as f32);
            let gradient = |d: f32, x: f32| affine.scale * (d - constant - of_x * (x - affine.mean));
            if residual {
                for ((dx, dy), x) in dx.into_iter().zip(dy).zip(planes.of(forward.x, channel)) {
                    for ((out, d), x) in dx.iter_mut().zip(dy).zip(x) {
                        *out = gradient(*d, *x);
                    }
                }
            } else {
                for (dy, x) in dy.into_iter().zip(planes.of(forward.x, channel)) {
                    for (d, x) in dy.iter_mut().zip(x) {
                        *d = gradient(*d, *x);
                    }
                }
            }
            ((product * inverse) as f32, total as f32)
        })
        .collect();
    let (weight, bias) = gradients.into_iter().unzip();
    Gradients { weight, bias }
}

/// Sums of `d` and of `d * (x - center)`.
fn products(d: &[f32], x: &[f32], center: f32) -> [f32; 2] {
    let ((d_chunks, d_rest), (x_chunks, x_rest)) = (d.as_chunks::<LANES>(), x.as_chunks::<LANES>());
    let (mut first, mut second) = ([0.0f32; LANES], [0.0f32; LANES]);
    for (d, x) in d_chunks.iter().zip(x_chunks) {
        for (((a, b), d), x) in first.iter_mut().zip(&mut second).zip(d).zip(x) {
            *a += d;
            *b += d * (x - center);
        }
    }
    let mut sums = [first.iter().sum::<f32>(), second.iter().sum::<f32>()];
    for (d, x) in d_rest.iter().zip(x_rest) {
        sums[0] += d;
        sums[1] += d * (x - center);
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_of_a_far_off_channel_are_exact() {
        // A naive sum of squares would lose all digits of the variance.
        let values: Vec<f32> = (0..10_000).map(|i| 4096.0 + 0.25 * (i % 5) as f32).collect();
        let (mean, variance) = moments([&values[..3000], &values[3000..]].into_iter());
        assert!((mean - 4096.5).abs() < 1e-3, "{mean}");
        assert!((variance - 0.125).abs() < 1e-5, "{variance}");
    }
}
