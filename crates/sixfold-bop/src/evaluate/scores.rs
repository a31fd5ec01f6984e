//! The result of an evaluation.

use std::collections::BTreeMap;

use serde::Serialize;

/// Recall against threshold.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecallCurves {
    /// Unit of the thresholds: `diameters`, `pixels (image 640 wide)` or `discrepancy`.
    pub unit: &'static str,
    /// The thresholds, ascending from zero.
    pub thresholds: Vec<f64>,
    /// Recall of each object at each threshold, by object id.
    pub objects: BTreeMap<String, Vec<f64>>,
    /// Recall over all targets.
    pub mean: Vec<f64>,
}

/// The curves of an evaluation, `None` for errors that could not be computed.
#[derive(Debug, Clone, PartialEq, Serialize, Default)]
pub struct Curves {
    /// Maximum symmetry-aware surface distance.
    pub mssd: Option<RecallCurves>,
    /// Maximum symmetry-aware projection distance.
    pub mspd: Option<RecallCurves>,
    /// Visible surface discrepancy, mean over the taus.
    pub vsd: Option<RecallCurves>,
    /// ADD, or ADI for symmetric objects.
    pub add: Option<RecallCurves>,
}

/// The scores of one object.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ObjectScores {
    /// Poses to be found.
    pub targets: usize,
    /// Average recall of VSD.
    pub ar_vsd: Option<f64>,
    /// Average recall of MSSD.
    pub ar_mssd: Option<f64>,
    /// Average recall of MSPD.
    pub ar_mspd: Option<f64>,
    /// Recall of ADD (ADI for symmetric objects) at 10 % of the diameter.
    pub add_s_recall: Option<f64>,
}

/// The scores of a result file. A score that cannot be computed is `None`, and `reasons` states why under the score's
/// name.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evaluation {
    /// Mean of the three average recalls.
    pub ar: Option<f64>,
    /// Average recall of VSD over taus and thresholds; with one of each, the recall.
    pub ar_vsd: Option<f64>,
    /// How VSD is averaged, where it differs from the BOP Challenge.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub vsd_protocol: Option<String>,
    /// Average recall of MSSD, over thresholds .05 to .5 diameters.
    pub ar_mssd: Option<f64>,
    /// Average recall of MSPD, over thresholds 5 to 50 px at an image width of 640.
    pub ar_mspd: Option<f64>,
    /// Recall of ADD (ADI for symmetric objects) at 10 % of the diameter: by object id, `mean` over all targets (each
    /// pose counts the same), `mean_over_objects` (each object counts the same).
    pub add_s_recall: BTreeMap<String, Option<f64>>,
    /// Area under the accuracy-threshold curve of ADD to 10 cm, over all targets (PoseCNN, Xiang et al. 2018).
    pub add_auc: Option<f64>,
    /// The same for ADD-S, computed for every object, symmetric or not.
    pub add_s_auc: Option<f64>,
    /// Why a score is missing.
    pub reasons: BTreeMap<String, String>,
    /// Poses to be found.
    pub targets: usize,
    /// Estimates that were compared with ground truth.
    pub estimates: usize,
    /// Estimates of images or objects that are not targets, or beyond the number of instances requested.
    pub estimates_left_out: usize,
    /// Mean seconds per image.
    pub average_time_per_image: Option<f64>,
    /// By object id.
    pub objects: BTreeMap<String, ObjectScores>,
    /// Recall against threshold.
    pub curves: Curves,
}

/// Scores of 6D detection (BOP'24): every instance of every object is a target, and false detections lower the score.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DetectionEvaluation {
    /// Mean of `ap_mssd` and `ap_mspd`.
    pub ap: Option<f64>,
    /// Average precision over MSSD thresholds .05 to .5 diameters, mean over objects.
    pub ap_mssd: Option<f64>,
    /// Average precision over MSPD thresholds 5 to 50 px at a width of 640, mean over objects.
    pub ap_mspd: Option<f64>,
    /// Average precision over MSSD thresholds 2 to 20 mm, mean over objects (BOP'25).
    pub ap_mssd_mm: Option<f64>,
    /// The mean of `ap_mssd` and `ap_mspd` of each object, by id.
    pub objects: BTreeMap<String, f64>,
    /// Why a score is missing.
    pub reasons: BTreeMap<String, String>,
}
