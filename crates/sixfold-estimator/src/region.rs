//! Where in an image an instance is searched.

use sixfold_geometry::{Camera, Mask, Rect};

/// Where one instance is searched, in a pinhole image.
#[derive(Debug, Clone, PartialEq)]
pub struct Region {
    /// Its box, pixels.
    pub bbox: Rect,
    /// The confidence of who says so, 0 to 1; 1 for a person or the ground truth.
    pub score: f64,
    /// Its visible pixels, of the image's size, where they are known.
    pub mask: Option<Mask>,
    /// Whether the mask holds all pixels in which to look; otherwise it is grown, as masks of detectors are coarse.
    pub exact: bool,
}

/// Masks are grown by this fraction of their box's longer side: masks are coarse, and depth is shifted against colour (chosen on
/// masks of the detector in simulated LM-O depth).
const MASK_MARGIN: f64 = 0.04;
/// The same for ICP, whose network has its own, finer idea of where the object is: only what lies well beside it is kept out.
const ICP_MARGIN: f64 = 0.12;
/// Boxes are scaled by this factor: they are tight, and depth is shifted against colour.
const BOX_SCALE: f64 = 1.1;

impl Region {
    /// A box that somebody drew.
    pub fn of_box(bbox: Rect) -> Region {
        Region { bbox, score: 1.0, mask: None, exact: false }
    }

    /// The pixels of a mask; `None` for an empty one.
    pub fn of_mask(mask: Mask) -> Option<Region> {
        let [x, y, width, height] = mask.bounding_box()?.map(|v| v as f64);
        Some(Region { bbox: Rect { x, y, width, height }, score: 1.0, mask: Some(mask), exact: true })
    }

    /// The pixels in which a method on depth looks: the mask's where there is one, else the box's, both grown a little.
    pub fn pixels(&self, camera: &Camera) -> Mask {
        match &self.mask {
            Some(mask) if self.exact => mask.clone(),
            Some(mask) => mask.grown(self.margin(MASK_MARGIN)),
            None => box_mask(&self.bbox, camera),
        }
    }

    /// The pixels whose depth may be the object's, where there is a mask.
    pub fn pixels_for_icp(&self) -> Option<Mask> {
        self.mask.as_ref().map(|mask| mask.grown(self.margin(ICP_MARGIN)))
    }

    /// Pixels, two at least.
    fn margin(&self, fraction: f64) -> usize {
        (fraction * self.bbox.width.max(self.bbox.height)).ceil().max(2.0) as usize
    }
}

/// The pixels of a box, grown a little.
pub(crate) fn box_mask(region: &Rect, camera: &Camera) -> Mask {
    let r = region.scaled(BOX_SCALE);
    Mask::from_fn(camera.width, camera.height, |x, y| {
        let (x, y) = (x as f64, y as f64);
        x >= r.x && y >= r.y && x < r.x + r.width && y < r.y + r.height
    })
}
