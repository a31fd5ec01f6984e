//! Locally optimised RANSAC (Chum, Matas and Kittler 2003; Lebeda, Matas and Chum 2012) over the truncated cost of
//! MSAC (Torr and Zisserman 2000), with the sequential test of Chum and Matas (2008), which rejects a bad pose after few
//! points.

use rand::{RngExt, SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;

use super::ap3p::ap3p;
use super::refine::{RefineOptions, refine};
use super::{Model, PnpOptions, Prepared, epnp};
use crate::{Pose, Vec2, Vec3};

/// Number of correspondences that are evaluated together.
const BLOCK: usize = 32;
/// A pose is rejected when its residuals are this much more likely under a wrong pose than under a good one.
const DECISION: f64 = 100.0;

/// Poses from a minimal sample.
pub(super) trait Kernel {
    /// Correspondences in a sample.
    const SAMPLE_SIZE: usize;
    /// Writes the poses that explain the sample; returns how many.
    fn generate(sample: &[(Vec3, Vec2)], out: &mut [Model; 4]) -> usize;
}

/// Three points, Ke and Roumeliotis (2017).
pub(super) struct Ap3pKernel;

impl Kernel for Ap3pKernel {
    const SAMPLE_SIZE: usize = 3;
    fn generate(sample: &[(Vec3, Vec2)], out: &mut [Model; 4]) -> usize {
        let rays = std::array::from_fn(|i| sample[i].1.push(1.0).normalize());
        let points = std::array::from_fn(|i| sample[i].0);
        ap3p(&rays, &points, out)
    }
}

/// Five points, Lepetit et al. (2009); five as in OpenCV's RANSAC, which the dissertation used.
pub(super) struct EpnpKernel;

impl Kernel for EpnpKernel {
    const SAMPLE_SIZE: usize = 5;
    fn generate(sample: &[(Vec3, Vec2)], out: &mut [Model; 4]) -> usize {
        let Some(model) = epnp::solve(sample.len(), |i| sample[i]) else { return 0 };
        out[0] = model;
        1
    }
}

/// The result of the search.
pub(super) struct Found {
    /// The pose for points relative to their centroid.
    pub pose: Pose,
    pub iterations: usize,
}

/// Searches; `None` when no pose has more support than its own sample.
pub(super) fn search<K: Kernel>(data: &Prepared, options: &PnpOptions) -> Option<Found> {
    let n = data.points.len();
    let mut random = ChaCha8Rng::seed_from_u64(options.seed);
    let blocks = Blocks::new(data, options.threshold_px, &mut random);
    let local = RefineOptions {
        threshold_px: options.threshold_px,
        max_iterations: options.local_iterations,
        convergence: 1e-3,
    };
    let mut test = SequentialTest::new();
    let mut best: Option<(f64, Pose)> = None;
    // The best pose directly from a sample: every sample that is better gets a local optimisation.
    let mut best_sampled = f32::INFINITY;
    let mut models = [Model::IDENTITY; 4];
    let mut sample = [(Vec3::zeros(), Vec2::zeros()); 8];
    let mut chosen = [0usize; 8];
    let mut needed = options.max_iterations;
    let mut iterations = 0;
    while iterations < needed.max(options.min_iterations).min(options.max_iterations) {
        iterations += 1;
        let size = K::SAMPLE_SIZE.min(n);
        for k in 0..size {
            chosen[k] = loop {
                let i = random.random_range(0..n);
                if !chosen[..k].contains(&i) {
                    break i;
                }
            };
            sample[k] = (data.points[chosen[k]], data.rays[chosen[k]]);
        }
        let count = K::generate(&sample[..size], &mut models);
        for model in &models[..count] {
            let Some((cost, inliers)) = blocks.cost(model, best_sampled, &mut test) else { continue };
            if inliers <= size {
                continue;
            }
            best_sampled = cost;
            let pose = model.pose();
            let (pose, cost, inliers) = if options.local_iterations > 0 {
                let wide =
                    RefineOptions { threshold_px: 2.0 * local.threshold_px, max_iterations: 2, ..local };
                let pose = refine(data, &pose, &wide).camera_from_object;
                let refined = refine(data, &pose, &local);
                (refined.camera_from_object, refined.cost, refined.inlier_count)
            } else {
                (pose, f64::from(cost), inliers)
            };
            if best.is_none_or(|b| cost < b.0) {
                best = Some((cost, pose));
                let fraction = inliers as f64 / n as f64;
                test.good = fraction.clamp(0.05, 0.95);
                needed = samples_needed(fraction, size, options.confidence, options.max_iterations);
            }
        }
    }
    best.map(|(_, pose)| Found { pose, iterations })
}

/// Samples after which one without outliers was drawn with probability `confidence` (Fischler and Bolles 1981).
fn samples_needed(fraction: f64, size: usize, confidence: f64, most: usize) -> usize {
    let clean = fraction.powi(size as i32);
    let needed = (1.0 - confidence).ln() / (1.0 - clean).ln();
    if needed.is_finite() {
        (needed.ceil() as usize).clamp(1, most)
    } else if clean > 0.5 {
        1
    } else {
        most
    }
}

/// The likelihoods of Chum and Matas (2008): a point fits a good pose with probability `good`, a wrong one with
/// `wrong`, which is the mean over the poses rejected so far.
struct SequentialTest {
    good: f64,
    wrong_inliers: f64,
    wrong_points: f64,
}

impl SequentialTest {
    fn new() -> Self {
        SequentialTest { good: 0.1, wrong_inliers: 2.0, wrong_points: 100.0 }
    }
}

/// The correspondences in random order, in single precision, in blocks that the compiler vectorises.
struct Blocks {
    blocks: Vec<Block>,
    count: usize,
    limit: f32,
    fx: f64,
    fy: f64,
}

#[derive(Clone)]
struct Block {
    x: [f32; BLOCK],
    y: [f32; BLOCK],
    z: [f32; BLOCK],
    u: [f32; BLOCK],
    v: [f32; BLOCK],
}

impl Blocks {
    fn new(data: &Prepared, threshold_px: f64, random: &mut ChaCha8Rng) -> Self {
        let mut order: Vec<usize> = (0..data.points.len()).collect();
        order.shuffle(random);
        let blocks = order
            .chunks(BLOCK)
            .map(|chunk| {
                // The padding of the last block never fits a pose.
                let mut block = Block {
                    x: [0.0; BLOCK],
                    y: [0.0; BLOCK],
                    z: [0.0; BLOCK],
                    u: [1e15; BLOCK],
                    v: [1e15; BLOCK],
                };
                for (k, &i) in chunk.iter().enumerate() {
                    let (p, m) = (&data.points[i], &data.rays[i]);
                    block.x[k] = p.x as f32;
                    block.y[k] = p.y as f32;
                    block.z[k] = p.z as f32;
                    block.u[k] = (m.x * data.camera.fx) as f32;
                    block.v[k] = (m.y * data.camera.fy) as f32;
                }
                block
            })
            .collect();
        Blocks {
            blocks,
            count: data.points.len(),
            limit: (threshold_px * threshold_px) as f32,
            fx: data.camera.fx,
            fy: data.camera.fy,
        }
    }

    /// Truncated cost and number of inliers, `None` as soon as the cost must exceed `most` or the sequential test
    /// rejects the pose.
    fn cost(&self, model: &Model, most: f32, test: &mut SequentialTest) -> Option<(f32, usize)> {
        let (r, t) = (&model.rotation, &model.translation);
        let row =
            |i: usize, f: f64| [r[(i, 0)] * f, r[(i, 1)] * f, r[(i, 2)] * f, t[i] * f].map(|v| v as f32);
        let rows = [row(0, self.fx), row(1, self.fy), row(2, 1.0)];
        let inlier = (test.wrong() / test.good).ln();
        let outlier = ((1.0 - test.wrong()) / (1.0 - test.good)).ln();
        let decision = DECISION.ln();
        // The padding counts as misses; subtract it at once, otherwise it would count towards the bound.
        let padding = self.blocks.len() * BLOCK - self.count;
        let mut cost = -(padding as f32) * self.limit;
        let mut inliers = 0;
        for (k, block) in self.blocks.iter().enumerate() {
            let (c, i) = block.cost(&rows, self.limit);
            cost += c;
            inliers += i;
            if cost >= most {
                return None;
            }
            let seen = ((k + 1) * BLOCK).min(self.count);
            let ratio = inliers as f64 * inlier + (seen - inliers) as f64 * outlier;
            if ratio > decision {
                test.wrong_inliers += inliers as f64;
                test.wrong_points += seen as f64;
                return None;
            }
        }
        (cost < most).then_some((cost, inliers))
    }
}

impl SequentialTest {
    fn wrong(&self) -> f64 {
        (self.wrong_inliers / self.wrong_points).clamp(0.005, 0.7 * self.good)
    }
}

impl Block {
    #[inline]
    fn cost(&self, m: &[[f32; 4]; 3], limit: f32) -> (f32, usize) {
        let mut squares = [0.0f32; BLOCK];
        for (k, out) in squares.iter_mut().enumerate() {
            let (x, y, z) = (self.x[k], self.y[k], self.z[k]);
            let px = m[0][0] * x + m[0][1] * y + m[0][2] * z + m[0][3];
            let py = m[1][0] * x + m[1][1] * y + m[1][2] * z + m[1][3];
            let pz = m[2][0] * x + m[2][1] * y + m[2][2] * z + m[2][3];
            let inverse = 1.0 / pz;
            let (du, dv) = (px * inverse - self.u[k], py * inverse - self.v[k]);
            let square = du * du + dv * dv;
            // Also false for NaN.
            *out = if (square < limit) & (pz > 0.0) { square } else { limit };
        }
        let mut lanes = [0.0f32; 8];
        let mut inliers = [0u32; 8];
        for chunk in squares.chunks_exact(8) {
            for k in 0..8 {
                lanes[k] += chunk[k];
                inliers[k] += u32::from(chunk[k] < limit);
            }
        }
        (lanes.iter().sum(), inliers.iter().sum::<u32>() as usize)
    }
}
