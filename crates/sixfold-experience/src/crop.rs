//! The network's input for an object: a square around it that covers 30 cm at its distance, with surface normals, points and VD-NOC
//! (dissertation, section 6.2.2).

use serde::{Deserialize, Serialize};
use sixfold_geometry::{
    Camera, DepthImage, Image, Mask, NormalOptions, Plane, Rect, Vec2, Vec3, inpaint_depth,
    normals_from_depth,
};
use sixfold_grasp::GraspView;
use thiserror::Error;

use crate::Extent;

/// Why an object cannot be cropped from a depth image.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum CropError {
    /// The sizes of depth image, mask and camera differ.
    #[error(
        "depth image {depth:?}, mask {mask:?} and camera {camera:?} (pixels): expected the same size for all three"
    )]
    Sizes {
        /// Size of the depth image.
        depth: (usize, usize),
        /// Size of the mask.
        mask: (usize, usize),
        /// Image size of the camera.
        camera: (usize, usize),
    },
    /// Too few pixels of the object have depth.
    #[error(
        "{found} pixels of the object have depth and a normal, expected at least {expected}: is this the mask of this depth image?"
    )]
    TooSmall {
        /// Pixels of the crop that show the object.
        found: usize,
        /// Number of pixels needed.
        expected: usize,
    },
}

/// Options of the crop.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CropOptions {
    /// Side of the crop in pixels.
    pub side: usize,
    /// Side of the area that the crop covers at the object's distance, metres.
    pub size: f64,
    /// Half width of the window from which normals are computed, pixels of the depth image.
    pub normal_radius: usize,
    /// Fraction of points left out at the ends of each axis for the VD-NOC; 0 for equation 6.1 as published.
    pub trim: f64,
    /// Fewest pixels of an object.
    pub min_pixels: usize,
}

impl CropOptions {
    /// The dissertation's options: 128x128 pixels for 30 cm, the extent of all points.
    pub fn paper() -> Self {
        CropOptions { side: 128, trim: 0.0, ..CropOptions::compact() }
    }

    /// 96x96 pixels for 30 cm, without the outermost 1 % of points.
    pub fn compact() -> Self {
        CropOptions { side: 96, size: 0.3, normal_radius: 4, trim: 0.01, min_pixels: 40 }
    }
}

/// The network's input for an object. Pixels that do not show the object are zero.
#[derive(Debug, Clone, PartialEq)]
pub struct Crop {
    /// Side in pixels.
    pub side: usize,
    /// The camera of the crop: its pixels are those of the crop.
    pub camera: Camera,
    /// Which pixels show the object.
    pub mask: Vec<bool>,
    /// For every pixel of the crop, the index of its pixel in the depth image, row by row.
    pub source: Vec<u32>,
    /// Unit normals in the camera's frame, pointing towards the camera; row by row.
    pub normals: Vec<[f32; 3]>,
    /// Points in the camera's frame, metres.
    pub points: Vec<[f32; 3]>,
    /// VD-NOC, each value from -1 to 1.
    pub vd_noc: Vec<[f32; 3]>,
    /// The extent with which points are converted to VD-NOC.
    pub extent: Extent,
    /// The plane on which the object stands, in the camera's frame, with its normal up; `None` if unknown.
    pub table: Option<Plane>,
}

impl Crop {
    /// Crops the object in `mask` from a depth image (metres) of a camera without distortion.
    ///
    /// # Errors
    /// [`CropError`].
    pub fn new(
        depth: &DepthImage,
        camera: &Camera,
        mask: &Mask,
        options: &CropOptions,
    ) -> Result<Crop, CropError> {
        let size = (camera.width, camera.height);
        if depth.size() != size || mask.size() != size {
            return Err(CropError::Sizes { depth: depth.size(), mask: mask.size(), camera: size });
        }
        let too_small = |found| CropError::TooSmall { found, expected: options.min_pixels };
        let at = |x: usize, y: usize| mask[(x, y)] && depth[(x, y)] > 0.0;
        let (mut sum, mut count) = (Vec3::zeros(), 0usize);
        for (x, y) in (0..size.1).flat_map(|y| (0..size.0).map(move |x| (x, y))) {
            if at(x, y) {
                sum += camera.unproject(&Vec2::new(x as f64, y as f64), f64::from(depth[(x, y)]));
                count += 1;
            }
        }
        if count < options.min_pixels {
            return Err(too_small(count));
        }
        let centroid = sum / count as f64;
        let centre = camera.project(&centroid).ok_or_else(|| too_small(0))?;
        // Size of the crop's area in pixels of the depth image.
        let pixels = options.size * 0.5 * (camera.fx + camera.fy) / centroid.z;
        // In coordinates of pixel corners, which differ from those of pixel centres by half a pixel.
        let corner = |c: f64| c + 0.5 - 0.5 * pixels;
        let rect = Rect { x: corner(centre.x), y: corner(centre.y), width: pixels, height: pixels };
        let step = pixels / options.side as f64;
        let part = Part::new(depth, camera, &rect, options.normal_radius);
        let total = options.side * options.side;
        let mut crop = Crop {
            side: options.side,
            camera: Camera {
                fx: camera.fx / step,
                fy: camera.fy / step,
                cx: (camera.cx + 0.5 - rect.x) / step - 0.5,
                cy: (camera.cy + 0.5 - rect.y) / step - 0.5,
                width: options.side,
                height: options.side,
                distortion: None,
            },
            source: vec![0; total],
            mask: vec![false; total],
            normals: vec![[0.0; 3]; total],
            points: vec![[0.0; 3]; total],
            vd_noc: vec![[0.0; 3]; total],
            extent: Extent { centre: centroid, half: Vec3::repeat(1.0) },
            table: None,
        };
        let mut seen = vec![];
        for (i, (u, v)) in (0..options.side).flat_map(|v| (0..options.side).map(move |u| (u, v))).enumerate()
        {
            // The centre of the crop's pixel in the depth image, rounded to the nearest pixel.
            let x = (rect.x + (u as f64 + 0.5) * step - 0.5).round();
            let y = (rect.y + (v as f64 + 0.5) * step - 0.5).round();
            if x < 0.0 || y < 0.0 || x >= size.0 as f64 || y >= size.1 as f64 {
                continue;
            }
            let (x, y) = (x as usize, y as usize);
            let normal = part.normal(x, y);
            if !at(x, y) || normal == [0.0; 3] {
                continue;
            }
            let point = camera.unproject(&Vec2::new(x as f64, y as f64), f64::from(depth[(x, y)]));
            crop.mask[i] = true;
            crop.source[i] = (y * size.0 + x) as u32;
            crop.normals[i] = normal;
            crop.points[i] = [point.x as f32, point.y as f32, point.z as f32];
            seen.push(point);
        }
        if seen.len() < options.min_pixels {
            return Err(too_small(seen.len()));
        }
        crop.set_extent(&seen, options.trim);
        Ok(crop)
    }

    /// Crops the object of a view, and keeps the table on which it stands.
    ///
    /// # Errors
    /// [`CropError`].
    pub fn of_view(view: &GraspView, options: &CropOptions) -> Result<Crop, CropError> {
        Ok(Crop { table: view.table, ..Crop::new(&view.depth, &view.camera, &view.mask, options)? })
    }

    /// Computes extent and VD-NOC from the points.
    pub(crate) fn set_extent(&mut self, seen: &[Vec3], trim: f64) {
        if let Some(extent) = Extent::of(seen, trim) {
            self.extent = extent;
        }
        for ((noc, point), inside) in self.vd_noc.iter_mut().zip(&self.points).zip(&self.mask) {
            if *inside {
                let n = self.extent.normalise(&Vec3::from_fn(|k, _| f64::from(point[k])));
                *noc = [n.x, n.y, n.z].map(|v| v.clamp(-1.0, 1.0) as f32);
            }
        }
    }

    /// Pixels that show the object.
    pub fn pixels(&self) -> impl Iterator<Item = usize> + '_ {
        self.mask.iter().enumerate().filter(|(_, inside)| **inside).map(|(i, _)| i)
    }

    /// The point of a pixel in the camera's frame, metres.
    pub fn point(&self, pixel: usize) -> Vec3 {
        Vec3::from_fn(|k, _| f64::from(self.points[pixel][k]))
    }

    /// Normals as three planes of `side * side` numbers: the geometry encoder's input.
    pub fn normal_planes(&self) -> Vec<f32> {
        planes(&self.normals)
    }

    /// VD-NOC as three planes: the VD-NOC encoder's input.
    pub fn vd_noc_planes(&self) -> Vec<f32> {
        planes(&self.vd_noc)
    }
}

/// From interleaved to planar layout.
fn planes(pixels: &[[f32; 3]]) -> Vec<f32> {
    (0..3).flat_map(|k| pixels.iter().map(move |p| p[k])).collect()
}

/// Normals in the part of a depth image around an object.
struct Part {
    normals: Image<[f32; 3]>,
    left: usize,
    top: usize,
}

impl Part {
    fn new(depth: &DepthImage, camera: &Camera, rect: &Rect, radius: usize) -> Part {
        let margin = radius as f64 + 2.0;
        let clamp = |v: f64, limit: usize| v.clamp(0.0, limit as f64) as usize;
        let (left, top) = (
            clamp((rect.x - margin).floor(), depth.width()),
            clamp((rect.y - margin).floor(), depth.height()),
        );
        let right = clamp((rect.x + rect.width + margin).ceil(), depth.width()).max(left);
        let bottom = clamp((rect.y + rect.height + margin).ceil(), depth.height()).max(top);
        let part = Image::from_fn(right - left, bottom - top, |x, y| depth[(left + x, top + y)]);
        let near = camera.crop(&Rect {
            x: left as f64,
            y: top as f64,
            width: (right - left) as f64,
            height: (bottom - top) as f64,
        });
        let options = NormalOptions { radius, ..NormalOptions::default() };
        let near = Camera { width: part.width(), height: part.height(), ..near };
        let normals = normals_from_depth(&inpaint_depth(&part, 2), &near, &options);
        Part { normals, left, top }
    }

    /// The normal at a pixel of the whole image, zero outside the part.
    fn normal(&self, x: usize, y: usize) -> [f32; 3] {
        match (x.checked_sub(self.left), y.checked_sub(self.top)) {
            (Some(u), Some(v)) => self.normals.get(u, v).copied().unwrap_or([0.0; 3]),
            _ => [0.0; 3],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene() -> (DepthImage, Camera, Mask) {
        let camera = Camera::new(575.0, 575.0, 319.5, 239.5, 640, 480).unwrap();
        // A plane patch of 10 cm at 0.8 m, to the right of the centre.
        let inside = |x: usize, y: usize| (400..472).contains(&x) && (200..272).contains(&y);
        let depth = Image::from_fn(640, 480, |x, y| if inside(x, y) { 0.8 } else { 1.5 });
        (depth, camera, Mask::from_fn(640, 480, inside))
    }

    #[test]
    fn the_crop_covers_thirty_centimetres_around_the_object() {
        let (depth, camera, mask) = scene();
        let crop = Crop::new(&depth, &camera, &mask, &CropOptions::compact()).unwrap();
        let projected = crop.camera.project(&Vec3::new(0.162, -0.0049, 0.8)).unwrap();
        assert!((projected - Vec2::new(47.5, 47.5)).norm() < 1.5, "{projected}");
        // 10 of 30 cm squared, except for the edges, which have normals as well.
        let fraction = crop.pixels().count() as f64 / (96.0 * 96.0);
        assert!((fraction - 1.0 / 9.0).abs() < 0.02, "{fraction}");
        for i in crop.pixels() {
            assert!(crop.normals[i][2] < -0.99);
            let projected = crop.camera.project(&crop.point(i)).unwrap();
            let pixel = Vec2::new((i % 96) as f64, (i / 96) as f64);
            assert!((projected - pixel).norm() < 0.75, "{projected} {pixel}");
            let back = crop.extent.restore(&Vec3::from_fn(|k, _| f64::from(crop.vd_noc[i][k])));
            assert!((back - crop.point(i)).norm() < 0.004);
        }
        assert_eq!(crop.normal_planes()[2 * 96 * 96 + 48 * 96 + 48], crop.normals[48 * 96 + 48][2]);
    }

    #[test]
    fn errors_explain_why_a_crop_fails() {
        let (depth, camera, mask) = scene();
        let empty = Mask::filled(640, 480, false);
        let error = Crop::new(&depth, &camera, &empty, &CropOptions::compact()).unwrap_err();
        assert!(error.to_string().contains("0 pixels of the object"), "{error}");
        let small = Mask::filled(3, 3, true);
        let error = Crop::new(&depth, &camera, &small, &CropOptions::compact()).unwrap_err();
        assert!(error.to_string().contains("(3, 3)"), "{error}");
        // An object at the edge of the image is cropped as well.
        let edge = Mask::from_fn(640, 480, |x, y| mask[(x, y)] && x > 440);
        assert!(Crop::new(&depth, &camera, &edge, &CropOptions::paper()).is_ok());
    }
}
