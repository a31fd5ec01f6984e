//! Posed images with approximate poses, as from a user's photographs: frames of a dataset, or images listed in a file
//! (`photograph_file.rs`).
//!
//! Masks come from the dataset or from a detector. Without these they are rendered from the poses, and rendered again when the
//! poses have been refined.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sixfold_bop::{
    BopDataset, Detection, GroundTruth, MaskKind, Models, ObjectVisibility, Rle, Scene, VISIBILITY_DELTA,
    ground_truth_visibility,
};
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::{Camera, FrameId, Mask, Pose, RgbImage, Vec3};
use sixfold_mesh::{Mesh, ModelInfo};

use crate::error::TrainingSetError;
use crate::posed_image::PosedImage;

/// A detection belongs to a posed object if its mask and the silhouette at the pose overlap by at least this much (intersection
/// over union).
const SAME_OBJECT: f64 = 0.3;

/// A function that detects masks in an image: its detections, best first.
pub type DetectMasks<'a> =
    &'a dyn Fn(&RgbImage) -> Result<Vec<Detection>, Box<dyn std::error::Error + Send + Sync>>;

/// Options for reading approximately posed images.
#[derive(Clone, Copy)]
pub struct RoughImageOptions<'a> {
    /// Images that show less of an object than this fraction are left out.
    pub min_visibility: f64,
    /// For experiments: poses are disturbed uniformly by up to this much along and about each axis, metres and radians.
    pub disturb: Option<[f64; 2]>,
    /// Seed of the disturbances.
    pub seed: u64,
    /// Detects the masks where there are no others.
    pub detect: Option<DetectMasks<'a>>,
}

/// An object and its images.
#[derive(Debug)]
pub struct RoughObject {
    /// Its id.
    pub id: u32,
    /// Its surface.
    pub mesh: Mesh,
    /// Diameter and symmetries.
    pub info: ModelInfo,
    /// The images that show it.
    pub images: Vec<RoughImage>,
}

/// One object in one image.
#[derive(Debug)]
pub struct RoughImage {
    /// Number of the image, which may show several objects.
    pub number: usize,
    /// Image, camera, pose and mask.
    pub posed: PosedImage,
    /// The pose as it was given, before any disturbance.
    pub given: Pose,
}

/// Camera, objects and poses of an image.
type Posed = (Camera, Vec<(u32, Pose)>);

/// Objects in approximately posed images.
#[derive(Debug, Default)]
pub struct RoughImages {
    /// The visible objects, by ascending id.
    pub objects: Vec<RoughObject>,
    /// Notes for the user.
    pub notes: Vec<String>,
    /// Objects that are not requested but may occlude others.
    others: BTreeMap<u32, Mesh>,
    /// Every image with masks that were rendered from poses.
    rendered: BTreeMap<usize, Posed>,
    /// Image and object of masks that were not rendered.
    kept: BTreeSet<(usize, u32)>,
}

/// Disturbs poses at random.
pub(crate) struct Disturber {
    random: ChaCha8Rng,
    reach: Option<[f64; 2]>,
}

impl Disturber {
    pub(crate) fn new(options: &RoughImageOptions<'_>) -> Self {
        Disturber { random: ChaCha8Rng::seed_from_u64(options.seed), reach: options.disturb }
    }

    pub(crate) fn disturb(&mut self, pose: &Pose) -> Pose {
        let Some([shift, rotation]) = self.reach else { return *pose };
        let mut draw = |reach: f64| reach * (2.0 * self.random.random::<f64>() - 1.0);
        let moved = Vec3::new(draw(shift), draw(shift), draw(shift));
        let rotated = UnitQuaternion::from_euler_angles(draw(rotation), draw(rotation), draw(rotation));
        Pose::new(rotated * pose.rotation(), pose.translation() + moved)
    }
}

/// The detections in an image; empty without a detector.
pub(crate) fn detections(
    options: &RoughImageOptions<'_>,
    image: &RgbImage,
) -> Result<Vec<Detection>, TrainingSetError> {
    options.detect.map_or(Ok(vec![]), |detect| detect(image).map_err(TrainingSetError::Detector))
}

/// The best detected mask of an object that overlaps its silhouette.
pub(crate) fn detected_mask(all: &[Detection], id: u32, silhouette: &Mask) -> Option<Mask> {
    let silhouette = Rle::encode(silhouette).ok()?;
    let iou = |mask: &Rle| {
        let both = mask.intersection(&silhouette)?;
        Some(both as f64 / (mask.area() + silhouette.area() - both) as f64)
    };
    let mut mine = all.iter().filter(|d| d.category_id == id).filter_map(|d| d.segmentation.as_ref());
    mine.find(|mask| iou(mask).is_some_and(|iou| iou >= SAME_OBJECT)).map(Rle::decode)
}

impl RoughImages {
    /// The objects of `ids` (all that models_info.json names if empty) in frames of a dataset: those of a targets file, or all
    /// with a colour image.
    ///
    /// # Errors
    /// [`TrainingSetError`].
    pub fn of_dataset(
        (root, split): (&Path, &str),
        ids: &[u32],
        frames: Option<&Path>,
        options: &RoughImageOptions<'_>,
    ) -> Result<RoughImages, TrainingSetError> {
        RoughImages::of_opened(&BopDataset::open(root, split)?, ids, frames, options)
    }

    /// The same for an opened dataset, with its chosen models.
    ///
    /// # Errors
    /// [`TrainingSetError`].
    pub fn of_opened(
        dataset: &BopDataset,
        ids: &[u32],
        frames: Option<&Path>,
        options: &RoughImageOptions<'_>,
    ) -> Result<RoughImages, TrainingSetError> {
        let infos = dataset.models_info(Models::Rendering)?.unwrap_or_default();
        let ids: Vec<u32> = if ids.is_empty() { infos.0.keys().copied().collect() } else { ids.to_vec() };
        if ids.is_empty() {
            return Err(TrainingSetError::NoObjects { root: dataset.root().to_owned() });
        }
        let frames = frames_of(dataset, frames)?;
        let mut objects = BTreeMap::new();
        for id in ids {
            let mesh = dataset.model(id, Models::Rendering)?;
            let info = infos.0.get(&id).cloned().unwrap_or_else(|| ModelInfo::of_mesh(&mesh));
            objects.insert(id, RoughObject { id, mesh, info, images: vec![] });
        }
        let mut all = RoughImages::default();
        let mut disturber = Disturber::new(options);
        for (number, frame) in frames.iter().enumerate() {
            all.add_frame(dataset, (number, *frame), &mut objects, &mut disturber, options)?;
        }
        all.leave_out_unseen(objects, frames.len(), options.min_visibility);
        if options.detect.is_some() {
            all.note_masks();
        }
        Ok(all)
    }

    /// One object from any source, with images that have masks or whose whole silhouettes are used.
    pub fn of_object(object: RoughObject) -> RoughImages {
        RoughImages { objects: vec![object], ..RoughImages::default() }
    }

    /// Adds the objects that a frame shows.
    fn add_frame(
        &mut self,
        dataset: &BopDataset,
        (number, frame): (usize, FrameId),
        objects: &mut BTreeMap<u32, RoughObject>,
        disturber: &mut Disturber,
        options: &RoughImageOptions<'_>,
    ) -> Result<(), TrainingSetError> {
        let scene = dataset.scene(frame.scene_id)?;
        let truth = &scene.image(frame.im_id)?.ground_truth;
        if !truth.iter().any(|g| objects.contains_key(&g.obj_id)) {
            return Ok(());
        }
        let image = Arc::new(scene.rgb(frame.im_id)?.ok_or(TrainingSetError::NoColorImage { frame })?);
        let camera = scene.camera(frame.im_id)?;
        for g in truth {
            if !objects.contains_key(&g.obj_id) && !self.others.contains_key(&g.obj_id) {
                self.others.insert(g.obj_id, dataset.model(g.obj_id, Models::Rendering)?);
            }
        }
        let poses: Vec<Pose> = truth.iter().map(|g| disturber.disturb(&g.camera_from_object)).collect();
        let visible = self.visibility(objects, truth, &poses, &camera);
        let seen = detections(options, &image)?;
        for (index, ((g, pose), visible)) in truth.iter().zip(&poses).zip(visible).enumerate() {
            if visible.info.visib_fract < options.min_visibility {
                continue;
            }
            let own = own_mask(&scene, (frame.im_id, index), options)?;
            let own = own.or_else(|| detected_mask(&seen, g.obj_id, &visible.mask_visible));
            if own.is_some() {
                self.kept.insert((number, g.obj_id));
            } else {
                let objects = truth.iter().zip(&poses).map(|(g, pose)| (g.obj_id, *pose)).collect();
                self.rendered.entry(number).or_insert((camera, objects));
            }
            let mask: Mask = own.unwrap_or(visible.mask_visible);
            let Some(object) = objects.get_mut(&g.obj_id) else { continue };
            let posed =
                PosedImage::of_frame(frame, g.obj_id, image.clone(), camera, *pose)?.with_mask(&mask)?;
            object.images.push(RoughImage { number, posed, given: g.camera_from_object });
        }
        Ok(())
    }

    /// The visibility of all objects in an image at these poses.
    fn visibility(
        &self,
        objects: &BTreeMap<u32, RoughObject>,
        truth: &[GroundTruth],
        poses: &[Pose],
        camera: &Camera,
    ) -> Vec<ObjectVisibility> {
        let mesh_of = |id: u32| objects.get(&id).map(|o| &o.mesh).or_else(|| self.others.get(&id));
        let placed: Vec<(&Mesh, Pose)> =
            truth.iter().zip(poses).filter_map(|(g, pose)| Some((mesh_of(g.obj_id)?, *pose))).collect();
        ground_truth_visibility(&placed, camera, None, VISIBILITY_DELTA)
    }

    /// Keeps the objects that are visible; the others may still occlude them.
    fn leave_out_unseen(&mut self, objects: BTreeMap<u32, RoughObject>, frames: usize, min_visibility: f64) {
        let (seen, unseen): (Vec<RoughObject>, Vec<RoughObject>) =
            objects.into_values().partition(|o| !o.images.is_empty());
        for object in &unseen {
            self.notes.push(format!(
                "object {}: none of the {frames} frames shows at least {:.0} % of it; left out",
                object.id,
                100.0 * min_visibility
            ));
        }
        self.objects = seen;
        self.others.extend(unseen.into_iter().map(|o| (o.id, o.mesh)));
    }

    /// Adds a note on how many masks were not rendered from poses.
    fn note_masks(&mut self) {
        let all: usize = self.objects.iter().map(|o| o.images.len()).sum();
        let keys = self.objects.iter().flat_map(|o| o.images.iter().map(|i| (i.number, o.id)));
        let with = keys.filter(|key| self.kept.contains(key)).count();
        self.notes.push(format!(
            "masks of {with} of {all} objects in photographs by the detector or the dataset, the others drawn"
        ));
    }

    /// Renders the masks that came from poses again with refined poses. `refined` lists image number, object and pose.
    ///
    /// # Errors
    /// [`TrainingSetError`].
    pub fn render_masks_again(&mut self, refined: &[(usize, u32, Pose)]) -> Result<(), TrainingSetError> {
        let mut masks: BTreeMap<(usize, u32), Mask> = BTreeMap::new();
        for (number, (camera, posed)) in &mut self.rendered {
            for (id, pose) in posed.iter_mut() {
                let better = refined.iter().find(|(i, object, _)| i == number && object == id);
                if let Some((_, _, better)) = better {
                    *pose = *better;
                }
            }
            let mesh_of = |id: u32| {
                let object = self.objects.iter().find(|o| o.id == id).map(|o| &o.mesh);
                object.or_else(|| self.others.get(&id))
            };
            let placed: Vec<(u32, &Mesh, Pose)> =
                posed.iter().filter_map(|(id, pose)| Some((*id, mesh_of(*id)?, *pose))).collect();
            let scene: Vec<(&Mesh, Pose)> = placed.iter().map(|(_, mesh, pose)| (*mesh, *pose)).collect();
            let visible = ground_truth_visibility(&scene, camera, None, VISIBILITY_DELTA);
            for ((id, _, _), visible) in placed.iter().zip(visible) {
                if !self.kept.contains(&(*number, *id)) {
                    masks.insert((*number, *id), visible.mask_visible);
                }
            }
        }
        for object in &mut self.objects {
            for image in &mut object.images {
                if let Some(mask) = masks.remove(&(image.number, object.id)) {
                    image.posed = image.posed.clone().with_mask(&mask)?;
                }
            }
        }
        Ok(())
    }
}

/// The dataset's mask, which fits the dataset's poses but not disturbed ones.
fn own_mask(
    scene: &Scene,
    (im_id, index): (u32, usize),
    options: &RoughImageOptions<'_>,
) -> Result<Option<Mask>, TrainingSetError> {
    if options.disturb.is_some() {
        return Ok(None);
    }
    Ok(scene.mask(im_id, index, MaskKind::Visible)?)
}

/// The frames of a targets file, or all that have a colour image; sorted, each once.
fn frames_of(dataset: &BopDataset, file: Option<&Path>) -> Result<Vec<FrameId>, TrainingSetError> {
    let mut frames = match file {
        Some(file) => {
            dataset.targets(Some(file))?.iter().map(|t| FrameId::new(t.scene_id, t.im_id)).collect()
        }
        None => crate::training_set::frames_with_colour(dataset)?,
    };
    frames.sort_unstable();
    frames.dedup();
    Ok(frames)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mask_that_overlaps_the_expected_one_is_used() {
        let bar = |from: usize, to: usize| Mask::from_fn(20, 4, |x, _| (from..to).contains(&x));
        let seen = |category_id: u32, mask: &Mask| Detection {
            scene_id: 0,
            image_id: 0,
            category_id,
            score: 0.9,
            bbox: None,
            segmentation: Some(Rle::encode(mask).unwrap()),
            time: None,
        };
        let all = [seen(1, &bar(12, 20)), seen(2, &bar(0, 10)), seen(1, &bar(2, 10))];
        assert_eq!(detected_mask(&all, 1, &bar(0, 8)), Some(bar(2, 10)));
        assert_eq!(detected_mask(&all, 2, &bar(0, 8)), Some(bar(0, 10)));
        // Four of ten columns in common are enough, two are not.
        assert_eq!(detected_mask(&all, 1, &bar(0, 6)), Some(bar(2, 10)));
        assert_eq!(detected_mask(&all, 1, &bar(0, 4)), None);
        assert_eq!(detected_mask(&all, 3, &bar(0, 8)), None);
        assert_eq!(detected_mask(&all, 1, &Mask::filled(20, 4, false)), None);
    }
}
