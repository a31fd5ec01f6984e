//! BOP datasets, result files, pose errors and scores.
//!
//! Millimetres exist in the files only; everything here is in metres, radians and pixels. The short way from a result
//! file to scores: [`BopDataset::open`], [`read_results`], [`BopDataset::targets`], [`evaluate`].

#![deny(clippy::print_stdout, clippy::print_stderr)]
#![warn(unreachable_pub, unnameable_types)]

mod coco;
mod coco_rows;
mod coco_score;
mod coco_truth;
mod dataset;
mod dataset_error;
mod errors;
mod evaluate;
pub mod import;
mod json;
mod plot;
mod points;
mod results;
mod rle;
mod scene_files;
mod score;
mod simulate;
mod table;
mod visibility;
mod write;

pub use coco::{
    AdjustedDetection, Adjustment, Annotation, CocoGroundTruth, Detection, Detections, ReadDetections,
    parse_detections, read_detections, write_detections,
};
pub use coco_rows::DetectionRows;
pub use coco_score::{CocoScores, IouType, evaluate_coco};
pub use coco_truth::{DetectionScores, FoundAtHalf, VisibleTruth, found_at_half, score_detections};
pub use dataset::{BopDataset, MaskKind, Models, Scene, SceneImage};
pub use dataset_error::{DatasetError, Place};
pub use errors::{
    PUBLISHED_TAU, Placement, Taus, VsdError, VsdOptions, add, add_s, adi, mspd, mssd, projection_error,
    rotation_error, translation_error, vsd,
};
pub use evaluate::{
    Curves, DetectionEvaluation, EvalError, EvalOptions, Evaluation, ObjectScores, RecallCurves, evaluate,
    evaluate_detection,
};
pub use plot::{draw_recall_curves, write_recall_curves};
pub use points::ModelPoints;
pub use results::{
    BadRow, Estimate, ResultsAppender, ResultsError, parse_results, read_results, read_results_lenient,
    write_results,
};
pub use rle::{Rle, RleError};
pub use scene_files::{
    GroundTruth, GroundTruthInfo, ImageCamera, Target, TargetObject, parse_scene_camera, parse_scene_gt,
    parse_scene_gt_info, parse_targets,
};
pub use score::{area_under_accuracy, average_precision, recall_below};
pub use simulate::DepthSimulation;
pub use table::{detection_score_table, score_table};
pub use visibility::{ObjectVisibility, VISIBILITY_DELTA, ground_truth_visibility};
pub use write::{NewImage, SceneWriter, write_camera, write_targets};
