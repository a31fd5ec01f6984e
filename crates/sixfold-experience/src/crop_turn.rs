//! In-plane copies: a crop as the camera would record it after a rotation about its optical axis (dissertation, section 6.3.1). The
//! result is exact, because a rotation about the optical axis does not move the viewpoint.

use sixfold_geometry::nalgebra::{UnitQuaternion, Vector3};
use sixfold_geometry::{Camera, Plane, Pose, Vec2, Vec3};

use crate::Crop;

/// The camera's rotation: takes points of the old camera's frame to the rotated one's.
pub fn turn(angle: f64) -> Pose {
    Pose::new(UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle), Vec3::zeros())
}

impl Crop {
    /// The crop rotated about its centre by `angle` radians (positive: from x to y), with points, normals and VD-NOC of the
    /// rotated camera. `trim` as in [`crate::CropOptions`].
    pub fn rotated(&self, angle: f64, trim: f64) -> Crop {
        let pose = turn(angle);
        let centre = 0.5 * (self.side as f64 - 1.0);
        let (sin, cos) = angle.sin_cos();
        let rotate = |p: Vec2| Vec2::new(cos * p.x - sin * p.y, sin * p.x + cos * p.y);
        let back = |p: Vec2| Vec2::new(cos * p.x + sin * p.y, -sin * p.x + cos * p.y);
        // The principal point rotates about the crop's centre. Both focal lengths are equal except for sensors whose pixels are not
        // square.
        let principal = rotate(Vec2::new(self.camera.cx - centre, self.camera.cy - centre));
        let camera = Camera { cx: principal.x + centre, cy: principal.y + centre, ..self.camera };
        let total = self.side * self.side;
        let mut out = Crop {
            side: self.side,
            camera,
            mask: vec![false; total],
            source: vec![0; total],
            normals: vec![[0.0; 3]; total],
            points: vec![[0.0; 3]; total],
            vd_noc: vec![[0.0; 3]; total],
            extent: self.extent,
            table: self.table.map(|t| Plane { normal: pose.transform_direction(&t.normal), ..t }),
        };
        let moved = |v: [f32; 3]| {
            let r = pose.transform_direction(&Vec3::from_fn(|k, _| f64::from(v[k])));
            [r.x as f32, r.y as f32, r.z as f32]
        };
        let mut seen = vec![];
        for i in 0..total {
            let here = Vec2::new((i % self.side) as f64 - centre, (i / self.side) as f64 - centre);
            let there = back(here);
            let (x, y) = ((there.x + centre).round(), (there.y + centre).round());
            if x < 0.0 || y < 0.0 || x >= self.side as f64 || y >= self.side as f64 {
                continue;
            }
            let j = y as usize * self.side + x as usize;
            if self.mask[j] {
                out.mask[i] = true;
                out.source[i] = j as u32;
                out.normals[i] = moved(self.normals[j]);
                out.points[i] = moved(self.points[j]);
                seen.push(pose.transform_point(&self.point(j)));
            }
        }
        out.set_extent(&seen, trim);
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::CropOptions;
    use sixfold_geometry::{Image, Mask};

    #[test]
    fn a_rotation_by_90_degrees_moves_points_to_their_projections() {
        let camera = Camera::new(575.0, 575.0, 319.5, 239.5, 640, 480).unwrap();
        let inside = |x: usize, y: usize| (380..480).contains(&x) && (260..300).contains(&y);
        let depth = Image::from_fn(640, 480, |x, y| if inside(x, y) { 0.7 + 0.0004 * x as f32 } else { 0.0 });
        let mask = Mask::from_fn(640, 480, inside);
        let crop = Crop::new(&depth, &camera, &mask, &CropOptions::compact()).unwrap();
        for angle in [std::f64::consts::FRAC_PI_2, 0.7] {
            let rotated = crop.rotated(angle, 0.0);
            let count = rotated.pixels().count() as f64 / crop.pixels().count() as f64;
            assert!((count - 1.0).abs() < 0.05, "{count}");
            for i in rotated.pixels() {
                let projected = rotated.camera.project(&rotated.point(i)).unwrap();
                let pixel = Vec2::new((i % 96) as f64, (i / 96) as f64);
                assert!((projected - pixel).norm() < 1.6, "{projected} {pixel}");
            }
            // A rotation preserves depth.
            let far = |c: &Crop| c.pixels().map(|i| c.point(i).z).fold(0.0, f64::max);
            assert!((far(&rotated) - far(&crop)).abs() < 1e-3);
        }
    }
}
