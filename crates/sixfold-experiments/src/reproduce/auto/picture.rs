//! Reliability diagrams: the fraction of right poses against their probability.

use sixfold_geometry::RgbImage;
use sixfold_plot::{Canvas, text_width};

use super::table::{Row, Whole};

const SIDE: f64 = 420.0;
const LEFT: f64 = 100.0;
const TOP: f64 = 50.0;
const WIDTH: f64 = LEFT + SIDE + 30.0;
const HEIGHT: f64 = TOP + SIDE + 70.0;
const INK: [u8; 3] = [40, 40, 40];
const PALE: [u8; 3] = [200, 200, 200];
const BLUE: [u8; 3] = [0, 114, 178];
/// Pixels of a dot of the font, whose letters are seven high.
const SIZE: f64 = 2.0;
const LETTER: f64 = 7.0 * SIZE;

/// The diagrams side by side.
pub(super) fn reliability(whole: &Whole) -> RgbImage {
    let columns = whole.rows.len().max(1);
    let mut canvas = Canvas::new((WIDTH * columns as f64) as usize, HEIGHT as usize);
    for (k, row) in whole.rows.iter().enumerate() {
        diagram(&mut canvas, WIDTH * k as f64 + LEFT, row);
    }
    canvas.finish()
}

fn diagram(canvas: &mut Canvas, left: f64, row: &Row) {
    let bottom = TOP + SIDE;
    let at = |x: f64, y: f64| (left + SIDE * x, bottom - SIDE * y);
    let title = format!("{}: error {:.3}", row.given.name(), row.expected_error);
    canvas.text(left, TOP - 28.0, SIZE, &title, INK);
    for tick in 0..=4 {
        let v = f64::from(tick) / 4.0;
        canvas.line(at(0.0, v), at(1.0, v), 1.0, PALE);
        canvas.line(at(v, 0.0), at(v, 1.0), 1.0, PALE);
        let label = format!("{v:.2}");
        let wide = text_width(&label, SIZE);
        canvas.text(at(v, 0.0).0 - 0.5 * wide, bottom + 8.0, SIZE, &label, INK);
        canvas.text(left - wide - 6.0, at(0.0, v).1 - 0.5 * LETTER, SIZE, &label, INK);
    }
    canvas.line(at(0.0, 0.0), at(1.0, 1.0), 1.0, INK);
    let most = row.bins.iter().map(|b| b.poses).max().unwrap_or(0).max(1) as f64;
    let mut last = None;
    for bin in row.bins.iter().filter(|b| b.poses > 0) {
        let (x, y) = at(bin.probability, bin.right);
        // The area of the square is proportional to the number of poses.
        let side = 4.0 + 12.0 * (bin.poses as f64 / most).sqrt();
        canvas.rectangle(x - 0.5 * side, y - 0.5 * side, side, side, BLUE);
        if let Some(last) = last {
            canvas.line(last, (x, y), 2.0, BLUE);
        }
        last = Some((x, y));
    }
    canvas.text(left, bottom + 34.0, SIZE, "probability; size: number of poses", INK);
    canvas.text_upwards(left - 90.0, TOP + 0.5 * SIDE, SIZE, "fraction that is right", INK);
}
