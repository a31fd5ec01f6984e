//! Posed images of a BOP dataset: masks from its files, or rendered from its annotations where there are none.

use std::collections::BTreeMap;
use std::sync::Arc;

use sixfold_bop::{BopDataset, MaskKind, Models, ground_truth_visibility};
use sixfold_geometry::{FrameId, Pose};
use sixfold_mesh::Mesh;

use crate::error::TrainingSetError;
use crate::posed_image::{MIN_PIXELS, PosedImage};

/// Reads the images of a dataset that show `objects`, one posed image for each instance; only `frames` are opened.
/// Instances less visible than `min_visibility` (0..1), or with fewer than [`MIN_PIXELS`] visible pixels, are left out.
///
/// Visible masks come from the dataset (`mask_visib`); where a frame has none, all its annotated objects are rendered
/// together. Occluders that are not annotated are then unknown.
///
/// # Errors
/// [`TrainingSetError`] when the dataset or one of the frames cannot be read.
pub fn read_posed_images(
    dataset: &BopDataset,
    frames: &[FrameId],
    objects: &[u32],
    min_visibility: f64,
) -> Result<Vec<PosedImage>, TrainingSetError> {
    let mut images = Vec::new();
    let mut scenes = BTreeMap::new();
    let mut meshes: BTreeMap<u32, Mesh> = BTreeMap::new();
    for &id in frames {
        let FrameId { scene_id, im_id } = id;
        if let std::collections::btree_map::Entry::Vacant(place) = scenes.entry(scene_id) {
            place.insert(dataset.scene(scene_id)?);
        }
        let scene = &scenes[&scene_id];
        let frame = scene.image(im_id)?;
        if !frame.ground_truth.iter().any(|g| objects.contains(&g.obj_id)) {
            continue;
        }
        let rgb = scene.rgb(im_id)?.ok_or(TrainingSetError::NoColorImage { frame: id })?;
        let rgb = Arc::new(rgb);
        let camera = scene.camera(im_id)?;
        let mut masks = Vec::new();
        for index in 0..frame.ground_truth.len() {
            masks.push(scene.mask(im_id, index, MaskKind::Visible)?);
        }
        let mut fractions = frame.visible_fractions();
        if masks.iter().any(Option::is_none) || fractions.iter().any(Option::is_none) {
            for g in &frame.ground_truth {
                if let std::collections::btree_map::Entry::Vacant(place) = meshes.entry(g.obj_id) {
                    place.insert(dataset.model(g.obj_id, Models::Rendering)?);
                }
            }
            let placed: Vec<(&Mesh, Pose)> =
                frame.ground_truth.iter().map(|g| (&meshes[&g.obj_id], g.camera_from_object)).collect();
            let rendered = ground_truth_visibility(&placed, &camera, None, 0.015);
            for ((mask, fraction), rendered) in masks.iter_mut().zip(&mut fractions).zip(rendered) {
                if mask.is_none() {
                    *mask = Some(rendered.mask_visible);
                }
                fraction.get_or_insert(rendered.info.visib_fract);
            }
        }
        for ((truth, mask), fraction) in frame.ground_truth.iter().zip(masks).zip(fractions) {
            let (Some(mask), Some(fraction)) = (mask, fraction) else { continue };
            if !objects.contains(&truth.obj_id) || fraction < min_visibility {
                continue;
            }
            if mask.as_slice().iter().filter(|v| **v).count() < MIN_PIXELS {
                continue;
            }
            let pose = truth.camera_from_object;
            let image = PosedImage::of_frame(id, truth.obj_id, rgb.clone(), camera, pose)?;
            images.push(image.with_mask(&mask)?.with_visible_fraction(fraction));
        }
    }
    Ok(images)
}
