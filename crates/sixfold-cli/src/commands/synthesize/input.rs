//! Photographs with approximate poses: from a BOP dataset, or from a file that lists them.

use anyhow::{Context, Result, anyhow, bail};
use sixfold_data::{RoughImageOptions, RoughImages, TrainingSetError};
use sixfold_detect::detector::TrainedDetector;
use sixfold_detect::torchvision::existing_objects_file;
use sixfold_geometry::RgbImage;
use sixfold_runner::detections;
use sixfold_shell::datasets;
use sixfold_shell::folder::Contents;
use sixfold_shell::new_views::add_contents;

use super::arguments::SynthesizeArguments;

/// Reads the input.
pub(super) fn read(a: &SynthesizeArguments) -> Result<RoughImages> {
    let detector = a.detector.as_deref().map(TrainedDetector::load).transpose()?;
    let detect = |image: &RgbImage| match &detector {
        Some(detector) => detections(detector, image, &[], (0, 0)).map_err(Into::into),
        None => Ok(vec![]),
    };
    let options = RoughImageOptions {
        min_visibility: a.min_visible,
        disturb: a.disturb_reach()?,
        seed: a.seed,
        detect: if detector.is_some() { Some(&detect) } else { None },
    };
    let images = match (&a.dataset, &a.photographs) {
        (Some(root), _) => {
            let dataset = datasets::open(root, &a.split, a.models.as_deref())?;
            RoughImages::of_opened(&dataset, &a.ids, a.frames.as_deref(), &options)
        }
        (None, Some(file)) => {
            let id = match detector.as_ref().map(|d| d.model().classes()) {
                None => 1,
                Some([only]) => only.id,
                Some(several) => bail!(
                    "--detector: found {} objects, expected a detector of one object, that of {}",
                    several.len(),
                    file.display()
                ),
            };
            RoughImages::of_file(file, id, &options)
        }
        (None, None) => bail!("what is to be rendered? Give --dataset DIR or --photographs FILE.json"),
    };
    let images = images.map_err(|error| match error {
        TrainingSetError::NoObjects { .. } => anyhow!("{error} with --ids"),
        TrainingSetError::NoColorImage { .. } => anyhow!("{error}, or choose other --frames"),
        error => error.into(),
    })?;
    if let (Some(detector), Some(weights), Some(_)) = (&detector, &a.detector, &a.dataset) {
        for object in &images.objects {
            detector.model().check_object(object.id).with_context(|| weights.display().to_string())?;
        }
    }
    images.notes.iter().for_each(|note| eprintln!("note: {note}"));
    Ok(images)
}

/// Hashes of the inputs.
pub(super) fn contents(a: &SynthesizeArguments, images: &RoughImages) -> Result<Contents> {
    let mut contents = Contents::default();
    let objects = a.detector.as_deref().and_then(existing_objects_file);
    for (name, file) in [
        ("weights", &a.weights),
        ("detector", &a.detector),
        ("objects of the detector", &objects),
        ("backgrounds", &a.backgrounds),
    ] {
        if let Some(file) = file {
            contents.add_path(name, file)?;
        }
    }
    add_contents(&mut contents, images);
    Ok(contents)
}
