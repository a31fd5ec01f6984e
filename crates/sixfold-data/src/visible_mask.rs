//! The mask of a visible object in an image, stored only within its box, because a dataset has thousands of
//! instances.

use sixfold_geometry::{Mask, Rect, Vec2};

/// A mask cropped to its box. Pixels outside the box do not show the object.
#[derive(Debug, Clone)]
pub struct VisibleMask {
    /// Columns and rows of the image.
    size: (usize, usize),
    x: usize,
    y: usize,
    width: usize,
    height: usize,
    /// 1 where the object is visible, row by row.
    data: Vec<u8>,
    pixels: usize,
    outline: Vec<Vec2>,
}

impl VisibleMask {
    /// Crops a mask of a whole image to its box; an empty mask has an empty box.
    pub fn new(mask: &Mask) -> Self {
        let (mut x0, mut y0, mut x1, mut y1) = (usize::MAX, usize::MAX, 0, 0);
        let mut outline = Vec::new();
        let mut pixels = 0;
        for y in 0..mask.height() {
            let row = mask.row(y);
            let Some(first) = row.iter().position(|v| *v) else { continue };
            let last = row.iter().rposition(|v| *v).unwrap_or(first);
            pixels += row.iter().filter(|v| **v).count();
            (x0, y0, x1, y1) = (x0.min(first), y0.min(y), x1.max(last + 1), y1.max(y + 1));
            // The corners of the row's first and last pixels.
            for dy in [-0.5, 0.5] {
                outline.push(Vec2::new(first as f64 - 0.5, y as f64 + dy));
                outline.push(Vec2::new(last as f64 + 0.5, y as f64 + dy));
            }
        }
        if pixels == 0 {
            (x0, y0) = (0, 0);
        }
        let data = (y0..y1).flat_map(|y| mask.row(y)[x0..x1].iter().map(|v| u8::from(*v))).collect();
        let (width, height) = (x1 - x0, y1 - y0);
        VisibleMask { size: mask.size(), x: x0, y: y0, width, height, data, pixels, outline }
    }

    /// Box and pixels as bytes, which identify the mask.
    pub(crate) fn parts(&self) -> [Vec<u8>; 2] {
        let numbers = [self.size.0, self.size.1, self.x, self.y, self.width, self.height];
        [numbers.iter().flat_map(|n| (*n as u64).to_le_bytes()).collect(), self.data.clone()]
    }

    /// Columns and rows of the image of the mask.
    pub fn image_size(&self) -> (usize, usize) {
        self.size
    }

    /// Number of pixels that show the object.
    pub fn pixels(&self) -> usize {
        self.pixels
    }

    /// The box of the visible pixels.
    pub fn bounding_box(&self) -> Rect {
        let side = |length: usize| length as f64;
        Rect { x: side(self.x), y: side(self.y), width: side(self.width), height: side(self.height) }
    }

    /// Points of the image whose bounding box is that of the visible part for any rotation of the image.
    pub fn outline(&self) -> &[Vec2] {
        &self.outline
    }

    /// Whether a pixel of the image shows the object; no pixel outside the image does.
    pub fn contains(&self, x: isize, y: isize) -> bool {
        let (x, y) = (x - self.x as isize, y - self.y as isize);
        x >= 0
            && y >= 0
            && x < self.width as isize
            && y < self.height as isize
            && self.data[y as usize * self.width + x as usize] > 0
    }

    /// The bilinearly interpolated mask at `(u, v)` of the image, 0 to 1.
    pub fn sample(&self, u: f32, v: f32) -> f32 {
        let at = |x: isize, y: isize| f32::from(u8::from(self.contains(x, y)));
        let (x, y) = (u.floor(), v.floor());
        let (fx, fy) = (u - x, v - y);
        let (x, y) = (x as isize, y as isize);
        let top = at(x, y) * (1.0 - fx) + at(x + 1, y) * fx;
        let bottom = at(x, y + 1) * (1.0 - fx) + at(x + 1, y + 1) * fx;
        top * (1.0 - fy) + bottom * fy
    }

    /// The mask of the whole image.
    pub fn to_mask(&self) -> Mask {
        Mask::from_fn(self.size.0, self.size.1, |x, y| self.contains(x as isize, y as isize))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_box_holds_the_whole_mask() {
        let mask = Mask::from_fn(9, 7, |x, y| (x == 3 && y == 2) || (x == 6 && y == 4));
        let cut = VisibleMask::new(&mask);
        assert_eq!((cut.pixels(), cut.image_size()), (2, (9, 7)));
        assert_eq!(cut.bounding_box(), Rect { x: 3.0, y: 2.0, width: 4.0, height: 3.0 });
        assert_eq!(cut.to_mask().as_slice(), mask.as_slice());
        assert_eq!(cut.sample(3.0, 2.0), 1.0);
        assert_eq!(cut.sample(2.75, 2.0), 0.75);
        assert_eq!(cut.sample(-5.0, 40.0), 0.0);
        let empty = VisibleMask::new(&Mask::filled(9, 7, false));
        assert_eq!((empty.pixels(), empty.to_mask().as_slice()), (0, &[false; 63][..]));
        assert!(empty.outline().is_empty());
    }
}
