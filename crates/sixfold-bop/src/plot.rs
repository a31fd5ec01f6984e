//! Recall curves as a figure.

use std::path::Path;

use sixfold_geometry::RgbImage;
use sixfold_io::{ImageFileError, write_rgb};
use sixfold_plot::{COLORS, Canvas, FAINT, INK, PAPER, text_width};

use crate::evaluate::{Evaluation, RecallCurves};

const PANEL_WIDTH: usize = 560;
const PANEL_HEIGHT: usize = 400;
const LEGEND_WIDTH: usize = 190;
const LEFT: usize = 64;
const RIGHT: usize = 20;
const TOP: usize = 44;
const BOTTOM: usize = 56;

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

/// Draws the recall curves of MSSD, MSPD, VSD and ADD(-S): one panel per error, a thin line per object, a thick line
/// for all targets together.
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
    // Objects whose names do not fit the image are only counted.
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
/// [`ImageFileError::Write`].
pub fn write_recall_curves(path: &Path, evaluation: &Evaluation) -> Result<(), ImageFileError> {
    write_rgb(path, &draw_recall_curves(evaluation))
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
            vsd_protocol: None,
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
    fn the_thick_line_is_at_the_recall() {
        for recall in [0.25, 0.75] {
            let picture = draw_recall_curves(&evaluation(recall));
            // The curve is level in the right half of the first panel: scan the column at three quarters of its
            // width.
            let x = LEFT + (PANEL_WIDTH - LEFT - RIGHT) * 3 / 4 + 7;
            let dark: Vec<usize> =
                (TOP..PANEL_HEIGHT - BOTTOM - 4).filter(|&y| picture[(x, y)] == INK).collect();
            let centre = dark.iter().sum::<usize>() as f64 / dark.len() as f64;
            let expected = TOP as f64 + (PANEL_HEIGHT - TOP - BOTTOM) as f64 * (1.0 - recall);
            assert!(
                (centre - expected).abs() < 2.0,
                "recall {recall}: line at {centre}, expected {expected}"
            );
        }
    }

    #[test]
    fn a_plot_is_written() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("curves.png");
        write_recall_curves(&path, &evaluation(0.5)).unwrap();
        let picture = image::open(&path).unwrap();
        assert_eq!(picture.width() as usize, 2 * PANEL_WIDTH + LEGEND_WIDTH);
    }
}
