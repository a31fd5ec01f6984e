//! Square views of a region: a camera at the same position, rotated so that the centre of a box is at the centre of its image. The
//! content of a crop then does not depend on the object's position in the image.

use sixfold_geometry::nalgebra::{Unit, UnitQuaternion};
use sixfold_geometry::{Camera, Pose, Rect, RgbImage, Vec2, Vec3};
use sixfold_synth::augment::Patch;

/// Maximum number of samples along each axis that a pixel of a crop averages if the image is reduced.
const MAX_TAPS: usize = 6;

/// A pinhole camera aimed at a box.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Crop {
    /// The square camera.
    pub camera: Camera,
    /// From the frame of the image's camera to that of the crop's; both have the same position.
    pub crop_from_camera: UnitQuaternion<f64>,
}

impl Crop {
    /// A crop of `side` pixels that shows a box enlarged `factor` times about its centre; `None` if the box has no area or is
    /// outside any image.
    pub(crate) fn of_box(camera: &Camera, bbox: &Rect, factor: f64, side: usize) -> Option<Crop> {
        if !(bbox.width > 0.0 && bbox.height > 0.0) {
            return None;
        }
        let box_centre = Vec2::new(bbox.x + 0.5 * bbox.width, bbox.y + 0.5 * bbox.height);
        let ray = |x: f64, y: f64| camera.unproject(&Vec2::new(x, y), 1.0);
        let to = Unit::try_new(ray(box_centre.x, box_centre.y), 1e-9)?;
        let crop_from_camera = UnitQuaternion::rotation_between_axis(&to, &Vec3::z_axis())?;
        let mut extent = 0.0f64;
        for (x, y) in [
            (bbox.x, box_centre.y),
            (bbox.x + bbox.width, box_centre.y),
            (box_centre.x, bbox.y),
            (box_centre.x, bbox.y + bbox.height),
        ] {
            let p = crop_from_camera * ray(x, y);
            if p.z <= 0.0 {
                return None;
            }
            extent = extent.max((p.x / p.z).abs()).max((p.y / p.z).abs());
        }
        let focal = 0.5 * side as f64 / (factor * extent);
        let centre = 0.5 * (side as f64 - 1.0);
        let camera = Camera::new(focal, focal, centre, centre, side, side).ok()?;
        Some(Crop { camera, crop_from_camera })
    }

    /// Converts a pose from the image's frame to the crop's.
    pub(crate) fn to_crop(self, camera_from_object: &Pose) -> Pose {
        Pose::new(self.crop_from_camera, Vec3::zeros()) * *camera_from_object
    }

    /// Converts a pose from the crop's frame to the image's.
    pub(crate) fn to_camera(self, crop_from_object: &Pose) -> Pose {
        Pose::new(self.crop_from_camera.inverse(), Vec3::zeros()) * *crop_from_object
    }

    /// The crop's pixels of an image of `camera` (without lens distortion): bilinear, an average over several samples if the image
    /// is reduced; `outside` beyond its border.
    pub(crate) fn cut(&self, image: &RgbImage, camera: &Camera, outside: [f32; 3]) -> Patch {
        let side = self.camera.width;
        let mut patch = Patch::filled(side, side, outside);
        let (width, height) = image.size();
        if width < 2 || height < 2 {
            return patch;
        }
        let rotation = self.crop_from_camera.inverse().to_rotation_matrix();
        let inverse = 1.0 / self.camera.fx;
        let at = |x: f64, y: f64| -> Option<Vec2> {
            let ray = Vec3::new((x - self.camera.cx) * inverse, (y - self.camera.cy) * inverse, 1.0);
            camera.project(&(rotation * ray))
        };
        let reduced = camera.fx * inverse;
        let taps = (reduced.ceil() as usize).clamp(1, MAX_TAPS);
        let area = side * side;
        let source = image.as_slice();
        let weight = 1.0 / (255.0 * (taps * taps) as f32);
        for y in 0..side {
            for x in 0..side {
                let mut sum = [0.0f32; 3];
                let mut all = true;
                for k in 0..taps * taps {
                    let part = |k: usize| (k as f64 + 0.5) / taps as f64 - 0.5;
                    let place = at(x as f64 + part(k % taps), y as f64 + part(k / taps));
                    let inside = place.filter(|p| {
                        p.x >= -0.5 && p.y >= -0.5 && p.x < width as f64 - 0.5 && p.y < height as f64 - 0.5
                    });
                    let Some(p) = inside else {
                        all = false;
                        break;
                    };
                    let (px, py) = (p.x.clamp(0.0, (width - 1) as f64), p.y.clamp(0.0, (height - 1) as f64));
                    let (x0, y0) = ((px as usize).min(width - 2), (py as usize).min(height - 2));
                    let (fx, fy) = ((px - x0 as f64) as f32, (py - y0 as f64) as f32);
                    let first = y0 * width + x0;
                    for (c, sum) in sum.iter_mut().enumerate() {
                        let v = |i: usize| f32::from(source[i][c]);
                        *sum += (1.0 - fy) * ((1.0 - fx) * v(first) + fx * v(first + 1))
                            + fy * ((1.0 - fx) * v(first + width) + fx * v(first + width + 1));
                    }
                }
                if all {
                    for (c, sum) in sum.into_iter().enumerate() {
                        patch.data[c * area + y * side + x] = sum * weight;
                    }
                }
            }
        }
        patch
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        Camera::new(570.0, 572.0, 325.0, 242.0, 640, 480).unwrap()
    }

    #[test]
    fn the_box_fills_its_part_of_the_crop_wherever_it_is() {
        let camera = camera();
        for bbox in [
            Rect { x: 300.0, y: 200.0, width: 80.0, height: 40.0 },
            Rect { x: 2.0, y: 3.0, width: 60.0, height: 90.0 },
            Rect { x: 560.0, y: 400.0, width: 79.0, height: 70.0 },
        ] {
            let crop = Crop::of_box(&camera, &bbox, 1.25, 160).unwrap();
            let edges = [(0.0, 0.5), (1.0, 0.5), (0.5, 0.0), (0.5, 1.0)].map(|(u, v)| {
                let pixel = Vec2::new(bbox.x + u * bbox.width, bbox.y + v * bbox.height);
                let seen =
                    crop.camera.project(&(crop.crop_from_camera * camera.unproject(&pixel, 1.0))).unwrap();
                (seen - Vec2::repeat(79.5)).amax()
            });
            let largest = edges.into_iter().fold(0.0, f64::max);
            assert!((largest - 64.0).abs() < 1e-6, "{bbox:?}: {largest}");
        }
        let empty = Rect { x: 10.0, y: 10.0, width: 0.0, height: 0.0 };
        assert!(Crop::of_box(&camera, &empty, 1.2, 160).is_none());
    }

    #[test]
    fn a_pose_and_its_pixels_go_to_the_crop_and_back() {
        let camera = camera();
        let bbox = Rect { x: 500.0, y: 50.0, width: 100.0, height: 80.0 };
        let crop = Crop::of_box(&camera, &bbox, 1.2, 160).unwrap();
        let pose = Pose::exp(&[0.2, -0.1, 0.9, 0.4, -0.3, 0.8].into());
        let back = crop.to_camera(&crop.to_crop(&pose));
        assert!(back.distance_to(&pose) < 1e-12 && back.rotation_angle_to(&pose) < 1e-6);
        // An image whose red encodes the column and whose green encodes the row.
        let image = RgbImage::from_fn(640, 480, |x, y| [(x / 4) as u8, (y / 4) as u8, 0]);
        let patch = crop.cut(&image, &camera, [0.0; 3]);
        let area = 160 * 160;
        for (x, y) in [(20, 30), (80, 80), (130, 110)] {
            let ray = crop.camera.unproject(&Vec2::new(x as f64, y as f64), 1.0);
            let pixel = camera.project(&(crop.crop_from_camera.inverse() * ray)).unwrap();
            let seen =
                [patch.data[y * 160 + x], patch.data[area + y * 160 + x]].map(|v| f64::from(v) * 255.0 * 4.0);
            assert!((seen[0] - pixel.x).abs() < 4.0 && (seen[1] - pixel.y).abs() < 4.0, "{seen:?} {pixel:?}");
        }
    }

    #[test]
    fn pixels_outside_the_image_are_filled() {
        let camera = camera();
        let image = RgbImage::filled(640, 480, [255, 255, 255]);
        let bbox = Rect { x: -40.0, y: 200.0, width: 80.0, height: 80.0 };
        let patch = Crop::of_box(&camera, &bbox, 1.2, 64).unwrap().cut(&image, &camera, [0.25; 3]);
        assert_eq!((patch.data[32 * 64], patch.data[32 * 64 + 63]), (0.25, 1.0));
    }
}
