//! The Gaussian pyramid of an image and its differences (Lowe 2004, section 3).

use rayon::prelude::*;

/// Levels in which extrema are searched, in each octave.
pub(super) const LEVELS: usize = 3;
/// Blur of the first level, pixels of its octave.
pub(super) const SIGMA: f32 = 1.6;
/// Blur that an image already has, pixels.
const CAMERA_SIGMA: f32 = 0.5;
/// Smallest side of an octave, pixels.
const SMALLEST: usize = 16;

/// Grey values, row by row.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Plane {
    pub width: usize,
    pub height: usize,
    pub data: Vec<f32>,
}

impl Plane {
    pub(super) fn at(&self, x: usize, y: usize) -> f32 {
        self.data[y * self.width + x]
    }

    /// The derivatives along x and y at an inner pixel.
    pub(super) fn gradient(&self, x: usize, y: usize) -> [f32; 2] {
        let i = y * self.width + x;
        let d = &self.data;
        [0.5 * (d[i + 1] - d[i - 1]), 0.5 * (d[i + self.width] - d[i - self.width])]
    }

    /// Twice as many rows and columns, bilinear; pixel `x` of the result is at `x / 2` of this one.
    pub(super) fn doubled(&self) -> Plane {
        let (width, height) = (2 * self.width, 2 * self.height);
        let mut data = vec![0.0f32; width * height];
        data.par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
            let (y0, y1) = (y / 2, (y.div_ceil(2)).min(self.height - 1));
            for (x, value) in row.iter_mut().enumerate() {
                let (x0, x1) = (x / 2, (x.div_ceil(2)).min(self.width - 1));
                *value = 0.25 * (self.at(x0, y0) + self.at(x1, y0) + self.at(x0, y1) + self.at(x1, y1));
            }
        });
        Plane { width, height, data }
    }

    /// Every second row and column.
    fn halved(&self) -> Plane {
        let (width, height) = (self.width / 2, self.height / 2);
        let data = (0..height).flat_map(|y| (0..width).map(move |x| self.at(2 * x, 2 * y))).collect();
        Plane { width, height, data }
    }

    fn minus(&self, other: &Plane) -> Plane {
        let data = self.data.iter().zip(&other.data).map(|(a, b)| a - b).collect();
        Plane { width: self.width, height: self.height, data }
    }

    /// Convolved with a Gaussian; the border is repeated.
    pub(super) fn blurred(&self, sigma: f32) -> Plane {
        let reach = (4.0 * sigma).ceil().max(1.0) as usize;
        let mut kernel: Vec<f32> =
            (0..=reach).map(|i| (-((i * i) as f32) / (2.0 * sigma * sigma)).exp()).collect();
        let sum = kernel[0] + 2.0 * kernel[1..].iter().sum::<f32>();
        kernel.iter_mut().for_each(|k| *k /= sum);
        let (width, height) = (self.width, self.height);
        let mut along = vec![0.0f32; self.data.len()];
        along.par_chunks_mut(width).zip(self.data.par_chunks(width)).for_each_init(
            || vec![0.0f32; width + 2 * reach],
            |padded, (out, row)| {
                padded[..reach].fill(row[0]);
                padded[reach..reach + width].copy_from_slice(row);
                padded[reach + width..].fill(row[width - 1]);
                out.iter_mut().zip(row).for_each(|(o, v)| *o = kernel[0] * v);
                for (i, k) in kernel.iter().enumerate().skip(1) {
                    let (left, right) = (&padded[reach - i..], &padded[reach + i..]);
                    out.iter_mut().zip(left).zip(right).for_each(|((o, a), b)| *o += k * (a + b));
                }
            },
        );
        let row = |y: usize| &along[y * width..(y + 1) * width];
        let mut data = vec![0.0f32; self.data.len()];
        data.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
            out.iter_mut().zip(row(y)).for_each(|(o, v)| *o = kernel[0] * v);
            for (i, k) in kernel.iter().enumerate().skip(1) {
                let (above, below) = (row(y.saturating_sub(i)), row((y + i).min(height - 1)));
                out.iter_mut().zip(above).zip(below).for_each(|((o, a), b)| *o += k * (a + b));
            }
        });
        Plane { width, height, data }
    }
}

/// One octave: levels of increasing blur, and the differences of neighbours.
pub(super) struct Octave {
    /// Pixels of the image per pixel of the octave.
    pub scale: f32,
    /// `LEVELS + 3` of them; level `i` has the blur `SIGMA * 2^(i / LEVELS)`.
    pub levels: Vec<Plane>,
    /// Level `i + 1` minus level `i`.
    pub differences: Vec<Plane>,
}

/// The octaves of an image, from fine to coarse.
pub(super) fn octaves(grey: Plane, double: bool) -> Vec<Octave> {
    let (mut scale, mut first, has) =
        if double { (0.5, grey.doubled(), 2.0 * CAMERA_SIGMA) } else { (1.0, grey, CAMERA_SIGMA) };
    first = first.blurred((SIGMA * SIGMA - has * has).sqrt());
    let mut octaves = Vec::new();
    loop {
        let blur = |level: usize| SIGMA * 2.0f32.powf(level as f32 / LEVELS as f32);
        let mut levels = vec![first];
        for level in 1..LEVELS + 3 {
            let more = (blur(level).powi(2) - blur(level - 1).powi(2)).sqrt();
            let next = levels[level - 1].blurred(more);
            levels.push(next);
        }
        let differences = levels.windows(2).map(|pair| pair[1].minus(&pair[0])).collect();
        first = levels[LEVELS].halved();
        octaves.push(Octave { scale, levels, differences });
        scale *= 2.0;
        if first.width.min(first.height) < SMALLEST {
            return octaves;
        }
    }
}
