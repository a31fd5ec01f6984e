//! Simulated photographs of a board with exact ground truth: for tests, and to try a camera before buying it.

use rayon::prelude::*;
use sixfold_geometry::random::{normal, stream};
use sixfold_geometry::{Camera, Image, Pose, RgbImage, Vec2, Vec3};

use crate::board::Board;

/// The degradations of a photograph.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Conditions {
    /// Standard deviation of blur, pixels.
    pub blur: f64,
    /// Standard deviation of noise, grey levels.
    pub noise: f64,
    /// Brightness of white paper at the darker and at the brighter side of the image, grey levels.
    pub light: (f64, f64),
    /// Disc on the board that hides tags: centre in the board's frame and radius, metres; zero for none.
    pub hidden: (f64, f64, f64),
}

impl Default for Conditions {
    fn default() -> Self {
        Conditions { blur: 0.6, noise: 2.0, light: (150.0, 220.0), hidden: (0.0, 0.0, 0.0) }
    }
}

/// Samples along a side of a pixel.
const SAMPLES: usize = 4;

/// A photograph of a board by a camera (with its distortion) at a pose. The same seed gives the same image.
pub fn photograph(
    board: &Board,
    camera: &Camera,
    camera_from_board: &Pose,
    conditions: &Conditions,
    seed: u64,
) -> RgbImage {
    let board_from_camera = camera_from_board.inverse();
    let origin = board_from_camera.translation();
    let pixel = |x: usize, y: usize| {
        let mut sum = 0.0;
        for i in 0..SAMPLES * SAMPLES {
            let within = |k: usize| (k as f64 + 0.5) / SAMPLES as f64 - 0.5;
            let pixel = Vec2::new(x as f64 + within(i % SAMPLES), y as f64 + within(i / SAMPLES));
            sum += reflectance(board, camera, &board_from_camera, &origin, &pixel, conditions);
        }
        let (low, high) = conditions.light;
        let light = low + (high - low) * x as f64 / camera.width as f64;
        sum / (SAMPLES * SAMPLES) as f64 * light
    };
    let rows: Vec<Vec<f64>> = (0..camera.height)
        .into_par_iter()
        .map(|y| (0..camera.width).map(|x| pixel(x, y)).collect())
        .collect();
    let sharp = Image::from_fn(camera.width, camera.height, |x, y| rows[y][x]);
    let blurred = blurred(&sharp, conditions.blur);
    let mut rng = stream(seed, 0);
    blurred.map(|level| {
        let noisy = level + conditions.noise * f64::from(normal(&mut rng));
        [noisy.round().clamp(0.0, 255.0) as u8; 3]
    })
}

/// The fraction of light that is reflected along a pixel's ray: white paper 1, ink 0.1, the table 0.4, occluders
/// 0.25.
fn reflectance(
    board: &Board,
    camera: &Camera,
    board_from_camera: &Pose,
    origin: &Vec3,
    pixel: &Vec2,
    conditions: &Conditions,
) -> f64 {
    let Some(p) = camera.undistort_point(pixel) else { return 0.4 };
    let ray = board_from_camera.transform_direction(&camera.unproject(&p, 1.0));
    let distance = -origin.z / ray.z;
    if !(distance > 0.0) {
        return 0.4;
    }
    let hit = origin + ray * distance;
    let (x, y, radius) = conditions.hidden;
    if (hit.x - x).hypot(hit.y - y) < radius {
        return 0.25;
    }
    match board.is_white(hit.x, hit.y) {
        Some(true) => 1.0,
        Some(false) => 0.1,
        None => 0.4,
    }
}

fn blurred(image: &Image<f64>, deviation: f64) -> Image<f64> {
    if deviation <= 0.0 {
        return image.clone();
    }
    let reach = (3.0 * deviation).ceil() as isize;
    let kernel: Vec<f64> = (-reach..=reach).map(|i| (-0.5 * (i as f64 / deviation).powi(2)).exp()).collect();
    let total: f64 = kernel.iter().sum();
    let pass = |image: &Image<f64>, dx: isize, dy: isize| {
        let (width, height) = image.size();
        Image::from_fn(width, height, |x, y| {
            let at = |i: isize| {
                let u = (x as isize + i * dx).clamp(0, width as isize - 1) as usize;
                let v = (y as isize + i * dy).clamp(0, height as isize - 1) as usize;
                image[(u, v)]
            };
            (-reach..=reach).zip(&kernel).map(|(i, k)| k * at(i)).sum::<f64>() / total
        })
    };
    pass(&pass(image, 1, 0), 0, 1)
}
