//! A depth image prepared for matching: normals, cloud, table plane, depth edges.

use rayon::prelude::*;
use sixfold_geometry::{
    Camera, CameraError, DepthImage, DepthImageError, Image, Mask, NormalImage, NormalOptions, Plane,
    PlaneOptions, PointCloud, Vec3, dominant_plane, inpaint_depth, normals_from_depth, usable_depth,
};
use thiserror::Error;

/// Why a depth image cannot be used.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum SceneError {
    /// The image does not belong to the camera.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// The mask does not belong to the image.
    #[error("the mask is {found_width}x{found_height}, the depth image {width}x{height}")]
    MaskSize {
        /// Width of the mask.
        found_width: usize,
        /// Height of the mask.
        found_height: usize,
        /// Width of the depth image.
        width: usize,
        /// Height of the depth image.
        height: usize,
    },
    /// The depth image holds nothing that could be the scene.
    #[error(transparent)]
    Depth(#[from] DepthImageError),
}

/// How a depth image is prepared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SceneOptions {
    /// How normals are computed.
    pub normals: NormalOptions,
    /// Rounds of in-painting before normals are computed (dissertation, section 5.3.1).
    pub inpaint_rounds: usize,
    /// Find the dominant plane and leave its points out of the matching.
    pub remove_plane: bool,
    /// How the plane is searched.
    pub plane: PlaneOptions,
    /// Points further away than this are left out, metres.
    pub max_depth: f64,
    /// Seed of the plane search.
    pub seed: u64,
}

impl Default for SceneOptions {
    fn default() -> Self {
        SceneOptions {
            normals: NormalOptions { radius: 4, ..NormalOptions::default() },
            inpaint_rounds: 2,
            remove_plane: true,
            plane: PlaneOptions::default(),
            max_depth: 5.0,
            seed: 0,
        }
    }
}

/// A prepared depth image.
#[derive(Debug, Clone)]
pub struct Scene {
    pub(crate) camera: Camera,
    /// As measured, invalid pixels 0.
    pub(crate) depth: DepthImage,
    pub(crate) normals: NormalImage,
    pub(crate) plane: Option<Plane>,
    /// Distance in pixels to the nearest depth edge or hole, at most 255.
    pub(crate) edge_distance: Image<u8>,
    /// Points off the plane, thinned to `base_step`.
    pub(crate) cloud: PointCloud,
}

/// Points of a scene are thinned to this first, metres.
const BASE_STEP: f64 = 0.002;

impl Scene {
    /// Prepares a depth image (metres). With a mask only its pixels can belong to the object that is searched;
    /// the rest of the image still hides and supports.
    ///
    /// # Errors
    /// [`SceneError`].
    pub fn new(
        depth: &DepthImage,
        camera: &Camera,
        mask: Option<&Mask>,
        options: &SceneOptions,
    ) -> Result<Scene, SceneError> {
        camera.check()?;
        camera.check_image(depth.width(), depth.height())?;
        if let Some(m) = mask
            && m.size() != depth.size()
        {
            return Err(SceneError::MaskSize {
                found_width: m.width(),
                found_height: m.height(),
                width: depth.width(),
                height: depth.height(),
            });
        }
        let depth = usable_depth(depth)?;
        let filled = inpaint_depth(&depth, options.inpaint_rounds);
        let mut normals = normals_from_depth(&filled, camera, &options.normals);
        for (n, z) in normals.as_mut_slice().iter_mut().zip(depth.as_slice()) {
            if *z == 0.0 {
                *n = [0.0; 3];
            }
        }
        let all = PointCloud::from_depth(
            &depth.map(|&z| if f64::from(z) < options.max_depth { z } else { 0.0 }),
            Some(&normals),
            camera,
        );
        let plane =
            if options.remove_plane { dominant_plane(&all, &options.plane, options.seed) } else { None };
        let margin = options.plane.threshold;
        let kept = Image::from_fn(depth.width(), depth.height(), |x, y| {
            let z = f64::from(depth[(x, y)]);
            if z <= 0.0 || z > options.max_depth || mask.is_some_and(|m| !m[(x, y)]) {
                return 0.0;
            }
            let p = camera.unproject(&sixfold_geometry::Vec2::new(x as f64, y as f64), z);
            match &plane {
                Some(plane) if plane.distance(&p) < margin => 0.0,
                _ => z as f32,
            }
        });
        let cloud = PointCloud::from_depth(&kept, Some(&normals), camera).voxel_downsample(BASE_STEP, 1.0);
        let edge_distance = edge_distances(&filled, &normals);
        Ok(Scene { camera: *camera, depth, normals, plane, edge_distance, cloud })
    }

    /// The table plane, if one was found; its normal points to the camera.
    pub fn plane(&self) -> Option<&Plane> {
        self.plane.as_ref()
    }

    /// The points that are matched: off the plane and inside the mask.
    pub fn cloud(&self) -> &PointCloud {
        &self.cloud
    }

    /// The depth as measured, 0 where invalid.
    pub fn depth(&self) -> &DepthImage {
        &self.depth
    }

    /// Normals per pixel.
    pub fn normals(&self) -> &NormalImage {
        &self.normals
    }

    /// Distance in pixels to the nearest depth edge or hole, at most 255.
    pub fn edge_distance(&self) -> &Image<u8> {
        &self.edge_distance
    }

    /// The camera.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// Takes out the points within `distance` metres of the given ones: what was explained is not matched again.
    pub(crate) fn cloud_without(&self, explained: &[Vec3], distance: f64) -> PointCloud {
        let tree = sixfold_geometry::KdTree::new(explained);
        let keep: Vec<bool> = self
            .cloud
            .points
            .par_iter()
            .map(|p| tree.nearest(p).is_none_or(|n| n.distance > distance))
            .collect();
        let mut cloud = PointCloud::default();
        for (i, keep) in keep.into_iter().enumerate() {
            if keep {
                cloud.points.push(self.cloud.points[i]);
                cloud.normals.push(self.cloud.normals[i]);
            }
        }
        cloud
    }
}

/// Distance in pixels (8-neighbour steps) to the nearest depth edge, at most 255: a jump of more than 1.5 % of
/// the depth plus 5 mm between neighbours, or a crease of more than 35 degrees between the normals four pixels to both
/// sides (an object on a table has no jump where it stands).
fn edge_distances(depth: &DepthImage, normals: &NormalImage) -> Image<u8> {
    const REACH: usize = 4;
    let crease = |a: [f32; 3], b: [f32; 3]| {
        a != [0.0; 3] && b != [0.0; 3] && a[0] * b[0] + a[1] * b[1] + a[2] * b[2] < 0.82
    };
    let (width, height) = depth.size();
    let jump = |a: f32, b: f32| (a > 0.0) != (b > 0.0) || (a - b).abs() > 0.005 + 0.015 * a.min(b);
    let mut distance = Image::from_fn(width, height, |x, y| {
        let z = depth[(x, y)];
        let right = x + 1 < width && jump(z, depth[(x + 1, y)]);
        let left = x > 0 && jump(z, depth[(x - 1, y)]);
        let down = y + 1 < height && jump(z, depth[(x, y + 1)]);
        let up = y > 0 && jump(z, depth[(x, y - 1)]);
        let bent = (x >= REACH
            && x + REACH < width
            && crease(normals[(x - REACH, y)], normals[(x + REACH, y)]))
            || (y >= REACH && y + REACH < height && crease(normals[(x, y - REACH)], normals[(x, y + REACH)]));
        if right || left || down || up || bent { 0u8 } else { 255 }
    });
    // Two sweeps of the chessboard distance (Rosenfeld and Pfaltz 1966).
    let data = distance.as_mut_slice();
    for y in 0..height {
        for x in 0..width {
            let i = y * width + x;
            let mut best = data[i];
            if x > 0 {
                best = best.min(data[i - 1].saturating_add(1));
            }
            if y > 0 {
                best = best.min(data[i - width].saturating_add(1));
                if x > 0 {
                    best = best.min(data[i - width - 1].saturating_add(1));
                }
                if x + 1 < width {
                    best = best.min(data[i - width + 1].saturating_add(1));
                }
            }
            data[i] = best;
        }
    }
    for y in (0..height).rev() {
        for x in (0..width).rev() {
            let i = y * width + x;
            let mut best = data[i];
            if x + 1 < width {
                best = best.min(data[i + 1].saturating_add(1));
            }
            if y + 1 < height {
                best = best.min(data[i + width].saturating_add(1));
                if x > 0 {
                    best = best.min(data[i + width - 1].saturating_add(1));
                }
                if x + 1 < width {
                    best = best.min(data[i + width + 1].saturating_add(1));
                }
            }
            data[i] = best;
        }
    }
    distance
}
