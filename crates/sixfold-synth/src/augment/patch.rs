//! A small planar colour image, and cropping one from a photograph.

use sixfold_geometry::RgbImage;

use super::blur::gaussian;
use super::coverage::Coverage;

/// Half a pixel in fixed point.
const HALF: i64 = 1 << 15;

/// An affine map from patch pixels to image pixels; pixel centres at whole numbers on both sides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AffineMap {
    /// `image_x = x[0] * patch_x + x[1] * patch_y + x[2]`.
    pub x: [f32; 3],
    /// `image_y = y[0] * patch_x + y[1] * patch_y + y[2]`.
    pub y: [f32; 3],
}

impl AffineMap {
    /// The image position of a patch pixel.
    pub fn apply(&self, x: f32, y: f32) -> [f32; 2] {
        [self.x[0] * x + self.x[1] * y + self.x[2], self.y[0] * x + self.y[1] * y + self.y[2]]
    }

    /// Image pixels per patch pixel along a side.
    pub fn scale(&self) -> f32 {
        (self.x[0] * self.y[1] - self.x[1] * self.y[0]).abs().sqrt()
    }

    /// Number of taps per side, which are averaged against aliasing for a map with a scale near 2 or more.
    fn taps(&self) -> usize {
        (self.scale().round() as usize).clamp(1, 4)
    }
}

/// A colour image of three planes (red, green, blue), row-major, values in 0..1.
#[derive(Debug, Clone, PartialEq)]
pub struct Patch {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `3 * height * width` numbers, channel first.
    pub data: Vec<f32>,
}

impl Patch {
    /// One colour everywhere.
    pub fn filled(width: usize, height: usize, color: [f32; 3]) -> Self {
        let mut data = Vec::with_capacity(3 * width * height);
        for c in color {
            data.resize(data.len() + width * height, c);
        }
        Patch { width, height, data }
    }

    /// A patch of a whole 8-bit image.
    pub fn from_rgb(image: &RgbImage) -> Self {
        let (width, height) = image.size();
        let pixels = width * height;
        let mut data = vec![0.0; 3 * pixels];
        for (i, rgb) in image.as_slice().iter().enumerate() {
            for c in 0..3 {
                data[c * pixels + i] = f32::from(rgb[c]) * (1.0 / 255.0);
            }
        }
        Patch { width, height, data }
    }

    /// The patch as an 8-bit image; values are clamped to 0..1.
    pub fn to_rgb(&self) -> RgbImage {
        let pixels = self.width * self.height;
        RgbImage::from_fn(self.width, self.height, |x, y| {
            std::array::from_fn(|c| {
                (self.data[c * pixels + y * self.width + x].clamp(0.0, 1.0) * 255.0).round() as u8
            })
        })
    }

    /// The three planes.
    pub fn planes_mut(&mut self) -> std::slice::ChunksExactMut<'_, f32> {
        self.data.chunks_exact_mut((self.width * self.height).max(1))
    }

    /// Crops a patch from an image, with bilinear interpolation (an average over several taps where the image is
    /// reduced). Also returns which pixels are inside the image; the others have the colour `outside`.
    pub fn warp(
        image: &RgbImage,
        map: &AffineMap,
        width: usize,
        height: usize,
        outside: [f32; 3],
    ) -> (Patch, Coverage) {
        let mut patch = Patch::filled(width, height, outside);
        let mut inside = Coverage::filled(width, height, 0.0);
        let (w, h) = image.size();
        if w < 2 || h < 2 {
            return (patch, inside);
        }
        let pixels = width * height;
        let source = image.as_slice();
        let taps = map.taps();
        let weight = 1.0 / (255.0 * (taps * taps) as f32);
        // Fixed point with 16 fractional bits: float conversions would cost more than the rest of a pixel's
        // computation.
        let fixed = |v: f32| (f64::from(v) * 65536.0) as i64;
        let offsets: Vec<[i64; 2]> = (0..taps * taps)
            .map(|k| {
                let at = |k: usize| (k as f32 + 0.5) / taps as f32 - 0.5;
                let (i, j) = (at(k % taps), at(k / taps));
                // Half a pixel is added, so that truncation rounds.
                [fixed(map.x[0] * i + map.x[1] * j + 0.5), fixed(map.y[0] * i + map.y[1] * j + 0.5)]
            })
            .collect();
        let (step_u, step_v) = (fixed(map.x[0]), fixed(map.y[0]));
        let (largest_u, largest_v) = (((w - 1) as i64) << 16, ((h - 1) as i64) << 16);
        let (red, rest) = patch.data.split_at_mut(pixels);
        let (green, blue) = rest.split_at_mut(pixels);
        for y in 0..height {
            let [start_u, start_v] = map.apply(0.0, y as f32).map(fixed);
            for x in 0..width {
                let (u, v) = (start_u + x as i64 * step_u, start_v + x as i64 * step_v);
                if u < -HALF || v < -HALF || u > largest_u + HALF || v > largest_v + HALF {
                    continue;
                }
                let mut sum = [0.0f32; 3];
                if taps == 1 {
                    let (u, v) = (u.clamp(0, largest_u), v.clamp(0, largest_v));
                    let (x0, y0) = (((u >> 16) as usize).min(w - 2), ((v >> 16) as usize).min(h - 2));
                    let fx = (u - ((x0 as i64) << 16)) as f32 * (1.0 / 65536.0);
                    let fy = (v - ((y0 as i64) << 16)) as f32 * (1.0 / 65536.0);
                    let top = &source[y0 * w + x0..y0 * w + x0 + 2];
                    let bottom = &source[(y0 + 1) * w + x0..(y0 + 1) * w + x0 + 2];
                    sum = std::array::from_fn(|c| {
                        let above = f32::from(top[0][c]) * (1.0 - fx) + f32::from(top[1][c]) * fx;
                        let below = f32::from(bottom[0][c]) * (1.0 - fx) + f32::from(bottom[1][c]) * fx;
                        above * (1.0 - fy) + below * fy
                    });
                } else {
                    // The taps are about a pixel apart, so the nearest pixel of each is enough.
                    let mut total = [0u32; 3];
                    for [du, dv] in &offsets {
                        let x0 = ((u + du).clamp(0, largest_u) >> 16) as usize;
                        let y0 = ((v + dv).clamp(0, largest_v) >> 16) as usize;
                        let pixel = source[y0 * w + x0];
                        (0..3).for_each(|c| total[c] += u32::from(pixel[c]));
                    }
                    (0..3).for_each(|c| sum[c] = total[c] as f32);
                }
                let at = y * width + x;
                inside.data[at] = 1.0;
                red[at] = sum[0] * weight;
                green[at] = sum[1] * weight;
                blue[at] = sum[2] * weight;
            }
        }
        (patch, inside)
    }

    /// Draws `over`, blended by `coverage`.
    pub fn blend(&mut self, over: &Patch, coverage: &Coverage) {
        let pixels = (self.width * self.height).max(1);
        for (under, over) in self.data.chunks_exact_mut(pixels).zip(over.data.chunks_exact(pixels)) {
            for ((u, o), a) in under.iter_mut().zip(over).zip(&coverage.data) {
                *u += (o - *u) * a;
            }
        }
    }

    /// Gaussian blur in place; sigmas below 0.2 pixels do nothing.
    pub fn blur(&mut self, sigma: f32) {
        let (width, height) = (self.width, self.height);
        self.planes_mut().for_each(|plane| gaussian(plane, width, height, sigma));
    }

    /// Blurs only the border of something drawn into the patch: the band where the coverage, blurred by `sigma`, is
    /// neither 0 nor 1 (dissertation, section 3.4.1: the borderlines are blurred to make smooth boundaries).
    pub fn soften_border(&mut self, coverage: &Coverage, sigma: f32) {
        if sigma.is_nan() || sigma < super::blur::MIN_SIGMA {
            return;
        }
        let mut band = coverage.clone();
        band.blur(sigma);
        band.data.iter_mut().for_each(|v| *v = (4.0 * *v * (1.0 - *v)).clamp(0.0, 1.0));
        let mut soft = self.clone();
        soft.blur(sigma);
        self.blend(&soft, &band);
    }

    /// Clamps all values to 0..1.
    pub fn clamp(&mut self) {
        self.data.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shift_by_whole_pixels_copies() {
        let image = RgbImage::from_fn(10, 8, |x, y| [x as u8 * 20, y as u8 * 30, 7]);
        let map = AffineMap { x: [1.0, 0.0, 3.0], y: [0.0, 1.0, 2.0] };
        let (patch, inside) = Patch::warp(&image, &map, 9, 4, [0.5; 3]);
        let back = patch.to_rgb();
        for y in 0..4 {
            for x in 0..7 {
                assert_eq!(back[(x, y)], image[(x + 3, y + 2)]);
            }
        }
        assert_eq!(back[(8, 0)], [128; 3]);
        assert_eq!(inside.area(), 28.0);
    }

    #[test]
    fn reducing_averages() {
        let image = RgbImage::from_fn(40, 40, |x, _| [if x % 2 == 0 { 0 } else { 200 }; 3]);
        let map = AffineMap { x: [2.0, 0.0, 0.5], y: [0.0, 2.0, 0.5] };
        let (patch, _) = Patch::warp(&image, &map, 18, 18, [0.0; 3]);
        assert!(patch.data.iter().all(|v| (v * 255.0 - 100.0).abs() < 1.0));
    }
}
