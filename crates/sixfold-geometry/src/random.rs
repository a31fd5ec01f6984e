//! Random numbers: one ChaCha stream per sample, so that a sample depends only on the seed and its number.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The random generator of all crates.
pub type Random = ChaCha8Rng;

/// The generator of sample `number` under `seed`: the same numbers on any thread and machine.
pub fn stream(seed: u64, number: u64) -> Random {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(number);
    random
}

/// Uniform between the two ends of `range`; the first end if they are equal or not in order.
pub fn uniform(random: &mut Random, range: [f32; 2]) -> f32 {
    range[0] + (range[1] - range[0]).max(0.0) * random.random::<f32>()
}

/// A number of the standard normal distribution (Box, Muller 1958).
pub fn normal(random: &mut impl Rng) -> f32 {
    let (u, v): (f32, f32) = (1.0 - random.random::<f32>(), random.random());
    (-2.0 * u.ln()).sqrt() * (std::f32::consts::TAU * v).cos()
}
