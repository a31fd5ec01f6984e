//! The pinhole camera, with Brown-Conrady distortion that is undone at the edge of the system.
//!
//! Distortion after Brown (1966) with the coefficients `k1 k2 p1 p2 k3` in OpenCV's order. Only
//! [`Camera::undistort_point`] and [`Camera::distort_point`] know it: everything behind the edge works with pinhole pixels.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::{Mat3, Rect, Vec2, Vec3};

/// Why a camera is not usable.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum CameraError {
    /// A parameter is out of range.
    #[error("camera field {field}: found {found}, expected {expected}")]
    Field {
        /// Name of the field.
        field: &'static str,
        /// What it held.
        found: f64,
        /// What it should hold.
        expected: &'static str,
    },
    /// The intrinsics belong to an image of another size.
    #[error(
        "the camera is for images of {camera_width}x{camera_height}, the image has {width}x{height}: \
         intrinsics of another resolution; scale the intrinsics or give the right image"
    )]
    Resolution {
        /// Width the camera is for.
        camera_width: usize,
        /// Height the camera is for.
        camera_height: usize,
        /// Width of the image.
        width: usize,
        /// Height of the image.
        height: usize,
    },
}

/// Lens distortion after Brown (1966), coefficients in OpenCV's order.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Default)]
pub struct BrownConrady {
    /// Radial, second order.
    pub k1: f64,
    /// Radial, fourth order.
    pub k2: f64,
    /// Tangential.
    pub p1: f64,
    /// Tangential.
    pub p2: f64,
    /// Radial, sixth order.
    #[serde(default)]
    pub k3: f64,
}

impl BrownConrady {
    /// Distorts a point on the plane `z = 1`.
    pub fn distort(&self, p: &Vec2) -> Vec2 {
        let (x, y) = (p.x, p.y);
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3));
        Vec2::new(
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
        )
    }

    /// Undoes [`BrownConrady::distort`] by Newton's method with a numerical Jacobian; `None` where the
    /// distortion folds over and has no inverse.
    pub fn undistort(&self, p: &Vec2) -> Option<Vec2> {
        let mut x = *p;
        for _ in 0..50 {
            let residual = self.distort(&x) - p;
            if residual.norm() < 1e-12 {
                return Some(x);
            }
            let h = 1e-7;
            let dx =
                (self.distort(&(x + Vec2::new(h, 0.0))) - self.distort(&(x - Vec2::new(h, 0.0)))) / (2.0 * h);
            let dy =
                (self.distort(&(x + Vec2::new(0.0, h))) - self.distort(&(x - Vec2::new(0.0, h)))) / (2.0 * h);
            let det = dx.x * dy.y - dy.x * dx.y;
            if !(det > 1e-6) {
                return None;
            }
            x -= Vec2::new(
                (dy.y * residual.x - dy.x * residual.y) / det,
                (dx.x * residual.y - dx.y * residual.x) / det,
            );
        }
        (self.distort(&x) - p).norm().lt(&1e-9).then_some(x)
    }
}

/// A pinhole camera: focal lengths and principal point in pixels, image size in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Focal length in x, pixels.
    pub fx: f64,
    /// Focal length in y, pixels.
    pub fy: f64,
    /// Principal point x, pixels (centre of the left column is 0).
    pub cx: f64,
    /// Principal point y, pixels (centre of the top row is 0).
    pub cy: f64,
    /// Image width in pixels.
    pub width: usize,
    /// Image height in pixels.
    pub height: usize,
    /// Lens distortion of the raw image, if it was not undone yet.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub distortion: Option<BrownConrady>,
}

impl Camera {
    /// A camera without distortion.
    ///
    /// # Errors
    /// [`CameraError::Field`] as in [`Camera::check`].
    pub fn new(fx: f64, fy: f64, cx: f64, cy: f64, width: usize, height: usize) -> Result<Self, CameraError> {
        let camera = Camera { fx, fy, cx, cy, width, height, distortion: None };
        camera.check()?;
        Ok(camera)
    }

    /// Tests every field.
    ///
    /// # Errors
    /// [`CameraError::Field`]: a focal length that is not finite and positive, a principal point that is not
    /// finite, or an empty image.
    pub fn check(&self) -> Result<(), CameraError> {
        for (field, found) in [("fx", self.fx), ("fy", self.fy)] {
            if !(found.is_finite() && found > 0.0) {
                return Err(CameraError::Field { field, found, expected: "a finite number above zero" });
            }
        }
        for (field, found) in [("cx", self.cx), ("cy", self.cy)] {
            if !found.is_finite() {
                return Err(CameraError::Field { field, found, expected: "a finite number" });
            }
        }
        for (field, found) in [("width", self.width), ("height", self.height)] {
            if found == 0 || found > 1 << 20 {
                return Err(CameraError::Field {
                    field,
                    found: found as f64,
                    expected: "between 1 and 1048576 pixels",
                });
            }
        }
        Ok(())
    }

    /// Tests that an image has the size that the intrinsics are for.
    ///
    /// # Errors
    /// [`CameraError::Resolution`].
    pub fn check_image(&self, width: usize, height: usize) -> Result<(), CameraError> {
        if (width, height) == (self.width, self.height) {
            return Ok(());
        }
        Err(CameraError::Resolution { camera_width: self.width, camera_height: self.height, width, height })
    }

    /// The intrinsic matrix `K`.
    pub fn matrix(&self) -> Mat3 {
        Mat3::new(self.fx, 0.0, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0)
    }

    /// Projects a point in the camera frame (metres) to pinhole pixels; `None` at or behind the camera.
    pub fn project(&self, point: &Vec3) -> Option<Vec2> {
        (point.z > 0.0)
            .then(|| Vec2::new(self.fx * point.x / point.z + self.cx, self.fy * point.y / point.z + self.cy))
    }

    /// The point in the camera frame that is seen at a pinhole pixel at `depth` metres along the axis.
    pub fn unproject(&self, pixel: &Vec2, depth: f64) -> Vec3 {
        Vec3::new((pixel.x - self.cx) / self.fx * depth, (pixel.y - self.cy) / self.fy * depth, depth)
    }

    /// Where the raw, distorted image shows what a pinhole would show at `pixel`.
    pub fn distort_point(&self, pixel: &Vec2) -> Vec2 {
        match &self.distortion {
            None => *pixel,
            Some(d) => {
                let p = d.distort(&Vec2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy));
                Vec2::new(p.x * self.fx + self.cx, p.y * self.fy + self.cy)
            }
        }
    }

    /// The pinhole pixel for a pixel of the raw, distorted image; `None` where the distortion cannot be undone.
    pub fn undistort_point(&self, pixel: &Vec2) -> Option<Vec2> {
        match &self.distortion {
            None => Some(*pixel),
            Some(d) => {
                let p =
                    d.undistort(&Vec2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy))?;
                Some(Vec2::new(p.x * self.fx + self.cx, p.y * self.fy + self.cy))
            }
        }
    }

    /// The same camera without its distortion: what an undistorted image was taken with.
    pub fn without_distortion(&self) -> Camera {
        Camera { distortion: None, ..*self }
    }

    /// The camera of the crop whose top left corner is at pixel corner `(rect.x, rect.y)`; the crop has
    /// `rect`'s size rounded to whole pixels.
    pub fn crop(&self, rect: &Rect) -> Camera {
        Camera {
            cx: self.cx - rect.x,
            cy: self.cy - rect.y,
            width: rect.width.round().max(1.0) as usize,
            height: rect.height.round().max(1.0) as usize,
            ..*self
        }
    }

    /// The camera of the image resized to `width x height`. Pixel centres lie at whole numbers, so the
    /// principal point moves as `(cx + 0.5) * s - 0.5`.
    pub fn resize(&self, width: usize, height: usize) -> Camera {
        let sx = width as f64 / self.width as f64;
        let sy = height as f64 / self.height as f64;
        Camera {
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: (self.cx + 0.5) * sx - 0.5,
            cy: (self.cy + 0.5) * sy - 0.5,
            width,
            height,
            distortion: self.distortion,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn camera() -> Camera {
        Camera::new(572.4, 573.6, 325.3, 242.0, 640, 480).unwrap()
    }

    proptest! {
        #[test]
        fn project_after_unproject(x in 0.0..639.0f64, y in 0.0..479.0f64, z in 0.1..5.0f64) {
            let p = camera().unproject(&Vec2::new(x, y), z);
            let back = camera().project(&p).unwrap();
            prop_assert!((back - Vec2::new(x, y)).norm() < 1e-9);
        }

        #[test]
        fn undistort_after_distort(x in 0.0..639.0f64, y in 0.0..479.0f64,
                                   k1 in -0.2..0.2f64, k2 in -0.05..0.05f64, p in -2e-3..2e-3f64) {
            let mut c = camera();
            c.distortion = Some(BrownConrady { k1, k2, p1: p, p2: -p, k3: 0.0 });
            let raw = c.distort_point(&Vec2::new(x, y));
            let back = c.undistort_point(&raw).unwrap();
            prop_assert!((back - Vec2::new(x, y)).norm() < 1e-6);
        }

        #[test]
        fn a_resized_crop_sees_the_same_ray(x in -0.2..0.2f64, y in -0.2..0.2f64, z in 0.5..2.0f64) {
            let point = Vec3::new(x, y, z);
            let rect = Rect { x: 100.0, y: 50.0, width: 200.0, height: 100.0 };
            let small = camera().crop(&rect).resize(100, 50);
            let full = camera().project(&point).unwrap();
            let in_crop = small.project(&point).unwrap();
            // Corner-based coordinates scale by exactly one half.
            prop_assert!(((full.x - 100.0 + 0.5) * 0.5 - (in_crop.x + 0.5)).abs() < 1e-9);
            prop_assert!(((full.y - 50.0 + 0.5) * 0.5 - (in_crop.y + 0.5)).abs() < 1e-9);
        }
    }

    #[test]
    fn points_behind_the_camera_are_not_projected() {
        assert!(camera().project(&Vec3::new(0.0, 0.0, 0.0)).is_none());
        assert!(camera().project(&Vec3::new(0.1, 0.0, -1.0)).is_none());
    }

    #[test]
    fn bad_intrinsics_and_resolutions_are_named() {
        let error = Camera::new(0.0, 500.0, 320.0, 240.0, 640, 480).unwrap_err();
        assert!(error.to_string().contains("fx"), "{error}");
        let error = camera().check_image(1280, 960).unwrap_err();
        assert!(error.to_string().contains("1280x960"), "{error}");
    }
}
