//! Arguments of `sixfold reproduce nol`.

use std::path::PathBuf;

use clap::Args;

/// Shown under `sixfold reproduce nol --help`.
pub(crate) const AFTER_HELP: &str = "Example:\n  \
    sixfold reproduce nol --dataset lmo --frames data/lmo-training-frames.json --weights nol.safetensors --hope hope --out out/reproduce-nol\n\n\
    Finished rows are kept. After a stop, the same command resumes.";

#[derive(Debug, Args)]
pub(crate) struct ReproduceNolArguments {
    /// BOP dataset folder with ground truth, colour images and models with vertex colours
    #[arg(long, value_name = "DIR")]
    pub dataset: PathBuf,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// The photographs to learn from: JSON, [{"scene_id": 2, "im_id": 36}, ...]; views are compared with the other frames
    #[arg(long, value_name = "FILE")]
    pub frames: PathBuf,
    /// The network of NOL; without it only averaging and plain texturing are measured
    #[arg(long, value_name = "FILE.safetensors")]
    pub weights: Option<PathBuf>,
    /// Another network to render views with, such as one trained without its LSTM; may be given several times
    #[arg(long, value_name = "NAME=FILE.safetensors", value_parser = named_file)]
    pub compare: Vec<(String, PathBuf)>,
    /// A scene photographed by a static camera under several lamps (such as those of HOPE): two images as sources, the third
    /// predicted
    #[arg(long, value_name = "DIR")]
    pub hope: Option<PathBuf>,
    /// Folder for the table, its JSON, the images, and the finished rows
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// One disturbance instead of three, and a quarter of the views; the same command without it continues with the others
    #[arg(long)]
    pub quick: bool,
    /// Seed of the disturbances
    #[arg(long, default_value = "0")]
    pub seed: u64,
}

fn named_file(text: &str) -> Result<(String, PathBuf), String> {
    match text.split_once('=') {
        Some((name, file)) if !name.is_empty() && !file.is_empty() => Ok((name.to_owned(), file.into())),
        _ => Err("expected NAME=FILE.safetensors".to_owned()),
    }
}
