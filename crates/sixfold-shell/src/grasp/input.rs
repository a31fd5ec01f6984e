//! A depth image from files, prepared for grasping.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use sixfold_geometry::{Camera, DepthImage, RgbImage, undistort_depth, undistort_rgb};
use sixfold_grasp::{GraspView, ViewOptions, find_objects};
use sixfold_io::{CameraFile, read_depth, read_mask, read_rgb};

use crate::ranges;

/// A depth image and what belongs to it.
#[derive(Debug, Args)]
pub struct InputArguments {
    /// Depth image: PNG, one channel of 16 bits
    #[arg(long, value_name = "FILE")]
    pub depth: PathBuf,
    /// Camera: a file of BOP, OpenCV or ROS (docs/cameras.md), and depth_scale (millimetres per unit of the depth image)
    #[arg(long, value_name = "FILE")]
    pub camera: PathBuf,
    /// Millimetres per unit of the depth image, in place of the camera file's depth_scale
    #[arg(long, value_name = "MM", value_parser = ranges::depth_scale)]
    pub depth_scale: Option<f64>,
    /// The object's mask: PNG, above zero inside (default: the largest object on the table)
    #[arg(long, value_name = "FILE")]
    pub mask: Option<PathBuf>,
}

/// The input of a grasp command, without lens distortion.
pub struct Input {
    /// Depth image, metres.
    pub depth: DepthImage,
    /// The camera of all images.
    pub camera: Camera,
    /// The colour image, if given.
    pub rgb: Option<RgbImage>,
    /// The view of the object; `None` when nothing is on the table.
    pub view: Option<GraspView>,
    /// Time at which the files were read and computation began.
    pub began: std::time::Instant,
}

/// Reads and prepares the view of the masked object, or of the largest object on the table; `rgb`: a colour image for
/// overlays.
///
/// # Errors
/// For files that cannot be read or do not belong together.
pub fn read(a: &InputArguments, rgb: Option<&Path>, seed: u64) -> Result<Input> {
    let file = CameraFile::read(&a.camera)?;
    let scale = a.depth_scale.or(file.depth_scale).ok_or_else(|| {
        anyhow!(
            "{}: field depth_scale is missing: give it there or as --depth-scale (millimetres per unit of the depth image: 1 for most cameras)",
            a.camera.display()
        )
    })?;
    if !(scale > 0.0 && scale.is_finite()) {
        bail!("--depth-scale: found {scale}, expected above 0");
    }
    let depth = read_depth(&a.depth, scale / 1000.0)?;
    let camera = file.for_image(depth.width(), depth.height(), &a.camera)?;
    let depth = undistort_depth(&depth, &camera)?;
    let rgb = match rgb {
        None => None,
        Some(path) => {
            Some(undistort_rgb(&read_rgb(path)?, &camera).with_context(|| path.display().to_string())?)
        }
    };
    let camera = camera.without_distortion();
    let began = std::time::Instant::now();
    let options = ViewOptions { seed, ..ViewOptions::default() };
    let mask = match &a.mask {
        Some(path) => Some(read_mask(path)?),
        None => find_objects(&depth, &camera, &options)
            .with_context(|| a.depth.display().to_string())?
            .into_iter()
            .next(),
    };
    let where_from = a.mask.as_ref().unwrap_or(&a.depth).display().to_string();
    let view = match &mask {
        Some(mask) => Some(GraspView::new(&depth, &camera, mask, &options).context(where_from)?),
        None => None,
    };
    if view.as_ref().is_some_and(|v| v.cut_by_edge) {
        eprintln!("note: the image cuts the object off: the part outside was not seen");
    }
    Ok(Input { depth, camera, rgb, view, began })
}
