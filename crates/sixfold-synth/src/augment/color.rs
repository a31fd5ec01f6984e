//! Colour augmentation in random order (dissertation, table 3.2, and a stronger set for rendered objects).

use rand::RngExt;
use rand::seq::SliceRandom;
use sixfold_geometry::random::{Random, uniform};

use super::error::AugmentError;
use super::patch::Patch;

/// Ranges and probabilities of each change, for image values in 0..1. A range of two equal neutral numbers disables its change.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ColorAugmentation {
    /// Offset, sampled separately for each channel.
    pub add: [f32; 2],
    /// Contrast about 0.5, the same for all channels.
    pub contrast: [f32; 2],
    /// Factor on all channels or, with probability `multiply_per_channel`, one for each.
    pub multiply: [f32; 2],
    /// Probability that the factor differs between channels.
    pub multiply_per_channel: f32,
    /// Sigma of a Gaussian blur, pixels.
    pub blur: [f32; 2],
    /// Probability of noise.
    pub noise_probability: f32,
    /// Standard deviation of the noise.
    pub noise: [f32; 2],
    /// Probability of a second, stronger contrast.
    pub strong_contrast_probability: f32,
    /// The stronger contrast, about the patch's mean (about 0.5 it would make dark objects black); per channel with probability
    /// 0.3.
    pub strong_contrast: [f32; 2],
    /// Probability of the three changes below.
    pub tone_probability: f32,
    /// Exponent on each value.
    pub gamma: [f32; 2],
    /// Rotation of the hue, radians.
    pub hue: [f32; 2],
    /// Factor on the difference from grey.
    pub saturation: [f32; 2],
}

impl ColorAugmentation {
    /// No change at all.
    pub fn none() -> Self {
        ColorAugmentation {
            add: [0.0; 2],
            contrast: [1.0; 2],
            multiply: [1.0; 2],
            multiply_per_channel: 0.0,
            blur: [0.0; 2],
            noise_probability: 0.0,
            noise: [0.0; 2],
            strong_contrast_probability: 0.0,
            strong_contrast: [1.0; 2],
            tone_probability: 0.0,
            gamma: [1.0; 2],
            hue: [0.0; 2],
            saturation: [1.0; 2],
        }
    }

    /// The ranges of table 3.2.
    pub fn table_3_2() -> Self {
        ColorAugmentation {
            add: [-15.0 / 255.0, 15.0 / 255.0],
            contrast: [0.8, 1.3],
            multiply: [0.8, 1.2],
            multiply_per_channel: 0.3,
            blur: [0.0, 0.5],
            ..ColorAugmentation::none()
        }
    }

    /// The ranges of table 4.1, for the source images of new views. (The table's noise has a standard deviation of 10; here it is
    /// uniform up to that.)
    pub fn table_4_1() -> Self {
        ColorAugmentation {
            multiply_per_channel: 0.0,
            noise_probability: 1.0,
            noise: [0.0, 10.0 / 255.0],
            ..ColorAugmentation::table_3_2()
        }
    }

    /// Table 3.2 with the noise and the strong contrast of the author's public code.
    pub fn real_images() -> Self {
        ColorAugmentation {
            noise_probability: 0.1,
            noise: [10.0 / 255.0; 2],
            strong_contrast_probability: 0.5,
            strong_contrast: [0.5, 2.2],
            ..ColorAugmentation::table_3_2()
        }
    }

    /// For rendered objects, whose light and camera are not the real ones.
    pub fn renders() -> Self {
        ColorAugmentation {
            multiply: [0.7, 1.3],
            multiply_per_channel: 0.5,
            blur: [0.0, 1.5],
            noise_probability: 0.3,
            noise: [0.01, 0.05],
            strong_contrast_probability: 0.3,
            strong_contrast: [0.5, 1.8],
            tone_probability: 0.8,
            gamma: [0.7, 1.5],
            hue: [-0.1, 0.1],
            saturation: [0.5, 1.6],
            ..ColorAugmentation::table_3_2()
        }
    }

    /// Tests every field.
    ///
    /// # Errors
    /// [`AugmentError::Option`].
    pub fn check(&self) -> Result<(), AugmentError> {
        let ranges: [(&'static str, [f32; 2], f32, f32, &'static str); 9] = [
            ("add", self.add, -1.0, 1.0, "two numbers in order between -1 and 1"),
            ("contrast", self.contrast, 0.0, 10.0, "two factors in order between 0 and 10"),
            ("multiply", self.multiply, 0.0, 10.0, "two factors in order between 0 and 10"),
            ("blur", self.blur, 0.0, 8.0, "two sigmas in order between 0 and 8 pixels"),
            ("noise", self.noise, 0.0, 1.0, "two deviations in order between 0 and 1"),
            ("strong_contrast", self.strong_contrast, 0.0, 10.0, "two factors in order between 0 and 10"),
            ("gamma", self.gamma, 0.1, 10.0, "two exponents in order between 0.1 and 10"),
            ("hue", self.hue, -4.0, 4.0, "two angles in order, radians"),
            ("saturation", self.saturation, 0.0, 10.0, "two factors in order between 0 and 10"),
        ];
        for (field, range, low, high, expected) in ranges {
            AugmentError::check_range(field, range, low, high, expected)?;
        }
        AugmentError::check_probability("multiply_per_channel", self.multiply_per_channel)?;
        AugmentError::check_probability("noise_probability", self.noise_probability)?;
        AugmentError::check_probability("strong_contrast_probability", self.strong_contrast_probability)?;
        AugmentError::check_probability("tone_probability", self.tone_probability)
    }

    /// Changes a patch; the values stay within 0..1.
    pub fn apply(&self, patch: &mut Patch, random: &mut Random) {
        let mut order =
            [Step::Add, Step::Contrast, Step::Multiply, Step::Blur, Step::Noise, Step::Strong, Step::Tone];
        order.shuffle(random);
        // Consecutive changes of the form a v + b are combined into one pass over the pixels.
        let mut linear = Linear::identity();
        for step in order {
            match step {
                Step::Add => linear.then([1.0; 3], std::array::from_fn(|_| uniform(random, self.add))),
                Step::Contrast => linear.contrast([uniform(random, self.contrast); 3], 0.5),
                Step::Multiply => {
                    let each = random.random::<f32>() < self.multiply_per_channel;
                    linear.then(factors(self.multiply, each, random), [0.0; 3]);
                }
                Step::Strong => {
                    if random.random::<f32>() < self.strong_contrast_probability {
                        let each = random.random::<f32>() < 0.3;
                        linear.flush(patch);
                        linear.contrast(factors(self.strong_contrast, each, random), mean(patch));
                    }
                }
                Step::Blur => {
                    // The blur commutes with linear changes.
                    patch.blur(uniform(random, self.blur));
                }
                Step::Noise => {
                    if random.random::<f32>() < self.noise_probability {
                        linear.flush(patch);
                        add_noise(patch, uniform(random, self.noise), random);
                    }
                }
                Step::Tone => {
                    if random.random::<f32>() < self.tone_probability {
                        linear.flush(patch);
                        let hue = uniform(random, self.hue);
                        let saturation = uniform(random, self.saturation);
                        turn_hue(patch, hue, saturation);
                        raise(patch, uniform(random, self.gamma));
                    }
                }
            }
        }
        linear.flush(patch);
        patch.clamp();
    }
}

#[derive(Clone, Copy)]
enum Step {
    Add,
    Contrast,
    Multiply,
    Blur,
    Noise,
    Strong,
    Tone,
}

fn factors(range: [f32; 2], each: bool, random: &mut Random) -> [f32; 3] {
    if each { std::array::from_fn(|_| uniform(random, range)) } else { [uniform(random, range); 3] }
}

/// `factor * v + offset` per channel, not yet applied.
struct Linear {
    factor: [f32; 3],
    offset: [f32; 3],
}

impl Linear {
    fn identity() -> Self {
        Linear { factor: [1.0; 3], offset: [0.0; 3] }
    }

    fn then(&mut self, factor: [f32; 3], offset: [f32; 3]) {
        for c in 0..3 {
            self.factor[c] *= factor[c];
            self.offset[c] = self.offset[c] * factor[c] + offset[c];
        }
    }

    fn contrast(&mut self, factor: [f32; 3], about: f32) {
        self.then(factor, factor.map(|f| about - about * f));
    }

    fn flush(&mut self, patch: &mut Patch) {
        if self.factor != [1.0; 3] || self.offset != [0.0; 3] {
            for (plane, (f, o)) in patch.planes_mut().zip(self.factor.iter().zip(&self.offset)) {
                plane.iter_mut().for_each(|v| *v = *v * f + o);
            }
        }
        *self = Linear::identity();
    }
}

/// The mean of all channels, over a part of the pixels.
fn mean(patch: &Patch) -> f32 {
    let (sum, count) = patch.data.iter().step_by(7).fold((0.0f32, 0.0f32), |(s, n), v| (s + v, n + 1.0));
    sum / count.max(1.0)
}

/// Adds approximately Gaussian noise: the sum of four uniform bytes.
fn add_noise(patch: &mut Patch, deviation: f32, random: &mut Random) {
    // Four uniform bytes have the variance 4 * (256^2 - 1) / 12.
    let scale = deviation / 147.8;
    for v in &mut patch.data {
        let bytes = random.random::<u32>().to_le_bytes();
        let sum: i32 = bytes.iter().map(|&b| i32::from(b)).sum();
        *v += (sum - 510) as f32 * scale;
    }
}

/// Rotates the hue by `angle` and multiplies the saturation, both about the grey axis.
fn turn_hue(patch: &mut Patch, angle: f32, saturation: f32) {
    // Rodrigues' rotation about (1, 1, 1) / sqrt 3, then a scaling perpendicular to that axis.
    let (s, c) = angle.sin_cos();
    let third = 1.0 / 3.0;
    let side = s / 3.0f32.sqrt();
    let (same, next, last) = (
        third + saturation * (c * (1.0 - third)),
        third + saturation * (-c * third - side),
        third + saturation * (-c * third + side),
    );
    let pixels = patch.width * patch.height;
    let (red, rest) = patch.data.split_at_mut(pixels);
    let (green, blue) = rest.split_at_mut(pixels);
    for ((r, g), b) in red.iter_mut().zip(green).zip(blue) {
        let (x, y, z) = (*r, *g, *b);
        *r = same * x + next * y + last * z;
        *g = last * x + same * y + next * z;
        *b = next * x + last * y + same * z;
    }
}

/// Raises each value to a power with a lookup table: `powf` on every pixel would cost more than all other changes.
fn raise(patch: &mut Patch, gamma: f32) {
    const STEPS: usize = 255;
    let table: [f32; STEPS + 2] = std::array::from_fn(|i| ((i.min(STEPS)) as f32 / STEPS as f32).powf(gamma));
    for v in &mut patch.data {
        let at = v.clamp(0.0, 1.0) * STEPS as f32;
        let i = at as usize;
        *v = table[i] + (table[i + 1] - table[i]) * (at - i as f32);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::random::stream;

    fn ramp() -> Patch {
        Patch { width: 16, height: 4, data: (0..192).map(|i| (i % 64) as f32 / 64.0).collect() }
    }

    #[test]
    fn none_changes_nothing_and_the_rest_stays_in_range() {
        let mut patch = ramp();
        ColorAugmentation::none().apply(&mut patch, &mut stream(3, 0));
        assert_eq!(patch, ramp());
        for number in 0..200 {
            for set in [
                ColorAugmentation::table_3_2(),
                ColorAugmentation::real_images(),
                ColorAugmentation::renders(),
            ] {
                set.check().unwrap();
                let mut patch = ramp();
                set.apply(&mut patch, &mut stream(3, number));
                assert!(patch.data.iter().all(|v| (0.0..=1.0).contains(v)));
                let mut again = ramp();
                set.apply(&mut again, &mut stream(3, number));
                assert_eq!(patch, again);
            }
        }
    }

    #[test]
    fn grey_has_no_hue_and_120_degrees_permute_the_channels() {
        let mut patch = Patch::filled(2, 2, [0.4; 3]);
        turn_hue(&mut patch, 1.0, 1.7);
        assert!(patch.data.iter().all(|v| (v - 0.4).abs() < 1e-6));
        let mut patch = Patch::filled(1, 1, [0.9, 0.1, 0.3]);
        turn_hue(&mut patch, std::f32::consts::TAU / 3.0, 1.0);
        for (found, expected) in patch.data.iter().zip([0.3, 0.9, 0.1]) {
            assert!((found - expected).abs() < 1e-6, "{:?}", patch.data);
        }
    }

    #[test]
    fn noise_has_its_deviation() {
        let mut patch = Patch::filled(100, 100, [0.5; 3]);
        add_noise(&mut patch, 0.04, &mut stream(5, 0));
        let n = patch.data.len() as f32;
        let variance = patch.data.iter().map(|v| (v - 0.5) * (v - 0.5)).sum::<f32>() / n;
        assert!((variance.sqrt() - 0.04).abs() < 0.001, "{}", variance.sqrt());
    }

    #[test]
    fn ranges_out_of_order_are_named() {
        let wrong = ColorAugmentation { gamma: [2.0, 1.0], ..ColorAugmentation::none() };
        assert!(wrong.check().unwrap_err().to_string().contains("gamma"));
    }
}
