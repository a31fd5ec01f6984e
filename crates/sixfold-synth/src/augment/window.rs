//! The square window of a crop, and the map between crop pixels and photograph pixels.

use sixfold_geometry::{Camera, Vec2};

use super::patch::AffineMap;

/// A square part of the image plane, pixels; pixel centres at whole numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Window {
    /// Its centre.
    pub centre: Vec2,
    /// Its side.
    pub side: f64,
}

impl Window {
    /// The camera of the crop at `size x size` pixels.
    pub fn camera(&self, camera: &Camera, size: usize) -> Camera {
        let scale = size as f64 / self.side;
        let corner = self.centre - Vec2::repeat(0.5 * self.side);
        Camera {
            fx: camera.fx * scale,
            fy: camera.fy * scale,
            cx: (camera.cx - corner.x) * scale - 0.5,
            cy: (camera.cy - corner.y) * scale - 0.5,
            width: size,
            height: size,
            distortion: None,
        }
    }

    /// The map from pixels of the crop (`size x size`, of the photograph rotated by `turn` radians) to those of
    /// the photograph.
    pub fn map(&self, camera: &Camera, size: usize, turn: f64) -> AffineMap {
        let step = self.side / size as f64;
        let (s, c) = turn.sin_cos();
        let (across, down) = (s * camera.fx / camera.fy, s * camera.fy / camera.fx);
        // Offset of the rotated pixel of crop pixel (0, 0) from the principal point.
        let q = self.centre - Vec2::repeat(0.5 * self.side - 0.5 * step) - Vec2::new(camera.cx, camera.cy);
        AffineMap {
            x: [(c * step) as f32, (across * step) as f32, (camera.cx + c * q.x + across * q.y) as f32],
            y: [(-down * step) as f32, (c * step) as f32, (camera.cy - down * q.x + c * q.y) as f32],
        }
    }
}
