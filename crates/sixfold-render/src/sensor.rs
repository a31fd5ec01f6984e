//! A depth camera's noise on rendered depth: what an ideal depth image lacks.
//!
//! Axial and lateral noise after Nguyen, Izadi and Lovell (2012), *Modeling Kinect sensor noise for improved 3D
//! reconstruction and tracking*; disparity quantisation and the loss at grazing angles after Khoshelham and
//! Elberink (2012) and Handa et al. (2014).

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use sixfold_geometry::{DepthImage, Image, NormalImage};

/// The noise of a structured-light or stereo depth camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthSensor {
    /// Axial noise at `axial_offset` metres: standard deviation in metres.
    pub axial_base: f64,
    /// Growth of the axial noise with the squared distance from `axial_offset`, 1/metres.
    pub axial_growth: f64,
    /// Distance in metres at which the axial noise is smallest.
    pub axial_offset: f64,
    /// Lateral noise: standard deviation in pixels.
    pub lateral: f64,
    /// Distance between projector and camera in metres times focal length in pixels: disparity = this / depth.
    pub baseline_focal: f64,
    /// Smallest step of the disparity in pixels; 0 for none.
    pub disparity_step: f64,
    /// Surfaces tilted more than this from the view direction (radians) return nothing.
    pub grazing_angle: f64,
    /// Chance that a pixel on a depth edge returns nothing.
    pub edge_loss: f64,
    /// Depth steps in metres of the file written (1 mm for most cameras).
    pub depth_step: f64,
}

impl DepthSensor {
    /// A Kinect v1 / Xtion class camera: the constants of Nguyen et al. (2012), 7.5 cm baseline, 1/8 pixel
    /// disparity steps (Khoshelham and Elberink 2012).
    pub fn kinect() -> Self {
        DepthSensor {
            axial_base: 0.0012,
            axial_growth: 0.0019,
            axial_offset: 0.4,
            lateral: 0.8,
            baseline_focal: 0.075 * 575.0,
            disparity_step: 0.125,
            grazing_angle: 82f64.to_radians(),
            edge_loss: 0.5,
            depth_step: 0.001,
        }
    }
}

/// Depth as `sensor` would measure it, from ideal `depth` (metres) and the normals of the same image.
///
/// The same seed gives the same bytes at any number of threads: every row draws from its own stream.
///
/// # Panics
/// When the two images have different sizes.
pub fn simulate_depth(
    depth: &DepthImage,
    normals: &NormalImage,
    sensor: &DepthSensor,
    seed: u64,
) -> DepthImage {
    assert_eq!(depth.size(), normals.size(), "depth and normals of different sizes");
    let (width, height) = depth.size();
    let rows: Vec<Vec<f32>> = (0..height)
        .into_par_iter()
        .map(|y| {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            random.set_stream(y as u64);
            (0..width).map(|x| measure(depth, normals, sensor, x, y, &mut random)).collect()
        })
        .collect();
    let data = rows.concat();
    Image::from_fn(width, height, |x, y| data[y * width + x])
}

fn measure(
    depth: &DepthImage,
    normals: &NormalImage,
    sensor: &DepthSensor,
    x: usize,
    y: usize,
    random: &mut impl Rng,
) -> f32 {
    let (width, height) = depth.size();
    // The draws come first, so that a pixel's noise does not depend on what its neighbours show.
    let (nx, ny) = gaussian_pair(random);
    let (nz, _) = gaussian_pair(random);
    let loss: f64 = random.random();
    let shift = |centre: usize, n: f64, size: usize| {
        ((centre as f64 + n * sensor.lateral).round().max(0.0) as usize).min(size - 1)
    };
    let (sx, sy) = (shift(x, nx, width), shift(y, ny, height));
    let z = f64::from(depth[(sx, sy)]);
    if z <= 0.0 {
        return 0.0;
    }
    let n = normals[(sx, sy)];
    // The normal's z is the cosine to the optical axis, close enough to the view ray's here.
    if f64::from(n[2].abs()) < sensor.grazing_angle.cos() {
        return 0.0;
    }
    let low = |v: usize| v.saturating_sub(1);
    let neighbours =
        [(low(sx), sy), ((sx + 1).min(width - 1), sy), (sx, low(sy)), (sx, (sy + 1).min(height - 1))];
    let jump = neighbours.iter().any(|&p| (f64::from(depth[p]) - z).abs() > 0.03);
    if jump && loss < sensor.edge_loss {
        return 0.0;
    }
    let sigma = sensor.axial_base + sensor.axial_growth * (z - sensor.axial_offset).powi(2);
    let mut measured = z + nz * sigma;
    if sensor.disparity_step > 0.0 && measured > 0.0 {
        let disparity = sensor.baseline_focal / measured;
        let steps = (disparity / sensor.disparity_step).round().max(1.0);
        measured = sensor.baseline_focal / (steps * sensor.disparity_step);
    }
    if sensor.depth_step > 0.0 {
        measured = (measured / sensor.depth_step).round() * sensor.depth_step;
    }
    measured.max(0.0) as f32
}

/// Two independent standard normal numbers (Box and Muller 1958).
fn gaussian_pair(random: &mut impl Rng) -> (f64, f64) {
    let u: f64 = 1.0 - random.random::<f64>();
    let angle = std::f64::consts::TAU * random.random::<f64>();
    let radius = (-2.0 * u.ln()).sqrt();
    (radius * angle.cos(), radius * angle.sin())
}
