//! Runs a method on all targets of a BOP dataset and writes a result CSV, image by image. A stopped run can be resumed.

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
    Cache, EstimatorError, Memo, Need, Object, PoseEstimate, PoseEstimator, PreparedObject, Query, Region,
    check_min_confidence,
};
use sixfold_geometry::{Camera, RgbImage};
use sixfold_io::{WriteLock, write_atomically};
use sixfold_mesh::{Mesh, ModelInfo, ModelsInfo};

use crate::error::{RunError, describe};
use crate::inputs::Inputs;
use crate::overruled::left_standing;
use crate::record::{RunOptions, RunRecord};
use crate::regions::RegionSource;

/// An object of a dataset with its mesh and the folder of what methods derive from it.
///
/// # Errors
/// [`RunError`] when its model is missing or broken.
pub fn dataset_object(
    dataset: &BopDataset,
    id: u32,
    infos: Option<&ModelsInfo>,
    cache: &Cache,
) -> Result<Object, RunError> {
    let mesh = dataset.model(id, Models::Rendering)?;
    let info = infos.and_then(|i| i.0.get(&id)).cloned().unwrap_or_else(|| ModelInfo::of_mesh(&mesh));
    let folder = cache.of_mesh(&mesh, &info)?;
    let name = format!("object {id} (obj_{id:06}.ply)");
    Ok(Object { id: Some(id), folder, ..Object::of_mesh(name, mesh, info) })
}

/// A method, a dataset, and where the results go.
pub struct DatasetRun<'a> {
    /// The method.
    pub estimator: &'a dyn PoseEstimator,
    /// The dataset.
    pub dataset: &'a BopDataset,
    /// Its targets, one object each.
    pub targets: &'a [Target],
    /// The regions in which they are searched.
    pub regions: &'a RegionSource,
    /// Poses of lower confidence are left out; `None` for the method's own threshold.
    pub min_confidence: Option<f64>,
    /// The cache for data that methods derive from the dataset's models.
    pub cache: &'a Cache,
    /// The options on which the results depend: a run can only be resumed with the same ones.
    pub options: &'a RunOptions,
}

/// Progress events of a run.
pub enum DatasetEvent<'e> {
    /// An image, `scene/image`, is done, now or in an earlier run.
    Image {
        /// Its name.
        image: String,
        /// Whether it was done in an earlier run.
        earlier: bool,
    },
    /// A note for the user.
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
    /// The objects found.
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

/// Summary of a run.
#[derive(Debug, Serialize)]
pub struct DatasetSummary {
    /// Images with targets.
    pub images: usize,
    /// Targets in them.
    pub targets: usize,
    /// Rows of the result file.
    pub poses: usize,
    /// Images and targets that were left out, with reasons.
    pub skipped: Vec<String>,
    /// Mean seconds per image, over the images of this run.
    pub seconds_per_image: Option<f64>,
    /// The result file.
    pub results: String,
}

/// A model of the dataset, read and prepared when it is first needed.
struct Known {
    mesh: Arc<Mesh>,
    prepared: Box<dyn PreparedObject>,
}

/// The images and targets of a run.
struct Work {
    infos: Option<ModelsInfo>,
    known: BTreeMap<u32, Known>,
    scenes: BTreeMap<u32, Scene>,
    /// Targets by scene and image.
    images: BTreeMap<(u32, u32), Vec<Target>>,
}

impl DatasetRun<'_> {
    /// Estimates all targets and appends the rows of every image to `results` as soon as it is done. Stops between images when
    /// `stop` is set; an invalid image is left out and reported. One run at a time writes a file; a later run can resume it only
    /// with the same options and the same contents of the dataset's files.
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
        // Lock before anything is read; otherwise rows that another run writes meanwhile would be taken for rows of this one.
        let _lock = WriteLock::take(results)?;
        if let Some(note) = self.regions.without_match(self.targets) {
            events(DatasetEvent::Note(note))?;
        }
        let mut record = RunRecord::open(results, self.estimator.name(), self.options)?;
        let infos = self.dataset.models_info(Models::Rendering)?;
        let mut work =
            Work { infos, known: BTreeMap::new(), scenes: BTreeMap::new(), images: BTreeMap::new() };
        for t in self.targets {
            work.images.entry((t.scene_id, t.im_id)).or_default().push(*t);
            if let Entry::Vacant(place) = work.scenes.entry(t.scene_id) {
                place.insert(self.dataset.scene(t.scene_id)?);
            }
        }
        let ids: BTreeSet<u32> = self.targets.iter().filter_map(|t| t.object).map(|o| o.obj_id).collect();
        for id in ids {
            let held = self.estimator.held(id);
            record.object(id, &Inputs::of_object(self.dataset, id, work.infos.as_ref(), held))?;
        }
        record.check_images(stop, |scene_id, im_id| self.inputs_of(&work, scene_id, im_id))?;
        let mut rows = open_results(results, &mut record, events)?;
        let mut summary = DatasetSummary {
            images: work.images.len(),
            targets: self.targets.len(),
            poses: rows.existing().len(),
            skipped: vec![],
            seconds_per_image: None,
            results: results.display().to_string(),
        };
        let done = self.images(&mut work, &mut record, &mut rows, &mut summary, stop, events);
        // Save finished images, whatever ended the loop.
        record.save()?;
        done.map(|()| summary)
    }

    /// The inputs of an image's poses. An image that is no longer a target counts as having other targets.
    fn inputs_of(&self, work: &Work, scene_id: u32, im_id: u32) -> Inputs {
        let targets = work.images.get(&(scene_id, im_id));
        match (work.scenes.get(&scene_id), targets) {
            (Some(scene), Some(targets)) => {
                Inputs::of_image(scene, im_id, targets, &self.estimator.needs(), self.regions)
            }
            _ => Inputs::without_targets(self.dataset.root()),
        }
    }

    /// Estimates all images that are not done yet.
    fn images(
        &self,
        work: &mut Work,
        record: &mut RunRecord,
        rows: &mut ResultsAppender,
        summary: &mut DatasetSummary,
        stop: &AtomicBool,
        events: &mut dyn FnMut(DatasetEvent<'_>) -> Result<(), RunError>,
    ) -> Result<(), RunError> {
        let mut seconds = vec![];
        let images: Vec<(u32, u32)> = work.images.keys().copied().collect();
        for (scene_id, im_id) in images {
            check(stop)?;
            let image = format!("{scene_id}/{im_id}");
            if record.is_done(scene_id, im_id) {
                events(DatasetEvent::Image { image, earlier: true })?;
                continue;
            }
            // Hash the inputs before they are read: if a file changes in between, the next run refuses to resume.
            let inputs = self.inputs_of(work, scene_id, im_id);
            self.prepare(work, (scene_id, im_id), stop, events)?;
            let (scene, targets) = (&work.scenes[&scene_id], &work.images[&(scene_id, im_id)]);
            let start = Instant::now();
            match self.estimate_image(scene, im_id, targets, &work.known, events) {
                Err(error) => summary.skipped.push(format!("image {image}: {}", describe(&error))),
                Ok(found) => {
                    let time = start.elapsed().as_secs_f64();
                    seconds.push(time);
                    rows.append(&rows_of(&found, (scene_id, im_id), time))?;
                    let count = found.len();
                    summary.poses += count;
                    summary.seconds_per_image = Some(seconds.iter().sum::<f64>() / seconds.len() as f64);
                    // Before the image is recorded: if the run is killed before the overlay is drawn, the next run draws it.
                    events(DatasetEvent::Result(&ImageResult { scene, scene_id, im_id, found }))?;
                    record.finished((scene_id, im_id), count, &inputs)?;
                }
            }
            events(DatasetEvent::Image { image, earlier: false })?;
        }
        Ok(())
    }

    /// Reads and prepares the models of an image's targets that were not prepared before.
    fn prepare(
        &self,
        work: &mut Work,
        image: (u32, u32),
        stop: &AtomicBool,
        events: &mut dyn FnMut(DatasetEvent<'_>) -> Result<(), RunError>,
    ) -> Result<(), RunError> {
        let ids: BTreeSet<u32> =
            work.images[&image].iter().filter_map(|t| t.object).map(|o| o.obj_id).collect();
        for id in ids {
            check(stop)?;
            if let Entry::Vacant(place) = work.known.entry(id) {
                place.insert(self.known(id, work.infos.as_ref(), events)?);
            }
        }
        Ok(())
    }

    /// Reads and prepares a model of the dataset.
    fn known(
        &self,
        id: u32,
        infos: Option<&ModelsInfo>,
        events: &mut dyn FnMut(DatasetEvent<'_>) -> Result<(), RunError>,
    ) -> Result<Known, RunError> {
        let object = dataset_object(self.dataset, id, infos, self.cache)?;
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
        // One query for the whole image: data that depends only on the image is computed for the first object.
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
                    // A region that cannot be searched affects only its own target.
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
        let standing = left_standing(&found.iter().map(|p| &p.estimate).collect::<Vec<_>>());
        let mut stands = standing.into_iter();
        found.retain(|_| stands.next().unwrap_or(true));
        Ok(found)
    }

    /// The inputs of an image that the method needs.
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
        if rgb.is_none() && depth.is_none() {
            let advice = "simulate its depth with `sixfold simulate-depth`";
            return Err(EstimatorError::Input { what: "image, of depth or of colour", method, advice }.into());
        }
        Ok(Input { camera, rgb, depth, memo: Memo::default() })
    }
}

/// An image, prepared for a method.
struct Input {
    camera: Camera,
    rgb: Option<RgbImage>,
    depth: Option<Arc<PreparedDepth>>,
    /// What methods keep of the image, for all targets in it.
    memo: Memo,
}

impl Input {
    fn query<'q>(&'q self, region: Option<&'q Region>, min_confidence: f64) -> Query<'q> {
        Query {
            rgb: self.rgb.as_ref(),
            depth: self.depth.as_ref(),
            region,
            min_confidence,
            image_memo: self.memo.clone(),
            ..Query::new(&self.camera)
        }
    }
}

/// An error once the caller has asked to stop.
pub(crate) fn check(stop: &AtomicBool) -> Result<(), RunError> {
    if stop.load(Ordering::Relaxed) { Err(RunError::Interrupted) } else { Ok(()) }
}

/// The rows of an image, all with the total time of the image.
fn rows_of(found: &[PosedObject<'_>], (scene_id, im_id): (u32, u32), time: f64) -> Vec<Estimate> {
    let row = |p: &PosedObject<'_>| Estimate {
        time: Some(time),
        ..Estimate::new(scene_id, im_id, p.obj_id, p.estimate.confidence, p.estimate.camera_from_object)
    };
    found.iter().map(row).collect()
}

/// Opens a result file for appending. Removes what an interrupted run did not finish: an incomplete row, and rows of images that
/// are not in the record.
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
    record.forget_unless_whole(results.existing().iter().map(|e| (e.scene_id, e.im_id)));
    let unfinished = results.existing().iter().find(|e| !record.is_done(e.scene_id, e.im_id));
    if let Some(Estimate { scene_id, im_id, .. }) = unfinished {
        let text = format!(
            "{}: the run was cut off before image {scene_id}/{im_id} was finished; it is computed again",
            path.display()
        );
        events(DatasetEvent::Note(text))?;
        drop(results);
        keep_finished(path, record).map_err(|source| RunError::Io { path: path.into(), source })?;
        results = ResultsAppender::open(path)?;
    }
    Ok(results)
}

/// Keeps only the header and the rows of finished images in a result file, unchanged.
fn keep_finished(path: &Path, record: &RunRecord) -> std::io::Result<()> {
    let text = std::fs::read_to_string(path)?;
    let finished = |line: &&str| {
        let mut columns = line.split(',').map(|c| c.trim().parse::<u32>().ok());
        let image = columns.next().flatten().zip(columns.next().flatten());
        image.is_none_or(|(scene_id, im_id)| record.is_done(scene_id, im_id))
    };
    let kept: String = text.split_inclusive('\n').filter(finished).collect();
    write_atomically(path, kept.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn queries_of_one_image_share_what_depends_on_the_image_alone() {
        let camera = Camera::new(300.0, 300.0, 159.5, 119.5, 320, 240).unwrap();
        let input = Input { camera, rgb: None, depth: None, memo: Memo::default() };
        let (a, b) = (input.query(None, 0.0), input.query(None, 0.0));
        let kept = |memo: &Memo| memo.get_or_default::<Vec<u8>>();
        assert!(Arc::ptr_eq(&kept(&a.image_memo), &kept(&b.image_memo)));
        assert!(!Arc::ptr_eq(&kept(&a.memo), &kept(&b.memo)));
        let other = a.passed_on(2, 0.5);
        assert!(Arc::ptr_eq(&kept(&a.image_memo), &kept(&other.image_memo)));
    }
}
