//! What trainings have in common: what they learn from, what they tell on their way, and what they say in the end.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, anyhow, bail};
use serde::Serialize;
use sixfold_data::{FrameId, FrameSelection, TrainingSet, TrainingSetError};
use sixfold_nn::recipe::{News, Trained};
use sixfold_nn::training_log::TrainingRecord;
use sixfold_nn::weights::ModelCard;

use crate::arguments::MaterialArguments;
use crate::objects;
use crate::progress::Progress;

/// What a training came to.
#[derive(Serialize)]
pub(super) struct Summary {
    pub model: String,
    pub objects: Vec<u32>,
    pub photographs: usize,
    pub steps: u64,
    /// Of training; `None` where a model was only exported.
    pub seconds: Option<f64>,
    pub losses: BTreeMap<String, f64>,
}

impl Summary {
    pub fn new(trained: Trained, objects: Vec<u32>, photographs: usize) -> Summary {
        let Trained { model, steps, seconds, losses } = trained;
        Summary { model: model.display().to_string(), objects, photographs, steps, seconds, losses }
    }
}

/// What `a` names: all its objects, and the photographed instances of which at least the share `least_visible` is seen.
pub(super) fn material(a: &MaterialArguments, least_visible: f64) -> Result<TrainingSet> {
    if let Some(root) = &a.dataset {
        let frames = match &a.frames {
            Some(file) => FrameSelection::File(file.clone()),
            None if a.renders_only => FrameSelection::RendersOnly,
            None => FrameSelection::All,
        };
        return TrainingSet::of_dataset(root, &a.split, &a.ids, &frames, least_visible).map_err(in_words);
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

/// With the options that help.
fn in_words(error: TrainingSetError) -> anyhow::Error {
    match &error {
        TrainingSetError::NoObjects { .. } => anyhow!("{error} with --ids"),
        TrainingSetError::NoImages { .. } => {
            anyhow!("{error}; give another --split, or train with --renders-only")
        }
        TrainingSetError::NothingVisible { .. } => {
            anyhow!("{error} with --frames, or train with --renders-only")
        }
        _ => error.into(),
    }
}

/// Shows what a training tells: a bar of its steps with `message` behind it, and notes. The last record is kept.
pub(super) struct Shown<M: Fn(&TrainingRecord) -> String> {
    message: M,
    bar: Option<Progress>,
    measuring: bool,
}

impl<M: Fn(&TrainingRecord) -> String> Shown<M> {
    pub fn new(message: M) -> Self {
        Shown { message, bar: None, measuring: false }
    }

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

    pub fn finish(&mut self) {
        if let Some(bar) = self.bar.take() {
            bar.finish();
        }
    }
}

/// The value of a loss, where the record has it.
pub(super) fn loss(record: &TrainingRecord, name: &str) -> f64 {
    record.losses.get(name).copied().unwrap_or(f64::NAN)
}

/// A training that was asked to stop.
pub(super) fn interrupted_after(step: u64) -> anyhow::Error {
    anyhow!("interrupted after step {step}, which is kept; run the same command again to go on")
}

/// What the user typed, for the card.
pub(super) fn command_line() -> String {
    let words = std::env::args().skip(1).filter(|word| word != "--export");
    std::iter::once("sixfold".to_string()).chain(words).collect::<Vec<_>>().join(" ")
}

/// Whether the model in `file` was trained on a frame: scores there are worth nothing.
///
/// # Errors
/// For a card that does not say: no frame can be tested on then.
pub(crate) fn was_trained_on(card: &ModelCard, file: &Path, frame: FrameId) -> Result<bool> {
    card.was_trained_on(frame).with_context(|| {
        format!(
            "{}: its card has no training_frames, so whether it was trained on frame {frame} is not known; train it anew, or \
             write its last checkpoint again with --export",
            file.display()
        )
    })
}
