//! A depth image prepared once for every method: in-painting, normals, table plane, depth edges. A [`DepthRegion`] is a view of it
//! with the points in which an object is searched.

use std::ops::Deref;
use std::sync::{Arc, OnceLock};

use rayon::prelude::*;
use sixfold_geometry::{
    Camera, CameraError, DepthImage, DepthImageError, Image, IndexedCloud, Mask, NormalImage, NormalOptions,
    OptionError, Plane, PlaneOptions, PointCloud, Vec2, Vec3, dominant_plane, inpaint_depth,
    normals_from_depth, usable_depth,
};
use thiserror::Error;

/// Why a depth image or a region of it cannot be used.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum PreparedDepthError {
    /// The image does not have the camera's size.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// The mask does not have the image's size.
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
    /// The depth image has no usable depth.
    #[error(transparent)]
    Depth(#[from] DepthImageError),
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
}

/// Options of the preparation of depth images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthOptions {
    /// How normals are computed.
    pub normals: NormalOptions,
    /// Rounds of in-painting before normals are computed (dissertation, section 5.3.1).
    pub inpaint_rounds: usize,
    /// Find the dominant plane and leave its points out of the search.
    pub remove_plane: bool,
    /// How the plane is searched.
    pub plane: PlaneOptions,
    /// Points further away than this are left out, metres.
    pub max_depth: f64,
    /// Seed of the plane search.
    pub seed: u64,
}

/// Radius in pixels within which a normal is fitted for matching: wider than for ICP, as features need smooth normals. Chosen by
/// hand; not swept.
const MATCHING_NORMAL_RADIUS: usize = 4;

/// Rounds of in-painting, each of which fills one pixel into the holes. The dissertation, section 5.3.1, in-paints; the number was
/// chosen by hand.
const INPAINT_ROUNDS: usize = 2;
/// Depth beyond which points are left out, metres; chosen by hand, not swept.
const MAX_DEPTH: f64 = 5.0;

impl Default for DepthOptions {
    fn default() -> Self {
        DepthOptions {
            normals: NormalOptions { radius: MATCHING_NORMAL_RADIUS, ..NormalOptions::default() },
            inpaint_rounds: INPAINT_ROUNDS,
            remove_plane: true,
            plane: PlaneOptions::default(),
            max_depth: MAX_DEPTH,
            seed: 0,
        }
    }
}

impl DepthOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        self.normals.check()?;
        OptionError::unless_within("inpaint_rounds", self.inpaint_rounds, ..=1000, "0 to 1000")?;
        self.plane.check()?;
        let fits = self.max_depth > 0.0;
        if fits { Ok(()) } else { Err(OptionError::new("max_depth", self.max_depth, "metres above 0")) }
    }
}

/// A depth image with data that methods derive from it, computed once. Plane and edges are computed on first use.
#[derive(Debug)]
pub struct PreparedDepth {
    camera: Camera,
    /// Depth as measured, invalid pixels 0.
    depth: DepthImage,
    filled: DepthImage,
    normals: NormalImage,
    options: DepthOptions,
    plane: OnceLock<Option<Plane>>,
    edge_distance: OnceLock<Image<u8>>,
}

/// Spacing to which the points of a region are downsampled first, metres: about the noise of depth cameras at one metre. Chosen by
/// hand; not swept.
const BASE_STEP: f64 = 0.002;
/// Points whose normals differ by more than this angle are not merged when downsampling, radians. Chosen by hand; not swept.
const BASE_ANGLE: f64 = 1.0;

impl PreparedDepth {
    /// Prepares a depth image (metres, 0 where nothing was measured) of a pinhole camera.
    ///
    /// # Errors
    /// [`PreparedDepthError`] if the image does not have the camera's size or cannot be depth in metres.
    pub fn new(
        depth: &DepthImage,
        camera: &Camera,
        options: &DepthOptions,
    ) -> Result<Arc<PreparedDepth>, PreparedDepthError> {
        options.check()?;
        camera.check_lens()?;
        camera.check_image(depth.width(), depth.height())?;
        let depth = usable_depth(depth)?;
        let filled = inpaint_depth(&depth, options.inpaint_rounds);
        let mut normals = normals_from_depth(&filled, camera, &options.normals);
        for (n, z) in normals.as_mut_slice().iter_mut().zip(depth.as_slice()) {
            if *z == 0.0 {
                *n = [0.0; 3];
            }
        }
        Ok(Arc::new(PreparedDepth {
            camera: *camera,
            depth,
            filled,
            normals,
            options: *options,
            plane: OnceLock::new(),
            edge_distance: OnceLock::new(),
        }))
    }

    /// The camera.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The depth as measured, 0 where invalid.
    pub fn depth(&self) -> &DepthImage {
        &self.depth
    }

    /// Normals per pixel, zero where there is no normal.
    pub fn normals(&self) -> &NormalImage {
        &self.normals
    }

    /// The table plane, if it was searched and found; its normal points to the camera.
    pub fn plane(&self) -> Option<&Plane> {
        let find = || {
            let near = |z: &f32| if f64::from(*z) < self.options.max_depth { *z } else { 0.0 };
            let all = PointCloud::from_depth(&self.depth.map(near), Some(&self.normals), &self.camera);
            dominant_plane(&all, &self.options.plane, self.options.seed)
        };
        if !self.options.remove_plane {
            return None;
        }
        self.plane.get_or_init(find).as_ref()
    }

    /// Points closer to the plane than this belong to it, metres.
    pub(crate) fn plane_margin(&self) -> f64 {
        self.options.plane.threshold
    }

    /// Distance in pixels to the nearest depth edge or hole, at most 255.
    pub fn edge_distance(&self) -> &Image<u8> {
        self.edge_distance.get_or_init(|| edge_distances(&self.filled, &self.normals))
    }

    /// The points off the plane, row by row, of the pixels for which `inside` is true, within the columns and rows `bounds` (`[x0,
    /// y0, x1, y1]`, ends excluded).
    fn points(&self, [x0, y0, x1, y1]: [usize; 4], inside: impl Fn(usize, usize) -> bool) -> PointCloud {
        let plane = self.plane();
        let margin = self.options.plane.threshold;
        let mut cloud = PointCloud::default();
        for y in y0..y1 {
            for x in x0..x1 {
                let z = f64::from(self.depth[(x, y)]);
                let n = self.normals[(x, y)];
                if z <= 0.0 || z > self.options.max_depth || n == [0.0; 3] || !inside(x, y) {
                    continue;
                }
                let p = self.camera.unproject(&Vec2::new(x as f64, y as f64), z);
                if plane.is_none_or(|plane| plane.distance(&p) >= margin) {
                    cloud.points.push(p);
                    cloud.normals.push(Vec3::from(n.map(f64::from)));
                }
            }
        }
        cloud.voxel_downsample(BASE_STEP, BASE_ANGLE)
    }
}

/// A view of a prepared depth image: an object is searched only in its points, but occluders and support are taken from the whole
/// image.
#[derive(Debug)]
pub struct DepthRegion {
    image: Arc<PreparedDepth>,
    /// Points off the plane, downsampled.
    cloud: PointCloud,
    indexed: OnceLock<Option<IndexedCloud>>,
}

impl Deref for DepthRegion {
    type Target = PreparedDepth;

    fn deref(&self) -> &PreparedDepth {
        &self.image
    }
}

impl DepthRegion {
    /// Prepares a depth image for one search: all of it, or the pixels of a mask. For several regions prepare the image once with
    /// [`PreparedDepth::new`].
    ///
    /// # Errors
    /// [`PreparedDepthError`].
    pub fn from_depth(
        depth: &DepthImage,
        camera: &Camera,
        mask: Option<&Mask>,
        options: &DepthOptions,
    ) -> Result<DepthRegion, PreparedDepthError> {
        let image = PreparedDepth::new(depth, camera, options)?;
        match mask {
            Some(mask) => DepthRegion::new(&image, mask),
            None => Ok(DepthRegion::whole(&image)),
        }
    }

    /// The whole image.
    pub fn whole(image: &Arc<PreparedDepth>) -> DepthRegion {
        let (width, height) = image.depth.size();
        DepthRegion::of(image, image.points([0, 0, width, height], |_, _| true))
    }

    /// The pixels of a mask of the image's size.
    ///
    /// # Errors
    /// [`PreparedDepthError::MaskSize`].
    pub fn new(image: &Arc<PreparedDepth>, mask: &Mask) -> Result<DepthRegion, PreparedDepthError> {
        if mask.size() != image.depth.size() {
            return Err(PreparedDepthError::MaskSize {
                found_width: mask.width(),
                found_height: mask.height(),
                width: image.depth.width(),
                height: image.depth.height(),
            });
        }
        let bounds =
            mask.bounding_box().map_or([0; 4], |[x, y, width, height]| [x, y, x + width, y + height]);
        Ok(DepthRegion::of(image, image.points(bounds, |x, y| mask[(x, y)])))
    }

    fn of(image: &Arc<PreparedDepth>, cloud: PointCloud) -> DepthRegion {
        DepthRegion { image: image.clone(), cloud, indexed: OnceLock::new() }
    }

    /// The image of which it is a view.
    pub fn image(&self) -> &Arc<PreparedDepth> {
        &self.image
    }

    /// The points that are searched: off the plane and inside the mask.
    pub fn cloud(&self) -> &PointCloud {
        &self.cloud
    }

    /// These points with a search tree, built on first use; `None` if there are no points.
    pub fn indexed_cloud(&self) -> Option<&IndexedCloud> {
        self.indexed.get_or_init(|| IndexedCloud::new(self.cloud.clone()).ok()).as_ref()
    }

    /// The points further than `distance` metres from all given ones, so that explained points are not matched again.
    pub fn cloud_without(&self, explained: &[Vec3], distance: f64) -> PointCloud {
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

/// A depth edge is a jump between neighbours of more than this many metres ([`EDGE_JUMP`]) plus this fraction of the nearer depth
/// ([`EDGE_SLOPE`]): the fraction allows for slanted surfaces. Both chosen by hand; not swept.
const EDGE_JUMP: f32 = 0.005;
/// See [`EDGE_JUMP`].
const EDGE_SLOPE: f32 = 0.015;
/// A crease: the cosine of the angle between the normals on both sides is less than this, about 35 degrees. Chosen by hand; not
/// swept.
const CREASE_COSINE: f32 = 0.82;
/// Distance from a crease, to both sides, at which its normals are compared, pixels; chosen by hand, not swept.
const CREASE_REACH: usize = 4;

/// Distance in pixels (8-neighbour steps) to the nearest depth edge, at most 255: a jump between neighbours, or a crease (there is
/// no jump in depth where an object touches the table).
fn edge_distances(depth: &DepthImage, normals: &NormalImage) -> Image<u8> {
    let crease = |a: [f32; 3], b: [f32; 3]| {
        a != [0.0; 3] && b != [0.0; 3] && a[0] * b[0] + a[1] * b[1] + a[2] * b[2] < CREASE_COSINE
    };
    let (width, height) = depth.size();
    let jump = |a: f32, b: f32| (a > 0.0) != (b > 0.0) || (a - b).abs() > EDGE_JUMP + EDGE_SLOPE * a.min(b);
    let mut distance = Image::from_fn(width, height, |x, y| {
        let z = depth[(x, y)];
        let right = x + 1 < width && jump(z, depth[(x + 1, y)]);
        let left = x > 0 && jump(z, depth[(x - 1, y)]);
        let down = y + 1 < height && jump(z, depth[(x, y + 1)]);
        let up = y > 0 && jump(z, depth[(x, y - 1)]);
        let bent = (x >= CREASE_REACH
            && x + CREASE_REACH < width
            && crease(normals[(x - CREASE_REACH, y)], normals[(x + CREASE_REACH, y)]))
            || (y >= CREASE_REACH
                && y + CREASE_REACH < height
                && crease(normals[(x, y - CREASE_REACH)], normals[(x, y + CREASE_REACH)]));
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_out_of_range_are_named() {
        let options = DepthOptions::default();
        assert_eq!(options.check(), Ok(()));
        assert_eq!(DepthOptions { max_depth: f64::INFINITY, ..options }.check(), Ok(()));
        let named = |options: DepthOptions| options.check().unwrap_err().option;
        assert_eq!(named(DepthOptions { max_depth: f64::NAN, ..options }), "max_depth");
        assert_eq!(named(DepthOptions { inpaint_rounds: 1001, ..options }), "inpaint_rounds");
        let normals = NormalOptions { max_relative_step: -1.0, ..options.normals };
        assert_eq!(named(DepthOptions { normals, ..options }), "normals.max_relative_step");
        let plane = PlaneOptions { min_fraction: f64::NAN, ..options.plane };
        assert_eq!(named(DepthOptions { plane, ..options }), "plane.min_fraction");
    }
}
