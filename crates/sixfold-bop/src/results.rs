//! The result file of the BOP Challenge: `scene_id,im_id,obj_id,score,R,t,time`, one estimate a line, `R` nine numbers
//! row by row, `t` in millimetres, `time` in seconds for the whole image or -1.

use std::fs::{File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use sixfold_geometry::{Mat3, Pose, Vec3};
use sixfold_io::{make_folder_of, sync_folder_of, write_atomically};
use thiserror::Error;

use crate::errors::Placement;
use crate::write::{rotation_rows, translation_mm};

const HEADER: &str = "scene_id,im_id,obj_id,score,R,t,time";
const COLUMNS: [&str; 7] = ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"];

/// An estimated pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// The scene.
    pub scene_id: u32,
    /// The image.
    pub im_id: u32,
    /// The object.
    pub obj_id: u32,
    /// Confidence; any finite number, higher is more confident.
    pub score: f64,
    /// The pose.
    pub camera_from_object: Pose,
    /// Seconds that all estimates of this image took together; `None` where not measured (-1 in the file).
    pub time: Option<f64>,
    /// The rotation as written in the file, if it came from one; the pose holds the nearest true rotation. An
    /// evaluation computes errors with these numbers, as the official one does.
    pub rotation_as_written: Option<Mat3>,
}

impl Estimate {
    /// An estimate of an object in an image, without time.
    pub fn new(scene_id: u32, im_id: u32, obj_id: u32, score: f64, camera_from_object: Pose) -> Self {
        let (time, rotation_as_written) = (None, None);
        Estimate { scene_id, im_id, obj_id, score, camera_from_object, time, rotation_as_written }
    }

    /// The pose as the evaluation uses it.
    pub fn placement(&self) -> Placement {
        let rotation = self.rotation_as_written.unwrap_or_else(|| self.camera_from_object.rotation_matrix());
        Placement { rotation, translation: self.camera_from_object.translation() }
    }
}

/// Why a result file cannot be read or written.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ResultsError {
    /// A row is invalid.
    #[error("{}: {row}", path.display())]
    Row {
        /// The file.
        path: PathBuf,
        /// Line, column and what is wrong.
        row: BadRow,
    },
    /// The file is not text.
    #[error("{}: line {line}: not UTF-8 text; is this a CSV file?", path.display())]
    NotText {
        /// The file.
        path: PathBuf,
        /// Line, from one.
        line: usize,
    },
    /// The system could not read the file.
    #[error("{}: cannot be read: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The system could not write the file.
    #[error("{}: cannot be written: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
}

/// A row that is not an estimate.
#[derive(Debug, Error, Clone, PartialEq, Eq)]
#[error("line {line}, column {column}: found {found}, expected {expected}")]
pub struct BadRow {
    /// Line in the file, from one.
    pub line: usize,
    /// Name of the column.
    pub column: &'static str,
    /// Its value.
    pub found: String,
    /// The expected value.
    pub expected: String,
}

/// Reads a result file; any bad row is an error.
///
/// # Errors
/// [`ResultsError`] naming file, line and column.
pub fn read_results(path: &Path) -> Result<Vec<Estimate>, ResultsError> {
    let (estimates, mut skipped) = read_results_lenient(path)?;
    if skipped.is_empty() {
        return Ok(estimates);
    }
    Err(ResultsError::Row { path: path.to_owned(), row: skipped.swap_remove(0) })
}

/// Reads a result file and keeps the good rows; the bad ones are reported in the order of the file.
///
/// # Errors
/// [`ResultsError::Read`] and [`ResultsError::NotText`] only.
pub fn read_results_lenient(path: &Path) -> Result<(Vec<Estimate>, Vec<BadRow>), ResultsError> {
    let bytes = sixfold_io::read_regular(path, sixfold_io::limits::LARGE_TEXT)
        .map_err(|source| ResultsError::Read { path: path.to_owned(), source })?;
    let text = std::str::from_utf8(&bytes).map_err(|e| ResultsError::NotText {
        path: path.to_owned(),
        line: 1 + bytes[..e.valid_up_to()].iter().filter(|&&b| b == b'\n').count(),
    })?;
    Ok(parse_results(text))
}

/// Parses the text of a result file: good rows and bad rows, in order.
pub fn parse_results(text: &str) -> (Vec<Estimate>, Vec<BadRow>) {
    let (mut estimates, mut bad) = (Vec::new(), Vec::new());
    for (index, line) in text.trim_start_matches('\u{feff}').lines().enumerate() {
        let is_header = index == 0 && line.trim() == HEADER;
        if is_header || line.trim().is_empty() {
            continue;
        }
        match parse_row(line, index + 1) {
            Ok(estimate) => estimates.push(estimate),
            Err(row) => bad.push(row),
        }
    }
    (estimates, bad)
}

fn shorten(text: &str) -> String {
    let text = text.trim();
    if text.chars().count() <= 60 {
        return format!("{text:?}");
    }
    format!("{:?}...", text.chars().take(57).collect::<String>())
}

fn parse_row(line: &str, number: usize) -> Result<Estimate, BadRow> {
    let columns: Vec<&str> = line.split(',').map(str::trim).collect();
    let bad = |column: usize, found: String, expected: &str| BadRow {
        line: number,
        column: COLUMNS[column],
        found,
        expected: expected.to_owned(),
    };
    if columns.len() != COLUMNS.len() {
        return Err(BadRow {
            line: number,
            column: "(all)",
            found: format!("{} columns: {}", columns.len(), shorten(line)),
            expected: format!("7 columns: {HEADER}"),
        });
    }
    let id = |column: usize| {
        let text = columns[column];
        text.parse::<u32>().map_err(|_| bad(column, shorten(text), "a whole number from 0"))
    };
    let number_in = |column: usize, text: &str| {
        text.parse::<f64>()
            .ok()
            .filter(|v| v.is_finite())
            .ok_or_else(|| bad(column, shorten(text), "finite numbers"))
    };
    let numbers = |column: usize, expected: &str, into: &mut [f64]| {
        let texts: Vec<&str> = columns[column].split_whitespace().collect();
        if texts.len() != into.len() {
            return Err(bad(
                column,
                format!("{} numbers: {}", texts.len(), shorten(columns[column])),
                expected,
            ));
        }
        for (value, text) in into.iter_mut().zip(texts) {
            *value = number_in(column, text)?;
        }
        Ok(())
    };
    let (scene_id, im_id, obj_id) = (id(0)?, id(1)?, id(2)?);
    let score = number_in(3, columns[3])?;
    let (mut r, mut t) = ([0.0; 9], [0.0; 3]);
    numbers(4, "9 numbers with spaces between, the rotation row by row", &mut r)?;
    numbers(5, "3 numbers with spaces between, the translation in mm", &mut t)?;
    let time = number_in(6, columns[6])?;
    let camera_from_object = Pose::from_parts(&Mat3::from_row_slice(&r), Vec3::from(t) / 1000.0)
        .map_err(|e| bad(4, format!("{} ({e})", shorten(columns[4])), "a rotation"))?;
    let time = (time >= 0.0).then_some(time);
    let rotation_as_written = Some(Mat3::from_row_slice(&r));
    Ok(Estimate { scene_id, im_id, obj_id, score, camera_from_object, time, rotation_as_written })
}

fn format_row(estimate: &Estimate) -> String {
    let join = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    format!(
        "{},{},{},{},{},{},{}\n",
        estimate.scene_id,
        estimate.im_id,
        estimate.obj_id,
        estimate.score,
        join(&rotation_rows(&estimate.placement().rotation)),
        join(&translation_mm(&estimate.camera_from_object)),
        estimate.time.unwrap_or(-1.0),
    )
}

/// Writes a result file, whole or not at all.
///
/// # Errors
/// [`ResultsError::Write`].
pub fn write_results(path: &Path, estimates: &[Estimate]) -> Result<(), ResultsError> {
    let mut text = format!("{HEADER}\n");
    text.extend(estimates.iter().map(format_row));
    write_atomically(path, text.as_bytes())
        .map_err(|source| ResultsError::Write { path: path.to_owned(), source })
}

/// A result file that grows. The rows of an interrupted run are kept; an incomplete last line is dropped.
#[derive(Debug)]
pub struct ResultsAppender {
    path: PathBuf,
    file: File,
    existing: Vec<Estimate>,
    torn: Option<String>,
}

impl ResultsAppender {
    /// Opens or creates the file and reads what is there. A last line without a line break is taken to be incomplete
    /// and is removed from the file: it can be computed again, while a truncated number cannot be distinguished from a
    /// whole one.
    ///
    /// # Errors
    /// [`ResultsError`]; any other bad row is an error, as in [`read_results`].
    pub fn open(path: &Path) -> Result<Self, ResultsError> {
        let write_error = |source| ResultsError::Write { path: path.to_owned(), source };
        make_folder_of(path).map_err(write_error)?;
        let mut file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(path)
            .map_err(write_error)?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)
            .map_err(|source| ResultsError::Read { path: path.to_owned(), source })?;
        let whole = bytes.iter().rposition(|&b| b == b'\n').map_or(0, |i| i + 1);
        let torn = (whole < bytes.len()).then(|| String::from_utf8_lossy(&bytes[whole..]).into_owned());
        let text = std::str::from_utf8(&bytes[..whole]).map_err(|e| ResultsError::NotText {
            path: path.to_owned(),
            line: 1 + bytes[..e.valid_up_to()].iter().filter(|&&b| b == b'\n').count(),
        })?;
        let (existing, mut bad) = parse_results(text);
        if !bad.is_empty() {
            return Err(ResultsError::Row { path: path.to_owned(), row: bad.swap_remove(0) });
        }
        file.set_len(whole as u64).map_err(write_error)?;
        file.seek(SeekFrom::End(0)).map_err(write_error)?;
        if whole == 0 {
            file.write_all(format!("{HEADER}\n").as_bytes()).map_err(write_error)?;
            sync_folder_of(path).map_err(write_error)?;
        }
        Ok(ResultsAppender { path: path.to_owned(), file, existing, torn })
    }

    /// The estimates in the file when it was opened.
    pub fn existing(&self) -> &[Estimate] {
        &self.existing
    }

    /// The incomplete last line that was dropped, for a message.
    pub fn torn(&self) -> Option<&str> {
        self.torn.as_deref()
    }

    /// Appends the estimates of one image in a single write and flushes them to the disk.
    ///
    /// # Errors
    /// [`ResultsError::Write`].
    pub fn append(&mut self, estimates: &[Estimate]) -> Result<(), ResultsError> {
        let text: String = estimates.iter().map(format_row).collect();
        self.file
            .write_all(text.as_bytes())
            .and_then(|()| self.file.sync_data())
            .map_err(|source| ResultsError::Write { path: self.path.clone(), source })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use sixfold_geometry::nalgebra::Vector6;

    const GOOD: &str = "scene_id,im_id,obj_id,score,R,t,time\n\
        2,96,6,0.75,1 0 0 0 1 0 0 0 1,10 -20 1000,37.5\n\
        2,96,1,-3e-2,0 -1 0 1 0 0 0 0 1,0 0 500,-1\n";

    #[test]
    fn rows_become_estimates_in_metres() {
        let (rows, bad) = parse_results(GOOD);
        assert!(bad.is_empty(), "{bad:?}");
        assert_eq!((rows[0].scene_id, rows[0].im_id, rows[0].obj_id, rows[0].score), (2, 96, 6, 0.75));
        assert!((rows[0].camera_from_object.translation() - Vec3::new(0.01, -0.02, 1.0)).norm() < 1e-15);
        assert_eq!((rows[0].time, rows[1].time), (Some(37.5), None));
        // Without header, with Windows line ends and without a last line end.
        let (again, bad) = parse_results(GOOD.split_once('\n').unwrap().1.replace('\n', "\r\n").trim_end());
        assert!(bad.is_empty());
        assert_eq!(again, rows);
    }

    #[test]
    fn bad_rows_are_named_and_the_rest_is_kept() {
        let cases = [
            ("2,96,6,0.7,1 0 0 0 1 0 0 0 1,1 2 3", "column (all): found 6 columns"),
            ("2,96,6,0.7,1 0 0 0 1 0 0 0 1,1 2 3,1,9", "found 8 columns"),
            ("2,96,6,nan,1 0 0 0 1 0 0 0 1,1 2 3,1", "column score: found \"nan\""),
            ("2,96,6,0.7,1 0 0 0 1 0 0 0 inf,1 2 3,1", "column R"),
            ("2,96,6,0.7,1 0 0 0 1 0 0 0,1 2 3,1", "column R: found 8 numbers"),
            ("2,96,6,0.7,1 0 0 0 1 0 0 0 2,1 2 3,1", "expected a rotation"),
            ("2,96,6,0.7,1 0 0 0 1 0 0 0 1,1 NaN 3,1", "column t: found \"NaN\""),
            ("2,96,duck,0.7,1 0 0 0 1 0 0 0 1,1 2 3,1", "column obj_id: found \"duck\""),
            ("-2,96,6,0.7,1 0 0 0 1 0 0 0 1,1 2 3,1", "column scene_id"),
            ("2,96,6,0.7,1 0 0 0 1 0 0 0 1,1 2 3,soon", "column time"),
        ];
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("method_lmo-test.csv");
        for (row, part) in cases {
            std::fs::write(&path, format!("{GOOD}{row}\n2,97,6,0.1,1 0 0 0 1 0 0 0 1,1 2 3,1\n")).unwrap();
            let message = read_results(&path).unwrap_err().to_string();
            assert!(message.contains("line 4") && message.contains(part), "{message} lacks {part}");
            assert!(message.contains("method_lmo-test.csv"), "{message}");
            let (kept, skipped) = read_results_lenient(&path).unwrap();
            assert_eq!((kept.len(), skipped.len()), (3, 1));
        }
        std::fs::write(&path, b"2,96,6\n\xff\xfe").unwrap();
        assert!(read_results(&path).unwrap_err().to_string().contains("line 2: not UTF-8"));
        assert!(matches!(read_results(&dir.path().join("gone.csv")), Err(ResultsError::Read { .. })));
    }

    fn estimate(im_id: u32, t: [f64; 6]) -> Estimate {
        Estimate {
            scene_id: 1,
            im_id,
            obj_id: 5,
            score: 0.1 * f64::from(im_id),
            camera_from_object: Pose::exp(&Vector6::from(t)),
            time: im_id.is_multiple_of(2).then_some(0.25),
            rotation_as_written: None,
        }
    }

    #[test]
    fn appending_after_a_crash_drops_the_torn_line_and_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("out/run.csv");
        let all: Vec<Estimate> = (0..4).map(|i| estimate(i, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6])).collect();
        let mut appender = ResultsAppender::open(&path).unwrap();
        assert!(appender.existing().is_empty());
        appender.append(&all[..2]).unwrap();
        drop(appender);
        let whole = std::fs::read(&path).unwrap();
        let mut torn = whole.clone();
        torn.extend_from_slice(b"1,2,5,0.2,0.8 0.1");
        std::fs::write(&path, &torn).unwrap();
        let mut appender = ResultsAppender::open(&path).unwrap();
        assert_eq!(appender.existing().len(), 2);
        assert_eq!(appender.torn(), Some("1,2,5,0.2,0.8 0.1"));
        assert_eq!(std::fs::read(&path).unwrap(), whole);
        appender.append(&all[2..]).unwrap();
        assert_eq!(read_results(&path).unwrap().len(), 4);
        let written_at_once = dir.path().join("once.csv");
        write_results(&written_at_once, &all).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), std::fs::read(&written_at_once).unwrap());
    }

    #[test]
    fn a_torn_header_starts_over_and_a_bad_row_inside_is_an_error() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("run.csv");
        std::fs::write(&path, "scene_id,im_").unwrap();
        drop(ResultsAppender::open(&path).unwrap());
        assert_eq!(std::fs::read_to_string(&path).unwrap(), format!("{HEADER}\n"));
        std::fs::write(&path, format!("{HEADER}\n1,2\n")).unwrap();
        assert!(ResultsAppender::open(&path).unwrap_err().to_string().contains("line 2"));
    }

    proptest! {
        #[test]
        fn a_written_file_reads_back(t in prop::array::uniform6(-2.0..2.0f64), im_id in 0u32..9) {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("r.csv");
            let e = estimate(im_id, t);
            write_results(&path, &[e]).unwrap();
            let back = read_results(&path).unwrap()[0];
            prop_assert!((back.camera_from_object.inverse() * e.camera_from_object).log().amax() < 1e-9);
            prop_assert_eq!((back.im_id, back.score, back.time), (e.im_id, e.score, e.time));
        }

        #[test]
        fn mutated_text_never_panics(at in 0usize..200, byte in 1u8..128, cut in 0usize..200) {
            let mut text = GOOD.as_bytes().to_vec();
            let at = at % text.len();
            text[at] = byte;
            text.truncate(cut.max(1));
            let _ = parse_results(std::str::from_utf8(&text).unwrap());
        }
    }
}
