//! The views of an object in a training set, and the composition of a view with a background (K. Park, dissertation, section 4.3).

use std::f64::consts::{FRAC_PI_4, TAU};

use sixfold_data::PosedImage;
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::random::{stream, uniform};
use sixfold_geometry::{Camera, Mask, Mat3, Pose, RgbImage, Vec3};
use sixfold_mesh::Mesh;
use sixfold_synth::augment::{Coverage, Patch};

use crate::synthesis::NewView;
use crate::window::object_window;

/// Side of an image in units of the object's box in the image.
const ROOM: f64 = 1.6;

/// A grid of views over a part of the sphere around an object.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewGrid {
    /// Step between views in azimuth and elevation, degrees.
    pub step: f64,
    /// Lowest and highest elevation above the object's xy plane, degrees.
    pub elevation: [f64; 2],
    /// Images of each view, each with its own in-plane rotation (up to 45 degrees).
    pub rotations: usize,
    /// Side of the images, pixels.
    pub size: usize,
    /// Seed of rotations and distances.
    pub seed: u64,
}

/// Direction of a view, radians, and the number of its in-plane rotation.
struct Aim {
    azimuth: f64,
    elevation: f64,
    turn: usize,
}

impl ViewGrid {
    /// Camera and camera_from_object of every image of object number `object`, at distances of its photographs; `None` for an image
    /// that would not show it.
    pub fn placed(
        &self,
        mesh: &Mesh,
        photographs: &[&PosedImage],
        object: u32,
    ) -> Vec<Option<(Camera, Pose)>> {
        let aims = self.aims();
        (0..).zip(&aims).map(|(number, aim)| self.place(mesh, photographs, object, aim, number)).collect()
    }

    /// Number of images of an object.
    pub fn count(&self) -> usize {
        self.aims().len()
    }

    fn aims(&self) -> Vec<Aim> {
        let step = self.step.to_radians();
        let (low, high) = (self.elevation[0].to_radians(), self.elevation[1].to_radians());
        let around = (TAU / step).round().max(1.0) as usize;
        let up = ((high - low) / step + 1e-9).floor() as usize + 1;
        let mut aims = Vec::with_capacity(around * up * self.rotations);
        for e in 0..up {
            for z in 0..around {
                for turn in 0..self.rotations {
                    let (azimuth, elevation) = (TAU * z as f64 / around as f64, low + e as f64 * step);
                    aims.push(Aim { azimuth, elevation, turn });
                }
            }
        }
        aims
    }

    /// Camera and pose of image `number`.
    fn place(
        &self,
        mesh: &Mesh,
        photographs: &[&PosedImage],
        object: u32,
        aim: &Aim,
        number: u32,
    ) -> Option<(Camera, Pose)> {
        let (low, high) = mesh.bounding_box();
        let centre = (low + high) * 0.5;
        let mut random = stream(self.seed ^ u64::from(object) << 40, u64::from(number));
        let distances = photographs.iter().map(|p| p.camera_from_object().translation().norm());
        let range = distances.fold([f64::INFINITY, 0.0f64], |[low, high], d| [low.min(d), high.max(d)]);
        let distance = f64::from(uniform(&mut random, [range[0] as f32, range[1] as f32]));
        // The in-plane rotations of one view are spread evenly between -45 and 45 degrees; a single one is random in this range.
        let roll = if self.rotations == 1 {
            f64::from(uniform(&mut random, [-1.0, 1.0])) * FRAC_PI_4
        } else {
            (2.0 * aim.turn as f64 / (self.rotations - 1) as f64 - 1.0) * FRAC_PI_4
        };
        let pose = looking_at(&centre, aim, distance, roll);
        let camera = *photographs.first()?.camera();
        Some((object_window(&camera, mesh, &pose, ROOM)?.camera(&camera, self.size), pose))
    }
}

/// The pose for a camera aimed at `centre` from a direction in the object's frame, upright except for the roll.
fn looking_at(centre: &Vec3, aim: &Aim, distance: f64, roll: f64) -> Pose {
    let (sa, ca) = aim.azimuth.sin_cos();
    let (se, ce) = aim.elevation.sin_cos();
    let back = Vec3::new(ce * ca, ce * sa, se);
    let z = -back;
    // For a view straight from above, the azimuth defines the up direction.
    let up = if se.abs() > 0.999 { Vec3::new(-ca, -sa, 0.0) * se.signum() } else { Vec3::z() };
    let x = z.cross(&up).normalize();
    let rotation = Mat3::from_rows(&[x.transpose(), z.cross(&x).transpose(), z.transpose()]);
    let upright = Pose::from_parts(&rotation, -rotation * (centre + back * distance)).unwrap_or_default();
    Pose::new(UnitQuaternion::from_axis_angle(&Vec3::z_axis(), roll), Vec3::zeros()) * upright
}

/// A view with a soft border composed with a background of its size.
pub(crate) fn over_background(view: &NewView, mut background: Patch) -> RgbImage {
    let (width, height) = view.mask.size();
    let mut soft = Coverage::from_fn(width, height, |x, y| f32::from(u8::from(view.mask[(x, y)])));
    soft.blur(0.7);
    background.blend(&spread(&view.patch, &view.mask), &soft);
    background.to_rgb()
}

/// Colours of the object extended a few pixels beyond its border, so that a soft border does not mix with black.
fn spread(patch: &Patch, mask: &Mask) -> Patch {
    let (width, height) = mask.size();
    let area = width * height;
    let mut patch = patch.clone();
    let mut known = mask.clone();
    for _ in 0..3 {
        let before = known.clone();
        for y in 1..height.saturating_sub(1) {
            for x in 1..width.saturating_sub(1) {
                if before[(x, y)] {
                    continue;
                }
                let near = [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)];
                let near: Vec<_> = near.into_iter().filter(|p| before[*p]).collect();
                if near.is_empty() {
                    continue;
                }
                for c in 0..3 {
                    let sum: f32 = near.iter().map(|(x, y)| patch.data[c * area + y * width + x]).sum();
                    patch.data[c * area + y * width + x] = sum / near.len() as f32;
                }
                known[(x, y)] = true;
            }
        }
    }
    patch
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_is_directed_at_the_centre_from_its_direction() {
        let centre = Vec3::new(0.01, -0.02, 0.03);
        for (azimuth, elevation) in [(0.0, 0.0), (1.0, 0.5), (4.0, std::f64::consts::FRAC_PI_2), (2.0, -0.4)]
        {
            let aim = Aim { azimuth, elevation, turn: 0 };
            let pose = looking_at(&centre, &aim, 0.7, 0.3);
            assert!((pose.transform_point(&centre) - Vec3::new(0.0, 0.0, 0.7)).norm() < 1e-9);
            let camera = pose.inverse().translation() - centre;
            assert!((camera.z / camera.norm() - elevation.sin()).abs() < 1e-9);
            if elevation.cos() > 1e-3 {
                assert!(
                    (camera.y.atan2(camera.x) - azimuth)
                        .rem_euclid(TAU)
                        .min((azimuth - camera.y.atan2(camera.x)).rem_euclid(TAU))
                        < 1e-9
                );
            }
        }
        // Upright: the object's z axis points up in the image (before the roll).
        let pose = looking_at(&centre, &Aim { azimuth: 0.4, elevation: 0.6, turn: 0 }, 0.7, 0.0);
        let up = pose.transform_direction(&Vec3::z());
        assert!(up.x.abs() < 1e-9 && up.y < 0.0);
    }
}
