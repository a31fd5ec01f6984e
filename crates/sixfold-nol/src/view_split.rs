//! New views of an object as a training set in BOP format (K. Park, dissertation, section 4.3).

use std::io;
use std::path::{Path, PathBuf};

use sixfold_bop::{DatasetError, GroundTruth, GroundTruthInfo, NewImage, SceneWriter};
use sixfold_data::{PosedImage, RoughObject};
use sixfold_geometry::random::stream;
use sixfold_geometry::{Camera, Mask, Pose, Progress, RgbImage};
use sixfold_mesh::Mesh;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};
use sixfold_synth::augment::Backgrounds;

use crate::coordinates::write_coordinates;
use crate::error::NolError;
use crate::source::SourceView;
use crate::synthesis::ViewMaker;
use crate::view_grid::{ViewGrid, over_background};

/// Number of images of an object in the preview.
const PREVIEWED: usize = 10;

/// Why views cannot be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ViewSplitError {
    /// A photograph cannot be used.
    #[error(transparent)]
    Image(#[from] NolError),
    /// The dataset cannot be written.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// Object coordinates cannot be written.
    #[error("{}", path.display())]
    Coordinates {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
}

/// A split of a dataset whose scenes are objects, each seen in new views.
pub struct ViewSplit<'a> {
    /// Folder of the dataset.
    pub dataset: &'a Path,
    /// Name of the split.
    pub split: &'a str,
    /// Viewpoints.
    pub grid: ViewGrid,
    /// Backgrounds of the views.
    pub backgrounds: &'a Backgrounds,
    /// Add the photographs themselves, cropped to the object, after the views.
    pub with_photographs: bool,
}

/// Summary of the written views of one object.
pub struct WrittenViews {
    /// Number of images.
    pub images: usize,
    /// Fraction of the object's pixels in all views that no photograph shows.
    pub unseen: f64,
    /// Some of the images, each with a text.
    pub preview: Vec<(RgbImage, String)>,
    /// Camera of the first image.
    pub camera: Option<Camera>,
}

impl ViewSplit<'_> {
    /// The folder of the object's scene.
    fn folder(&self, id: u32) -> PathBuf {
        self.dataset.join(self.split).join(format!("{id:06}"))
    }

    /// Renders all views of one object. Existing images are not rendered again. `progress` is called for every image; `None` if it
    /// stopped the run.
    ///
    /// # Errors
    /// When an image cannot be written, or a photograph to be added cannot be used.
    pub fn write(
        &self,
        object: &RoughObject,
        maker: &ViewMaker<'_>,
        progress: &dyn Progress,
    ) -> Result<Option<WrittenViews>, ViewSplitError> {
        let ViewGrid { size, seed, .. } = self.grid;
        let photographs: Vec<&PosedImage> = object.images.iter().map(|i| &i.posed).collect();
        let places = self.grid.placed(&object.mesh, &photographs, object.id);
        let mut writer = SceneWriter::new(self.dataset, self.split, object.id);
        let mut written = WrittenViews { images: 0, unseen: 0.0, preview: vec![], camera: None };
        let every = places.len().div_ceil(PREVIEWED).max(1);
        for (number, place) in places.iter().enumerate() {
            let im_id = number as u32;
            let Some((camera, pose)) = *place else { continue };
            let image_file = self.folder(object.id).join("rgb").join(format!("{im_id:06}.png"));
            let coordinates = self.folder(object.id).join("coordinates").join(format!("{im_id:06}.png"));
            // The coordinates are written last: if they exist, so do the other files.
            let there = coordinates.exists() && image_file.exists();
            let previewed = number % every == every / 2;
            let (mask, image) = if there && !previewed {
                (silhouette(&object.mesh, &camera, &pose), None)
            } else {
                let view = maker.render(&camera, &pose);
                written.unseen += view.unseen_fraction();
                let mut random = stream(seed ^ 0x6e6f_6c00 ^ u64::from(object.id), u64::from(im_id));
                let image = over_background(&view, self.backgrounds.patch(size, size, &mut random));
                if previewed {
                    let percent = (100.0 * view.unseen_fraction()).round();
                    let text = if percent >= 1.0 { format!("{percent:.0} % unseen") } else { String::new() };
                    written.preview.push((view.patch.to_rgb(), text));
                }
                (view.mask, Some(image))
            };
            add(&mut writer, object, im_id, &camera, &pose, &mask, image.as_ref())?;
            if !there {
                write_coordinates(&coordinates, &object.mesh, &camera, &pose)
                    .map_err(|source| ViewSplitError::Coordinates { path: coordinates, source })?;
            }
            written.images += 1;
            written.camera.get_or_insert(camera);
            if !progress.report(written.images, places.len()) {
                return Ok(None);
            }
        }
        if self.with_photographs {
            for (k, image) in object.images.iter().enumerate() {
                let im_id = (places.len() + k) as u32;
                written.images +=
                    usize::from(add_photograph(size, &mut writer, object, im_id, &image.posed)?);
            }
        }
        writer.finish()?;
        written.unseen /= places.len().max(1) as f64;
        Ok(Some(written))
    }
}

/// Adds a photograph, cropped to the object, to the dataset.
fn add_photograph(
    size: usize,
    writer: &mut SceneWriter,
    object: &RoughObject,
    im_id: u32,
    photograph: &PosedImage,
) -> Result<bool, ViewSplitError> {
    let pose = *photograph.camera_from_object();
    let view = SourceView::new(photograph, &object.mesh, size)?;
    let mask = Mask::from_fn(size, size, |x, y| {
        view.visible.data[y * size + x] > 0.5 && view.depth()[y * size + x] > 0.0
    });
    if !mask.as_slice().contains(&true) {
        return Ok(false);
    }
    add(writer, object, im_id, &view.camera, &pose, &mask, Some(&view.patch.to_rgb()))?;
    Ok(true)
}

fn silhouette(mesh: &Mesh, camera: &Camera, pose: &Pose) -> Mask {
    let mut frame = VisibilityBuffer::new(camera);
    frame.render(&[SceneObject { mesh, camera_from_object: *pose }], &RenderOptions::default());
    frame.mask(0)
}

fn add(
    writer: &mut SceneWriter,
    object: &RoughObject,
    im_id: u32,
    camera: &Camera,
    pose: &Pose,
    visible: &Mask,
    image: Option<&RgbImage>,
) -> Result<(), DatasetError> {
    let whole = silhouette(&object.mesh, camera, pose);
    let info = GroundTruthInfo::of_masks(&whole, visible);
    let truth = [GroundTruth::new(object.id, *pose)];
    let (whole, visible) = ([whole], [visible.clone()]);
    writer.add(&NewImage {
        rgb: image,
        ground_truth: &truth,
        info: Some(&[info]),
        masks: image.is_some().then_some(&whole[..]),
        masks_visible: image.is_some().then_some(&visible[..]),
        ..NewImage::new(im_id, camera)
    })
}
