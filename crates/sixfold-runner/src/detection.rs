//! Runs a detector on all images of a dataset and writes one file of COCO detections. A stopped run can be resumed.
//!
//! The file is written as a whole at the end. Until then the rows are in `FILE.part`, with a record beside it as for result files
//! ([`RunOptions`]). Both are written at most once a second and removed when the run is complete.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use serde::Serialize;
use sixfold_bop::{BopDataset, Detection, DetectionRows, Rle, Scene};
use sixfold_estimator::ObjectDetector;
use sixfold_geometry::RgbImage;
use sixfold_io::WriteLock;

use crate::dataset::check;
use crate::error::{RunError, describe};
use crate::inputs::Inputs;
use crate::record::{RunOptions, RunRecord};

/// A detector's detections in an image, in COCO's form. Only those of the objects `ids`, if any are given.
///
/// # Errors
/// [`RunError::Estimator`] if the image cannot be searched.
pub fn detections(
    detector: &dyn ObjectDetector,
    image: &RgbImage,
    ids: &[u32],
    (scene_id, image_id): (u32, u32),
) -> Result<Vec<Detection>, RunError> {
    let start = Instant::now();
    let found = detector.detect(image)?;
    let time = start.elapsed().as_secs_f64();
    let wanted = found.into_iter().filter(|d| ids.is_empty() || ids.contains(&d.object_id));
    wanted
        .map(|d| {
            Ok(Detection {
                scene_id,
                image_id,
                category_id: d.object_id,
                score: d.region.score,
                bbox: Some(d.region.bbox),
                segmentation: d.region.mask.as_ref().map(Rle::encode).transpose()?,
                time: Some(time),
            })
        })
        .collect()
}

/// A detection as JSON for programs and people.
#[derive(Debug, Serialize)]
pub struct FoundDetection {
    /// Id of the object.
    pub object_id: u32,
    /// Its name, if it has one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub object: Option<String>,
    /// Confidence, 0 to 1.
    pub score: f64,
    /// x, y, width, height in pixels.
    pub bbox: [f64; 4],
    /// Number of pixels of the mask.
    pub mask_pixels: Option<u64>,
}

impl FoundDetection {
    /// A detection of one of these named objects, or of another. `None` for a detection without a box, which detectors do not return.
    pub fn new(d: &Detection, names: &BTreeMap<u32, String>) -> Option<FoundDetection> {
        let b = d.bbox?;
        Some(FoundDetection {
            object_id: d.category_id,
            object: names.get(&d.category_id).cloned(),
            score: d.score,
            bbox: [b.x, b.y, b.width, b.height],
            mask_pixels: d.segmentation.as_ref().map(Rle::area),
        })
    }
}

/// A detector and the images to search.
pub struct DetectionRun<'a> {
    /// The detector.
    pub detector: &'a dyn ObjectDetector,
    /// The dataset.
    pub dataset: &'a BopDataset,
    /// Scene and image, ascending.
    pub images: &'a [(u32, u32)],
    /// Only detections of these objects are kept; all if empty.
    pub ids: &'a [u32],
    /// The options on which detections depend: a run can only be resumed with the same ones.
    pub options: &'a RunOptions,
}

/// Progress events of a run.
pub enum DetectionEvent<'e> {
    /// The detections in an image.
    Found {
        /// The scene.
        scene: &'e Scene,
        /// The image's number.
        im_id: u32,
        /// The image.
        image: &'e RgbImage,
        /// The detections in it.
        detections: &'e [Detection],
    },
    /// An image, `scene/image`, is done, now or in an earlier run.
    Image {
        /// Its name.
        image: String,
        /// Whether it was done in an earlier run.
        earlier: bool,
    },
}

/// Summary of a run.
#[derive(Debug, Serialize)]
pub struct DetectionSummary {
    /// Images that were searched.
    pub images: usize,
    /// Detections in them.
    pub detections: usize,
    /// Images that were left out, with reasons.
    pub skipped: Vec<String>,
    /// Mean seconds per image, over the images of this run.
    pub seconds_per_image: Option<f64>,
    /// The file of detections.
    pub file: PathBuf,
}

/// The rows of an unfinished run, on disk with their record.
struct Part {
    path: PathBuf,
    rows: DetectionRows,
    record: RunRecord,
    saved: Instant,
    /// Duration of the last save.
    cost: Duration,
}

/// Saving takes at most this fraction (one in N) of the time, because it writes all rows again.
const SAVING: u32 = 20;

impl Part {
    /// Opens the part of `out`, without the rows of images that are not requested or were not finished.
    fn open(out: &Path, options: &RunOptions, images: &[(u32, u32)]) -> Result<Part, RunError> {
        let mut path = out.as_os_str().to_owned();
        path.push(".part");
        let path = PathBuf::from(path);
        let mut record = RunRecord::open(&path, "detector", options)?;
        let mut rows = if path.exists() { DetectionRows::read(&path)? } else { DetectionRows::default() };
        rows.keep_images(|scene_id, im_id| images.binary_search(&(scene_id, im_id)).is_ok());
        record.forget_unless_whole(rows.images());
        rows.keep_images(|scene_id, im_id| record.is_done(scene_id, im_id));
        Ok(Part { path, rows, record, saved: Instant::now(), cost: Duration::ZERO })
    }

    fn save(&mut self) -> Result<(), RunError> {
        let start = Instant::now();
        self.rows.write(&self.path)?;
        self.record.save()?;
        (self.saved, self.cost) = (Instant::now(), start.elapsed());
        Ok(())
    }

    fn save_if_due(&mut self) -> Result<(), RunError> {
        let due = self.record.is_due() && self.saved.elapsed() >= SAVING * self.cost;
        if due { self.save() } else { Ok(()) }
    }

    /// Removes both files once the rows are in the final file. A record without the first file is ignored by the next run.
    fn remove(self) -> Result<(), RunError> {
        if self.path.exists() {
            std::fs::remove_file(&self.path).map_err(|source| RunError::Io { path: self.path, source })?;
        }
        self.record.remove()
    }
}

impl DetectionRun<'_> {
    /// Searches all images and writes the detections to `out`, as a whole at the end. An image that cannot be read is left out and
    /// reported. Stops between images when `stop` is set; a later run with the same options resumes if the finished images are
    /// unchanged. After a run that left images out, the next one searches only these. One run at a time writes a file.
    ///
    /// # Errors
    /// [`RunError`].
    pub fn run(
        &self,
        out: &Path,
        stop: &AtomicBool,
        events: &mut dyn FnMut(DetectionEvent<'_>),
    ) -> Result<DetectionSummary, RunError> {
        let _lock = WriteLock::take(out)?;
        let mut part = Part::open(out, self.options, self.images)?;
        let mut scene = None;
        part.record.check_images(stop, |scene_id, im_id| match self.scene(&mut scene, scene_id) {
            Ok(scene) => Inputs::of_colour(scene, im_id),
            // If it cannot be read, this is reported when its images are searched.
            Err(_) => Inputs::default(),
        })?;
        let (mut skipped, mut seconds) = (vec![], vec![]);
        let done = self.images(&mut part, &mut skipped, &mut seconds, stop, events);
        // Save finished images, whatever ended the loop.
        part.save()?;
        done?;
        part.rows.sort_by_image();
        part.rows.write(out)?;
        let detections = part.rows.len();
        if skipped.is_empty() {
            part.remove()?;
        }
        Ok(DetectionSummary {
            images: self.images.len(),
            detections,
            skipped,
            seconds_per_image: (!seconds.is_empty())
                .then(|| seconds.iter().sum::<f64>() / seconds.len() as f64),
            file: out.to_owned(),
        })
    }

    /// Searches all images that are not done yet.
    fn images(
        &self,
        part: &mut Part,
        skipped: &mut Vec<String>,
        seconds: &mut Vec<f64>,
        stop: &AtomicBool,
        events: &mut dyn FnMut(DetectionEvent<'_>),
    ) -> Result<(), RunError> {
        let mut scene: Option<Scene> = None;
        for &(scene_id, im_id) in self.images {
            check(stop)?;
            let image = format!("{scene_id}/{im_id}");
            if part.record.is_done(scene_id, im_id) {
                events(DetectionEvent::Image { image, earlier: true });
                continue;
            }
            let scene = self.scene(&mut scene, scene_id)?;
            // Hash the image before it is read: if it changes in between, the next run refuses to resume.
            let inputs = Inputs::of_colour(scene, im_id);
            match self.search(scene, im_id, events) {
                Ok((found, time)) => {
                    part.rows.add(&found);
                    part.record.add((scene_id, im_id), found.len(), &inputs);
                    part.save_if_due()?;
                    seconds.push(time);
                }
                Err(error) => skipped.push(format!("image {image}: {}", describe(&error))),
            }
            events(DetectionEvent::Image { image, earlier: false });
        }
        Ok(())
    }

    /// A scene, read unless it is the same as the last one.
    fn scene<'s>(&self, last: &'s mut Option<Scene>, scene_id: u32) -> Result<&'s Scene, RunError> {
        Ok(match last.take().filter(|s| s.scene_id == scene_id) {
            Some(same) => last.insert(same),
            None => last.insert(self.dataset.scene(scene_id)?),
        })
    }

    /// The detections in an image and the seconds it took.
    fn search(
        &self,
        scene: &Scene,
        im_id: u32,
        events: &mut dyn FnMut(DetectionEvent<'_>),
    ) -> Result<(Vec<Detection>, f64), RunError> {
        let image =
            scene.rgb(im_id)?.ok_or(RunError::Lacks { what: "colour image", user: "the detector" })?;
        let start = Instant::now();
        let found = detections(self.detector, &image, self.ids, (scene.scene_id, im_id))?;
        let time = start.elapsed().as_secs_f64();
        events(DetectionEvent::Found { scene, im_id, image: &image, detections: &found });
        Ok((found, time))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;
    use std::sync::atomic::Ordering;

    use sixfold_bop::{GroundTruth, NewImage, SceneWriter};
    use sixfold_estimator::{DetectedObject, EstimatorError, Region};
    use sixfold_geometry::{Camera, Pose, Rect, Vec3};

    use super::*;

    /// A test detector: finds one box per image, with a score that depends on the image's colour; records the colours and requests
    /// a stop after some images.
    struct Colours {
        seen: Mutex<Vec<u8>>,
        stop_after: usize,
        stop: AtomicBool,
    }

    impl Colours {
        fn new(stop_after: usize) -> Colours {
            Colours { seen: Mutex::default(), stop_after, stop: AtomicBool::new(false) }
        }
    }

    impl ObjectDetector for Colours {
        fn check_object(&self, _: u32) -> Result<(), EstimatorError> {
            Ok(())
        }

        fn detect(&self, image: &RgbImage) -> Result<Vec<DetectedObject>, EstimatorError> {
            let mut seen = self.seen.lock().unwrap();
            let colour = image[(0, 0)][0];
            seen.push(colour);
            self.stop.store(seen.len() >= self.stop_after, Ordering::Relaxed);
            let bbox = Rect { x: 1.0, y: 2.0, width: f64::from(colour) / 7.0, height: 3.0 };
            let score = f64::from(f32::from(colour) / 255.0);
            let region = Region { bbox, score, mask: None, exact: false };
            Ok(vec![DetectedObject { object_id: 3, region }])
        }
    }

    /// Four images of two scenes; for example, image 4 of scene 2 is grey 9.
    fn dataset(root: &Path) -> Vec<(u32, u32)> {
        let camera = Camera::new(60.0, 60.0, 31.5, 23.5, 64, 48).unwrap();
        let images = [(1, 0, 40), (1, 5, 80), (2, 4, 9), (2, 7, 200)];
        for scene_id in [1, 2] {
            let mut writer = SceneWriter::new(root, "test", scene_id);
            for (_, im_id, grey) in images.iter().filter(|i| i.0 == scene_id) {
                let rgb = RgbImage::filled(64, 48, [*grey; 3]);
                let truth = [GroundTruth::new(3, Pose::from_translation(Vec3::z()))];
                let image = NewImage::new(*im_id, &camera);
                writer.add(&NewImage { rgb: Some(&rgb), ground_truth: &truth, ..image }).unwrap();
            }
            writer.finish().unwrap();
        }
        images.map(|(scene_id, im_id, _)| (scene_id, im_id)).to_vec()
    }

    fn options(threshold: &str) -> RunOptions {
        let mut options = RunOptions::default();
        options.add("threshold", threshold);
        options
    }

    /// Runs until the detector requests a stop; returns the images that it searched.
    fn run(
        root: &Path,
        images: &[(u32, u32)],
        detector: &Colours,
        options: &RunOptions,
    ) -> (Result<DetectionSummary, RunError>, Vec<u8>) {
        let dataset = BopDataset::open(root, "test").unwrap();
        let run = DetectionRun { detector, dataset: &dataset, images, ids: &[], options };
        let summary = run.run(&root.join("found.json"), &detector.stop, &mut |_| ());
        (summary, std::mem::take(&mut *detector.seen.lock().unwrap()))
    }

    /// The file without measured times.
    fn found(root: &Path) -> String {
        let text = std::fs::read_to_string(root.join("found.json")).unwrap();
        let rows = text.lines().map(|line| line.split("\"time\"").next().unwrap().to_owned());
        rows.collect::<Vec<_>>().join("\n")
    }

    fn is_whole(root: &Path) -> bool {
        !root.join("found.json.part").exists() && !root.join("found.json.part.run.json").exists()
    }

    #[test]
    fn a_stopped_run_resumes_and_ends_with_the_same_file() {
        let whole = tempfile::tempdir().unwrap();
        let images = dataset(whole.path());
        let (summary, seen) = run(whole.path(), &images, &Colours::new(9), &options("0.1"));
        assert_eq!((summary.unwrap().detections, seen), (4, vec![40, 80, 9, 200]));
        assert!(is_whole(whole.path()));

        let stopped = tempfile::tempdir().unwrap();
        let root = stopped.path();
        dataset(root);
        let (ended, seen) = run(root, &images, &Colours::new(2), &options("0.1"));
        assert!(matches!(ended, Err(RunError::Interrupted)) && seen == [40, 80]);
        assert!(!root.join("found.json").exists() && !is_whole(root));
        // It is not resumed with other options, nor with another image under a finished number.
        let other = run(root, &images, &Colours::new(9), &options("0.2")).0.unwrap_err().to_string();
        assert!(other.contains("threshold: 0.1, now 0.2") && other.contains("found.json.part"), "{other}");
        let image = root.join("test/000001/rgb/000005.png");
        let before = std::fs::read(&image).unwrap();
        sixfold_io::write_rgb(&image, &RgbImage::filled(64, 48, [7; 3])).unwrap();
        let other = run(root, &images, &Colours::new(9), &options("0.1")).0.unwrap_err().to_string();
        assert!(other.contains("colour image of image 1/5") && other.contains("has changed"), "{other}");
        std::fs::write(&image, before).unwrap();
        // Images whose rows are not in the record are searched again.
        let record = root.join("found.json.part.run.json");
        let text = std::fs::read_to_string(&record).unwrap();
        std::fs::write(&record, text.replace("\"rows\": 1", "\"rows\": 2")).unwrap();
        let (ended, seen) = run(root, &images, &Colours::new(1), &options("0.1"));
        assert!(matches!(ended, Err(RunError::Interrupted)) && seen == [40]);
        let (summary, seen) = run(root, &images, &Colours::new(9), &options("0.1"));
        assert_eq!((summary.unwrap().detections, seen), (4, vec![80, 9, 200]));
        assert!(is_whole(root));
        assert_eq!(found(root), found(whole.path()));
    }

    #[test]
    fn an_image_that_was_left_out_is_all_that_the_next_run_searches() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path();
        let images = dataset(root);
        let image = root.join("test/000002/rgb/000004.png");
        let before = std::fs::read(&image).unwrap();
        std::fs::write(&image, b"no image").unwrap();
        let (summary, seen) = run(root, &images, &Colours::new(9), &options("0.1"));
        let summary = summary.unwrap();
        assert_eq!((summary.detections, summary.skipped.len(), seen), (3, 1, vec![40, 80, 200]));
        std::fs::write(&image, before).unwrap();
        // With fewer images, the rows of the others are removed.
        let (summary, seen) = run(root, &images[1..], &Colours::new(9), &options("0.1"));
        assert_eq!((summary.unwrap().detections, seen), (3, vec![9]));
        assert!(is_whole(root));
        let ids: Vec<bool> = ["\"image_id\":5", "\"image_id\":4", "\"image_id\":7", "\"image_id\":0"]
            .map(|id| found(root).contains(id))
            .to_vec();
        assert_eq!(ids, [true, true, true, false]);
    }
}
