//! Arguments of `sixfold demo`.

use std::path::PathBuf;

use clap::Args;
use sixfold_shell::output::JsonArguments;

#[derive(Debug, Args)]
pub(crate) struct DemoArguments {
    /// Folder for results and images
    #[arg(long, default_value = "out/demo", value_name = "DIR")]
    pub out: PathBuf,
    /// Folder of the sample data (default: data/demo of this repository)
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Weights for poses from colour (default: weights/pix2pose-lmo.safetensors of this repository)
    #[arg(long, value_name = "FILE.safetensors")]
    pub weights: Option<PathBuf>,
    /// Weights of the detector (default: weights/detector-lmo.safetensors of this repository)
    #[arg(long, value_name = "FILE.safetensors")]
    pub detector: Option<PathBuf>,
    #[command(flatten)]
    pub json: JsonArguments,
}
