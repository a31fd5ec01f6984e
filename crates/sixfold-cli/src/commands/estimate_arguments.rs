//! What `sixfold estimate` is told, by whatever method.

use std::num::NonZeroUsize;
use std::path::PathBuf;

use clap::{Args, ValueEnum};
use sixfold_mesh::Unit;
use sixfold_shell::output::JsonArguments;

use super::mttm::arguments::Matcher;

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Method {
    /// Point pair features on depth, no training
    Ppf,
    /// Object coordinates from colour by a trained network, in boxes
    Pix2pose,
    /// Templates in depth, from a mesh or from depth images of the object, no training
    Mttm,
}

impl Method {
    /// As it is typed.
    pub fn name(self) -> &'static str {
        match self {
            Method::Ppf => "ppf",
            Method::Pix2pose => "pix2pose",
            Method::Mttm => "mttm",
        }
    }
}

#[derive(Debug, Args)]
pub(crate) struct EstimateArguments {
    /// How poses are found
    #[arg(long, value_enum, default_value = "ppf")]
    pub method: Method,
    /// Trained model for --method pix2pose: a file that `sixfold train pix2pose` wrote; for --method mttm another network than
    /// that within the program
    #[arg(long, value_name = "FILE.safetensors")]
    pub weights: Option<PathBuf>,
    /// Leave out the last step of --method pix2pose, which aligns the rendered mesh with the image
    #[arg(long)]
    pub no_refine: bool,
    /// Most looks of --method pix2pose at an object: each but the first is into the box of the pose before, which helps where
    /// boxes are poor and takes as long again (default: 1)
    #[arg(long, value_name = "N")]
    pub looks: Option<NonZeroUsize>,
    /// Which of the model's objects --method pix2pose looks for in one image (default: its only one)
    #[arg(long, value_name = "ID", conflicts_with = "dataset")]
    pub object_id: Option<u32>,
    /// Align the poses of --method pix2pose with the depth image (ICP)
    #[arg(long)]
    pub icp: bool,
    /// Who matches regions with templates in --method mttm
    #[arg(long, value_enum, default_value = "both")]
    pub matcher: Matcher,
    /// Judge the poses of --method mttm by its templates alone, as if there were no mesh
    #[arg(long)]
    pub templates_only: bool,
    /// Colour image: what pix2pose works on, else for the overlay
    #[arg(long, value_name = "FILE", requires = "camera")]
    pub rgb: Option<PathBuf>,
    /// Depth image: PNG, one channel of 16 bits
    #[arg(long, value_name = "FILE", requires = "camera", conflicts_with = "dataset")]
    pub depth: Option<PathBuf>,
    /// Camera: a JSON file with fx fy cx cy or cam_K, and depth_scale (millimetres per unit of the depth image)
    #[arg(long, value_name = "FILE", conflicts_with = "dataset")]
    pub camera: Option<PathBuf>,
    /// Millimetres per unit of the depth image, in place of the camera file's depth_scale
    #[arg(long, value_name = "MM")]
    pub depth_scale: Option<f64>,
    /// Objects to look for: mesh files, or names given with `sixfold object add`
    #[arg(long = "object", value_name = "NAME_OR_MESH", num_args = 1.., conflicts_with = "dataset")]
    pub objects: Vec<String>,
    /// Unit of mesh files: m, cm, mm, in (meshes in the store know theirs)
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// The object lies in this mask (PNG, above zero inside)
    #[arg(long, value_name = "FILE", conflicts_with = "dataset")]
    pub mask: Option<PathBuf>,
    /// The object lies in this box, in pixels
    #[arg(
        long = "box",
        value_name = "X,Y,W,H",
        value_delimiter = ',',
        allow_hyphen_values = true,
        conflicts_with = "dataset"
    )]
    pub region: Option<Vec<f64>>,
    /// Most instances of each object (in a dataset: what its targets say)
    #[arg(long, value_name = "N", default_value = "1")]
    pub instances: NonZeroUsize,
    /// BOP dataset folder: estimate all its targets
    #[arg(long, value_name = "DIR", requires = "out")]
    pub dataset: Option<PathBuf>,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Targets file of the dataset (default: its test_targets_bop19.json, or all ground truth)
    #[arg(long, value_name = "FILE", requires = "dataset")]
    pub targets: Option<PathBuf>,
    /// Leave out these frames of the dataset, such as those of a training: JSON, [{"scene_id": 2, "im_id": 36}, ...]
    #[arg(long, value_name = "FILE", requires = "dataset")]
    pub except: Option<PathBuf>,
    /// Where the objects are: gt for the ground truth's boxes, detect for those of --detector, or a file of COCO
    /// detections (default: detect with --detector, else anywhere)
    #[arg(long, value_name = "gt|detect|FILE", requires = "dataset")]
    pub boxes: Option<String>,
    /// Trained detector that says where the objects are: a file that `sixfold train detector` wrote
    #[arg(long, value_name = "FILE.safetensors")]
    pub detector: Option<PathBuf>,
    /// Result: a CSV file in the BOP format for a dataset, a folder for one image
    #[arg(long, value_name = "PATH")]
    pub out: Option<PathBuf>,
    /// Folder for overlay pictures of a dataset's images
    #[arg(long, value_name = "DIR", requires = "dataset")]
    pub overlays: Option<PathBuf>,
    /// Leave out poses with a lower confidence, 0 to 1 (default: 0.25 for one image, 0.05 for a dataset, 0
    /// with --method pix2pose, 0.45 for one image with --method mttm)
    #[arg(long, value_name = "SCORE")]
    pub min_score: Option<f64>,
    /// Match points on the table plane too
    #[arg(long)]
    pub keep_plane: bool,
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
    /// Seed of everything random
    #[arg(long, default_value = "0")]
    pub seed: u64,
    #[command(flatten)]
    pub json: JsonArguments,
}

impl EstimateArguments {
    /// Whether poses from colour are aligned with the image.
    pub fn refines(&self) -> bool {
        self.method == Method::Pix2pose && !self.no_refine
    }
}
