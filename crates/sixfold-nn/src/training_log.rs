//! The training's log: one JSON object per line, only appended to, and its learning curves as a figure.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Deserializer, Serialize};
use sixfold_io::{write_atomically_with, write_rgb};
use sixfold_plot::{COLORS, Canvas, FAINT, INK, Ticks, text_width, ticks, ticks_logarithmic};

use crate::files::explain;

/// Means over the steps since the last record.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TrainingRecord {
    /// Number of steps done.
    pub step: u64,
    /// Time since the start of the training, in seconds.
    #[serde(deserialize_with = "number")]
    pub seconds: f64,
    /// Learning rate of the step.
    #[serde(deserialize_with = "number")]
    pub learning_rate: f64,
    /// Training samples per second since the previous record.
    #[serde(deserialize_with = "number")]
    pub samples_per_second: f64,
    /// Losses and scores by name. NaN if the training diverged, written as JSON's `null`.
    #[serde(deserialize_with = "numbers")]
    pub losses: BTreeMap<String, f64>,
}

/// JSON cannot represent numbers that are not finite, so they are written as `null`.
fn number<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::<f64>::deserialize(deserializer)?.unwrap_or(f64::NAN))
}

fn numbers<'de, D: Deserializer<'de>>(deserializer: D) -> Result<BTreeMap<String, f64>, D::Error> {
    let values = BTreeMap::<String, Option<f64>>::deserialize(deserializer)?;
    Ok(values.into_iter().map(|(name, value)| (name, value.unwrap_or(f64::NAN))).collect())
}

/// Why the log could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum TrainingLogError {
    /// The file could not be read.
    #[error("{}: cannot be read: {}", file.display(), explain(source))]
    Read {
        /// The file.
        file: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The file could not be written.
    #[error("{}: cannot be written: {}", file.display(), explain(source))]
    Write {
        /// The file.
        file: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// A line before the last one is not a valid record.
    #[error("{}: line {line}: expected a training record as JSON, found {found:?} ({reason}); remove the line or the file",
        file.display())]
    Line {
        /// The file.
        file: PathBuf,
        /// Line number from 1.
        line: usize,
        /// The beginning of the line.
        found: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The figure could not be drawn.
    #[error("{}: expected records with losses to plot, found none; train a few steps first", file.display())]
    NothingToDraw {
        /// The figure's file.
        file: PathBuf,
    },
}

/// An open log to which records are appended.
#[derive(Debug)]
pub struct TrainingLog {
    path: PathBuf,
    file: File,
}

impl TrainingLog {
    /// Opens the log of a training that starts (`resumed_step` 0) or resumes after `resumed_step` steps. Records of later steps and
    /// an incomplete last line are removed: those steps are repeated.
    ///
    /// # Errors
    /// [`TrainingLogError::Read`], [`TrainingLogError::Write`] and [`TrainingLogError::Line`].
    pub fn open(path: &Path, resumed_step: u64) -> Result<Self, TrainingLogError> {
        let write_error = |source| TrainingLogError::Write { file: path.to_owned(), source };
        if path.exists() {
            let Lines { records, torn } = read_lines(path)?;
            let kept: Vec<_> = records.iter().filter(|r| r.step <= resumed_step).collect();
            if torn || kept.len() < records.len() {
                write_atomically_with(path, |file| {
                    kept.iter().try_for_each(|record| file.write_all(line(record)?.as_bytes()))
                })
                .map_err(write_error)?;
            }
        }
        let file = OpenOptions::new().create(true).append(true).open(path).map_err(write_error)?;
        Ok(TrainingLog { path: path.to_owned(), file })
    }

    /// Appends a record as one line; it has been passed to the operating system when this returns.
    ///
    /// # Errors
    /// [`TrainingLogError::Write`].
    pub fn append(&mut self, record: &TrainingRecord) -> Result<(), TrainingLogError> {
        let written = line(record).and_then(|line| self.file.write_all(line.as_bytes()));
        written.map_err(|source| TrainingLogError::Write { file: self.path.clone(), source })?;
        Ok(())
    }
}

fn line(record: &TrainingRecord) -> io::Result<String> {
    Ok(serde_json::to_string(record)? + "\n")
}

/// All records of a log. An incomplete last line is left out.
///
/// # Errors
/// [`TrainingLogError::Read`] and [`TrainingLogError::Line`].
pub fn read_training_log(path: &Path) -> Result<Vec<TrainingRecord>, TrainingLogError> {
    Ok(read_lines(path)?.records)
}

struct Lines {
    records: Vec<TrainingRecord>,
    /// Whether the last line was incomplete or not terminated.
    torn: bool,
}

fn read_lines(path: &Path) -> Result<Lines, TrainingLogError> {
    let bytes = fs::read(path).map_err(|source| TrainingLogError::Read { file: path.to_owned(), source })?;
    let text = String::from_utf8_lossy(&bytes);
    let mut records = Vec::new();
    let mut torn = !text.is_empty() && !text.ends_with('\n');
    let count = text.lines().count();
    for (i, line) in text.lines().enumerate() {
        match serde_json::from_str(line) {
            // A last record without a line end may be incomplete even if it is valid JSON: a number may have lost digits.
            Ok(record) if i + 1 < count || !torn => records.push(record),
            Err(e) if i + 1 < count => {
                return Err(TrainingLogError::Line {
                    file: path.to_owned(),
                    line: i + 1,
                    found: line.chars().take(40).collect(),
                    reason: e.to_string(),
                });
            }
            _ => torn = true,
        }
    }
    Ok(Lines { records, torn })
}

const PANEL_WIDTH: u32 = 560;
const PANEL_HEIGHT: u32 = 340;
const LEFT: f64 = 84.0;
const RIGHT: f64 = 32.0;
const TOP: f64 = 44.0;
const BOTTOM: f64 = 56.0;
/// Maximum number of losses that are drawn.
const MAX_PANELS: usize = 24;

/// Draws every loss over the steps, then learning rate and speed: one panel each, with the values in a faint and their running mean
/// in a strong colour. A panel is logarithmic if all its values are positive and span more than a factor of 20.
///
/// # Errors
/// [`TrainingLogError::NothingToDraw`] without records, [`TrainingLogError::Write`].
pub(crate) fn draw_curves(log: &[TrainingRecord], png: &Path) -> Result<(), TrainingLogError> {
    let mut curves: BTreeMap<&str, Vec<(f64, f64)>> = BTreeMap::new();
    for record in log {
        for (name, value) in &record.losses {
            curves.entry(name).or_default().push((record.step as f64, *value));
        }
    }
    if curves.is_empty() {
        return Err(TrainingLogError::NothingToDraw { file: png.to_owned() });
    }
    let mut panels: Vec<(&str, Vec<(f64, f64)>)> = curves.into_iter().take(MAX_PANELS - 2).collect();
    let over_steps =
        |value: fn(&TrainingRecord) -> f64| log.iter().map(|r| (r.step as f64, value(r))).collect();
    panels.push(("learning rate", over_steps(|r| r.learning_rate)));
    panels.push(("samples per second", over_steps(|r| r.samples_per_second)));
    let columns = 2.min(panels.len() as u32);
    let rows = (panels.len() as u32).div_ceil(columns);
    let mut canvas = Canvas::new((columns * PANEL_WIDTH) as usize, (rows * PANEL_HEIGHT) as usize);
    for (i, (name, points)) in panels.iter().enumerate() {
        let (column, row) = (i as u32 % columns, i as u32 / columns);
        let corner = (f64::from(column * PANEL_WIDTH), f64::from(row * PANEL_HEIGHT));
        panel(&mut canvas, corner, name, points, COLORS[i % COLORS.len()]);
    }
    write_rgb(png, &canvas.finish())
        .map_err(|error| TrainingLogError::Write { file: png.to_owned(), source: error.into() })
}

fn panel(canvas: &mut Canvas, corner: (f64, f64), name: &str, points: &[(f64, f64)], color: [u8; 3]) {
    let (left, top) = (corner.0 + LEFT, corner.1 + TOP);
    let (width, height) = (f64::from(PANEL_WIDTH) - LEFT - RIGHT, f64::from(PANEL_HEIGHT) - TOP - BOTTOM);
    let finite: Vec<(f64, f64)> = points.iter().copied().filter(|p| p.1.is_finite()).collect();
    let lowest = finite.iter().map(|p| p.1).fold(f64::INFINITY, f64::min);
    let highest = finite.iter().map(|p| p.1).fold(f64::NEG_INFINITY, f64::max);
    let logarithmic = lowest > 0.0 && highest > 20.0 * lowest;
    // A schedule that ends near zero must not compress the rest of the curve.
    let lowest = if logarithmic { lowest.max(1e-4 * highest) } else { lowest };
    let vertical = if logarithmic { ticks_logarithmic(lowest, highest) } else { ticks(lowest, highest) };
    let last_step = points.last().map_or(1.0, |p| p.0).max(1.0);
    let horizontal = ticks(0.0, last_step);

    let last = finite.last().map_or("no number".to_owned(), |p| {
        if p.1 != 0.0 && p.1.abs() < 1e-3 { format!("{:.2e}", p.1) } else { format!("{:.4}", p.1) }
    });
    let room = (width / 12.0) as usize;
    let title: String = format!("{name}   {last}").chars().take(room).collect();
    canvas.text(left, corner.1 + 16.0, 2.0, &title, INK);
    let fraction = |ticks: &Ticks, value: f64| {
        if logarithmic {
            (value / ticks.low).ln() / (ticks.high / ticks.low).ln()
        } else {
            (value - ticks.low) / (ticks.high - ticks.low)
        }
    };
    for (value, label) in &vertical.marks {
        let y = top + height * (1.0 - fraction(&vertical, *value));
        canvas.rectangle(left, y - 0.5, width, 1.0, FAINT);
        canvas.text(left - 10.0 - text_width(label, 1.6), y - 5.5, 1.6, label, INK);
    }
    for (value, label) in &horizontal.marks {
        let x = left + width * value / horizontal.high;
        canvas.rectangle(x - 0.5, top, 1.0, height, FAINT);
        canvas.text(x - 0.5 * text_width(label, 1.6), top + height + 10.0, 1.6, label, INK);
    }
    canvas.text(left + 0.5 * (width - text_width("step", 1.6)), top + height + 32.0, 1.6, "step", INK);
    canvas.rectangle(left - 1.0, top, 1.5, height + 1.0, INK);
    canvas.rectangle(left - 1.0, top + height - 0.5, width + 1.0, 1.5, INK);

    let place = |p: (f64, f64)| {
        (left + width * p.0 / horizontal.high, top + height * (1.0 - fraction(&vertical, p.1)))
    };
    let mut curve = |points: &[(f64, f64)], thickness: f64, color: [u8; 3]| {
        let points = at_most_one_a_pixel(points, 2 * PANEL_WIDTH as usize);
        if let [only] = points[..] {
            canvas.line(place(only), place(only), 3.0 * thickness, color);
        }
        for pair in points.windows(2) {
            canvas.line(place(pair[0]), place(pair[1]), thickness, color);
        }
    };
    let mean = running_mean(&finite, (finite.len() / 50).max(1));
    let pale = color.map(|c| 255 - (255 - c) / 3);
    curve(&finite, 1.2, pale);
    curve(&mean, 2.0, color);
}

/// Mean of each value and the `window - 1` before it.
fn running_mean(points: &[(f64, f64)], window: usize) -> Vec<(f64, f64)> {
    (0..points.len())
        .map(|i| {
            let part = &points[(i + 1).saturating_sub(window)..=i];
            (points[i].0, part.iter().map(|p| p.1).sum::<f64>() / part.len() as f64)
        })
        .collect()
}

/// Keeps the lowest and highest value of every interval, so that no outlier is lost.
fn at_most_one_a_pixel(points: &[(f64, f64)], max: usize) -> Vec<(f64, f64)> {
    if points.len() <= max {
        return points.to_vec();
    }
    points
        .chunks(2 * points.len().div_ceil(max))
        .flat_map(|chunk| {
            let index = |best: fn(f64, f64) -> bool| {
                (0..chunk.len()).fold(0, |b, i| if best(chunk[i].1, chunk[b].1) { i } else { b })
            };
            let (low, high) = (index(|a, b| a < b), index(|a, b| a > b));
            [chunk[low.min(high)], chunk[low.max(high)]]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(step: u64) -> TrainingRecord {
        TrainingRecord {
            step,
            seconds: step as f64 * 0.25,
            learning_rate: 1e-3,
            samples_per_second: 120.5,
            losses: BTreeMap::from([("total".to_owned(), 1.0 / (1.0 + step as f64))]),
        }
    }

    fn fill(path: &Path, steps: std::ops::RangeInclusive<u64>, resumed: u64) {
        let mut log = TrainingLog::open(path, resumed).unwrap();
        steps.for_each(|step| log.append(&record(step)).unwrap());
    }

    #[test]
    fn records_come_back() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("log.jsonl");
        fill(&path, 1..=5, 0);
        let records = read_training_log(&path).unwrap();
        assert_eq!(records, (1..=5).map(record).collect::<Vec<_>>());
        TrainingLog::open(&path, 5).unwrap();
        assert_eq!(read_training_log(&path).unwrap(), records);
    }

    #[test]
    fn steps_after_the_resumed_one_are_taken_out() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("log.jsonl");
        fill(&path, 1..=8, 0);
        fill(&path, 6..=7, 5);
        let records = read_training_log(&path).unwrap();
        assert_eq!(records.iter().map(|r| r.step).collect::<Vec<_>>(), [1, 2, 3, 4, 5, 6, 7]);
        fill(&path, 1..=1, 0);
        assert_eq!(read_training_log(&path).unwrap().len(), 1, "a training that was restarted");
    }

    #[test]
    fn a_torn_last_line_is_no_harm() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("log.jsonl");
        fill(&path, 1..=3, 0);
        let whole = fs::read(&path).unwrap();
        let third = whole.iter().enumerate().filter(|(_, b)| **b == b'\n').nth(1).unwrap().0 + 1;
        for length in third..whole.len() {
            fs::write(&path, &whole[..length]).unwrap();
            assert_eq!(read_training_log(&path).unwrap().len(), 2, "{length}");
            fill(&path, 3..=3, 3);
            assert_eq!(fs::read(&path).unwrap(), whole);
        }
    }

    #[test]
    fn a_broken_line_in_between_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("log.jsonl");
        fs::write(&path, "{\"step\": 1}\nx\n").unwrap();
        let error = read_training_log(&path).unwrap_err().to_string();
        assert!(error.contains("log.jsonl: line 1: expected a training record"), "{error}");
    }

    #[test]
    fn a_loss_that_is_no_number_is_kept_as_such() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("log.jsonl");
        let mut bad = record(1);
        bad.losses.insert("total".to_owned(), f64::NAN);
        TrainingLog::open(&path, 0).unwrap().append(&bad).unwrap();
        assert!(read_training_log(&path).unwrap()[0].losses["total"].is_nan());
        draw_curves(&read_training_log(&path).unwrap(), &dir.path().join("c.png")).unwrap();
    }

    #[test]
    fn curves_are_plotted_at_their_values() {
        let dir = tempfile::tempdir().unwrap();
        let png = dir.path().join("curves.png");
        let mut log: Vec<_> = (1..=3000).map(record).collect();
        for record in &mut log {
            record.losses = BTreeMap::from([("level".to_owned(), 0.25), ("wide".to_owned(), 5.0)]);
        }
        log[0].losses.insert("level".to_owned(), 0.0);
        log[1].losses.insert("level".to_owned(), 1.0);
        draw_curves(&log, &png).unwrap();
        let picture = image::open(&png).unwrap().to_rgb8();
        assert_eq!(picture.dimensions(), (2 * PANEL_WIDTH, 2 * PANEL_HEIGHT));
        // Down a column halfway across the first panel: the horizontal line at a quarter of the height.
        let x = (LEFT + 0.53 * (f64::from(PANEL_WIDTH) - LEFT - RIGHT)) as u32;
        let rows: Vec<u32> = (TOP as u32..PANEL_HEIGHT - BOTTOM as u32)
            .filter(|y| picture.get_pixel(x, *y).0 == COLORS[0])
            .collect();
        let centre = rows.iter().sum::<u32>() as f64 / rows.len() as f64;
        let expected = TOP + 0.75 * (f64::from(PANEL_HEIGHT) - TOP - BOTTOM);
        assert!((centre - expected).abs() < 2.0, "line at {centre}, expected {expected}");
        assert!(draw_curves(&[], &png).unwrap_err().to_string().contains("train a few steps first"));
    }
}
