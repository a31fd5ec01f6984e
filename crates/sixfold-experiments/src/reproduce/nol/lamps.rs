//! A scene photographed under several lamps by a static camera: each photograph is predicted from the others.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use sixfold_bop::{BopDataset, Models, VISIBILITY_DELTA, ground_truth_visibility};
use sixfold_data::PosedImage;
use sixfold_geometry::Pose;
use sixfold_mesh::{Mesh, Unit, read_mesh};
use sixfold_nol::similarity::ImageSimilarity;

use super::super::kept::kept_or_made;
use super::picture::Strips;
use super::views::{Networks, Target, ViewRow, compare, ways};
use sixfold_shell::progress::{Progress, check_interrupt};

/// Side of the crops: the objects are larger than in the other dataset.
const SIDE: usize = 192;
/// Minimum visible fraction of an object as source or target.
const MIN_VISIBILITY: f64 = 0.8;
/// Objects with `--quick`.
const QUICK: usize = 3;
/// The name of these rows' only set.
pub(super) const SET: &str = "other lamps";

/// An object of the scene, one entry per instance.
struct Thing {
    object: u32,
    /// Index in the ground truth.
    index: usize,
    mesh: Mesh,
    /// The same, textured, if there is one.
    textured: Option<Mesh>,
    /// Its images under every lamp.
    photographs: Vec<PosedImage>,
}

pub(super) fn rows(
    root: &Path,
    out: &Path,
    networks: &Networks,
    judge: &ImageSimilarity,
    strips: &Strips,
    quick: bool,
) -> Result<Vec<ViewRow>> {
    let (lamps, things) = things(root, quick)?;
    let mut progress = Progress::new("views under other lamps", lamps.len() * things.len());
    let mut rows = vec![];
    for thing in &things {
        for (k, lamp) in lamps.iter().enumerate() {
            check_interrupt(super::RESUME_HINT)?;
            let key = format!("lamp-{lamp}-{}-{}", thing.object, thing.index);
            rows.push(kept_or_made(out, &key, || {
                let mut others = thing.photographs.clone();
                let target = others.remove(k);
                let ways = ways(SET, &thing.mesh, &others, networks, SIDE, false);
                let target = Target {
                    key: &key,
                    frame: (0, *lamp),
                    object: thing.object,
                    photograph: &target,
                    mesh: thing.textured.as_ref().unwrap_or(&thing.mesh),
                    side: SIDE,
                };
                let (row, pictures) = compare(&target, &ways, judge)?;
                if k + 1 == lamps.len() {
                    strips.keep(&row, &pictures)?;
                }
                Ok(row)
            })?);
            progress.step(format!("object {}", thing.object));
        }
    }
    progress.finish();
    Ok(rows)
}

fn things(root: &Path, quick: bool) -> Result<(Vec<u32>, Vec<Thing>)> {
    let dataset = BopDataset::open(root, "test").context("--hope")?;
    let Some(scene_id) = dataset.scene_ids().first().copied() else {
        bail!("--hope {}: holds no scene", root.display())
    };
    let scene = dataset.scene(scene_id)?;
    let lamps = scene.image_ids();
    if lamps.len() < 2 {
        bail!(
            "--hope {}: found {} images, expected the same scene under two lamps or more",
            root.display(),
            lamps.len()
        );
    }
    let mut things: Vec<Thing> = vec![];
    for (number, im_id) in lamps.iter().enumerate() {
        let Some(image) = scene.rgb(*im_id)? else {
            bail!("--hope {}: image {im_id} has no colour image", root.display())
        };
        let (image, camera) = (Arc::new(image), scene.camera(*im_id)?);
        let truth = &scene.image(*im_id)?.ground_truth;
        if number == 0 {
            for (index, g) in truth.iter().enumerate() {
                let file = root.join(format!("models_textured/obj_{:06}/textured.obj", g.obj_id));
                let textured = if file.is_file() { Some(read_mesh(&file, Unit::Millimetre)?) } else { None };
                let mesh = dataset.model(g.obj_id, Models::Rendering)?;
                things.push(Thing { object: g.obj_id, index, mesh, textured, photographs: vec![] });
            }
        }
        if truth.len() != things.len() {
            bail!(
                "--hope {}: image {im_id} shows {} objects, the first one {}; expected the same scene under several lamps",
                root.display(),
                truth.len(),
                things.len()
            );
        }
        let placed: Vec<(&Mesh, Pose)> =
            things.iter().zip(truth).map(|(t, g)| (&t.mesh, g.camera_from_object)).collect();
        let visible = ground_truth_visibility(&placed, &camera, None, VISIBILITY_DELTA);
        for ((thing, g), visible) in things.iter_mut().zip(truth).zip(visible) {
            if visible.info.visib_fract >= MIN_VISIBILITY {
                let name = format!("{im_id} of object {}", thing.object);
                let posed = PosedImage::new(name, thing.object, image.clone(), camera, g.camera_from_object)?;
                thing.photographs.push(posed.with_mask(&visible.mask_visible)?);
            }
        }
    }
    things.retain(|t| t.photographs.len() == lamps.len());
    if quick {
        things.truncate(QUICK);
    }
    Ok((lamps, things))
}
