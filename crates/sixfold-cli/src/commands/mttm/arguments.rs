//! The command line of template matching.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use sixfold_mttm::{Coverage, MatchedBy};

/// From which sides templates are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum TemplateViews {
    /// From above, the camera held upright: 305 views with 7 turns, for what stands on a table, z axis up
    Above,
    /// From everywhere and however the camera is held: 642 views with 24 turns
    Around,
}

impl TemplateViews {
    pub fn coverage(self) -> Coverage {
        match self {
            TemplateViews::Above => Coverage::Above,
            TemplateViews::Around => Coverage::Around,
        }
    }
}

/// Who matches regions with templates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Matcher {
    /// Template and region point by point, without a network
    Points,
    /// The network's descriptors alone, as in the dissertation
    Network,
    /// The network says where to look, and both say with which template
    Both,
}

impl Matcher {
    pub fn matched_by(self) -> MatchedBy {
        match self {
            Matcher::Points => MatchedBy::Points,
            Matcher::Network => MatchedBy::Network,
            Matcher::Both => MatchedBy::Both,
        }
    }
}

/// An object known from depth images, for `sixfold object add`.
#[derive(Debug, Args)]
pub(crate) struct DepthViewArguments {
    /// Depth images of an object that has no mesh: its templates for `estimate --method mttm`
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with = "mesh", requires = "masks", requires = "camera")]
    pub depth: Vec<PathBuf>,
    /// Where the object is in each of them (PNG, above zero inside), in the same order
    #[arg(long = "mask", value_name = "FILE", num_args = 1.., requires = "depth")]
    pub masks: Vec<PathBuf>,
    /// Camera of the depth images: a JSON file with fx fy cx cy or cam_K, and depth_scale
    #[arg(long, value_name = "FILE", requires = "depth")]
    pub camera: Option<PathBuf>,
    /// Millimetres per unit of the depth images, in place of the camera file's depth_scale
    #[arg(long, value_name = "MM", requires = "depth")]
    pub depth_scale: Option<f64>,
    /// The object's pose in each image, if known: a JSON file with a list of 4x4 matrices camera_from_object, row by row, in
    /// metres (default: every view has a frame of its own)
    #[arg(long, value_name = "FILE", requires = "depth")]
    pub poses: Option<PathBuf>,
}
