//! Simulated noise of a depth camera on ideal rendered depth.
//!
//! Axial and lateral noise follow Nguyen, Izadi and Lovell (2012), *Modeling Kinect sensor noise for improved 3D reconstruction
//! and tracking*; disparity quantisation and the loss at grazing angles follow Khoshelham and Elberink (2012) and Handa et al.
//! (2014); the shadow of the projector is in `shadow.rs` (dissertation, section 5.2.1: a camera and an emitter a baseline
//! apart).

use std::sync::LazyLock;

use rand::{Rng, RngExt};
use rayon::prelude::*;
use sixfold_geometry::random::stream;
use sixfold_geometry::{DepthImage, Image, NormalImage};

use crate::shadow::shadow_row;

/// The noise of a structured-light or stereo depth camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthSensor {
    /// Axial noise at `axial_offset` metres: standard deviation in metres.
    pub axial_base: f64,
    /// Growth of the axial noise with the squared distance from `axial_offset`, 1/metres.
    pub axial_growth: f64,
    /// Distance in metres at which the axial noise is smallest.
    pub axial_offset: f64,
    /// Growth of the axial noise with the surface's angle `a` to the view direction: this times
    /// `a^2 / (sqrt(z) (pi/2 - a)^2)` metres is added (Nguyen et al. 2012, equation 3).
    pub axial_angle: f64,
    /// Lateral noise: standard deviation in pixels.
    pub lateral: f64,
    /// Growth of the lateral noise with the surface's angle `a`: this times `a / (pi/2 - a)` pixels is added (Nguyen et
    /// al. 2012, equation 2).
    pub lateral_angle: f64,
    /// Correlation length of the axial noise, pixels: a stereo camera compares windows, so its errors are waves rather than
    /// single pixels. 1 for independent pixels.
    pub correlation: usize,
    /// Distance between projector and camera in metres times focal length in pixels: disparity = this / depth.
    pub baseline_focal: f64,
    /// Whether the projector's shadow is simulated: the projector (or second camera) is to the right of the camera, and surfaces
    /// hidden from it have no depth.
    pub shadow: bool,
    /// Smallest step of the disparity in pixels; 0 for none.
    pub disparity_step: f64,
    /// Surfaces tilted by more than this from the view direction (radians) have no depth.
    pub grazing_angle: f64,
    /// Probability that a pixel on a depth edge has no depth.
    pub edge_loss: f64,
    /// Nearest and farthest depth that is measured, metres.
    pub range: (f64, f64),
    /// Depth resolution of the written file in metres (1 mm for most cameras).
    pub depth_step: f64,
    /// The generator of normally distributed numbers.
    pub draws: Draws,
}

/// The generator of normally distributed numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Draws {
    /// The Box-Muller transform, with a logarithm and two trigonometric functions per pixel. [`DepthSensor::kinect`] keeps using
    /// it, so that its simulations stay the same to the byte.
    BoxMuller,
    /// One of 4096 equally likely quantiles: several times as fast, with no number beyond 3.7 standard deviations.
    Quantiles,
}

impl DepthSensor {
    /// A Kinect v1 / Xtion class camera: the constants of Nguyen et al. (2012), 7.5 cm baseline, 1/8 pixel
    /// disparity steps (Khoshelham and Elberink 2012). Only noise and losses of single pixels; [`DepthSensor::xtion`] also has
    /// the projector's shadow.
    pub fn kinect() -> Self {
        DepthSensor {
            axial_base: 0.0012,
            axial_growth: 0.0019,
            axial_offset: 0.4,
            axial_angle: 0.0,
            lateral: 0.8,
            lateral_angle: 0.0,
            correlation: 1,
            baseline_focal: 0.075 * 575.0,
            shadow: false,
            disparity_step: 0.125,
            grazing_angle: 82f64.to_radians(),
            edge_loss: 0.5,
            range: (0.0, f64::INFINITY),
            depth_step: 0.001,
            draws: Draws::BoxMuller,
        }
    }

    /// A Kinect v1 / Xtion class camera with all of its effects: [`DepthSensor::kinect`] with the shadow of the projector 7.5 cm
    /// to the right, the growth of the noise with the surface's angle (Nguyen et al. 2012, equations 2 and 3), and
    /// the device's range.
    pub fn xtion() -> Self {
        DepthSensor {
            axial_angle: 0.0001,
            lateral_angle: 0.035,
            shadow: true,
            range: (0.4, 8.0),
            draws: Draws::Quantiles,
            ..DepthSensor::kinect()
        }
    }

    /// A RealSense D400 class camera (active stereo, 5 cm baseline): the error grows with the square of the distance as
    /// `z^2 s / (f b)` with `s` = 0.08 pixels of disparity, from the manufacturer's tuning guide; the quadratic growth was
    /// measured by Ahn et al. (2019), *Analysis and noise modeling of the Intel RealSense D435 for mobile robots*. Its errors
    /// are correlated within the matching window; disparities have 1/32 pixel steps.
    pub fn realsense() -> Self {
        let baseline_focal = 0.05 * 600.0;
        DepthSensor {
            axial_base: 0.0005,
            axial_growth: 0.08 / baseline_focal,
            axial_offset: 0.0,
            axial_angle: 0.0001,
            lateral: 1.0,
            lateral_angle: 0.035,
            correlation: 5,
            baseline_focal,
            shadow: true,
            disparity_step: 1.0 / 32.0,
            grazing_angle: 80f64.to_radians(),
            edge_loss: 0.6,
            range: (0.2, 10.0),
            depth_step: 0.001,
            draws: Draws::Quantiles,
        }
    }
}

/// Depth as `sensor` would measure it, from ideal `depth` (metres) and the normals of the same image.
///
/// The same seed gives the same bytes for any number of threads: every row has its own random stream.
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
    let waves = (sensor.correlation > 1).then(|| Waves::new(width, height, sensor.correlation, seed));
    let seen = Seen { depth, normals, sensor, grazing: sensor.grazing_angle.cos() as f32 };
    let rows: Vec<Vec<f32>> = (0..height)
        .into_par_iter()
        .map(|y| {
            let mut random = stream(seed, y as u64);
            let mut row: Vec<f32> = (0..width)
                .map(|x| seen.measure(x, y, waves.as_ref().map(|w| w.at(x, y)), &mut random))
                .collect();
            if sensor.shadow {
                for (z, dark) in row.iter_mut().zip(shadow_row(depth.row(y), sensor.baseline_focal)) {
                    if dark {
                        *z = 0.0;
                    }
                }
            }
            row
        })
        .collect();
    let data = rows.concat();
    Image::from_fn(width, height, |x, y| data[y * width + x])
}

/// The ideal images and the noise to be applied.
struct Seen<'a> {
    depth: &'a DepthImage,
    normals: &'a NormalImage,
    sensor: &'a DepthSensor,
    /// Cosine of the grazing angle.
    grazing: f32,
}

impl Seen<'_> {
    /// Measures one pixel; `wave` is its axial noise in standard deviations if the noise is correlated.
    fn measure(&self, x: usize, y: usize, wave: Option<f64>, random: &mut impl Rng) -> f32 {
        let (depth, normals, sensor) = (self.depth, self.normals, self.sensor);
        let (width, height) = depth.size();
        // The random numbers are drawn first, so that a pixel's noise does not depend on its neighbours' content.
        let ([nx, ny, nz], loss) = sensor.draws.pixel(random);
        let nz = wave.unwrap_or(nz);
        let lateral = match sensor.lateral_angle {
            0.0 => sensor.lateral,
            growth => sensor.lateral + growth * steepness(normals[(x, y)]),
        };
        let shift = |centre: usize, n: f64, size: usize| {
            ((centre as f64 + n * lateral).round().max(0.0) as usize).min(size - 1)
        };
        let (sx, sy) = (shift(x, nx, width), shift(y, ny, height));
        let z = f64::from(depth[(sx, sy)]);
        if z <= 0.0 || z < sensor.range.0 || z > sensor.range.1 {
            return 0.0;
        }
        let n = normals[(sx, sy)];
        // The normal's z is the cosine to the optical axis, close enough to the view ray's here.
        if n[2].abs() < self.grazing {
            return 0.0;
        }
        let low = |v: usize| v.saturating_sub(1);
        let neighbours =
            [(low(sx), sy), ((sx + 1).min(width - 1), sy), (sx, low(sy)), (sx, (sy + 1).min(height - 1))];
        let jump = neighbours.iter().any(|&p| (f64::from(depth[p]) - z).abs() > 0.03);
        if jump && loss < sensor.edge_loss {
            return 0.0;
        }
        let mut sigma = sensor.axial_base + sensor.axial_growth * (z - sensor.axial_offset).powi(2);
        if sensor.axial_angle > 0.0 {
            let steep = steepness(n);
            sigma += sensor.axial_angle * steep * steep / z.sqrt();
        }
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
}

impl Draws {
    /// Three normally distributed numbers and one that is uniform in 0..1.
    fn pixel(self, random: &mut impl Rng) -> ([f64; 3], f64) {
        match self {
            Draws::BoxMuller => {
                let (nx, ny) = gaussian_pair(random);
                let (nz, _) = gaussian_pair(random);
                ([nx, ny, nz], random.random())
            }
            Draws::Quantiles => {
                let bits = random.next_u64();
                let normal = |k: u32| f64::from(QUANTILES[(bits >> (12 * k) & 4095) as usize]);
                ([normal(0), normal(1), normal(2)], (bits >> 36) as f64 / (1u64 << 28) as f64)
            }
        }
    }
}

/// The normal distribution's quantiles at the midpoints of 4096 equal parts.
static QUANTILES: LazyLock<Vec<f32>> = LazyLock::new(|| {
    // The distribution function by the midpoint rule in small steps; each quantile is taken where the distribution function
    // passes its fraction.
    let (mut x, mut below) = (-8.0f64, 0.0f64);
    let step = 1e-4;
    (0..4096)
        .map(|k| {
            let fraction = (f64::from(k) + 0.5) / 4096.0;
            while below < fraction {
                let midpoint = x + 0.5 * step;
                below += step * (-0.5 * midpoint * midpoint).exp() / std::f64::consts::TAU.sqrt();
                x += step;
            }
            x as f32
        })
        .collect()
});

/// `a / (pi/2 - a)` of the angle `a` between a surface and the view direction, limited to the value at 85 degrees.
fn steepness(normal: [f32; 3]) -> f64 {
    f64::from(STEEPNESS[(normal[2].abs().min(1.0) * 1024.0) as usize])
}

/// [`steepness`] tabulated over the cosine in steps of 1/1024.
static STEEPNESS: LazyLock<Vec<f32>> = LazyLock::new(|| {
    (0..=1024)
        .map(|k| {
            let angle = (f64::from(k) / 1024.0).acos().min(85f64.to_radians());
            (angle / (std::f64::consts::FRAC_PI_2 - angle)) as f32
        })
        .collect()
});

/// Correlated noise: random numbers on a grid, interpolated and normalised to a standard deviation of one.
struct Waves {
    step: usize,
    columns: usize,
    knots: Vec<f32>,
}

impl Waves {
    /// Number of the random stream, different from those of the rows.
    const STREAM: u64 = u64::MAX;

    fn new(width: usize, height: usize, step: usize, seed: u64) -> Waves {
        let (columns, rows) = (width / step + 2, height / step + 2);
        let mut random = stream(seed, Waves::STREAM);
        let knots = (0..columns * rows).map(|_| gaussian_pair(&mut random).0 as f32).collect();
        Waves { step, columns, knots }
    }

    fn at(&self, x: usize, y: usize) -> f64 {
        let split = |v: usize| (v / self.step, (v % self.step) as f64 / self.step as f64);
        let ((i, u), (j, v)) = (split(x), split(y));
        let knot = |i: usize, j: usize| f64::from(self.knots[j * self.columns + i]);
        let weights = [(1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v];
        let sum = weights[0] * knot(i, j)
            + weights[1] * knot(i + 1, j)
            + weights[2] * knot(i, j + 1)
            + weights[3] * knot(i + 1, j + 1);
        sum / weights.iter().map(|w| w * w).sum::<f64>().sqrt()
    }
}

/// Two independent standard normal numbers (Box and Muller 1958).
fn gaussian_pair(random: &mut impl Rng) -> (f64, f64) {
    let u: f64 = 1.0 - random.random::<f64>();
    let angle = std::f64::consts::TAU * random.random::<f64>();
    let radius = (-2.0 * u.ln()).sqrt();
    (radius * angle.cos(), radius * angle.sin())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wall at 1.2 m with a board at 0.8 m in front of its centre, 320x240.
    fn scene() -> (DepthImage, NormalImage) {
        let depth = DepthImage::from_fn(320, 240, |x, _| if (120..200).contains(&x) { 0.8 } else { 1.2 });
        (depth, Image::filled(320, 240, [0.0, 0.0, -1.0]))
    }

    #[test]
    fn noise_on_a_wall_has_the_published_deviation() {
        let (width, height) = (640, 480);
        let normals = Image::filled(width, height, [0.0, 0.0, -1.0]);
        for (sensor, z) in
            [(DepthSensor::xtion(), 1.0), (DepthSensor::realsense(), 1.0), (DepthSensor::realsense(), 2.0)]
        {
            let sensor = DepthSensor { disparity_step: 0.0, depth_step: 0.0, ..sensor };
            let depth = DepthImage::filled(width, height, z);
            let measured = simulate_depth(&depth, &normals, &sensor, 4);
            let n = (width * height) as f64;
            let off = |m: &f32| f64::from(*m) - f64::from(z);
            let mean = measured.as_slice().iter().map(off).sum::<f64>() / n;
            let variance = measured.as_slice().iter().map(|m| (off(m) - mean).powi(2)).sum::<f64>() / n;
            let expected =
                sensor.axial_base + sensor.axial_growth * (f64::from(z) - sensor.axial_offset).powi(2);
            assert!((variance.sqrt() / expected - 1.0).abs() < 0.04, "{} {expected}", variance.sqrt());
            assert!(mean.abs() < 0.1 * expected, "{mean}");
        }
    }

    #[test]
    fn the_projector_casts_a_shadow_of_the_disparity_difference() {
        let (depth, normals) = scene();
        let sensor = DepthSensor { lateral: 0.0, lateral_angle: 0.0, edge_loss: 0.0, ..DepthSensor::xtion() };
        let measured = simulate_depth(&depth, &normals, &sensor, 1);
        // The wall's points left of the board are hidden from a projector on the right.
        let width = sensor.baseline_focal * (1.0 / 0.8 - 1.0 / 1.2);
        let dark = (0..320).filter(|&x| measured[(x, 100)] == 0.0).collect::<Vec<_>>();
        assert!((dark.len() as f64 - width).abs() < 1.5, "{dark:?}, expected {width}");
        assert!(dark.iter().all(|x| (100..120).contains(x)), "{dark:?}");
        let none = simulate_depth(&depth, &normals, &DepthSensor { shadow: false, ..sensor }, 1);
        assert!(none.as_slice().iter().all(|&z| z > 0.0));
    }

    #[test]
    fn disparities_come_in_steps_and_grazing_surfaces_are_lost() {
        let depth = DepthImage::from_fn(200, 20, |x, _| 2.0 + 0.002 * x as f32);
        let normals = Image::filled(200, 20, [0.0, 0.0, -1.0]);
        let sensor = DepthSensor {
            axial_base: 0.0,
            axial_growth: 0.0,
            axial_angle: 0.0,
            depth_step: 0.0,
            ..DepthSensor::xtion()
        };
        let measured = simulate_depth(&depth, &normals, &sensor, 1);
        for &z in measured.as_slice().iter().filter(|z| **z > 0.0) {
            let steps = sensor.baseline_focal / f64::from(z) / sensor.disparity_step;
            assert!((steps - steps.round()).abs() < 1e-3, "{z}");
        }
        let steep = Image::filled(200, 20, [0.999, 0.0, -0.045]);
        assert!(simulate_depth(&depth, &steep, &sensor, 1).as_slice().iter().all(|&z| z == 0.0));
        let near = depth.map(|z| z * 0.1);
        assert!(simulate_depth(&near, &normals, &sensor, 1).as_slice().iter().all(|&z| z == 0.0));
    }

    #[test]
    fn same_seed_same_bytes_at_any_number_of_threads() {
        let (depth, normals) = scene();
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| simulate_depth(&depth, &normals, &DepthSensor::realsense(), 9))
        };
        assert_eq!(with(1), with(3));
        assert_ne!(with(1), simulate_depth(&depth, &normals, &DepthSensor::realsense(), 10));
    }
}
