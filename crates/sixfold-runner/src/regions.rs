//! The regions in which targets of a dataset are searched: boxes of the ground truth, detections from a file or from a
//! detector, or the whole image.

use std::path::Path;
use std::sync::{Mutex, PoisonError};

use sixfold_bop::{
    Adjustment, BopDataset, DatasetError, Detection, Rle, Scene, Target, TargetObject, VISIBILITY_DELTA,
    ground_truth_visibility,
};
use sixfold_estimator::{DetectedObject, ObjectDetector, Region};
use sixfold_geometry::{Camera, Rect};
use sixfold_mesh::Mesh;

use crate::error::RunError;

type LastImage = Option<((u32, u32), Vec<DetectedObject>)>;

/// The source of the regions.
pub enum RegionSource {
    /// In the whole image.
    Anywhere,
    /// In the visible boxes of the ground truth.
    GroundTruth,
    /// In the boxes and masks of a file.
    Detections(Vec<Detection>),
    /// In the detections of a detector, with its answer for the last image.
    Detector(Box<dyn ObjectDetector>, Mutex<LastImage>),
}

impl RegionSource {
    /// A detector of the objects `ids`.
    ///
    /// # Errors
    /// For an object that it was not trained on.
    pub fn of_detector(
        detector: Box<dyn ObjectDetector>,
        ids: impl IntoIterator<Item = u32>,
    ) -> Result<RegionSource, RunError> {
        for id in ids {
            detector.check_object(id)?;
        }
        Ok(RegionSource::Detector(detector, Mutex::new(None)))
    }

    /// The detections of a COCO file, and notes on what was changed or left out, one sentence each.
    ///
    /// # Errors
    /// [`RunError::Dataset`].
    pub fn read(
        dataset: &BopDataset,
        file: &Path,
    ) -> Result<(RegionSource, Vec<String>, Vec<String>), RunError> {
        let read = dataset.detections(file, false)?;
        let (mut changed, mut left_out) = (vec![], vec![]);
        for adjusted in read.adjusted {
            match adjusted.adjustment {
                Adjustment::Clipped | Adjustment::Scene => changed.push(adjusted.message),
                _ => left_out.push(adjusted.message),
            }
        }
        Ok((RegionSource::Detections(read.detections), changed, left_out))
    }

    /// A note for the user if no detection belongs to a target: with wrong scene, image or object ids, all detections are
    /// ignored.
    pub(crate) fn without_match(&self, targets: &[Target]) -> Option<String> {
        let RegionSource::Detections(all) = self else { return None };
        let is_for = |d: &Detection, t: &Target| {
            (d.scene_id, d.image_id, Some(d.category_id)) == (t.scene_id, t.im_id, t.object.map(|o| o.obj_id))
        };
        if all.is_empty() || targets.is_empty() || all.iter().any(|d| targets.iter().any(|t| is_for(d, t))) {
            return None;
        }
        let (d, t) = (&all[0], &targets[0]);
        Some(format!(
            "none of the {} detections is of a target, so nothing can be found: the first one is of scene_id {}, image_id {}, \
             category_id {}, the first target of {}, {}, {}; the numbers of the file have to be those of the dataset",
            all.len(),
            d.scene_id,
            d.image_id,
            d.category_id,
            t.scene_id,
            t.im_id,
            t.object.map_or(0, |o| o.obj_id)
        ))
    }

    /// Regions of a target with their scores: detections best first, as many as there are instances, or the ground truth's.
    /// Empty for [`RegionSource::Anywhere`].
    ///
    /// # Errors
    /// [`RunError`].
    pub fn of_target<'m>(
        &self,
        scene: &Scene,
        target: &Target,
        object: &TargetObject,
        mesh_of: impl Fn(u32) -> Option<&'m Mesh>,
    ) -> Result<Vec<Region>, RunError> {
        Ok(match self {
            RegionSource::Anywhere => vec![],
            RegionSource::GroundTruth => ground_truth_boxes(scene, target.im_id, object.obj_id, mesh_of)?
                .into_iter()
                .map(Region::of_box)
                .collect(),
            RegionSource::Detections(all) => best(all, target, object, &scene.camera(target.im_id)?)?,
            RegionSource::Detector(detector, last) => {
                let image = (target.scene_id, target.im_id);
                let mut last = last.lock().unwrap_or_else(PoisonError::into_inner);
                if last.as_ref().is_none_or(|(of, _)| *of != image) {
                    let rgb = scene.rgb(target.im_id)?;
                    let rgb = rgb.ok_or(RunError::Lacks { what: "colour image", user: "the detector" })?;
                    *last = Some((image, detector.detect(&rgb)?));
                }
                let all = last.as_ref().map_or(&[][..], |(_, all)| all);
                let mut mine: Vec<&DetectedObject> =
                    all.iter().filter(|d| d.object_id == object.obj_id).collect();
                mine.sort_by(|x, y| y.region.score.total_cmp(&x.region.score));
                mine.into_iter().take(object.inst_count).map(|d| d.region.clone()).collect()
            }
        })
    }
}

/// The target's regions among detections, best first.
fn best(
    all: &[Detection],
    target: &Target,
    object: &TargetObject,
    camera: &Camera,
) -> Result<Vec<Region>, RunError> {
    let wanted = (target.scene_id, target.im_id, object.obj_id);
    let mut mine: Vec<&Detection> =
        all.iter().filter(|d| (d.scene_id, d.image_id, d.category_id) == wanted).collect();
    mine.sort_by(|x, y| y.score.total_cmp(&x.score));
    mine.iter()
        .take(object.inst_count)
        .filter_map(|d| Some((d, d.bbox?)))
        .map(|(d, bbox)| {
            let mask = d.segmentation.as_ref().map(Rle::decode);
            if let Some(mask) = &mask {
                let wrong = |source| RunError::Segmentation {
                    object_id: object.obj_id,
                    scene_id: d.scene_id,
                    image_id: d.image_id,
                    source,
                };
                camera.check_image(mask.width(), mask.height()).map_err(wrong)?;
            }
            Ok(Region { score: d.score, mask, ..Region::of_box(bbox) })
        })
        .collect()
}

/// The visible boxes of an object's instances: from `scene_gt_info.json`, or rendered.
fn ground_truth_boxes<'m>(
    scene: &Scene,
    im_id: u32,
    obj_id: u32,
    mesh_of: impl Fn(u32) -> Option<&'m Mesh>,
) -> Result<Vec<Rect>, DatasetError> {
    let image = scene.image(im_id)?;
    if let Some(info) = &image.info {
        return Ok(image
            .ground_truth
            .iter()
            .zip(info)
            .filter(|(g, _)| g.obj_id == obj_id)
            .filter_map(|(_, i)| i.bbox_visib)
            .collect());
    }
    let objects: Vec<_> = image
        .ground_truth
        .iter()
        .filter_map(|g| Some((g.obj_id, mesh_of(g.obj_id)?, g.camera_from_object)))
        .collect();
    let meshes: Vec<_> = objects.iter().map(|(_, mesh, pose)| (*mesh, *pose)).collect();
    let depth = scene.depth(im_id)?;
    let visible = ground_truth_visibility(&meshes, &scene.camera(im_id)?, depth.as_ref(), VISIBILITY_DELTA);
    Ok(objects
        .iter()
        .zip(visible)
        .filter(|((id, ..), _)| *id == obj_id)
        .filter_map(|(_, v)| v.info.bbox_visib)
        .collect())
}
