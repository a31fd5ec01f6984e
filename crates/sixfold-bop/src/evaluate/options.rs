//! Options of an evaluation (tolerances, thresholds, which poses count), and its errors.

use std::path::Path;

use thiserror::Error;

use crate::dataset::Models;
use crate::dataset_error::DatasetError;
use crate::errors::{Taus, VsdError, VsdOptions};
use crate::score::fractions_05_to_50;

/// Options of an evaluation. The default is the BOP Challenge's.
#[derive(Debug, Clone, PartialEq)]
pub struct EvalOptions {
    /// Step of discretised continuous symmetries, as a fraction of the diameter.
    pub max_symmetry_step: f64,
    /// VSD's tolerances.
    pub vsd: VsdOptions,
    /// A pose is right by VSD if its error is below a threshold; recall is the mean over these.
    pub vsd_thresholds: Vec<f64>,
    /// Whether VSD is computed, which renders every estimate and every target.
    pub compute_vsd: bool,
    /// Which poses are targets: `None` takes the `inst_count` most visible ones (BOP'19), a number takes those with
    /// at least that visible fraction.
    pub visib_gt_min: Option<f64>,
    /// Steps of the recall curves.
    pub curve_steps: usize,
    /// The model folder to use.
    pub models: Models,
}

impl Default for EvalOptions {
    fn default() -> Self {
        EvalOptions {
            max_symmetry_step: 0.01,
            vsd: VsdOptions::default(),
            vsd_thresholds: fractions_05_to_50(),
            compute_vsd: true,
            visib_gt_min: None,
            curve_steps: 50,
            models: Models::Evaluation,
        }
    }
}

/// Why an evaluation cannot be done at all.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum EvalError {
    /// An option is out of range.
    #[error("option {field}: found {found}, expected {expected}")]
    Option {
        /// Name of the option.
        field: &'static str,
        /// Its value.
        found: f64,
        /// The expected value.
        expected: &'static str,
    },
    /// The dataset is broken.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A depth image does not fit (cannot happen with images that passed the size check).
    #[error(transparent)]
    Vsd(#[from] VsdError),
    /// The receiver of the progress reports asked to stop.
    #[error("the evaluation was stopped")]
    Stopped,
}

/// The delta of ITODD in the BOP Challenge, metres; all other datasets use the default.
const ITODD: (&str, f64) = ("itodd", 0.005);
/// Threshold of VSD and minimum visible fraction of a target pose, in the benchmark of 2018 (Hodan, Michel et al. 2018, section
/// 4.2) and in table 3.6 of the dissertation.
const PUBLISHED: (f64, f64) = (0.3, 0.1);

impl EvalOptions {
    /// The options of the BOP Challenge for the dataset in a folder, which is recognised by the folder's name.
    pub fn for_dataset(folder: &Path) -> EvalOptions {
        let mut options = EvalOptions::default();
        if folder.file_name().is_some_and(|name| name.eq_ignore_ascii_case(ITODD.0)) {
            options.vsd.delta = ITODD.1;
        }
        options
    }

    /// The options of the benchmark of 2018, by which the dissertation scores T-LESS (section 3.4.4): VSD below 0.3 with a
    /// tolerance of 20 mm; targets are all poses that are at least 10 % visible.
    pub fn published() -> EvalOptions {
        let (threshold, visible) = PUBLISHED;
        EvalOptions {
            vsd: VsdOptions::published(),
            vsd_thresholds: vec![threshold],
            visib_gt_min: Some(visible),
            ..EvalOptions::default()
        }
    }

    /// How VSD is averaged, in words; `None` for the protocol of the BOP Challenge, where VSD counts for AR.
    pub(super) fn vsd_protocol(&self) -> Option<String> {
        let usual = EvalOptions::default();
        let same = self.vsd.taus == usual.vsd.taus
            && self.vsd_thresholds == usual.vsd_thresholds
            && self.vsd.missing_is_visible == usual.vsd.missing_is_visible;
        if same {
            return None;
        }
        let list = |values: &[f64], factor: f64| {
            let texts: Vec<String> =
                values.iter().map(|v| format!("{}", (v * factor * 1e6).round() / 1e6)).collect();
            texts.join(", ")
        };
        let taus = match &self.vsd.taus {
            Taus::Diameters(values) => format!("{} diameters", list(values, 1.0)),
            Taus::Metres(values) => format!("{} mm", list(values, 1000.0)),
        };
        let missing =
            if self.vsd.missing_is_visible { "" } else { ", nothing visible where depth is missing" };
        Some(format!("VSD below {} at tolerances of {taus}{missing}", list(&self.vsd_thresholds, 1.0)))
    }

    /// Tests every field.
    ///
    /// # Errors
    /// [`EvalError::Option`].
    pub fn check(&self) -> Result<(), EvalError> {
        let test = |ok: bool, field, found, expected| {
            if ok { Ok(()) } else { Err(EvalError::Option { field, found, expected }) }
        };
        let step = self.max_symmetry_step;
        test((1e-4..=1.0).contains(&step), "max_symmetry_step", step, "a fraction from 0.0001 to 1")?;
        let delta = self.vsd.delta;
        test(delta.is_finite() && delta >= 0.0, "vsd.delta", delta, "metres, zero or more")?;
        let taus = self.vsd.taus.values();
        test(!taus.is_empty(), "vsd.taus", 0.0, "at least one tau")?;
        for &tau in taus {
            test(
                tau.is_finite() && tau > 0.0,
                "vsd.taus",
                tau,
                "fractions of the diameter, or metres, above zero",
            )?;
        }
        test(!self.vsd_thresholds.is_empty(), "vsd_thresholds", 0.0, "at least one threshold")?;
        for &threshold in &self.vsd_thresholds {
            test((0.0..=1.0).contains(&threshold), "vsd_thresholds", threshold, "errors from 0 to 1")?;
        }
        let visible = self.visib_gt_min.unwrap_or(0.0);
        test((0.0..=1.0).contains(&visible), "visib_gt_min", visible, "a fraction from 0 to 1")?;
        let steps = self.curve_steps;
        test((1..=10_000).contains(&steps), "curve_steps", steps as f64, "from 1 to 10000")
    }
}
