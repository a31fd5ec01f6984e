//! `sixfold import`: converts datasets of other formats to BOP datasets.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, Subcommand};
use serde_json::{Value, json};
use sixfold_bop::DatasetError;
use sixfold_bop::import::{
    Ho3dOptions, ImportSummary, NolOptions, SmotOptions, import_ho3d, import_nol, import_smot,
};
use sixfold_shell::Outcome;
use sixfold_shell::folder::{Contents, DatasetFolder};
use sixfold_shell::output::{JsonArguments, report};
use sixfold_shell::progress::{Bar, check_interrupt};
use sixfold_shell::ranges::{count, folder_name};

/// Written last: if it is missing, an import was interrupted.
const SCENES: &str = "scenes.json";

#[derive(Debug, Args)]
pub(crate) struct ImportArguments {
    #[command(subcommand)]
    pub format: Format,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Format {
    /// HO-3D (Hampali et al. 2020), version 2 or 3: hands that hold YCB objects
    #[command(
        after_help = "Example:\n  sixfold import ho3d HO3D --models YCB_Video_Models/models --every 30 --out out/ho3d"
    )]
    Ho3d(Ho3dArguments),
    /// SMOT, the dataset of the dissertation's chapter 4
    #[command(after_help = "Example:\n  sixfold import smot SMOT --split train --out out/smot")]
    Smot(SmotArguments),
    /// Source images of NOL in an HDF5 file of the author's code
    #[command(
        after_help = "Example:\n  sixfold import nol obj_01.hdf5 --camera camera_SMOT.json --out out/nol-source"
    )]
    Nol(NolArguments),
}

#[derive(Debug, Args)]
pub(crate) struct Ho3dArguments {
    /// Folder with train and evaluation
    #[arg(value_name = "SOURCE")]
    pub source: PathBuf,
    /// Split to convert
    #[arg(long, default_value = "train", value_parser = folder_name)]
    pub split: String,
    /// Folder of the YCB-Video models, with 003_cracker_box/textured_simple.obj and so on
    #[arg(long, value_name = "DIR")]
    pub models: PathBuf,
    /// Sequences to convert, such as ABF10 (default: all)
    #[arg(long, value_name = "NAME", value_delimiter = ',', value_parser = folder_name)]
    pub sequences: Vec<String>,
    #[command(flatten)]
    pub common: CommonArguments,
}

#[derive(Debug, Args)]
pub(crate) struct SmotArguments {
    /// Folder with camera_intrinsic.json, models and train
    #[arg(value_name = "SOURCE")]
    pub source: PathBuf,
    /// Split to convert
    #[arg(long, default_value = "train", value_parser = folder_name)]
    pub split: String,
    #[command(flatten)]
    pub common: CommonArguments,
}

#[derive(Debug, Args)]
pub(crate) struct NolArguments {
    /// HDF5 file of one object
    #[arg(value_name = "SOURCE.hdf5")]
    pub source: PathBuf,
    /// Camera of the whole images: JSON with width, height and cam_K, as in the author's cfg_camera
    #[arg(long, value_name = "FILE.json")]
    pub camera: PathBuf,
    /// Id of the object (default: the number in the file's name, or 1)
    #[arg(long, value_name = "ID")]
    pub object_id: Option<u32>,
    /// Name of the new dataset's split
    #[arg(long, default_value = "train", value_parser = folder_name)]
    pub split: String,
    /// New dataset folder
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Debug, Args)]
pub(crate) struct CommonArguments {
    /// Convert every N-th image of a sequence
    #[arg(long, value_name = "N", default_value = "1", value_parser = count::<100_000>)]
    pub every: NonZeroUsize,
    /// New dataset folder
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    #[command(flatten)]
    pub json: JsonArguments,
}

pub(crate) fn run(a: &ImportArguments) -> Result<Outcome> {
    match &a.format {
        Format::Ho3d(a) => {
            let options = Ho3dOptions {
                split: a.split.clone(),
                models: a.models.clone(),
                sequences: a.sequences.clone(),
                every: a.common.every.get(),
            };
            let deciding = json!({
                "format": "ho3d", "source": a.source, "split": a.split, "models": a.models, "sequences": a.sequences,
                "every": a.common.every,
            });
            let inputs = [a.source.as_path(), &a.models];
            convert(&a.common.out, &inputs, deciding, &a.common.json, |bar| {
                import_ho3d(&a.source, &a.common.out, &options, bar)
            })
        }
        Format::Smot(a) => {
            let options = SmotOptions { split: a.split.clone(), every: a.common.every.get() };
            let deciding = json!({
                "format": "smot", "source": a.source, "split": a.split, "every": a.common.every,
            });
            convert(&a.common.out, &[&a.source], deciding, &a.common.json, |bar| {
                import_smot(&a.source, &a.common.out, &options, bar)
            })
        }
        Format::Nol(a) => {
            let options =
                NolOptions { camera: a.camera.clone(), obj_id: a.object_id, split: a.split.clone() };
            let deciding = json!({
                "format": "nol", "source": a.source, "camera": a.camera, "object-id": a.object_id, "split": a.split,
            });
            convert(&a.out, &[], deciding, &a.json, |bar| import_nol(&a.source, &a.out, &options, bar))
        }
    }
}

/// Runs an import into a new folder. An interrupted import is repeated as a whole.
fn convert(
    out: &Path,
    inputs: &[&Path],
    deciding: Value,
    json: &JsonArguments,
    import: impl FnOnce(&Bar) -> Result<ImportSummary, DatasetError>,
) -> Result<Outcome> {
    if out.join(SCENES).exists() {
        bail!("{} exists already: remove it or choose another --out", out.join(SCENES).display());
    }
    let folder = DatasetFolder::take(out, "import", deciding, inputs)?;
    folder.begin(&Contents::default())?;
    let bar = Bar::stopped_by_interrupts("images");
    let summary = import(&bar);
    bar.finish();
    if matches!(summary, Err(DatasetError::Stopped)) {
        check_interrupt("run the same command again to make all of it")?;
    }
    let summary = summary.context("nothing was converted")?;
    report(json, &summary, || {
        println!(
            "{} images of {} objects in {} scenes: {}",
            summary.images,
            summary.objects.len(),
            summary.scenes,
            out.display()
        );
        for (id, v) in &summary.views {
            let [from, to, low, high] = [v.azimuth[0], v.azimuth[1], v.elevation[0], v.elevation[1]];
            println!(
                "object {id}: {} images, azimuth {from:.0} to {to:.0}, elevation {low:.1} to {high:.1} degrees",
                v.images
            );
        }
        if summary.without_poses > 0 {
            println!("{} images left out: nothing is annotated there", summary.without_poses);
        }
    })?;
    Ok(if summary.images > 0 { Outcome::Found } else { Outcome::NothingFound })
}
