//! One depth image prepared for grasping an object: its points, the points around it, the table.

use std::collections::VecDeque;

use sixfold_geometry::{
    Camera, CameraError, DepthImage, DepthImageError, Image, Mask, NormalOptions, OptionError, Plane,
    PlaneOptions, PointCloud, Rect, Vec2, Vec3, dominant_plane, inpaint_depth, normals_from_depth,
    usable_depth,
};
use thiserror::Error;

/// Why a depth image cannot be used for grasping.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum ViewError {
    /// The image does not have the camera's size.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// The mask does not have the image's size.
    #[error(
        "the mask is {found_width}x{found_height}, the depth image {width}x{height}: give the mask of this image"
    )]
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
    /// An option is out of its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The depth image has no usable depth.
    #[error(transparent)]
    Depth(#[from] DepthImageError),
    /// There is no plane that could be a table.
    #[error(
        "no plane contains {percent:.0} % of the measured points, so no table was found: give a mask of the \
         object"
    )]
    NoTable {
        /// Minimum fraction of the points, in per cent.
        percent: f64,
    },
    /// The mask has no pixel.
    #[error("the mask is empty: no pixel is above zero; mark the pixels of the object")]
    EmptyMask,
    /// The mask has pixels, but too few of them were measured.
    #[error(
        "the mask has {pixels} pixels, {measured} of them with depth, expected at least {expected}: the sensor saw nothing there (a glossy or transparent object?), or mask and depth do not belong together"
    )]
    NoDepthInMask {
        /// Pixels of the mask.
        pixels: usize,
        /// Pixels with a valid depth above the table.
        measured: usize,
        /// Number of pixels needed.
        expected: usize,
    },
    /// The mask covers separate objects.
    #[error(
        "the mask covers {parts} separate parts (the largest two have {first} and {second} pixels), \
         expected one object: split the mask"
    )]
    SeveralObjects {
        /// Number of parts.
        parts: usize,
        /// Pixels of the largest part.
        first: usize,
        /// Pixels of the second largest.
        second: usize,
    },
}

/// How a view is prepared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewOptions {
    /// How normals are computed.
    pub normals: NormalOptions,
    /// Rounds of in-painting before normals are computed.
    pub inpaint_rounds: usize,
    /// How the table is searched.
    pub plane: PlaneOptions,
    /// Points lower than this above the table belong to the table, metres.
    pub table_margin: f64,
    /// Neighbouring pixels further apart than this do not belong to the same object, metres.
    pub gap: f64,
    /// Minimum number of measured pixels of an object.
    pub min_pixels: usize,
    /// Points within this distance around the object's bounding box are kept as obstacles, metres.
    pub surroundings: f64,
    /// Spacing to which the object's cloud is downsampled, metres.
    pub step: f64,
    /// Depth beyond this is left out, metres.
    pub max_depth: f64,
    /// Seed of the plane search.
    pub seed: u64,
}

impl Default for ViewOptions {
    fn default() -> Self {
        ViewOptions {
            normals: NormalOptions { radius: 4, ..NormalOptions::default() },
            inpaint_rounds: 2,
            plane: PlaneOptions::default(),
            table_margin: 0.008,
            gap: 0.015,
            min_pixels: 150,
            surroundings: 0.2,
            step: 0.003,
            max_depth: 3.0,
            seed: 0,
        }
    }
}

impl ViewOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        self.normals.check()?;
        OptionError::unless_within("inpaint_rounds", self.inpaint_rounds, ..=1000, "0 to 1000")?;
        self.plane.check()?;
        OptionError::unless_weight("table_margin", self.table_margin)?;
        OptionError::unless_positive("gap", self.gap, "metres above 0")?;
        OptionError::unless_some("min_pixels", self.min_pixels)?;
        OptionError::unless_weight("surroundings", self.surroundings)?;
        OptionError::unless_positive("step", self.step, "metres above 0")?;
        let fits = self.max_depth > 0.0;
        if fits { Ok(()) } else { Err(OptionError::new("max_depth", self.max_depth, "metres above 0")) }
    }
}

/// A depth image prepared for grasping; everything is in the camera's frame.
#[derive(Debug, Clone)]
pub struct GraspView {
    /// The camera, without distortion.
    pub camera: Camera,
    /// Depth as measured, metres, 0 where nothing was measured.
    pub depth: DepthImage,
    /// The object's pixels: in the mask, measured, and above the table.
    pub mask: Mask,
    /// The table, its normal up; `None` when no plane was found.
    pub table: Option<Plane>,
    /// The object's points with their normals, downsampled.
    pub object: PointCloud,
    /// Other points around the object, without the table and without normals.
    pub obstacles: PointCloud,
    /// Spacing of the object's cloud, metres.
    pub step: f64,
    /// Whether the object touches the border of the image, so that a part of it was not seen.
    pub cut_by_edge: bool,
}

#[cfg(test)]
impl GraspView {
    /// A view of points on a table `table` metres below a camera that looks straight down, without a depth image.
    pub(crate) fn from_above(object: PointCloud, table: f64, step: f64) -> GraspView {
        GraspView {
            camera: Camera::new(500.0, 500.0, 31.5, 31.5, 64, 64).unwrap(),
            depth: DepthImage::filled(64, 64, 0.0),
            mask: Mask::filled(64, 64, false),
            table: Some(Plane { normal: -Vec3::z(), offset: -table }),
            object,
            obstacles: PointCloud::default(),
            step,
            cut_by_edge: false,
        }
    }
}

impl GraspView {
    /// Prepares the view of the object in `mask`, from a depth image in metres of a camera without distortion (undistort it first).
    ///
    /// # Errors
    /// [`ViewError`].
    pub fn new(
        depth: &DepthImage,
        camera: &Camera,
        mask: &Mask,
        options: &ViewOptions,
    ) -> Result<GraspView, ViewError> {
        let depth = checked(depth, camera, options)?;
        if mask.size() != depth.size() {
            return Err(ViewError::MaskSize {
                found_width: mask.width(),
                found_height: mask.height(),
                width: depth.width(),
                height: depth.height(),
            });
        }
        let pixels = mask.as_slice().iter().filter(|m| **m).count();
        if pixels == 0 {
            return Err(ViewError::EmptyMask);
        }
        let table = find_table(&depth, camera, options);
        let above = above_table(&depth, camera, table.as_ref(), 0.5 * options.table_margin);
        let mut object = Mask::from_fn(depth.width(), depth.height(), |x, y| mask[(x, y)] && above[(x, y)]);
        let parts = components(&object, &depth, camera, options.gap);
        let measured = parts.iter().map(Vec::len).sum();
        let largest = parts.first().map_or(0, Vec::len);
        if largest < options.min_pixels {
            return Err(ViewError::NoDepthInMask { pixels, measured, expected: options.min_pixels });
        }
        if let Some(second) = parts.get(1).filter(|p| p.len() >= options.min_pixels && 4 * p.len() > largest)
            && apart(&parts[0], second, &depth, camera)
        {
            let large = parts.iter().filter(|p| p.len() >= options.min_pixels).count();
            return Err(ViewError::SeveralObjects { parts: large, first: largest, second: second.len() });
        }
        // Small parts are noise; larger parts may be one object behind a bar.
        object = Mask::filled(depth.width(), depth.height(), false);
        for &pixel in parts.iter().filter(|p| 20 * p.len() >= largest).flatten() {
            object.as_mut_slice()[pixel] = true;
        }
        Ok(Self::of_object(depth, camera, object, table, options))
    }

    fn of_object(
        depth: DepthImage,
        camera: &Camera,
        mask: Mask,
        table: Option<Plane>,
        options: &ViewOptions,
    ) -> GraspView {
        let (width, height) = depth.size();
        let (mut x0, mut y0, mut x1, mut y1) = (width, height, 0, 0);
        let mut nearest = f64::INFINITY;
        for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
            if mask[(x, y)] {
                (x0, y0, x1, y1) = (x0.min(x), y0.min(y), x1.max(x), y1.max(y));
                nearest = nearest.min(f64::from(depth[(x, y)]));
            }
        }
        let cut_by_edge = x0 == 0 || y0 == 0 || x1 + 1 == width || y1 + 1 == height;
        // Only the surroundings are processed: whole images cost ten times as much.
        let reach = (options.surroundings * camera.fx.max(camera.fy) / nearest.max(0.05)).ceil() as usize;
        let (left, top) = (x0.saturating_sub(reach), y0.saturating_sub(reach));
        let (right, bottom) = ((x1 + 1 + reach).min(width), (y1 + 1 + reach).min(height));
        let rect = Rect {
            x: left as f64,
            y: top as f64,
            width: (right - left) as f64,
            height: (bottom - top) as f64,
        };
        let near = camera.crop(&rect);
        let part = Image::from_fn(right - left, bottom - top, |x, y| depth[(left + x, top + y)]);
        let normals =
            normals_from_depth(&inpaint_depth(&part, options.inpaint_rounds), &near, &options.normals);
        let only = |keep: &dyn Fn(usize, usize) -> bool| {
            Image::from_fn(part.width(), part.height(), |x, y| if keep(x, y) { part[(x, y)] } else { 0.0 })
        };
        let inside = |x: usize, y: usize| mask[(left + x, top + y)];
        let known = |x: usize, y: usize| inside(x, y) && normals[(x, y)] != [0.0; 3];
        let mut object = PointCloud::from_depth(&only(&known), Some(&normals), &near)
            .voxel_downsample(options.step, 60f64.to_radians());
        if object.normals.len() != object.points.len() {
            object.normals.clear();
        }
        // The table's noise exceeds its margin; points that low are represented by the table's plane.
        let above = above_table(&part, &near, table.as_ref(), 1.5 * options.table_margin);
        let obstacles = PointCloud::from_depth(&only(&|x, y| !inside(x, y) && above[(x, y)]), None, &near)
            .voxel_downsample(2.0 * options.step, 1.0);
        let obstacles = PointCloud { points: without_specks(obstacles.points), normals: vec![] };
        GraspView { camera: *camera, depth, mask, table, object, obstacles, step: options.step, cut_by_edge }
    }
}

/// Points with at least two others within 2 cm: flying pixels are isolated.
fn without_specks(points: Vec<Vec3>) -> Vec<Vec3> {
    let tree = sixfold_geometry::KdTree::new(&points);
    points.iter().filter(|p| tree.within(p, 0.02).len() > 3).copied().collect()
}

/// Masks of the objects on the table, largest first.
///
/// # Errors
/// [`ViewError`] for a depth image that is unusable or of another size than the camera, and [`ViewError::NoTable`].
pub fn find_objects(
    depth: &DepthImage,
    camera: &Camera,
    options: &ViewOptions,
) -> Result<Vec<Mask>, ViewError> {
    let depth = checked(depth, camera, options)?;
    let table = find_table(&depth, camera, options)
        .ok_or(ViewError::NoTable { percent: 100.0 * options.plane.min_fraction })?;
    // Objects on the table are above a measured part of it; the background behind the table's edge is not.
    let above = above_table(&depth, camera, Some(&table), options.table_margin);
    let on_table = footprint(&depth, camera, &table, options);
    let candidates = Image::from_fn(depth.width(), depth.height(), |x, y| {
        above[(x, y)] && on_table(&point_at(&depth, camera, x, y))
    });
    let parts = components(&candidates, &depth, camera, options.gap);
    Ok(parts
        .into_iter()
        .filter(|part| part.len() >= options.min_pixels)
        .map(|part| {
            let mut mask = Mask::filled(depth.width(), depth.height(), false);
            for pixel in part {
                mask.as_mut_slice()[pixel] = true;
            }
            mask
        })
        .collect())
}

/// Whether a point is above the measured part of the table: within the bounding box of the table's points along two directions of
/// the plane.
fn footprint(
    depth: &DepthImage,
    camera: &Camera,
    table: &Plane,
    options: &ViewOptions,
) -> impl Fn(&Vec3) -> bool {
    let any = if table.normal.x.abs() < 0.8 { Vec3::x() } else { Vec3::y() };
    let u = table.normal.cross(&any).normalize();
    let v = table.normal.cross(&u);
    let (mut along_u, mut along_v) = (vec![], vec![]);
    for (x, y) in
        (0..depth.height()).step_by(4).flat_map(|y| (0..depth.width()).step_by(4).map(move |x| (x, y)))
    {
        if depth[(x, y)] > 0.0 {
            let p = point_at(depth, camera, x, y);
            if table.distance(&p).abs() < options.plane.threshold {
                along_u.push(u.dot(&p));
                along_v.push(v.dot(&p));
            }
        }
    }
    let range = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        let at = |fraction: f64| {
            values.get((fraction * values.len().saturating_sub(1) as f64) as usize).copied().unwrap_or(0.0)
        };
        (at(0.01), at(0.99))
    };
    let (u_range, v_range) = (range(along_u), range(along_v));
    move |p| {
        let (a, b) = (u.dot(p), v.dot(p));
        a > u_range.0 && a < u_range.1 && b > v_range.0 && b < v_range.1
    }
}

fn checked(depth: &DepthImage, camera: &Camera, options: &ViewOptions) -> Result<DepthImage, ViewError> {
    options.check()?;
    camera.check_lens()?;
    camera.check_image(depth.width(), depth.height())?;
    let depth = usable_depth(depth)?;
    Ok(depth.map(|&z| if f64::from(z) <= options.max_depth { z } else { 0.0 }))
}

fn point_at(depth: &DepthImage, camera: &Camera, x: usize, y: usize) -> Vec3 {
    camera.unproject(&Vec2::new(x as f64, y as f64), f64::from(depth[(x, y)]))
}

/// The plane that most of a depth image shows, taken as the table, its normal towards the camera; from every third pixel in both
/// directions. The depth (metres) is of a camera without distortion. `None` if no plane has enough points.
pub fn find_table(depth: &DepthImage, camera: &Camera, options: &ViewOptions) -> Option<Plane> {
    let thinned = Image::from_fn(depth.width(), depth.height(), |x, y| {
        if x % 3 == 0 && y % 3 == 0 { depth[(x, y)] } else { 0.0 }
    });
    dominant_plane(&PointCloud::from_depth(&thinned, None, camera), &options.plane, options.seed)
}

/// Pixels whose point is more than `margin` above the table; all measured ones without a table.
fn above_table(depth: &DepthImage, camera: &Camera, table: Option<&Plane>, margin: f64) -> Mask {
    Mask::from_fn(depth.width(), depth.height(), |x, y| {
        depth[(x, y)] > 0.0 && table.is_none_or(|t| t.distance(&point_at(depth, camera, x, y)) > margin)
    })
}

/// Connected components, largest first: neighbours are up to two pixels apart and their points closer than `gap`.
fn components(mask: &Mask, depth: &DepthImage, camera: &Camera, gap: f64) -> Vec<Vec<usize>> {
    let (width, height) = mask.size();
    let mut left = mask.as_slice().to_vec();
    let mut parts = vec![];
    for start in 0..left.len() {
        if !left[start] {
            continue;
        }
        left[start] = false;
        let mut part = vec![start];
        let mut queue = VecDeque::from([start]);
        while let Some(pixel) = queue.pop_front() {
            let (x, y) = (pixel % width, pixel / width);
            let here = point_at(depth, camera, x, y);
            for v in y.saturating_sub(2)..(y + 3).min(height) {
                for u in x.saturating_sub(2)..(x + 3).min(width) {
                    let next = v * width + u;
                    if left[next] && (point_at(depth, camera, u, v) - here).norm() < gap {
                        left[next] = false;
                        part.push(next);
                        queue.push_back(next);
                    }
                }
            }
        }
        parts.push(part);
    }
    // A stable sort: parts of equal size keep the order of their first pixels.
    parts.sort_by_key(|part| std::cmp::Reverse(part.len()));
    parts
}

/// Whether two parts are separate objects: no point of one is within 4 cm of the other.
fn apart(a: &[usize], b: &[usize], depth: &DepthImage, camera: &Camera) -> bool {
    let points = |part: &[usize]| -> Vec<Vec3> {
        let width = depth.width();
        part.iter().step_by(3).map(|&i| point_at(depth, camera, i % width, i / width)).collect()
    };
    let tree = sixfold_geometry::KdTree::new(&points(a));
    points(b).iter().all(|p| tree.nearest(p).is_none_or(|n| n.distance > 0.04))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_out_of_range_are_named() {
        let options = ViewOptions::default();
        assert_eq!(options.check(), Ok(()));
        let named = |options: ViewOptions| options.check().unwrap_err().option;
        assert_eq!(named(ViewOptions { max_depth: f64::NAN, ..options }), "max_depth");
        assert_eq!(named(ViewOptions { gap: 0.0, ..options }), "gap");
    }
}
