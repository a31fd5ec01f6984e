//! The run of `sixfold demo`: all steps on the sample frames, from files to scored poses and images. This file finds poses
//! from depth; `colour_poses.rs` adds poses from colour, and `samples.rs` holds the objects that both use.

mod colour;
#[cfg(feature = "networks")]
mod colour_poses;
#[cfg(not(feature = "networks"))]
#[path = "without_networks.rs"]
mod colour_poses;
mod samples;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Result;
use rayon::prelude::*;
use serde::Serialize;
use sixfold_align::{DepthOptions, DepthRegion};
use sixfold_bop::{
    BopDataset, Estimate, EvalOptions, Evaluation, Models, Scene, Target, evaluate, write_recall_curves,
};
use sixfold_ppf::{PpfOptions, estimate};

pub use self::colour::Colour;
use self::samples::{Known, add_s};
use crate::overlay::{self, Drawn};
use crate::pictures::Pictures;
use crate::progress::Progress;
use crate::shipped::DEMO;

/// Scenes of the sample data from this id on have simulated depth.
const SIMULATED: u32 = 1000;

/// Poses within this fraction of the diameter are right.
const RIGHT: f64 = 0.1;

/// Input files of the demo; files that are not given are found among those that come with Sixfold.
#[derive(Debug, Clone, Copy, Default)]
pub struct DemoFiles<'a> {
    /// Folder of the sample data.
    pub data: Option<&'a Path>,
    /// Weights for poses from colour.
    pub weights: Option<&'a Path>,
    /// Weights of the detector.
    pub detector: Option<&'a Path>,
}

/// A pose with its error against the ground truth.
#[derive(Serialize)]
pub struct SamplePose {
    /// Scene and image.
    pub image: String,
    /// Whether the pose was found from real or from simulated depth; absent for a pose from colour.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub depth: Option<&'static str>,
    /// Object id.
    pub object: u32,
    /// Mean distance of the model's points at the two poses (nearest points for symmetric objects), millimetres.
    pub add_s_mm: f64,
    /// The same as a fraction of the diameter.
    pub add_s_of_diameter: f64,
    /// The method's confidence.
    pub confidence: f64,
    /// Time of the search, seconds.
    pub seconds: f64,
}

/// The results of the demo.
#[derive(Serialize)]
pub struct Demo {
    /// Poses from depth.
    pub poses: Vec<SamplePose>,
    /// How many of them are within 10 % of the diameter.
    pub correct: usize,
    /// Poses to be found.
    pub targets: usize,
    /// Total time, seconds.
    pub seconds: f64,
    /// Images that were written.
    pub pictures: Vec<PathBuf>,
    /// Scores of the poses from depth.
    pub evaluation: Evaluation,
    /// Poses from colour alone.
    pub colour: Colour,
}

impl Demo {
    /// Finds poses in the sample frames and scores them; data derived from the objects is kept in the folder `objects`.
    ///
    /// # Errors
    /// When the sample data cannot be found or read, or given weights are not of the right kind.
    pub fn run(files: &DemoFiles<'_>, objects: &Path, out: &mut Pictures) -> Result<Demo> {
        let start = Instant::now();
        let folder = files.data.map_or_else(|| DEMO.find(), |data| Ok(data.to_owned()))?;
        let dataset = BopDataset::open(&folder, "test")?;
        let targets = dataset.object_targets(&dataset.targets(None)?)?;
        let mut samples = Samples::new(&dataset, objects)?;
        let mut found = FromDepth::default();
        let mut progress = Progress::new("poses", targets.len());
        for scene_id in dataset.scene_ids() {
            let scene = dataset.scene(scene_id)?;
            for im_id in scene.image_ids() {
                let of_image = |t: &&Target| (t.scene_id, t.im_id) == (scene_id, im_id);
                let here: Vec<&Target> = targets.iter().filter(of_image).collect();
                found.add_image(&scene, im_id, &here, &mut samples, out, &mut progress)?;
            }
        }
        progress.finish();
        let FromDepth { poses, results, mut pictures } = found;
        let evaluation = evaluate(&dataset, &results, &dataset.targets(None)?, &EvalOptions::default(), &())?;
        pictures.extend(out.with("recall.png", |curves| write_recall_curves(curves, &evaluation)));
        let colour = colour_poses::run(files, out, &dataset, &targets, &samples.known)?;
        Ok(Demo {
            correct: poses.iter().filter(|pose| pose.add_s_of_diameter < RIGHT).count(),
            poses,
            targets: targets.len(),
            seconds: start.elapsed().as_secs_f64(),
            pictures,
            evaluation,
            colour,
        })
    }

    /// The error of the pose from depth of an object in an image, as a fraction of the diameter.
    pub fn error_from_depth(&self, image: &str, object: u32) -> Option<f64> {
        let pose = self.poses.iter().find(|pose| pose.image == image && pose.object == object);
        pose.map(|pose| pose.add_s_of_diameter)
    }
}

/// The samples' objects; the features of each are computed when an image first needs it.
struct Samples<'a> {
    dataset: &'a BopDataset,
    infos: sixfold_mesh::ModelsInfo,
    folder: &'a Path,
    known: BTreeMap<u32, Known>,
}

impl<'a> Samples<'a> {
    fn new(dataset: &'a BopDataset, folder: &'a Path) -> Result<Samples<'a>> {
        let infos = dataset.models_info(Models::Rendering)?.unwrap_or_default();
        Ok(Samples { dataset, infos, folder, known: BTreeMap::new() })
    }

    /// Prepares the objects of an image, several at a time.
    fn prepare(&mut self, targets: &[&Target]) -> Result<()> {
        let ids: BTreeSet<u32> = targets.iter().filter_map(|t| t.object).map(|o| o.obj_id).collect();
        let missing: Vec<u32> = ids.into_iter().filter(|id| !self.known.contains_key(id)).collect();
        let new = |&id: &u32| Ok((id, Known::new(self.dataset, &self.infos, id, self.folder)?));
        let new: Vec<Result<_>> = missing.par_iter().map(new).collect();
        for object in new {
            let (id, (known, notes)) = object?;
            notes.iter().for_each(|note| eprintln!("note: {note}"));
            self.known.insert(id, known);
        }
        Ok(())
    }
}

/// Poses from depth, in the forms for display and for scoring.
#[derive(Default)]
struct FromDepth {
    poses: Vec<SamplePose>,
    results: Vec<Estimate>,
    pictures: Vec<PathBuf>,
}

impl FromDepth {
    /// Searches for the targets of one image and draws the poses.
    fn add_image(
        &mut self,
        scene: &Scene,
        im_id: u32,
        targets: &[&Target],
        samples: &mut Samples<'_>,
        out: &mut Pictures,
        progress: &mut Progress,
    ) -> Result<()> {
        let scene_id = scene.scene_id;
        let camera = scene.camera(im_id)?;
        let Some(depth) = scene.depth(im_id)? else { return Ok(()) };
        let prepared = DepthRegion::from_depth(&depth, &camera, None, &DepthOptions::default())?;
        samples.prepare(targets)?;
        let mut found = vec![];
        for object in targets.iter().filter_map(|t| t.object) {
            let id = object.obj_id;
            let Some(known) = samples.known.get(&id) else { continue };
            let began = Instant::now();
            let estimates = estimate(&prepared, &known.model, &PpfOptions::default());
            let seconds = began.elapsed().as_secs_f64();
            progress.step(format!("image {im_id}, object {id}"));
            let truth = scene.image(im_id)?.ground_truth.iter().find(|g| g.obj_id == id);
            for e in estimates {
                let pose = e.camera_from_object;
                self.results.push(Estimate::new(scene_id, im_id, id, e.confidence, pose));
                found.push((id, pose, e.confidence));
                let Some(truth) = truth else { continue };
                let error = add_s(known, pose, truth);
                self.poses.push(SamplePose {
                    image: format!("{scene_id}/{im_id}"),
                    depth: Some(if scene_id >= SIMULATED { "simulated" } else { "real" }),
                    object: id,
                    add_s_mm: 1000.0 * error,
                    add_s_of_diameter: error / known.model.diameter(),
                    confidence: e.confidence,
                    seconds,
                });
            }
        }
        let drawn: Vec<Drawn<'_>> = found
            .iter()
            .filter_map(|(id, pose, confidence)| {
                Some(Drawn::of_dataset(*id, samples.known.get(id)?.mesh()?, *pose, *confidence))
            })
            .collect();
        let background = scene.rgb(im_id)?.unwrap_or_else(|| overlay::depth_picture(&depth));
        let picture = overlay::draw(&background, &camera, &drawn);
        self.pictures.extend(out.write(&format!("{scene_id:06}_{im_id:06}.png"), &picture));
        Ok(())
    }
}
