//! The fitted models, one for each combination of images (depth, colour, both), and for colour one more without the numbers of a search; and their file.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::numbers::{NAMES, Numbers, OF_COLOR, OF_DEPTH, OF_OTHERS, OF_POSE, OF_SEARCH};
use crate::regression::{Fit, LogisticModel, fit};

/// Version of the file format.
const VERSION: u32 = 2;

/// Why a calibration cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CalibrationError {
    /// The file cannot be read.
    #[error("{}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The file is not a calibration.
    #[error("{file}: {reason}; expected a file that `sixfold reproduce auto --fit FILE` wrote")]
    Content {
        /// The file.
        file: String,
        /// What is wrong.
        reason: String,
    },
}

/// Models that turn the numbers of a pose into a probability.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    version: u32,
    /// The names of the numbers, equal to [`NAMES`].
    names: Vec<String>,
    /// With depth alone.
    depth: LogisticModel,
    /// With colour alone, for the pose of one instance from a search of the whole image.
    color: LogisticModel,
    /// With colour alone, for a pose in a given region and for several instances: without the numbers of such a search.
    color_without_search: LogisticModel,
    /// With both.
    both: LogisticModel,
}

impl Calibration {
    /// The shipped calibration.
    ///
    /// # Errors
    /// [`CalibrationError::Content`]; never if the tests pass.
    pub fn shipped() -> Result<Calibration, CalibrationError> {
        Calibration::parse(include_str!("../calibration.json"), "calibration.json within the program")
    }

    /// Reads a file.
    ///
    /// # Errors
    /// [`CalibrationError`].
    pub fn read(path: &Path) -> Result<Calibration, CalibrationError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| CalibrationError::Read { path: path.to_owned(), source })?;
        Calibration::parse(&text, &path.display().to_string())
    }

    fn parse(text: &str, file: &str) -> Result<Calibration, CalibrationError> {
        let content = |reason: String| CalibrationError::Content { file: file.to_owned(), reason };
        let read: Calibration = serde_json::from_str(text).map_err(|e| content(e.to_string()))?;
        if read.version != VERSION {
            return Err(content(format!("field version: found {}, expected {VERSION}", read.version)));
        }
        if read.names != NAMES {
            return Err(content("field names: found other numbers than this version knows".to_owned()));
        }
        let models = [
            ("depth", &read.depth),
            ("color", &read.color),
            ("color_without_search", &read.color_without_search),
            ("both", &read.both),
        ];
        if let Some((name, _)) = models.into_iter().find(|(_, model)| !model.is_whole()) {
            return Err(content(format!("field {name}: found lists of other lengths, or no finite numbers")));
        }
        Ok(read)
    }

    /// Fits the models for depth alone, colour alone (with and without the numbers of a search) and both; each from its rows and from those of them
    /// that would be reported. For an empty list the shipped model is kept.
    ///
    /// # Errors
    /// As [`Calibration::shipped`].
    pub fn fitted(rows: [(&[Fit<'_>], &[Fit<'_>]); 3]) -> Result<Calibration, CalibrationError> {
        let kept = Calibration::shipped()?;
        let model = |(all, reported): (&[Fit<'_>], &[Fit<'_>]),
                     ranges: &[std::ops::Range<usize>],
                     kept: LogisticModel| {
            let takes: Vec<usize> = ranges.iter().cloned().flatten().collect();
            if all.is_empty() { kept } else { fit(all, &takes).scaled_to(reported) }
        };
        let [depth, color, both] = rows;
        Ok(Calibration {
            version: VERSION,
            names: NAMES.map(str::to_owned).to_vec(),
            depth: model(depth, &[OF_DEPTH, OF_OTHERS], kept.depth),
            color: model(color, &[OF_COLOR, OF_OTHERS, OF_POSE, OF_SEARCH], kept.color),
            color_without_search: model(color, &[OF_COLOR, OF_OTHERS, OF_POSE], kept.color_without_search),
            both: model(both, &[OF_DEPTH, OF_COLOR, OF_OTHERS], kept.both),
        })
    }

    /// The probability that a pose is right; 0 if no number of it is known.
    pub fn probability(&self, numbers: &Numbers) -> f64 {
        let known = |mut range: std::ops::Range<usize>| range.any(|k| numbers[k].is_some());
        let searched = OF_SEARCH.into_iter().all(|k| numbers[k].is_some());
        match (known(OF_DEPTH), known(OF_COLOR)) {
            (true, true) => self.both.probability(numbers),
            (true, false) => self.depth.probability(numbers),
            (false, true) if searched => self.color.probability(numbers),
            (false, true) => self.color_without_search.probability(numbers),
            (false, false) => 0.0,
        }
    }

    /// The content of the calibration file.
    pub fn to_text(&self) -> String {
        // Numbers, lists and strings can always be serialised.
        serde_json::to_string_pretty(self).unwrap_or_default() + "\n"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_one_within_the_program_is_whole_and_broken_ones_are_named() {
        let shipped = Calibration::shipped().unwrap();
        let text = shipped.to_text();
        assert_eq!(Calibration::parse(&text, "x").unwrap(), shipped);
        let broken = |from: &str, to: &str| {
            Calibration::parse(&text.replacen(from, to, 1), "x.json").unwrap_err().to_string()
        };
        assert!(broken("\"version\": 2", "\"version\": 9").contains("field version: found 9, expected 2"));
        assert!(broken("\"pixels\"", "\"inches\"").contains("field names"));
        assert!(broken("\"scaling\": [", "\"scaling\": [1,").contains("x.json"));
        let none = Calibration::read(Path::new("/nowhere/calibration.json")).unwrap_err().to_string();
        assert!(none.starts_with("/nowhere/calibration.json: "), "{none}");
    }

    /// The shipped probability of a pose of which these numbers are known.
    fn probability(known: &[(&str, f64)]) -> f64 {
        let mut numbers: Numbers = [None; NAMES.len()];
        for (name, value) in known {
            numbers[NAMES.iter().position(|n| n == name).unwrap()] = Some(*value);
        }
        Calibration::shipped().unwrap().probability(&numbers)
    }

    #[test]
    fn without_depth_a_small_object_far_away_is_less_probable() {
        let image = [
            ("edges", 0.9),
            ("background_edges", 0.2),
            ("correlation", 0.6),
            ("tint", 0.03),
            ("similarity", 0.9),
        ];
        let others = [("gap_here", 0.4), ("gap_elsewhere", 0.4)];
        let at = |diameters: f64, search: &[(&str, f64)]| {
            probability(&[&image[..], &others, search, &[("distance", diameters.ln())]].concat())
        };
        // In a given region, of several instances, and of one that is searched in the whole image.
        let recognised = [("recognised", 0.4), ("support", 0.8)];
        for search in [&[][..], &recognised[..1], &recognised] {
            let [near, middle, far] = [3.0, 6.0, 12.0].map(|diameters| at(diameters, search));
            assert!(near > 0.8 && far < middle && middle < near - 0.02, "{near} {middle} {far}");
        }
        assert_eq!(at(6.0, &[]), at(6.0, &recognised[..1]));
    }

    #[test]
    fn a_pose_to_which_few_searches_lead_is_less_probable() {
        let image = [
            ("edges", 0.8),
            ("background_edges", 0.2),
            ("correlation", 0.4),
            ("tint", 0.1),
            ("similarity", 0.7),
            ("gap_here", 0.4),
            ("gap_elsewhere", 0.1),
            ("distance", 1.7),
        ];
        let of = |recognised: f64, support: f64| {
            probability(&[&image[..], &[("recognised", recognised), ("support", support)]].concat())
        };
        let (sure, alone, unlike) = (of(0.4, 0.8), of(0.4, 0.05), of(0.05, 0.8));
        assert!(sure > alone + 0.2 && sure > unlike + 0.05, "{sure} {alone} {unlike}");
    }

    #[test]
    fn better_evidence_is_more_probable() {
        let with = |score: f64| {
            let scores = ["depth", "boundary", "normals", "visible", "total"].map(|name| (name, score));
            let fixed =
                [("pixels", 8.0), ("relief", 0.6), ("pierced", 0.0), ("on_plane", 0.0), ("gap_here", 0.4)];
            probability(&[&scores[..], &fixed, &[("gap_elsewhere", score - 0.5)]].concat())
        };
        assert!(with(1.0) > 0.8 && with(0.3) < 0.2, "{} {}", with(1.0), with(0.3));
        assert_eq!(probability(&[]), 0.0);
    }
}
