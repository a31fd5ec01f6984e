//! A BOP dataset on disk: split, scenes, images, models. Text files are checked when a scene is opened; images are
//! read when they are asked for. What a dataset does not contain (depth, masks, ground truth, models) is `None`; an invalid file is
//! an error.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use sixfold_geometry::{Camera, DepthImage, Mask, RgbImage};
use sixfold_io::{ImageFile, ImageFileError, check_pixels, max_pixels};
use sixfold_mesh::{Mesh, ModelsInfo, Unit, read_mesh};

use crate::dataset_error::DatasetError;
use crate::json::{At, parse};
use crate::scene_files::{
    GroundTruth, GroundTruthInfo, ImageCamera, Target, TargetObject, parse_scene_camera, parse_scene_gt,
    parse_scene_gt_info, parse_targets,
};

/// Which of a dataset's model folders is used, where none was chosen by [`BopDataset::with_models`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Models {
    /// `models_eval` where there is one (uniformly resampled, without inner faces), otherwise `models`.
    #[default]
    Evaluation,
    /// `models`: the models for rendering.
    Rendering,
}

/// Width and height of a split's images, and the file that states them.
type StatedSize = ((usize, usize), PathBuf);

/// A `models_info.json` and the name of its file, where there is one.
type NamedInfos = Option<(String, ModelsInfo)>;

/// A dataset folder with one of its splits.
#[derive(Debug, Clone)]
pub struct BopDataset {
    root: PathBuf,
    split_dir: PathBuf,
    size: Option<StatedSize>,
    scenes: BTreeMap<u32, PathBuf>,
    /// The chosen folder of models.
    models: Option<PathBuf>,
    /// `models_info.json` of [`Models::Evaluation`] and of [`Models::Rendering`], once read; every model is checked against it.
    infos: Arc<[OnceLock<NamedInfos>; 2]>,
}

impl BopDataset {
    /// Opens `dir/split` (such as `test`), or `dir` itself where it is a scene folder (`scene_camera.json` in it);
    /// the scene then has the folder's number as id, or 0.
    ///
    /// # Errors
    /// [`DatasetError`] when the folder or split is missing, has no scene, or `camera.json` is broken.
    pub fn open(dir: &Path, split: &str) -> Result<Self, DatasetError> {
        let size = read_camera_size(&dir.join("camera.json"))?;
        if dir.join("scene_camera.json").is_file() {
            let name = dir.file_name().and_then(|n| n.to_str()).and_then(|n| n.parse().ok());
            let scenes = BTreeMap::from([(name.unwrap_or(0), dir.to_owned())]);
            let (root, split_dir) = (dir.to_owned(), dir.to_owned());
            return Ok(BopDataset { root, split_dir, size, scenes, models: None, infos: Arc::default() });
        }
        if !dir.is_dir() {
            return Err(DatasetError::Missing {
                path: dir.to_owned(),
                what: "the dataset folder",
                advice: "give the folder that holds camera.json, models and test",
            });
        }
        let split_dir = dir.join(split);
        let missing = |what| DatasetError::Missing {
            path: split_dir.clone(),
            what,
            advice: "a BOP split holds folders such as 000001 with scene_camera.json in them",
        };
        if !split_dir.is_dir() {
            return Err(missing("the folder of the split"));
        }
        let read = |source| DatasetError::Read { path: split_dir.clone(), source };
        let mut scenes = BTreeMap::new();
        for entry in std::fs::read_dir(&split_dir).map_err(read)? {
            let path = entry.map_err(read)?.path();
            let number = path.file_name().and_then(|n| n.to_str()).and_then(|n| n.parse().ok());
            if let Some(scene_id) = number.filter(|_| path.join("scene_camera.json").is_file()) {
                scenes.insert(scene_id, path);
            }
        }
        if scenes.is_empty() {
            return Err(missing("a scene folder"));
        }
        let root = dir.to_owned();
        Ok(BopDataset { root, split_dir, size, scenes, models: None, infos: Arc::default() })
    }

    /// The same dataset with the models of one of its folders for all uses, such as T-LESS's `models_cad` or `models_reconst`.
    ///
    /// # Errors
    /// [`DatasetError::Missing`] when there is no such folder.
    pub fn with_models(self, folder: &str) -> Result<Self, DatasetError> {
        let dir = self.root.join(folder);
        if !dir.is_dir() {
            return Err(DatasetError::Missing {
                path: dir,
                what: "the folder of models",
                advice: "choose one that the dataset has, such as models, models_eval, models_cad or models_reconst",
            });
        }
        Ok(BopDataset { models: Some(dir), infos: Arc::default(), ..self })
    }

    /// The dataset's folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The split's name: that of its folder.
    pub fn split(&self) -> String {
        self.split_dir.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
    }

    /// The scenes of the split, ascending.
    pub fn scene_ids(&self) -> Vec<u32> {
        self.scenes.keys().copied().collect()
    }

    /// Width and height that `camera.json` states.
    pub fn image_size(&self) -> Option<(usize, usize)> {
        self.size.as_ref().map(|(size, _)| *size)
    }

    /// Reads the text files of a scene.
    ///
    /// # Errors
    /// [`DatasetError`] when the scene is not there or one of its files is broken.
    pub fn scene(&self, scene_id: u32) -> Result<Scene, DatasetError> {
        let dir = self.scenes.get(&scene_id).ok_or_else(|| DatasetError::NoScene {
            path: self.split_dir.clone(),
            scene_id,
            known: list_ids(self.scenes.keys()),
        })?;
        Scene::read(scene_id, dir, self.size.clone())
    }

    /// The folder of models that will be used, if the dataset has one: the chosen folder, otherwise the one for `models`.
    pub fn models_dir(&self, models: Models) -> Option<PathBuf> {
        if let Some(chosen) = &self.models {
            return Some(chosen.clone());
        }
        let names: &[&str] = match models {
            Models::Evaluation => &["models_eval", "models"],
            Models::Rendering => &["models", "models_eval"],
        };
        names.iter().map(|name| self.root.join(name)).find(|dir| dir.is_dir())
    }

    /// Diameters and symmetries of the models; `None` where the dataset has no `models_info.json`.
    ///
    /// # Errors
    /// [`DatasetError::Model`] when the file is broken.
    pub fn models_info(&self, models: Models) -> Result<Option<ModelsInfo>, DatasetError> {
        Ok(self.named_models_info(models)?.as_ref().map(|(_, infos)| infos.clone()))
    }

    /// The same with the name of its file, read once.
    pub(crate) fn named_models_info(&self, models: Models) -> Result<&NamedInfos, DatasetError> {
        let place = match models {
            Models::Evaluation => &self.infos[0],
            Models::Rendering => &self.infos[1],
        };
        if let Some(read) = place.get() {
            return Ok(read);
        }
        let read = self.read_models_info(models)?;
        Ok(place.get_or_init(|| read))
    }

    fn read_models_info(&self, models: Models) -> Result<NamedInfos, DatasetError> {
        let first = self.models_dir(models);
        let other = self.models_dir(Models::Rendering);
        for dir in [first, other].into_iter().flatten() {
            let path = dir.join("models_info.json");
            if path.is_file() {
                let infos = ModelsInfo::read(&path).map_err(|e| DatasetError::Model(Box::new(e)))?;
                return Ok(Some((path.display().to_string(), infos)));
            }
        }
        Ok(None)
    }

    /// The path of an object's model file, whether or not it exists.
    pub fn model_path(&self, obj_id: u32, models: Models) -> PathBuf {
        let dir = self.models_dir(models).unwrap_or_else(|| self.root.join("models"));
        dir.join(format!("obj_{obj_id:06}.ply"))
    }

    /// Reads the model of an object, in metres.
    ///
    /// # Errors
    /// [`DatasetError::NoModel`] when there is no such file, [`DatasetError::Model`] when it is broken or `models_info.json`
    /// does not describe it.
    pub fn model(&self, obj_id: u32, models: Models) -> Result<Mesh, DatasetError> {
        let path = self.model_path(obj_id, models);
        if !path.is_file() {
            let dir = path.parent().unwrap_or(&path).to_owned();
            return Err(DatasetError::NoModel { path: dir, obj_id });
        }
        let model = |error| DatasetError::Model(Box::new(error));
        let mesh = read_mesh(&path, Unit::Millimetre).map_err(model)?;
        if let Some((file, infos)) = self.named_models_info(models)? {
            infos.check_mesh(obj_id, &mesh, file).map_err(model)?;
        }
        Ok(mesh)
    }

    /// The targets: from `file`, or from the dataset's `test_targets_bop19.json`, or, where neither exists, every ground-truth pose
    /// of the split that is at least 10 % visible (or of unknown visibility).
    ///
    /// Targets in the BOP'24 form (images only) stay as they are; [`BopDataset::object_targets`] expands them to one per object.
    ///
    /// # Errors
    /// [`DatasetError`] when a file is missing or broken.
    pub fn targets(&self, file: Option<&Path>) -> Result<Vec<Target>, DatasetError> {
        let default = self.targets_file();
        let Some(path) = file.or(default.as_deref()) else { return self.all_targets() };
        let text = sixfold_io::read_regular(path, sixfold_io::limits::LARGE_TEXT)
            .map_err(|source| DatasetError::Read { path: path.to_owned(), source })?;
        parse_targets(&text, path)
    }

    /// Every ground-truth pose of the split that is at least 10 % visible (or of unknown visibility), regardless of targets files.
    ///
    /// # Errors
    /// [`DatasetError`] when a scene is broken.
    pub fn all_targets(&self) -> Result<Vec<Target>, DatasetError> {
        let images = self.images(None)?;
        let targets = images.into_iter().map(|(scene_id, im_id)| Target { scene_id, im_id, object: None });
        self.object_targets(&targets.collect::<Vec<_>>())
    }

    /// The images (scene, image) of the targets in `file`, ascending, or all of the split without a file.
    ///
    /// # Errors
    /// [`DatasetError`] when a file is missing or broken.
    pub fn images(&self, file: Option<&Path>) -> Result<BTreeSet<(u32, u32)>, DatasetError> {
        if let Some(file) = file {
            return Ok(self.targets(Some(file))?.iter().map(|t| (t.scene_id, t.im_id)).collect());
        }
        let mut images = BTreeSet::new();
        for scene_id in self.scene_ids() {
            images.extend(self.scene(scene_id)?.image_ids().into_iter().map(|im_id| (scene_id, im_id)));
        }
        Ok(images)
    }

    /// The dataset's own file of targets, `test_targets_bop19.json`, where it has one.
    pub fn targets_file(&self) -> Option<PathBuf> {
        Some(self.root.join("test_targets_bop19.json")).filter(|path| path.is_file())
    }

    /// Targets with an object each: those of a whole image become one per object with ground truth there that is at
    /// least 10 % visible (or of unknown visibility).
    ///
    /// # Errors
    /// [`DatasetError`] when a scene is missing or broken.
    pub fn object_targets(&self, targets: &[Target]) -> Result<Vec<Target>, DatasetError> {
        let mut scenes = BTreeMap::new();
        let mut spelled = Vec::new();
        for target in targets {
            if target.object.is_some() {
                spelled.push(*target);
                continue;
            }
            let scene = match scenes.entry(target.scene_id) {
                Entry::Occupied(known) => known.into_mut(),
                Entry::Vacant(new) => new.insert(self.scene(target.scene_id)?),
            };
            let image = scene.image(target.im_id)?;
            let mut counts = BTreeMap::new();
            for (pose, visible) in image.ground_truth.iter().zip(image.visible_fractions()) {
                if visible.is_none_or(|v| v >= 0.1) {
                    *counts.entry(pose.obj_id).or_insert(0) += 1;
                }
            }
            spelled.extend(counts.into_iter().map(|(obj_id, inst_count)| Target {
                object: Some(TargetObject { obj_id, inst_count }),
                ..*target
            }));
        }
        Ok(spelled)
    }
}

pub(crate) fn list_ids<'a>(ids: impl ExactSizeIterator<Item = &'a u32>) -> String {
    const SHOWN: usize = 12;
    let more = ids.len().saturating_sub(SHOWN);
    let mut text = ids.take(SHOWN).map(u32::to_string).collect::<Vec<_>>().join(", ");
    if more > 0 {
        text.push_str(&format!(" and {more} more"));
    }
    text
}

/// Width and height from `camera.json`, where the file exists and states them.
fn read_camera_size(path: &Path) -> Result<Option<StatedSize>, DatasetError> {
    if !path.is_file() {
        return Ok(None);
    }
    let text = sixfold_io::read_regular(path, sixfold_io::limits::LARGE_TEXT)
        .map_err(|source| DatasetError::Read { path: path.to_owned(), source })?;
    let json = parse(&text, path)?;
    let at = At::file(path);
    let map = at.object(&json)?;
    let (width, height) = match (map.get("width"), map.get("height")) {
        (Some(width), Some(height)) => (width, height),
        (None, None) => return Ok(None),
        (None, Some(_)) => return Err(at.error("width", "nothing", "both width and height, or neither")),
        (Some(_), None) => return Err(at.error("height", "nothing", "both width and height, or neither")),
    };
    let side = |field: &str, value| {
        let side = at.id(field, value)?;
        if side == 0 || side > 1 << 15 {
            return Err(at.error(field, format!("{side}"), "an image side from 1 to 32768 pixels"));
        }
        Ok(side as usize)
    };
    let size = (side("width", width)?, side("height", height)?);
    let large = |reason: String| at.error("width, height", reason, "the size of an image");
    check_pixels(size.0, size.1, max_pixels()).map_err(large)?;
    Ok(Some((size, path.to_owned())))
}

/// One image of a scene: its entries in the text files.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneImage {
    /// Its id.
    pub im_id: u32,
    /// Intrinsics and depth unit.
    pub camera: ImageCamera,
    /// The objects in it; empty where the scene has no ground truth.
    pub ground_truth: Vec<GroundTruth>,
    /// The entry of each object in `scene_gt_info.json`, in the same order.
    pub info: Option<Vec<GroundTruthInfo>>,
}

impl SceneImage {
    /// The visible fraction of each ground-truth pose, `None` where unknown.
    pub fn visible_fractions(&self) -> Vec<Option<f64>> {
        match &self.info {
            Some(info) => info.iter().map(|i| Some(i.visib_fract)).collect(),
            None => vec![None; self.ground_truth.len()],
        }
    }
}

/// A kind of mask of an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MaskKind {
    /// The whole silhouette inside the image (`mask`).
    Full,
    /// The visible part (`mask_visib`).
    Visible,
}

/// A scene folder with its text files read.
#[derive(Debug, Clone)]
pub struct Scene {
    /// Its id.
    pub scene_id: u32,
    dir: PathBuf,
    size: Option<StatedSize>,
    has_ground_truth: bool,
    images: BTreeMap<u32, SceneImage>,
}

impl Scene {
    fn read(scene_id: u32, dir: &Path, size: Option<StatedSize>) -> Result<Self, DatasetError> {
        let read = |name: &str| -> Result<Option<(Vec<u8>, PathBuf)>, DatasetError> {
            let path = dir.join(name);
            match sixfold_io::read_regular(&path, sixfold_io::limits::LARGE_TEXT) {
                Ok(text) => Ok(Some((text, path))),
                Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
                Err(source) => Err(DatasetError::Read { path, source }),
            }
        };
        let (text, camera_path) = read("scene_camera.json")?.ok_or_else(|| DatasetError::Missing {
            path: dir.join("scene_camera.json"),
            what: "the file with the intrinsics",
            advice: "every BOP scene has one",
        })?;
        let cameras = parse_scene_camera(&text, &camera_path)?;
        let ground_truth =
            read("scene_gt.json")?.map(|(t, p)| Ok((parse_scene_gt(&t, &p)?, p))).transpose()?;
        let infos =
            read("scene_gt_info.json")?.map(|(t, p)| Ok((parse_scene_gt_info(&t, &p)?, p))).transpose()?;
        let has_ground_truth = ground_truth.is_some();
        let (mut poses, gt_path) = ground_truth.unwrap_or_default();
        let mut images = BTreeMap::new();
        for (im_id, camera) in cameras {
            images.insert(
                im_id,
                SceneImage {
                    im_id,
                    camera,
                    ground_truth: poses.remove(&im_id).unwrap_or_default(),
                    info: None,
                },
            );
        }
        if let Some((&im_id, _)) = poses.first_key_value() {
            let found = "ground truth for it";
            return Err(At::image(&gt_path, im_id).error("(key)", found, "an image of scene_camera.json"));
        }
        if let Some((infos, path)) = infos {
            for (im_id, info) in infos {
                let Some(image) = images.get_mut(&im_id) else { continue };
                if info.len() != image.ground_truth.len() {
                    let expected = format!("{}, as in scene_gt.json", image.ground_truth.len());
                    return Err(At::image(&path, im_id).error(
                        "(number of entries)",
                        info.len().to_string(),
                        expected,
                    ));
                }
                image.info = Some(info);
            }
        }
        Ok(Scene { scene_id, dir: dir.to_owned(), size, has_ground_truth, images })
    }

    /// The scene's folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// The images of the scene, ascending.
    pub fn image_ids(&self) -> Vec<u32> {
        self.images.keys().copied().collect()
    }

    /// Whether the scene has a `scene_gt.json`.
    pub fn has_ground_truth(&self) -> bool {
        self.has_ground_truth
    }

    /// The entries of an image in the text files.
    ///
    /// # Errors
    /// [`DatasetError::NoImage`].
    pub fn image(&self, im_id: u32) -> Result<&SceneImage, DatasetError> {
        let path = self.dir.join("scene_camera.json");
        self.images.get(&im_id).ok_or(DatasetError::NoImage { path, im_id })
    }

    fn find(&self, folders: &[&str], im_id: u32) -> Option<PathBuf> {
        let candidates = folders.iter().flat_map(|folder| {
            ["png", "jpg", "jpeg", "tif"].map(|end| self.dir.join(folder).join(format!("{im_id:06}.{end}")))
        });
        candidates.into_iter().find(|path| path.is_file())
    }

    /// The colour (or grey) image file, if there is one.
    pub fn rgb_path(&self, im_id: u32) -> Option<PathBuf> {
        self.find(&["rgb", "gray"], im_id)
    }

    /// The depth image file, if there is one.
    pub fn depth_path(&self, im_id: u32) -> Option<PathBuf> {
        self.find(&["depth"], im_id)
    }

    /// The image with its size: from `camera.json`, or from the header of the colour or depth image.
    ///
    /// # Errors
    /// [`DatasetError`] when the image is not in the scene or its size is unknown.
    pub fn camera(&self, im_id: u32) -> Result<Camera, DatasetError> {
        let image = self.image(im_id)?;
        let (width, height) = self.expected_size(im_id)?.0;
        let k = image.camera;
        let camera = Camera { fx: k.fx, fy: k.fy, cx: k.cx, cy: k.cy, width, height, distortion: None };
        let path = self.dir.join("scene_camera.json");
        // This also holds for the camera of a crop, whose principal point may lie outside the image.
        camera
            .check_lens()
            .map_err(|e| At::image(&path, im_id).error("cam_K", e.to_string(), "a camera of this image"))?;
        Ok(camera)
    }

    fn expected_size(&self, im_id: u32) -> Result<((usize, usize), String), DatasetError> {
        if let Some((size, path)) = &self.size {
            return Ok((*size, path.display().to_string()));
        }
        let path = self
            .rgb_path(im_id)
            .or_else(|| self.depth_path(im_id))
            .ok_or_else(|| DatasetError::UnknownSize { path: self.dir.clone(), im_id })?;
        let size = ImageFile::new(&path).size().map_err(|e| DatasetError::of_image(im_id, e))?;
        Ok((size, path.display().to_string()))
    }

    fn open_image<T>(
        &self,
        path: Option<PathBuf>,
        im_id: u32,
        decode: impl FnOnce(&ImageFile<'_>) -> Result<T, ImageFileError>,
    ) -> Result<Option<T>, DatasetError> {
        let Some(path) = path else { return Ok(None) };
        let (expected, size_from) = self.expected_size(im_id)?;
        decode(&ImageFile::of_size(&path, expected, size_from))
            .map(Some)
            .map_err(|e| DatasetError::of_image(im_id, e))
    }

    /// The colour image (grey images as colour); `None` where the scene has none.
    ///
    /// # Errors
    /// [`DatasetError`] when the file is damaged or of another size than the camera.
    pub fn rgb(&self, im_id: u32) -> Result<Option<RgbImage>, DatasetError> {
        self.image(im_id)?;
        self.open_image(self.rgb_path(im_id), im_id, |file| file.rgb())
    }

    /// The depth image in metres, zero where nothing was measured; `None` where the scene has none.
    ///
    /// # Errors
    /// [`DatasetError`] when the file is damaged, of another size than the camera, or `depth_scale` is missing.
    pub fn depth(&self, im_id: u32) -> Result<Option<DepthImage>, DatasetError> {
        let image = self.image(im_id)?;
        let Some(path) = self.depth_path(im_id) else { return Ok(None) };
        let scene_camera = self.dir.join("scene_camera.json");
        let scale = image.camera.depth_scale.ok_or_else(|| {
            At::image(&scene_camera, im_id).error("depth_scale", "nothing", "millimetres per depth unit")
        })?;
        self.open_image(Some(path), im_id, |file| file.depth(scale))
    }

    /// The mask of ground-truth pose number `index` of an image; `None` where the scene has none.
    ///
    /// # Errors
    /// [`DatasetError`] when the file is damaged or of another size than the camera.
    pub fn mask(&self, im_id: u32, index: usize, kind: MaskKind) -> Result<Option<Mask>, DatasetError> {
        self.image(im_id)?;
        let folder = match kind {
            MaskKind::Full => "mask",
            MaskKind::Visible => "mask_visib",
        };
        let path = self.dir.join(folder).join(format!("{im_id:06}_{index:06}.png"));
        self.open_image(path.is_file().then_some(path), im_id, |file| file.mask())
    }
}
