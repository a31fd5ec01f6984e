//! Dense convolutions as matrix products: pointwise ones directly on the image, others through patches arranged as columns
//! (im2col), one band of rows at a time, so that the patches stay in the cache.

use super::shared::{Shared, View, activate, before_activation, multiply, sum, unwritten, written, zeroed};
use super::{ConvGradients, ConvShape, ConvSpec};
use rayon::prelude::*;
use std::cell::RefCell;

/// Upper bound of the size of patch matrices, numbers (1 MiB).
const BAND: usize = 1 << 18;

/// Number of groups of images whose weight gradients are summed separately and then together: fixed, so that the sum does not
/// depend on the number of threads.
const GROUPS: usize = 8;

thread_local! {
    static COLUMNS: RefCell<[Vec<f32>; 3]> = const { RefCell::new([Vec::new(), Vec::new(), Vec::new()]) };
}

/// A buffer of at least `length` numbers; its content is undefined.
fn sized(buffer: &mut Vec<f32>, length: usize) -> &mut [f32] {
    if buffer.len() < length {
        buffer.resize(length, 0.0);
    }
    &mut buffer[..length]
}

struct Plan {
    /// Rows and columns of the output.
    out: [usize; 2],
    /// Numbers in a patch.
    patch: usize,
    /// Output rows in a band.
    rows: usize,
    /// A 1x1 convolution with stride 1: the image itself is the patch matrix.
    pointwise: bool,
}

impl Plan {
    fn new(shape: &ConvShape, spec: &ConvSpec) -> Self {
        let out = shape.output_size(spec);
        let patch = shape.inputs * shape.kernel * shape.kernel;
        let pointwise = shape.kernel == 1 && spec.stride == 1 && spec.padding == [0, 0];
        // Products of fewer than 128 columns are slow, independent of the cache.
        let longest = if pointwise { BAND / (shape.inputs + shape.outputs) } else { (BAND / patch).max(128) };
        Self { out, patch, rows: (longest / out[1]).clamp(1, out[0]), pointwise }
    }

    fn pixels(&self) -> usize {
        self.out[0] * self.out[1]
    }

    fn bands(&self) -> usize {
        self.out[0].div_ceil(self.rows)
    }

    /// First row and number of rows of a band.
    fn band(&self, index: usize) -> (usize, usize) {
        let first = index * self.rows;
        (first, self.rows.min(self.out[0] - first))
    }
}

/// Output columns for which column `kx` of the kernel is inside the image: `[first, last)`.
fn inside(kx: usize, width: usize, out: usize, spec: &ConvSpec) -> (usize, usize) {
    let first = spec.padding[0].saturating_sub(kx).div_ceil(spec.stride);
    let last = (width + spec.padding[0]).saturating_sub(kx).div_ceil(spec.stride);
    (first.min(out), last.min(out))
}

/// Arranges the patches of output rows `first..first + rows` of one image as columns: `patch x (rows * out columns)`.
fn columns(
    x: &[f32],
    shape: &ConvShape,
    spec: &ConvSpec,
    plan: &Plan,
    (first, rows): (usize, usize),
    out: &mut [f32],
) {
    let [height, width] = shape.size;
    let n = rows * plan.out[1];
    let k = shape.kernel;
    for (channel, image) in x.chunks_exact(shape.pixels()).enumerate() {
        for ky in 0..k {
            for kx in 0..k {
                let line = &mut out[((channel * k + ky) * k + kx) * n..][..n];
                let (from, to) = inside(kx, width, plan.out[1], spec);
                for (row, target) in line.chunks_exact_mut(plan.out[1]).enumerate() {
                    let y = ((first + row) * spec.stride + ky).wrapping_sub(spec.padding[0]);
                    if y >= height || from >= to {
                        target.fill(0.0);
                        continue;
                    }
                    let source = &image[y * width..][..width];
                    target[..from].fill(0.0);
                    target[to..].fill(0.0);
                    let start = from * spec.stride + kx - spec.padding[0];
                    if spec.stride == 1 {
                        target[from..to].copy_from_slice(&source[start..start + to - from]);
                    } else {
                        for (value, s) in
                            target[from..to].iter_mut().zip(source[start..].iter().step_by(spec.stride))
                        {
                            *value = *s;
                        }
                    }
                }
            }
        }
    }
}

/// The transpose of [`columns`]: adds each number of the patches to its source pixel.
fn add_columns(
    patches: &[f32],
    shape: &ConvShape,
    spec: &ConvSpec,
    plan: &Plan,
    (first, rows): (usize, usize),
    dx: &mut [f32],
) {
    let [height, width] = shape.size;
    let n = rows * plan.out[1];
    let k = shape.kernel;
    for (channel, image) in dx.chunks_exact_mut(shape.size[0] * shape.size[1]).enumerate() {
        for ky in 0..k {
            for kx in 0..k {
                let line = &patches[((channel * k + ky) * k + kx) * n..][..n];
                let (from, to) = inside(kx, width, plan.out[1], spec);
                if from >= to {
                    continue;
                }
                for (row, source) in line.chunks_exact(plan.out[1]).enumerate() {
                    let y = ((first + row) * spec.stride + ky).wrapping_sub(spec.padding[0]);
                    if y >= height {
                        continue;
                    }
                    let start = from * spec.stride + kx - spec.padding[0];
                    let target = &mut image[y * width..][start..width];
                    if spec.stride == 1 {
                        for (t, s) in target.iter_mut().zip(&source[from..to]) {
                            *t += s;
                        }
                    } else {
                        for (t, s) in target.iter_mut().step_by(spec.stride).zip(&source[from..to]) {
                            *t += s;
                        }
                    }
                }
            }
        }
    }
}

pub(super) fn dense_forward(
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
    shape: &ConvShape,
    spec: &ConvSpec,
) -> Vec<f32> {
    let plan = Plan::new(shape, spec);
    let pixels = plan.pixels();
    let mut y = unwritten(shape.batch * shape.outputs * pixels);
    let shared = Shared::new(&mut y);
    let image = shape.inputs * shape.pixels();
    // Several images keep both cores busy; a single one is split into bands (at least four if possible).
    let plan =
        if shape.batch == 1 { Plan { rows: plan.rows.min(plan.out[0].div_ceil(4)), ..plan } } else { plan };
    (0..shape.batch * plan.bands()).into_par_iter().for_each(|task| {
        let (b, band) = (task / plan.bands(), plan.band(task % plan.bands()));
        let (start, n) = (band.0 * plan.out[1], band.1 * plan.out[1]);
        let x = &x[b * image..][..image];
        let begin = b * shape.outputs * pixels + start;
        // SAFETY: every task writes its own image and rows.
        #[allow(unsafe_code)]
        let line = |channel: usize| unsafe { shared.slice(begin + channel * pixels, n) };
        for (channel, bias) in bias.iter().enumerate() {
            line(channel).iter_mut().for_each(|v| {
                v.write(*bias);
            });
        }
        COLUMNS.with_borrow_mut(|[patches, ..]| {
            let left = View { data: weight, strides: [plan.patch, 1] };
            let right = if plan.pointwise {
                View { data: &x[start..], strides: [pixels, 1] }
            } else {
                let patches = sized(patches, plan.patch * n);
                columns(x, shape, spec, &plan, band, patches);
                View { data: patches, strides: [n, 1] }
            };
            // SAFETY: as above.
            #[allow(unsafe_code)]
            unsafe {
                multiply([shape.outputs, n, plan.patch], (shared, begin, pixels), true, left, right)
            };
        });
        for channel in 0..shape.outputs {
            // SAFETY: the biases were written first.
            #[allow(unsafe_code)]
            activate(unsafe { line(channel).assume_init_mut() }, spec.activation);
        }
    });
    // SAFETY: the bands of all images are all of the output.
    #[allow(unsafe_code)]
    unsafe {
        written(y)
    }
}

pub(super) fn dense_backward(
    x: &[f32],
    weight: &[f32],
    y: &[f32],
    dy: &[f32],
    shape: &ConvShape,
    spec: &ConvSpec,
    [want_x, want_weight]: [bool; 2],
) -> ConvGradients {
    let plan = Plan::new(shape, spec);
    let pixels = plan.pixels();
    let image = shape.inputs * shape.pixels();
    let mut dx = match (want_x, plan.pointwise) {
        (false, _) => Vec::new(),
        (true, true) => unwritten(x.len()),
        (true, false) => zeroed(x.len()),
    };
    let shared = Shared::new(&mut dx);
    let group_size = shape.batch.div_ceil(GROUPS).max(1);
    let groups: Vec<(Vec<f32>, Vec<f32>)> = (0..shape.batch.div_ceil(group_size))
        .into_par_iter()
        .map(|group| {
            let mut dweight = vec![0.0; if want_weight { weight.len() } else { 0 }];
            let mut dbias = vec![0.0; if want_weight { shape.outputs } else { 0 }];
            for b in group * group_size..((group + 1) * group_size).min(shape.batch) {
                let x = &x[b * image..][..image];
                for band in (0..plan.bands()).map(|i| plan.band(i)) {
                    let (start, n) = (band.0 * plan.out[1], band.1 * plan.out[1]);
                    COLUMNS.with_borrow_mut(|[patches, gradient, dpatches]| {
                        let gradient = sized(gradient, shape.outputs * n);
                        for (channel, line) in gradient.chunks_exact_mut(n).enumerate() {
                            let range = (b * shape.outputs + channel) * pixels + start..;
                            before_activation(line, &y[range.clone()][..n], &dy[range][..n], spec.activation);
                        }
                        if want_weight {
                            for (bias, line) in dbias.iter_mut().zip(gradient.chunks_exact(n)) {
                                *bias += sum(line);
                            }
                            // The patches, transposed: n x patch.
                            let right = if plan.pointwise {
                                View { data: &x[start..], strides: [1, pixels] }
                            } else {
                                let patches = sized(patches, plan.patch * n);
                                columns(x, shape, spec, &plan, band, patches);
                                View { data: patches, strides: [1, n] }
                            };
                            let left = View { data: gradient, strides: [n, 1] };
                            let out = (Shared::of_numbers(&mut dweight), 0, plan.patch);
                            // SAFETY: these sums belong to this group alone.
                            #[allow(unsafe_code)]
                            unsafe {
                                multiply([shape.outputs, plan.patch, n], out, true, left, right)
                            };
                        }
                        if want_x {
                            let left = View { data: weight, strides: [1, plan.patch] };
                            let right = View { data: gradient, strides: [n, 1] };
                            let size = [plan.patch, n, shape.outputs];
                            // SAFETY: every image belongs to one group, every band to one turn of its loop; what is
                            // added to was zeroed.
                            #[allow(unsafe_code)]
                            if plan.pointwise {
                                unsafe {
                                    multiply(size, (shared, b * image + start, pixels), false, left, right)
                                };
                            } else {
                                let dpatches = sized(dpatches, plan.patch * n);
                                let out = (Shared::of_numbers(dpatches), 0, n);
                                unsafe { multiply(size, out, false, left, right) };
                                let dx = unsafe { shared.slice(b * image, image).assume_init_mut() };
                                add_columns(dpatches, shape, spec, &plan, band, dx);
                            }
                        }
                    });
                }
            }
            (dweight, dbias)
        })
        .collect();
    let mut total = groups.into_iter();
    let (mut dweight, mut dbias) = total.next().unwrap_or_default();
    for (w, b) in total {
        dweight.iter_mut().zip(&w).for_each(|(t, v)| *t += v);
        dbias.iter_mut().zip(&b).for_each(|(t, v)| *t += v);
    }
    // SAFETY: zeroed, or written by the products of all bands of all images.
    #[allow(unsafe_code)]
    let dx = unsafe { written(dx) };
    ConvGradients { x: dx, weight: dweight, bias: dbias }
}
