//! Objects that are known from depth images alone: reading the files and making templates of them.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use serde::Serialize;
use sixfold_geometry::{Camera, DepthImage, Mask, Pose, undistort_depth};
use sixfold_io::{CameraFile, read_depth, read_mask};
use sixfold_mttm::mask_check::{CheckedMask, WORTH_A_WARNING, check_mask};
use sixfold_mttm::{DepthView, ObjectTemplates, TemplateOptions};

use crate::ranges;

/// An object known from depth images, for `sixfold object add`.
#[derive(Debug, Args)]
pub struct DepthViewArguments {
    /// Depth images of an object that has no mesh: its templates for `estimate --method mttm`
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with = "mesh", requires = "masks", requires = "camera")]
    pub depth: Vec<PathBuf>,
    /// Masks of the object in the depth images (PNG, above zero inside), in the same order
    #[arg(long = "mask", value_name = "FILE", num_args = 1.., requires = "depth", conflicts_with = "mesh")]
    pub masks: Vec<PathBuf>,
    /// Use masks unchanged. By default they are checked against depth: the table and surfaces beyond depth edges are removed,
    /// and a mask that is more than a third too large is refused
    #[arg(long, requires = "depth", conflicts_with = "mesh")]
    pub mask_as_is: bool,
    /// Camera of the depth images: a file of BOP, OpenCV or ROS (docs/cameras.md), and depth_scale
    #[arg(long, value_name = "FILE", requires = "depth", conflicts_with = "mesh")]
    pub camera: Option<PathBuf>,
    /// Millimetres per unit of the depth images, in place of the camera file's depth_scale
    #[arg(long, value_name = "MM", requires = "depth", conflicts_with = "mesh", value_parser = ranges::depth_scale)]
    pub depth_scale: Option<f64>,
    /// The object's pose in each image, if known: a JSON file with a list of 4x4 matrices camera_from_object, row by row, in
    /// metres (default: every view has a frame of its own)
    #[arg(long, value_name = "FILE", requires = "depth", conflicts_with = "mesh")]
    pub poses: Option<PathBuf>,
}

struct Read {
    depth: DepthImage,
    camera: Camera,
    mask: Mask,
    pose: Option<Pose>,
}

/// What was left out of a mask, as fractions of its pixels with depth.
#[derive(Debug, Serialize)]
pub struct LeftOut {
    mask: String,
    /// On the plane around the object.
    on_plane: f64,
    /// Beyond a depth edge.
    beyond_edges: f64,
}

/// A mask without the pixels that depth shows to belong to something else; warns where many were removed.
fn checked(path: &Path, depth: &DepthImage, camera: &Camera, mask: &Mask) -> Result<(Mask, LeftOut)> {
    let file = path.display().to_string();
    let advice = || format!("{file}: too large a mask (--mask-as-is takes it as it is)");
    let CheckedMask { mask, on_plane, beyond_edges } =
        check_mask(depth, camera, mask).with_context(advice)?;
    if on_plane + beyond_edges >= WORTH_A_WARNING {
        eprintln!(
            "warning: {file}: left out {:.0} % of the mask on the plane around the object and {:.0} % beyond a depth edge; \
             --mask-as-is takes it as it is",
            100.0 * on_plane,
            100.0 * beyond_edges
        );
    }
    Ok((mask, LeftOut { mask: file, on_plane, beyond_edges }))
}

/// The templates of an object in depth images, and what was left out of its masks.
///
/// # Errors
/// When a file is missing or does not fit the others; the message names option or file.
pub fn templates_of(a: &DepthViewArguments) -> Result<(ObjectTemplates, Vec<LeftOut>)> {
    let camera_path = a.camera.as_deref().ok_or_else(|| anyhow!("--camera FILE is missing"))?;
    let file = CameraFile::read(camera_path)?;
    let scale = a.depth_scale.or(file.depth_scale).ok_or_else(|| {
        anyhow!("{}: field depth_scale is missing: give it there or as --depth-scale", camera_path.display())
    })?;
    if !(scale > 0.0 && scale.is_finite()) {
        bail!("--depth-scale: found {scale}, expected above 0");
    }
    if a.masks.len() != a.depth.len() {
        bail!(
            "--mask: found {} masks for {} depth images, expected one for each: a template needs the mask \
             of the object",
            a.masks.len(),
            a.depth.len()
        );
    }
    let poses = a.poses.as_deref().map(read_poses).transpose()?;
    if let Some(poses) = &poses
        && poses.len() != a.depth.len()
    {
        bail!(
            "--poses: found {} poses for {} depth images, expected one for each",
            poses.len(),
            a.depth.len()
        );
    }
    let (mut read, mut left_out) = (vec![], vec![]);
    for (i, (depth_file, mask_file)) in a.depth.iter().zip(&a.masks).enumerate() {
        let depth = read_depth(depth_file, scale / 1000.0)?;
        let camera = file.for_image(depth.width(), depth.height(), camera_path)?;
        let depth = undistort_depth(&depth, &camera)?;
        let mask = read_mask(mask_file)?;
        camera.check_image(mask.width(), mask.height()).with_context(|| mask_file.display().to_string())?;
        let camera = camera.without_distortion();
        let mask = if a.mask_as_is {
            mask
        } else {
            let (mask, out) = checked(mask_file, &depth, &camera, &mask)?;
            left_out.push(out);
            mask
        };
        read.push(Read { depth, camera, mask, pose: poses.as_ref().map(|p| p[i]) });
    }
    let views: Vec<DepthView<'_>> = read
        .iter()
        .map(|r| DepthView { depth: &r.depth, camera: &r.camera, mask: &r.mask, camera_from_object: r.pose })
        .collect();
    let names: Vec<String> = a.depth.iter().map(|f| f.display().to_string()).collect();
    let templates = ObjectTemplates::from_depth(&views, &TemplateOptions::default());
    Ok((templates.with_context(|| names.join(", "))?, left_out))
}

fn read_poses(path: &Path) -> Result<Vec<Pose>> {
    let text = sixfold_io::read_regular_text(path, sixfold_io::limits::SMALL_TEXT)
        .with_context(|| path.display().to_string())?;
    let rows: Vec<[[f64; 4]; 4]> = serde_json::from_str(&text)
        .with_context(|| format!("{}: expected a list of 4x4 matrices, row by row", path.display()))?;
    rows.iter()
        .enumerate()
        .map(|(i, m)| Pose::from_rows(m).with_context(|| format!("{}: pose {}", path.display(), i + 1)))
        .collect()
}
