//! Dense convolutions over more than one pixel, computed directly (Georganas et al. 2018): every tap of the kernel reads the padded
//! image at another offset, so that no patches have to be arranged. For processors with fused multiplication and addition in vectors; the sum of
//! every output has the same order on all of them.

use super::shared::{Shared, activate, unwritten, written};
use super::{ConvShape, ConvSpec};
use rayon::prelude::*;
use std::cell::RefCell;

/// Outputs whose weights are stored together.
const TOGETHER: usize = 4;
/// Widest tile, pixels: three vectors of AVX-512.
const TILE: usize = 48;
/// Upper bound of a padded band's size, numbers (256 KiB).
const BAND: usize = 1 << 16;
/// Fewest output columns: pixels between rows are computed too, and not used. With 5 and 7 columns patches are faster on two threads, with 10
/// they are slower.
const MIN_COLUMNS: usize = 8;
/// Most taps of an output, over all channels: of more the weights do not stay in the cache. On one thread the direct way is 2.3 times as fast as
/// patches with 1008 taps, 1.2 times with 2304, 0.7 times with 4608.
const MAX_TAPS: usize = 2304;

thread_local! {
    static PADDED: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// The vectors of a processor.
#[derive(Clone, Copy)]
enum Vectors {
    Avx512,
    Avx2,
}

impl Vectors {
    /// Those of this processor; `None` if it has none with fused multiplication and addition.
    fn of_processor() -> Option<Vectors> {
        use std::arch::is_x86_feature_detected as has;
        if has!("avx512f") {
            return Some(Vectors::Avx512);
        }
        (has!("avx2") && has!("fma")).then_some(Vectors::Avx2)
    }
}

/// A padded band of one image: for each channel and each phase (a row and a column modulo the stride) a plane. An output pixel
/// is at the same place of each plane as its first tap.
struct Padded {
    /// Rows and columns of the output, rows of a band.
    out: [usize; 2],
    band: usize,
    /// Columns of a plane.
    columns: usize,
}

impl Padded {
    fn new(shape: &ConvShape, spec: &ConvSpec) -> Self {
        let out = shape.output_size(spec);
        let more = (shape.kernel - 1) / spec.stride;
        let columns = out[1] + more;
        let row = shape.inputs * spec.stride * spec.stride * columns;
        let mut band = (BAND / row).saturating_sub(more).clamp(1, out[0]);
        // Several images keep all cores busy; a single one is split into bands.
        if shape.batch == 1 {
            band = band.min(out[0].div_ceil(4));
        }
        // Bands of about the same size.
        let band = out[0].div_ceil(out[0].div_ceil(band));
        Self { out, band, columns }
    }

    fn bands(&self) -> usize {
        self.out[0].div_ceil(self.band)
    }

    /// First row and number of rows of a band.
    fn rows(&self, index: usize) -> (usize, usize) {
        let first = index * self.band;
        (first, self.band.min(self.out[0] - first))
    }

    /// Numbers in a plane of a band.
    fn plane(&self, rows: usize, shape: &ConvShape, spec: &ConvSpec) -> usize {
        (rows + (shape.kernel - 1) / spec.stride) * self.columns
    }

    /// Where each tap of the first output pixel is, in the order of the weights.
    fn taps(&self, plane: usize, shape: &ConvShape, spec: &ConvSpec) -> Vec<usize> {
        let (k, s) = (shape.kernel, spec.stride);
        let mut taps = Vec::with_capacity(shape.inputs * k * k);
        for channel in 0..shape.inputs {
            for ky in 0..k {
                for kx in 0..k {
                    let phase = (channel * s + ky % s) * s + kx % s;
                    taps.push(phase * plane + ky / s * self.columns + kx / s);
                }
            }
        }
        taps
    }

    /// Copies the rows that the output rows `first..` need.
    fn fill(
        &self,
        out: &mut [f32],
        x: &[f32],
        first: usize,
        plane: usize,
        shape: &ConvShape,
        spec: &ConvSpec,
    ) {
        let [height, width] = shape.size;
        let (s, before) = (spec.stride, spec.padding[0]);
        let planes = out.chunks_exact_mut(plane).take(shape.inputs * s * s);
        for (number, target) in planes.enumerate() {
            let (channel, phase) = (number / (s * s), [number / s % s, number % s]);
            let image = &x[channel * height * width..][..height * width];
            // Column of the image in column 0 of the plane, and the first column of the plane inside the image.
            let inside = before.saturating_sub(phase[1]).div_ceil(s);
            for (row, target) in target.chunks_exact_mut(self.columns).enumerate() {
                let y = ((first + row) * s + phase[0]).wrapping_sub(before);
                if y >= height {
                    target.fill(0.0);
                    continue;
                }
                let start = (inside * s + phase[1] - before).min(width);
                let source = &image[y * width..][start..width];
                let inside = inside.min(target.len());
                let (zeros, target) = target.split_at_mut(inside);
                zeros.fill(0.0);
                let count = source.len().div_ceil(s).min(target.len());
                let (target, zeros) = target.split_at_mut(count);
                zeros.fill(0.0);
                if s == 1 {
                    target.copy_from_slice(&source[..count]);
                } else {
                    target.iter_mut().zip(source.iter().step_by(s)).for_each(|(t, v)| *t = *v);
                }
            }
        }
    }
}

/// Weights in blocks of [`TOGETHER`] outputs, tap by tap; missing outputs have zeros.
fn packed(weight: &[f32], outputs: usize) -> Vec<f32> {
    let patch = weight.len() / outputs;
    let mut out = vec![0.0; outputs.div_ceil(TOGETHER) * TOGETHER * patch];
    for (block, lines) in out.chunks_exact_mut(TOGETHER * patch).zip(weight.chunks(TOGETHER * patch)) {
        for (lane, line) in lines.chunks_exact(patch).enumerate() {
            block.iter_mut().skip(lane).step_by(TOGETHER).zip(line).for_each(|(b, w)| *b = *w);
        }
    }
    out
}

/// A tile of the output: `B` blocks of outputs, and pixels.
type Tile<const B: usize> = [[[f32; TILE]; TOGETHER]; B];

macro_rules! kernel {
    ($name:ident, $features:literal, $width:literal, $zero:ident, $load:ident, $set:ident, $fma:ident, $store:ident) => {
        /// Adds to each output of a tile, of `V` vectors of pixels, the products of its weights and the source at each tap.
        #[target_feature(enable = $features)]
        fn $name<const B: usize, const V: usize>(
            weights: [&[f32]; B],
            taps: &[usize],
            source: &[f32],
            tile: &mut Tile<B>,
        ) {
            use std::arch::x86_64::*;
            const { assert!(V * $width <= TILE) };
            let weights = weights.map(|w| &w.as_chunks::<TOGETHER>().0[..taps.len()]);
            let mut sums = [[[$zero(); V]; TOGETHER]; B];
            for (k, tap) in taps.iter().enumerate() {
                let line = &source[*tap..][..V * $width];
                let mut values = [$zero(); V];
                for (v, value) in values.iter_mut().enumerate() {
                    // SAFETY: within the line.
                    #[allow(unsafe_code)]
                    {
                        *value = unsafe { $load(line.as_ptr().add(v * $width)) };
                    }
                }
                for block in 0..B {
                    let weights = &weights[block][k];
                    for lane in 0..TOGETHER {
                        let weight = $set(weights[lane]);
                        for v in 0..V {
                            sums[block][lane][v] = $fma(weight, values[v], sums[block][lane][v]);
                        }
                    }
                }
            }
            // By number: behind iterators the sums would be kept in memory.
            for block in 0..B {
                for lane in 0..TOGETHER {
                    for v in 0..V {
                        let target = &mut tile[block][lane][v * $width..(v + 1) * $width];
                        // SAFETY: the target has this width.
                        #[allow(unsafe_code)]
                        unsafe {
                            $store(target.as_mut_ptr(), sums[block][lane][v])
                        };
                    }
                }
            }
        }
    };
}

kernel!(
    avx512,
    "avx512f",
    16,
    _mm512_setzero_ps,
    _mm512_loadu_ps,
    _mm512_set1_ps,
    _mm512_fmadd_ps,
    _mm512_storeu_ps
);
kernel!(
    avx2,
    "avx2,fma",
    8,
    _mm256_setzero_ps,
    _mm256_loadu_ps,
    _mm256_set1_ps,
    _mm256_fmadd_ps,
    _mm256_storeu_ps
);

/// The sums of products for up to `pixels` pixels of `B` blocks of outputs; returns how many pixels it computed.
fn products<const B: usize>(
    vectors: Vectors,
    weights: [&[f32]; B],
    taps: &[usize],
    source: &[f32],
    pixels: usize,
    tile: &mut Tile<B>,
) -> usize {
    // SAFETY: the processor has these vectors.
    #[allow(unsafe_code)]
    unsafe {
        match (vectors, pixels) {
            (Vectors::Avx512, 33..) => avx512::<B, 3>(weights, taps, source, tile),
            (Vectors::Avx512, 17..) => avx512::<B, 2>(weights, taps, source, tile),
            (Vectors::Avx512, _) => avx512::<B, 1>(weights, taps, source, tile),
            (Vectors::Avx2, _) => {
                for (weights, tile) in weights.into_iter().zip(tile.iter_mut()) {
                    avx2::<1, 3>([weights], taps, source, std::array::from_mut(tile));
                }
                return pixels.min(24);
            }
        }
    }
    pixels.min(TILE)
}

/// Where the results of a band go.
struct Band<'a> {
    shared: Shared<'a>,
    /// Beginning of the first output's rows, and numbers per output.
    begin: usize,
    pixels: usize,
    columns: usize,
    /// Columns of a plane.
    wide: usize,
}

impl Band<'_> {
    /// Writes the pixels `from..from + count` of a plane for one output, with its bias, but for those between rows.
    fn write(&self, output: usize, from: usize, line: &[f32], bias: f32) {
        let mut at = from;
        let end = from + line.len();
        while at < end {
            let (row, column) = (at / self.wide, at % self.wide);
            let next = ((row + 1) * self.wide).min(end);
            if column < self.columns {
                let count = (next - at).min(self.columns - column);
                let start = self.begin + output * self.pixels + row * self.columns + column;
                // SAFETY: every task writes its own rows.
                #[allow(unsafe_code)]
                let target = unsafe { self.shared.slice(start, count) };
                target.iter_mut().zip(&line[at - from..]).for_each(|(t, v)| {
                    t.write(v + bias);
                });
            }
            at = next;
        }
    }
}

/// A padded band.
struct Source<'a> {
    vectors: Vectors,
    taps: &'a [usize],
    values: &'a [f32],
    /// Pixels from the first to the last, with those between rows.
    pixels: usize,
}

impl Source<'_> {
    /// Writes `B` blocks of outputs, the first of which is `output`.
    fn outputs<const B: usize>(&self, weights: [&[f32]; B], bias: &[f32], output: usize, band: &Band<'_>) {
        let mut tile: Tile<B> = [[[0.0; TILE]; TOGETHER]; B];
        let mut from = 0;
        while from < self.pixels {
            let left = self.pixels - from;
            let done = products(self.vectors, weights, self.taps, &self.values[from..], left, &mut tile);
            for (lane, (line, bias)) in tile.iter().flatten().zip(bias).enumerate() {
                band.write(output + lane, from, &line[..done], *bias);
            }
            from += done;
        }
    }
}

/// `activation(conv(x, weight) + bias)`; `None` if the processor lacks the vectors, or another way is faster.
pub(super) fn direct_forward(
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
    shape: &ConvShape,
    spec: &ConvSpec,
) -> Option<Vec<f32>> {
    let taps = shape.inputs * shape.kernel * shape.kernel;
    let here = shape.kernel > 1 && taps <= MAX_TAPS && shape.output_size(spec)[1] >= MIN_COLUMNS;
    here.then(Vectors::of_processor)
        .flatten()
        .map(|vectors| with_vectors(vectors, x, weight, bias, shape, spec))
}

fn with_vectors(
    vectors: Vectors,
    x: &[f32],
    weight: &[f32],
    bias: &[f32],
    shape: &ConvShape,
    spec: &ConvSpec,
) -> Vec<f32> {
    let padded = Padded::new(shape, spec);
    let [height, width] = padded.out;
    let weights = packed(weight, shape.outputs);
    let patch = shape.inputs * shape.kernel * shape.kernel;
    let blocks: Vec<&[f32]> = weights.chunks_exact(TOGETHER * patch).collect();
    let image = shape.inputs * shape.pixels();
    let mut y = unwritten(shape.batch * shape.outputs * height * width);
    let shared = Shared::new(&mut y);
    let whole = padded.plane(padded.band, shape, spec);
    let taps_of_whole = padded.taps(whole, shape, spec);
    (0..shape.batch * padded.bands()).into_par_iter().for_each(|task| {
        let (b, (first, rows)) = (task / padded.bands(), padded.rows(task % padded.bands()));
        let plane = padded.plane(rows, shape, spec);
        let own;
        let taps = if plane == whole {
            &taps_of_whole
        } else {
            own = padded.taps(plane, shape, spec);
            &own
        };
        let begin = b * shape.outputs * height * width + first * width;
        let band = Band { shared, begin, pixels: height * width, columns: width, wide: padded.columns };
        PADDED.with_borrow_mut(|buffer| {
            let length = shape.inputs * spec.stride * spec.stride * plane;
            // The last tile reads past the end.
            if buffer.len() < length + TILE {
                buffer.resize(length + TILE, 0.0);
            }
            padded.fill(&mut buffer[..length], &x[b * image..][..image], first, plane, shape, spec);
            let pixels = (rows - 1) * padded.columns + width;
            let source = Source { vectors, taps, values: buffer, pixels };
            for (number, pair) in blocks.chunks(2).enumerate() {
                let output = 2 * TOGETHER * number;
                let bias = &bias[output..];
                match pair {
                    [a, b] => source.outputs([*a, *b], bias, output, &band),
                    [a] => source.outputs([*a], bias, output, &band),
                    _ => {}
                }
            }
        });
        for output in 0..shape.outputs {
            // SAFETY: this task's rows, written just now.
            #[allow(unsafe_code)]
            let line =
                unsafe { shared.slice(begin + output * height * width, rows * width).assume_init_mut() };
            activate(line, spec.activation);
        }
    });
    // SAFETY: the bands of all images are all of the output.
    #[allow(unsafe_code)]
    unsafe {
        written(y)
    }
}

#[cfg(test)]
mod tests {
    use super::super::Activation;
    use super::*;

    fn numbers(count: usize, seed: usize) -> Vec<f32> {
        (0..count).map(|i| ((i * 7919 + seed * 31) % 1009) as f32 / 504.5 - 1.0).collect()
    }

    /// The definition, in double precision.
    fn naive(x: &[f32], weight: &[f32], bias: &[f32], shape: &ConvShape, spec: &ConvSpec) -> Vec<f64> {
        let ([height, width], k) = (shape.size, shape.kernel);
        let out = shape.output_size(spec);
        let mut y = Vec::new();
        for place in 0..shape.batch * shape.outputs * out[0] * out[1] {
            let (row, column) = (place / out[1] % out[0], place % out[1]);
            let (b, o) =
                (place / (out[0] * out[1]) / shape.outputs, place / (out[0] * out[1]) % shape.outputs);
            let mut sum = f64::from(bias[o]);
            for tap in 0..shape.inputs * k * k {
                let (channel, ky, kx) = (tap / (k * k), tap / k % k, tap % k);
                let v = (row * spec.stride + ky).wrapping_sub(spec.padding[0]);
                let u = (column * spec.stride + kx).wrapping_sub(spec.padding[0]);
                if v < height && u < width {
                    let pixel = x[((b * shape.inputs + channel) * height + v) * width + u];
                    sum += f64::from(pixel) * f64::from(weight[o * shape.inputs * k * k + tap]);
                }
            }
            y.push(if spec.activation == Activation::Relu { sum.max(0.0) } else { sum });
        }
        y
    }

    #[test]
    fn every_size_agrees_with_the_definition_and_all_vectors_with_each_other() {
        let Some(best) = Vectors::of_processor() else {
            println!("skipped: this processor has no vectors with fused multiplication and addition");
            return;
        };
        // Batch, inputs, outputs, rows, columns, kernel, stride, padding. Up to three vectors in the last tile of a row of tiles, one and
        // two blocks of outputs, one that is not full, one band and many.
        let sizes = [
            ([1, 3, 5, 9, 13], 3, 1, [1, 1]),
            ([2, 4, 8, 20, 20], 3, 1, [1, 1]),
            ([1, 2, 12, 11, 70], 3, 1, [0, 0]),
            ([3, 5, 3, 8, 8], 5, 1, [2, 2]),
            ([2, 3, 9, 17, 15], 3, 2, [1, 1]),
            ([1, 3, 4, 16, 16], 3, 2, [0, 1]),
            ([2, 2, 6, 18, 23], 7, 2, [3, 3]),
            ([1, 2, 8, 16, 20], 4, 4, [0, 0]),
            ([2, 1, 4, 13, 10], 2, 3, [1, 0]),
            ([2, 96, 4, 40, 30], 3, 1, [1, 1]),
        ];
        for (i, ([batch, inputs, outputs, height, width], kernel, stride, padding)) in
            sizes.into_iter().enumerate()
        {
            let shape = ConvShape { batch, inputs, outputs, size: [height, width], kernel };
            let activation = if i % 2 == 0 { Activation::Relu } else { Activation::Linear };
            let spec = ConvSpec { stride, padding, groups: 1, activation };
            let x = numbers(batch * inputs * height * width, i);
            let weight = numbers(outputs * inputs * kernel * kernel, i + 1);
            let bias = numbers(outputs, i + 2);
            let of = |vectors| with_vectors(vectors, &x, &weight, &bias, &shape, &spec);
            // Once more, with what the first run left in the buffers.
            let (first, again) = (of(best), of(best));
            let right = naive(&x, &weight, &bias, &shape, &spec);
            assert_eq!(first.len(), right.len());
            for (a, b) in first.iter().zip(&right) {
                assert!((f64::from(*a) - b).abs() < 1e-4, "{shape:?} {spec:?}: {a} {b}");
            }
            assert_eq!(first, again);
            if matches!(best, Vectors::Avx512) {
                assert_eq!(first, of(Vectors::Avx2), "{shape:?} {spec:?}");
            }
        }
    }

    #[test]
    fn bands_cover_all_rows_and_fit_the_cache() {
        let spec = ConvSpec { stride: 1, padding: [1, 1], groups: 1, activation: Activation::Linear };
        let shape = |batch, inputs| ConvShape { batch, inputs, outputs: 8, size: [40, 30], kernel: 3 };
        for (batch, inputs, bands) in [(2, 8, 1), (1, 8, 4), (2, 96, 3), (2, 4000, 40)] {
            let shape = shape(batch, inputs);
            let padded = Padded::new(&shape, &spec);
            assert_eq!(padded.bands(), bands, "{inputs} channels");
            let rows: Vec<usize> = (0..bands).map(|i| padded.rows(i).1).collect();
            assert_eq!(rows.iter().sum::<usize>(), 40);
            if bands < 40 {
                assert!(inputs * padded.plane(padded.band, &shape, &spec) <= BAND);
            }
        }
    }
}
