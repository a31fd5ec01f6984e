//! Where in an image a target is looked for: ground truth's boxes, a file of detections, a detector's, or anywhere.

use std::cell::RefCell;
use std::path::Path;

use anyhow::{Context, Result, anyhow};
use sixfold_bop::{Adjustment, BopDataset, Detection, ReadDetections, Rle, Scene, Target, TargetObject, VISIBILITY_DELTA, ground_truth_visibility, read_detections};
use sixfold_geometry::{Camera, Mask, Rect};
use sixfold_mesh::Mesh;
use sixfold_nn::weights::ModelCard;

use crate::detector::Detector;

/// Where targets are looked for.
pub enum Boxes {
    /// Nothing says where: the whole image.
    Anywhere,
    /// The boxes of the visible ground truth.
    GroundTruth,
    /// The detections of a file.
    Detections(Vec<Detection>),
    /// A detector, and what it found in the image that was looked at last.
    Detector(Box<Detector>, RefCell<LastImage>),
}

/// Where one instance of a target is looked for.
pub struct Region {
    /// Pixels.
    pub bbox: Rect,
    /// The detector's confidence; 1 for the ground truth.
    pub score: f64,
    /// Its visible pixels, of the image's size, where the detection says so.
    pub mask: Option<Mask>,
}

/// Masks are grown by this share of their box's longer side: masks are coarse, and depth shifts against colour.
const MASK_MARGIN: f64 = 0.04;
/// The same for ICP, whose network has its own, finer idea of where the object is: only what lies well beside it is kept out.
const ICP_MARGIN: f64 = 0.12;

impl Region {
    /// The pixels in which a method on depth looks: the mask's where there is one, else the box's, both grown a little.
    pub fn pixels(&self, camera: &Camera) -> Mask {
        match &self.mask {
            Some(mask) => mask.grown(self.margin(MASK_MARGIN)),
            None => box_mask(&self.bbox, camera),
        }
    }

    /// The pixels whose depth may be the object's, where there is a mask.
    pub fn pixels_for_icp(&self) -> Option<Mask> {
        self.mask.as_ref().map(|mask| mask.grown(self.margin(ICP_MARGIN)))
    }

    /// Pixels, two at least.
    fn margin(&self, share: f64) -> usize {
        (share * self.bbox.width.max(self.bbox.height)).ceil().max(2.0) as usize
    }
}

/// Which image was looked at last, and what was found in it.
pub type LastImage = Option<((u32, u32), Vec<Detection>)>;

/// Detections this sure are passed on: a pose's own confidence sorts them further.
const SURE_ENOUGH: f32 = 0.1;

impl Boxes {
    /// A detector of the objects `ids`.
    pub fn of_detector(weights: &Path, ids: impl IntoIterator<Item = u32>) -> Result<Boxes> {
        let detector = Detector::load(weights)?.with_threshold(SURE_ENOUGH);
        for id in ids {
            detector.model().check_object(id).with_context(|| weights.display().to_string())?;
        }
        Ok(Boxes::Detector(Box::new(detector), RefCell::new(None)))
    }

    /// The detections of a file, and what was left out of them.
    pub fn read(dataset: &BopDataset, file: &Path) -> Result<(Boxes, Vec<String>)> {
        let options = ReadDetections { image_size: dataset.image_size(), ..ReadDetections::default() };
        let read = read_detections(file, &options)?;
        let mut skipped = vec![];
        for changed in read.adjusted {
            match changed.adjustment {
                Adjustment::Clipped => eprintln!("note: {}", changed.message),
                _ => skipped.push(changed.message),
            }
        }
        Ok((Boxes::Detections(read.detections), skipped))
    }

    /// The card of the detector, if there is one.
    pub fn detector_card(&self) -> Option<&ModelCard> {
        match self {
            Boxes::Detector(detector, _) => Some(detector.model().card()),
            _ => None,
        }
    }

    /// Boxes of a target with their scores: detections best first, as many as there are instances, or the ground
    /// truth's.
    pub fn of_target<'m>(
        &self,
        scene: &Scene,
        target: &Target,
        object: &TargetObject,
        mesh_of: impl Fn(u32) -> Option<&'m Mesh>,
    ) -> Result<Vec<Region>> {
        Ok(match self {
            Boxes::Anywhere => vec![],
            Boxes::GroundTruth => ground_truth_boxes(scene, target.im_id, object.obj_id, mesh_of)?
                .into_iter()
                .map(|bbox| Region { bbox, score: 1.0, mask: None })
                .collect(),
            Boxes::Detections(all) => best(all, target, object, &scene.camera(target.im_id)?)?,
            Boxes::Detector(detector, last) => {
                let image = (target.scene_id, target.im_id);
                let mut last = last.borrow_mut();
                if last.as_ref().is_none_or(|(of, _)| *of != image) {
                    let rgb = scene.rgb(target.im_id)?;
                    let rgb = rgb.ok_or_else(|| anyhow!("has no colour image, which the detector needs"))?;
                    *last = Some((image, detector.detections(&rgb, target.scene_id, target.im_id)?));
                }
                match last.as_ref() {
                    Some((_, all)) => best(all, target, object, &scene.camera(target.im_id)?)?,
                    None => vec![],
                }
            }
        })
    }
}

/// The target's boxes among detections, best first.
fn best(all: &[Detection], target: &Target, object: &TargetObject, camera: &Camera) -> Result<Vec<Region>> {
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
                camera.check_image(mask.width(), mask.height()).with_context(|| {
                    format!("segmentation of object {} in image {}/{}", object.obj_id, d.scene_id, d.image_id)
                })?;
            }
            Ok(Region { bbox, score: d.score, mask })
        })
        .collect()
}

/// The visible boxes of an object's instances: from `scene_gt_info.json`, or rendered.
fn ground_truth_boxes<'m>(
    scene: &Scene,
    im_id: u32,
    obj_id: u32,
    mesh_of: impl Fn(u32) -> Option<&'m Mesh>,
) -> Result<Vec<Rect>> {
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

/// The pixels of a box, grown a little: boxes are tight and depth shifts against colour.
pub fn box_mask(region: &Rect, camera: &Camera) -> Mask {
    let r = region.scaled(1.1);
    Mask::from_fn(camera.width, camera.height, |x, y| {
        let (x, y) = (x as f64, y as f64);
        x >= r.x && y >= r.y && x < r.x + r.width && y < r.y + r.height
    })
}
