//! Arguments of `sixfold demo`.

use std::path::PathBuf;

use clap::Args;
use sixfold_shell::output::JsonArguments;

#[derive(Debug, Args)]
pub(crate) struct DemoArguments {
    /// Folder for results and images
    #[arg(long, default_value = "out/demo", value_name = "DIR")]
    pub out: PathBuf,
    /// Folder of the sample data (default: the one that comes with Sixfold, docs/install.md)
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Weights for poses from colour (default: those that come with Sixfold)
    #[arg(long, value_name = "FILE.safetensors")]
    pub weights: Option<PathBuf>,
    /// Weights of the detector (default: those that come with Sixfold)
    #[arg(long, value_name = "FILE.safetensors")]
    pub detector: Option<PathBuf>,
    #[command(flatten)]
    pub json: JsonArguments,
}
