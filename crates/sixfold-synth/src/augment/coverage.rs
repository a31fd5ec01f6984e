//! One channel over a patch: the covered fraction of each pixel, in 0..1.

use super::blur::gaussian;
use rand::RngExt;
use sixfold_geometry::random::Random;

/// Row-major coverage in 0..1.
#[derive(Debug, Clone, PartialEq)]
pub struct Coverage {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// One number per pixel.
    pub data: Vec<f32>,
}

impl Coverage {
    /// The same everywhere.
    pub fn filled(width: usize, height: usize, value: f32) -> Self {
        Coverage { width, height, data: vec![value; width * height] }
    }

    /// Calls `f(x, y)` for every pixel.
    pub fn from_fn(width: usize, height: usize, mut f: impl FnMut(usize, usize) -> f32) -> Self {
        let mut data = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                data.push(f(x, y));
            }
        }
        Coverage { width, height, data }
    }

    /// Gaussian blur in place; sigmas below 0.2 pixels do nothing.
    pub fn blur(&mut self, sigma: f32) {
        gaussian(&mut self.data, self.width, self.height, sigma);
    }

    /// Removes `other`, leaving what remains visible behind it.
    pub fn remove(&mut self, other: &Coverage) {
        self.data.iter_mut().zip(&other.data).for_each(|(a, b)| *a *= 1.0 - b);
    }

    /// The sum over all pixels, in pixels.
    pub fn area(&self) -> f32 {
        self.data.iter().sum()
    }

    /// Bilinear value at a point, borders repeated.
    pub fn sample(&self, x: f32, y: f32) -> f32 {
        let x = x.clamp(0.0, (self.width - 1) as f32);
        let y = y.clamp(0.0, (self.height - 1) as f32);
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(self.width - 1), (y0 + 1).min(self.height - 1));
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let at = |x: usize, y: usize| self.data[y * self.width + x];
        let top = at(x0, y0) + (at(x1, y0) - at(x0, y0)) * fx;
        let bottom = at(x0, y1) + (at(x1, y1) - at(x0, y1)) * fx;
        top + (bottom - top) * fy
    }

    /// The same area at another resolution: each pixel has the value at its centre.
    pub fn resampled(&self, width: usize, height: usize) -> Coverage {
        if (width, height) == (self.width, self.height) {
            return self.clone();
        }
        let sx = self.width as f32 / width as f32;
        let sy = self.height as f32 / height as f32;
        Coverage::from_fn(width, height, |x, y| {
            self.sample((x as f32 + 0.5) * sx - 0.5, (y as f32 + 0.5) * sy - 0.5)
        })
    }

    /// A mask as a network would predict it: grown or shrunk by about `grow` pixels, with a border disturbed by
    /// about `wobble` pixels, then thresholded at one half (so 0 or 1).
    pub fn disturbed(&self, grow: f32, wobble: f32, random: &mut Random) -> Coverage {
        // The edge of a mask blurred by sigma falls from 1 to 0 about linearly over 2.5 sigma.
        let reach = (grow.abs() + wobble).max(1.0);
        let mut soft = self.clone();
        soft.blur(reach.min(8.0));
        let field =
            super::noise::value_noise(self.width, self.height, 6 + random.random_range(0..10), random);
        let slope = 1.0 / (2.5 * reach.min(8.0));
        for (v, n) in soft.data.iter_mut().zip(&field) {
            let moved = *v + (grow + wobble * (2.0 * n - 1.0)) * slope;
            *v = if moved > 0.5 { 1.0 } else { 0.0 };
        }
        soft
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::random::stream;

    #[test]
    fn half_the_resolution_is_the_mean_of_blocks() {
        let fine = Coverage::from_fn(8, 8, |x, y| if x + y < 7 { 1.0 } else { 0.0 });
        let coarse = fine.resampled(4, 4);
        let mean = (0..4).map(|k| fine.data[(2 + k / 2) * 8 + 4 + k % 2]).sum::<f32>() / 4.0;
        assert!((coarse.data[4 + 2] - mean).abs() < 1e-6);
        assert!((coarse.area() * 4.0 - fine.area()).abs() < 1e-4);
    }

    #[test]
    fn a_disturbed_mask_grows_and_shrinks() {
        let mask = Coverage::from_fn(64, 64, |x, y| f32::from(x.abs_diff(32) < 16 && y.abs_diff(32) < 16));
        let mut random = stream(1, 1);
        let grown = mask.disturbed(3.0, 0.5, &mut random).area();
        let shrunk = mask.disturbed(-3.0, 0.5, &mut random).area();
        assert!((grown.sqrt() - 31.0 - 6.0).abs() < 2.5, "{grown}");
        assert!((shrunk.sqrt() - 31.0 + 6.0).abs() < 2.5, "{shrunk}");
    }
}
