//! One scene: objects drop, cameras look.

use std::f64::consts::TAU;

use anyhow::Result;
use rand::seq::SliceRandom;
use rand::{Rng, RngExt};
use rand_chacha::ChaCha8Rng;
use sixfold_bop::{
    GroundTruth, NewImage, ObjectVisibility, SceneWriter, VISIBILITY_DELTA, ground_truth_visibility,
};
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::random::stream;
use sixfold_geometry::{Camera, DepthImage, Mask, Pose, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{Frame, Light, Material, RenderOptions, SceneObject, shade, simulate_depth};
use sixfold_simulation::{ConvexParts, ViewPoint, drop_objects};

use super::arguments::SimulateScenesArguments;
use super::objects::Thing;
use crate::progress::check_interrupt;

/// Metres per unit of the depth files: what reaches 6.5 m.
pub(super) const DEPTH_SCALE: f64 = 1e-4;
/// Drops of a scene in which nothing at all came to rest, before it stays empty.
const TRIES: u64 = 5;
/// Cameras look past the middle by up to so much, metres, and are turned in the image by up to so much, radians.
const AIM: f64 = 0.1;
const ROLL: f64 = 0.12;

/// What came of one scene.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Made {
    pub dropped: usize,
    pub resting: usize,
}

/// What the cameras of a scene look at.
struct Scene<'a> {
    /// With world_from_object, metres.
    things: Vec<(&'a Thing, Pose)>,
    table: Mesh,
    lights: Lights,
}

/// Drops the objects, renders all views and writes the scene's folder. A function of the arguments and the scene's id.
pub(super) fn write(
    a: &SimulateScenesArguments,
    camera: &Camera,
    things: &[Thing],
    scene_id: u32,
) -> Result<Made> {
    let mut random = stream(a.seed, 3 << 40 | u64::from(scene_id));
    let (things, made) = settle(a, things, scene_id, &mut random);
    let scene = Scene { things, table: table(&mut random)?, lights: Lights::random(&mut random) };
    let mut writer = SceneWriter::new(&a.out, &a.split, scene_id);
    for im_id in 0..a.views as u32 {
        check_interrupt("give the same command again to go on")?;
        let camera_from_world = camera_pose(a, &mut random).inverse();
        let noise = a.seed ^ (u64::from(scene_id) << 32 | u64::from(im_id));
        scene.add_view(a, camera, &camera_from_world, noise, (im_id, &mut writer))?;
    }
    writer.finish()?;
    Ok(made)
}

/// Chooses objects and lets them fall until at least one of them rests.
fn settle<'a>(
    a: &SimulateScenesArguments,
    things: &'a [Thing],
    scene_id: u32,
    random: &mut ChaCha8Rng,
) -> (Vec<(&'a Thing, Pose)>, Made) {
    let count = random.random_range(a.objects_per_scene[0]..=a.objects_per_scene[1]);
    let mut chosen: Vec<&Thing> = vec![];
    while chosen.len() < count {
        let mut round: Vec<&Thing> = things.iter().collect();
        round.shuffle(random);
        chosen.extend(round.into_iter().take(count - chosen.len()));
    }
    let parts: Vec<&ConvexParts> = chosen.iter().map(|t| &t.parts).collect();
    // The same numbers as the objects' own shapes would be no harm, but no chance either.
    let seed = a.seed ^ 0x7069_6c65;
    let mut resting: Vec<(&Thing, Pose)> = vec![];
    for attempt in 0..TRIES {
        let poses = drop_objects(&parts, &a.pile(), seed, attempt << 32 | u64::from(scene_id));
        resting = chosen.iter().zip(poses).filter_map(|(thing, pose)| Some((*thing, pose?))).collect();
        if !resting.is_empty() {
            break;
        }
    }
    let made = Made { dropped: count, resting: resting.len() };
    (resting, made)
}

/// A square table top at z = 0 of 1 to 3 m in a dull colour.
fn table(random: &mut impl Rng) -> Result<Mesh> {
    let half = between(random, 0.5, 1.5);
    let corners = [(-half, -half), (half, -half), (half, half), (-half, half)];
    let grey = between(random, 70.0, 190.0);
    let color = [0; 3].map(|_: u8| (grey + between(random, -25.0, 25.0)) as u8);
    let mesh = Mesh::new(corners.map(|(x, y)| Vec3::new(x, y, 0.0)).to_vec(), vec![[0, 1, 2], [0, 2, 3]])?;
    Ok(mesh.with_colors(vec![color; 4])?)
}

/// Where light comes from in a scene, world frame.
struct Lights {
    direction: Vec3,
    ambient: f32,
    lamp: f32,
}

impl Lights {
    fn random(random: &mut impl Rng) -> Self {
        let angle = between(random, 0.0, TAU);
        let direction = Vec3::new(0.8 * angle.cos(), 0.8 * angle.sin(), -between(random, 0.6, 1.6));
        let ambient = between(random, 0.25, 0.45) as f32;
        Lights { direction, ambient, lamp: 1.05 - ambient }
    }

    fn seen_from(&self, camera_from_world: &Pose) -> [Light; 2] {
        let direction = camera_from_world.transform_direction(&self.direction);
        [Light::Ambient { color: [self.ambient; 3] }, Light::Directional { direction, color: [self.lamp; 3] }]
    }
}

/// world_from_camera of a camera that looks near the middle.
fn camera_pose(a: &SimulateScenesArguments, random: &mut impl Rng) -> Pose {
    let target = Vec3::from_fn(|axis, _| match axis {
        2 => between(random, 0.0, 0.5 * AIM),
        _ => between(random, -AIM, AIM),
    });
    let view = ViewPoint {
        azimuth: between(random, 0.0, TAU),
        elevation: between(random, a.elevation[0], a.elevation[1]).to_radians(),
        distance: between(random, a.distance[0], a.distance[1]),
        target,
    };
    let roll = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), between(random, -ROLL, ROLL));
    view.world_from_camera() * Pose::new(roll, Vec3::zeros())
}

impl Scene<'_> {
    /// Renders one image and hands it to the writer under its id.
    fn add_view(
        &self,
        a: &SimulateScenesArguments,
        camera: &Camera,
        camera_from_world: &Pose,
        noise: u64,
        (im_id, writer): (u32, &mut SceneWriter),
    ) -> Result<()> {
        let posed: Vec<(&Mesh, Pose)> = self
            .things
            .iter()
            .map(|(thing, world_from_object)| (&thing.mesh, *camera_from_world * *world_from_object))
            .collect();
        let objects: Vec<SceneObject<'_>> = posed
            .iter()
            .copied()
            .chain([(&self.table, *camera_from_world)])
            .map(|(mesh, camera_from_object)| SceneObject { mesh, camera_from_object })
            .collect();
        let mut frame = Frame::new(camera);
        frame.render(&objects, &RenderOptions::default());
        let ideal = frame.depth();
        let depth = match a.sensor.model() {
            None => ideal,
            Some(sensor) => simulate_depth(&ideal, &frame.normals(&objects), &sensor, noise),
        };
        let lights = self.lights.seen_from(camera_from_world);
        let rgb = (!a.no_rgb).then(|| shade(&frame, &objects, &lights, &Material::default(), None));
        let visible = visibility(&posed, camera, &depth);
        let truth: Vec<GroundTruth> = self
            .things
            .iter()
            .zip(&posed)
            .map(|((thing, _), (_, pose))| GroundTruth::new(thing.id, *pose))
            .collect();
        let infos: Vec<_> = visible.iter().map(|v| v.info).collect();
        let (masks, masks_visible): (Vec<Mask>, Vec<Mask>) =
            visible.into_iter().map(|v| (v.mask, v.mask_visible)).unzip();
        writer.add(&NewImage {
            depth_scale: DEPTH_SCALE,
            camera_from_world: Some(*camera_from_world),
            rgb: rgb.as_ref(),
            depth: Some(&depth),
            ground_truth: &truth,
            info: Some(&infos),
            masks: (!a.no_masks).then_some(&masks[..]),
            masks_visible: (!a.no_masks).then_some(&masks_visible[..]),
            ..NewImage::new(im_id, camera)
        })?;
        Ok(())
    }
}

/// Which pixels show which object is known exactly here, so it need not be guessed from the noisy depth as in real
/// datasets; only how many pixels were measured comes from that.
fn visibility(posed: &[(&Mesh, Pose)], camera: &Camera, depth: &DepthImage) -> Vec<ObjectVisibility> {
    let mut visible = ground_truth_visibility(posed, camera, None, VISIBILITY_DELTA);
    for object in &mut visible {
        let pixels = object.mask.as_slice().iter().zip(depth.as_slice());
        object.info.px_count_valid = Some(pixels.filter(|(inside, z)| **inside && **z > 0.0).count() as u64);
    }
    visible
}

fn between(random: &mut impl Rng, low: f64, high: f64) -> f64 {
    low + (high - low) * random.random::<f64>()
}
