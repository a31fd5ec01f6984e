//! Outputs of the visibility buffer: barycentrics, normals, object coordinates, masks.

use nalgebra::Vector3;
use sixfold_geometry::{Image, NormalImage, PointImage, Vec2, Vec3};

use crate::raster::{Canvas, SceneObject, VisibilityBuffer, face_in_camera};

/// The surface at one pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Surface {
    /// Index of the object in the list given to [`VisibilityBuffer::render`].
    pub object: u32,
    /// Index of the face in that object's mesh.
    pub face: u32,
    /// Weights of the face's three corners at the visible point (perspective-correct; they sum to 1). A face without area, or so
    /// large that its area is not a finite number, has all the weight at its first corner.
    pub barycentric: [f32; 3],
}

/// The axis-aligned box that normalises object coordinates: each axis ranges from -1 to 1 over it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoundingBoxScale {
    /// The point that becomes the origin, metres.
    pub centre: Vec3,
    /// The divisor of each axis, metres.
    pub half_size: Vec3,
}

impl BoundingBoxScale {
    /// The box between two corners; an axis without extent is divided by the largest extent instead.
    pub fn of_corners(low: &Vec3, high: &Vec3) -> Self {
        let half = (high - low) * 0.5;
        let largest = half.amax().max(f64::MIN_POSITIVE);
        BoundingBoxScale {
            centre: (low + high) * 0.5,
            half_size: half.map(|h| if h > 0.0 { h } else { largest }),
        }
    }

    /// Metres to normalised coordinates.
    pub fn normalise(&self, p: &Vec3) -> Vec3 {
        (p - self.centre).component_div(&self.half_size)
    }

    /// Normalised coordinates to metres.
    pub fn restore(&self, n: &Vec3) -> Vec3 {
        n.component_mul(&self.half_size) + self.centre
    }
}

impl VisibilityBuffer {
    /// Calls `f` with pixel number, depth-scaled point in the camera frame (metres) and surface of every
    /// covered pixel. `objects` must be the rendered ones.
    pub(crate) fn for_surfaces(
        &self,
        objects: &[SceneObject<'_>],
        mut f: impl FnMut(usize, Vec3, usize, usize, [f64; 3], &[Vec3; 3]),
    ) {
        let camera = *self.camera();
        let mut last = (usize::MAX, usize::MAX);
        let mut corners = [Vec3::zeros(); 3];
        self.for_covered(|index| {
            let Some((object, face)) = self.surface_at(index) else { return };
            if (object, face) != last {
                last = (object, face);
                corners = face_in_camera(&objects[object], face);
            }
            let pixel = Vec2::new((index % self.width()) as f64, (index / self.width()) as f64);
            let point = camera.unproject(&pixel, 1.0 / f64::from(self.inverse_depth()[index]));
            f(index, point, object, face, barycentric(&point, &corners), &corners);
        });
    }

    /// Object, face and barycentric weights per pixel.
    pub fn surfaces(&self, objects: &[SceneObject<'_>]) -> Image<Option<Surface>> {
        let mut out = Image::filled(self.width(), self.height(), None);
        self.for_surfaces(objects, |index, _, object, face, weights, _| {
            out.as_mut_slice()[index] = Some(Surface {
                object: object as u32,
                face: face as u32,
                barycentric: weights.map(|w| w as f32),
            });
        });
        out
    }

    /// Unit normals in the camera frame, pointing to the camera; zero where nothing was rendered, or where a face is so large that
    /// its area is not a finite number. Vertex normals are interpolated where the mesh has them, otherwise each face is flat.
    pub fn normals(&self, objects: &[SceneObject<'_>]) -> NormalImage {
        let mut out = Image::filled(self.width(), self.height(), [0.0f32; 3]);
        self.for_surfaces(objects, |index, point, object, face, weights, corners| {
            let n = surface_normal(&objects[object], face, weights, corners, &point);
            out.as_mut_slice()[index] = [n.x as f32, n.y as f32, n.z as f32];
        });
        out
    }

    /// The visible point in its object's own frame, metres; NaN where nothing was rendered.
    pub fn object_coordinates(&self, objects: &[SceneObject<'_>]) -> PointImage {
        let mut out = Canvas::new(self.width(), self.height(), [f32::NAN; 3]);
        self.object_coordinates_into(objects, &mut out);
        out.into_image()
    }

    /// As [`VisibilityBuffer::object_coordinates`], into an image that is reused; create it with NaN as its empty pixel.
    pub fn object_coordinates_into(&self, objects: &[SceneObject<'_>], out: &mut Canvas<[f32; 3]>) {
        // object = R^T (z K^-1 (x, y, 1) - t): linear in the pixel, so no barycentrics are needed.
        let maps: Vec<_> = objects
            .iter()
            .map(|o| {
                let r = o.camera_from_object.rotation_matrix().transpose();
                let kx = r.column(0) / self.camera().fx;
                let ky = r.column(1) / self.camera().fy;
                let k0 = r.column(2) - kx * self.camera().cx - ky * self.camera().cy;
                let t: Vector3<f64> = r * o.camera_from_object.translation();
                (Vector3::from(kx), Vector3::from(ky), Vector3::from(k0), t)
            })
            .collect();
        let width = self.width();
        let [x0, y0, x1, y1] = self.covered();
        let single = maps.len() == 1;
        let data = out.begin(width, self.height(), [x0, y0, x1, y1]);
        for y in y0..y1 {
            let row = y * width..(y + 1) * width;
            let inverses = &self.inverse_depth()[row.clone()][x0..x1];
            for (i, (out, &inverse)) in data[row][x0..x1].iter_mut().zip(inverses).enumerate() {
                if inverse <= 0.0 {
                    *out = [f32::NAN; 3];
                    continue;
                }
                let x = x0 + i;
                let object = if single { 0 } else { self.surface_at(y * width + x).map_or(0, |s| s.0) };
                let (kx, ky, k0, t) = &maps[object];
                let z = 1.0 / f64::from(inverse);
                let p = (kx * x as f64 + (ky * y as f64 + k0)) * z - t;
                *out = [p.x as f32, p.y as f32, p.z as f32];
            }
        }
    }

    /// As [`VisibilityBuffer::object_coordinates`], normalised to -1..1 by one box per object; NaN where nothing was rendered.
    pub fn normalised_coordinates(
        &self,
        objects: &[SceneObject<'_>],
        scales: &[BoundingBoxScale],
    ) -> PointImage {
        let mut out = self.object_coordinates(objects);
        self.for_covered(|index| {
            let Some((object, _)) = self.surface_at(index) else { return };
            let p = out.as_slice()[index].map(f64::from);
            let n = scales[object].normalise(&Vec3::from(p));
            out.as_mut_slice()[index] = [n.x as f32, n.y as f32, n.z as f32];
        });
        out
    }
}

/// Weights of the corners at a point on their triangle, each from 0 to 1. A triangle that is degenerate, or so large that its
/// area is no longer a finite number, gives its first corner.
fn barycentric(p: &Vec3, c: &[Vec3; 3]) -> [f64; 3] {
    let (e1, e2, q) = (c[1] - c[0], c[2] - c[0], p - c[0]);
    let n = e1.cross(&e2);
    let area = n.norm_squared();
    let (w1, w2) = (q.cross(&e2).dot(&n) / area, e1.cross(&q).dot(&n) / area);
    if area <= 0.0 || !w1.is_finite() || !w2.is_finite() {
        return [1.0, 0.0, 0.0];
    }
    let w1 = w1.clamp(0.0, 1.0);
    let w2 = w2.clamp(0.0, 1.0 - w1);
    [1.0 - w1 - w2, w1, w2]
}

/// The unit normal at a point of a face, in the camera frame, pointing to the camera.
pub(crate) fn surface_normal(
    object: &SceneObject<'_>,
    face: usize,
    weights: [f64; 3],
    corners: &[Vec3; 3],
    point: &Vec3,
) -> Vec3 {
    let smooth = object.mesh.normals().and_then(|normals| {
        let f = object.mesh.faces()[face];
        let n: Vec3 = (0..3).map(|k| normals[f[k] as usize] * weights[k]).sum();
        object.camera_from_object.transform_direction(&n).try_normalize(1e-9)
    });
    let normal = smooth.or_else(|| {
        let n = (corners[1] - corners[0]).cross(&(corners[2] - corners[0]));
        // NaN for a face so large that its area is not finite.
        n.try_normalize(1e-30).filter(|n| n.iter().all(|c| c.is_finite()))
    });
    match normal {
        Some(n) if n.dot(point) > 0.0 => -n,
        Some(n) => n,
        None => Vec3::zeros(),
    }
}
