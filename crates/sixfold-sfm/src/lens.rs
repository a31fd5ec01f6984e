//! The parameters of a reconstruction's camera that can be refined: one focal length, the principal point, two radial coefficients.

use sixfold_geometry::nalgebra::Vector5;
use sixfold_geometry::{BrownConrady, Camera, Vec2, Vec3};

/// Prior standard deviations of a guess: the focal length (fraction of it), the principal point (fraction of the longer side), and
/// both radial coefficients. Chosen by hand; not swept.
const BELIEF: [f64; 4] = [0.3, 0.02, 0.2, 0.3];

/// A pixel with its derivatives by the point (2x3, by rows) and by the parameters (2x5).
type Slopes = (Vec2, [[f64; 3]; 2], [[f64; 5]; 2]);

/// `f cx cy k1 k2`; the ratio of the two focal lengths stays.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Lens {
    pub numbers: Vector5<f64>,
    pub ratio: f64,
    pub size: (usize, usize),
}

impl Lens {
    /// The parameters of a camera. Distortion beyond two radial coefficients is dropped: the pixels have been corrected for it.
    pub fn of(camera: &Camera) -> Lens {
        let d = camera.distortion.unwrap_or_default();
        Lens {
            numbers: Vector5::new(camera.fx, camera.cx, camera.cy, d.k1, d.k2),
            ratio: camera.fy / camera.fx,
            size: (camera.width, camera.height),
        }
    }

    pub fn camera(&self) -> Camera {
        let [f, cx, cy, k1, k2] = [0, 1, 2, 3, 4].map(|i: usize| self.numbers[i]);
        let distortion =
            (k1 != 0.0 || k2 != 0.0).then_some(BrownConrady { k1, k2, p1: 0.0, p2: 0.0, k3: 0.0 });
        Camera { fx: f, fy: f * self.ratio, cx, cy, width: self.size.0, height: self.size.1, distortion }
    }

    pub fn with_focal_length(&self, f: f64) -> Lens {
        let mut other = *self;
        other.numbers[0] = f;
        other
    }

    /// Prior standard deviations of the parameters.
    pub fn belief(&self) -> Vector5<f64> {
        let side = self.size.0.max(self.size.1) as f64;
        let [f, centre, k1, k2] = BELIEF;
        Vector5::new(f * self.numbers[0], centre * side, centre * side, k1, k2)
    }

    /// The point on the plane `z = 1` of a pixel's ray.
    pub fn ray(&self, pixel: &Vec2) -> Option<Vec2> {
        let [f, cx, cy, k1, k2] = [0, 1, 2, 3, 4].map(|i: usize| self.numbers[i]);
        let p = Vec2::new((pixel.x - cx) / f, (pixel.y - cy) / (f * self.ratio));
        if k1 == 0.0 && k2 == 0.0 {
            return Some(p);
        }
        BrownConrady { k1, k2, p1: 0.0, p2: 0.0, k3: 0.0 }.undistort(&p)
    }

    /// The pixel of a point in the camera's frame.
    pub fn project(&self, p: &Vec3) -> Option<Vec2> {
        if !(p.z > 1e-9) {
            return None;
        }
        let [f, cx, cy, k1, k2] = [0, 1, 2, 3, 4].map(|i: usize| self.numbers[i]);
        let (x, y) = (p.x / p.z, p.y / p.z);
        let square = x * x + y * y;
        let scale = f * (1.0 + square * (k1 + square * k2));
        Some(Vec2::new(scale * x + cx, scale * self.ratio * y + cy))
    }

    /// The same with its derivatives.
    pub fn project_with_slopes(&self, p: &Vec3) -> Option<Slopes> {
        let pixel = self.project(p)?;
        let [f, _, _, k1, k2] = [0, 1, 2, 3, 4].map(|i: usize| self.numbers[i]);
        let (x, y) = (p.x / p.z, p.y / p.z);
        let square = x * x + y * y;
        let radial = 1.0 + square * (k1 + square * k2);
        // Twice the derivative of the radial factor by the squared radius.
        let slope = 2.0 * (k1 + 2.0 * k2 * square);
        let across = [[radial + x * x * slope, x * y * slope], [x * y * slope, radial + y * y * slope]];
        let focal = [f, f * self.ratio];
        let by_point = [0, 1].map(|i: usize| {
            let [a, b] = across[i].map(|v| v * focal[i] / p.z);
            [a, b, -(a * x + b * y)]
        });
        let by_numbers = [
            [radial * x, 1.0, 0.0, f * x * square, f * x * square * square],
            [radial * y * self.ratio, 0.0, 1.0, focal[1] * y * square, focal[1] * y * square * square],
        ];
        Some((pixel, by_point, by_numbers))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slopes_are_those_of_differences_and_rays_lead_back() {
        let lens =
            Lens { numbers: Vector5::new(900.0, 510.0, 380.0, 0.08, -0.1), ratio: 0.99, size: (1024, 768) };
        let p = Vec3::new(0.2, -0.15, 0.6);
        let (pixel, by_point, by_numbers) = lens.project_with_slopes(&p).unwrap();
        assert!((lens.ray(&pixel).unwrap() - (p / p.z).xy()).norm() < 1e-10);
        let known = lens.camera().distort_point(&lens.camera().project(&p).unwrap());
        assert!((known - pixel).norm() < 1e-9);
        for k in 0..3 {
            let mut step = Vec3::zeros();
            step[k] = 1e-6;
            let slope = (lens.project(&(p + step)).unwrap() - lens.project(&(p - step)).unwrap()) / 2e-6;
            assert!((0..2).all(|i: usize| (slope[i] - by_point[i][k]).abs() < 1e-4), "{k}");
        }
        for (k, by_number) in [0, 1, 2, 3, 4].map(|k: usize| (k, by_numbers.map(|row| row[k]))) {
            let at = |sign: f64| {
                let mut other = lens;
                other.numbers[k] += sign * 1e-5;
                other.project(&p).unwrap()
            };
            let slope = (at(1.0) - at(-1.0)) / 2e-5;
            assert!((0..2).all(|i: usize| (slope[i] - by_number[i]).abs() < 1e-4), "{k}");
        }
    }
}
