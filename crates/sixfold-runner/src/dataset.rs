//! A method on all targets of a BOP dataset, into a result CSV, image by image. A stopped run resumes.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use serde::Serialize;
use sixfold_align::PreparedDepth;
use sixfold_bop::{BopDataset, Estimate, Models, ResultsAppender, Scene, Target};
use sixfold_estimator::{
    Cache, EstimatorError, Need, Object, PoseEstimate, PoseEstimator, PreparedObject, Query, Region,
    check_min_confidence,
};
use sixfold_geometry::{Camera, RgbImage};
use sixfold_mesh::{Mesh, ModelInfo, ModelsInfo};

use crate::error::{RunError, describe};
use crate::record::{RunOptions, RunRecord};
use crate::regions::RegionSource;

/// A method, a dataset, and where the results go.
pub struct DatasetRun<'a> {
    /// The method.
    pub estimator: &'a dyn PoseEstimator,
    /// The dataset.
    pub dataset: &'a BopDataset,
    /// Its targets, one object each.
    pub targets: &'a [Target],
    /// Where they are searched.
    pub regions: &'a RegionSource,
    /// Poses of lower confidence are left out; `None` for the method's own threshold.
    pub min_confidence: Option<f64>,
    /// Where methods keep what they derive from the dataset's models.
    pub cache: &'a Cache,
    /// What decides about the results: a run resumes with the same only.
    pub options: &'a RunOptions,
}

/// What a run says of its progress.
pub enum DatasetEvent<'e> {
    /// An image, `scene/image`, is done, now or in an earlier run.
    Image {
        /// Which.
        image: String,
        /// Whether it was done in an earlier run.
        earlier: bool,
    },
    /// Something that a user should know.
    Note(String),
    /// The poses of an image, whose rows are on disk.
    Result(&'e ImageResult<'e>),
}

/// The poses of one image.
pub struct ImageResult<'e> {
    /// The scene.
    pub scene: &'e Scene,
    /// Its number.
    pub scene_id: u32,
    /// The image.
    pub im_id: u32,
    /// What was found.
    pub found: Vec<PosedObject<'e>>,
}

/// An object of the dataset with a pose.
pub struct PosedObject<'e> {
    /// Its number.
    pub obj_id: u32,
    /// Its mesh.
    pub mesh: &'e Mesh,
    /// Its pose.
    pub estimate: PoseEstimate,
}

/// What a run did.
#[derive(Debug, Serialize)]
pub struct DatasetSummary {
    /// Images with targets.
    pub images: usize,
    /// Targets in them.
    pub targets: usize,
    /// Rows of the result file.
    pub poses: usize,
    /// What was left out, and why.
    pub skipped: Vec<String>,
    /// Seconds an image took on average, of those done now.
    pub seconds_per_image: Option<f64>,
    /// The result file.
    pub results: String,
}

/// A model of the dataset, read and prepared when it is first needed.
struct Known {
    mesh: Arc<Mesh>,
    prepared: Box<dyn PreparedObject>,
}

impl DatasetRun<'_> {
    /// Estimates all targets and appends the rows of every image to `results` at once. Stops between images when `stop` is set;
    /// a broken image is left out and reported.
    ///
    /// # Errors
    /// [`RunError`].
    pub fn run(
        &self,
        results: &Path,
        stop: &AtomicBool,
        events: &mut dyn FnMut(DatasetEvent<'_>) -> Result<(), RunError>,
    ) -> Result<DatasetSummary, RunError> {
        if let Some(min) = self.min_confidence {
            check_min_confidence(min).map_err(EstimatorError::method)?;
        }
        let needs = self.estimator.needs();
        if needs.region == Need::Required && matches!(self.regions, RegionSource::Anywhere) {
            return Err(RunError::NoRegions { method: self.estimator.name() });
        }
        let mut record = RunRecord::open(results, self.estimator.name(), self.options)?;
        let mut rows = open_results(results, &mut record, events)?;
        let infos = self.dataset.models_info(Models::Rendering)?;
        let mut known: BTreeMap<u32, Known> = BTreeMap::new();
        let mut scenes: BTreeMap<u32, Scene> = BTreeMap::new();
        let mut images: BTreeMap<(u32, u32), Vec<Target>> = BTreeMap::new();
        for t in self.targets {
            images.entry((t.scene_id, t.im_id)).or_default().push(*t);
        }
        let mut poses = rows.existing().len();
        let (mut seconds, mut skipped) = (vec![], vec![]);
        for ((scene_id, im_id), targets) in &images {
            if stop.load(Ordering::Relaxed) {
                return Err(RunError::Interrupted);
            }
            let image = format!("{scene_id}/{im_id}");
            if record.is_done(&image) {
                events(DatasetEvent::Image { image, earlier: true })?;
                continue;
            }
            let ids: BTreeSet<u32> = targets.iter().filter_map(|t| t.object).map(|o| o.obj_id).collect();
            for id in ids {
                if let Entry::Vacant(place) = known.entry(id) {
                    let made = self.known(id, infos.as_ref(), events)?;
                    place.insert(made);
                }
            }
            let scene = match scenes.entry(*scene_id) {
                Entry::Occupied(known) => known.into_mut(),
                Entry::Vacant(place) => place.insert(self.dataset.scene(*scene_id)?),
            };
            let start = Instant::now();
            match self.estimate_image(scene, *im_id, targets, &known, events) {
                Err(error) => skipped.push(format!("image {image}: {}", describe(&error))),
                Ok(found) => {
                    let time = start.elapsed().as_secs_f64();
                    seconds.push(time);
                    let row = |p: &PosedObject<'_>| Estimate {
                        time: Some(time),
                        ..Estimate::new(
                            *scene_id,
                            *im_id,
                            p.obj_id,
                            p.estimate.confidence,
                            p.estimate.camera_from_object,
                        )
                    };
                    let new: Vec<Estimate> = found.iter().map(row).collect();
                    rows.append(&new)?;
                    poses += new.len();
                    record.done(image.clone());
                    if new.is_empty() {
                        record.save()?;
                    }
                    let result = ImageResult { scene, scene_id: *scene_id, im_id: *im_id, found };
                    events(DatasetEvent::Result(&result))?;
                }
            }
            events(DatasetEvent::Image { image, earlier: false })?;
        }
        record.save()?;
        Ok(DatasetSummary {
            images: images.len(),
            targets: self.targets.len(),
            poses,
            skipped,
            seconds_per_image: (!seconds.is_empty())
                .then(|| seconds.iter().sum::<f64>() / seconds.len() as f64),
            results: results.display().to_string(),
        })
    }

    /// Reads and prepares a model of the dataset.
    fn known(
        &self,
        id: u32,
        infos: Option<&ModelsInfo>,
        events: &mut dyn FnMut(DatasetEvent<'_>) -> Result<(), RunError>,
    ) -> Result<Known, RunError> {
        let mesh = self.dataset.model(id, Models::Rendering)?;
        let info = infos.and_then(|i| i.0.get(&id)).cloned().unwrap_or_else(|| ModelInfo::of_mesh(&mesh));
        let folder = self.cache.of_mesh(&mesh, &info)?;
        let name = format!("object {id} (obj_{id:06}.ply)");
        let object = Object { id: Some(id), folder, ..Object::of_mesh(name, mesh, info) };
        let prepared = self.estimator.prepare(&object)?;
        for note in prepared.notes() {
            events(DatasetEvent::Note(note.clone()))?;
        }
        let mesh = object.needed_mesh(self.estimator.name())?.clone();
        Ok(Known { mesh, prepared })
    }

    /// The poses of an image's targets.
    fn estimate_image<'e>(
        &self,
        scene: &Scene,
        im_id: u32,
        targets: &[Target],
        known: &'e BTreeMap<u32, Known>,
        events: &mut dyn FnMut(DatasetEvent<'_>) -> Result<(), RunError>,
    ) -> Result<Vec<PosedObject<'e>>, RunError> {
        let input = self.input(scene, im_id)?;
        let min = self.min_confidence.unwrap_or(self.estimator.min_confidence().dataset);
        // One query for the whole image: what depends on the image alone is computed for the first object.
        let mut whole = input.query(None, min);
        let mut found = vec![];
        for target in targets {
            let Some(o) = target.object else { continue };
            let Some(object) = known.get(&o.obj_id) else { continue };
            let posed = |estimate| PosedObject { obj_id: o.obj_id, mesh: &object.mesh, estimate };
            if matches!(self.regions, RegionSource::Anywhere) {
                if o.inst_count == 0 {
                    continue;
                }
                whole.max_instances = o.inst_count;
                let estimates = self.estimator.estimate(object.prepared.as_ref(), &whole)?;
                found.extend(estimates.into_iter().map(posed));
                continue;
            }
            let mesh_of = |id| known.get(&id).map(|k| k.mesh.as_ref());
            for region in self.regions.of_target(scene, target, &o, mesh_of)? {
                let query = input.query(Some(&region), min);
                let estimates = match self.estimator.estimate(object.prepared.as_ref(), &query) {
                    Ok(estimates) => estimates,
                    // One bad region costs its own target only.
                    Err(error @ EstimatorError::Region { .. }) => {
                        let text = format!(
                            "image {}/{im_id}, object {}: {}",
                            target.scene_id,
                            o.obj_id,
                            describe(&error)
                        );
                        events(DatasetEvent::Note(text))?;
                        continue;
                    }
                    Err(error) => return Err(error.into()),
                };
                found.extend(estimates.into_iter().map(posed));
            }
        }
        Ok(found)
    }

    /// What the method needs of an image.
    fn input(&self, scene: &Scene, im_id: u32) -> Result<Input, RunError> {
        let (needs, method) = (self.estimator.needs(), self.estimator.name());
        let camera = scene.camera(im_id)?;
        let rgb = if needs.rgb == Need::Unused { None } else { scene.rgb(im_id)? };
        if rgb.is_none() && needs.rgb == Need::Required {
            let advice = "choose images with colour, or a method that works on depth";
            return Err(EstimatorError::Input { what: "colour image", method, advice }.into());
        }
        let mut depth = None;
        if needs.depth != Need::Unused {
            let read = scene.depth(im_id)?;
            if read.is_none() && needs.depth == Need::Required {
                let advice = "simulate it with `sixfold simulate-depth`";
                return Err(EstimatorError::Input { what: "depth image", method, advice }.into());
            }
            let options = self.estimator.depth_options();
            let prepare = |d| PreparedDepth::new(&d, &camera, &options).map_err(EstimatorError::from);
            depth = read.map(prepare).transpose()?;
        }
        Ok(Input { camera, rgb, depth })
    }
}

/// An image as a method wants it.
struct Input {
    camera: Camera,
    rgb: Option<RgbImage>,
    depth: Option<Arc<PreparedDepth>>,
}

impl Input {
    fn query<'q>(&'q self, region: Option<&'q Region>, min_confidence: f64) -> Query<'q> {
        Query {
            rgb: self.rgb.as_ref(),
            depth: self.depth.as_ref(),
            region,
            min_confidence,
            ..Query::new(&self.camera)
        }
    }
}

/// Opens a result file to append to. Rows are written image by image: only the last image can be there in part, and is done
/// again unless it is known to be whole.
fn open_results(
    path: &Path,
    record: &mut RunRecord,
    events: &mut dyn FnMut(DatasetEvent<'_>) -> Result<(), RunError>,
) -> Result<ResultsAppender, RunError> {
    let mut results = ResultsAppender::open(path)?;
    if let Some(torn) = results.torn() {
        let text = format!("{}: the last line was cut off and is dropped: {torn}", path.display());
        events(DatasetEvent::Note(text))?;
    }
    if let Some(last) = results.existing().last()
        && !record.is_done(&format!("{}/{}", last.scene_id, last.im_id))
    {
        let image = (last.scene_id, last.im_id);
        drop(results);
        drop_last_image(path, image).map_err(|source| RunError::Io { path: path.into(), source })?;
        results = ResultsAppender::open(path)?;
    }
    for e in results.existing() {
        record.done(format!("{}/{}", e.scene_id, e.im_id));
    }
    Ok(results)
}

/// Cuts the rows of this image off the end of a result file.
fn drop_last_image(path: &Path, (scene_id, im_id): (u32, u32)) -> std::io::Result<()> {
    let text = std::fs::read_to_string(path)?;
    let of_image = |line: &&str| {
        let mut columns = line.split(',').map(|c| c.trim().parse::<u32>().ok());
        columns.next().flatten() == Some(scene_id) && columns.next().flatten() == Some(im_id)
    };
    let lines: Vec<&str> = text.split_inclusive('\n').collect();
    let cut: usize = lines.iter().rev().take_while(|l| of_image(l)).map(|l| l.len()).sum();
    std::fs::OpenOptions::new().write(true).open(path)?.set_len((text.len() - cut) as u64)
}
