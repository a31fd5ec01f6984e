//! Renders an object from everywhere on a part of the view sphere and writes the images of a BOP training set.

use std::f64::consts::{FRAC_PI_4, TAU};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use sixfold_bop::{GroundTruth, GroundTruthInfo, NewImage, SceneWriter};
use sixfold_data::PosedImage;
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::random::{stream, uniform};
use sixfold_geometry::{Camera, Mask, Mat3, Pose, Rect, RgbImage, Vec3};
use sixfold_mesh::Mesh;
use sixfold_nol::synthesis::ViewMaker;
use sixfold_nol::{SourceView, object_window};
use sixfold_render::{BoundingBoxScale, Frame, RenderOptions, SceneObject};
use sixfold_synth::augment::{Backgrounds, Coverage, Patch};

use super::arguments::SynthesizeArguments;
use super::input::Subject;
use crate::progress::{Progress, check_interrupt};

/// Side of an image in units of the object's box.
const ROOM: f64 = 1.6;
/// Pictures of an object in the preview.
const PREVIEWED: usize = 10;

/// What was written of one object.
pub(super) struct Written {
    pub images: usize,
    /// Share of the object's pixels in all views that no photograph shows.
    pub unseen: f64,
    pub preview: Vec<(RgbImage, String)>,
}

/// A pose to render, and its distance.
struct Aim {
    azimuth: f64,
    elevation: f64,
    turn: usize,
}

fn aims(a: &SynthesizeArguments) -> Vec<Aim> {
    let step = a.step.to_radians();
    let (low, high) = (a.elevation[0].to_radians(), a.elevation[1].to_radians());
    let around = (TAU / step).round().max(1.0) as usize;
    let up = ((high - low) / step + 1e-9).floor() as usize + 1;
    let mut aims = Vec::with_capacity(around * up * a.turns);
    for e in 0..up {
        for z in 0..around {
            for turn in 0..a.turns {
                let (azimuth, elevation) = (TAU * z as f64 / around as f64, low + e as f64 * step);
                aims.push(Aim { azimuth, elevation, turn });
            }
        }
    }
    aims
}

/// A camera that looks at `centre` from a direction given in the object's frame, upright but for a turn of the image.
fn looking_at(centre: &Vec3, aim: &Aim, distance: f64, roll: f64) -> Pose {
    let (sa, ca) = aim.azimuth.sin_cos();
    let (se, ce) = aim.elevation.sin_cos();
    let back = Vec3::new(ce * ca, ce * sa, se);
    let z = -back;
    // Straight from above, up is where the azimuth points.
    let up = if se.abs() > 0.999 { Vec3::new(-ca, -sa, 0.0) * se.signum() } else { Vec3::z() };
    let x = z.cross(&up).normalize();
    let rotation = Mat3::from_rows(&[x.transpose(), z.cross(&x).transpose(), z.transpose()]);
    let upright = Pose::from_parts(&rotation, -rotation * (centre + back * distance)).unwrap_or_default();
    Pose::new(UnitQuaternion::from_axis_angle(&Vec3::z_axis(), roll), Vec3::zeros()) * upright
}

/// Camera and pose of image `number`.
fn placed(a: &SynthesizeArguments, subject: &Subject, aim: &Aim, number: u32) -> Option<(Camera, Pose)> {
    let (low, high) = subject.mesh.bounding_box();
    let centre = (low + high) * 0.5;
    let mut random = stream(a.seed ^ u64::from(subject.id) << 40, u64::from(number));
    let distances =
        subject.photographs.iter().map(|s| s.photograph.camera_from_object().translation().norm());
    let range = distances.fold([f64::INFINITY, 0.0f64], |[low, high], d| [low.min(d), high.max(d)]);
    let distance = f64::from(uniform(&mut random, [range[0] as f32, range[1] as f32]));
    // Turns of one view lie evenly between -45 and 45 degrees; a single one anywhere there.
    let roll = if a.turns == 1 {
        f64::from(uniform(&mut random, [-1.0, 1.0])) * FRAC_PI_4
    } else {
        (2.0 * aim.turn as f64 / (a.turns - 1) as f64 - 1.0) * FRAC_PI_4
    };
    let pose = looking_at(&centre, aim, distance, roll);
    let camera = *subject.photographs.first()?.photograph.camera();
    Some((object_window(&camera, &subject.mesh, &pose, ROOM)?.camera(&camera, a.size), pose))
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
    let aims = aims(a);
    let mut writer = SceneWriter::new(&a.out, &a.new_split, subject.id);
    let mut written = Written { images: 0, unseen: 0.0, preview: vec![] };
    let every = aims.len().div_ceil(PREVIEWED).max(1);
    let scale = {
        let (low, high) = subject.mesh.bounding_box();
        BoundingBoxScale::of_corners(&low, &high)
    };
    for (number, aim) in aims.iter().enumerate() {
        check_interrupt("give the same command again to go on")?;
        let im_id = number as u32;
        let Some((camera, pose)) = placed(a, subject, aim, im_id) else { continue };
        let image_file = folder(a, subject.id).join("rgb").join(format!("{im_id:06}.png"));
        let coordinates = folder(a, subject.id).join("coordinates").join(format!("{im_id:06}.png"));
        // The coordinates are written last: where they are, all is.
        let there = coordinates.exists() && image_file.exists();
        let previewed = number % every == every / 2;
        let (mask, image) = if there && !previewed {
            (silhouette(&subject.mesh, &camera, &pose), None)
        } else {
            let view = maker.render(&camera, &pose);
            written.unseen += view.unseen_share();
            let mut random = stream(a.seed ^ 0x6e6f_6c00 ^ u64::from(subject.id), u64::from(im_id));
            let mut patch = backgrounds.patch(a.size, a.size, &mut random);
            let mut soft = Coverage::from_fn(a.size, a.size, |x, y| f32::from(u8::from(view.mask[(x, y)])));
            soft.blur(0.7);
            patch.blend(&spread(&view.patch, &view.mask), &soft);
            let image = patch.to_rgb();
            if previewed {
                let percent = (100.0 * view.unseen_share()).round();
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
            let im_id = (aims.len() + k) as u32;
            written.images +=
                usize::from(add_photograph(a, &mut writer, subject, im_id, &source.photograph)?);
        }
    }
    writer.finish()?;
    written.unseen /= aims.len().max(1) as f64;
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

/// Colours of the object carried a few pixels beyond its border, so that a soft border mixes no black.
fn spread(patch: &Patch, mask: &Mask) -> Patch {
    let (width, height) = mask.size();
    let area = width * height;
    let mut patch = patch.clone();
    let mut known = mask.clone();
    for _ in 0..3 {
        let before = known.clone();
        for y in 1..height.saturating_sub(1) {
            for x in 1..width.saturating_sub(1) {
                if before[(x, y)] {
                    continue;
                }
                let near = [(x - 1, y), (x + 1, y), (x, y - 1), (x, y + 1)];
                let near: Vec<_> = near.into_iter().filter(|p| before[*p]).collect();
                if near.is_empty() {
                    continue;
                }
                for c in 0..3 {
                    let sum: f32 = near.iter().map(|(x, y)| patch.data[c * area + y * width + x]).sum();
                    patch.data[c * area + y * width + x] = sum / near.len() as f32;
                }
                known[(x, y)] = true;
            }
        }
    }
    patch
}

fn silhouette(mesh: &Mesh, camera: &Camera, pose: &Pose) -> Mask {
    let mut frame = Frame::new(camera);
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
    let mut frame = Frame::new(camera);
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
    fn a_view_looks_at_the_centre_from_where_it_should() {
        let centre = Vec3::new(0.01, -0.02, 0.03);
        for (azimuth, elevation) in [(0.0, 0.0), (1.0, 0.5), (4.0, std::f64::consts::FRAC_PI_2), (2.0, -0.4)]
        {
            let aim = Aim { azimuth, elevation, turn: 0 };
            let pose = looking_at(&centre, &aim, 0.7, 0.3);
            assert!((pose.transform_point(&centre) - Vec3::new(0.0, 0.0, 0.7)).norm() < 1e-9);
            let camera = pose.inverse().translation() - centre;
            assert!((camera.z / camera.norm() - elevation.sin()).abs() < 1e-9);
            if elevation.cos() > 1e-3 {
                assert!(
                    (camera.y.atan2(camera.x) - azimuth)
                        .rem_euclid(TAU)
                        .min((azimuth - camera.y.atan2(camera.x)).rem_euclid(TAU))
                        < 1e-9
                );
            }
        }
        // Upright: the object's z axis points up in the image, turned by the roll.
        let pose = looking_at(&centre, &Aim { azimuth: 0.4, elevation: 0.6, turn: 0 }, 0.7, 0.0);
        let up = pose.transform_direction(&Vec3::z());
        assert!(up.x.abs() < 1e-9 && up.y < 0.0);
    }

    #[test]
    fn boxes_are_as_bop_writes_them() {
        let mask = Mask::from_fn(10, 8, |x, y| (2..5).contains(&x) && (3..4).contains(&y));
        let found = bounds(&mask).unwrap();
        assert_eq!([found.x, found.y, found.width, found.height], [2.0, 3.0, 2.0, 0.0]);
        assert!(bounds(&Mask::filled(3, 3, false)).is_none());
    }
}
