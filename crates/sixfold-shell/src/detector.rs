//! A trained detector as the commands use it: model and options in one, detections as COCO has them.

use std::path::Path;
use std::time::Instant;

use anyhow::Result;
use sixfold_bop::{Detection, Rle};
use sixfold_detect::detect::DetectOptions;
use sixfold_detect::model::DetectorModel;
use sixfold_geometry::RgbImage;

/// A detector with what is asked of it.
pub struct Detector {
    model: DetectorModel,
    options: DetectOptions,
}

impl Detector {
    /// The detector of a weight file with its default threshold.
    ///
    /// # Errors
    /// When the file is not that of a detector.
    pub fn load(weights: &Path) -> Result<Detector> {
        let model = DetectorModel::load(weights)?;
        let options = model.options();
        Ok(Detector { model, options })
    }

    /// A detector with options of one's own.
    pub fn new(model: DetectorModel, options: DetectOptions) -> Detector {
        Detector { model, options }
    }

    /// The network.
    pub fn model(&self) -> &DetectorModel {
        &self.model
    }

    /// Detections below `threshold` are left out.
    pub fn with_threshold(self, threshold: f32) -> Detector {
        Detector { options: DetectOptions { threshold, ..self.options }, ..self }
    }

    /// Detections of an image as COCO has them.
    ///
    /// # Errors
    /// When the image cannot be searched.
    pub fn detections(&self, image: &RgbImage, scene_id: u32, image_id: u32) -> Result<Vec<Detection>> {
        let start = Instant::now();
        let found = self.model.detect(image, &self.options)?;
        let time = start.elapsed().as_secs_f64();
        found
            .iter()
            .map(|d| {
                Ok(Detection {
                    scene_id,
                    image_id,
                    category_id: self.model.id_of(d.class),
                    score: f64::from(d.score),
                    bbox: Some(d.bbox),
                    segmentation: d.mask.as_ref().map(Rle::encode).transpose()?,
                    time: Some(time),
                })
            })
            .collect()
    }
}
