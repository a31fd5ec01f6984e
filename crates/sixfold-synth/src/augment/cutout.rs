//! Cut-out images of objects, pasted behind an object as clutter or in front of it as occluders.

use rand::RngExt;
use sixfold_geometry::random::{Random, uniform};
use sixfold_geometry::{Mask, RgbImage};

use super::coverage::Coverage;
use super::patch::Patch;

/// A small image with coverage, 8 bits each.
#[derive(Debug, Clone, PartialEq)]
pub struct Cutout {
    width: usize,
    height: usize,
    /// Red, green, blue, coverage.
    pixels: Vec<[u8; 4]>,
}

impl Cutout {
    /// The pixels of `image` in `mask`, cropped to their box; `None` when the mask is empty or of another size.
    pub fn new(image: &RgbImage, mask: &Mask) -> Option<Cutout> {
        if image.size() != mask.size() {
            return None;
        }
        let (mut x0, mut y0, mut x1, mut y1) = (usize::MAX, usize::MAX, 0, 0);
        for y in 0..mask.height() {
            for (x, inside) in mask.row(y).iter().enumerate() {
                if *inside {
                    (x0, y0, x1, y1) = (x0.min(x), y0.min(y), x1.max(x + 1), y1.max(y + 1));
                }
            }
        }
        if x1 <= x0 {
            return None;
        }
        let mut pixels = Vec::with_capacity((x1 - x0) * (y1 - y0));
        for y in y0..y1 {
            for x in x0..x1 {
                let [r, g, b] = image[(x, y)];
                pixels.push([r, g, b, if mask[(x, y)] { 255 } else { 0 }]);
            }
        }
        Some(Cutout { width: x1 - x0, height: y1 - y0, pixels })
    }

    /// Columns and rows.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// Draws the cut-out, rotated and scaled about its centre, with its centre at `centre`. Returns its colours and
    /// coverage over a patch of the given size. `longest` is the length of its longer side in patch pixels.
    pub fn draw(
        &self,
        width: usize,
        height: usize,
        centre: [f32; 2],
        longest: f32,
        turn: f32,
    ) -> (Patch, Coverage) {
        let mut patch = Patch::filled(width, height, [0.0; 3]);
        let mut cover = Coverage::filled(width, height, 0.0);
        let pixels = width * height;
        let scale = self.width.max(self.height) as f32 / longest.max(1.0);
        let (s, c) = turn.sin_cos();
        let reach = 0.5 * (self.width as f32).hypot(self.height as f32) / scale + 1.0;
        let span = |centre: f32, limit: usize| {
            let low = (centre - reach).floor().clamp(0.0, limit as f32) as usize;
            low..((centre + reach).ceil().clamp(0.0, limit as f32) as usize)
        };
        let (centre_x, centre_y) = (0.5 * (self.width as f32 - 1.0), 0.5 * (self.height as f32 - 1.0));
        for y in span(centre[1], height) {
            for x in span(centre[0], width) {
                let (dx, dy) = ((x as f32 - centre[0]) * scale, (y as f32 - centre[1]) * scale);
                let (u, v) = (c * dx + s * dy + centre_x, c * dy - s * dx + centre_y);
                let (color, covered) = self.sample(u, v);
                if covered <= 0.0 {
                    continue;
                }
                let at = y * width + x;
                cover.data[at] = covered;
                for (plane, value) in patch.data.chunks_exact_mut(pixels).zip(color) {
                    plane[at] = value;
                }
            }
        }
        (patch, cover)
    }

    /// Bilinear colour and coverage; uncovered pixels do not contribute to the colour.
    fn sample(&self, u: f32, v: f32) -> ([f32; 3], f32) {
        let (x, y) = (u.floor(), v.floor());
        if !(x >= -1.0 && y >= -1.0 && x < self.width as f32 && y < self.height as f32) {
            return ([0.0; 3], 0.0);
        }
        let (fx, fy) = (u - x, v - y);
        let (mut color, mut covered) = ([0.0f32; 3], 0.0f32);
        for (dx, dy, weight) in [
            (0.0, 0.0, (1.0 - fx) * (1.0 - fy)),
            (1.0, 0.0, fx * (1.0 - fy)),
            (0.0, 1.0, (1.0 - fx) * fy),
            (1.0, 1.0, fx * fy),
        ] {
            let (x, y) = (x + dx, y + dy);
            if x < 0.0 || y < 0.0 || x as usize >= self.width || y as usize >= self.height {
                continue;
            }
            let pixel = self.pixels[y as usize * self.width + x as usize];
            let weight = weight * f32::from(pixel[3]) * (1.0 / 255.0);
            covered += weight;
            (0..3).for_each(|c| color[c] += weight * f32::from(pixel[c]));
        }
        (color.map(|c| c / (255.0 * covered.max(1e-6))), covered)
    }

    /// Draws the cut-out so that it hides about `fraction` of `visible`: of several places between the outside of the
    /// object and its centre, in a random direction, the one with the closest fraction is used. `None` when nothing is
    /// visible.
    pub fn draw_over(
        &self,
        visible: &Coverage,
        fraction: f32,
        longest: f32,
        random: &mut Random,
    ) -> Option<(Patch, Coverage)> {
        const GRID: usize = 4;
        let (mut sum, mut x_sum, mut y_sum) = (0.0f32, 0.0f32, 0.0f32);
        let mut points = Vec::new();
        for y in (GRID / 2..visible.height).step_by(GRID) {
            for x in (GRID / 2..visible.width).step_by(GRID) {
                if visible.data[y * visible.width + x] > 0.5 {
                    points.push([x as f32, y as f32]);
                    sum += 1.0;
                    x_sum += x as f32;
                    y_sum += y as f32;
                }
            }
        }
        if points.is_empty() {
            return None;
        }
        let centroid = [x_sum / sum, y_sum / sum];
        let turn = uniform(random, [-std::f32::consts::PI, std::f32::consts::PI]);
        let direction = uniform(random, [0.0, std::f32::consts::TAU]);
        let (dy, dx) = direction.sin_cos();
        let (s, c) = turn.sin_cos();
        let scale = self.width.max(self.height) as f32 / longest.max(1.0);
        let hides = |centre: [f32; 2]| {
            let hit = points.iter().filter(|p| {
                let (x, y) = ((p[0] - centre[0]) * scale, (p[1] - centre[1]) * scale);
                let u = (c * x + s * y + 0.5 * self.width as f32).floor();
                let v = (c * y - s * x + 0.5 * self.height as f32).floor();
                u >= 0.0
                    && v >= 0.0
                    && (u as usize) < self.width
                    && (v as usize) < self.height
                    && self.pixels[v as usize * self.width + u as usize][3] > 127
            });
            hit.count() as f32 / sum
        };
        let farthest = 0.5 * (visible.width.max(visible.height) as f32 * 0.8 + longest);
        // Slightly beside the line, so that shapes are not always aligned with the centre.
        let side = uniform(random, [-0.2, 0.2]) * longest;
        let places = (0..12).map(|i| {
            let r = farthest * (1.0 - (i as f32 + random.random::<f32>()) / 12.0);
            [centroid[0] + dx * r - dy * side, centroid[1] + dy * r + dx * side]
        });
        let centre = places
            .map(|centre| (centre, (hides(centre) - fraction).abs()))
            .min_by(|a, b| a.1.total_cmp(&b.1))?
            .0;
        Some(self.draw(visible.width, visible.height, centre, longest, turn))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::random::stream;

    fn square() -> Cutout {
        let image = RgbImage::from_fn(40, 40, |x, y| [x as u8 * 6, y as u8 * 6, 9]);
        let mask = Mask::from_fn(40, 40, |x, y| (10..30).contains(&x) && (5..35).contains(&y));
        Cutout::new(&image, &mask).unwrap()
    }

    #[test]
    fn pasted_without_rotation_it_equals_the_cutout() {
        let cutout = square();
        assert_eq!(cutout.size(), (20, 30));
        let (patch, cover) = cutout.draw(60, 60, [19.5, 24.5], 30.0, 0.0);
        assert_eq!(cover.area(), 600.0);
        // Its corner (10, 5) of the image lies at (10, 10) of the patch.
        assert!((patch.data[10 * 60 + 10] * 255.0 - 60.0).abs() < 0.01);
        assert!((patch.data[3600 + 10 * 60 + 10] * 255.0 - 30.0).abs() < 0.01);
    }

    #[test]
    fn it_hides_about_the_requested_fraction() {
        let visible = Coverage::from_fn(64, 64, |x, y| f32::from(x.abs_diff(32) < 20 && y.abs_diff(30) < 16));
        let mut off = 0.0;
        for number in 0..200 {
            let mut random = stream(3, number);
            let fraction = uniform(&mut random, [0.05, 0.4]);
            let (_, cover) = square().draw_over(&visible, fraction, 45.0, &mut random).unwrap();
            let mut left = visible.clone();
            left.remove(&cover);
            off += (1.0 - left.area() / visible.area() - fraction).abs() / 200.0;
        }
        assert!(off < 0.05, "{off}");
    }

    #[test]
    fn empty_masks_give_nothing() {
        let image = RgbImage::filled(4, 4, [0; 3]);
        assert!(Cutout::new(&image, &Mask::filled(4, 4, false)).is_none());
        assert!(Cutout::new(&image, &Mask::filled(5, 4, true)).is_none());
    }
}
