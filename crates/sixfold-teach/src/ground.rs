//! A textured ground for simulated photographs without a board: a cloth with discs and rectangles of many sizes and colours.

use rayon::prelude::*;
use sixfold_geometry::random::{Random, stream, uniform};
use sixfold_geometry::{RgbImage, Vec2};

/// Number of shapes per 1000 x 1000 pixels.
const SHAPES: f64 = 900.0;
/// Smallest and largest half side of a shape, as a fraction of the image's side.
const SIZES: [f32; 2] = [0.002, 0.03];

struct Shape {
    centre: Vec2,
    along: Vec2,
    half: [f64; 2],
    round: bool,
    color: [u8; 3],
}

impl Shape {
    fn new(random: &mut Random, side: f64) -> Shape {
        let mut number = |range: [f32; 2]| f64::from(uniform(random, range));
        let centre = Vec2::new(number([0.0, 1.0]), number([0.0, 1.0])) * side;
        let angle = number([0.0, std::f32::consts::TAU]);
        let mut half = || side * number([SIZES[0].ln(), SIZES[1].ln()]).exp();
        let half = [half(), half()];
        let round = number([0.0, 1.0]) < 0.4;
        let grey = number([20.0, 235.0]);
        let color = [0, 1, 2].map(|_| (grey + number([-30.0, 30.0])).clamp(0.0, 255.0) as u8);
        Shape { centre, along: Vec2::new(angle.cos(), angle.sin()), half, round, color }
    }

    fn holds(&self, point: &Vec2) -> bool {
        let d = point - self.centre;
        let (u, v) = (d.dot(&self.along) / self.half[0], d.perp(&self.along) / self.half[1]);
        if self.round { u * u + v * v < 1.0 } else { u.abs() < 1.0 && v.abs() < 1.0 }
    }
}

/// A square image of shapes. Same seed, same image.
pub fn patterned(side: usize, seed: u64) -> RgbImage {
    let mut random = stream(seed, 77);
    let count = (SHAPES * (side * side) as f64 / 1e6).ceil() as usize;
    let shapes: Vec<Shape> = (0..count).map(|_| Shape::new(&mut random, side as f64)).collect();
    let row = |y: usize| {
        let y = y as f64;
        let near: Vec<&Shape> =
            shapes.iter().filter(|s| (s.centre.y - y).abs() < s.half[0].hypot(s.half[1])).collect();
        let color = move |x: usize| {
            // The last shape is on top.
            let at = near.iter().rev().find(|s| s.holds(&Vec2::new(x as f64, y)));
            at.map_or([170, 160, 140], |s| s.color)
        };
        (0..side).map(color)
    };
    let pixels: Vec<[u8; 3]> = (0..side).into_par_iter().flat_map_iter(row).collect();
    RgbImage::from_vec(side, side, pixels).unwrap_or_else(|_| RgbImage::filled(side, side, [0; 3]))
}
