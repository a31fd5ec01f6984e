//! Square images of any number of channels that are interpolated between pixels, with their gradients.

use sixfold_synth::augment::Patch;

/// Channels over a square crop, interleaved, so that the values of one lookup are adjacent in memory.
#[derive(Debug, Clone, PartialEq)]
pub struct Maps {
    channels: usize,
    side: usize,
    /// `side * side * channels` numbers.
    data: Vec<f32>,
}

impl Maps {
    /// Converts planar data, channel by channel.
    ///
    /// # Panics
    /// If `planes` does not have `channels * side * side` numbers.
    pub(crate) fn from_planes(planes: &[f32], channels: usize, side: usize) -> Self {
        let area = side * side;
        assert_eq!(planes.len(), channels * area, "one number per pixel and channel");
        let mut data = vec![0.0; planes.len()];
        for (c, plane) in planes.chunks_exact(area.max(1)).enumerate() {
            for (i, value) in plane.iter().enumerate() {
                data[i * channels + c] = *value;
            }
        }
        Maps { channels, side, data }
    }

    /// The colours of a square patch, blurred by `sigma` pixels.
    pub fn of_patch(patch: &Patch, sigma: f32) -> Self {
        let mut patch = patch.clone();
        patch.blur(sigma);
        Maps::from_planes(&patch.data, 3, patch.width)
    }

    /// The colours of a square patch, high-pass filtered: blurred by `sigma` pixels, minus the mean over a wide neighbourhood
    /// (`wide` pixels), both over pixels `inside` (0 to 1 per pixel) only. This removes shading and shadows, which vary slowly, and
    /// keeps the texture; pixels outside the object have no influence.
    pub(crate) fn of_detail(patch: &Patch, inside: &[f32], sigma: f32, wide: f32) -> Self {
        let area = patch.width * patch.height;
        let mean = |sigma: f32| {
            let mut masked = patch.clone();
            for plane in masked.data.chunks_exact_mut(area) {
                plane.iter_mut().zip(inside).for_each(|(v, m)| *v *= m);
            }
            masked.blur(sigma);
            let mut weight = Patch::filled(patch.width, patch.height, [0.0; 3]);
            weight.data[..area].copy_from_slice(inside);
            weight.blur(sigma);
            for plane in masked.data.chunks_exact_mut(area) {
                plane.iter_mut().zip(&weight.data[..area]).for_each(|(v, w)| *v /= w.max(0.02));
            }
            masked
        };
        let (mut fine, coarse) = (mean(sigma), mean(wide));
        fine.data.iter_mut().zip(&coarse.data).for_each(|(v, c)| *v -= c);
        Maps::from_planes(&fine.data, 3, patch.width)
    }

    /// Number of channels.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// Pixels along a side.
    pub fn side(&self) -> usize {
        self.side
    }

    fn corner(&self, x: f32, y: f32) -> (usize, f32, f32) {
        let last = (self.side - 2) as f32;
        let (x0, y0) = (x.floor().clamp(0.0, last), y.floor().clamp(0.0, last));
        (y0 as usize * self.side + x0 as usize, (x - x0).clamp(0.0, 1.0), (y - y0).clamp(0.0, 1.0))
    }

    /// The channels at a pixel, bilinearly interpolated; beyond the border its values are repeated.
    pub fn sample(&self, x: f32, y: f32, out: &mut [f32]) {
        let (i, fx, fy) = self.corner(x, y);
        let c = self.channels;
        let row = self.side * c;
        let top = &self.data[i * c..i * c + 2 * c];
        let bottom = &self.data[i * c + row..i * c + row + 2 * c];
        for (k, out) in out.iter_mut().enumerate().take(c) {
            let above = top[k] * (1.0 - fx) + top[c + k] * fx;
            let below = bottom[k] * (1.0 - fx) + bottom[c + k] * fx;
            *out = above * (1.0 - fy) + below * fy;
        }
    }

    /// The channels at a pixel and their change per pixel to the right and downwards (central differences over one pixel).
    pub(crate) fn sample_with_gradient(
        &self,
        x: f32,
        y: f32,
        out: &mut [f32],
        dx: &mut [f32],
        dy: &mut [f32],
    ) {
        self.sample(x, y, out);
        let mut before = vec![0.0f32; self.channels];
        for (gradient, [u, v]) in [(dx, [0.5f32, 0.0]), (dy, [0.0, 0.5])] {
            self.sample(x - u, y - v, &mut before);
            self.sample(x + u, y + v, gradient);
            gradient.iter_mut().zip(&before).for_each(|(g, before)| *g -= before);
        }
    }
}
