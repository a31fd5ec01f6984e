//! Errors of templates and of template files.

use std::io;
use std::path::PathBuf;

use sixfold_geometry::{CameraError, OptionError};
use thiserror::Error;

/// Why templates could not be made.
#[derive(Debug, Error, Clone, PartialEq)]
#[non_exhaustive]
pub enum TemplateError {
    /// An option is out of its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The mesh has no surface to render.
    #[error("the mesh has {faces} faces, templates need a surface: give a mesh, not a point cloud")]
    NoSurface {
        /// Faces found.
        faces: usize,
    },
    /// The camera has another image size.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// The mask has another image size.
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
    /// Too few pixels of the object have depth.
    #[error(
        "only {found} of the mask's {pixels} pixels have depth, at least {needed} are needed: is it the mask of this image, and is the depth there?"
    )]
    TooLittleDepth {
        /// Pixels of the mask with depth.
        found: usize,
        /// Pixels of the mask.
        pixels: usize,
        /// Pixels needed.
        needed: usize,
    },
    /// Much of the mask does not show the object.
    #[error(
        "{:.0} % of the mask lies on the plane around it and {:.0} % beyond a depth edge, at most {:.0} % are left out: cut it closer to the object",
        100.0 * on_plane, 100.0 * beyond_edges, 100.0 * maximum
    )]
    MaskTooLarge {
        /// Fraction of its pixels with depth on the plane that surrounds it.
        on_plane: f64,
        /// Fraction beyond a depth edge, on surfaces that continue outside the mask.
        beyond_edges: f64,
        /// Largest fraction that may be left out.
        maximum: f64,
    },
    /// The object in the mask has a size that no tabletop object has.
    #[error(
        "the surface in the mask is {found:.3} m large, expected {low} m to {high} m: is the depth scale \
         right, and does the mask hold one object only?"
    )]
    Size {
        /// Largest extent in metres.
        found: f64,
        /// Smallest extent accepted.
        low: f64,
        /// Largest extent accepted.
        high: f64,
    },
    /// There are more views than a file can contain templates.
    #[error("found {found} views, expected at most {maximum}: leave out views that look nearly the same")]
    TooManyViews {
        /// Views found.
        found: usize,
        /// Most views accepted.
        maximum: usize,
    },
    /// No view was given.
    #[error("no view of the object was given")]
    NoViews,
    /// Some views have a pose and some do not.
    #[error("view {view} has {found} pose, the first view {first}: poses for all views or for none")]
    MixedPoses {
        /// Number of the view.
        view: usize,
        /// "a" or "no".
        found: &'static str,
        /// "has one" or "has none".
        first: &'static str,
    },
}

/// Why a file of templates cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum StoreError {
    /// The file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// Not a file of templates, or damaged.
    #[error("{}: {what}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: &'static str,
    },
    /// A file of another format version.
    #[error(
        "{}: written by another version of sixfold: found format {found}, expected {expected}",
        path.display()
    )]
    Version {
        /// The file.
        path: PathBuf,
        /// Format found.
        found: u32,
        /// Format expected.
        expected: u32,
    },
    /// The templates cannot be used, and there is no mesh to render them again.
    #[error(
        "the templates of an object without a mesh cannot be used; make them again with `sixfold object add {object} --depth FILE --mask FILE --camera FILE --replace`"
    )]
    OnlyTemplates {
        /// The object.
        object: String,
        /// What is wrong with the file.
        source: Box<StoreError>,
    },
    /// An intact file of this version, but made from other templates or by another network.
    #[error("{}: made from other templates or by another network", path.display())]
    OtherInput {
        /// The file.
        path: PathBuf,
    },
}
