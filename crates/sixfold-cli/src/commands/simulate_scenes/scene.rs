//! One scene: objects at rest on a table, written as the dataset's folder.

use anyhow::Result;
use sixfold_bop::{GroundTruth, NewImage, ObjectVisibility, SceneWriter, ground_truth_visibility};
use sixfold_geometry::{Camera, DepthImage, Mask, Pose};
use sixfold_mesh::Mesh;
use sixfold_shell::progress::check_interrupt;
use sixfold_simulation::{ConvexParts, Tabletop};

use super::arguments::SimulateScenesArguments;
use super::objects::Thing;

/// Metres per unit of the depth files: what reaches 6.5 m.
pub(super) const DEPTH_SCALE: f64 = 1e-4;

/// What came of one scene.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Made {
    pub dropped: usize,
    pub resting: usize,
}

/// Drops the objects, renders all views and writes the scene's folder. A function of the arguments and the scene's id.
pub(super) fn write(
    a: &SimulateScenesArguments,
    camera: &Camera,
    things: &[Thing],
    scene_id: u32,
) -> Result<Made> {
    let parts: Vec<&ConvexParts> = things.iter().map(|thing| &thing.parts).collect();
    let mut scene = Tabletop::new(&parts, &a.tabletop(), scene_id)?;
    let mut writer = SceneWriter::new(&a.out, &a.split, scene_id);
    for im_id in 0..a.views as u32 {
        check_interrupt("give the same command again to continue")?;
        let camera_from_world = scene.next_camera();
        add_view(a, camera, things, &scene, &camera_from_world, (scene_id, im_id, &mut writer))?;
    }
    writer.finish()?;
    Ok(Made { dropped: scene.dropped, resting: scene.resting.len() })
}

/// Renders one image and hands it to the writer under its id.
fn add_view(
    a: &SimulateScenesArguments,
    camera: &Camera,
    things: &[Thing],
    scene: &Tabletop,
    camera_from_world: &Pose,
    (scene_id, im_id, writer): (u32, u32, &mut SceneWriter),
) -> Result<()> {
    let noise = a.seed ^ (u64::from(scene_id) << 32 | u64::from(im_id));
    let sensor = a.sensor.model();
    let meshes: Vec<&Mesh> = things.iter().map(|thing| &thing.mesh).collect();
    let sensor = sensor.as_ref().map(|sensor| (sensor, noise));
    let seen = scene.image(&meshes, camera, camera_from_world, sensor, !a.no_rgb);
    let resting = || scene.resting.iter().map(|(thing, _)| &things[*thing]).zip(&seen.camera_from_object);
    let truth: Vec<GroundTruth> = resting().map(|(thing, pose)| GroundTruth::new(thing.id, *pose)).collect();
    let posed: Vec<(&Mesh, Pose)> = resting().map(|(thing, pose)| (&thing.mesh, *pose)).collect();
    let visible = visibility(&posed, camera, &seen.depth);
    let infos: Vec<_> = visible.iter().map(|v| v.info).collect();
    let (masks, masks_visible): (Vec<Mask>, Vec<Mask>) =
        visible.into_iter().map(|v| (v.mask, v.mask_visible)).unzip();
    writer.add(&NewImage {
        depth_scale: DEPTH_SCALE,
        camera_from_world: Some(*camera_from_world),
        rgb: seen.rgb.as_ref(),
        depth: Some(&seen.depth),
        ground_truth: &truth,
        info: Some(&infos),
        masks: (!a.no_masks).then_some(&masks[..]),
        masks_visible: (!a.no_masks).then_some(&masks_visible[..]),
        ..NewImage::new(im_id, camera)
    })?;
    Ok(())
}

/// Which pixels show which object is known exactly here, so it need not be guessed from the noisy depth as in real
/// datasets; only how many pixels were measured comes from that.
fn visibility(posed: &[(&Mesh, Pose)], camera: &Camera, depth: &DepthImage) -> Vec<ObjectVisibility> {
    let mut visible = ground_truth_visibility(posed, camera, None, 0.015);
    for object in &mut visible {
        let pixels = object.mask.as_slice().iter().zip(depth.as_slice());
        object.info.px_count_valid = Some(pixels.filter(|(inside, z)| **inside && **z > 0.0).count() as u64);
    }
    visible
}
