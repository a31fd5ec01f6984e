//! Arguments of `sixfold detect`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use sixfold_mesh::Unit;
use sixfold_shell::output::JsonArguments;

use super::estimate::arguments::{CacheArguments, StoreArguments};

/// How objects are detected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum DetectMethod {
    /// A trained network; without --weights one that proposes boxes of any object, without names
    Network,
    /// Rendered views of the objects give names to these boxes, then boxes and masks by the objects' poses; no training
    Views,
}

#[derive(Debug, Args)]
pub(crate) struct DetectArguments {
    /// How objects are detected
    #[arg(long, value_enum, default_value = "network")]
    pub method: DetectMethod,
    /// With --method views: objects to detect, mesh files or names given with `sixfold object add`; their ids are 1, 2, ... (in a dataset:
    /// its models, see --ids)
    #[arg(long = "object", value_name = "NAME_OR_MESH", num_args = 1.., conflicts_with = "dataset")]
    pub objects: Vec<String>,
    /// Unit of mesh files: m, cm, mm, in (not needed for stored objects)
    #[arg(long, value_name = "UNIT", requires = "objects")]
    pub unit: Option<Unit>,
    /// With --method views: name the proposed boxes only; several times as fast, but less exact
    #[arg(long)]
    pub quick: bool,
    /// Trained detector: a file that `sixfold train detector` wrote, or torchvision's weights of Faster R-CNN, Mask R-CNN or
    /// RetinaNet on ResNet-50 with a pyramid (.pth, .pt or .safetensors; a file NAME.objects.json beside them maps labels to
    /// objects). Without it, a detector of any object, which comes with the program, proposes boxes
    #[arg(long, value_name = "FILE")]
    pub weights: Option<PathBuf>,
    /// Colour images: PNG or JPEG of any size, grey or colour
    #[arg(long, value_name = "FILE", num_args = 1.., required_unless_present = "dataset", conflicts_with = "dataset")]
    pub rgb: Vec<PathBuf>,
    /// BOP dataset folder: detect in the images of its targets. After a stop, the same command resumes
    #[arg(long, value_name = "DIR", requires = "out")]
    pub dataset: Option<PathBuf>,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Targets file that lists the images (default: the dataset's test_targets_bop19.json, or all images)
    #[arg(long, value_name = "FILE", requires = "dataset", conflicts_with = "rgb")]
    pub targets: Option<PathBuf>,
    /// Leave out these frames of the dataset, such as those used for training: JSON, [{"scene_id": 2, "im_id": 36}, ...]
    #[arg(long, value_name = "FILE", requires = "dataset", conflicts_with = "rgb")]
    pub except: Option<PathBuf>,
    /// Result: a JSON file of COCO detections for a dataset, a folder for images
    #[arg(long, value_name = "PATH")]
    pub out: Option<PathBuf>,
    /// Folder for overlays of a dataset's images
    #[arg(long, value_name = "DIR", requires = "dataset", conflicts_with = "rgb")]
    pub overlays: Option<PathBuf>,
    /// Only these of the detector's objects (default: all)
    #[arg(long, value_name = "ID", value_delimiter = ',')]
    pub ids: Vec<u32>,
    /// Leave out detections with a lower score, 0 to 1 (default: the model's, 0.5 with --method views; 0.02 with --dataset, since average
    /// precision includes low scores)
    #[arg(long, value_name = "SCORE")]
    pub threshold: Option<f32>,
    /// If two boxes of an object overlap more than this (intersection over union), keep only the better one (default: 0.5; 0.6
    /// for boxes of any object)
    #[arg(long, value_name = "FRACTION")]
    pub overlap: Option<f32>,
    /// Maximum number of detections per object in an image (default: 100; 300 for boxes of any object)
    #[arg(long, value_name = "N")]
    pub per_object: Option<usize>,
    /// Maximum number of detections in an image (default: 100; 300 for boxes of any object)
    #[arg(long, value_name = "N")]
    pub max_detections: Option<usize>,
    /// Number of sizes at which an image is processed, each smaller by the square root of two (default: 1; 3 for boxes of any object;
    /// networks with anchors: 1 only)
    #[arg(long, value_name = "N")]
    pub scales: Option<usize>,
    /// Boxes only
    #[arg(long)]
    pub no_masks: bool,
    #[command(flatten)]
    pub store: StoreArguments,
    #[command(flatten)]
    pub cache: CacheArguments,
    #[command(flatten)]
    pub json: JsonArguments,
}
