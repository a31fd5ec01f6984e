//! The window of a training crop, and photographs rotated about their principal point.
//!
//! A rotation of the image about the principal point by `R_z` is exactly a rotation of the scene about the camera's axis: the
//! photograph at pose `P` becomes that at `R_z P` (for `fx != fy` with a small shear, which is kept). Targets are therefore
//! rendered at `R_z P` with the window's camera, and only colours are interpolated.

use rand::RngExt;
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::random::{Random, uniform};
use sixfold_geometry::{Camera, Pose, Vec2, Vec3};
use sixfold_synth::augment::{Coverage, Window};

use super::options::SampleOptions;

/// Smallest and largest corner of a set of points in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Extent {
    low: Vec2,
    high: Vec2,
}

impl Extent {
    pub(crate) fn of(points: impl IntoIterator<Item = Vec2>) -> Option<Extent> {
        let mut points = points.into_iter();
        let first = points.next()?;
        let (low, high) = points.fold((first, first), |(low, high), p| (low.inf(&p), high.sup(&p)));
        Some(Extent { low, high })
    }

    pub(crate) fn centre(&self) -> Vec2 {
        (self.low + self.high) * 0.5
    }

    pub(crate) fn longest(&self) -> f64 {
        (self.high - self.low).max()
    }

    /// The box without a part at one of its sides, and the border of that part.
    pub(super) fn cut(&self, options: &SampleOptions, random: &mut Random) -> (Extent, Cut) {
        let axis = random.random_range(0..2usize);
        let share = f64::from(uniform(random, options.cut));
        let mut rest = *self;
        let mut outwards = Vec2::zeros();
        let mut point = self.centre();
        if random.random::<bool>() {
            rest.high[axis] -= share * (self.high[axis] - self.low[axis]);
            (outwards[axis], point[axis]) = (1.0, rest.high[axis]);
        } else {
            rest.low[axis] += share * (self.high[axis] - self.low[axis]);
            (outwards[axis], point[axis]) = (-1.0, rest.low[axis]);
        }
        let (s, c) = f64::from(uniform(random, [-0.4, 0.4])).sin_cos();
        let outwards = Vec2::new(c * outwards.x - s * outwards.y, s * outwards.x + c * outwards.y);
        (rest, Cut { point, outwards })
    }

    /// A degenerate box of one point.
    pub(crate) fn at(point: Vec2) -> Extent {
        Extent { low: point, high: point }
    }
}

/// The straight border of an occluder.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Cut {
    point: Vec2,
    outwards: Vec2,
}

impl Cut {
    /// The area beyond it in a crop.
    pub(crate) fn beyond(&self, window: &Window, size: usize) -> Coverage {
        let step = window.side / size as f64;
        let corner = window.centre - Vec2::repeat(0.5 * window.side - 0.5 * step);
        Coverage::from_fn(size, size, |x, y| {
            let pixel = corner + Vec2::new(x as f64, y as f64) * step;
            ((pixel - self.point).dot(&self.outwards) / step + 0.5).clamp(0.0, 1.0) as f32
        })
    }
}

/// A crop around a box, randomly shifted and scaled.
pub(super) fn window_around(extent: &Extent, options: &SampleOptions, random: &mut Random) -> Window {
    let mut symmetric = |reach: f64| reach * (2.0 * random.random::<f64>() - 1.0);
    let longest = extent.longest().max(2.0);
    let shift = Vec2::new(symmetric(options.centre_jitter), symmetric(options.centre_jitter)) * longest;
    let side = longest * options.crop_factor * (1.0 + symmetric(options.size_jitter));
    Window { centre: extent.centre() + shift, side }
}

/// The scene rotated about the camera's axis.
pub(super) fn rotated(pose: &Pose, turn: f64) -> Pose {
    Pose::new(UnitQuaternion::from_axis_angle(&Vec3::z_axis(), turn), Vec3::zeros()) * *pose
}

/// The position of a pixel of the photograph after its rotation about the principal point.
pub(super) fn rotated_pixel(camera: &Camera, pixel: &Vec2, turn: f64) -> Vec2 {
    let (s, c) = turn.sin_cos();
    let (x, y) = ((pixel.x - camera.cx) / camera.fx, (pixel.y - camera.cy) / camera.fy);
    Vec2::new(camera.cx + camera.fx * (c * x - s * y), camera.cy + camera.fy * (s * x + c * y))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crop_pixels_agree_with_the_rotated_scene() {
        let camera = Camera::new(572.4, 540.0, 325.3, 242.0, 640, 480).unwrap();
        let point = Vec3::new(0.11, -0.07, 0.9);
        let turn = 0.7;
        let window = Window { centre: Vec2::new(290.0, 310.0), side: 137.0 };
        let rotated_point = rotated(&Pose::from_translation(point), turn).translation();
        let in_crop = window.camera(&camera, 64).project(&rotated_point).unwrap();
        let [x, y] = window.map(&camera, 64, turn).apply(in_crop.x as f32, in_crop.y as f32);
        let expected = camera.project(&point).unwrap();
        assert!((Vec2::new(f64::from(x), f64::from(y)) - expected).norm() < 1e-3, "{x} {y} {expected}");
        let rotated_in_image = camera.project(&rotated_point).unwrap();
        assert!((rotated_pixel(&camera, &expected, turn) - rotated_in_image).norm() < 1e-9);
        // Half the resolution: the centre of a block of four pixels.
        let fine = window.camera(&camera, 128).project(&rotated_point).unwrap();
        assert!((((fine + Vec2::repeat(0.5)) * 0.5 - Vec2::repeat(0.5)) - in_crop).norm() < 1e-9);
    }
}
