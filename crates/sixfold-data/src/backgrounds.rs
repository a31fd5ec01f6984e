//! The backgrounds of training images.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use sixfold_geometry::Rect;
use sixfold_synth::augment::{AugmentError, Backgrounds, PhotographOptions};

use crate::posed_image::PosedImage;
use crate::training_set::TrainingObject;

/// The photographs of a folder if one is given, else procedural textures; and the suitable fraction of textures.
///
/// # Errors
/// [`AugmentError`] for a folder without photographs.
pub fn plain_backgrounds(folder: Option<&Path>) -> Result<(Backgrounds, f32), AugmentError> {
    Ok(match folder {
        Some(folder) => (Backgrounds::from_folder(folder, &PhotographOptions::default())?, 0.1),
        None => (Backgrounds::procedural(), 0.6),
    })
}

/// The photographs that [`plain_backgrounds`] reads, in its order; none without a folder.
///
/// # Errors
/// [`AugmentError`] for a folder that cannot be listed.
pub fn background_files(folder: Option<&Path>) -> Result<Vec<PathBuf>, AugmentError> {
    folder.map_or(Ok(vec![]), |folder| Backgrounds::files(folder, &PhotographOptions::default()))
}

/// As [`plain_backgrounds`], with additional backgrounds from the training images themselves, away from their objects.
///
/// # Errors
/// [`AugmentError`].
pub fn backgrounds_with_images(
    folder: Option<&Path>,
    images: &[PosedImage],
    objects: &[TrainingObject],
) -> Result<Backgrounds, AugmentError> {
    let (mut backgrounds, fraction) = plain_backgrounds(folder)?;
    let mut frames: Vec<(&Arc<_>, Vec<Rect>)> = vec![];
    for posed in images {
        let Some(object) = objects.iter().find(|o| o.id == posed.object_id()) else { continue };
        let corners = object.mesh.box_corners().into_iter().filter_map(|corner| {
            posed.camera().project(&posed.camera_from_object().transform_point(&corner))
        });
        let (x, y): (Vec<f64>, Vec<f64>) = corners.map(|c| (c.x, c.y)).unzip();
        let minimum = |v: &[f64]| v.iter().copied().fold(f64::INFINITY, f64::min);
        let most = |v: &[f64]| v.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        if x.is_empty() {
            continue;
        }
        let rect = Rect {
            x: minimum(&x),
            y: minimum(&y),
            width: most(&x) - minimum(&x),
            height: most(&y) - minimum(&y),
        };
        match frames.iter_mut().find(|(image, _)| Arc::ptr_eq(image, posed.image())) {
            Some((_, rects)) => rects.push(rect),
            None => frames.push((posed.image(), vec![rect])),
        }
    }
    for (image, rects) in frames {
        backgrounds = backgrounds.with_image(image.clone(), rects)?;
    }
    Ok(backgrounds.with_procedural_fraction(fraction))
}
