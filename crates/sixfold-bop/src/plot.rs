//! Recall curves as a picture, drawn with nothing but pixels: no font file, no system library.

use std::path::Path;

use sixfold_geometry::{Image, RgbImage};

use crate::dataset_error::DatasetError;
use crate::evaluate::{Evaluation, RecallCurves};
use crate::image_files::{png_of_rgb, write_png};

/// Drawn this many times larger and averaged down: smooth lines.
const OVERSAMPLING: usize = 3;
const PANEL_WIDTH: usize = 560;
const PANEL_HEIGHT: usize = 400;
const LEGEND_WIDTH: usize = 190;
const LEFT: usize = 64;
const RIGHT: usize = 20;
const TOP: usize = 44;
const BOTTOM: usize = 56;

const INK: [u8; 3] = [40, 44, 52];
const FAINT: [u8; 3] = [226, 229, 234];
const PAPER: [u8; 3] = [255, 255, 255];
/// Colours that stay apart for colour-blind eyes (Tol's bright and muted schemes).
const COLORS: [[u8; 3]; 12] = [
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

/// Glyphs of 5 x 7 pixels for the characters from space to `~`, a byte a column, lowest bit on top.
const FONT: [[u8; 5]; 95] = [
    [0, 0, 0, 0, 0],
    [0, 0, 95, 0, 0],
    [0, 7, 0, 7, 0],
    [20, 127, 20, 127, 20],
    [36, 42, 127, 42, 18],
    [35, 19, 8, 100, 98],
    [54, 73, 86, 32, 80],
    [0, 8, 7, 3, 0],
    [0, 28, 34, 65, 0],
    [0, 65, 34, 28, 0],
    [42, 28, 127, 28, 42],
    [8, 8, 62, 8, 8],
    [0, 128, 112, 48, 0],
    [8, 8, 8, 8, 8],
    [0, 0, 96, 96, 0],
    [32, 16, 8, 4, 2],
    [62, 81, 73, 69, 62],
    [0, 66, 127, 64, 0],
    [114, 73, 73, 73, 70],
    [33, 65, 73, 77, 51],
    [24, 20, 18, 127, 16],
    [39, 69, 69, 69, 57],
    [60, 74, 73, 73, 49],
    [65, 33, 17, 9, 7],
    [54, 73, 73, 73, 54],
    [70, 73, 73, 41, 30],
    [0, 0, 20, 0, 0],
    [0, 64, 52, 0, 0],
    [0, 8, 20, 34, 65],
    [20, 20, 20, 20, 20],
    [0, 65, 34, 20, 8],
    [2, 1, 89, 9, 6],
    [62, 65, 93, 89, 78],
    [124, 18, 17, 18, 124],
    [127, 73, 73, 73, 54],
    [62, 65, 65, 65, 34],
    [127, 65, 65, 65, 62],
    [127, 73, 73, 73, 65],
    [127, 9, 9, 9, 1],
    [62, 65, 65, 81, 115],
    [127, 8, 8, 8, 127],
    [0, 65, 127, 65, 0],
    [32, 64, 65, 63, 1],
    [127, 8, 20, 34, 65],
    [127, 64, 64, 64, 64],
    [127, 2, 28, 2, 127],
    [127, 4, 8, 16, 127],
    [62, 65, 65, 65, 62],
    [127, 9, 9, 9, 6],
    [62, 65, 81, 33, 94],
    [127, 9, 25, 41, 70],
    [38, 73, 73, 73, 50],
    [3, 1, 127, 1, 3],
    [63, 64, 64, 64, 63],
    [31, 32, 64, 32, 31],
    [63, 64, 56, 64, 63],
    [99, 20, 8, 20, 99],
    [3, 4, 120, 4, 3],
    [97, 89, 73, 77, 67],
    [0, 127, 65, 65, 65],
    [2, 4, 8, 16, 32],
    [0, 65, 65, 65, 127],
    [4, 2, 1, 2, 4],
    [64, 64, 64, 64, 64],
    [0, 3, 7, 8, 0],
    [32, 84, 84, 120, 64],
    [127, 40, 68, 68, 56],
    [56, 68, 68, 68, 40],
    [56, 68, 68, 40, 127],
    [56, 84, 84, 84, 24],
    [0, 8, 126, 9, 2],
    [24, 164, 164, 156, 120],
    [127, 8, 4, 4, 120],
    [0, 68, 125, 64, 0],
    [32, 64, 64, 61, 0],
    [127, 16, 40, 68, 0],
    [0, 65, 127, 64, 0],
    [124, 4, 120, 4, 120],
    [124, 8, 4, 4, 120],
    [56, 68, 68, 68, 56],
    [252, 24, 36, 36, 24],
    [24, 36, 36, 24, 252],
    [124, 8, 4, 4, 8],
    [72, 84, 84, 84, 36],
    [4, 4, 63, 68, 36],
    [60, 64, 64, 32, 124],
    [28, 32, 64, 32, 28],
    [60, 64, 48, 64, 60],
    [68, 40, 16, 40, 68],
    [76, 144, 144, 144, 124],
    [68, 100, 84, 76, 68],
    [0, 8, 54, 65, 0],
    [0, 0, 119, 0, 0],
    [0, 65, 54, 8, 0],
    [2, 1, 2, 4, 2],
];

/// A canvas in picture coordinates; drawing happens at the oversampled size.
struct Canvas {
    width: usize,
    height: usize,
    large: RgbImage,
}

impl Canvas {
    fn new(width: usize, height: usize) -> Self {
        let large = Image::filled(width * OVERSAMPLING, height * OVERSAMPLING, PAPER);
        Canvas { width, height, large }
    }

    fn set(&mut self, x: i64, y: i64, color: [u8; 3]) {
        if x >= 0 && y >= 0 && (x as usize) < self.large.width() && (y as usize) < self.large.height() {
            self.large[(x as usize, y as usize)] = color;
        }
    }

    fn rectangle(&mut self, x: f64, y: f64, width: f64, height: f64, color: [u8; 3]) {
        let s = OVERSAMPLING as f64;
        let to = |v: f64| (v * s).round() as i64;
        for py in to(y)..to(y + height) {
            for px in to(x)..to(x + width) {
                self.set(px, py, color);
            }
        }
    }

    /// A line with round ends.
    fn line(&mut self, from: (f64, f64), to: (f64, f64), thickness: f64, color: [u8; 3]) {
        let s = OVERSAMPLING as f64;
        let (ax, ay, bx, by) = (from.0 * s, from.1 * s, to.0 * s, to.1 * s);
        let radius = 0.5 * thickness * s;
        let (dx, dy) = (bx - ax, by - ay);
        let length_squared = (dx * dx + dy * dy).max(1e-12);
        let low = |a: f64, b: f64| (a.min(b) - radius).floor() as i64;
        let high = |a: f64, b: f64| (a.max(b) + radius).ceil() as i64;
        for y in low(ay, by)..=high(ay, by) {
            for x in low(ax, bx)..=high(ax, bx) {
                let (px, py) = (x as f64 + 0.5 - ax, y as f64 + 0.5 - ay);
                let along = ((px * dx + py * dy) / length_squared).clamp(0.0, 1.0);
                let (ox, oy) = (px - along * dx, py - along * dy);
                if ox * ox + oy * oy <= radius * radius {
                    self.set(x, y, color);
                }
            }
        }
    }

    /// Text with its top left corner at `(x, y)`; a glyph's pixel is `size` picture pixels.
    fn text(&mut self, x: f64, y: f64, size: f64, text: &str, color: [u8; 3]) {
        for (i, c) in text.chars().enumerate() {
            self.glyph(c, color, size, |column, row| (x + size * (6.0 * i as f64 + column), y + size * row));
        }
    }

    /// Text that runs upwards, its middle at `(x, y)`.
    fn text_upwards(&mut self, x: f64, y: f64, size: f64, text: &str, color: [u8; 3]) {
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

    fn finish(self) -> RgbImage {
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

fn text_width(text: &str, size: f64) -> f64 {
    size * (6.0 * text.chars().count() as f64 - 1.0)
}

fn panel(
    canvas: &mut Canvas,
    x: f64,
    y: f64,
    title: &str,
    curves: Option<&RecallCurves>,
    why_not: &str,
    ids: &[String],
) {
    let (left, top) = (x + LEFT as f64, y + TOP as f64);
    let width = (PANEL_WIDTH - LEFT - RIGHT) as f64;
    let height = (PANEL_HEIGHT - TOP - BOTTOM) as f64;
    canvas.text(left, y + 16.0, 2.0, title, INK);
    for i in 0..=5 {
        let value = f64::from(i) / 5.0;
        let py = top + height * (1.0 - value);
        canvas.rectangle(left, py - 0.5, width, 1.0, FAINT);
        let label = format!("{value:.1}");
        canvas.text(left - 10.0 - text_width(&label, 1.6), py - 5.5, 1.6, &label, INK);
    }
    canvas.text_upwards(x + 8.0, top + 0.5 * height, 1.6, "recall", INK);
    let Some(curves) = curves else {
        let cut: String = why_not.chars().take(70).collect();
        for (i, line) in ["not computed:", &cut].into_iter().enumerate() {
            let px = left + 0.5 * (width - text_width(line, 1.0));
            canvas.text(px, top + 0.5 * height - 12.0 + 18.0 * i as f64, 1.0, line, INK);
        }
        axes(canvas, left, top, width, height);
        return;
    };
    let largest = curves.thresholds.last().copied().unwrap_or(1.0).max(1e-12);
    for i in 0..=5 {
        let value = largest * f64::from(i) / 5.0;
        let px = left + width * f64::from(i) / 5.0;
        canvas.rectangle(px - 0.5, top, 1.0, height, FAINT);
        let label = if largest >= 5.0 { format!("{value:.0}") } else { format!("{value:.2}") };
        canvas.text(px - 0.5 * text_width(&label, 1.6), top + height + 10.0, 1.6, &label, INK);
    }
    let caption = format!("threshold, {}", curves.unit);
    canvas.text(left + 0.5 * (width - text_width(&caption, 1.6)), top + height + 32.0, 1.6, &caption, INK);
    axes(canvas, left, top, width, height);
    let mut draw = |recall: &[f64], thickness: f64, color| {
        let at = |i: usize| (left + width * curves.thresholds[i] / largest, top + height * (1.0 - recall[i]));
        for i in 1..recall.len().min(curves.thresholds.len()) {
            canvas.line(at(i - 1), at(i), thickness, color);
        }
    };
    for (id, recall) in &curves.objects {
        if let Some(n) = ids.iter().position(|known| known == id) {
            draw(recall, 1.6, COLORS[n % COLORS.len()]);
        }
    }
    draw(&curves.mean, 3.4, INK);
}

fn axes(canvas: &mut Canvas, left: f64, top: f64, width: f64, height: f64) {
    canvas.rectangle(left - 1.0, top, 1.5, height + 1.0, INK);
    canvas.rectangle(left - 1.0, top + height - 0.5, width + 1.0, 1.5, INK);
}

/// Draws the recall curves of MSSD, MSPD, VSD and ADD(-S): one panel each, a thin line an object, a thick one for all
/// targets together.
pub fn draw_recall_curves(evaluation: &Evaluation) -> RgbImage {
    let mut canvas = Canvas::new(2 * PANEL_WIDTH + LEGEND_WIDTH, 2 * PANEL_HEIGHT);
    let mut ids: Vec<String> = evaluation.objects.keys().cloned().collect();
    ids.sort_by_key(|id| id.parse::<u64>().unwrap_or(u64::MAX));
    let score = |value: Option<f64>| value.map_or(String::new(), |v| format!("{:.1} %", 100.0 * v));
    let reason = |name: &str| evaluation.reasons.get(name).map_or("", String::as_str);
    let mean_add = evaluation.add_s_recall.get("mean").copied().flatten();
    let curves = &evaluation.curves;
    let panels = [
        (format!("MSSD   AR {}", score(evaluation.ar_mssd)), &curves.mssd, reason("ar_mssd")),
        (format!("MSPD   AR {}", score(evaluation.ar_mspd)), &curves.mspd, reason("ar_mspd")),
        (format!("VSD    AR {}", score(evaluation.ar_vsd)), &curves.vsd, reason("ar_vsd")),
        (format!("ADD(-S)   at 10 %: {}", score(mean_add)), &curves.add, reason("add_s_recall")),
    ];
    for (i, (title, curves, reason)) in panels.into_iter().enumerate() {
        let (x, y) = ((i % 2 * PANEL_WIDTH) as f64, (i / 2 * PANEL_HEIGHT) as f64);
        let title = if curves.is_some() { title.as_str() } else { title.split(' ').next().unwrap_or("") };
        panel(&mut canvas, x, y, title, curves.as_ref(), reason, &ids);
    }
    let (x, mut y) = ((2 * PANEL_WIDTH + 14) as f64, TOP as f64);
    let mut entry = |label: &str, thickness: f64, color| {
        canvas.line((x, y + 5.5), (x + 26.0, y + 5.5), thickness, color);
        canvas.text(x + 36.0, y, 1.6, label, INK);
        y += 22.0;
    };
    entry("all targets", 3.4, INK);
    // What does not fit the picture is counted instead.
    let shown = ids.len().min((2 * PANEL_HEIGHT - 2 * TOP) / 22 - 2);
    for (n, id) in ids.iter().take(shown).enumerate() {
        entry(&format!("object {id}"), 1.6, COLORS[n % COLORS.len()]);
    }
    if ids.len() > shown {
        entry(&format!("and {} more", ids.len() - shown), 0.0, PAPER);
    }
    canvas.finish()
}

/// Writes [`draw_recall_curves`] as a PNG file.
///
/// # Errors
/// [`DatasetError::Write`].
pub fn write_recall_curves(path: &Path, evaluation: &Evaluation) -> Result<(), DatasetError> {
    match png_of_rgb(&draw_recall_curves(evaluation)) {
        Some(png) => write_png(path, png),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::Curves;
    use std::collections::BTreeMap;

    fn evaluation(recall: f64) -> Evaluation {
        let curves = |unit, largest: f64| RecallCurves {
            unit,
            thresholds: vec![0.0, 0.5 * largest, largest],
            objects: BTreeMap::from([("5".to_owned(), vec![0.0, recall, recall])]),
            mean: vec![0.0, recall, recall],
        };
        let scores = crate::evaluate::ObjectScores {
            targets: 1,
            ar_vsd: None,
            ar_mssd: Some(recall),
            ar_mspd: None,
            add_s_recall: None,
        };
        Evaluation {
            ar: None,
            ar_vsd: None,
            ar_mssd: Some(recall),
            ar_mspd: Some(recall),
            add_s_recall: BTreeMap::new(),
            add_auc: None,
            add_s_auc: None,
            reasons: BTreeMap::new(),
            targets: 1,
            estimates: 1,
            estimates_left_out: 0,
            average_time_per_image: None,
            objects: BTreeMap::from([("5".to_owned(), scores)]),
            curves: Curves { mssd: Some(curves("diameters", 0.5)), ..Default::default() },
        }
    }

    #[test]
    fn the_thick_line_is_where_the_recall_is() {
        for recall in [0.25, 0.75] {
            let picture = draw_recall_curves(&evaluation(recall));
            // The curve is level in the right half of the first panel; look down a column three quarters across.
            let x = LEFT + (PANEL_WIDTH - LEFT - RIGHT) * 3 / 4 + 7;
            let dark: Vec<usize> =
                (TOP..PANEL_HEIGHT - BOTTOM - 4).filter(|&y| picture[(x, y)] == INK).collect();
            let middle = dark.iter().sum::<usize>() as f64 / dark.len() as f64;
            let expected = TOP as f64 + (PANEL_HEIGHT - TOP - BOTTOM) as f64 * (1.0 - recall);
            assert!(
                (middle - expected).abs() < 2.0,
                "recall {recall}: line at {middle}, expected {expected}"
            );
        }
    }

    #[test]
    fn a_picture_is_written() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("curves.png");
        write_recall_curves(&path, &evaluation(0.5)).unwrap();
        let picture = image::open(&path).unwrap();
        assert_eq!(picture.width() as usize, 2 * PANEL_WIDTH + LEGEND_WIDTH);
    }
}
