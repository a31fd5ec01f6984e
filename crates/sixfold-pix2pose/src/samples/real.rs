//! Photographs of an object with known pose, and how they are read from a BOP dataset.

use std::collections::BTreeMap;
use std::sync::Arc;

use sixfold_bop::{BopDataset, MaskKind, Models, VISIBILITY_DELTA, ground_truth_visibility};
use sixfold_geometry::{Camera, Mask, Pose, Rect, RgbImage, Vec2};
use sixfold_mesh::Mesh;
use sixfold_synth::augment::{AffineMap, Coverage, Cutout};

use super::error::SampleError;

/// Fewer visible pixels teach nothing.
const LEAST_PIXELS: usize = 64;

/// One object in one photograph. The photograph is shared between its objects.
#[derive(Debug, Clone)]
pub struct RealCrop {
    object_id: u32,
    image: Arc<RgbImage>,
    camera: Camera,
    camera_from_object: Pose,
    visible: MaskWindow,
    outline: Vec<Vec2>,
}

/// A mask cut to its box: 1 where the object is visible.
#[derive(Debug, Clone)]
struct MaskWindow {
    x: usize,
    y: usize,
    width: usize,
    height: usize,
    data: Vec<u8>,
}

impl MaskWindow {
    fn at(&self, x: isize, y: isize) -> f32 {
        let (x, y) = (x - self.x as isize, y - self.y as isize);
        if x < 0 || y < 0 || x >= self.width as isize || y >= self.height as isize {
            return 0.0;
        }
        f32::from(self.data[y as usize * self.width + x as usize])
    }

    /// Bilinear.
    fn sample(&self, u: f32, v: f32) -> f32 {
        let (x, y) = (u.floor(), v.floor());
        let (fx, fy) = (u - x, v - y);
        let (x, y) = (x as isize, y as isize);
        let top = self.at(x, y) * (1.0 - fx) + self.at(x + 1, y) * fx;
        let bottom = self.at(x, y + 1) * (1.0 - fx) + self.at(x + 1, y + 1) * fx;
        top * (1.0 - fy) + bottom * fy
    }
}

impl RealCrop {
    /// One object of a photograph: pinhole camera, pose, and where the object is visible.
    ///
    /// # Errors
    /// [`SampleError`] when sizes differ, the camera is not usable, the pose puts the object outside the image, or
    /// fewer than 64 pixels are visible.
    pub fn new(
        object_id: u32,
        image: Arc<RgbImage>,
        camera: Camera,
        camera_from_object: Pose,
        visible: &Mask,
    ) -> Result<Self, SampleError> {
        camera.check().map_err(|source| SampleError::Camera { id: object_id, source })?;
        for (what, (width, height)) in [("photograph", image.size()), ("visible mask", visible.size())] {
            if (width, height) != (camera.width, camera.height) {
                return Err(SampleError::Size {
                    id: object_id,
                    what,
                    width,
                    height,
                    camera_width: camera.width,
                    camera_height: camera.height,
                });
            }
        }
        let t = camera_from_object.translation();
        let outside = || SampleError::OutsideImage { id: object_id, translation: [t.x, t.y, t.z] };
        // The origin may lie a little outside the image while the object is inside; behind the camera it may not.
        let pixel = camera.project(&t).ok_or_else(outside)?;
        let (w, h) = (camera.width as f64, camera.height as f64);
        if !(pixel.x > -w && pixel.y > -h && pixel.x < 2.0 * w && pixel.y < 2.0 * h) {
            return Err(outside());
        }
        let (mut x0, mut y0, mut x1, mut y1) = (usize::MAX, usize::MAX, 0, 0);
        let mut outline = Vec::new();
        let mut pixels = 0;
        for y in 0..visible.height() {
            let row = visible.row(y);
            let Some(first) = row.iter().position(|v| *v) else { continue };
            let last = row.iter().rposition(|v| *v).unwrap_or(first);
            pixels += row.iter().filter(|v| **v).count();
            (x0, y0, x1, y1) = (x0.min(first), y0.min(y), x1.max(last + 1), y1.max(y + 1));
            // Corners of the row's outermost pixels.
            for dy in [-0.5, 0.5] {
                outline.push(Vec2::new(first as f64 - 0.5, y as f64 + dy));
                outline.push(Vec2::new(last as f64 + 0.5, y as f64 + dy));
            }
        }
        if pixels < LEAST_PIXELS {
            return Err(SampleError::NotVisible { id: object_id, pixels, least: LEAST_PIXELS });
        }
        let data = (y0..y1).flat_map(|y| visible.row(y)[x0..x1].iter().map(|v| u8::from(*v))).collect();
        Ok(RealCrop {
            object_id,
            image,
            camera: camera.without_distortion(),
            camera_from_object,
            visible: MaskWindow { x: x0, y: y0, width: x1 - x0, height: y1 - y0, data },
            outline,
        })
    }

    /// Which object.
    pub fn object_id(&self) -> u32 {
        self.object_id
    }

    /// The photograph.
    pub fn image(&self) -> &Arc<RgbImage> {
        &self.image
    }

    /// Its camera.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The object's pose.
    pub fn camera_from_object(&self) -> &Pose {
        &self.camera_from_object
    }

    /// The box of the visible part, pixels.
    pub fn visible_box(&self) -> Rect {
        let m = &self.visible;
        Rect { x: m.x as f64, y: m.y as f64, width: m.width as f64, height: m.height as f64 }
    }

    /// Points of the image whose box is that of the visible part, however the image is turned.
    pub(super) fn outline(&self) -> &[Vec2] {
        &self.outline
    }

    /// How much of each crop pixel shows the object.
    pub fn visible(&self, map: &AffineMap, size: usize) -> Coverage {
        Coverage::from_fn(size, size, |x, y| {
            let [u, v] = map.apply(x as f32, y as f32);
            self.visible.sample(u, v)
        })
    }

    /// The visible part as a picture of its own.
    pub fn cutout(&self) -> Option<Cutout> {
        let m = &self.visible;
        let image = RgbImage::from_fn(m.width, m.height, |x, y| self.image[(m.x + x, m.y + y)]);
        let mask = Mask::from_fn(m.width, m.height, |x, y| m.data[y * m.width + x] > 0);
        Cutout::new(&image, &mask)
    }
}

/// Reads the photographs of a dataset that show `objects`: `frames` are pairs of scene and image id; nothing else of the
/// dataset's images is opened. Instances less visible than `least_visible` (0..1) are left out.
///
/// Visible masks come from the dataset (`mask_visib`); where a frame has none, all its annotated objects are rendered
/// together. What is annotated nowhere and hides an object is then not known.
///
/// # Errors
/// [`SampleError`] when the dataset or one of the frames cannot be read.
pub fn read_real_crops(
    dataset: &BopDataset,
    frames: &[(u32, u32)],
    objects: &[u32],
    least_visible: f64,
) -> Result<Vec<RealCrop>, SampleError> {
    let mut crops = Vec::new();
    let mut scenes = BTreeMap::new();
    let mut meshes: BTreeMap<u32, Mesh> = BTreeMap::new();
    for &(scene_id, im_id) in frames {
        if let std::collections::btree_map::Entry::Vacant(place) = scenes.entry(scene_id) {
            place.insert(dataset.scene(scene_id)?);
        }
        let scene = &scenes[&scene_id];
        let frame = scene.image(im_id)?;
        if !frame.ground_truth.iter().any(|g| objects.contains(&g.obj_id)) {
            continue;
        }
        let rgb = scene.rgb(im_id)?.ok_or(SampleError::NoColorImage { scene_id, im_id })?;
        let rgb = Arc::new(rgb);
        let camera = scene.camera(im_id)?;
        let mut masks = Vec::new();
        for index in 0..frame.ground_truth.len() {
            masks.push(scene.mask(im_id, index, MaskKind::Visible)?);
        }
        let mut fractions = frame.visible_fractions();
        if masks.iter().any(Option::is_none) || fractions.iter().any(Option::is_none) {
            for g in &frame.ground_truth {
                if let std::collections::btree_map::Entry::Vacant(place) = meshes.entry(g.obj_id) {
                    place.insert(dataset.model(g.obj_id, Models::Rendering)?);
                }
            }
            let placed: Vec<(&Mesh, Pose)> =
                frame.ground_truth.iter().map(|g| (&meshes[&g.obj_id], g.camera_from_object)).collect();
            let rendered = ground_truth_visibility(&placed, &camera, None, VISIBILITY_DELTA);
            for ((mask, fraction), rendered) in masks.iter_mut().zip(&mut fractions).zip(rendered) {
                if mask.is_none() {
                    *mask = Some(rendered.mask_visible);
                }
                fraction.get_or_insert(rendered.info.visib_fract);
            }
        }
        for ((truth, mask), fraction) in frame.ground_truth.iter().zip(masks).zip(fractions) {
            let (Some(mask), Some(fraction)) = (mask, fraction) else { continue };
            if !objects.contains(&truth.obj_id) || fraction < least_visible {
                continue;
            }
            if mask.as_slice().iter().filter(|v| **v).count() < LEAST_PIXELS {
                continue;
            }
            crops.push(RealCrop::new(truth.obj_id, rgb.clone(), camera, truth.camera_from_object, &mask)?);
        }
    }
    Ok(crops)
}
