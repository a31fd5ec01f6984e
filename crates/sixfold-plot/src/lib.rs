//! Lines, text and axes drawn directly as pixels, without font files or system libraries.
//!
//! [`Canvas`] draws at three times the size and averages down, so lines are smooth. Coordinates are image pixels, x to
//! the right and y down from the top left corner.

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

mod bars;
mod font;
mod ticks;

use sixfold_geometry::{Image, RgbImage};

pub use bars::{BarChart, BarGroup};
use font::FONT;
pub use ticks::{Ticks, ticks, ticks_logarithmic};

/// Images are drawn this many times larger and averaged down, for smooth lines.
const OVERSAMPLING: usize = 3;

/// Colour of text and axes.
pub const INK: [u8; 3] = [40, 44, 52];
/// Colour of grid lines.
pub const FAINT: [u8; 3] = [226, 229, 234];
/// Colour of the background.
pub const PAPER: [u8; 3] = [255, 255, 255];
/// Colours that colour-blind readers can distinguish (Tol's bright and muted schemes).
pub const COLORS: [[u8; 3]; 12] = [
    [68, 119, 170],
    [238, 102, 119],
    [34, 136, 51],
    [204, 187, 68],
    [102, 204, 238],
    [170, 51, 119],
    [221, 119, 51],
    [51, 34, 136],
    [68, 170, 153],
    [153, 153, 51],
    [136, 34, 85],
    [150, 150, 150],
];

/// An image under construction.
pub struct Canvas {
    width: usize,
    height: usize,
    large: RgbImage,
}

impl Canvas {
    /// An empty image of `width` x `height` pixels.
    pub fn new(width: usize, height: usize) -> Self {
        let large = Image::filled(width * OVERSAMPLING, height * OVERSAMPLING, PAPER);
        Canvas { width, height, large }
    }

    fn set(&mut self, x: i64, y: i64, color: [u8; 3]) {
        if x >= 0 && y >= 0 && (x as usize) < self.large.width() && (y as usize) < self.large.height() {
            self.large[(x as usize, y as usize)] = color;
        }
    }

    /// A filled rectangle with its top left corner at `(x, y)`.
    pub fn rectangle(&mut self, x: f64, y: f64, width: f64, height: f64, color: [u8; 3]) {
        let s = OVERSAMPLING as f64;
        let to = |v: f64| (v * s).round() as i64;
        let (right, bottom) = (self.large.width() as i64, self.large.height() as i64);
        for py in to(y).max(0)..to(y + height).min(bottom) {
            for px in to(x).max(0)..to(x + width).min(right) {
                self.set(px, py, color);
            }
        }
    }

    /// A line with round ends. A line to or from a point that is not finite is left out.
    pub fn line(&mut self, from: (f64, f64), to: (f64, f64), thickness: f64, color: [u8; 3]) {
        let s = OVERSAMPLING as f64;
        let (ax, ay, bx, by) = (from.0 * s, from.1 * s, to.0 * s, to.1 * s);
        if ![ax, ay, bx, by].iter().all(|v| v.is_finite()) {
            return;
        }
        let radius = 0.5 * thickness * s;
        let (dx, dy) = (bx - ax, by - ay);
        let length_squared = (dx * dx + dy * dy).max(1e-12);
        let low = |a: f64, b: f64| ((a.min(b) - radius).floor() as i64).max(0);
        let high = |a: f64, b: f64, end: usize| ((a.max(b) + radius).ceil() as i64).min(end as i64 - 1);
        for y in low(ay, by)..=high(ay, by, self.large.height()) {
            for x in low(ax, bx)..=high(ax, bx, self.large.width()) {
                let (px, py) = (x as f64 + 0.5 - ax, y as f64 + 0.5 - ay);
                let along = ((px * dx + py * dy) / length_squared).clamp(0.0, 1.0);
                let (ox, oy) = (px - along * dx, py - along * dy);
                if ox * ox + oy * oy <= radius * radius {
                    self.set(x, y, color);
                }
            }
        }
    }

    /// Text with its top left corner at `(x, y)`; a glyph's pixel is `size` image pixels, a glyph 5 x 7 of them.
    /// Characters outside ASCII leave a gap.
    pub fn text(&mut self, x: f64, y: f64, size: f64, text: &str, color: [u8; 3]) {
        for (i, c) in text.chars().enumerate() {
            self.glyph(c, color, size, |column, row| (x + size * (6.0 * i as f64 + column), y + size * row));
        }
    }

    /// Text that runs upwards, with its left side at `x` and its centre at `y`.
    pub fn text_upwards(&mut self, x: f64, y: f64, size: f64, text: &str, color: [u8; 3]) {
        let bottom = y + 0.5 * text_width(text, size);
        for (i, c) in text.chars().enumerate() {
            self.glyph(c, color, size, |column, row| {
                (x + size * row, bottom - size * (6.0 * i as f64 + column + 1.0))
            });
        }
    }

    fn glyph(&mut self, c: char, color: [u8; 3], size: f64, place: impl Fn(f64, f64) -> (f64, f64)) {
        let Some(columns) = (c as usize).checked_sub(32).and_then(|i| FONT.get(i)) else { return };
        for (column, bits) in columns.iter().enumerate() {
            for row in (0..8).filter(|row| bits >> row & 1 == 1) {
                let (px, py) = place(column as f64, f64::from(row));
                self.rectangle(px, py, size, size, color);
            }
        }
    }

    /// The image.
    pub fn finish(self) -> RgbImage {
        Image::from_fn(self.width, self.height, |x, y| {
            let mut sum = [0usize; 3];
            for dy in 0..OVERSAMPLING {
                for dx in 0..OVERSAMPLING {
                    let pixel = self.large[(x * OVERSAMPLING + dx, y * OVERSAMPLING + dy)];
                    for (total, value) in sum.iter_mut().zip(pixel) {
                        *total += usize::from(value);
                    }
                }
            }
            sum.map(|v| (v / (OVERSAMPLING * OVERSAMPLING)) as u8)
        })
    }
}

/// Width of a text in image pixels.
pub fn text_width(text: &str, size: f64) -> f64 {
    size * (6.0 * text.chars().count() as f64 - 1.0).max(0.0)
}

/// The dots of a text, column and row from its top left corner; six columns per character, eight rows.
pub fn text_dots(text: &str) -> Vec<(usize, usize)> {
    let mut dots = vec![];
    for (i, c) in text.chars().enumerate() {
        let Some(columns) = (c as usize).checked_sub(32).and_then(|c| FONT.get(c)) else { continue };
        for (column, bits) in columns.iter().enumerate() {
            dots.extend((0..8).filter(|row| bits >> row & 1 == 1).map(|row| (6 * i + column, row)));
        }
    }
    dots
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_drawn_at_its_coordinates() {
        let mut canvas = Canvas::new(40, 20);
        canvas.line((5.0, 10.0), (35.0, 10.0), 3.0, INK);
        let picture = canvas.finish();
        assert_eq!(picture[(20, 9)], INK);
        assert_eq!(picture[(20, 10)], INK);
        assert_eq!(picture[(20, 4)], PAPER);
        assert_eq!(picture[(1, 10)], PAPER);
    }

    #[test]
    fn drawing_outside_the_canvas_does_nothing() {
        let mut canvas = Canvas::new(10, 10);
        canvas.line((-1e12, 5.0), (-5.0, 1e12), 2.0, INK);
        canvas.line((f64::NAN, 5.0), (5.0, 5.0), 2.0, INK);
        canvas.rectangle(-20.0, -20.0, 5.0, 5.0, INK);
        canvas.text(100.0, 100.0, 2.0, "out \u{e4}", INK);
        assert!(canvas.finish().as_slice().iter().all(|p| *p == PAPER));
    }
}
