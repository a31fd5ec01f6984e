//! An image for inspection: every photograph with the outlines of its mask and of the mesh.

use sixfold_geometry::{Image, Mask, RgbImage};
use sixfold_render::render_depth;

use crate::error::TeachError;
use crate::snapshot::Snapshot;

/// Width of a photograph in the image, pixels.
const WIDTH: usize = 400;
/// Photographs in a row.
const COLUMNS: usize = 4;
/// Maximum number of photographs that are shown.
const MOST: usize = 40;
const MASK: [u8; 3] = [255, 200, 0];
const MESH: [u8; 3] = [0, 220, 255];

impl Snapshot {
    /// The used photographs, cropped to the object and its surroundings, with the border of the mask in yellow and the outline of
    /// the mesh in blue.
    ///
    /// # Errors
    /// [`TeachError`].
    pub fn picture(&self) -> Result<RgbImage, TeachError> {
        let mesh = self.mesh()?;
        let posed = self.posed()?;
        let mut tiles = vec![];
        for (_, image, camera, pose, mask) in posed.iter().take(MOST) {
            let pinhole = camera.without_distortion();
            let image = sixfold_geometry::undistort_rgb(image, camera).unwrap_or_else(|_| image.clone());
            let outline = render_depth(&mesh, pose, &pinhole).map(|d| *d > 0.0);
            tiles.push(close_up(&image, Some(mask), Some(&outline), WIDTH));
        }
        let height = tiles.iter().map(Image::height).max().unwrap_or(1);
        let rows = tiles.len().div_ceil(COLUMNS).max(1);
        let mut picture = Image::filled(WIDTH * COLUMNS.min(tiles.len().max(1)), height * rows, [30; 3]);
        for (i, tile) in tiles.iter().enumerate() {
            let (x0, y0) = (WIDTH * (i % COLUMNS), height * (i / COLUMNS));
            for y in 0..tile.height() {
                for x in 0..tile.width() {
                    picture[(x0 + x, y0 + y)] = tile[(x, y)];
                }
            }
        }
        Ok(picture)
    }
}

/// A square crop around an outline, or around a mask if there is no outline; both are drawn as lines.
pub(crate) fn close_up(
    image: &RgbImage,
    mask: Option<&Mask>,
    outline: Option<&Mask>,
    size: usize,
) -> RgbImage {
    let around = outline.and_then(Image::bounding_box).or_else(|| mask.and_then(Image::bounding_box));
    let [x, y, width, height] = around.unwrap_or([0, 0, image.width(), image.height()]);
    let side = width.max(height) * 7 / 5 + 16;
    let left = (x + width / 2).saturating_sub(side / 2);
    let top = (y + height / 2).saturating_sub(side / 2);
    let scale = side as f64 / size as f64;
    let at = |x: usize, y: usize| {
        let (u, v) = (left + (x as f64 * scale) as usize, top + (y as f64 * scale) as usize);
        (u < image.width() && v < image.height()).then_some((u, v))
    };
    let border = |mask: Option<&Mask>, x: usize, y: usize| {
        let Some(mask) = mask else { return false };
        let inside = |x: usize, y: usize| at(x, y).is_some_and(|p| mask[p]);
        inside(x, y) != inside(x + 1, y) || inside(x, y) != inside(x, y + 1)
    };
    Image::from_fn(size, size, |x, y| match at(x, y) {
        _ if border(outline, x, y) => MESH,
        _ if border(mask, x, y) => MASK,
        Some(p) => image[p],
        None => [30; 3],
    })
}

/// An image with the border of a mask in yellow and that of an outline in blue, two pixels wide where the image is large.
pub(crate) fn outlined(image: &RgbImage, mask: Option<&Mask>, outline: Option<&Mask>) -> RgbImage {
    let (width, height) = image.size();
    let reach = 1 + width.max(height) / 800;
    let border = |mask: Option<&Mask>, x: usize, y: usize| {
        let Some(mask) = mask else { return false };
        let here = mask[(x, y)];
        let differs = |u: usize, v: usize| mask.get(u, v).is_some_and(|there| *there != here);
        (1..=reach).any(|d| differs(x + d, y) || differs(x, y + d))
    };
    Image::from_fn(width, height, |x, y| match (x, y) {
        _ if border(outline, x, y) => MESH,
        _ if border(mask, x, y) => MASK,
        at => image[at],
    })
}
