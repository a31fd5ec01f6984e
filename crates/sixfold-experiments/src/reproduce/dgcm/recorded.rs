//! Recorded depth images with annotated grasps, for figure 6.7: what the dissertation's LfED-6D holds (section 6.3.1), in a list
//! of our own.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use serde::Deserialize;
use sixfold_geometry::Pose;
use sixfold_grasp::{Grasp, GraspView, Gripper};
use sixfold_io::{fnv1a, limits, read_regular_text};

use sixfold_shell::grasp::input::{self, InputArguments};

use super::offline::{Instance, Shape, wanted};

/// One image of the list, with a grasp on it. Files are relative to the list.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Image {
    class: String,
    object: String,
    depth: PathBuf,
    camera: PathBuf,
    /// By default the largest object on the table.
    #[serde(default)]
    mask: Option<PathBuf>,
    /// Row by row, metres; the gripper approaches along its z axis and closes along its x axis.
    camera_from_gripper: [[f64; 4]; 4],
    /// The object's width between the pads, metres.
    width: f64,
}

/// The objects of a list in its order, each with all its images, and a hash of the list.
///
/// # Errors
/// When the list or one of its files cannot be read, an object has two classes or a single image, or a grasp is none.
pub(super) fn instances(list: &Path, gripper: &Gripper) -> Result<(Vec<Instance>, u64)> {
    let file = list.display();
    let text = read_regular_text(list, limits::LARGE_TEXT).with_context(|| format!("--recorded {file}"))?;
    let images: Vec<Image> = serde_json::from_str(&text).with_context(|| {
        format!(
            "{file}: expected a list of images, each with class, object, depth, camera, mask (optional), camera_from_gripper and \
             width"
        )
    })?;
    let folder = list.parent().unwrap_or(Path::new(""));
    let mut instances: Vec<Instance> = vec![];
    for (number, image) in images.iter().enumerate() {
        let view = image.view(folder, gripper).with_context(|| format!("{file}: image {}", number + 1))?;
        match instances.iter_mut().find(|i| i.name == image.object) {
            None => instances.push(Instance {
                class: image.class.clone(),
                name: image.object.clone(),
                shape: Shape::Recorded(vec![view]),
            }),
            Some(other) if other.class != image.class => bail!(
                "{file}: image {}, class: found {} for object {}, expected {} as before",
                number + 1,
                image.class,
                image.object,
                other.class
            ),
            Some(other) => {
                if let Shape::Recorded(views) = &mut other.shape {
                    views.push(view);
                }
            }
        }
    }
    if let Some(single) = instances.iter().find(|i| matches!(&i.shape, Shape::Recorded(v) if v.len() < 2)) {
        bail!(
            "{file}: found 1 image of object {}, expected at least 2: one for the experience, one to be tested",
            single.name
        );
    }
    if instances.is_empty() {
        bail!("{file}: found no image");
    }
    Ok((instances, fnv1a(text.as_bytes())))
}

impl Image {
    fn view(&self, folder: &Path, gripper: &Gripper) -> Result<(Arc<GraspView>, Grasp)> {
        let pose = Pose::from_rows(&self.camera_from_gripper).context("camera_from_gripper")?;
        if !(self.width > 0.0 && self.width <= gripper.max_opening) {
            bail!(
                "width: found {} m, expected above 0 and at most {} m, which {} can open",
                self.width,
                gripper.max_opening,
                gripper.name
            );
        }
        let files = InputArguments {
            depth: folder.join(&self.depth),
            camera: folder.join(&self.camera),
            depth_scale: None,
            mask: self.mask.as_ref().map(|mask| folder.join(mask)),
        };
        let Some(view) = input::read(&files, None, 0)?.view else {
            bail!("{}: no object found on the table; give mask", files.depth.display());
        };
        Ok((Arc::new(view), wanted(pose, self.width, gripper)))
    }
}
