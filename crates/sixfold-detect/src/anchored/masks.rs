//! Masks of boxes, laid into the image (He et al. 2017, section 3.1, "Inference"; torchvision's `paste_masks_in_image`).

use sixfold_geometry::Mask;
use sixfold_geometry::stats::sigmoid;

use super::boxes::Corners;
use super::transform::{interpolate, taps};

/// Rows and columns of a mask before it is laid into the image.
pub const MASK_SIDE: usize = 28;
/// Rows and columns of zeros about a mask, so that it can end within its box.
const BORDER: usize = 1;
/// A pixel belongs to the object from this probability on (He et al. 2017, section 3.1).
const PROBABILITY: f32 = 0.5;

/// Probability that a point of a box shows the object, on a grid.
#[derive(Debug, Clone, PartialEq)]
pub struct MaskProbabilities {
    /// Row by row, [`MASK_SIDE`] each way.
    pub values: Vec<f32>,
}

/// Probabilities of the pixels of a part of an image; those of all others are 0.
#[derive(Debug, Clone, PartialEq)]
pub struct PastedMask {
    /// First column and row.
    pub corner: [usize; 2],
    /// Columns and rows; one of them may be 0.
    pub size: [usize; 2],
    /// Row by row.
    pub values: Vec<f32>,
}

impl MaskProbabilities {
    /// Of the mask with this number among the logits of many.
    pub(super) fn new(logits: &[f32], number: usize) -> MaskProbabilities {
        let pixels = MASK_SIDE * MASK_SIDE;
        MaskProbabilities {
            values: logits[number * pixels..][..pixels].iter().map(|v| sigmoid(*v)).collect(),
        }
    }

    /// The mask of a box (left, top, right and bottom) in an image of `size` (columns, rows).
    pub fn pasted(&self, corners: &[f32; 4], size: (usize, usize)) -> PastedMask {
        const SIDE: usize = MASK_SIDE + 2 * BORDER;
        let mut padded = vec![0.0; SIDE * SIDE];
        for (row, values) in self.values.chunks_exact(MASK_SIDE).enumerate() {
            padded[(row + BORDER) * SIDE + BORDER..][..MASK_SIDE].copy_from_slice(values);
        }
        let [left, top, right, bottom] = whole(corners);
        let [width, height] = [right - left, bottom - top].map(|side| (side + 1).max(1) as usize);
        let clip = |first: i64, last: i64, side: usize| {
            let from = first.clamp(0, side as i64);
            (from, (last + 1).clamp(from, side as i64))
        };
        let (x0, x1) = clip(left, right, size.0);
        let (y0, y1) = clip(top, bottom, size.1);
        let part = |from: i64, to: i64, first: i64, side: usize| {
            let mut all = taps(SIDE, side);
            all.truncate((to - first) as usize);
            all.split_off(((from - first) as usize).min(all.len()))
        };
        let (columns, rows) = (part(x0, x1, left, width), part(y0, y1, top, height));
        let mut values = vec![0.0; columns.len() * rows.len()];
        let stride = columns.len();
        interpolate(&padded, SIDE, &rows, &columns, |x, y, v| values[y * stride + x] = v);
        PastedMask { corner: [x0 as usize, y0 as usize], size: [columns.len(), rows.len()], values }
    }
}

/// The box as much larger as the border makes the mask, cut to whole numbers.
fn whole(c: &Corners) -> [i64; 4] {
    let scale = (MASK_SIDE + 2 * BORDER) as f64 / MASK_SIDE as f64;
    let half = [c[2] - c[0], c[3] - c[1]].map(|side| side * 0.5 * scale as f32);
    let centre = [(c[2] + c[0]) * 0.5, (c[3] + c[1]) * 0.5];
    [centre[0] - half[0], centre[1] - half[1], centre[0] + half[0], centre[1] + half[1]].map(|v| v as i64)
}

impl PastedMask {
    /// The pixels that rather show the object than not, in an image of `size` (columns, rows).
    pub fn mask(&self, size: (usize, usize)) -> Mask {
        let mut mask = Mask::filled(size.0, size.1, false);
        for (row, values) in self.values.chunks_exact(self.size[0].max(1)).enumerate() {
            for (column, value) in values.iter().enumerate() {
                mask[(self.corner[0] + column, self.corner[1] + row)] = *value >= PROBABILITY;
            }
        }
        mask
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_mask_fills_its_box_and_is_clipped_to_the_image() {
        let full = MaskProbabilities { values: vec![1.0; MASK_SIDE * MASK_SIDE] };
        // The numbers are those of paste_masks_in_image(torch.ones(1, 1, 28, 28), box, (40, 60)) >= 0.5: one pixel more on the right
        // and below, as the whole box counts its last pixel.
        let pasted = full.pasted(&[10.0, 20.0, 38.0, 48.0], (60, 40));
        assert_eq!((pasted.corner, pasted.size), ([9, 19], [31, 21]));
        let mask = pasted.mask((60, 40));
        assert_eq!(mask.bounding_box(), Some([10, 20, 29, 20]));
        assert!(mask[(24, 39)] && !mask[(9, 30)] && !mask[(39, 30)]);
        // All of it outside, and partly.
        let outside = full.pasted(&[70.0, 50.0, 80.0, 60.0], (60, 40));
        assert!(outside.mask((60, 40)).bounding_box().is_none());
        let left = full.pasted(&[-14.0, 0.0, 14.0, 28.0], (60, 40)).mask((60, 40));
        assert_eq!(left.bounding_box(), Some([0, 0, 15, 29]));
    }

    #[test]
    fn an_empty_mask_leaves_all_pixels() {
        let none = MaskProbabilities::new(&[-20.0; 2 * MASK_SIDE * MASK_SIDE], 1);
        assert!(none.pasted(&[0.0, 0.0, 5.0, 5.0], (9, 9)).mask((9, 9)).bounding_box().is_none());
    }
}
