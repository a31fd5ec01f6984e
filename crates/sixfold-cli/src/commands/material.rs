//! What trainings on objects learn from.

use anyhow::{Result, anyhow, bail};
use sixfold_nn::weights::ModelCard;
use sixfold_data::{FrameSelection, TrainingSet, TrainingSetError};

use crate::arguments::MaterialArguments;
use crate::objects;

/// What `a` names: all its objects, and the photographed instances of which at least the share `least_visible` is seen.
pub(super) fn material(a: &MaterialArguments, least_visible: f64) -> Result<TrainingSet> {
    if let Some(root) = &a.dataset {
        let frames = match &a.frames {
            Some(file) => Frames::File(file.clone()),
            None if a.renders_only => Frames::RendersOnly,
            None => Frames::All,
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

/// Whether a model's card names a frame (`scene/image`) among those of its training.
pub(crate) fn was_trained_on(card: &ModelCard, scene_id: u32, im_id: u32) -> bool {
    let name = format!("{scene_id}/{im_id}");
    card.data.split(|c: char| !(c.is_ascii_digit() || c == '/')).any(|word| word == name)
}
