//! The parts that trainings on the command line have in common: their data, the display of progress, and the report.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use serde::Serialize;
use sixfold_data::{FrameId, FrameSelection, TrainingSet, TrainingSetError};
use sixfold_mesh::Unit;
use sixfold_nn::options::OptionError;
use sixfold_nn::recipe::{Recipe, Session, Trained, TrainingEvent, export, train};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::Outcome;
use sixfold_nn::training_log::TrainingRecord;
use sixfold_nn::weights::ModelCard;
use sixfold_pix2pose::recipe::Pix2PoseRecipe;

use crate::datasets;
use crate::objects;
use crate::progress::{Terminal, Watch};
use crate::ranges::folder_name;

/// What a training learns from.
#[derive(Debug, Args)]
pub struct MaterialArguments {
    /// BOP dataset folder with models and posed images
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Folder of the dataset's models, such as models_cad or models_reconst of T-LESS (default: models, or models_eval without it)
    #[arg(long, value_name = "FOLDER", requires = "dataset", conflicts_with = "objects", value_parser = folder_name)]
    pub models: Option<String>,
    /// Frames of the split to use as photographs: JSON, [{"scene_id": 2, "im_id": 36}, ...] (default: all)
    #[arg(long, value_name = "FILE", requires = "dataset", conflicts_with = "objects")]
    pub frames: Option<PathBuf>,
    /// Train only on renders of the dataset's models, without photographs
    #[arg(long, requires = "dataset", conflicts_with_all = ["frames", "objects"])]
    pub renders_only: bool,
    /// Object ids of the dataset (default: all)
    #[arg(long, value_name = "ID", value_delimiter = ',', requires = "dataset", conflicts_with = "objects")]
    pub ids: Vec<u32>,
    /// Objects to learn from renders: mesh files, or names given with `sixfold object add`; they get the ids 1, 2, ...
    #[arg(long = "object", value_name = "NAME_OR_MESH", num_args = 1.., conflicts_with = "dataset")]
    pub objects: Vec<String>,
    /// Unit of mesh files: m, cm, mm, in (not needed for stored objects)
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// Folder of photographs for backgrounds (default: procedural textures)
    #[arg(long, value_name = "DIR")]
    pub backgrounds: Option<PathBuf>,
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
}

/// The training set that `a` names: all its objects, and the posed instances whose visible fraction is at least `min_visibility`.
///
/// # Errors
/// When nothing is named, or it cannot be read.
pub fn training_set(a: &MaterialArguments, min_visibility: f64) -> Result<TrainingSet> {
    if let Some(root) = &a.dataset {
        let frames = match &a.frames {
            Some(file) => FrameSelection::File(file.clone()),
            None if a.renders_only => FrameSelection::RendersOnly,
            None => FrameSelection::All,
        };
        let dataset = datasets::open(root, &a.split, a.models.as_deref())?;
        return TrainingSet::of_opened(&dataset, &a.ids, &frames, min_visibility).map_err(in_words);
    }
    if a.objects.is_empty() {
        bail!("what is to be learnt? Give --dataset DIR, or --object NAME_OR_MESH for training on renders");
    }
    let mut meshes = vec![];
    for (index, name) in a.objects.iter().enumerate() {
        let object = objects::find(name, a.unit, &a.store)?;
        meshes.push((index as u32 + 1, object.mesh, object.info));
    }
    Ok(TrainingSet::of_meshes(meshes, &a.objects.join(", ")))
}

/// The error with the options that help.
fn in_words(error: TrainingSetError) -> anyhow::Error {
    match &error {
        TrainingSetError::NoObjects { .. } => anyhow!("{error} with --ids"),
        TrainingSetError::NamedTwice { .. } => anyhow!("--{error}"),
        TrainingSetError::NoImages { .. } => {
            anyhow!("{error}; give another --split, or train with --renders-only")
        }
        TrainingSetError::NothingVisible { .. } => {
            anyhow!("{error} with --frames, or train with --renders-only")
        }
        _ => error.into(),
    }
}

/// Whether the model in `file` was trained on a frame, so that scores on this frame are meaningless.
///
/// # Errors
/// For a card that does not state this: no frame can then be used for tests.
pub fn was_trained_on(card: &ModelCard, file: &Path, frame: FrameId) -> Result<bool> {
    card.was_trained_on(frame).with_context(|| {
        format!(
            "{}: its card has no training_frames, so whether it was trained on frame {frame} is not known; train it again",
            file.display()
        )
    })
}

/// The report of a training; `M` holds the fields that only some trainings report.
#[derive(Serialize)]
pub struct Summary<M> {
    /// The model's file.
    pub model: String,
    /// Steps of the training.
    pub steps: u64,
    /// Training time in seconds; `None` where a model was only exported.
    pub seconds: Option<f64>,
    /// Losses of the last record, by name.
    pub losses: BTreeMap<String, f64>,
    /// Fields that only some trainings report.
    #[serde(flatten)]
    pub more: M,
}

/// The training data.
#[derive(Serialize)]
pub struct LearntFrom {
    /// Ids of the objects.
    pub objects: Vec<u32>,
    /// Posed instances in photographs.
    pub photographs: usize,
}

/// The quality of the model on objects that it was not trained on.
#[derive(Serialize)]
pub struct Measured<Q> {
    /// Its scores.
    pub quality: Q,
}

/// The report of a training.
pub fn summary<R, M>(trained: Trained<R>, more: impl FnOnce(R) -> M) -> Summary<M> {
    let Trained { model, steps, seconds, losses, report } = trained;
    Summary { model: model.display().to_string(), steps, seconds, losses, more: more(report) }
}

/// Texts for the display of a training.
pub struct Shown {
    /// What is prepared before the first step.
    pub preparing: &'static str,
    /// What is measured after the last step.
    pub measuring: &'static str,
    /// The message behind the progress bar of the steps.
    pub message: fn(&TrainingRecord) -> String,
}

/// Trains in `out`, or resumes the training there, or only writes the model of its last checkpoint, with progress on the terminal.
/// `by_flag` describes an option out of its range by the name of its flag.
///
/// # Errors
/// As the recipe, and when the user interrupts.
pub fn train_in<R: Recipe>(
    recipe: &R,
    data: R::Data,
    out: &Path,
    export_only: bool,
    shown: Shown,
    by_flag: impl Fn(&OptionError) -> anyhow::Error,
) -> Result<Trained<R::Report>> {
    train_watched(recipe, data, out, export_only, &Events { shown, watch: &Terminal::default() }, by_flag)
}

fn train_watched<R: Recipe>(
    recipe: &R,
    data: R::Data,
    out: &Path,
    export_only: bool,
    events: &Events<'_>,
    by_flag: impl Fn(&OptionError) -> anyhow::Error,
) -> Result<Trained<R::Report>> {
    let mut receive = |event: TrainingEvent<'_>| events.receive(event);
    let mut session = Session::new(out, events.watch.stop(), &mut receive);
    let ended =
        if export_only { export(recipe, data, &mut session) } else { train(recipe, data, &mut session) };
    match ended {
        Ok(Outcome::Finished(trained)) => Ok(trained),
        Ok(Outcome::Interrupted { step: 0 }) => {
            bail!("interrupted; nothing was trained yet; run the same command again")
        }
        Ok(Outcome::Interrupted { step }) => {
            bail!("interrupted after step {step}, which is kept; run the same command again to continue")
        }
        Err(TrainError::Option(error)) => Err(by_flag(&error)),
        Err(error) => Err(error.into()),
    }
}

/// Trains Pix2Pose in `out`, or resumes the training there, or only writes the model of its last checkpoint; as [`train_in`], with
/// progress reported to `watch`.
///
/// # Errors
/// As [`train_in`].
pub fn train_pix2pose(
    recipe: &Pix2PoseRecipe,
    material: TrainingSet,
    out: &Path,
    export_only: bool,
    watch: &dyn Watch,
    by_flag: impl Fn(&OptionError) -> anyhow::Error,
) -> Result<Trained<()>> {
    let shown = Shown {
        preparing: "samples",
        measuring: "alignment measured on the photographs",
        message: |record| {
            format!("L1 {:.4}, {:.0} images/s", loss(record, "coordinates"), record.samples_per_second)
        },
    };
    train_watched(recipe, material, out, export_only, &Events { shown, watch }, by_flag)
}

/// Passes the events of a training to those who watch it.
struct Events<'a> {
    shown: Shown,
    watch: &'a dyn Watch,
}

impl Events<'_> {
    fn receive(&self, event: TrainingEvent<'_>) {
        let Events { shown, watch } = self;
        match event {
            TrainingEvent::Note(text) => watch.note(text),
            TrainingEvent::Warning(text) => watch.note(&format!("warning: {text}")),
            TrainingEvent::Preparing(done, all) => watch.report(shown.preparing, done, all, String::new()),
            TrainingEvent::Steps(record, steps) => {
                watch.report("steps", record.step as usize, steps as usize, (shown.message)(record));
            }
            TrainingEvent::Measuring(done, all) => watch.report(shown.measuring, done, all, String::new()),
        }
    }
}

/// The value of a loss in a record; NaN if the record does not have it.
pub fn loss(record: &TrainingRecord, name: &str) -> f64 {
    record.losses.get(name).copied().unwrap_or(f64::NAN)
}

/// The command line, for the model card.
pub fn command_line() -> String {
    let words = std::env::args().skip(1).filter(|word| word != "--export");
    std::iter::once("sixfold".to_string()).chain(words).collect::<Vec<_>>().join(" ")
}
