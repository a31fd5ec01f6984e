//! Masks given by a person, and the volume of the object from them or from the salient region of whole photographs.

use sixfold_geometry::{Camera, Image, Mask, Pose};

use crate::cones::{Cone, volume_of_masks};
use crate::error::TeachError;
use crate::reduce::undistorted;
use crate::shape::{Capture, NOT_IN_SIGHT, Segmentation, ShapeOptions};
use crate::silhouette::{SMALLEST_HOLE, Segmenter, without_specks};
use crate::view::{PosedPhotograph, Volume};

/// The volume of the object from masks: the given ones or, if there are none, the salient regions of whole photographs.
pub(crate) fn searched_volume(
    capture: &Capture,
    segmenter: &dyn Segmenter,
    options: &ShapeOptions,
) -> Result<Volume, TeachError> {
    let given: Vec<Masked> = capture.photographs.iter().filter_map(Masked::given).collect();
    let masked = if given.len() >= 2 {
        given
    } else {
        let found = |p| Masked::salient(p, segmenter, options.coarse_side).map_err(TeachError::Masks);
        capture.photographs.iter().map(found).collect::<Result<_, _>>()?
    };
    let cones: Vec<Cone<'_>> = masked.iter().map(Masked::cone).collect();
    volume_of_masks(&cones).ok_or_else(|| TeachError::NoObject {
        hint: "; what the masks show has no place in common: check the poses, or take photographs from more sides".to_owned(),
    })
}

/// A photograph's mask with the data of a cone.
struct Masked {
    camera: Camera,
    pose: Pose,
    mask: Mask,
    unknown: Option<Mask>,
}

impl Masked {
    fn given(p: &PosedPhotograph) -> Option<Masked> {
        let unknown = p.hidden.as_ref().map(|hidden| (**hidden).clone());
        Some(Masked { camera: p.camera, pose: p.camera_from_world, mask: certain(p)?, unknown })
    }

    fn salient(
        p: &PosedPhotograph,
        segmenter: &dyn Segmenter,
        side: usize,
    ) -> Result<Masked, Box<dyn std::error::Error + Send + Sync>> {
        let (image, camera) = undistorted(&p.image, Some(&p.camera), side);
        let mask = without_specks(&segmenter.foreground(&image)?.map(|p| *p > 0.5), SMALLEST_HOLE);
        Ok(Masked { camera: camera.unwrap_or(p.camera), pose: p.camera_from_world, mask, unknown: None })
    }

    fn cone(&self) -> Cone<'_> {
        Cone {
            camera: &self.camera,
            camera_from_world: &self.pose,
            mask: &self.mask,
            unknown: self.unknown.as_ref(),
        }
    }
}

/// The mean of the salient region's probability over each of some masks, which have no lens distortion.
pub(crate) fn salient_fraction(
    p: &PosedPhotograph,
    segmenter: &dyn Segmenter,
    options: &ShapeOptions,
    masks: &[Mask],
) -> Result<Vec<f64>, Box<dyn std::error::Error + Send + Sync>> {
    let (image, camera) = undistorted(&p.image, Some(&p.camera), options.coarse_side);
    let (foreground, camera) = (segmenter.foreground(&image)?, camera.unwrap_or(p.camera));
    let of = |mask: &Mask| {
        let reduced = |x: usize, y: usize| {
            let scale = p.camera.width as f64 / camera.width as f64;
            let at = |k: usize| ((k as f64 + 0.5) * scale) as usize;
            mask.get(at(x), at(y)).copied().unwrap_or(false)
        };
        let (w, h) = foreground.size();
        let pixels =
            (0..w * h).filter(|i| reduced(i % w, i / w)).map(|i| f64::from(foreground.as_slice()[i]));
        let (sum, count) = pixels.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
        sum / f64::max(count, 1.0)
    };
    Ok(masks.iter().map(of).collect())
}

/// The pixels that certainly show the object, in a photograph whose mask was given.
pub(crate) fn certain(p: &PosedPhotograph) -> Option<Mask> {
    Some(not_hidden(p, p.mask.as_ref()?))
}

/// A mask without the pixels where something may occlude the object.
pub(crate) fn not_hidden(p: &PosedPhotograph, mask: &Mask) -> Mask {
    let Some(hidden) = &p.hidden else { return mask.clone() };
    Image::from_fn(mask.width(), mask.height(), |x, y| {
        mask[(x, y)] && !hidden.get(x, y).copied().unwrap_or(false)
    })
}

/// The masks, if all of them were given: nothing is searched then.
pub(crate) fn given_masks(capture: &Capture, volume: &Volume) -> Option<Segmentation> {
    let certain: Vec<Mask> = capture.photographs.iter().map(certain).collect::<Option<_>>()?;
    let (mut masks, mut left_out) = (vec![], vec![]);
    for (number, (photograph, certain)) in capture.photographs.iter().zip(&certain).enumerate() {
        let in_sight = certain.as_slice().contains(&true);
        if !in_sight {
            left_out.push((number, NOT_IN_SIGHT.to_owned()));
        }
        masks.push(photograph.mask.as_ref().filter(|_| in_sight).map(|mask| (**mask).clone()));
    }
    Some(Segmentation { volume: *volume, masks, left_out })
}
