//! Figures 6.7 and 6.10 to 6.12 as images.

use sixfold_geometry::RgbImage;
use sixfold_plot::{COLORS, Canvas, FAINT, INK, text_width};

use super::offline::COUNTS;
use sixfold_shell::grasp::learn::Curve;

/// A curve in the left part of figure 6.7: fractions for each number of experiences.
pub(super) struct Line {
    pub class: String,
    /// Whether experience of all classes is used, or only of this class.
    pub all: bool,
    pub fractions: [f64; COUNTS.len()],
}

/// Fractions against the number of experiences per object.
pub(super) fn curves(title: &str, lines: &[Line]) -> RgbImage {
    let (left, top, width, height) = (70.0, 40.0, 420.0, 300.0);
    let mut canvas = Canvas::new(680, 400);
    canvas.text(left, 12.0, 2.0, title, INK);
    for k in 0..=5 {
        let y = top + height * (1.0 - 0.2 * f64::from(k));
        canvas.line((left, y), (left + width, y), 1.0, FAINT);
        canvas.text(left - 40.0, y - 6.0, 2.0, &format!("{:.1}", 0.2 * f64::from(k)), INK);
    }
    let x = |k: usize| left + width * (k as f64 + 0.5) / COUNTS.len() as f64;
    for (k, count) in COUNTS.iter().enumerate() {
        canvas.text(x(k) - 5.0, top + height + 10.0, 2.0, &count.to_string(), INK);
    }
    canvas.text(left + 60.0, top + height + 34.0, 2.0, "experiences per object", INK);
    let mut classes: Vec<&str> = vec![];
    for line in lines {
        let number = classes.iter().position(|c| *c == line.class).unwrap_or_else(|| {
            classes.push(&line.class);
            classes.len() - 1
        });
        let color = COLORS[number % COLORS.len()];
        let at = |k: usize| (x(k), top + height * (1.0 - line.fractions[k]));
        for k in 1..COUNTS.len() {
            let (from, to) = (at(k - 1), at(k));
            if line.all {
                // Dotted, as in the dissertation.
                for i in 0..12 {
                    let s = f64::from(i) / 12.0;
                    let p = (from.0 + (to.0 - from.0) * s, from.1 + (to.1 - from.1) * s);
                    canvas.line(p, p, 3.5, color);
                }
            } else {
                canvas.line(from, to, 2.5, color);
            }
        }
        if !line.all {
            canvas.text(left + width + 16.0, top + 26.0 * number as f64, 2.0, &line.class, color);
        }
    }
    let y = top + 26.0 * classes.len() as f64 + 10.0;
    for (k, text) in ["line: own class", "dots: all classes"].iter().enumerate() {
        canvas.text(left + width + 10.0, y + 18.0 * k as f64, 1.5, text, INK);
    }
    canvas.finish()
}

/// Fractions for transfer from every object (rows) to every other (columns).
pub(super) fn matrix(title: &str, names: &[String], fractions: &[Vec<Option<f64>>]) -> RgbImage {
    let cell = 46.0;
    let widest = names.iter().map(|n| text_width(n, 1.5)).fold(0.0, f64::max);
    let (left, top) = (widest + 24.0, widest + 44.0);
    let side = cell * names.len() as f64;
    let mut canvas = Canvas::new((left + side + 20.0) as usize, (top + side + 30.0) as usize);
    canvas.text(12.0, 12.0, 2.0, title, INK);
    for (i, row) in fractions.iter().enumerate() {
        let y = top + cell * i as f64;
        canvas.text(12.0, y + 0.5 * cell - 5.0, 1.5, &names[i], INK);
        let x = left + cell * i as f64 + 0.5 * cell - 5.0;
        canvas.text_upwards(x, top - 8.0 - 0.5 * text_width(&names[i], 1.5), 1.5, &names[i], INK);
        for (k, fraction) in row.iter().enumerate() {
            let x = left + cell * k as f64;
            let Some(fraction) = fraction else { continue };
            // White to blue.
            let color = [1.0 - 0.88 * fraction, 1.0 - 0.53 * fraction, 1.0 - 0.29 * fraction]
                .map(|v| (255.0 * v) as u8);
            canvas.rectangle(x + 1.0, y + 1.0, cell - 2.0, cell - 2.0, color);
            let ink = if *fraction > 0.6 { [255; 3] } else { INK };
            canvas.text(x + 6.0, y + 0.5 * cell - 6.0, 1.5, &format!("{fraction:.2}"), ink);
        }
    }
    canvas.text(12.0, top + side + 10.0, 1.5, "rows: experience of; columns: grasp on", INK);
    canvas.finish()
}

/// Success and nearest feature distance over the attempts: one strip per object and setting.
pub(super) fn incremental(curves: &[(&str, &Curve)], near: f64) -> RgbImage {
    let (left, width, height, gap) = (80.0, 480.0, 110.0, 66.0);
    let mut canvas = Canvas::new(620, (40.0 + (height + gap) * curves.len() as f64) as usize);
    for (i, (setting, curve)) in curves.iter().enumerate() {
        let top = 34.0 + (height + gap) * i as f64;
        canvas.text(left, top - 22.0, 2.0, &format!("{}, {setting} setting", curve.object), INK);
        let largest = curve.nearest.iter().flatten().fold(2.0 * near, |a, b| a.max(*b)).min(6.0);
        let n = curve.held.len().max(1) as f64;
        let x = |k: usize| left + width * (k as f64 + 0.5) / n;
        let y = |d: f64| top + height * (1.0 - (d / largest).min(1.0));
        canvas.line((left, top + height), (left + width, top + height), 1.0, INK);
        canvas.line((left, y(near)), (left + width, y(near)), 1.0, [214, 39, 40]);
        canvas.text(12.0, y(near) - 5.0, 1.5, &format!("{near:.1}"), [214, 39, 40]);
        canvas.text(12.0, top, 1.5, &format!("{largest:.1}"), INK);
        for k in 0..curve.held.len() {
            if let (Some(a), Some(b)) = (k.checked_sub(1).and_then(|j| curve.nearest[j]), curve.nearest[k]) {
                canvas.line((x(k - 1), y(a)), (x(k), y(b)), 2.0, COLORS[0]);
            }
            let color = if curve.held[k] { [60, 170, 80] } else { [214, 39, 40] };
            canvas.rectangle(x(k) - 8.0, top + height + 8.0, 16.0, 16.0, color);
            let letter = if curve.from_experience[k] { "E" } else { "G" };
            canvas.text(x(k) - 5.0, top + height + 9.0, 2.0, letter, [255; 3]);
        }
    }
    canvas.finish()
}
