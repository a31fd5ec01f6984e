//! Reduction of photographs of many megapixels before they are processed.

use std::sync::Arc;

use sixfold_geometry::{Camera, Image, Mask, RgbImage, Vec2};

use crate::view::{PosedPhotograph, reduced};

/// The photograph with at most `side` pixels along its longer side.
pub(crate) fn reduced_photograph(photograph: PosedPhotograph, side: usize) -> PosedPhotograph {
    let (width, height) = photograph.image.size();
    let longest = width.max(height);
    if longest <= side {
        return photograph;
    }
    let scale = longest as f64 / side as f64;
    let size = ((width as f64 / scale).round() as usize, (height as f64 / scale).round() as usize);
    let camera = photograph.camera.resize(size.0, size.1);
    let (sx, sy) = (width as f64 / size.0 as f64, height as f64 / size.1 as f64);
    let source = |x: f64, y: f64| Vec2::new((x + 0.5) * sx - 0.5, (y + 0.5) * sy - 0.5);
    let nearest = |x: usize, y: usize| {
        let p = source(x as f64, y as f64);
        ((p.x.round() as usize).min(width - 1), (p.y.round() as usize).min(height - 1))
    };
    let depth = photograph.depth.map(|d| Arc::new(Image::from_fn(size.0, size.1, |x, y| d[nearest(x, y)])));
    let of_mask = |m: Arc<Mask>| Arc::new(Image::from_fn(size.0, size.1, |x, y| m[nearest(x, y)]));
    let (mask, hidden) = (photograph.mask.map(of_mask), photograph.hidden.map(of_mask));
    let image = Arc::new(reduced(&photograph.image, size, sx, &source));
    PosedPhotograph { image, depth, mask, hidden, camera, ..photograph }
}

/// A photograph with at most `side` pixels along its longer side and, if its lens is known, without distortion; and the camera of
/// the new image.
pub(crate) fn undistorted(
    image: &RgbImage,
    lens: Option<&Camera>,
    side: usize,
) -> (RgbImage, Option<Camera>) {
    let (width, height) = image.size();
    let scale = (width.max(height) as f64 / side as f64).max(1.0);
    let shorter = |length: usize| ((length as f64 / scale).round() as usize).max(1);
    let size = (shorter(width), shorter(height));
    let (sx, sy) = (width as f64 / size.0 as f64, height as f64 / size.1 as f64);
    let source = |x: f64, y: f64| {
        let pixel = Vec2::new((x + 0.5) * sx - 0.5, (y + 0.5) * sy - 0.5);
        lens.map_or(pixel, |lens| lens.distort_point(&pixel))
    };
    let camera = lens.map(|lens| lens.without_distortion().resize(size.0, size.1));
    (reduced(image, size, sx, &source), camera)
}

/// A mask of the full photograph, resampled to the pixels of the reduced one.
pub(crate) fn reduced_mask(mask: &Mask, photograph: &PosedPhotograph) -> Mask {
    of_size(mask, photograph.image.size())
}

/// A mask of the reduced photograph, resampled to the pixels of the original camera.
pub(crate) fn enlarged_mask(mask: &Mask, photograph: &PosedPhotograph, camera: Option<&Camera>) -> Mask {
    let size = camera.map_or(photograph.image.size(), |c| (c.width, c.height));
    of_size(mask, size)
}

pub(crate) fn of_size(mask: &Mask, (width, height): (usize, usize)) -> Mask {
    if mask.size() == (width, height) {
        return mask.clone();
    }
    let (sx, sy) = (mask.width() as f64 / width as f64, mask.height() as f64 / height as f64);
    let at = |x: usize, s: f64, most: usize| ((((x as f64 + 0.5) * s).floor()) as usize).min(most - 1);
    Image::from_fn(width, height, |x, y| mask[(at(x, sx, mask.width()), at(y, sy, mask.height()))])
}
