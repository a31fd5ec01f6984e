//! The frames of a dataset, poses disturbed at random, and photographs with masks from such poses.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sixfold_bop::{BopDataset, Models, VISIBILITY_DELTA, ground_truth_visibility};
use sixfold_data::PosedImage;
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::{Camera, Pose, RgbImage, Vec3};
use sixfold_mesh::Mesh;

use super::arguments::ReproduceNolArguments;

/// Largest disturbance of a pose: metres along each axis, radians about each.
pub(super) const REACH: [f64; 2] = [0.01, 0.05];
/// Minimum visible fraction of a source.
const MIN_VISIBILITY: f64 = 0.5;
/// Minimum visible fraction of a target.
const MIN_TARGET_VISIBILITY: f64 = 0.8;
/// Every n-th of the other frames; every n-th with `--quick`.
const EVERY: [usize; 2] = [6, 24];

/// A frame with its objects.
pub(super) struct PosedFrame {
    /// Scene and image.
    pub id: (u32, u32),
    pub image: Arc<RgbImage>,
    pub camera: Camera,
    /// Objects and their true poses.
    pub truth: Vec<(u32, Pose)>,
}

/// Poses of everything in all frames: one list per frame, in the order of its truth.
pub(super) type Poses = Vec<Vec<Pose>>;

/// A photograph of one object.
pub(super) struct Source {
    /// Number of its frame.
    pub frame: usize,
    /// Which of the frame's objects it is.
    pub index: usize,
    pub object: u32,
    pub photograph: PosedImage,
    pub truth: Pose,
}

/// The data of all measurements.
pub(super) struct Material {
    pub meshes: BTreeMap<u32, Mesh>,
    pub sources: Vec<PosedFrame>,
    pub targets: Vec<PosedFrame>,
}

impl Material {
    pub fn read(a: &ReproduceNolArguments) -> Result<Material> {
        let dataset = BopDataset::open(&a.dataset, &a.split)?;
        let chosen: BTreeSet<(u32, u32)> = dataset
            .targets(Some(&a.frames))
            .context("--frames")?
            .iter()
            .map(|t| (t.scene_id, t.im_id))
            .collect();
        let mut material = Material { meshes: BTreeMap::new(), sources: vec![], targets: vec![] };
        let mut others = vec![];
        for scene_id in dataset.scene_ids() {
            let scene = dataset.scene(scene_id)?;
            let posed = |id: &u32| scene.rgb_path(*id).is_some();
            others.extend(scene.image_ids().into_iter().filter(posed).map(|im_id| (scene_id, im_id)));
        }
        others.retain(|id| !chosen.contains(id));
        let every = EVERY[usize::from(a.quick)];
        for id in &chosen {
            let frame = material.frame(&dataset, *id)?;
            material.sources.push(frame);
        }
        for id in others.iter().step_by(every) {
            let frame = material.frame(&dataset, *id)?;
            material.targets.push(frame);
        }
        if material.sources.is_empty() || material.targets.is_empty() {
            bail!(
                "{}: {} frames to learn from and {} others with colour to compare with; at least one of each is needed (the former are those of {})",
                a.dataset.display(),
                material.sources.len(),
                others.len(),
                a.frames.display()
            );
        }
        Ok(material)
    }

    fn frame(&mut self, dataset: &BopDataset, (scene_id, im_id): (u32, u32)) -> Result<PosedFrame> {
        let scene = dataset.scene(scene_id)?;
        let Some(image) = scene.rgb(im_id)? else {
            bail!("{}: image {im_id} has no colour image; choose other --frames", scene.dir().display());
        };
        let truth: Vec<(u32, Pose)> =
            scene.image(im_id)?.ground_truth.iter().map(|g| (g.obj_id, g.camera_from_object)).collect();
        for (id, _) in &truth {
            if !self.meshes.contains_key(id) {
                self.meshes.insert(*id, dataset.model(*id, Models::Rendering)?);
            }
        }
        Ok(PosedFrame { id: (scene_id, im_id), image: Arc::new(image), camera: scene.camera(im_id)?, truth })
    }

    /// The true poses of the sources.
    pub fn true_poses(&self) -> Poses {
        self.sources.iter().map(|f| f.truth.iter().map(|(_, pose)| *pose).collect()).collect()
    }

    /// The sources' poses, each disturbed uniformly within [`REACH`].
    pub fn disturbed(&self, seed: u64) -> Poses {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut draw = |reach: f64| reach * (2.0 * random.random::<f64>() - 1.0);
        let mut disturb = |pose: &Pose| {
            let shift = Vec3::from_fn(|_, _| draw(REACH[0]));
            let [a, b, c] = [0; 3].map(|_| draw(REACH[1]));
            let turn = UnitQuaternion::from_euler_angles(a, b, c);
            Pose::new(turn * pose.rotation(), pose.translation() + shift)
        };
        self.sources.iter().map(|f| f.truth.iter().map(|(_, pose)| disturb(pose)).collect()).collect()
    }

    /// Photographs of all sufficiently visible objects at these poses, by object, with masks from all poses of a frame together.
    pub fn photographs(&self, poses: &Poses) -> Result<Vec<Source>> {
        let mut all = vec![];
        for (number, (frame, poses)) in self.sources.iter().zip(poses).enumerate() {
            let visible = self.visible(frame, poses);
            for (index, ((object, truth), (fraction, mask))) in frame.truth.iter().zip(visible).enumerate() {
                if fraction < MIN_VISIBILITY {
                    continue;
                }
                let (image, pose) = (frame.image.clone(), poses[index]);
                let id = frame.id.into();
                let photograph =
                    PosedImage::of_frame(id, *object, image, frame.camera, pose)?.with_mask(&mask)?;
                all.push(Source { frame: number, index, object: *object, photograph, truth: *truth });
            }
        }
        // Sort by object, as the refinement reports them; the order of the frames is kept.
        all.sort_by_key(|s| s.object);
        Ok(all)
    }

    /// Photographs of the same sources at other poses, with masks from those.
    pub fn at_poses(&self, sources: &[Source], poses: &Poses) -> Result<Vec<Source>> {
        let visible: Vec<_> =
            self.sources.iter().zip(poses).map(|(f, poses)| self.visible(f, poses)).collect();
        sources
            .iter()
            .map(|s| {
                let frame = &self.sources[s.frame];
                let (image, pose) = (frame.image.clone(), poses[s.frame][s.index]);
                let mask = visible[s.frame][s.index].1.clone();
                let id = frame.id.into();
                let photograph =
                    PosedImage::of_frame(id, s.object, image, frame.camera, pose)?.with_mask(&mask)?;
                Ok(Source { photograph, ..*s })
            })
            .collect()
    }

    /// Targets of one object: true pose, visible mask.
    pub fn targets_of(&self, object: u32) -> Result<Vec<((u32, u32), PosedImage)>> {
        let mut all = vec![];
        for frame in &self.targets {
            let poses: Vec<Pose> = frame.truth.iter().map(|(_, pose)| *pose).collect();
            if !frame.truth.iter().any(|(id, _)| *id == object) {
                continue;
            }
            for ((id, pose), (fraction, mask)) in frame.truth.iter().zip(self.visible(frame, &poses)) {
                if *id == object && fraction >= MIN_TARGET_VISIBILITY {
                    let (id, image) = (frame.id.into(), frame.image.clone());
                    let photograph = PosedImage::of_frame(id, object, image, frame.camera, *pose)?;
                    all.push((frame.id, photograph.with_mask(&mask)?));
                }
            }
        }
        Ok(all)
    }

    /// Visible fraction and mask of every object in a frame.
    fn visible(&self, frame: &PosedFrame, poses: &[Pose]) -> Vec<(f64, sixfold_geometry::Mask)> {
        let placed: Vec<(&Mesh, Pose)> =
            frame.truth.iter().zip(poses).map(|((id, _), pose)| (&self.meshes[id], *pose)).collect();
        ground_truth_visibility(&placed, &frame.camera, None, VISIBILITY_DELTA)
            .into_iter()
            .map(|v| (v.info.visib_fract, v.mask_visible))
            .collect()
    }
}
