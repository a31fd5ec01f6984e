//! The pinhole camera, with Brown-Conrady distortion that is removed when images enter the system.
//!
//! [`Camera::check`] refuses invalid numbers, [`Camera::check_lens`] a camera that no real lens has, and
//! [`Camera::check_whole_image`] a camera that cannot belong to a whole image, such as intrinsics in a wrong unit or for another
//! resolution.
//!
//! Distortion after Brown (1966) with the coefficients `k1 k2 p1 p2 k3` in OpenCV's order. Only [`Camera::undistort_point`] and
//! [`Camera::distort_point`] use them; all other code works with pinhole pixels.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::{Mat3, Rect, Vec2, Vec3};

/// Largest angle between an image edge and the optical axis, degrees: the field of view of a centred image is up to twice this
/// angle. At 90 degrees a pinhole image would be infinitely large.
const MAX_OFF_AXIS: f64 = 85.0;
/// Largest ratio of the focal lengths, either way: pixels of sensors are square, and images are rarely stretched by more.
const MAX_RATIO: f64 = 2.0;
/// Longest focal length, pixels: a telescope's. One of its pixels covers a micrometre at a metre.
const MAX_FOCAL_LENGTH: f64 = 1e6;
/// Smallest field of view along the longer side of a whole image, degrees: a lens of 2 metres in front of a full-frame sensor.
const MIN_FIELD_OF_VIEW: f64 = 1.0;
/// The principal point of a whole image lies within this part of its width and height.
const CENTRE: std::ops::RangeInclusive<f64> = 0.1..=0.9;
/// A principal point nearer than this to one corner, as a fraction of width and of height, belongs to an image of another
/// resolution: a smaller one if the corner is at the top left.
const CORNER: f64 = 0.35;
/// Largest factor by which a lens moves the middle of an image's edge towards or away from the optical axis.
const MAX_DISTORTION: f64 = 5.0;
/// Maximum number of pixels of a camera's image: a rendering takes 8 bytes per pixel.
const MAX_PIXELS: usize = 1 << 28;

/// Why a camera is not usable.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum CameraError {
    /// A parameter is out of range.
    #[error("camera field {field}: found {found}, expected {expected}")]
    Field {
        /// Name of the field.
        field: &'static str,
        /// Its value.
        found: f64,
        /// The expected value.
        expected: &'static str,
    },
    /// No lens has these parameters, or not with an image of this size.
    #[error("camera {fields}: found {found}, expected {expected}; {advice}")]
    Implausible {
        /// Names of the fields.
        fields: &'static str,
        /// Their values and what these would imply.
        found: String,
        /// The expected values.
        expected: &'static str,
        /// Advice.
        advice: &'static str,
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

impl CameraError {
    /// Adds the image's size to the value that the error reports.
    fn of_image(mut self, camera: &Camera) -> Self {
        if let CameraError::Implausible { found, .. } = &mut self {
            found.push_str(&format!(" for an image of {}x{}", camera.width, camera.height));
        }
        self
    }
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
        if self.width * self.height > MAX_PIXELS {
            return Err(CameraError::Field {
                field: "width x height",
                found: self.width as f64 * self.height as f64,
                expected: "at most 268435456 pixels in all",
            });
        }
        Ok(())
    }

    /// Tests that a lens can have these parameters, of a whole image or of a crop: every edge of the image within 85 degrees of the
    /// optical axis (a field of view of 170 degrees), focal lengths up to a million pixels and within a factor of 2 of each other,
    /// and a distortion that moves no edge by more than a factor of 5.
    ///
    /// # Errors
    /// As [`Camera::check`]; [`CameraError::Implausible`], with what the numbers may be instead.
    pub fn check_lens(&self) -> Result<(), CameraError> {
        self.check()?;
        let ratio = self.fx / self.fy;
        if !(1.0 / MAX_RATIO..=MAX_RATIO).contains(&ratio) {
            return Err(CameraError::Implausible {
                fields: "fields fx, fy",
                found: format!("{} and {}", self.fx, self.fy),
                expected: "focal lengths in pixels within a factor of 2 of each other",
                advice: "pixels are square or nearly so: is a digit lost? Scale a stretched image back first",
            });
        }
        let axes = [
            ("fields fx, cx", self.fx, self.cx, self.width),
            ("fields fy, cy", self.fy, self.cy, self.height),
        ];
        for (fields, focal, centre, side) in axes {
            let last = side as f64 - 1.0;
            let off_axis = centre.abs().max((last - centre).abs());
            if off_axis > focal * MAX_OFF_AXIS.to_radians().tan() {
                let degrees = (off_axis / focal).atan().to_degrees();
                return Err(CameraError::Implausible {
                    fields,
                    found: format!(
                        "{focal} and {centre}, which puts an edge of the {}x{} image {degrees:.2} degrees off the optical axis",
                        self.width, self.height
                    ),
                    expected: "pixels, with every edge within 85 degrees",
                    advice: self.unit_advice(),
                });
            }
            if focal > MAX_FOCAL_LENGTH {
                return Err(CameraError::Implausible {
                    fields,
                    found: format!("{focal} and {centre}"),
                    expected: "a focal length of at most 1000000 pixels",
                    advice: "give it in pixels: millimetres times the image's width over the sensor's width",
                });
            }
        }
        self.check_distortion()
    }

    /// Tests that this is the camera of a whole image: as [`Camera::check_lens`], and a field of view of at least a degree along
    /// the longer side, with the principal point in the middle 80 percent of width and height and not as far towards a corner as
    /// that of an image of another resolution.
    ///
    /// # Errors
    /// As [`Camera::check_lens`].
    pub fn check_whole_image(&self) -> Result<(), CameraError> {
        self.check_lens()?;
        let (x, y) = (self.cx / self.width as f64, self.cy / self.height as f64);
        let off = !CENTRE.contains(&x) || !CENTRE.contains(&y);
        if off || x.max(y) < CORNER || x.min(y) > 1.0 - CORNER {
            return Err(CameraError::Implausible {
                fields: "fields cx, cy",
                found: format!("{}, {}", self.cx, self.cy),
                expected: "pixels near the centre of the image",
                advice: "intrinsics of another resolution? Scale them, or give the right image",
            }
            .of_image(self));
        }
        let extent = (self.width as f64 / self.fx).max(self.height as f64 / self.fy);
        let degrees = 2.0 * (0.5 * extent).atan().to_degrees();
        if degrees < MIN_FIELD_OF_VIEW {
            return Err(CameraError::Implausible {
                fields: "fields fx, fy",
                found: format!("{} and {}, a field of view of {degrees:.3} degrees", self.fx, self.fy),
                expected: "pixels, with a field of view of at least 1 degree",
                advice: "give focal lengths in pixels, and the camera of this image",
            }
            .of_image(self));
        }
        Ok(())
    }

    fn check_distortion(&self) -> Result<(), CameraError> {
        let Some(d) = &self.distortion else { return Ok(()) };
        let coefficients = [("k1", d.k1), ("k2", d.k2), ("p1", d.p1), ("p2", d.p2), ("k3", d.k3)];
        for (field, found) in coefficients {
            if !found.is_finite() {
                return Err(CameraError::Field { field, found, expected: "a finite number" });
            }
        }
        let (right, bottom) = (self.width as f64 - 1.0, self.height as f64 - 1.0);
        for (x, y) in [(0.0, self.cy), (right, self.cy), (self.cx, 0.0), (self.cx, bottom)] {
            let p = Vec2::new((x - self.cx) / self.fx, (y - self.cy) / self.fy);
            let (before, after) = (p.norm(), d.distort(&p).norm());
            let along = d.distort(&p).dot(&p);
            let fits = along > 0.0 && after < MAX_DISTORTION * before && after * MAX_DISTORTION > before;
            if before > 0.0 && !fits {
                return Err(CameraError::Implausible {
                    fields: "field distortion",
                    found: format!(
                        "k1 {}, k2 {}, p1 {}, p2 {}, k3 {}, which move pixel ({x:.0}, {y:.0}) by a factor of {:.3}",
                        d.k1,
                        d.k2,
                        d.p1,
                        d.p2,
                        d.k3,
                        along / (before * before)
                    ),
                    expected: "a factor between 0.2 and 5 at the edges of the image",
                    advice: "the coefficients are OpenCV's, in its order k1, k2, p1, p2, k3",
                });
            }
        }
        Ok(())
    }

    /// Advice about the possible unit of a focal length that is far too short.
    fn unit_advice(&self) -> &'static str {
        let longest = self.fx.max(self.fy);
        if longest < 10.0 && self.cx.abs() <= 2.0 && self.cy.abs() <= 2.0 {
            "these look normalised by the image's size: multiply fx and cx by its width, fy and cy by its height"
        } else if longest < 0.1 * self.width.max(self.height) as f64 {
            "a focal length in millimetres? In pixels it is millimetres times the image's width over the sensor's width; \
             intrinsics of another resolution have to be scaled"
        } else {
            "intrinsics of another resolution? Scale them, or give the right image; fisheye images have to be undistorted first"
        }
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

    /// The point in the camera frame that projects to a pinhole pixel, at `depth` metres along the optical axis.
    pub fn unproject(&self, pixel: &Vec2, depth: f64) -> Vec3 {
        Vec3::new((pixel.x - self.cx) / self.fx * depth, (pixel.y - self.cy) / self.fy * depth, depth)
    }

    /// The pixel of the raw, distorted image for a pinhole pixel.
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

    /// The same camera without distortion: the camera of the undistorted image.
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
        fn a_resized_crop_keeps_the_rays(x in -0.2..0.2f64, y in -0.2..0.2f64, z in 0.5..2.0f64) {
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
    fn impossible_cameras_are_refused_with_advice() {
        let of = |fx: f64, fy: f64, cx: f64, cy: f64| Camera::new(fx, fy, cx, cy, 640, 480).unwrap();
        let cases = [
            (of(0.5, 0.5, 319.5, 239.5), "millimetres"),
            (of(1e-5, 1e-5, 319.5, 239.5), "millimetres"),
            (of(0.9, 1.2, 0.5, 0.5), "normalised"),
            (of(572.4, 57.36, 325.3, 242.0), "a factor of 2"),
            (of(572.4, 0.5, 325.3, 242.0), "a factor of 2"),
            (of(572.4, 573.6, 1e9, 242.0), "another resolution"),
            (of(1e9, 1e9, 319.5, 239.5), "1000000 pixels"),
        ];
        for (camera, words) in cases {
            let error = camera.check_lens().unwrap_err().to_string();
            assert!(error.contains(words) && error.contains("field"), "{error}");
            assert!(camera.check_whole_image().is_err());
        }
        // Full-HD intrinsics for a VGA image and vice versa, a telescope.
        for camera in [
            of(1390.5, 1387.0, 965.0, 522.6),
            of(572.4, 573.6, 325.3, 242.0).crop(&Rect { x: 0.0, y: 0.0, width: 1920.0, height: 1080.0 }),
            of(60000.0, 60000.0, 319.5, 239.5),
        ] {
            assert_eq!(camera.check_lens(), Ok(()));
            let error = camera.check_whole_image().unwrap_err().to_string();
            assert!(error.contains(&format!("{}x{}", camera.width, camera.height)), "{error}");
        }
        let folded = Camera { distortion: Some(BrownConrady { k1: -9.0, ..Default::default() }), ..camera() };
        assert!(folded.check_lens().unwrap_err().to_string().contains("k1, k2, p1, p2, k3"));
        let large = Camera::new(5e5, 5e5, 5e5, 5e5, 1 << 20, 1 << 20).unwrap_err();
        assert!(large.to_string().contains("width x height"), "{large}");
    }

    #[test]
    fn wide_and_long_lenses_pass() {
        let of = |f: f64, w: usize, h: usize| {
            Camera::new(f, f, (w as f64 - 1.0) / 2.0, (h as f64 - 1.0) / 2.0, w, h).unwrap()
        };
        // 165 degrees wide; a lens of 600 mm in front of a sensor of 36 mm; 1024 pixels at 1.2 degrees; a bin-picking camera.
        for camera in
            [of(42.2, 640, 480), of(100_000.0, 6000, 4000), of(48_900.0, 1024, 768), of(2992.6, 1280, 960)]
        {
            assert_eq!(camera.check_whole_image(), Ok(()));
        }
        let action = BrownConrady { k1: -0.25, k2: 0.07, p1: 2e-4, p2: -1e-4, k3: -0.008 };
        let wide = Camera { distortion: Some(action), ..of(870.0, 1920, 1080) };
        assert_eq!(wide.check_whole_image(), Ok(()));
    }

    #[test]
    fn bad_intrinsics_and_resolutions_are_named() {
        let error = Camera::new(0.0, 500.0, 320.0, 240.0, 640, 480).unwrap_err();
        assert!(error.to_string().contains("fx"), "{error}");
        let error = camera().check_image(1280, 960).unwrap_err();
        assert!(error.to_string().contains("1280x960"), "{error}");
    }
}
