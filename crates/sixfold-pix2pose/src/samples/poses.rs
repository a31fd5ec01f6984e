//! Poses of rendered objects: near those of photographs, or from anywhere on a part of the view sphere.

use rand::RngExt;
use sixfold_geometry::nalgebra::{Rotation3, UnitQuaternion};
use sixfold_geometry::random::{Random, uniform};
use sixfold_geometry::{Camera, Mat3, Pose, Vec2, Vec3};

use super::options::SampleOptions;

/// What poses are drawn from.
pub struct PoseRange<'a> {
    /// The camera.
    pub camera: &'a Camera,
    /// Centre of the object's box in its own frame, metres.
    pub centre: Vec3,
    /// Distances of that centre from the camera, metres.
    pub distance: [f64; 2],
    /// Poses of photographs, possibly none.
    pub real: &'a [Pose],
}

impl PoseRange<'_> {
    /// A pose: near one of the photographs or from anywhere, as the options say.
    pub fn draw(&self, options: &SampleOptions, random: &mut Random) -> Pose {
        let near = !self.real.is_empty() && random.random::<f32>() < options.near_real_share;
        let facing = if near {
            let pose = &self.real[random.random_range(0..self.real.len())];
            let noise = Vec3::from_fn(|_, _| options.pose_noise * (2.0 * random.random::<f64>() - 1.0));
            let turn = f64::from(uniform(random, [-options.rotation, options.rotation]));
            // As it looks when the camera points at it.
            let ray = pose.transform_point(&self.centre);
            let view = towards(&ray).inverse() * pose.rotation();
            turn_in_plane(turn) * UnitQuaternion::from_scaled_axis(noise) * view
        } else {
            self.anywhere(options, random)
        };
        // Anywhere in the image but its rim, seen along that ray.
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

    fn anywhere(&self, options: &SampleOptions, random: &mut Random) -> UnitQuaternion<f64> {
        // Uniform on the sphere: the sine of the elevation is uniform.
        let sines = options.elevation.map(f32::sin);
        let z = f64::from(uniform(random, sines)).clamp(-1.0, 1.0);
        let azimuth = std::f64::consts::TAU * random.random::<f64>();
        let r = (1.0 - z * z).max(0.0).sqrt();
        let direction = Vec3::new(r * azimuth.cos(), r * azimuth.sin(), z);
        let turn = f64::from(uniform(random, [-options.view_turn, options.view_turn]));
        turn_in_plane(turn) * looking_from(&direction, azimuth)
    }
}

fn turn_in_plane(angle: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(&Vec3::z_axis(), angle)
}

/// The smallest turn that brings the camera's axis to `ray`.
fn towards(ray: &Vec3) -> UnitQuaternion<f64> {
    UnitQuaternion::rotation_between(&Vec3::z(), ray).unwrap_or_else(UnitQuaternion::identity)
}

/// Camera from object for a camera that looks at the object from `direction` (unit, object frame), its image upright:
/// the object's z axis points up.
fn looking_from(direction: &Vec3, azimuth: f64) -> UnitQuaternion<f64> {
    let z = -direction;
    // Seen from right above, "right" still follows the azimuth.
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
        let options = SampleOptions { view_turn: 0.0, elevation: [0.3, 1.2], ..SampleOptions::default() };
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
        let options = SampleOptions {
            near_real_share: 1.0,
            rotation: 0.0,
            pose_noise: 0.2,
            ..SampleOptions::default()
        };
        let view = |p: &Pose| p.inverse().translation().normalize();
        for number in 0..100 {
            let pose = range.draw(&options, &mut stream(4, number));
            assert!(view(&pose).angle(&view(&real[0])) < 0.2 * 3f64.sqrt() + 1e-6);
        }
    }
}
