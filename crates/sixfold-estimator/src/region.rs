//! A region of an image in which an instance is searched.

use sixfold_geometry::{Camera, Mask, Rect};

/// The region of one instance in a pinhole image.
#[derive(Debug, Clone, PartialEq)]
pub struct Region {
    /// Its box, pixels.
    pub bbox: Rect,
    /// The confidence of its source, 0 to 1; 1 for a person or the ground truth.
    pub score: f64,
    /// Its visible pixels, of the image's size, if known.
    pub mask: Option<Mask>,
    /// Whether the mask contains all pixels to search; otherwise it is dilated, because masks of detectors are coarse.
    pub exact: bool,
}

/// Masks are dilated by this fraction of their box's longer side, because masks are coarse and depth is shifted against colour
/// (chosen on masks of the detector in simulated LM-O depth).
const MASK_MARGIN: f64 = 0.04;
/// The same for ICP. Its network locates the object more finely, so only pixels well outside the mask are excluded.
const ICP_MARGIN: f64 = 0.12;
/// Boxes are scaled by this factor: they are tight, and depth is shifted against colour.
const BOX_SCALE: f64 = 1.1;

impl Region {
    /// A box given by a person.
    pub fn of_box(bbox: Rect) -> Region {
        Region { bbox, score: 1.0, mask: None, exact: false }
    }

    /// The pixels of a mask; `None` for an empty one.
    pub fn of_mask(mask: Mask) -> Option<Region> {
        let [x, y, width, height] = mask.bounding_box()?.map(|v| v as f64);
        Some(Region { bbox: Rect { x, y, width, height }, score: 1.0, mask: Some(mask), exact: true })
    }

    /// The pixels that a depth method searches: those of the mask if there is one, else those of the box, both dilated a little.
    pub fn pixels(&self, camera: &Camera) -> Mask {
        match &self.mask {
            Some(mask) if self.exact => mask.clone(),
            Some(mask) => mask.grown(self.margin(MASK_MARGIN)),
            None => box_mask(&self.bbox, camera),
        }
    }

    /// The pixels whose depth may belong to the object, if there is a mask.
    pub fn pixels_for_icp(&self) -> Option<Mask> {
        self.mask.as_ref().map(|mask| mask.grown(self.margin(ICP_MARGIN)))
    }

    /// The dilation in pixels, at least two.
    fn margin(&self, fraction: f64) -> usize {
        (fraction * self.bbox.width.max(self.bbox.height)).ceil().max(2.0) as usize
    }
}

/// The pixels of a box, enlarged a little.
pub(crate) fn box_mask(region: &Rect, camera: &Camera) -> Mask {
    let r = region.scaled(BOX_SCALE);
    Mask::from_fn(camera.width, camera.height, |x, y| {
        let (x, y) = (x as f64, y as f64);
        x >= r.x && y >= r.y && x < r.x + r.width && y < r.y + r.height
    })
}
