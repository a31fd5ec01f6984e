//! Writes the views of an object as the images of a BOP training set.

use std::path::PathBuf;

use anyhow::{Context, Result};
use sixfold_bop::{GroundTruth, GroundTruthInfo, NewImage, SceneWriter};
use sixfold_data::{PosedImage, RoughObject};
use sixfold_geometry::random::stream;
use sixfold_geometry::{Camera, Mask, Pose, RgbImage};
use sixfold_mesh::Mesh;
use sixfold_nol::SourceView;
use sixfold_nol::coordinates::write_coordinates;
use sixfold_nol::synthesis::ViewMaker;
use sixfold_nol::view_grid::over_background;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};
use sixfold_synth::augment::Backgrounds;

use super::arguments::SynthesizeArguments;
use sixfold_shell::progress::{Progress, check_interrupt};

/// Images of an object in the preview.
const PREVIEWED: usize = 10;

/// What was written of one object.
pub(super) struct Written {
    pub images: usize,
    /// Fraction of the object's pixels in all views that no photograph shows.
    pub unseen: f64,
    /// Some of the images with a text each.
    pub preview: Vec<(RgbImage, String)>,
    /// Of the first image.
    pub camera: Option<Camera>,
}

/// The folder of the object's scene.
fn folder(a: &SynthesizeArguments, id: u32) -> PathBuf {
    a.out.join(&a.new_split).join(format!("{id:06}"))
}

/// Renders all views of one object. Images that are there already are not rendered again.
pub(super) fn write(
    a: &SynthesizeArguments,
    object: &RoughObject,
    maker: &ViewMaker<'_>,
    backgrounds: &Backgrounds,
    progress: &mut Progress,
) -> Result<Written> {
    let photographs: Vec<&PosedImage> = object.images.iter().map(|i| &i.posed).collect();
    let places = a.grid().placed(&object.mesh, &photographs, object.id);
    let mut writer = SceneWriter::new(&a.out, &a.new_split, object.id);
    let mut written = Written { images: 0, unseen: 0.0, preview: vec![], camera: None };
    let every = places.len().div_ceil(PREVIEWED).max(1);
    for (number, place) in places.iter().enumerate() {
        check_interrupt("give the same command again to continue")?;
        let im_id = number as u32;
        let Some((camera, pose)) = *place else { continue };
        let image_file = folder(a, object.id).join("rgb").join(format!("{im_id:06}.png"));
        let coordinates = folder(a, object.id).join("coordinates").join(format!("{im_id:06}.png"));
        // The coordinates are written last: where they are, all is.
        let there = coordinates.exists() && image_file.exists();
        let previewed = number % every == every / 2;
        let (mask, image) = if there && !previewed {
            (silhouette(&object.mesh, &camera, &pose), None)
        } else {
            let view = maker.render(&camera, &pose);
            written.unseen += view.unseen_fraction();
            let mut random = stream(a.seed ^ 0x6e6f_6c00 ^ u64::from(object.id), u64::from(im_id));
            let image = over_background(&view, backgrounds.patch(a.size, a.size, &mut random));
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
                .with_context(|| coordinates.display().to_string())?;
        }
        written.images += 1;
        written.camera.get_or_insert(camera);
        progress.step(format!("object {}", object.id));
    }
    if a.with_photographs {
        for (k, image) in object.images.iter().enumerate() {
            let im_id = (places.len() + k) as u32;
            written.images += usize::from(add_photograph(a, &mut writer, object, im_id, &image.posed)?);
        }
    }
    writer.finish()?;
    written.unseen /= places.len().max(1) as f64;
    Ok(written)
}

/// A photograph cut to the object, as an image of the dataset.
fn add_photograph(
    a: &SynthesizeArguments,
    writer: &mut SceneWriter,
    object: &RoughObject,
    im_id: u32,
    photograph: &PosedImage,
) -> Result<bool> {
    let pose = *photograph.camera_from_object();
    let view = SourceView::new(photograph, &object.mesh, a.size)?;
    let size = a.size;
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
) -> Result<()> {
    let whole = silhouette(&object.mesh, camera, pose);
    let info = GroundTruthInfo::of_masks(&whole, visible);
    let truth = [GroundTruth::new(object.id, *pose)];
    let (whole, visible) = ([whole], [visible.clone()]);
    Ok(writer.add(&NewImage {
        rgb: image,
        ground_truth: &truth,
        info: Some(&[info]),
        masks: image.is_some().then_some(&whole[..]),
        masks_visible: image.is_some().then_some(&visible[..]),
        ..NewImage::new(im_id, camera)
    })?)
}
