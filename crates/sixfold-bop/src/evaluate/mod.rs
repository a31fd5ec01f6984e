//! Scores of a result file on a dataset: BOP'19 localisation (AR of VSD, MSSD, MSPD), ADD(-S) recall, and BOP'24
//! detection (AP of MSSD and MSPD).
//!
//! Definitions as in the BOP Challenge's evaluation (Hodan et al. 2020; docs of bop_toolkit): errors of the top
//! `inst_count` estimates per image and object against the most visible `inst_count` poses, greedy matching per
//! threshold, recall over all targets, mean over thresholds.

mod detection;
mod localisation;
mod options;
mod recall;
mod scores;
mod task_errors;
mod tasks;

pub use detection::evaluate_detection;
pub use localisation::evaluate;
pub use options::{EvalError, EvalOptions};
pub use scores::{Curves, DetectionEvaluation, Evaluation, ObjectScores, RecallCurves};
