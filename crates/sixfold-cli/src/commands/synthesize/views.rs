//! Writes the views of an object as the images of a BOP training set.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use sixfold_bop::{GroundTruth, GroundTruthInfo, NewImage, SceneWriter};
use sixfold_data::PosedImage;
use sixfold_geometry::random::stream;
use sixfold_geometry::{Camera, Mask, Pose, Rect, RgbImage, Vec3};
use sixfold_mesh::Mesh;
use sixfold_nol::SourceView;
use sixfold_nol::synthesis::ViewMaker;
use sixfold_nol::view_grid::{ViewGrid, over_background};
use sixfold_render::{BoundingBoxScale, RenderOptions, SceneObject, VisibilityBuffer};
use sixfold_synth::augment::Backgrounds;

use super::arguments::SynthesizeArguments;
use super::input::Subject;
use sixfold_shell::progress::{Progress, check_interrupt};

/// Images of an object in the preview.
const PREVIEWED: usize = 10;

/// What was written of one object.
pub(super) struct Written {
    pub images: usize,
    /// Fraction of the object's pixels in all views that no photograph shows.
    pub unseen: f64,
    pub preview: Vec<(RgbImage, String)>,
}

/// Where the views are taken from.
pub(super) fn grid(a: &SynthesizeArguments) -> ViewGrid {
    let (step, elevation) = (a.step, [a.elevation[0], a.elevation[1]]);
    ViewGrid { step, elevation, turns: a.turns, size: a.size, seed: a.seed }
}

/// The folder of the object's scene.
fn folder(a: &SynthesizeArguments, id: u32) -> PathBuf {
    a.out.join(&a.new_split).join(format!("{id:06}"))
}

/// Renders all views of one object. Images that are there already are not rendered again.
pub(super) fn write(
    a: &SynthesizeArguments,
    subject: &Subject,
    maker: &ViewMaker<'_>,
    backgrounds: &Backgrounds,
    progress: &mut Progress,
) -> Result<Written> {
    let photographs: Vec<&PosedImage> = subject.photographs.iter().map(|s| &s.photograph).collect();
    let places = grid(a).placed(&subject.mesh, &photographs, subject.id);
    let mut writer = SceneWriter::new(&a.out, &a.new_split, subject.id);
    let mut written = Written { images: 0, unseen: 0.0, preview: vec![] };
    let every = places.len().div_ceil(PREVIEWED).max(1);
    let scale = {
        let (low, high) = subject.mesh.bounding_box();
        BoundingBoxScale::of_corners(&low, &high)
    };
    for (number, place) in places.iter().enumerate() {
        check_interrupt("give the same command again to continue")?;
        let im_id = number as u32;
        let Some((camera, pose)) = *place else { continue };
        let image_file = folder(a, subject.id).join("rgb").join(format!("{im_id:06}.png"));
        let coordinates = folder(a, subject.id).join("coordinates").join(format!("{im_id:06}.png"));
        // The coordinates are written last: where they are, all is.
        let there = coordinates.exists() && image_file.exists();
        let previewed = number % every == every / 2;
        let (mask, image) = if there && !previewed {
            (silhouette(&subject.mesh, &camera, &pose), None)
        } else {
            let view = maker.render(&camera, &pose);
            written.unseen += view.unseen_fraction();
            let mut random = stream(a.seed ^ 0x6e6f_6c00 ^ u64::from(subject.id), u64::from(im_id));
            let image = over_background(&view, backgrounds.patch(a.size, a.size, &mut random));
            if previewed {
                let percent = (100.0 * view.unseen_fraction()).round();
                let text = if percent >= 1.0 { format!("{percent:.0} % unseen") } else { String::new() };
                written.preview.push((view.patch.to_rgb(), text));
            }
            (view.mask, Some(image))
        };
        add(&mut writer, subject, im_id, &camera, &pose, &mask, image.as_ref())?;
        if !there {
            write_coordinates(&coordinates, &subject.mesh, &scale, &camera, &pose)?;
        }
        written.images += 1;
        progress.step(format!("object {}", subject.id));
    }
    if a.with_photographs {
        for (k, source) in subject.photographs.iter().enumerate() {
            let im_id = (places.len() + k) as u32;
            written.images +=
                usize::from(add_photograph(a, &mut writer, subject, im_id, &source.photograph)?);
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
    subject: &Subject,
    im_id: u32,
    photograph: &PosedImage,
) -> Result<bool> {
    let pose = *photograph.camera_from_object();
    let view = SourceView::new(photograph, &subject.mesh, a.size)?;
    let size = a.size;
    let mask = Mask::from_fn(size, size, |x, y| {
        view.visible.data[y * size + x] > 0.5 && view.depth()[y * size + x] > 0.0
    });
    if !mask.as_slice().contains(&true) {
        return Ok(false);
    }
    add(writer, subject, im_id, &view.camera, &pose, &mask, Some(&view.patch.to_rgb()))?;
    Ok(true)
}

fn silhouette(mesh: &Mesh, camera: &Camera, pose: &Pose) -> Mask {
    let mut frame = VisibilityBuffer::new(camera);
    frame.render(&[SceneObject { mesh, camera_from_object: *pose }], &RenderOptions::default());
    frame.mask(0)
}

fn add(
    writer: &mut SceneWriter,
    subject: &Subject,
    im_id: u32,
    camera: &Camera,
    pose: &Pose,
    visible: &Mask,
    image: Option<&RgbImage>,
) -> Result<()> {
    let whole = silhouette(&subject.mesh, camera, pose);
    let info = info(&whole, visible);
    let truth = [GroundTruth::new(subject.id, *pose)];
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

fn info(whole: &Mask, visible: &Mask) -> GroundTruthInfo {
    let count = |mask: &Mask| mask.as_slice().iter().filter(|v| **v).count() as u64;
    let (all, seen) = (count(whole), count(visible));
    GroundTruthInfo {
        bbox_obj: bounds(whole),
        bbox_visib: bounds(visible),
        px_count_all: Some(all),
        px_count_valid: Some(all),
        px_count_visib: Some(seen),
        visib_fract: if all > 0 { (seen as f64 / all as f64).min(1.0) } else { 0.0 },
    }
}

/// As BOP writes boxes: first pixel, then last minus first.
fn bounds(mask: &Mask) -> Option<Rect> {
    let width = mask.width();
    let (mut x0, mut y0, mut x1, mut y1) = (usize::MAX, usize::MAX, 0, 0);
    for (i, _) in mask.as_slice().iter().enumerate().filter(|(_, v)| **v) {
        let (x, y) = (i % width, i / width);
        (x0, y0, x1, y1) = (x0.min(x), y0.min(y), x1.max(x), y1.max(y));
    }
    (x0 <= x1).then(|| Rect { x: x0 as f64, y: y0 as f64, width: (x1 - x0) as f64, height: (y1 - y0) as f64 })
}

/// Object coordinates as colours of 16 bits: -1 to 1 over the object's box becomes 1 to 65535, 0 is beside the object.
fn write_coordinates(
    path: &Path,
    mesh: &Mesh,
    scale: &BoundingBoxScale,
    camera: &Camera,
    pose: &Pose,
) -> Result<()> {
    let mut frame = VisibilityBuffer::new(camera);
    let objects = [SceneObject { mesh, camera_from_object: *pose }];
    frame.render(&objects, &RenderOptions::default());
    let points = frame.object_coordinates(&objects);
    let (width, height) = points.size();
    let mut data = Vec::with_capacity(3 * width * height);
    for point in points.as_slice() {
        if point[0].is_nan() {
            data.extend([0u16; 3]);
            continue;
        }
        let n = scale.normalise(&Vec3::from(point.map(f64::from)));
        data.extend([n.x, n.y, n.z].map(|v| 1 + ((v.clamp(-1.0, 1.0) + 1.0) * 0.5 * 65534.0).round() as u16));
    }
    let image = image::ImageBuffer::<image::Rgb<u16>, _>::from_raw(width as u32, height as u32, data)
        .context("coordinates have another size than their image")?;
    let parent = path.parent().context("coordinates lie in a folder")?;
    std::fs::create_dir_all(parent).with_context(|| format!("folder {}", parent.display()))?;
    let partial = path.with_extension("png.tmp");
    image
        .save_with_format(&partial, image::ImageFormat::Png)
        .with_context(|| format!("cannot write {}", partial.display()))?;
    std::fs::rename(&partial, path).with_context(|| format!("cannot write {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_are_as_bop_writes_them() {
        let mask = Mask::from_fn(10, 8, |x, y| (2..5).contains(&x) && (3..4).contains(&y));
        let found = bounds(&mask).unwrap();
        assert_eq!([found.x, found.y, found.width, found.height], [2.0, 3.0, 2.0, 0.0]);
        assert!(bounds(&Mask::filled(3, 3, false)).is_none());
    }
}
