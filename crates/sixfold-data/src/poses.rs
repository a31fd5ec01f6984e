//! Poses of rendered objects: near those of posed images, or anywhere on a part of the view sphere.

use rand::RngExt;
use sixfold_geometry::nalgebra::{Rotation3, UnitQuaternion};
use sixfold_geometry::random::{Random, uniform};
use sixfold_geometry::{Camera, Mat3, Pose, Vec2, Vec3};

use crate::posed_image::PosedImage;

/// The default camera of renders.
pub const DEFAULT_CAMERA: Camera =
    Camera { fx: 600.0, fy: 600.0, cx: 319.5, cy: 239.5, width: 640, height: 480, distortion: None };

/// How poses of renders vary. The defaults are for objects on a table, seen from above.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseVariation {
    /// Fraction of poses near one of a posed image, 0..1; the others view the object from anywhere within
    /// `elevation`.
    pub near_fraction: f32,
    /// Largest rotation about each axis away from a posed image's pose, radians.
    pub noise: f64,
    /// Largest rotation in the image plane to either side near a posed image, radians.
    pub rotation: f32,
    /// Elevation of the camera over the object's xy plane, radians: `[0, pi/2]` is the upper hemisphere.
    pub elevation: [f32; 2],
    /// Largest rotation about the view axis from upright for poses that are not near a posed image's, radians.
    pub view_rotation: f32,
}

impl Default for PoseVariation {
    fn default() -> Self {
        PoseVariation {
            near_fraction: 0.5,
            noise: 25f64.to_radians(),
            rotation: std::f32::consts::FRAC_PI_4,
            elevation: [0.0, std::f32::consts::FRAC_PI_2],
            view_rotation: std::f32::consts::PI,
        }
    }
}

/// Distances at which images show their objects, a tenth nearer to a tenth farther, metres; `None` without images.
pub fn distances<'a>(images: impl IntoIterator<Item = &'a PosedImage>) -> Option<[f64; 2]> {
    let norms = images.into_iter().map(|image| image.camera_from_object().translation().norm());
    let (low, high) = norms.fold((f64::INFINITY, 0.0f64), |(low, high), d| (low.min(d), high.max(d)));
    (low <= high).then_some([0.9 * low, 1.1 * high])
}

/// Distances without images: 4 to 12 diameters.
pub fn default_distances(diameter: f64) -> [f64; 2] {
    [4.0 * diameter, 12.0 * diameter]
}

/// The range from which poses are sampled.
pub struct PoseRange<'a> {
    /// The camera.
    pub camera: &'a Camera,
    /// Centre of the object's box in its own frame, metres.
    pub centre: Vec3,
    /// Distances of that centre from the camera, metres.
    pub distance: [f64; 2],
    /// Poses of posed images; may be empty.
    pub real: &'a [Pose],
}

impl PoseRange<'_> {
    /// Samples a pose: near one of the posed images or anywhere, according to the variation.
    pub fn draw(&self, variation: &PoseVariation, random: &mut Random) -> Pose {
        let near = !self.real.is_empty() && random.random::<f32>() < variation.near_fraction;
        let facing = if near {
            let pose = &self.real[random.random_range(0..self.real.len())];
            let noise = Vec3::from_fn(|_, _| variation.noise * (2.0 * random.random::<f64>() - 1.0));
            let turn = f64::from(uniform(random, [-variation.rotation, variation.rotation]));
            // The pose when the camera points at the object.
            let ray = pose.transform_point(&self.centre);
            let view = towards(&ray).inverse() * pose.rotation();
            turn_in_plane(turn) * UnitQuaternion::from_scaled_axis(noise) * view
        } else {
            anywhere(variation, random)
        };
        // Any pixel except near the border; the object is viewed along its ray.
        let pixel = Vec2::new(
            self.camera.width as f64 * (0.1 + 0.8 * random.random::<f64>()),
            self.camera.height as f64 * (0.1 + 0.8 * random.random::<f64>()),
        );
        let ray = self.camera.unproject(&pixel, 1.0).normalize();
        let distance =
            self.distance[0] + (self.distance[1] - self.distance[0]).max(0.0) * random.random::<f64>();
        let rotation = towards(&ray) * facing;
        Pose::new(rotation, ray * distance - rotation * self.centre)
    }
}

fn anywhere(variation: &PoseVariation, random: &mut Random) -> UnitQuaternion<f64> {
    // Uniform on the sphere: the sine of the elevation is uniform.
    let sines = variation.elevation.map(f32::sin);
    let z = f64::from(uniform(random, sines)).clamp(-1.0, 1.0);
    let azimuth = std::f64::consts::TAU * random.random::<f64>();
    let r = (1.0 - z * z).max(0.0).sqrt();
    let direction = Vec3::new(r * azimuth.cos(), r * azimuth.sin(), z);
    let turn = f64::from(uniform(random, [-variation.view_rotation, variation.view_rotation]));
    turn_in_plane(turn) * looking_from(&direction, azimuth)
}

fn turn_in_plane(angle: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(&Vec3::z_axis(), angle)
}

/// The smallest rotation that takes the camera's axis to `ray`.
fn towards(ray: &Vec3) -> UnitQuaternion<f64> {
    UnitQuaternion::rotation_between(&Vec3::z(), ray).unwrap_or_else(UnitQuaternion::identity)
}

/// Camera from object for a camera that looks at the object from `direction` (unit, object frame), its image upright:
/// the object's z axis points up.
fn looking_from(direction: &Vec3, azimuth: f64) -> UnitQuaternion<f64> {
    let z = -direction;
    // From straight above, the image's x axis still follows the azimuth.
    let x = Vec3::new(-azimuth.sin(), azimuth.cos(), 0.0);
    let y = z.cross(&x);
    let rows = Mat3::from_rows(&[x.transpose(), y.transpose(), z.transpose()]);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rows))
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::random::stream;

    #[test]
    fn the_camera_looks_from_above_and_upright() {
        let camera = Camera::new(600.0, 600.0, 320.0, 240.0, 640, 480).unwrap();
        let centre = Vec3::new(0.01, 0.02, 0.03);
        let range = PoseRange { camera: &camera, centre, distance: [0.5, 0.9], real: &[] };
        let options = PoseVariation { view_rotation: 0.0, elevation: [0.3, 1.2], ..PoseVariation::default() };
        for number in 0..200 {
            let pose = range.draw(&options, &mut stream(4, number));
            let seen = pose.transform_point(&centre);
            assert!((0.5..=0.9).contains(&seen.norm()));
            let pixel = camera.project(&seen).unwrap();
            assert!((64.0..=576.0).contains(&pixel.x) && (48.0..=432.0).contains(&pixel.y));
            let from = pose.inverse().translation() - centre;
            let elevation = (from.z / from.norm()).asin();
            assert!((0.299..=1.201).contains(&elevation), "{elevation}");
            // Up in the object's frame is up in the image.
            let up = camera.project(&pose.transform_point(&(centre + Vec3::z() * 0.01))).unwrap();
            assert!(up.y < pixel.y);
        }
    }

    #[test]
    fn near_a_photograph_the_view_is_like_it() {
        let camera = Camera::new(600.0, 600.0, 320.0, 240.0, 640, 480).unwrap();
        let real = [Pose::exp(&[0.1, 0.1, 0.8, 2.0, 0.1, 0.3].into())];
        let range = PoseRange { camera: &camera, centre: Vec3::zeros(), distance: [0.5, 0.9], real: &real };
        let options =
            PoseVariation { near_fraction: 1.0, rotation: 0.0, noise: 0.2, ..PoseVariation::default() };
        let view = |p: &Pose| p.inverse().translation().normalize();
        for number in 0..100 {
            let pose = range.draw(&options, &mut stream(4, number));
            assert!(view(&pose).angle(&view(&real[0])) < 0.2 * 3f64.sqrt() + 1e-6);
        }
    }
}
