//! What trainings have in common: what they learn from, what they tell on their way, and what they say in the end.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::{Result, anyhow, bail};
use clap::Args;
use serde::Serialize;
use sixfold_mesh::Unit;
use sixfold_nn::recipe::{News, Trained};
use sixfold_nn::training_log::TrainingRecord;
use sixfold_nn::weights::ModelCard;
use sixfold_data::{FrameSelection, TrainingSet, TrainingSetError};

use crate::objects;
use crate::progress::Progress;

/// What a training came to.
#[derive(Serialize)]
pub struct Summary {
    /// File of the model.
    pub model: String,
    /// Ids of the objects that were learnt.
    pub objects: Vec<u32>,
    /// Photographed instances that were learnt from.
    pub photographs: usize,
    /// Of the training.
    pub steps: u64,
    /// Of training; `None` where a model was only exported.
    pub seconds: Option<f64>,
    /// Of the last record, by name.
    pub losses: BTreeMap<String, f64>,
}

impl Summary {
    /// Of a training that went through.
    pub fn new(trained: Trained, objects: Vec<u32>, photographs: usize) -> Summary {
        let Trained { model, steps, seconds, losses } = trained;
        Summary { model: model.display().to_string(), objects, photographs, steps, seconds, losses }
    }
}

/// What a training learns from.
#[derive(Debug, Args)]
pub struct MaterialArguments {
    /// BOP dataset folder with models and posed photographs
    #[arg(long, value_name = "DIR")]
    pub dataset: Option<PathBuf>,
    /// Split of the dataset
    #[arg(long, default_value = "test")]
    pub split: String,
    /// Which frames of the split are photographs to learn from: JSON, [{"scene_id": 2, "im_id": 36}, ...] (default: all)
    #[arg(long, value_name = "FILE", requires = "dataset")]
    pub frames: Option<PathBuf>,
    /// Open no photograph, learn from renders of the dataset's models alone
    #[arg(long, requires = "dataset", conflicts_with = "frames")]
    pub renders_only: bool,
    /// Object ids of the dataset (default: all)
    #[arg(long, value_name = "ID", value_delimiter = ',', requires = "dataset")]
    pub ids: Vec<u32>,
    /// Objects to learn from renders: mesh files, or names given with `sixfold object add`; they get the ids 1, 2, ...
    #[arg(long = "object", value_name = "NAME_OR_MESH", num_args = 1.., conflicts_with = "dataset")]
    pub objects: Vec<String>,
    /// Unit of mesh files: m, cm, mm, in (meshes in the store know theirs)
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// Folder of photographs for backgrounds (default: made-up textures)
    #[arg(long, value_name = "DIR")]
    pub backgrounds: Option<PathBuf>,
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
}

/// What `a` names: all its objects, and the photographed instances of which at least the share `least_visible` is seen.
pub fn material(a: &MaterialArguments, least_visible: f64) -> Result<Material> {
    if let Some(root) = &a.dataset {
        let frames = match &a.frames {
            Some(file) => Frames::File(file.clone()),
            None if a.renders_only => Frames::RendersOnly,
            None => Frames::All,
        };
        return Material::of_dataset(root, &a.split, &a.ids, &frames, least_visible).map_err(in_words);
    }
    if a.objects.is_empty() {
        bail!("what is to be learnt? Give --dataset DIR, or --object NAME_OR_MESH for training on renders");
    }
    let mut meshes = vec![];
    for (index, name) in a.objects.iter().enumerate() {
        let object = objects::find(name, a.unit, &a.store)?;
        meshes.push((index as u32 + 1, object.mesh, object.info));
    }
    Ok(Material::of_meshes(meshes, &a.objects.join(", ")))
}

/// With the options that help.
fn in_words(error: MaterialError) -> anyhow::Error {
    match &error {
        MaterialError::NoObjects { .. } => anyhow!("{error} with --ids"),
        MaterialError::NoImages { .. } => {
            anyhow!("{error}; give another --split, or train with --renders-only")
        }
        MaterialError::NothingVisible { .. } => {
            anyhow!("{error} with --frames, or train with --renders-only")
        }
        _ => error.into(),
    }
}

/// Shows what a training tells: a bar of its steps with `message` behind it, and notes. The last record is kept.
pub struct Shown<M: Fn(&TrainingRecord) -> String> {
    message: M,
    bar: Option<Progress>,
    measuring: bool,
}

impl<M: Fn(&TrainingRecord) -> String> Shown<M> {
    /// Shows `message` of every record behind the bar.
    pub fn new(message: M) -> Self {
        Shown { message, bar: None, measuring: false }
    }

    /// Shows what a training tells.
    pub fn hear(&mut self, news: News<'_>) {
        match news {
            News::Note(text) => eprintln!("{text}"),
            News::Warning(text) => eprintln!("warning: {text}"),
            News::Preparing(done, all) => {
                if done % 1000 < 4 {
                    eprintln!("  {done} of {all}");
                }
            }
            News::Steps(record, steps) => {
                let bar = self.bar.get_or_insert_with(|| Progress::new("steps", steps as usize));
                bar.set(record.step as usize);
                bar.message((self.message)(record));
            }
            News::Measuring(done, all) => {
                if !std::mem::replace(&mut self.measuring, true) {
                    self.finish();
                }
                let what = "alignment measured on the photographs";
                self.bar.get_or_insert_with(|| Progress::new(what, all)).set(done);
            }
        }
    }

    /// Takes the bar away.
    pub fn finish(&mut self) {
        if let Some(bar) = self.bar.take() {
            bar.finish();
        }
    }
}

/// The value of a loss, where the record has it.
pub fn loss(record: &TrainingRecord, name: &str) -> f64 {
    record.losses.get(name).copied().unwrap_or(f64::NAN)
}

/// A training that was asked to stop.
pub fn interrupted_after(step: u64) -> anyhow::Error {
    anyhow!("interrupted after step {step}, which is kept; run the same command again to go on")
}

/// What the user typed, for the card.
pub fn command_line() -> String {
    let words = std::env::args().skip(1).filter(|word| word != "--export");
    std::iter::once("sixfold".to_string()).chain(words).collect::<Vec<_>>().join(" ")
}

/// Whether a model's card names a frame (`scene/image`) among those of its training.
pub fn was_trained_on(card: &ModelCard, scene_id: u32, im_id: u32) -> bool {
    let name = format!("{scene_id}/{im_id}");
    card.data.split(|c: char| !(c.is_ascii_digit() || c == '/')).any(|word| word == name)
}
