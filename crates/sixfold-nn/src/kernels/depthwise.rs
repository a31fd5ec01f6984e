//! Depthwise convolutions (one kernel per channel), computed directly, one row at a time.
//!
//! Each channel is copied into a padded buffer; with a stride of two its even and odd columns are stored separately, so that every
//! inner loop runs over contiguous numbers.

use super::shared::{Shared, activate, before_activation, sum, unwritten, vectorised, written};
use super::{ConvGradients, ConvShape, ConvSpec};
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// The padded channel: `stride` phases of columns, each `rows x columns`.
struct Padded {
    rows: usize,
    columns: usize,
    stride: usize,
}

impl Padded {
    fn new(shape: &ConvShape, spec: &ConvSpec) -> Self {
        let padding = spec.padding[0] + spec.padding[1];
        // Sixteen more columns than needed: the last vector of a row may read past its end.
        let columns = (shape.size[1] + padding).div_ceil(spec.stride) + 16;
        Self { rows: shape.size[0] + padding, columns, stride: spec.stride }
    }

    fn len(&self) -> usize {
        self.rows * self.columns * self.stride
    }

    /// Where kernel column `kx` of padded row `row` begins.
    fn start(&self, row: usize, kx: usize) -> usize {
        ((kx % self.stride) * self.rows + row) * self.columns + kx / self.stride
    }

    /// First image column in a phase of a padded row, and its index in the buffer.
    fn phase(&self, row: usize, phase: usize, spec: &ConvSpec) -> (usize, usize) {
        let first = (phase + self.stride - spec.padding[0] % self.stride) % self.stride;
        (first, self.start(row, phase) + (first + spec.padding[0]) / self.stride)
    }

    fn fill(&self, buffer: &mut [f32], image: &[f32], width: usize, spec: &ConvSpec) {
        for (y, line) in image.chunks_exact(width).enumerate() {
            let row = y + spec.padding[0];
            if self.stride == 1 {
                buffer[self.start(row, 0) + spec.padding[0]..][..width].copy_from_slice(line);
            } else {
                for phase in 0..self.stride {
                    let (first, start) = self.phase(row, phase, spec);
                    let source = line[first.min(width)..].iter().step_by(self.stride);
                    buffer[start..].iter_mut().zip(source).for_each(|(b, v)| *b = *v);
                }
            }
        }
    }

    fn unfill(&self, buffer: &[f32], image: &mut [MaybeUninit<f32>], width: usize, spec: &ConvSpec) {
        for (y, line) in image.chunks_exact_mut(width).enumerate() {
            let row = y + spec.padding[0];
            if self.stride == 1 {
                line.write_copy_of_slice(&buffer[self.start(row, 0) + spec.padding[0]..][..width]);
            } else {
                for phase in 0..self.stride {
                    let (first, start) = self.phase(row, phase, spec);
                    let target = line[first.min(width)..].iter_mut().step_by(self.stride);
                    target.zip(&buffer[start..]).for_each(|(v, b)| {
                        v.write(*b);
                    });
                }
            }
        }
    }
}

vectorised! {
    /// One output row: the sum over the taps of `weight * source[start..]`, in blocks of sixteen columns.
    fn row(out: &mut [MaybeUninit<f32>], source: &[f32], starts: &[usize], weights: &[f32], bias: f32) {
        let width = out.len();
        let mut x = 0;
        while x < width {
            let mut lanes = [bias; 16];
            for (start, weight) in starts.iter().zip(weights) {
                let values = &source[start + x..start + x + 16];
                for (lane, v) in lanes.iter_mut().zip(values) {
                    *lane += weight * v;
                }
            }
            let n = 16.min(width - x);
            out[x..x + n].write_copy_of_slice(&lanes[..n]);
            x += 16;
        }
    }
}

vectorised! {
    /// Weight gradient of one channel: for every tap the sum over the rows of `gradient * source`. `starts` has the taps of each
    /// row, `gradient` has rows of `wide` columns, a multiple of sixteen.
    fn weight_gradient(dweight: &mut [f32], gradient: &[f32], wide: usize, source: &[f32], starts: &[usize]) {
        let area = dweight.len();
        for (tap, d) in dweight.iter_mut().enumerate() {
            let mut lanes = [0.0f32; 16];
            for (line, gradient) in gradient.chunks_exact(wide).enumerate() {
                let source = &source[starts[line * area + tap]..][..wide];
                for (a, b) in gradient.chunks_exact(16).zip(source.chunks_exact(16)) {
                    for ((lane, a), b) in lanes.iter_mut().zip(a).zip(b) {
                        *lane += a * b;
                    }
                }
            }
            *d += lanes.iter().sum::<f32>();
        }
    }
}

vectorised! {
    /// Input gradient of one channel: adds `weight * gradient` at every tap of every row.
    fn input_gradient(out: &mut [f32], gradient: &[f32], wide: usize, weights: &[f32], starts: &[usize]) {
        let area = weights.len();
        for (line, gradient) in gradient.chunks_exact(wide).enumerate() {
            for (weight, start) in weights.iter().zip(&starts[line * area..]) {
                let out = &mut out[*start..][..wide];
                for (o, g) in out.chunks_exact_mut(16).zip(gradient.chunks_exact(16)) {
                    for (o, g) in o.iter_mut().zip(g) {
                        *o += weight * g;
                    }
                }
            }
        }
    }
}

/// Starts of all taps of every output row, in the order of the weights.
fn taps(padded: &Padded, kernel: usize, rows: usize) -> Vec<usize> {
    let mut starts = Vec::with_capacity(rows * kernel * kernel);
    for y in 0..rows {
        for ky in 0..kernel {
            starts.extend((0..kernel).map(|kx| padded.start(y * padded.stride + ky, kx)));
        }
    }
    starts
}

pub(super) fn depthwise_forward(
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
    shape: &ConvShape,
    spec: &ConvSpec,
) -> Vec<f32> {
    let [rows, columns] = shape.output_size(spec);
    let padded = Padded::new(shape, spec);
    let area = shape.kernel * shape.kernel;
    let starts = taps(&padded, shape.kernel, rows);
    let mut y = unwritten(shape.batch * shape.outputs * rows * columns);
    y.par_chunks_mut(rows * columns)
        .zip(x.par_chunks(shape.pixels()))
        .enumerate()
        .with_min_len(8)
        .for_each_init(
            || vec![0.0; padded.len()],
            |buffer, (plane, (out, image))| {
                let channel = plane % shape.outputs;
                padded.fill(buffer, image, shape.size[1], spec);
                for (out, starts) in out.chunks_exact_mut(columns).zip(starts.chunks_exact(area)) {
                    row(out, buffer, starts, &weight[channel * area..][..area], bias[channel]);
                }
                // SAFETY: all of its rows were written just now.
                #[allow(unsafe_code)]
                activate(unsafe { out.assume_init_mut() }, spec.activation);
            },
        );
    // SAFETY: every plane of every image was written.
    #[allow(unsafe_code)]
    unsafe {
        written(y)
    }
}

pub(super) fn depthwise_backward(
    x: &[f32],
    weight: &[f32],
    y: &[f32],
    dy: &[f32],
    shape: &ConvShape,
    spec: &ConvSpec,
    [want_x, want_weight]: [bool; 2],
) -> ConvGradients {
    let [rows, columns] = shape.output_size(spec);
    let padded = Padded::new(shape, spec);
    let area = shape.kernel * shape.kernel;
    let (pixels, out_pixels) = (shape.pixels(), rows * columns);
    let mut dx = unwritten(if want_x { x.len() } else { 0 });
    // With a stride of one the input gradient is a convolution of the gradient with the flipped kernel.
    let use_flipped = spec.stride == 1 && spec.padding.iter().all(|p| *p < shape.kernel);
    let flipped_spec =
        ConvSpec { padding: spec.padding.map(|p| (shape.kernel - 1).saturating_sub(p)), ..*spec };
    let flipped_shape = ConvShape { size: [rows, columns], ..*shape };
    let flipped_padded = Padded::new(&flipped_shape, &flipped_spec);
    let flipped_starts =
        if use_flipped { taps(&flipped_padded, shape.kernel, shape.size[0]) } else { Vec::new() };
    let shared = Shared::new(&mut dx);
    let starts = taps(&padded, shape.kernel, rows);
    // Rows of the gradient, padded with zeros to whole vectors.
    let wide = columns.next_multiple_of(16);
    let gradients: Vec<(Vec<f32>, f32)> = (0..shape.outputs)
        .into_par_iter()
        .with_min_len(4)
        .map_init(
            || {
                (
                    vec![0.0; padded.len()],
                    vec![0.0; padded.len().max(flipped_padded.len())],
                    vec![0.0; rows * wide],
                )
            },
            |(buffer, dbuffer, gradient), channel| {
                let weight = &weight[channel * area..][..area];
                let flipped_weight: Vec<f32> = weight.iter().rev().copied().collect();
                let mut dweight = vec![0.0; area];
                let mut dbias = 0.0;
                for b in 0..shape.batch {
                    let plane = b * shape.outputs + channel;
                    let out = plane * out_pixels..(plane + 1) * out_pixels;
                    for ((g, y), dy) in gradient
                        .chunks_exact_mut(wide)
                        .zip(y[out.clone()].chunks_exact(columns))
                        .zip(dy[out].chunks_exact(columns))
                    {
                        before_activation(&mut g[..columns], y, dy, spec.activation);
                    }
                    if want_weight {
                        dbias += sum(gradient);
                        padded.fill(buffer, &x[plane * pixels..][..pixels], shape.size[1], spec);
                        weight_gradient(&mut dweight, gradient, wide, buffer, &starts);
                    }
                    if want_x {
                        // SAFETY: every channel of every image belongs to one task.
                        #[allow(unsafe_code)]
                        let dx = unsafe { shared.slice(plane * pixels, pixels) };
                        if use_flipped {
                            for (y, g) in gradient.chunks_exact(wide).enumerate() {
                                let start = flipped_padded.start(y + flipped_spec.padding[0], 0)
                                    + flipped_spec.padding[0];
                                dbuffer[start..start + columns].copy_from_slice(&g[..columns]);
                            }
                            let lines =
                                dx.chunks_exact_mut(shape.size[1]).zip(flipped_starts.chunks_exact(area));
                            lines.for_each(|(dx, starts)| row(dx, dbuffer, starts, &flipped_weight, 0.0));
                        } else {
                            dbuffer.fill(0.0);
                            input_gradient(dbuffer, gradient, wide, weight, &starts);
                            padded.unfill(dbuffer, dx, shape.size[1], spec);
                        }
                    }
                }
                (dweight, dbias)
            },
        )
        .collect();
    let (weight, bias): (Vec<Vec<f32>>, Vec<f32>) = gradients.into_iter().unzip();
    // SAFETY: empty, or written channel by channel, each whole.
    #[allow(unsafe_code)]
    let dx = unsafe { written(dx) };
    if want_weight {
        ConvGradients { x: dx, weight: weight.concat(), bias }
    } else {
        ConvGradients { x: dx, ..Default::default() }
    }
}
