//! Removal of lens distortion from whole images when they enter the system: from then on every image is a pinhole image.
//!
//! The distorted position of every pinhole pixel is computed (Brown 1966) and the raw image is read there; the distortion
//! is not inverted.

use rayon::prelude::*;

use crate::{Camera, CameraError, DepthImage, Image, Rect, RgbImage, Vec2};

/// The depth image that a pinhole camera with the same intrinsics would have measured. Takes the nearest raw pixel, because
/// a mean across a depth edge is a point that does not exist. Depth is missing outside the raw image.
///
/// # Errors
/// [`CameraError::Resolution`] when the image does not belong to the camera.
pub fn undistort_depth(raw: &DepthImage, camera: &Camera) -> Result<DepthImage, CameraError> {
    resample(raw, camera, |image, p| {
        let (x, y) = (p.x.round(), p.y.round());
        if x < 0.0 || y < 0.0 { 0.0 } else { image.get(x as usize, y as usize).copied().unwrap_or(0.0) }
    })
}

/// The colour image that a pinhole camera with the same intrinsics would have taken, interpolated bilinearly; black outside
/// the raw image.
///
/// # Errors
/// [`CameraError::Resolution`] when the image does not belong to the camera.
pub fn undistort_rgb(raw: &RgbImage, camera: &Camera) -> Result<RgbImage, CameraError> {
    resample(raw, camera, |image, p| {
        let (w, h) = (image.width() as f64 - 1.0, image.height() as f64 - 1.0);
        if !(p.x >= -0.5 && p.y >= -0.5 && p.x <= w + 0.5 && p.y <= h + 0.5) {
            return [0; 3];
        }
        let (x, y) = (p.x.clamp(0.0, w), p.y.clamp(0.0, h));
        let (x0, y0) = (x.floor(), y.floor());
        let (fx, fy) = (x - x0, y - y0);
        let (x0, y0) = (x0 as usize, y0 as usize);
        let (x1, y1) = ((x0 + 1).min(image.width() - 1), (y0 + 1).min(image.height() - 1));
        std::array::from_fn(|k| {
            let at = |x, y| f64::from(image[(x, y)][k]);
            let top = at(x0, y0) * (1.0 - fx) + at(x1, y0) * fx;
            let bottom = at(x0, y1) * (1.0 - fx) + at(x1, y1) * fx;
            (top * (1.0 - fy) + bottom * fy).round() as u8
        })
    })
}

/// The box in the pinhole image that contains the content of a box in the raw image, computed from 25 points on its border
/// and inside.
pub fn undistort_box(region: &Rect, lens: &Camera) -> Rect {
    if lens.distortion.is_none() {
        return *region;
    }
    let (mut low, mut high) = (Vec2::repeat(f64::INFINITY), Vec2::repeat(f64::NEG_INFINITY));
    for (u, v) in (0..=4).flat_map(|u| (0..=4).map(move |v| (u, v))) {
        let along = |i: i32, start: f64, size: f64| start + 0.25 * f64::from(i) * size;
        let at = Vec2::new(along(u, region.x, region.width), along(v, region.y, region.height));
        if let Some(at) = lens.undistort_point(&at) {
            (low, high) = (low.inf(&at), high.sup(&at));
        }
    }
    if low.x > high.x {
        return *region;
    }
    Rect { x: low.x, y: low.y, width: high.x - low.x, height: high.y - low.y }
}

fn resample<T: Clone + Send + Sync>(
    raw: &Image<T>,
    camera: &Camera,
    sample: impl Fn(&Image<T>, Vec2) -> T + Sync,
) -> Result<Image<T>, CameraError> {
    camera.check_image(raw.width(), raw.height())?;
    if camera.distortion.is_none() {
        return Ok(raw.clone());
    }
    let mut out = raw.clone();
    out.as_mut_slice().par_chunks_mut(raw.width()).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            *pixel = sample(raw, camera.distort_point(&Vec2::new(x as f64, y as f64)));
        }
    });
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::BrownConrady;

    fn camera() -> Camera {
        Camera {
            distortion: Some(BrownConrady { k1: -0.25, k2: 0.05, p1: 0.001, p2: -0.002, k3: 0.0 }),
            ..Camera::new(90.0, 92.0, 79.5, 59.5, 160, 120).unwrap()
        }
    }

    #[test]
    fn a_smooth_raw_image_becomes_the_pinhole_image() {
        // The colour of the scene along a ray; the raw image has it at the distorted pixel.
        let color = |p: &Vec2| {
            [128.0 + 0.6 * (p.x - 80.0), 128.0 + 0.9 * (p.y - 60.0), 100.0].map(|v: f64| v.round() as u8)
        };
        let c = camera();
        let raw = RgbImage::from_fn(160, 120, |x, y| {
            c.undistort_point(&Vec2::new(x as f64, y as f64)).map_or([0; 3], |p| color(&p))
        });
        let flat = undistort_rgb(&raw, &c).unwrap();
        for (x, y) in [(80, 60), (40, 30), (120, 95), (60, 100)] {
            let expected = color(&Vec2::new(x as f64, y as f64));
            for k in 0..3 {
                assert!(
                    flat[(x, y)][k].abs_diff(expected[k]) <= 2,
                    "({x}, {y}) {:?} {expected:?}",
                    flat[(x, y)]
                );
            }
        }
        // The raw image really is distorted there.
        assert!(raw[(20, 15)][0].abs_diff(color(&Vec2::new(20.0, 15.0))[0]) > 2);
    }

    #[test]
    fn depth_is_taken_whole_and_never_mixed() {
        let raw = DepthImage::from_fn(160, 120, |x, _| if x < 80 { 1.0 } else { 2.0 });
        let flat = undistort_depth(&raw, &camera()).unwrap();
        assert!(flat.as_slice().iter().all(|&z| z == 0.0 || z == 1.0 || z == 2.0));
        assert_eq!((flat[(20, 60)], flat[(140, 60)]), (1.0, 2.0));
        let wrong = DepthImage::filled(10, 10, 1.0);
        assert!(matches!(undistort_depth(&wrong, &camera()), Err(CameraError::Resolution { .. })));
        let pinhole = camera().without_distortion();
        assert_eq!(undistort_depth(&raw, &pinhole).unwrap(), raw);
    }
}
