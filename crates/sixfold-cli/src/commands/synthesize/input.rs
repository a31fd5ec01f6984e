//! Photographs with rough poses: from a BOP dataset, or from a file that names them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, anyhow, bail};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Deserialize;
use sixfold_bop::{BopDataset, Detection, MaskKind, Models, Rle, VISIBILITY_DELTA, ground_truth_visibility};
use sixfold_data::{FrameId, PosedImage};
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::{Camera, Mask, Mat3, Pose, RgbImage, Vec3, undistort_rgb};
use sixfold_io::{CameraFile, read_mask, read_rgb};
use sixfold_mesh::{Mesh, ModelInfo, Unit, read_mesh};

use super::arguments::SynthesizeArguments;
use sixfold_detect::detector::TrainedDetector;
use sixfold_runner::detections;

/// All that is given.
pub(super) struct Input {
    pub subjects: Vec<Subject>,
    /// Objects that are not looked for but may hide others.
    others: BTreeMap<u32, Mesh>,
    /// Camera, objects and poses of every image some of whose masks were rendered from poses.
    drawn: BTreeMap<usize, (Camera, Vec<(u32, Pose)>)>,
    /// Image and object of masks that were not.
    kept: BTreeSet<(usize, u32)>,
}

/// Masks that a detector sees in photographs.
struct DetectedMasks(Option<TrainedDetector>);

/// A detection is that of a posed object where its mask and the pose's silhouette overlap by this much (intersection over union).
const SAME_OBJECT: f64 = 0.3;

impl DetectedMasks {
    fn new(a: &SynthesizeArguments, ids: &[u32]) -> Result<Self> {
        let Some(weights) = &a.detector else { return Ok(DetectedMasks(None)) };
        let detector = TrainedDetector::load(weights)?;
        for id in ids {
            detector.model().check_object(*id).with_context(|| weights.display().to_string())?;
        }
        Ok(DetectedMasks(Some(detector)))
    }

    /// What is seen in an image, best first.
    fn of(&self, image: &RgbImage) -> Result<Vec<Detection>> {
        self.0.as_ref().map_or_else(|| Ok(vec![]), |detector| Ok(detections(detector, image, &[], (0, 0))?))
    }

    /// The mask of an object that lies about where it was drawn.
    fn choose(all: &[Detection], id: u32, drawn: &Mask) -> Option<Mask> {
        let drawn = Rle::encode(drawn).ok()?;
        let iou = |mask: &Rle| {
            let both = mask.intersection(&drawn)?;
            Some(both as f64 / (mask.area() + drawn.area() - both) as f64)
        };
        let mut mine = all.iter().filter(|d| d.category_id == id).filter_map(|d| d.segmentation.as_ref());
        mine.find(|mask| iou(mask).is_some_and(|iou| iou >= SAME_OBJECT)).map(Rle::decode)
    }
}

impl Input {
    /// Draws the masks that came from poses again, now that the poses of the subjects are better. `refined` has image, object
    /// and pose.
    pub fn redraw_masks(&mut self, refined: &[(usize, u32, Pose)]) -> Result<()> {
        let mut masks: BTreeMap<(usize, u32), Mask> = BTreeMap::new();
        for (image, (camera, objects)) in &mut self.drawn {
            for (id, pose) in objects.iter_mut() {
                let better = refined.iter().find(|(i, object, _)| i == image && object == id);
                if let Some((_, _, better)) = better {
                    *pose = *better;
                }
            }
            let mesh_of = |id: u32| {
                let subject = self.subjects.iter().find(|s| s.id == id).map(|s| &s.mesh);
                subject.or_else(|| self.others.get(&id))
            };
            let placed: Vec<(u32, &Mesh, Pose)> =
                objects.iter().filter_map(|(id, pose)| Some((*id, mesh_of(*id)?, *pose))).collect();
            let scene: Vec<(&Mesh, Pose)> = placed.iter().map(|(_, mesh, pose)| (*mesh, *pose)).collect();
            let visible = ground_truth_visibility(&scene, camera, None, VISIBILITY_DELTA);
            for ((id, _, _), visible) in placed.iter().zip(visible) {
                if !self.kept.contains(&(*image, *id)) {
                    masks.insert((*image, *id), visible.mask_visible);
                }
            }
        }
        for subject in &mut self.subjects {
            for source in &mut subject.photographs {
                if let Some(mask) = masks.remove(&(source.image, subject.id)) {
                    let p = &source.photograph;
                    source.photograph = p.clone().with_mask(&mask)?;
                }
            }
        }
        Ok(())
    }
}

/// An object and its photographs.
pub(super) struct Subject {
    pub id: u32,
    pub mesh: Mesh,
    pub info: ModelInfo,
    pub photographs: Vec<Source>,
}

/// A photograph of one object, and of which image it is.
pub(super) struct Source {
    pub image: usize,
    /// Scene and image of a dataset.
    pub frame: Option<(u32, u32)>,
    pub photograph: PosedImage,
    /// The pose as it was given, before any disturbance.
    pub given: Pose,
}

pub(super) fn read(a: &SynthesizeArguments) -> Result<Input> {
    match (&a.dataset, &a.photographs) {
        (Some(root), _) => from_dataset(a, root),
        (None, Some(file)) => {
            let subjects = vec![from_file(a, file)?];
            Ok(Input { subjects, others: BTreeMap::new(), drawn: BTreeMap::new(), kept: BTreeSet::new() })
        }
        (None, None) => bail!("what is to be rendered? Give --dataset DIR or --photographs FILE.json"),
    }
}

/// Moves poses at random for experiments.
struct Disturber {
    random: ChaCha8Rng,
    reach: Option<[f64; 2]>,
}

impl Disturber {
    fn new(a: &SynthesizeArguments) -> Result<Self> {
        let reach = match a.disturb.as_slice() {
            [] => None,
            [mm, degrees] if *mm >= 0.0 && *degrees >= 0.0 && mm.is_finite() && degrees.is_finite() => {
                Some([mm * 1e-3, degrees.to_radians()])
            }
            other => bail!("--disturb: found {other:?}, expected millimetres and degrees, 0 or more"),
        };
        Ok(Disturber { random: ChaCha8Rng::seed_from_u64(a.seed), reach })
    }

    fn disturb(&mut self, pose: &Pose) -> Pose {
        let Some([shift, turn]) = self.reach else { return *pose };
        let mut draw = |reach: f64| reach * (2.0 * self.random.random::<f64>() - 1.0);
        let moved = Vec3::new(draw(shift), draw(shift), draw(shift));
        let turned = UnitQuaternion::from_euler_angles(draw(turn), draw(turn), draw(turn));
        Pose::new(turned * pose.rotation(), pose.translation() + moved)
    }
}

/// Scene and image of the photographs, sorted.
fn frames(a: &SynthesizeArguments, dataset: &BopDataset) -> Result<Vec<(u32, u32)>> {
    let mut frames: Vec<(u32, u32)> = match &a.frames {
        Some(file) => dataset.targets(Some(file))?.iter().map(|t| (t.scene_id, t.im_id)).collect(),
        None => {
            let mut all = vec![];
            for scene_id in dataset.scene_ids() {
                let scene = dataset.scene(scene_id)?;
                let shown = scene.image_ids().into_iter().filter(|id| scene.rgb_path(*id).is_some());
                all.extend(shown.map(|im_id| (scene_id, im_id)));
            }
            all
        }
    };
    frames.sort_unstable();
    frames.dedup();
    Ok(frames)
}

fn from_dataset(a: &SynthesizeArguments, root: &Path) -> Result<Input> {
    let dataset = BopDataset::open(root, &a.split)?;
    let infos = dataset.models_info(Models::Rendering)?.unwrap_or_default();
    let ids: Vec<u32> = if a.ids.is_empty() { infos.0.keys().copied().collect() } else { a.ids.clone() };
    if ids.is_empty() {
        bail!("{}: no objects: its models have no models_info.json; name them with --ids", root.display());
    }
    let frames = frames(a, &dataset)?;
    let mut disturber = Disturber::new(a)?;
    let detected = DetectedMasks::new(a, &ids)?;
    let mut subjects = BTreeMap::new();
    for id in ids {
        let mesh = dataset.model(id, Models::Rendering)?;
        let info = infos.0.get(&id).cloned().unwrap_or_else(|| ModelInfo::of_mesh(&mesh));
        subjects.insert(id, Subject { id, mesh, info, photographs: vec![] });
    }
    let mut others: BTreeMap<u32, Mesh> = BTreeMap::new();
    let (mut drawn, mut kept) = (BTreeMap::new(), BTreeSet::new());
    for (number, (scene_id, im_id)) in frames.iter().enumerate() {
        let scene = dataset.scene(*scene_id)?;
        let truth = &scene.image(*im_id)?.ground_truth;
        if !truth.iter().any(|g| subjects.contains_key(&g.obj_id)) {
            continue;
        }
        let image = Arc::new(scene.rgb(*im_id)?.ok_or_else(|| {
            anyhow!("{}: image {im_id} has no colour image; choose other --frames", scene.dir().display())
        })?);
        let camera = scene.camera(*im_id)?;
        for g in truth {
            if !subjects.contains_key(&g.obj_id) && !others.contains_key(&g.obj_id) {
                others.insert(g.obj_id, dataset.model(g.obj_id, Models::Rendering)?);
            }
        }
        let poses: Vec<Pose> = truth.iter().map(|g| disturber.disturb(&g.camera_from_object)).collect();
        let mesh_of = |id: u32| subjects.get(&id).map(|s| &s.mesh).or_else(|| others.get(&id));
        let placed: Vec<(&Mesh, Pose)> =
            truth.iter().zip(&poses).filter_map(|(g, pose)| Some((mesh_of(g.obj_id)?, *pose))).collect();
        let visible = ground_truth_visibility(&placed, &camera, None, VISIBILITY_DELTA);
        let seen = detected.of(&image)?;
        for (index, ((g, pose), visible)) in truth.iter().zip(&poses).zip(visible).enumerate() {
            if visible.info.visib_fract < a.least_visible {
                continue;
            }
            // Masks of the dataset fit its own poses, not disturbed ones.
            let own = if a.disturb.is_empty() { scene.mask(*im_id, index, MaskKind::Visible)? } else { None };
            let own = own.or_else(|| DetectedMasks::choose(&seen, g.obj_id, &visible.mask_visible));
            if own.is_some() {
                kept.insert((number, g.obj_id));
            } else {
                let objects = truth.iter().zip(&poses).map(|(g, pose)| (g.obj_id, *pose)).collect();
                drawn.entry(number).or_insert((camera, objects));
            }
            let mask: Mask = own.unwrap_or(visible.mask_visible);
            let Some(subject) = subjects.get_mut(&g.obj_id) else { continue };
            let id = FrameId::new(*scene_id, *im_id);
            let photograph =
                PosedImage::of_frame(id, g.obj_id, image.clone(), camera, *pose)?.with_mask(&mask)?;
            subject.photographs.push(Source {
                image: number,
                frame: Some((*scene_id, *im_id)),
                photograph,
                given: g.camera_from_object,
            });
        }
    }
    let (subjects, without): (Vec<Subject>, Vec<Subject>) =
        subjects.into_values().partition(|s| !s.photographs.is_empty());
    for subject in &without {
        eprintln!(
            "note: object {}: none of the {} frames shows at least {:.0} % of it; left out",
            subject.id,
            frames.len(),
            100.0 * a.least_visible
        );
    }
    others.extend(without.into_iter().map(|s| (s.id, s.mesh)));
    if detected.0.is_some() {
        tell_masks(&subjects, &kept);
    }
    Ok(Input { subjects, others, drawn, kept })
}

/// Says how many masks were not drawn from poses.
fn tell_masks(subjects: &[Subject], kept: &BTreeSet<(usize, u32)>) {
    let all: usize = subjects.iter().map(|s| s.photographs.len()).sum();
    let with = subjects.iter().flat_map(|s| s.photographs.iter().map(|p| (p.image, s.id)));
    let with = with.filter(|key| kept.contains(key)).count();
    eprintln!(
        "note: masks of {with} of {all} objects in photographs by the detector or the dataset, the others drawn"
    );
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    mesh: String,
    unit: String,
    photographs: Vec<Entry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
#[allow(non_snake_case)]
struct Entry {
    image: String,
    camera: String,
    cam_R_m2c: [f64; 9],
    cam_t_m2c: [f64; 3],
    mask: Option<String>,
}

fn from_file(a: &SynthesizeArguments, path: &Path) -> Result<Subject> {
    let shown = path.display();
    let text = std::fs::read_to_string(path).with_context(|| format!("--photographs {shown}"))?;
    let file: File = serde_json::from_str(&text).with_context(|| {
        format!("{shown}: expected {{\"mesh\", \"unit\", \"photographs\": [{{\"image\", \"camera\", \"cam_R_m2c\", \"cam_t_m2c\", \"mask\"}}]}}")
    })?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let unit: Unit = file.unit.parse().with_context(|| format!("{shown}: unit"))?;
    let mesh = read_mesh(folder.join(&file.mesh), unit)?;
    if file.photographs.is_empty() {
        bail!("{shown}: photographs: found none, expected at least one");
    }
    let mut disturber = Disturber::new(a)?;
    let detected = DetectedMasks::new(a, &[])?;
    let id = match &detected.0 {
        None => 1,
        Some(detector) => match detector.model().classes() {
            [only] => only.id,
            several => bail!(
                "--detector: found {} objects, expected one that knows the object of {shown} alone",
                several.len()
            ),
        },
    };
    let mut photographs = vec![];
    for (number, entry) in file.photographs.iter().enumerate() {
        let (image, camera) = picture(folder, entry)?;
        let rotation = Mat3::from_row_slice(&entry.cam_R_m2c);
        let given = Pose::from_parts(&rotation, Vec3::from(entry.cam_t_m2c) * 1e-3)
            .with_context(|| format!("{shown}: photographs[{number}].cam_R_m2c"))?;
        let pose = disturber.disturb(&given);
        let mask = match &entry.mask {
            Some(mask) => Some(read_mask(&folder.join(mask))?),
            None if detected.0.is_none() => None,
            None => {
                let silhouette = ground_truth_visibility(&[(&mesh, pose)], &camera, None, VISIBILITY_DELTA);
                let silhouette = silhouette.into_iter().next().map(|v| v.mask_visible);
                let seen = detected.of(&image)?;
                silhouette.and_then(|s| DetectedMasks::choose(&seen, id, &s))
            }
        };
        let photograph = PosedImage::new(&entry.image, id, Arc::new(image), camera, pose)?;
        let photograph = match &mask {
            Some(mask) => photograph.with_mask(mask)?,
            None => photograph,
        };
        photographs.push(Source { image: number, frame: None, photograph, given });
    }
    let info = ModelInfo::of_mesh(&mesh);
    Ok(Subject { id: 1, mesh, info, photographs })
}

/// An image without distortion, and its camera.
fn picture(folder: &Path, entry: &Entry) -> Result<(RgbImage, Camera)> {
    let image = read_rgb(&folder.join(&entry.image))?;
    let file = folder.join(&entry.camera);
    let (width, height) = image.size();
    let camera = CameraFile::read(&file)?.for_image(width, height, &file)?;
    let image = if camera.distortion.is_some() { undistort_rgb(&image, &camera)? } else { image };
    Ok((image, camera.without_distortion()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mask_that_lies_where_the_pose_says_is_taken() {
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
        assert_eq!(DetectedMasks::choose(&all, 1, &bar(0, 8)), Some(bar(2, 10)));
        assert_eq!(DetectedMasks::choose(&all, 2, &bar(0, 8)), Some(bar(0, 10)));
        // Four of ten columns in common are enough, two are not.
        assert_eq!(DetectedMasks::choose(&all, 1, &bar(0, 6)), Some(bar(2, 10)));
        assert_eq!(DetectedMasks::choose(&all, 1, &bar(0, 4)), None);
        assert_eq!(DetectedMasks::choose(&all, 3, &bar(0, 8)), None);
        assert_eq!(DetectedMasks::choose(&all, 1, &Mask::filled(20, 4, false)), None);
    }
}
