//! Procedural textures for users without photographs: value noise in octaves, gradients, stripes, checks and scattered
//! shapes, coloured at random.

use rand::RngExt;
use sixfold_geometry::random::{Random, uniform};

use super::coverage::Coverage;
use super::noise::{add_noise, value_noise};
use super::patch::Patch;
use super::shapes::Shape;

/// Noise in octaves, about 0..1, with a random slope of its spectrum.
fn fractal(width: usize, height: usize, random: &mut Random) -> Vec<f32> {
    let mut out = vec![0.0; width * height];
    let persistence = uniform(random, [0.35, 0.85]);
    let octaves = random.random_range(2..6);
    let mut cells = random.random_range(1..5usize);
    let (mut weight, mut sum) = (1.0, 0.0);
    for _ in 0..octaves {
        if cells * 2 > width.max(4) {
            break;
        }
        add_noise(&mut out, width, height, cells, weight, random);
        sum += weight;
        weight *= persistence;
        cells = cells * 2 + random.random_range(0..2usize);
    }
    // A sum of octaves is concentrated around one half: stretch it.
    let scale = 1.0 / f32::max(sum, 1e-6);
    out.iter_mut().for_each(|v| *v = ((*v * scale - 0.5) * 1.7 + 0.5).clamp(0.0, 1.0));
    out
}

fn color(random: &mut Random) -> [f32; 3] {
    let grey = random.random::<f32>();
    let vivid = random.random::<f32>() * random.random::<f32>();
    std::array::from_fn(|_| (grey + vivid * (random.random::<f32>() - 0.5) * 2.0).clamp(0.0, 1.0))
}

/// A plane of numbers in 0..1 coloured from `low` to `high`.
fn colored(plane: &[f32], width: usize, height: usize, low: [f32; 3], high: [f32; 3]) -> Patch {
    let mut data = Vec::with_capacity(3 * plane.len());
    for c in 0..3 {
        data.extend(plane.iter().map(|v| low[c] + (high[c] - low[c]) * v));
    }
    Patch { width, height, data }
}

/// A texture of random kind and colours.
pub fn procedural_texture(width: usize, height: usize, random: &mut Random) -> Patch {
    let mut patch = layer(width, height, random);
    // A second texture shows through where slow noise is high.
    if random.random::<f32>() < 0.5 {
        let other = layer(width, height, random);
        let sharp = uniform(random, [1.0, 12.0]);
        let mut data = value_noise(width, height, random.random_range(1..6), random);
        data.iter_mut().for_each(|v| *v = ((*v - 0.5) * sharp + 0.5).clamp(0.0, 1.0));
        patch.blend(&other, &Coverage { width, height, data });
    }
    // Scattered shapes: edges and corners as on a cluttered desk.
    for _ in 0..random.random_range(0..5u32) {
        let shape = Shape::random(random);
        let side = width.max(height) as f32;
        let centre = [random.random::<f32>() * width as f32, random.random::<f32>() * height as f32];
        let mut cover = shape.draw(width, height, centre, side * uniform(random, [0.03, 0.3]));
        let strength = uniform(random, [0.4, 1.0]);
        cover.data.iter_mut().for_each(|v| *v *= strength);
        let (a, b) = (color(random), color(random));
        let fill = if random.random() {
            Patch::filled(width, height, a)
        } else {
            let noise = value_noise(width, height, random.random_range(1..12), random);
            colored(&noise, width, height, a, b)
        };
        patch.blend(&fill, &cover);
    }
    patch
}

fn layer(width: usize, height: usize, random: &mut Random) -> Patch {
    let (low, high) = (color(random), color(random));
    let angle = uniform(random, [0.0, std::f32::consts::TAU]);
    let (s, c) = angle.sin_cos();
    let side = width.max(height).max(1) as f32;
    match random.random_range(0..10u32) {
        0..=4 => {
            let mut patch = colored(&fractal(width, height, random), width, height, low, high);
            if random.random::<f32>() < 0.4 {
                // Separate noise for each channel, which makes it colourful.
                let amount = uniform(random, [0.1, 0.5]);
                let pixels = width * height;
                for channel in 0..3 {
                    let noise = value_noise(width, height, random.random_range(2..20), random);
                    let plane = &mut patch.data[channel * pixels..(channel + 1) * pixels];
                    plane.iter_mut().zip(&noise).for_each(|(v, n)| *v += amount * (n - 0.5));
                }
                patch.clamp();
            }
            patch
        }
        5 | 6 => {
            let ramp = Coverage::from_fn(width, height, |x, y| {
                ((c * x as f32 + s * y as f32) / side * 0.7 + 0.5).clamp(0.0, 1.0)
            });
            colored(&ramp.data, width, height, low, high)
        }
        7 => {
            let period = side * uniform(random, [0.04, 0.4]);
            let sharp = uniform(random, [1.0, 6.0]);
            let stripes = Coverage::from_fn(width, height, |x, y| {
                let t = ((c * x as f32 + s * y as f32) / period).rem_euclid(1.0);
                ((((t - 0.5).abs() - 0.25) * 2.0 * sharp) + 0.5).clamp(0.0, 1.0)
            });
            colored(&stripes.data, width, height, low, high)
        }
        8 => {
            let period = side * uniform(random, [0.06, 0.3]);
            let checks = Coverage::from_fn(width, height, |x, y| {
                let (u, v) = (c * x as f32 + s * y as f32, c * y as f32 - s * x as f32);
                f32::from(((u / period).floor() + (v / period).floor()).rem_euclid(2.0) < 1.0)
            });
            colored(&checks.data, width, height, low, high)
        }
        _ => Patch::filled(width, height, low),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::random::stream;

    #[test]
    fn textures_are_valid_different_and_repeatable() {
        let mut varied = 0;
        for number in 0..100 {
            let patch = procedural_texture(40, 24, &mut stream(1, number));
            assert_eq!(patch.data.len(), 3 * 40 * 24);
            assert!(patch.data.iter().all(|v| (-1e-5..=1.00001).contains(v)));
            assert_eq!(patch, procedural_texture(40, 24, &mut stream(1, number)));
            let mean = patch.data.iter().sum::<f32>() / patch.data.len() as f32;
            varied += usize::from(patch.data.iter().any(|v| (v - mean).abs() > 0.1));
        }
        assert!(varied > 70, "{varied}");
    }
}
