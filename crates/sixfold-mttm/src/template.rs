//! A template: the appearance of an object from one side, as a small depth image around a point of its surface.
//!
//! The *view frame* has its origin at that reference point and its z axis along the ray through it. A patch spans a fixed metric
//! size at the reference point's distance, so a template looks the same from any distance (dissertation, section 5.2.4:
//! ROIs of fixed metric size).

use serde::{Deserialize, Serialize};
use sixfold_geometry::{
    Camera, DepthImage, NormalOptions, OptionError, PointCloud, Pose, Vec2, Vec3, normals_from_depth,
};

use crate::views::ViewCoverage;

/// Pixels along a side of a template; chosen by hand, not swept.
pub const SIDE: usize = 64;
/// Quantisation step of stored depth, metres: well below the depth noise.
const DEPTH_STEP: f64 = 1e-4;
/// Stored depth of the reference point; 0 is "nothing seen".
const DEPTH_ZERO: i32 = 32_768;
/// Width in metres of the windows over which normals are computed, about the same for scenes and templates. Chosen by hand; not
/// swept.
const NORMAL_REACH: f64 = 0.008;

/// How templates are made.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TemplateOptions {
    /// Directions from which a mesh is rendered.
    pub coverage: ViewCoverage,
    /// Side of a patch as a fraction of the object's diameter (the largest extent for objects from depth images).
    pub margin: f64,
    /// Distance from which a mesh is rendered, metres.
    pub distance: f64,
}

/// Radii of the window of a template's normals, pixels: the smallest and the largest. Chosen by hand; not swept.
const NORMAL_RADII: (f64, f64) = (1.0, 4.0);
/// [`TemplateOptions::margin`]: slightly larger than the object from any side. Chosen by hand; not swept.
const MARGIN: f64 = 1.1;
/// [`TemplateOptions::distance`]: about that of objects on a table. Chosen by hand; not swept.
const DISTANCE: f64 = 0.8;

impl Default for TemplateOptions {
    fn default() -> Self {
        TemplateOptions { coverage: ViewCoverage::Above, margin: MARGIN, distance: DISTANCE }
    }
}

impl TemplateOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_within("templates.margin", self.margin, 0.5..=5.0, "0.5 to 5 diameters")?;
        OptionError::unless_within("templates.distance", self.distance, 0.05..=20.0, "0.05 m to 20 m")
    }
}

/// Where templates came from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// Rendered from a mesh.
    Mesh,
    /// Cut out of depth images whose poses are known.
    PosedDepth,
    /// Cut out of depth images without poses: every view has an object frame of its own, parallel to its view frame, with its
    /// origin at the centre of the visible points.
    Depth,
}

/// An object seen from one direction.
#[derive(Debug, Clone, PartialEq)]
pub struct Template {
    /// From the object's frame to the view frame.
    pub view_from_object: Pose,
    /// Distance of the reference point from the camera, metres.
    pub distance: f64,
    /// Depth relative to the reference point's, row by row, in steps of 0.1 mm from 32768 on; 0 where the object is
    /// not seen.
    pub depth: Vec<u16>,
}

/// All templates of an object.
#[derive(Debug, Clone, PartialEq)]
pub struct ObjectTemplates {
    /// Diameter of the object, metres (the largest visible extent for objects from depth images).
    pub diameter: f64,
    /// Side of a patch at the reference point's distance, metres.
    pub size: f64,
    /// How they were made.
    pub options: TemplateOptions,
    /// What they were made from.
    pub source: Source,
    /// A hash of the mesh and the options they were made from; 0 for depth images.
    pub made_from: u64,
    /// The views, without in-plane rotations, which are computed.
    pub templates: Vec<Template>,
}

impl ObjectTemplates {
    /// In-plane rotations at which every view is matched, radians.
    pub fn turns(&self) -> Vec<f64> {
        match self.source {
            Source::Mesh => self.options.coverage.turns(),
            // The camera may be rolled relative to a recorded view, but is seldom upside down.
            Source::PosedDepth | Source::Depth => ViewCoverage::Above.turns(),
        }
    }
}

impl Template {
    /// The depth of a pixel relative to the reference point, metres.
    pub fn relative_depth(&self, column: usize, row: usize) -> Option<f64> {
        match self.depth[row * SIDE + column] {
            0 => None,
            stored => Some(f64::from(i32::from(stored) - DEPTH_ZERO) * DEPTH_STEP),
        }
    }

    /// Relative depth as it is stored.
    pub(crate) fn stored(relative: f64) -> u16 {
        let steps = (relative / DEPTH_STEP).round() as i32 + DEPTH_ZERO;
        steps.clamp(1, i32::from(u16::MAX)) as u16
    }

    /// The camera of the patch; the view frame lies `distance` in front of it.
    pub fn camera(&self, size: f64) -> Camera {
        patch_camera(size, self.distance)
    }

    /// The patch as a depth image of [`Template::camera`], metres.
    pub(crate) fn depth_image(&self) -> DepthImage {
        DepthImage::from_fn(SIDE, SIDE, |x, y| {
            self.relative_depth(x, y).map_or(0.0, |z| (self.distance + z) as f32)
        })
    }

    /// The visible surface in the view frame: points and normals of pixels with a normal, row by row, with their columns and rows.
    pub fn cloud(&self, size: f64) -> (PointCloud, Vec<[usize; 2]>) {
        let (camera, depth) = (self.camera(size), self.depth_image());
        let radius =
            (NORMAL_REACH * SIDE as f64 / size).round().clamp(NORMAL_RADII.0, NORMAL_RADII.1) as usize;
        let normals = normals_from_depth(&depth, &camera, &NormalOptions { radius, ..Default::default() });
        let (mut cloud, mut pixels) = (PointCloud::default(), vec![]);
        for y in 0..SIDE {
            for x in 0..SIDE {
                let (z, n) = (depth[(x, y)], normals[(x, y)]);
                if z > 0.0 && n != [0.0; 3] {
                    let p = camera.unproject(&Vec2::new(x as f64, y as f64), f64::from(z));
                    cloud.points.push(p - Vec3::z() * self.distance);
                    cloud.normals.push(Vec3::from(n.map(f64::from)));
                    pixels.push([x, y]);
                }
            }
        }
        (cloud, pixels)
    }
}

/// A camera of [`SIDE`] pixels whose image spans `size` metres at `distance`.
pub(crate) fn patch_camera(size: f64, distance: f64) -> Camera {
    let focal = SIDE as f64 * distance / size;
    let centre = (SIDE as f64 - 1.0) / 2.0;
    Camera { fx: focal, fy: focal, cx: centre, cy: centre, width: SIDE, height: SIDE, distortion: None }
}

/// The pixel of a mask nearest to its centroid.
pub(crate) fn central_pixel(pixels: &[[usize; 2]]) -> Option<[usize; 2]> {
    let n = pixels.len() as f64;
    let mean = |k: usize| pixels.iter().map(|p| p[k] as f64).sum::<f64>() / n;
    let (x, y) = (mean(0), mean(1));
    let off = |p: &[usize; 2]| (p[0] as f64 - x).powi(2) + (p[1] as f64 - y).powi(2);
    pixels.iter().copied().min_by(|a, b| off(a).total_cmp(&off(b)))
}
