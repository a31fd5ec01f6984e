//! The input of the network: a region of a scene, or a template, as normals and depth on a grid of fixed metric size.
//!
//! Five planes: the normal in the region's frame (dissertation, section 5.2.2), the depth along the region's axis relative to its
//! centre as a fraction of half the patch, from -1 to 1, and whether the pixel was measured. Where it was not, all are zero.

use sixfold_align::DepthRegion;

use crate::roi::{Cell, Roi};
use crate::template::{SIDE, Template};

/// Planes of a patch.
pub(crate) const PLANES: usize = 5;
/// Side of the network's patch as a fraction of the object's diameter.
pub const REACH: f64 = 1.2;

/// A patch as planes, row by row: `5 x side x side`.
#[derive(Debug, Clone, PartialEq)]
pub struct Patch {
    /// Pixels along a side.
    pub side: usize,
    /// `5 x side x side` numbers.
    pub values: Vec<f32>,
}

impl Patch {
    /// A patch in which nothing was measured.
    pub fn empty(side: usize) -> Patch {
        Patch { side, values: vec![0.0; PLANES * side * side] }
    }

    /// The region around `roi`'s centre, `size` metres wide. Pixels (by their number in the image) for which `seen` is false count
    /// as not measured.
    pub fn of_scene(
        scene: &DepthRegion,
        roi: &Roi,
        size: f64,
        side: usize,
        seen: impl Fn(usize) -> bool,
    ) -> Patch {
        Patch::of_cells(&roi.cells_on_grid(scene, size, side, seen), size, side)
    }

    /// Cells of a region of `size` metres, as [`Roi::cells_on_grid`] returns them.
    pub fn of_cells(cells: &[Cell], size: f64, side: usize) -> Patch {
        let mut patch = Patch::empty(side);
        for (i, [depth, x, y, z]) in cells.iter().enumerate() {
            // Closer than anything can be: not measured.
            if *depth > -1e5 {
                patch.set(i, [*x, *y, *z], *depth, size);
            }
        }
        patch
    }

    fn set(&mut self, pixel: usize, normal: [f32; 3], depth: f32, size: f64) {
        let pixels = self.side * self.side;
        for (k, n) in normal.into_iter().enumerate() {
            self.values[k * pixels + pixel] = n;
        }
        self.values[3 * pixels + pixel] = (depth / (0.5 * size) as f32).clamp(-1.0, 1.0);
        self.values[4 * pixels + pixel] = 1.0;
    }
}

/// A template prepared for resampling as a patch at any rotation.
#[derive(Debug, Clone)]
pub struct TemplateSurface {
    /// Normal and relative depth (metres) of every pixel of the template that has both.
    pixels: Vec<Option<([f32; 3], f32)>>,
    /// Size of a pixel at the reference point, metres.
    pixel_size: f64,
}

impl TemplateSurface {
    /// Prepares a template whose patch is `template_size` metres wide.
    pub fn new(template: &Template, template_size: f64) -> TemplateSurface {
        let (cloud, places) = template.cloud(template_size);
        let mut pixels = vec![None; SIDE * SIDE];
        for (i, &[x, y]) in places.iter().enumerate() {
            let n = cloud.normals[i];
            pixels[y * SIDE + x] = Some(([n.x as f32, n.y as f32, n.z as f32], cloud.points[i].z as f32));
        }
        TemplateSurface { pixels, pixel_size: template_size / SIDE as f64 }
    }

    /// The template rotated by `turn` radians in the image plane (region from view), as a patch of `size` metres that shows the
    /// object alone.
    pub fn patch(&self, turn: f64, size: f64, side: usize) -> Patch {
        let mut patch = Patch::empty(side);
        let (sin, cos) = turn.sin_cos();
        let scale = size / side as f64 / self.pixel_size;
        let (own_centre, centre) = ((side as f64 - 1.0) / 2.0, (SIDE as f64 - 1.0) / 2.0);
        for i in 0..side * side {
            let (u, v) = (((i % side) as f64 - own_centre) * scale, ((i / side) as f64 - own_centre) * scale);
            let (x, y) = ((cos * u + sin * v + centre).round(), (-sin * u + cos * v + centre).round());
            if !(x >= 0.0 && y >= 0.0 && x < SIDE as f64 && y < SIDE as f64) {
                continue;
            }
            if let Some((n, depth)) = self.pixels[y as usize * SIDE + x as usize] {
                let (s, c) = (sin as f32, cos as f32);
                patch.set(i, [c * n[0] - s * n[1], s * n[0] + c * n[1], n[2]], depth, size);
            }
        }
        patch
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::camera_from_view;
    use crate::template::{ObjectTemplates, TemplateOptions};
    use sixfold_align::DepthOptions;
    use sixfold_geometry::{Camera, Vec3};
    use sixfold_mesh::Mesh;
    use sixfold_render::render_depth;

    /// A wedge, on which no two sides are alike.
    fn wedge() -> Mesh {
        let v = [
            [-0.05, -0.03, 0.0],
            [0.05, -0.03, 0.0],
            [-0.05, 0.04, 0.0],
            [0.05, 0.04, 0.0],
            [-0.05, -0.03, 0.06],
            [-0.05, 0.04, 0.03],
        ];
        let faces = [[0, 2, 3], [0, 3, 1], [0, 1, 4], [1, 3, 5], [1, 5, 4], [2, 5, 3], [0, 4, 5], [0, 5, 2]];
        Mesh::new(v.map(Vec3::from).to_vec(), faces.to_vec()).unwrap()
    }

    #[test]
    fn a_template_resembles_its_object_in_a_scene() {
        let mesh = wedge();
        let object = ObjectTemplates::from_mesh(&mesh, &TemplateOptions::default()).unwrap();
        let size = REACH * object.diameter;
        let template = &object.templates[60];
        let camera = Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap();
        let roi = Roi { centre: Vec3::new(0.12, -0.08, 0.7) };
        for turn in [0.0, 0.6] {
            // The object's pose at which the template's reference point is at the region's centre.
            let pose = camera_from_view(&roi.camera_from_roi(), turn) * template.view_from_object;
            let depth = render_depth(&mesh, &pose, &camera);
            let options = DepthOptions { remove_plane: false, ..DepthOptions::default() };
            let scene = DepthRegion::from_depth(&depth, &camera, None, &options).unwrap();
            let seen = Patch::of_scene(&scene, &roi, size, 28, |_| true);
            let drawn = TemplateSurface::new(template, object.size).patch(turn, size, 28);
            let (mut both, mut either, mut alike) = (0, 0, 0);
            for i in 0..28 * 28 {
                let at = |p: &Patch| [0, 1, 2, 3, 4].map(|k| p.values[k * 784 + i]);
                let (a, b) = (at(&seen), at(&drawn));
                either += usize::from(a[4] + b[4] > 0.0);
                if a[4] * b[4] > 0.0 {
                    both += 1;
                    let cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
                    alike += usize::from(cosine > 0.8 && (a[3] - b[3]).abs() < 0.1);
                }
            }
            assert!(both > 60 && 10 * both > 8 * either, "turn {turn}: {both} of {either}");
            assert!(10 * alike > 8 * both, "turn {turn}: {alike} of {both}");
        }
    }
}
