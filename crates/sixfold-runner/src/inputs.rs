//! The inputs of an image's poses or detections, as hashes of their contents.

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::path::{Path, PathBuf};

use sixfold_bop::{BopDataset, Models, Scene, Target};
use sixfold_estimator::{Need, Needs};
use sixfold_io::{fnv1a, fnv1a_of_file};
use sixfold_mesh::ModelsInfo;

use crate::regions::RegionSource;

/// Inputs by name, each with its file.
#[derive(Debug, Default)]
pub(crate) struct Inputs(BTreeMap<&'static str, (String, PathBuf)>);

/// A hash in the form of the record.
pub(crate) fn hex(hash: u64) -> String {
    format!("{hash:016x}")
}

impl Inputs {
    /// The mesh of an object with its diameter and symmetries, and what a method holds of it ([`PoseEstimator::held`]).
    ///
    /// [`PoseEstimator::held`]: sixfold_estimator::PoseEstimator::held
    pub(crate) fn of_object(
        dataset: &BopDataset,
        id: u32,
        infos: Option<&ModelsInfo>,
        held: Option<(&'static str, u64)>,
    ) -> Inputs {
        let mut inputs = Inputs::default();
        let model = dataset.model_path(id, Models::Rendering);
        let info = model.with_file_name("models_info.json");
        inputs.file("mesh", Some(model));
        inputs.value("models_info", &infos.and_then(|i| i.0.get(&id)), info);
        if let Some((name, hash)) = held {
            inputs.0.insert(name, (hex(hash), dataset.root().to_owned()));
        }
        inputs
    }

    /// The files of an image that a method reads, and the source of its regions. A file that cannot be read counts as missing;
    /// the method reports it.
    pub(crate) fn of_image(
        scene: &Scene,
        im_id: u32,
        targets: &[Target],
        needs: &Needs,
        regions: &RegionSource,
    ) -> Inputs {
        let mut inputs = Inputs::default();
        let place = |name: &str| scene.dir().join(name);
        let objects: Vec<_> = targets.iter().map(|t| t.object).collect();
        inputs.value("list of targets", &objects, place("scene_gt.json"));
        let camera = scene.camera(im_id).map_err(|error| error.to_string());
        let image = scene.image(im_id).ok();
        let depth_scale = image.map(|i| i.camera.depth_scale);
        inputs.value("camera", &(camera, depth_scale), place("scene_camera.json"));
        let detected = matches!(regions, RegionSource::Detector(..));
        if needs.rgb != Need::Unused || detected {
            inputs.file("colour image", scene.rgb_path(im_id));
        }
        let truth = matches!(regions, RegionSource::GroundTruth);
        // Without `scene_gt_info.json` the boxes are rendered, with occlusion from the depth image.
        let rendered = truth && image.is_none_or(|i| i.info.is_none());
        if needs.depth != Need::Unused || rendered {
            inputs.file("depth image", scene.depth_path(im_id));
        }
        if truth {
            let poses = image.map(|i| (&i.ground_truth, &i.info));
            inputs.value("ground truth", &poses, place("scene_gt.json"));
        }
        inputs
    }

    /// The files of an image that a detector reads.
    pub(crate) fn of_colour(scene: &Scene, im_id: u32) -> Inputs {
        let mut inputs = Inputs::default();
        inputs.file("colour image", scene.rgb_path(im_id));
        inputs
    }

    /// The inputs of an image without targets.
    pub(crate) fn without_targets(dataset: &Path) -> Inputs {
        let mut inputs = Inputs::default();
        inputs.value("list of targets", &"none", dataset.to_owned());
        inputs
    }

    fn file(&mut self, name: &'static str, path: Option<PathBuf>) {
        let hash = path.as_deref().and_then(|p| fnv1a_of_file(p).ok());
        let hash = hash.map_or_else(|| "none".to_owned(), hex);
        self.0.insert(name, (hash, path.unwrap_or_default()));
    }

    /// Adds a value with all digits of its numbers.
    fn value(&mut self, name: &'static str, value: &impl Debug, from: PathBuf) {
        self.0.insert(name, (hex(fnv1a(format!("{value:?}").as_bytes())), from));
    }

    /// The hashes, for a record.
    pub(crate) fn hashes(&self) -> BTreeMap<String, String> {
        self.0.iter().map(|(name, (hash, _))| ((*name).to_owned(), hash.clone())).collect()
    }

    /// The first input that differs from before, and its file.
    pub(crate) fn difference(&self, before: &BTreeMap<String, String>) -> Option<(&'static str, PathBuf)> {
        let differs =
            |(name, (hash, _)): &(&&'static str, &(String, PathBuf))| before.get(**name) != Some(hash);
        self.0.iter().find(differs).map(|(name, (_, file))| (*name, file.clone()))
    }
}
