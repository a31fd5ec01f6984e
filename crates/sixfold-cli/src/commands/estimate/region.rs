//! The region to search in one image, from `--box`, `--mask` or `--detector`, in the pinhole image.

use std::path::Path;

use anyhow::{Context, Result, anyhow, bail};
use sixfold_estimator::Region;
use sixfold_geometry::{Camera, Mask, Rect, RgbImage, undistort_box};
use sixfold_io::read_mask;

use super::arguments::CommonArguments;
use super::networks;

/// The region to search.
pub(super) enum Where {
    /// In the whole image.
    Anywhere,
    /// In a region.
    In(Region),
    /// Nowhere: the detector did not find the object.
    Nowhere,
}

/// The region from the options. `lens` is the camera with its distortion, `image` the colour image without it.
pub(super) fn find(a: &CommonArguments, lens: &Camera, image: Option<&RgbImage>) -> Result<Where> {
    let boxed = given_box(a, lens)?.map(|b| undistort_box(&b, lens));
    if let Some(weights) = &a.detector {
        if boxed.is_some() || a.mask.is_some() {
            bail!("--detector: give it, or --box or --mask, but not both");
        }
        let image = image.ok_or_else(|| anyhow!("--detector needs a colour image: give --rgb FILE"))?;
        let id = a.object_id;
        let id = id.ok_or_else(|| anyhow!("--detector needs --object-id N: which of its objects is it?"))?;
        let found = networks::detected(weights, image, id)?;
        return Ok(found.map_or(Where::Nowhere, Where::In));
    }
    let mask = a.mask.as_deref().map(|path| given_mask(path, lens, boxed.as_ref())).transpose()?;
    Ok(match (mask, boxed) {
        (Some(region), _) => Where::In(region),
        (None, Some(bbox)) => Where::In(Region::of_box(bbox)),
        (None, None) => Where::Anywhere,
    })
}

/// `--box`, checked to have a size and to overlap the image.
fn given_box(a: &CommonArguments, camera: &Camera) -> Result<Option<Rect>> {
    let Some(r) = &a.region else { return Ok(None) };
    let [x, y, width, height] = r[..] else {
        bail!("--box: found {} numbers, expected x, y, width, height", r.len())
    };
    if !(width > 0.0 && height > 0.0 && r.iter().all(|v| v.is_finite())) {
        bail!("--box: found {r:?}, expected x, y, width, height with a size above 0");
    }
    let region = Rect { x, y, width, height };
    let image = Rect { x: 0.0, y: 0.0, width: camera.width as f64, height: camera.height as f64 };
    if region.intersect(&image).is_none() {
        bail!("--box: {r:?} lies outside the {}x{} image", camera.width, camera.height);
    }
    Ok(Some(region))
}

/// The pixels of `--mask`, within `--box` if that is given too.
fn given_mask(path: &Path, lens: &Camera, boxed: Option<&Rect>) -> Result<Region> {
    let mask = read_mask(path)?;
    lens.check_image(mask.width(), mask.height()).with_context(|| path.display().to_string())?;
    let empty = || {
        let and_box = if boxed.is_some() { " and --box" } else { "" };
        anyhow!(
            "{}{and_box}: the mask is empty: no pixel is left in which the object could be; it has to be above zero on the object",
            path.display()
        )
    };
    let mask = match boxed {
        None => mask,
        Some(bbox) => {
            let inside = Region::of_box(*bbox).pixels(lens);
            Mask::from_fn(mask.width(), mask.height(), |x, y| mask[(x, y)] && inside[(x, y)])
        }
    };
    let region = Region::of_mask(mask).ok_or_else(empty)?;
    if lens.distortion.is_none() {
        return Ok(region);
    }
    // A mask of a distorted image does not match the pixels of the pinhole image: use its box.
    Ok(Region::of_box(undistort_box(&region.bbox, lens)))
}
