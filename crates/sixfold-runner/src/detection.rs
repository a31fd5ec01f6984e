//! A detector on all images of a dataset, into one file of COCO detections.

use std::path::{Path, PathBuf};
use std::time::Instant;

use serde::Serialize;
use sixfold_bop::{BopDataset, Detection, Rle, Scene, write_detections};
use sixfold_estimator::ObjectDetector;
use sixfold_geometry::RgbImage;
use sixfold_io::WriteLock;

use crate::error::{RunError, describe};

/// What a detector sees in an image, as COCO has it. Of `ids` only, where there are any.
///
/// # Errors
/// [`RunError::Estimator`] where the image cannot be searched.
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
    /// Which object.
    pub object_id: u32,
    /// 0 to 1.
    pub score: f64,
    /// x, y, width, height in pixels.
    pub bbox: [f64; 4],
    /// Pixels of the mask.
    pub mask_pixels: Option<u64>,
}

impl FoundDetection {
    /// `None` for a detection without a box, which a detector does not give.
    pub fn new(d: &Detection) -> Option<FoundDetection> {
        let b = d.bbox?;
        Some(FoundDetection {
            object_id: d.category_id,
            score: d.score,
            bbox: [b.x, b.y, b.width, b.height],
            mask_pixels: d.segmentation.as_ref().map(Rle::area),
        })
    }
}

/// A detector and the images that it is to look at.
pub struct DetectionRun<'a> {
    /// The detector.
    pub detector: &'a dyn ObjectDetector,
    /// The dataset.
    pub dataset: &'a BopDataset,
    /// Scene and image, ascending.
    pub images: &'a [(u32, u32)],
    /// Detections of these objects are kept; of all where there are none.
    pub ids: &'a [u32],
}

/// What a run says of its progress.
pub enum DetectionEvent<'e> {
    /// What was found in an image.
    Found {
        /// The scene.
        scene: &'e Scene,
        /// The image's number.
        im_id: u32,
        /// The image.
        image: &'e RgbImage,
        /// What was found in it.
        detections: &'e [Detection],
    },
    /// An image, `scene/image`, is done.
    Image(String),
}

/// What a run did.
#[derive(Debug, Serialize)]
pub struct DetectionSummary {
    /// Images that were searched.
    pub images: usize,
    /// Detections in them.
    pub detections: usize,
    /// What was left out, and why.
    pub skipped: Vec<String>,
    /// Seconds an image took on average.
    pub seconds_per_image: Option<f64>,
    /// The file of detections.
    pub file: PathBuf,
}

impl DetectionRun<'_> {
    /// Looks at all images and writes what was found to `out`, whole at the end. An image that cannot be read is left out and
    /// reported. One run at a time writes a file.
    ///
    /// # Errors
    /// [`RunError`].
    pub fn run(
        &self,
        out: &Path,
        events: &mut dyn FnMut(DetectionEvent<'_>),
    ) -> Result<DetectionSummary, RunError> {
        let _lock = WriteLock::take(out)?;
        let (mut all, mut skipped, mut seconds) = (vec![], vec![], vec![]);
        let mut scene: Option<Scene> = None;
        for &(scene_id, im_id) in self.images {
            let scene = match scene.take().filter(|s| s.scene_id == scene_id) {
                Some(same) => scene.insert(same),
                None => scene.insert(self.dataset.scene(scene_id)?),
            };
            match self.look(scene, im_id, events) {
                Ok((found, time)) => {
                    all.extend(found);
                    seconds.push(time);
                }
                Err(error) => skipped.push(format!("image {scene_id}/{im_id}: {}", describe(&error))),
            }
            events(DetectionEvent::Image(format!("{scene_id}/{im_id}")));
        }
        write_detections(out, &all)?;
        Ok(DetectionSummary {
            images: self.images.len(),
            detections: all.len(),
            skipped,
            seconds_per_image: (!seconds.is_empty())
                .then(|| seconds.iter().sum::<f64>() / seconds.len() as f64),
            file: out.to_owned(),
        })
    }

    /// What is found in an image, and in how many seconds.
    fn look(
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
