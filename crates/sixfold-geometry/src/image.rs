//! Row-major images: the one container for depth, masks, normals, coordinates and colour.

use thiserror::Error;

/// Why an image could not be built.
#[derive(Debug, Error, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum ImageError {
    /// The pixel buffer does not hold `width * height` pixels.
    #[error("an image of {width}x{height} needs {expected} pixels, the buffer has {found}")]
    WrongLength {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// `width * height`.
        expected: usize,
        /// Pixels in the buffer.
        found: usize,
    },
    /// `width * height` does not fit the machine's address space.
    #[error("an image of {width}x{height} is too large")]
    TooLarge {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
}

/// A row-major image of `width * height` pixels; pixel `(x, y)` is `data[y * width + x]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Image<T> {
    width: usize,
    height: usize,
    data: Vec<T>,
}

/// Depth along the optical axis in metres; `0.0` (or any value that is not finite and positive)
/// where nothing was measured.
pub type DepthImage = Image<f32>;
/// `true` where a pixel belongs to the region.
pub type Mask = Image<bool>;
/// Colour, 8 bit per channel, sRGB.
pub type RgbImage = Image<[u8; 3]>;
/// Unit surface normals in the camera frame, pointing to the camera; `[0, 0, 0]` where unknown.
pub type NormalImage = Image<[f32; 3]>;
/// A 3D point per pixel, in metres; the function that makes the image documents its frame and the value of
/// missing pixels.
pub type PointImage = Image<[f32; 3]>;

impl<T: Clone> Image<T> {
    /// An image in which every pixel is `value`.
    pub fn filled(width: usize, height: usize, value: T) -> Self {
        Image { width, height, data: vec![value; width * height] }
    }
}

impl<T> Image<T> {
    /// Wraps a row-major buffer.
    ///
    /// # Errors
    /// [`ImageError::WrongLength`] unless `data.len() == width * height`.
    pub fn from_vec(width: usize, height: usize, data: Vec<T>) -> Result<Self, ImageError> {
        let expected = width.checked_mul(height).ok_or(ImageError::TooLarge { width, height })?;
        if data.len() != expected {
            return Err(ImageError::WrongLength { width, height, expected, found: data.len() });
        }
        Ok(Image { width, height, data })
    }

    /// Builds an image by calling `f(x, y)` for every pixel, row by row.
    pub fn from_fn(width: usize, height: usize, mut f: impl FnMut(usize, usize) -> T) -> Self {
        let mut data = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                data.push(f(x, y));
            }
        }
        Image { width, height, data }
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// `(width, height)`.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// The pixel at `(x, y)`, or `None` outside the image.
    pub fn get(&self, x: usize, y: usize) -> Option<&T> {
        if x < self.width && y < self.height { self.data.get(y * self.width + x) } else { None }
    }

    /// All pixels, row by row.
    pub fn as_slice(&self) -> &[T] {
        &self.data
    }

    /// All pixels, row by row, mutable.
    pub fn as_mut_slice(&mut self) -> &mut [T] {
        &mut self.data
    }

    /// The pixel buffer.
    pub fn into_vec(self) -> Vec<T> {
        self.data
    }

    /// Row `y` as a slice.
    ///
    /// # Panics
    /// When `y` is not below the height.
    pub fn row(&self, y: usize) -> &[T] {
        &self.data[y * self.width..(y + 1) * self.width]
    }

    /// An image of the same size with `f` applied to every pixel.
    pub fn map<U>(&self, f: impl FnMut(&T) -> U) -> Image<U> {
        Image { width: self.width, height: self.height, data: self.data.iter().map(f).collect() }
    }
}

impl Image<bool> {
    /// The smallest box that holds all pixels of the mask, `[x, y, width, height]`; `None` for an empty mask.
    pub fn bounding_box(&self) -> Option<[usize; 4]> {
        let (mut x0, mut y0, mut x1, mut y1) = (usize::MAX, usize::MAX, 0, 0);
        for y in 0..self.height {
            let row = self.row(y);
            let (Some(first), Some(last)) = (row.iter().position(|m| *m), row.iter().rposition(|m| *m))
            else {
                continue;
            };
            (x0, y0, x1, y1) = (x0.min(first), y0.min(y), x1.max(last + 1), y + 1);
        }
        (x1 > x0).then(|| [x0, y0, x1 - x0, y1 - y0])
    }

    /// The mask dilated by a square: all pixels at most `pixels` columns and rows from a pixel of the mask.
    pub fn grown(&self, pixels: usize) -> Image<bool> {
        let spread = |line: &[bool]| -> Vec<bool> {
            let mut near = vec![false; line.len()];
            for (i, _) in line.iter().enumerate().filter(|(_, inside)| **inside) {
                near[i.saturating_sub(pixels)..(i + pixels + 1).min(line.len())].fill(true);
            }
            near
        };
        let mut grown = self.clone();
        for row in grown.data.chunks_mut(self.width.max(1)) {
            row.copy_from_slice(&spread(row));
        }
        for x in 0..self.width {
            let column: Vec<bool> = (0..self.height).map(|y| grown.data[y * self.width + x]).collect();
            for (y, near) in spread(&column).into_iter().enumerate() {
                grown.data[y * self.width + x] = near;
            }
        }
        grown
    }
}

impl<T> std::ops::Index<(usize, usize)> for Image<T> {
    type Output = T;
    fn index(&self, (x, y): (usize, usize)) -> &T {
        assert!(x < self.width && y < self.height, "pixel ({x}, {y}) outside the image");
        &self.data[y * self.width + x]
    }
}

impl<T> std::ops::IndexMut<(usize, usize)> for Image<T> {
    fn index_mut(&mut self, (x, y): (usize, usize)) -> &mut T {
        assert!(x < self.width && y < self.height, "pixel ({x}, {y}) outside the image");
        &mut self.data[y * self.width + x]
    }
}

/// An axis-aligned rectangle in pixels: `x, y` of the top left corner, width and height, as in BOP and COCO
/// (`[x, y, w, h]`).
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Rect {
    /// Left edge in pixels.
    pub x: f64,
    /// Top edge in pixels.
    pub y: f64,
    /// Width in pixels.
    pub width: f64,
    /// Height in pixels.
    pub height: f64,
}

impl Rect {
    /// The area in square pixels, zero for an empty rectangle.
    pub fn area(&self) -> f64 {
        self.width.max(0.0) * self.height.max(0.0)
    }

    /// The intersection of two rectangles; `None` if it is empty.
    pub fn intersect(&self, other: &Rect) -> Option<Rect> {
        let x = self.x.max(other.x);
        let y = self.y.max(other.y);
        let right = (self.x + self.width).min(other.x + other.width);
        let bottom = (self.y + self.height).min(other.y + other.height);
        (right > x && bottom > y).then_some(Rect { x, y, width: right - x, height: bottom - y })
    }

    /// Intersection over union, in `0..=1`.
    pub fn iou(&self, other: &Rect) -> f64 {
        let common = self.intersect(other).map_or(0.0, |r| r.area());
        let union = self.area() + other.area() - common;
        if union > 0.0 { common / union } else { 0.0 }
    }

    /// The same rectangle grown by `factor` about its centre (1.5 makes it half as large again).
    pub fn scaled(&self, factor: f64) -> Rect {
        let (w, h) = (self.width * factor, self.height * factor);
        Rect { x: self.x + 0.5 * (self.width - w), y: self.y + 0.5 * (self.height - h), width: w, height: h }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_buffer_of_the_wrong_length_is_refused() {
        let error = Image::from_vec(3, 2, vec![0u8; 5]).unwrap_err();
        assert_eq!(error, ImageError::WrongLength { width: 3, height: 2, expected: 6, found: 5 });
    }

    #[test]
    fn masks_grow_by_whole_pixels_up_to_the_border() {
        let mut mask = Image::filled(6, 4, false);
        mask[(1, 0)] = true;
        let inside = |grown: &Image<bool>| -> Vec<(usize, usize)> {
            (0..4).flat_map(|y| (0..6).map(move |x| (x, y))).filter(|at| grown[*at]).collect()
        };
        assert_eq!(inside(&mask.grown(0)), [(1, 0)]);
        assert_eq!(inside(&mask.grown(1)), [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1)]);
        mask[(5, 3)] = true;
        assert_eq!(mask.grown(2).as_slice().iter().filter(|v| **v).count(), 12 + 9 - 2);
        assert!(Image::<bool>::filled(0, 0, true).grown(3).as_slice().is_empty());
    }

    #[test]
    fn rows_and_pixels_agree() {
        let image = Image::from_fn(4, 3, |x, y| 10 * y + x);
        assert_eq!(image.row(2), &[20, 21, 22, 23]);
        assert_eq!(image[(3, 1)], 13);
        assert_eq!(image.get(4, 0), None);
    }

    #[test]
    fn iou_of_half_overlapping_boxes() {
        let a = Rect { x: 0.0, y: 0.0, width: 2.0, height: 2.0 };
        let b = Rect { x: 1.0, y: 0.0, width: 2.0, height: 2.0 };
        assert!((a.iou(&b) - 1.0 / 3.0).abs() < 1e-12);
        assert_eq!(a.iou(&Rect { x: 5.0, y: 5.0, width: 1.0, height: 1.0 }), 0.0);
    }
}
