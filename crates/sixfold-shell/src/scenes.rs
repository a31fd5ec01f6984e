//! Objects dropped on a table, seen by a simulated depth camera and written as scenes of a BOP dataset (K. Park,
//! dissertation, section 5.2.1).

use std::path::Path;
use std::sync::Mutex;

use anyhow::{Context, Result, anyhow, bail};
use rayon::prelude::*;
use serde::Serialize;
use sixfold_bop::{
    BopDataset, GroundTruth, NewImage, ObjectVisibility, SceneWriter, VISIBILITY_DELTA,
    ground_truth_visibility,
};
use sixfold_geometry::random::stream;
use sixfold_geometry::{Camera, DepthImage, Mask, Pose, RgbImage};
use sixfold_io::CameraFile;
use sixfold_mesh::{Mesh, ModelInfo, ModelsInfo, Unit, read_mesh};
use sixfold_render::DepthSensor;
use sixfold_simulation::{ConvexParts, PartsOptions, Tabletop, TabletopOptions};
use sixfold_synth::augment::Backgrounds;
use sixfold_synth::shapes::{Family, member, toy};
use sixfold_synth::with_own_color;

use crate::folder::DatasetFolder;
use crate::progress::{Progress, check_interrupt};

/// Random stream of the backgrounds.
const BACKGROUND: u64 = 0x6261_636B;

/// Metres per unit of the depth files, for depths up to 6.5 m.
pub const DEPTH_SCALE: f64 = 1e-4;

/// An object before it is prepared for the simulation.
#[derive(Debug)]
pub struct NamedModel {
    /// Its id in the dataset.
    pub id: u32,
    /// Its name for people.
    pub name: String,
    /// Its surface.
    pub mesh: Mesh,
    /// Diameter and symmetries.
    pub info: ModelInfo,
}

/// Objects by ascending id.
#[derive(Debug, Default)]
pub struct NamedModels(pub Vec<NamedModel>);

impl NamedModels {
    /// The models of a dataset, all or those of `wanted`, with their ids.
    ///
    /// # Errors
    /// When a model is missing, cannot be read, or does not match `models_info.json`.
    pub fn of_dataset(dataset: &Path, wanted: &[u32]) -> Result<NamedModels> {
        let folder = dataset.join("models");
        let file = folder.join("models_info.json");
        let infos = ModelsInfo::read(&file)
            .with_context(|| format!("--dataset {}: its models", dataset.display()))?;
        if let Some(id) = wanted.iter().find(|id| !infos.0.contains_key(id)) {
            let there: Vec<String> = infos.0.keys().map(u32::to_string).collect();
            bail!("--ids: found {id}, expected some of {} ({})", there.join(", "), folder.display());
        }
        let chosen = infos.0.iter().filter(|(id, _)| wanted.is_empty() || wanted.contains(id));
        let models = chosen.map(|(&id, info)| {
            let name = format!("obj_{id:06}");
            let mesh = read_mesh(folder.join(format!("{name}.ply")), Unit::Millimetre)?;
            infos.check_mesh(id, &mesh, &file.display().to_string())?;
            if mesh.faces().is_empty() {
                bail!("{}/{name}.ply: found points without faces, expected a surface", folder.display());
            }
            Ok(NamedModel { id, name, mesh, info: info.clone() })
        });
        Ok(NamedModels(models.collect::<Result<_>>()?))
    }

    /// Adds an object under the next id.
    pub fn add(&mut self, name: String, mesh: Mesh, info: ModelInfo) {
        let id = self.0.last().map_or(0, |last| last.id) + 1;
        self.0.push(NamedModel { id, name, mesh, info });
    }

    /// Adds members of families and toys, which are functions of the seed.
    ///
    /// # Errors
    /// When a shape cannot be made.
    pub fn add_synthetic(
        &mut self,
        families: &[Family],
        members: usize,
        toys: usize,
        seed: u64,
    ) -> Result<()> {
        for &family in families {
            for number in 0..members {
                let number_of_all = (family as u64) << 32 | number as u64;
                let member = member(family, &mut stream(seed, number_of_all))?;
                let info = member.info();
                self.add(format!("{}-{number}", family.name()), member.mesh, info);
            }
        }
        for number in 0..toys {
            let mesh = toy(&mut stream(seed, 1 << 40 | number as u64))?;
            let info = ModelInfo::of_mesh(&mesh);
            self.add(format!("toy-{number}"), mesh, info);
        }
        Ok(())
    }

    /// Prepares them for the simulation: with exact shapes if `exact`, else with their convex hulls. Objects without colours
    /// get one.
    ///
    /// # Errors
    /// When an object has no convex parts, or the user interrupts.
    pub fn ready(self, exact: bool) -> Result<Vec<FallingObject>> {
        let mut progress = Progress::new("objects", self.0.len());
        let mut objects = vec![];
        for model in self.0 {
            check_interrupt("give the same command again to continue")?;
            let parts = if exact {
                ConvexParts::of_mesh(&model.mesh, &PartsOptions::default())
            } else {
                ConvexParts::of_convex(&model.mesh)
            };
            let parts = parts.with_context(|| format!("object {}", model.name))?;
            let mesh = with_own_color(model.mesh, model.id)?;
            progress.step(model.name.clone());
            objects.push(FallingObject { model: NamedModel { mesh, ..model }, parts });
        }
        progress.finish();
        Ok(objects)
    }
}

/// One of the objects that scenes are made of.
pub struct FallingObject {
    /// Its surface and names.
    pub model: NamedModel,
    /// Its collision shape.
    pub parts: ConvexParts,
}

#[derive(Serialize)]
struct Listed<'a> {
    id: u32,
    name: &'a str,
    diameter: f64,
}

/// The intrinsics of the camera that views scenes: from a file, or 640x480 pixels with the focal length of a Kinect.
///
/// # Errors
/// For a file that cannot be read, or with lens distortion, which rendered images do not have.
pub fn pinhole(file: Option<&Path>) -> Result<Camera> {
    let Some(file) = file else {
        return Ok(Camera::new(575.0, 575.0, 319.5, 239.5, 640, 480)?);
    };
    let read = CameraFile::read(file)?;
    let (width, height) = if read.sized { (read.camera.width, read.camera.height) } else { (640, 480) };
    let camera = read.for_image(width, height, file)?;
    if camera.distortion.is_some() {
        bail!(
            "{}: field distortion: rendered images have none; give a camera file without it",
            file.display()
        );
    }
    Ok(camera)
}

/// Writes the models, and a list of their names.
///
/// # Errors
/// When another model is there already.
pub fn write_objects(folder: &DatasetFolder, out: &Path, objects: &[FallingObject]) -> Result<()> {
    let models = || objects.iter().map(|o| &o.model);
    folder.write_models(models().map(|m| (m.id, &m.mesh, &m.info)))?;
    let list: Vec<Listed<'_>> =
        models().map(|m| Listed { id: m.id, name: &m.name, diameter: m.info.diameter }).collect();
    folder.write_once(&out.join("objects.json"), serde_json::to_string_pretty(&list)?.as_bytes())
}

/// The result of one scene.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Made {
    /// Objects that fell.
    pub dropped: usize,
    /// Objects that came to rest within reach.
    pub resting: usize,
}

/// Makes and writes scenes.
pub struct SceneMaker<'a> {
    /// Folder of the dataset, and its split.
    pub dataset: (&'a Path, &'a str),
    /// Objects that may be dropped.
    pub objects: &'a [FallingObject],
    /// How objects are dropped, and where cameras are.
    pub tabletop: TabletopOptions,
    /// The camera's intrinsics.
    pub camera: Camera,
    /// Noise of the depth camera.
    pub sensor: Option<DepthSensor>,
    /// Images of a scene.
    pub views: usize,
    /// Write colour images.
    pub rgb: bool,
    /// Shown in the colour images wherever no object is; `None` for the plane itself.
    pub backgrounds: Option<Backgrounds>,
    /// Write masks.
    pub masks: bool,
}

impl SceneMaker<'_> {
    /// Drops the objects, renders all views and writes the scene's folder. The result depends only on the options and the
    /// scene's id.
    ///
    /// # Errors
    /// When it cannot be written, or the user interrupts.
    pub fn write(&self, scene_id: u32) -> Result<Made> {
        let parts: Vec<&ConvexParts> = self.objects.iter().map(|o| &o.parts).collect();
        let mut scene = Tabletop::new(&parts, &self.tabletop, scene_id)?;
        let mut writer = SceneWriter::new(self.dataset.0, self.dataset.1, scene_id);
        for im_id in 0..self.views as u32 {
            check_interrupt("give the same command again to continue")?;
            let camera_from_world = scene.next_camera();
            self.add_view(&scene, &camera_from_world, (scene_id, im_id, &mut writer))?;
        }
        writer.finish()?;
        Ok(Made { dropped: scene.dropped, resting: scene.resting.len() })
    }

    /// Makes scenes, several at a time; returns the sum of their results.
    ///
    /// # Errors
    /// When one cannot be written, or the user interrupts.
    pub fn write_all(&self, scenes: &[u32]) -> Result<Made> {
        let progress = Mutex::new((Progress::new("scenes", scenes.len()), Made::default()));
        scenes.par_iter().try_for_each(|&scene_id| -> Result<()> {
            check_interrupt("give the same command again to continue")?;
            let made = self.write(scene_id)?;
            if let Ok(mut shared) = progress.lock() {
                shared.1.dropped += made.dropped;
                shared.1.resting += made.resting;
                shared.0.step(format!("scene {scene_id}: {} objects", made.resting));
            }
            Ok(())
        })?;
        let (progress, made) = progress.into_inner().map_err(|_| anyhow!("a scene ended in a panic"))?;
        progress.finish();
        Ok(made)
    }

    /// Whether a scene is complete: the text file that is written last exists.
    pub fn is_whole(&self, scene_id: u32) -> bool {
        self.dataset.0.join(self.dataset.1).join(format!("{scene_id:06}/scene_gt_info.json")).exists()
    }

    /// Renders one image and hands it to the writer under its id.
    fn add_view(
        &self,
        scene: &Tabletop,
        camera_from_world: &Pose,
        (scene_id, im_id, writer): (u32, u32, &mut SceneWriter),
    ) -> Result<()> {
        let noise = self.tabletop.seed ^ (u64::from(scene_id) << 32 | u64::from(im_id));
        let meshes: Vec<&Mesh> = self.objects.iter().map(|o| &o.model.mesh).collect();
        let sensor = self.sensor.as_ref().map(|sensor| (sensor, noise));
        let mut seen = scene.image(&meshes, &self.camera, camera_from_world, sensor, self.rgb);
        let resting =
            || scene.resting.iter().map(|(o, _)| &self.objects[*o].model).zip(&seen.camera_from_object);
        let truth: Vec<GroundTruth> =
            resting().map(|(model, pose)| GroundTruth::new(model.id, *pose)).collect();
        let posed: Vec<(&Mesh, Pose)> = resting().map(|(model, pose)| (&model.mesh, *pose)).collect();
        let visible = visibility(&posed, &self.camera, &seen.depth);
        let infos: Vec<_> = visible.iter().map(|v| v.info).collect();
        let (masks, masks_visible): (Vec<Mask>, Vec<Mask>) =
            visible.into_iter().map(|v| (v.mask, v.mask_visible)).unzip();
        if let (Some(rgb), Some(backgrounds)) = (&mut seen.rgb, &self.backgrounds) {
            let mut random = stream(noise, BACKGROUND);
            let behind = backgrounds.patch(self.camera.width, self.camera.height, &mut random).to_rgb();
            show_behind(rgb, &masks_visible, &behind);
        }
        writer.add(&NewImage {
            depth_scale: DEPTH_SCALE,
            camera_from_world: Some(*camera_from_world),
            rgb: seen.rgb.as_ref(),
            depth: Some(&seen.depth),
            ground_truth: &truth,
            info: Some(&infos),
            masks: self.masks.then_some(&masks[..]),
            masks_visible: self.masks.then_some(&masks_visible[..]),
            ..NewImage::new(im_id, &self.camera)
        })?;
        Ok(())
    }
}

/// Replaces every pixel that shows no object by that of another image.
fn show_behind(image: &mut RgbImage, objects: &[Mask], behind: &RgbImage) {
    for (i, (pixel, new)) in image.as_mut_slice().iter_mut().zip(behind.as_slice()).enumerate() {
        if objects.iter().all(|mask| !mask.as_slice()[i]) {
            *pixel = *new;
        }
    }
}

/// In rendered images the pixels of each object are known exactly and need not be estimated from noisy depth as in real
/// datasets; only the number of measured pixels comes from the depth image.
fn visibility(posed: &[(&Mesh, Pose)], camera: &Camera, depth: &DepthImage) -> Vec<ObjectVisibility> {
    let mut visible = ground_truth_visibility(posed, camera, None, VISIBILITY_DELTA);
    for object in &mut visible {
        let pixels = object.mask.as_slice().iter().zip(depth.as_slice());
        object.info.px_count_valid = Some(pixels.filter(|(inside, z)| **inside && **z > 0.0).count() as u64);
    }
    visible
}

/// Size of a dataset.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Counts {
    /// Images.
    pub images: usize,
    /// Ground-truth poses.
    pub instances: usize,
    /// The sum of their visible fractions.
    pub visible: f64,
}

impl Counts {
    /// Counts over all scenes of a dataset.
    ///
    /// # Errors
    /// When a scene cannot be read.
    pub fn of(dataset: &BopDataset) -> Result<Counts> {
        let mut counts = Counts::default();
        for scene_id in dataset.scene_ids() {
            let scene = dataset.scene(scene_id)?;
            for im_id in scene.image_ids() {
                let image = scene.image(im_id)?;
                counts.images += 1;
                counts.instances += image.ground_truth.len();
                counts.visible += image.visible_fractions().into_iter().flatten().sum::<f64>();
            }
        }
        Ok(counts)
    }
}
