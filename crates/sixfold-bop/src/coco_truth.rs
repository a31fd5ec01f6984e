//! Ground truth of 2D detection from poses, for datasets without `scene_gt_coco.json`, and scores of detections that take the
//! visibility of objects into account.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::Serialize;
use serde_json::json;
use sixfold_io::write_atomically;
use sixfold_mesh::Mesh;

use crate::coco::{Annotation, CocoGroundTruth, Detection};
use crate::coco_score::{CocoScores, IouType, evaluate_coco};
use crate::dataset::{BopDataset, MaskKind, Models};
use crate::dataset_error::DatasetError;
use crate::rle::Rle;
use crate::visibility::{VISIBILITY_DELTA, ground_truth_visibility};

/// Objects less visible than this are marked as crowds: detections of them are neither right nor wrong. BOP leaves them
/// out of its targets too.
const MIN_VISIBILITY: f64 = 0.1;

/// Ground truth of detection with the visible fraction of every object.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct VisibleTruth {
    /// Images and annotations.
    pub truth: CocoGroundTruth,
    /// The visible fraction of each annotation, 0..=1.
    pub visible: Vec<f64>,
}

impl VisibleTruth {
    /// The ground truth of these images (scene, image): from `scene_gt_coco.json` where all scenes have one, otherwise from
    /// poses ([`VisibleTruth::of_poses`]). `scene_gt_coco.json` does not state how much of an object is visible.
    ///
    /// # Errors
    /// [`DatasetError`].
    pub fn of_images(dataset: &BopDataset, images: &BTreeSet<(u32, u32)>) -> Result<Self, DatasetError> {
        let mut files = vec![];
        for scene_id in dataset.scene_ids() {
            files.push((scene_id, dataset.scene(scene_id)?.dir().join("scene_gt_coco.json")));
        }
        if !files.iter().all(|(_, file)| file.is_file()) {
            return VisibleTruth::of_poses(dataset, &images.iter().copied().collect::<Vec<_>>());
        }
        let mut truth = CocoGroundTruth::default();
        for (scene_id, file) in files {
            let text =
                std::fs::read(&file).map_err(|source| DatasetError::Read { path: file.clone(), source })?;
            truth.add_scene(scene_id, &text, &file)?;
        }
        truth.images.retain(|image| images.contains(image));
        truth.annotations.retain(|a| images.contains(&(a.scene_id, a.image_id)));
        Ok(VisibleTruth { truth, visible: vec![] })
    }

    /// The ground truth of these images (scene, image): boxes as `bbox_visib` (first pixel, last minus first), masks of
    /// what is visible. Where a scene has no masks or no `scene_gt_info.json`, all annotated objects of an image are
    /// rendered together (with the depth image, if there is one); without a depth image, occluders that are not annotated are
    /// then unknown. Objects that are less than 10 % visible become crowds; objects without visible pixels are left out.
    ///
    /// # Errors
    /// [`DatasetError`].
    pub fn of_poses(dataset: &BopDataset, images: &[(u32, u32)]) -> Result<Self, DatasetError> {
        let mut out = VisibleTruth::default();
        let mut meshes: BTreeMap<u32, Mesh> = BTreeMap::new();
        let mut scenes = BTreeMap::new();
        for &(scene_id, im_id) in images {
            if let std::collections::btree_map::Entry::Vacant(place) = scenes.entry(scene_id) {
                place.insert(dataset.scene(scene_id)?);
            }
            let scene = &scenes[&scene_id];
            let frame = scene.image(im_id)?;
            out.truth.images.push((scene_id, im_id));
            let mut masks = vec![];
            for index in 0..frame.ground_truth.len() {
                masks.push(scene.mask(im_id, index, MaskKind::Visible)?);
            }
            let mut infos: Vec<_> = match &frame.info {
                Some(info) => info.iter().map(|i| Some((i.bbox_visib, i.visib_fract))).collect(),
                None => vec![None; frame.ground_truth.len()],
            };
            if masks.iter().any(Option::is_none) || infos.iter().any(Option::is_none) {
                for g in &frame.ground_truth {
                    if let std::collections::btree_map::Entry::Vacant(place) = meshes.entry(g.obj_id) {
                        place.insert(dataset.model(g.obj_id, Models::Rendering)?);
                    }
                }
                let placed: Vec<_> =
                    frame.ground_truth.iter().map(|g| (&meshes[&g.obj_id], g.camera_from_object)).collect();
                let depth = scene.depth(im_id)?;
                let rendered =
                    ground_truth_visibility(&placed, &scene.camera(im_id)?, depth.as_ref(), VISIBILITY_DELTA);
                for ((mask, info), rendered) in masks.iter_mut().zip(&mut infos).zip(rendered) {
                    info.get_or_insert((rendered.info.bbox_visib, rendered.info.visib_fract));
                    mask.get_or_insert(rendered.mask_visible);
                }
            }
            for ((truth, mask), info) in frame.ground_truth.iter().zip(masks).zip(infos) {
                let (Some(mask), Some((Some(bbox), fraction))) = (mask, info) else { continue };
                let Ok(rle) = Rle::encode(&mask) else { continue };
                out.truth.annotations.push(Annotation {
                    scene_id,
                    image_id: im_id,
                    category_id: truth.obj_id,
                    bbox,
                    area: rle.area() as f64,
                    iscrowd: fraction < MIN_VISIBILITY,
                    segmentation: Some(rle),
                });
                out.visible.push(fraction);
            }
        }
        Ok(out)
    }
}

impl CocoGroundTruth {
    /// Writes the ground truth as one COCO file that pycocotools reads. COCO has no scenes, so image numbers have to differ
    /// between scenes.
    ///
    /// # Errors
    /// [`DatasetError::Write`], also when two scenes have an image of the same number.
    pub fn write(&self, path: &Path) -> Result<(), DatasetError> {
        let mut ids: Vec<u32> = self.images.iter().map(|i| i.1).collect();
        ids.sort_unstable();
        ids.dedup();
        let failed = |source| DatasetError::Write { path: path.to_owned(), source };
        if ids.len() < self.images.len() {
            let text = "images of several scenes have the same number; write one scene at a time";
            return Err(failed(std::io::Error::other(text)));
        }
        let mut categories: Vec<u32> = self.annotations.iter().map(|a| a.category_id).collect();
        categories.sort_unstable();
        categories.dedup();
        let mut first: BTreeMap<u32, &Annotation> = BTreeMap::new();
        for annotation in &self.annotations {
            first.entry(annotation.image_id).or_insert(annotation);
        }
        let size = |im_id: u32| {
            let of = first.get(&im_id)?.segmentation.as_ref()?;
            Some((of.width(), of.height()))
        };
        let images: Vec<_> = self
            .images
            .iter()
            .map(|(_, id)| {
                let (width, height) = size(*id).unwrap_or((0, 0));
                json!({ "id": id, "width": width, "height": height })
            })
            .collect();
        let annotations: Vec<_> = self
            .annotations
            .iter()
            .enumerate()
            .map(|(index, a)| {
                let mut entry = json!({
                    "id": index + 1,
                    "image_id": a.image_id,
                    "category_id": a.category_id,
                    "iscrowd": u8::from(a.iscrowd),
                    "bbox": [a.bbox.x, a.bbox.y, a.bbox.width, a.bbox.height],
                    "area": a.area,
                });
                if let Some(rle) = &a.segmentation {
                    entry["segmentation"] =
                        json!({ "size": [rle.height(), rle.width()], "counts": rle.to_compressed() });
                }
                entry
            })
            .collect();
        let categories: Vec<_> =
            categories.iter().map(|id| json!({ "id": id, "name": id.to_string() })).collect();
        let whole = json!({ "images": images, "annotations": annotations, "categories": categories });
        write_atomically(path, whole.to_string().as_bytes()).map_err(failed)
    }
}

/// How many objects are found at an overlap of 0.5, and how many detections are false.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FoundAtHalf {
    /// Detections with a lower score were left out.
    pub min_score: f64,
    /// Objects at least this visible counted.
    pub min_visibility: f64,
    /// Number of those objects.
    pub objects: usize,
    /// Fraction of these objects that is found; `None` without objects.
    pub recall: Option<f64>,
    /// Recall of each object that occurs.
    pub recall_of: BTreeMap<u32, f64>,
    /// False detections per image: those that overlap no instance of their object by half, however little of it is visible.
    pub false_per_image: f64,
}

/// Counts directly what COCO averages. For every image and object, detections are matched in order of falling score: each
/// takes the instance that it overlaps most, if the intersection over union of the boxes is at least one half.
pub fn found_at_half(
    truth: &VisibleTruth,
    detections: &[Detection],
    min_score: f64,
    min_visibility: f64,
) -> FoundAtHalf {
    let annotations = &truth.truth.annotations;
    let mut order: Vec<&Detection> = detections.iter().filter(|d| d.score >= min_score).collect();
    order.sort_by(|a, b| b.score.total_cmp(&a.score));
    let mut taken = vec![false; annotations.len()];
    let mut wrong = 0usize;
    let images = truth.truth.images.len();
    let known: BTreeSet<(u32, u32)> = truth.truth.images.iter().copied().collect();
    let mut of_kind: BTreeMap<(u32, u32, u32), Vec<usize>> = BTreeMap::new();
    for (i, a) in annotations.iter().enumerate() {
        of_kind.entry((a.scene_id, a.image_id, a.category_id)).or_default().push(i);
    }
    for d in order {
        if !known.contains(&(d.scene_id, d.image_id)) {
            continue;
        }
        let Some(bbox) = d.bbox.or_else(|| d.segmentation.as_ref().map(Rle::bounding_box)) else { continue };
        let of_kind = of_kind.get(&(d.scene_id, d.image_id, d.category_id)).into_iter().flatten();
        let overlapping: Vec<(usize, f64)> =
            of_kind.map(|&i| (i, annotations[i].bbox.iou(&bbox))).filter(|(_, iou)| *iou >= 0.5).collect();
        let free = overlapping.iter().filter(|(i, _)| !taken[*i]).max_by(|a, b| a.1.total_cmp(&b.1));
        match free {
            Some((index, _)) => taken[*index] = true,
            None => wrong += 1,
        }
    }
    let mut counts: BTreeMap<u32, (usize, usize)> = BTreeMap::new();
    for ((annotation, visible), taken) in annotations.iter().zip(&truth.visible).zip(&taken) {
        if *visible >= min_visibility {
            let count = counts.entry(annotation.category_id).or_default();
            *count = (count.0 + usize::from(*taken), count.1 + 1);
        }
    }
    let (found, objects) = counts.values().fold((0, 0), |(f, n), c| (f + c.0, n + c.1));
    FoundAtHalf {
        min_score,
        min_visibility,
        objects,
        recall: (objects > 0).then(|| found as f64 / objects as f64),
        recall_of: counts.iter().map(|(id, (f, n))| (*id, *f as f64 / *n as f64)).collect(),
        false_per_image: wrong as f64 / images.max(1) as f64,
    }
}

/// COCO's scores of detections, and the fraction of objects found by visibility.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DetectionScores {
    /// Images with ground truth.
    pub images: usize,
    /// Average precision of boxes.
    #[serde(rename = "box")]
    pub boxes: CocoScores,
    /// Average precision of masks, where both sides have some.
    #[serde(rename = "mask")]
    pub masks: Option<CocoScores>,
    /// For objects at least 10 % and at least 40 % visible, where the ground truth states the visibility.
    pub found_at_half: Vec<FoundAtHalf>,
}

/// Scores detections by boxes, by masks where both sides have some, and by the objects found with scores of at least
/// `min_score`.
pub fn score_detections(truth: &VisibleTruth, detections: &[Detection], min_score: f64) -> DetectionScores {
    let boxes = evaluate_coco(&truth.truth, detections, IouType::Box);
    let with_masks = detections.iter().any(|d| d.segmentation.is_some())
        && truth.truth.annotations.iter().any(|a| a.segmentation.is_some());
    let masks = with_masks.then(|| evaluate_coco(&truth.truth, detections, IouType::Mask));
    let known = truth.visible.len() == truth.truth.annotations.len();
    let min_visibility: &[f64] = if known { &[0.1, 0.4] } else { &[] };
    let found_at_half =
        min_visibility.iter().map(|v| found_at_half(truth, detections, min_score, *v)).collect();
    DetectionScores { images: truth.truth.images.len(), boxes, masks, found_at_half }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::Rect;

    fn annotation(image_id: u32, category_id: u32, x: f64) -> Annotation {
        let bbox = Rect { x, y: 10.0, width: 20.0, height: 20.0 };
        Annotation {
            scene_id: 1,
            image_id,
            category_id,
            bbox,
            area: 400.0,
            iscrowd: false,
            segmentation: None,
        }
    }

    fn detection(image_id: u32, category_id: u32, x: f64, score: f64) -> Detection {
        let bbox = Some(Rect { x, y: 10.0, width: 20.0, height: 20.0 });
        Detection { scene_id: 1, image_id, category_id, score, bbox, segmentation: None, time: None }
    }

    #[test]
    fn objects_are_found_once_and_the_rest_is_wrong() {
        let truth = VisibleTruth {
            truth: CocoGroundTruth {
                images: vec![(1, 3), (1, 4)],
                annotations: vec![annotation(3, 5, 10.0), annotation(3, 5, 50.0), annotation(4, 6, 10.0)],
            },
            visible: vec![0.9, 0.3, 1.0],
        };
        let detections = [
            detection(3, 5, 11.0, 0.9),
            detection(3, 5, 13.0, 0.8),
            detection(3, 6, 50.0, 0.7),
            detection(4, 6, 12.0, 0.2),
            detection(9, 6, 12.0, 0.9),
        ];
        let found = found_at_half(&truth, &detections, 0.0, 0.4);
        assert_eq!((found.objects, found.recall), (2, Some(1.0)));
        // The second detection of the same object, and the detection of another object.
        assert_eq!(found.false_per_image, 1.0);
        let sure = found_at_half(&truth, &detections, 0.5, 0.0);
        assert_eq!((sure.objects, sure.recall), (3, Some(1.0 / 3.0)));
        assert_eq!(sure.recall_of, BTreeMap::from([(5, 0.5), (6, 0.0)]));
        assert_eq!(found_at_half(&VisibleTruth::default(), &detections, 0.5, 0.0).recall, None);
    }
}
