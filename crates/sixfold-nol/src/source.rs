//! A photograph cropped to the object, with the depth of the mesh at the current pose.

use crate::error::NolError;
use crate::projection::{Projection, TargetSurface};
use crate::window::object_window;
use sixfold_data::{PosedImage, PosedImageError};
use sixfold_geometry::{Camera, Pose, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};
use sixfold_synth::augment::{Coverage, Patch};

/// Colour where the crop extends beyond the image.
const OUTSIDE: f32 = 0.5;
/// The crop's side in units of the object's box in the image, with a margin for pose errors.
pub(crate) const MARGIN: f64 = 1.3;
/// A point counts as visible up to this depth behind the rendered surface, in units of the mesh's diameter.
const BEHIND: f64 = 0.02;

/// A square crop of a photograph around the object.
#[derive(Debug, Clone)]
pub struct SourceView {
    /// Colours, `side x side`.
    pub patch: Patch,
    /// Where the object is visible, 0 to 1: the mask, or 1 everywhere within the image.
    pub visible: Coverage,
    /// The crop's camera.
    pub camera: Camera,
    /// The current pose.
    camera_from_object: Pose,
    /// Depth of the mesh at that pose, row by row, metres; 0 outside it.
    depth: Vec<f32>,
    /// Largest depth of a visible point behind the rendered surface, metres.
    behind: f32,
}

impl SourceView {
    /// Crops the object at the photograph's pose, `side` pixels wide.
    ///
    /// # Errors
    /// [`PosedImageError::OutsideImage`] if the mesh extends behind the camera.
    pub fn new(photograph: &PosedImage, mesh: &Mesh, side: usize) -> Result<Self, NolError> {
        let (camera, pose) = (photograph.camera(), photograph.camera_from_object());
        let Some(window) = object_window(camera, mesh, pose, MARGIN) else {
            let t = pose.translation();
            let name = photograph.name().to_owned();
            return Err(PosedImageError::OutsideImage { name, translation: [t.x, t.y, t.z] }.into());
        };
        let map = window.map(camera, side, 0.0);
        let (patch, mut visible) = Patch::warp(photograph.image(), &map, side, side, [OUTSIDE; 3]);
        if let Some(mask) = photograph.mask() {
            for (i, value) in visible.data.iter_mut().enumerate() {
                let [u, v] = map.apply((i % side) as f32, (i / side) as f32);
                *value *= mask.sample(u, v);
            }
        }
        Ok(Self::of_crop(patch, visible, window.camera(camera, side), *pose, mesh))
    }

    /// A view from an existing crop.
    pub(crate) fn of_crop(patch: Patch, visible: Coverage, camera: Camera, pose: Pose, mesh: &Mesh) -> Self {
        let (low, high) = mesh.bounding_box();
        let mut view = SourceView {
            patch,
            visible,
            camera,
            camera_from_object: pose,
            depth: vec![],
            behind: (BEHIND * (high - low).norm()) as f32,
        };
        view.set_pose(mesh, pose, &mut VisibilityBuffer::new(&camera));
        view
    }

    /// Fraction of the mesh's silhouette at the current pose that the mask leaves visible, 0 to 1.
    pub fn visible_fraction(&self) -> f64 {
        let (mut all, mut seen) = (0usize, 0usize);
        for (z, visible) in self.depth.iter().zip(&self.visible.data) {
            all += usize::from(*z > 0.0);
            seen += usize::from(*z > 0.0 && *visible > 0.5);
        }
        seen as f64 / all.max(1) as f64
    }

    /// The current pose.
    pub fn camera_from_object(&self) -> &Pose {
        &self.camera_from_object
    }

    /// Pixels along a side.
    pub fn side(&self) -> usize {
        self.patch.width
    }

    /// Depth of the mesh at the current pose, row by row, metres; 0 outside it.
    pub fn depth(&self) -> &[f32] {
        &self.depth
    }

    /// Sets another pose for the same crop.
    pub(crate) fn set_pose(&mut self, mesh: &Mesh, camera_from_object: Pose, frame: &mut VisibilityBuffer) {
        self.camera_from_object = camera_from_object;
        frame.set_camera(&self.camera);
        frame.render(&[SceneObject { mesh, camera_from_object }], &RenderOptions::default());
        self.depth.clear();
        let inverse = frame.inverse_depth().iter();
        self.depth.extend(inverse.map(|z| if *z > 0.0 { 1.0 / z } else { 0.0 }));
    }

    /// The pixel at which the crop shows a surface point (object frame, metres; unit normal), and the cosine of the angle between
    /// normal and line of sight. `None` if the surface faces away, is hidden by the object itself, or is outside the crop.
    /// Occlusion by other objects is in `visible`.
    #[inline]
    pub fn see(&self, point: &Vec3, normal: &Vec3) -> Option<([f32; 2], f32)> {
        self.see_at(&self.camera_from_object, point, normal)
    }

    /// The same with another pose near the current one; visibility is decided with the depth of the current one.
    #[inline]
    pub(crate) fn see_at(&self, pose: &Pose, point: &Vec3, normal: &Vec3) -> Option<([f32; 2], f32)> {
        let p = pose.transform_point(point);
        let n = pose.transform_direction(normal);
        let cosine = -n.dot(&p) / p.norm();
        if cosine <= 0.0 || p.z <= 0.0 {
            return None;
        }
        let pixel = self.camera.project(&p)?;
        let last = (self.side() - 1) as f64;
        if !(pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x <= last && pixel.y <= last) {
            return None;
        }
        let (x, y) = (pixel.x as usize, pixel.y as usize);
        let limit = p.z as f32 - self.behind;
        let side = self.side();
        let (x1, y1) = ((x + 1).min(side - 1), (y + 1).min(side - 1));
        let seen = [(x, y), (x1, y), (x, y1), (x1, y1)].into_iter().any(|(x, y)| {
            let z = self.depth[y * side + x];
            z > 0.0 && z >= limit
        });
        seen.then_some(([pixel.x as f32, pixel.y as f32], cosine as f32))
    }

    /// Projects every point of a new view into this crop.
    pub fn project(&self, target: &TargetSurface) -> Projection {
        let mut projection = Projection {
            pixels: Vec::with_capacity(target.points.len()),
            cosines: Vec::with_capacity(target.points.len()),
        };
        for (point, normal) in target.points.iter().zip(&target.normals) {
            let (pixel, cosine) = self.see(point, normal).unwrap_or(([0.0; 2], 0.0));
            projection.pixels.push(pixel);
            projection.cosines.push(cosine);
        }
        projection
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use sixfold_geometry::RgbImage;
    use sixfold_geometry::nalgebra::{UnitQuaternion, Vector3};

    use super::*;

    #[test]
    fn self_occluded_points_are_not_visible() {
        // A plate of 10 cm, and one of 4 cm three centimetres in front of it, both facing the camera.
        let plate = |half: f64, z: f64| {
            [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
                .map(|(x, y)| Vec3::new(x * half, y * half, z))
        };
        let vertices = [plate(0.05, 0.0), plate(0.02, 0.03)].concat();
        let mesh = Mesh::new(vertices, vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]).unwrap();
        let camera = Camera::new(500.0, 500.0, 159.5, 119.5, 320, 240).unwrap();
        let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        let pose = Pose::new(turn, Vec3::new(0.0, 0.0, 0.5));
        let image = Arc::new(RgbImage::filled(320, 240, [90; 3]));
        let photograph = PosedImage::new("plates", 1, image, camera, pose).unwrap();
        let view = SourceView::new(&photograph, &mesh, 96).unwrap();
        let up = Vec3::z();
        let (pixel, cosine) = view.see(&Vec3::new(0.0, 0.0, 0.03), &up).expect("the plate in front");
        assert!(pixel.iter().all(|p| (p - 47.5).abs() < 1.0) && cosine > 0.99, "{pixel:?} {cosine}");
        assert!(view.see(&Vec3::new(0.04, 0.0, 0.0), &up).is_some(), "beside it, the plate behind");
        assert!(view.see(&Vec3::zeros(), &up).is_none(), "behind the plate in front");
        assert!(view.see(&Vec3::new(0.0, 0.0, 0.03), &-up).is_none(), "turned away");
        assert!(view.see(&Vec3::new(0.3, 0.0, 0.0), &up).is_none(), "beside the crop");
    }
}
