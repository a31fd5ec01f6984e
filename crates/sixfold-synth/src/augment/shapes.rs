//! Shapes that hide a chosen fraction of an object (dissertation, table 3.3): rectangles, ellipses, polygons, blobs and
//! straight edges.
//!
//! Every shape is defined by a level function that increases outwards from its centre: a pixel is inside the shape of
//! size `s` if its level is at most `s`. The size that hides a given fraction is therefore a quantile of the levels
//! over the object's pixels, and no search is needed.

use rand::RngExt;
use sixfold_geometry::random::{Random, uniform};

use super::coverage::Coverage;

/// A shape about a centre, without its size.
#[derive(Debug, Clone, PartialEq)]
pub enum Shape {
    /// A rotated rectangle of the given side ratio.
    Rectangle {
        /// Cosine and sine of its rotation.
        turn: [f32; 2],
        /// Half sides at size 1.
        half: [f32; 2],
    },
    /// A rotated ellipse.
    Ellipse {
        /// Cosine and sine of its rotation.
        turn: [f32; 2],
        /// Half axes at size 1.
        half: [f32; 2],
    },
    /// A convex polygon: unit normals of its sides and their distances at size 1.
    Polygon {
        /// `[normal_x, normal_y, 1 / distance]` per side.
        sides: Vec<[f32; 3]>,
    },
    /// A star-shaped blob: its radius is `1 + sum of a_k cos(k t) + b_k sin(k t)` for k = 1, 2, ...
    Blob {
        /// `[a_k, b_k]`; the sum of their absolute values is below 1.
        waves: Vec<[f32; 2]>,
    },
    /// Everything on one side of a line through the centre.
    Edge {
        /// Unit normal.
        normal: [f32; 2],
    },
}

impl Shape {
    /// A shape of a random kind.
    pub fn random(random: &mut Random) -> Shape {
        let angle = uniform(random, [0.0, std::f32::consts::TAU]);
        let turn = [angle.cos(), angle.sin()];
        let half = [1.0, uniform(random, [0.25, 1.0])];
        match random.random_range(0..10u32) {
            0 | 1 => Shape::Rectangle { turn: if random.random() { turn } else { [1.0, 0.0] }, half },
            2 | 3 => Shape::Ellipse { turn, half },
            4 | 5 => {
                let count = random.random_range(3..8usize);
                let sides = (0..count)
                    .map(|i| {
                        let step = std::f32::consts::TAU / count as f32;
                        let a = angle + step * (i as f32 + uniform(random, [-0.3, 0.3]));
                        [a.cos(), a.sin(), 1.0 / uniform(random, [0.5, 1.0])]
                    })
                    .collect();
                Shape::Polygon { sides }
            }
            6..=8 => {
                let waves =
                    (1..6).map(|k| [0, 1].map(|_| uniform(random, [-0.45, 0.45]) / k as f32 * 0.6)).collect();
                Shape::Blob { waves }
            }
            _ => Shape::Edge { normal: turn },
        }
    }

    /// The smallest size at which the shape reaches a point that lies `(dx, dy)` from its centre.
    pub fn level(&self, dx: f32, dy: f32) -> f32 {
        match self {
            Shape::Rectangle { turn, half } => {
                let (u, v) = (turn[0] * dx + turn[1] * dy, turn[0] * dy - turn[1] * dx);
                (u.abs() / half[0]).max(v.abs() / half[1])
            }
            Shape::Ellipse { turn, half } => {
                let u = (turn[0] * dx + turn[1] * dy) / half[0];
                let v = (turn[0] * dy - turn[1] * dx) / half[1];
                (u * u + v * v).sqrt()
            }
            Shape::Polygon { sides } => {
                sides.iter().map(|s| (s[0] * dx + s[1] * dy) * s[2]).fold(f32::NEG_INFINITY, f32::max)
            }
            Shape::Blob { waves } => {
                let r = (dx * dx + dy * dy).sqrt();
                if r < 1e-6 {
                    return 0.0;
                }
                let (c, s) = (dx / r, dy / r);
                // cos(k t) and sin(k t) by multiplying with (c, s).
                let (mut ck, mut sk) = (c, s);
                let mut radius = 1.0;
                for [a, b] in waves {
                    radius += a * ck + b * sk;
                    (ck, sk) = (ck * c - sk * s, ck * s + sk * c);
                }
                r / radius.max(0.05)
            }
            Shape::Edge { normal } => normal[0] * dx + normal[1] * dy,
        }
    }

    /// Draws the shape with a size and centre, with an edge about one pixel wide.
    pub fn draw(&self, width: usize, height: usize, centre: [f32; 2], size: f32) -> Coverage {
        Coverage::from_fn(width, height, |x, y| {
            let level = self.level(x as f32 - centre[0], y as f32 - centre[1]);
            // Levels are in pixels along the longest axis.
            (size - level + 0.5).clamp(0.0, 1.0)
        })
    }
}

/// A shape about `centre` that hides `fraction` of `visible`. `None` when nothing is visible or the fraction is less
/// than a pixel.
pub fn occluder_of_fraction(
    shape: &Shape,
    centre: [f32; 2],
    visible: &Coverage,
    fraction: f32,
) -> Option<Coverage> {
    let width = visible.width.max(1);
    // Every third pixel of every second row is enough for a quantile.
    let mut levels = Vec::with_capacity(visible.data.len() / 6 + 1);
    for (y, row) in visible.data.chunks_exact(width).enumerate().step_by(2) {
        for (x, v) in row.iter().enumerate().skip(y / 2 % 3).step_by(3) {
            if *v > 0.5 {
                levels.push(shape.level(x as f32 - centre[0], y as f32 - centre[1]));
            }
        }
    }
    let count = (levels.len() as f32 * fraction.clamp(0.0, 1.0)) as usize;
    if count == 0 {
        return None;
    }
    let (_, size, _) = levels.select_nth_unstable_by(count - 1, f32::total_cmp);
    Some(shape.draw(visible.width, visible.height, centre, *size))
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::random::stream;

    #[test]
    fn shapes_hide_the_requested_fraction() {
        let disc =
            Coverage::from_fn(96, 96, |x, y| f32::from((x as f32 - 48.0).hypot(y as f32 - 40.0) < 30.0));
        for number in 0..300 {
            let mut random = stream(7, number);
            let shape = Shape::random(&mut random);
            let centre = [uniform(&mut random, [20.0, 76.0]), uniform(&mut random, [10.0, 70.0])];
            let fraction = uniform(&mut random, [0.04, 0.5]);
            let cover = occluder_of_fraction(&shape, centre, &disc, fraction).unwrap();
            let mut left = disc.clone();
            left.remove(&cover);
            let hidden = 1.0 - left.area() / disc.area();
            assert!((hidden - fraction).abs() < 0.06, "{shape:?} {centre:?}: {hidden} instead of {fraction}");
        }
    }

    #[test]
    fn nothing_to_hide() {
        let empty = Coverage::filled(8, 8, 0.0);
        let shape = Shape::Edge { normal: [1.0, 0.0] };
        assert!(occluder_of_fraction(&shape, [4.0, 4.0], &empty, 0.5).is_none());
        let none = Coverage { width: 0, height: 0, data: vec![] };
        assert!(occluder_of_fraction(&shape, [0.0, 0.0], &none, 0.5).is_none());
    }
}
