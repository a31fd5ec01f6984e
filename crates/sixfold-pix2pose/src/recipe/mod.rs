//! A whole training: objects and their photographs in, a model file out. Interrupted at any time, it goes on.

mod error;

use std::collections::BTreeMap;
use std::f32::consts::PI;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use burn::tensor::Device;
use sixfold_data::{PosedImage, TrainingObject, TrainingSet, backgrounds_with_images};
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_nn::lite0::imagenet_encoder;
use sixfold_nn::recipe::{Listener, News, NotReady, Trained, continued_from};
use sixfold_nn::training::Ending;
use sixfold_nn::training_log::TrainingRecord;
use sixfold_nn::weights::{ModelCard, WeightsError, training_frames};
use sixfold_align::outline::outline_mesh;

pub use self::error::RecipeError;
use crate::adversarial::{AdversarialOptions, train_adversarial};
use crate::aligned::measure_corrections;
use crate::model::{ImageSizes, Network, Pix2PoseModel};
use crate::networks::{Compact, CompactConfig, PaperGeneratorConfig, ResNet50GeneratorConfig};
use crate::object::{ObjectEntry, SymmetryMap, symmetry_deviation};
use crate::preset::Preset;
use crate::samples::{SampleOptions, SampleSource};
use crate::training::{TrainingOptions, last_checkpoint, train};

/// Which network learns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum NetworkKind {
    /// ImageNet encoder shared by all objects, a small decoder for each; trains on two cores.
    #[default]
    Compact,
    /// The dissertation's generator with its discriminator, one object.
    Paper,
    /// The same with a ResNet-50 encoder, as in the entry to BOP 2020.
    ResNet50,
}

impl NetworkKind {
    /// All kinds.
    pub const ALL: [NetworkKind; 3] = [NetworkKind::Compact, NetworkKind::Paper, NetworkKind::ResNet50];

    /// As it is typed.
    pub fn name(self) -> &'static str {
        match self {
            NetworkKind::Compact => "compact",
            NetworkKind::Paper => "paper",
            NetworkKind::ResNet50 => "resnet50",
        }
    }
}

/// How a model is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct Recipe {
    /// Which network learns.
    pub network: NetworkKind,
    /// Steps in all; `None`: 8000, the dissertation's networks 25000.
    pub steps: Option<u64>,
    /// Images of every object in a step; `None`: 4, the dissertation's networks 50.
    pub per_object: Option<usize>,
    /// Highest learning rate; `None`: 0.002, the dissertation's networks 0.0001.
    pub learning_rate: Option<f64>,
    /// Train against a discriminator; `None`: the dissertation's networks with one, the compact one without.
    pub adversarial: Option<bool>,
    /// torchvision's ResNet-50 weights for [`NetworkKind::ResNet50`]; random ones without.
    pub encoder: Option<PathBuf>,
    /// Stages of the ImageNet encoder that stay as they are, of five.
    pub frozen_stages: usize,
    /// Share of renders among the images, 0 to 1.
    pub render_share: f32,
    /// Share of renders whose pose lies near one of a photograph, 0 to 1.
    pub near_photographs: f32,
    /// Largest turn of photographs in the image plane, radians.
    pub rotation: f32,
    /// Side of the network's input in pixels, a multiple of 32.
    pub size: usize,
    /// Go on from the weights of another training instead of ImageNet's.
    pub init: Option<PathBuf>,
    /// Draw the meshes in their own colours; otherwise in random ones.
    pub mesh_colors: bool,
    /// Learn the coordinates of the meshes' convex hulls.
    pub convex_hull: bool,
    /// The transformer loss for symmetric objects (equation 3.2); otherwise plain L1.
    pub transformer_loss: bool,
    /// Plain L1 with one side of a symmetric object standing for all.
    pub view_limits: bool,
    /// Symmetries, outlier thresholds and occlusion of one of the dissertation's experiments; `None`: symmetries as they
    /// are stated, the thresholds of its BOP entries.
    pub preset: Option<Preset>,
    /// Folder of photographs for backgrounds; made-up textures without.
    pub backgrounds: Option<PathBuf>,
    /// Seed of weights and samples.
    pub seed: u64,
    /// What was asked for, for the model's card.
    pub command: String,
}

impl Default for Recipe {
    fn default() -> Self {
        Recipe {
            network: NetworkKind::Compact,
            steps: None,
            per_object: None,
            learning_rate: None,
            adversarial: None,
            encoder: None,
            frozen_stages: 2,
            render_share: 0.5,
            near_photographs: 0.5,
            rotation: 45f32.to_radians(),
            size: 128,
            init: None,
            mesh_colors: true,
            convex_hull: false,
            transformer_loss: true,
            view_limits: false,
            preset: None,
            backgrounds: None,
            seed: 0,
            command: String::new(),
        }
    }
}

/// Instances of a photograph that are less visible teach more confusion than shape.
pub const LEAST_VISIBLE: f64 = 0.25;

/// Weight of the compact network's adversarial loss: the dissertation's lambda_1 is 100.
const ADVERSARIAL: f32 = 0.01;

/// Everything that stands before the first step.
struct Prepared {
    objects: Vec<TrainingObject>,
    real: Vec<PosedImage>,
    entries: Vec<ObjectEntry>,
    network: Compact,
    card: ModelCard,
    sizes: ImageSizes,
    device: Device,
    folder: PathBuf,
    path: PathBuf,
}

impl Recipe {
    /// Trains, or goes on with the training in `out`, and writes the model there. `stop` ends it after the current step.
    ///
    /// # Errors
    /// [`RecipeError`].
    pub fn train(
        &self,
        material: TrainingSet,
        out: &Path,
        stop: &AtomicBool,
        hear: &mut Listener<'_>,
    ) -> Result<Ending<Trained>, RecipeError> {
        if self.steps == Some(0) {
            return Ok(Ending::Finished(self.measure_anew(material, out, hear)?));
        }
        let Prepared { objects, real, entries, network, mut card, sizes, device, folder, path } =
            self.prepare(material, out, hear)?;
        let outlines = outlines(&objects, &real);
        let photographs = real.clone();
        let backgrounds = backgrounds_with_images(self.backgrounds.as_deref(), &real, &objects)?;
        let pools: Vec<Vec<SymmetryMap>> =
            objects.iter().map(|o| SymmetryMap::pool(&o.info, &o.scale)).collect();
        let sample_options = SampleOptions {
            size: sizes.input,
            target_size: Some(sizes.output),
            render_share: self.render_share,
            near_real_share: self.near_photographs,
            rotation: self.rotation,
            random_color_chance: if self.mesh_colors { 0.0 } else { 1.0 },
            view_limits: self.view_limits,
            occlusion: self.preset.map_or(SampleOptions::default().occlusion, Preset::occlusion),
            seed: self.seed,
            ..SampleOptions::default()
        };
        hear(News::Note(&format!(
            "making {} objects and {} photographed instances ready",
            objects.len(),
            photographs.len()
        )));
        let source = SampleSource::new(objects, real, backgrounds, sample_options)?;
        let steps = self.steps();
        let mut last = TrainingRecord::default();
        let shown = |record: &TrainingRecord| {
            hear(News::Steps(record, steps));
            last = record.clone();
        };
        let ending = match self.network {
            NetworkKind::Compact => {
                let options = self.compact_options();
                train(&source, &pools, network, &device, &folder, &options, stop, shown)?
            }
            NetworkKind::Paper => {
                let generator = PaperGeneratorConfig { seed: self.seed }.init(&device);
                let options = self.dissertation_options();
                train_adversarial(&source, &pools[0], generator, &device, &folder, &options, stop, shown)?
                    .map(|n| Network::Paper(Box::new(n)))
            }
            NetworkKind::ResNet50 => {
                let config = ResNet50GeneratorConfig { seed: self.seed };
                let generator = match &self.encoder {
                    Some(file) => config.from_pytorch(file, &device)?,
                    None => config.init(&device),
                };
                let options = self.dissertation_options();
                train_adversarial(&source, &pools[0], generator, &device, &folder, &options, stop, shown)?
                    .map(|n| Network::ResNet50(Box::new(n)))
            }
        };
        let network = match ending {
            Ending::Finished(network) => network,
            Ending::Interrupted { step } => return Ok(Ending::Interrupted { step }),
        };
        card.steps = steps;
        let model = Pix2PoseModel::new(network, entries, sizes, card);
        save_corrected(model, &path, &photographs, &outlines, hear)?;
        Ok(Ending::Finished(Trained { model: path, steps, seconds: Some(last.seconds), losses: last.losses }))
    }

    /// Writes the model of the last checkpoint in `out`.
    ///
    /// # Errors
    /// [`RecipeError`].
    pub fn export(
        &self,
        material: TrainingSet,
        out: &Path,
        hear: &mut Listener<'_>,
    ) -> Result<Trained, RecipeError> {
        if self.network != NetworkKind::Compact {
            return Err(wrong("export", self.network.name(), "the compact network"));
        }
        let p = self.prepare(material, out, hear)?;
        let Some((network, step)) = last_checkpoint(&p.folder, p.network)? else {
            return Err(NotReady::NoCheckpoint { folder: p.folder }.into());
        };
        let card = ModelCard { steps: step, ..p.card };
        let model = Pix2PoseModel::new(Network::Compact(Box::new(network)), p.entries, p.sizes, card);
        save_corrected(model, &p.path, &p.real, &outlines(&p.objects, &p.real), hear)?;
        Ok(Trained { model: p.path, steps: step, seconds: None, losses: BTreeMap::new() })
    }

    /// The model to begin with as it is, with what its aligned poses are off by measured anew: the alignment may have changed
    /// since it was trained.
    fn measure_anew(
        &self,
        material: TrainingSet,
        out: &Path,
        hear: &mut Listener<'_>,
    ) -> Result<Trained, RecipeError> {
        let Some(file) = &self.init else {
            return Err(wrong(
                "steps",
                0,
                "1 or more, or weights to begin with, whose alignment is then measured anew",
            ));
        };
        let model = Pix2PoseModel::load(file)?;
        let (steps, mut card) = (model.card().steps, model.card().clone());
        let p = self.prepare(material, out, hear)?;
        // The corrections are learnt from these frames too.
        card.training_frames = p.card.training_frames.clone();
        card.extra["corrections"] = serde_json::json!({ "command": self.command, "data": p.card.data });
        let model = model.with_card(card);
        std::fs::create_dir_all(out)
            .map_err(|source| WeightsError::Write { file: p.path.clone(), source })?;
        save_corrected(model, &p.path, &p.real, &outlines(&p.objects, &p.real), hear)?;
        Ok(Trained { model: p.path, steps, seconds: None, losses: BTreeMap::new() })
    }

    /// Steps in all.
    pub fn steps(&self) -> u64 {
        if self.network == NetworkKind::Compact {
            self.compact_options().steps
        } else {
            self.dissertation_options().steps
        }
    }

    fn compact_options(&self) -> TrainingOptions {
        let default = TrainingOptions::default();
        TrainingOptions {
            steps: self.steps.unwrap_or(default.steps),
            per_object: self.per_object.unwrap_or(default.per_object),
            learning_rate: self.learning_rate.unwrap_or(default.learning_rate),
            frozen_stages: self.frozen_stages,
            transformer_loss: self.transformer_loss && !self.view_limits,
            adversarial: if self.adversarial == Some(true) { ADVERSARIAL } else { 0.0 },
            seed: self.seed,
            ..default
        }
    }

    fn dissertation_options(&self) -> AdversarialOptions {
        AdversarialOptions {
            steps: self.steps.unwrap_or(25_000),
            batch: self.per_object.unwrap_or(50),
            learning_rate: self.learning_rate.unwrap_or(1e-4),
            adversarial: self.adversarial.unwrap_or(true),
            transformer_loss: self.transformer_loss && !self.view_limits,
            seed: self.seed,
            ..AdversarialOptions::default()
        }
    }

    fn check(&self, objects: usize) -> Result<(), RecipeError> {
        if !self.size.is_multiple_of(32) || !(32..=512).contains(&self.size) {
            return Err(wrong("size", self.size, "a multiple of 32 from 32 to 512"));
        }
        if !(0.0..=PI).contains(&self.rotation) {
            return Err(wrong("rotation", self.rotation, "radians from 0 to half a turn"));
        }
        if self.network != NetworkKind::Compact && (objects != 1 || self.size != 128 || self.init.is_some()) {
            let found =
                format!("{} for {objects} objects, images of {} pixels", self.network.name(), self.size);
            return Err(wrong(
                "network",
                found,
                "the compact network, or one object, images of 128 pixels and no weights to begin with",
            ));
        }
        Ok(())
    }

    fn prepare(
        &self,
        material: TrainingSet,
        out: &Path,
        hear: &mut Listener<'_>,
    ) -> Result<Prepared, RecipeError> {
        let TrainingSet { mut objects, images: real, frames, mut description } = material;
        self.check(objects.len())?;
        if let Some(preset) = self.preset {
            for object in &mut objects {
                apply(preset, object, hear)?;
            }
            description += &format!("; the dissertation's parameters for {}", preset.name());
        }
        for object in &objects {
            warn_of_symmetry(object, hear);
        }
        if self.convex_hull {
            for object in &mut objects {
                let id = object.id;
                let hull = object.mesh.convex_hull().map_err(|reason| RecipeError::Hull { id, reason })?;
                object.mesh = hull;
            }
            description += "; convex hulls in place of the meshes";
        }
        let compact = self.network == NetworkKind::Compact;
        let sizes = ImageSizes { input: self.size, output: if compact { self.size / 2 } else { self.size } };
        let entries: Vec<ObjectEntry> = objects
            .iter()
            .map(|o| {
                let mut entry = ObjectEntry::new(o.id, &o.info, &o.scale);
                if let Some(thresholds) = self.preset.and_then(|preset| preset.thresholds(o.id)) {
                    entry.thresholds = thresholds;
                }
                entry
            })
            .collect();
        let ids: Vec<u32> = entries.iter().map(|e| e.id).collect();
        // Tells of wrong weights before anything else begins.
        let device = Device::flex().autodiff();
        let network = match &self.init {
            Some(file) => Pix2PoseModel::network_for_training(file, &ids, &device)?,
            None => CompactConfig { objects: ids.len() }.init(imagenet_encoder(&device)?, self.seed, &device),
        };
        let mut card = ModelCard::new("", "Pix2Pose, compact network");
        card.data = description;
        card.training_frames = training_frames(self.init.as_deref(), &frames)?;
        card.seed = self.seed;
        card.command.clone_from(&self.command);
        card.extra = serde_json::json!({
            "training": self.compact_options(), "continued_from": continued_from(self.init.as_deref())?
        });
        if !compact {
            card.title = format!("Pix2Pose, the dissertation's schedule, {} network", self.network.name());
            card.extra = serde_json::json!({ "training": self.dissertation_options() });
        }
        let (folder, path) = (out.join("training"), out.join("model.safetensors"));
        Ok(Prepared { objects, real, entries, network, card, sizes, device, folder, path })
    }
}

fn wrong(field: &'static str, found: impl ToString, expected: &'static str) -> RecipeError {
    NotReady::option(field, found, expected).into()
}

/// What the alignment is measured with, where there are photographs to measure it on.
fn outlines(objects: &[TrainingObject], photographs: &[PosedImage]) -> BTreeMap<u32, (Mesh, ModelInfo)> {
    if photographs.is_empty() {
        return BTreeMap::new();
    }
    objects.iter().map(|o| (o.id, (outline_mesh(&o.mesh), o.info.clone()))).collect()
}

/// Writes the model with what its aligned poses are off by on the photographs that it learnt from.
fn save_corrected(
    mut model: Pix2PoseModel,
    path: &Path,
    photographs: &[PosedImage],
    outlines: &BTreeMap<u32, (Mesh, ModelInfo)>,
    hear: &mut Listener<'_>,
) -> Result<(), RecipeError> {
    // First without: nothing that was trained may be lost.
    model.save(path)?;
    if photographs.is_empty() {
        return Ok(());
    }
    let mut done = 0;
    let corrections = measure_corrections(&model, photographs, outlines, || {
        done += 1;
        hear(News::Measuring(done, photographs.len()));
    })?;
    model.set_corrections(&corrections);
    Ok(model.save(path)?)
}

/// A symmetry that the mesh does not have misleads the training: say how far the surface is off.
/// Gives an object the symmetries of a preset, which must have the object.
fn apply(preset: Preset, object: &mut TrainingObject, hear: &mut Listener<'_>) -> Result<(), RecipeError> {
    if preset.thresholds(object.id).is_none() {
        let found = format!("{} with object {}", preset.name(), object.id);
        return Err(wrong("preset", found, preset.objects()));
    }
    let pooled = preset.with_pool(object.id, &object.info);
    let stated = std::mem::replace(&mut object.info, pooled);
    let count = |info: &ModelInfo| (info.symmetries_discrete.len(), info.symmetries_continuous.len());
    if count(&stated) != count(&object.info) {
        hear(News::Note(&format!(
            "object {}: {} discrete and {} continuous symmetries of appendix A in place of the dataset's {} and {}",
            object.id,
            object.info.symmetries_discrete.len(),
            object.info.symmetries_continuous.len(),
            stated.symmetries_discrete.len(),
            stated.symmetries_continuous.len()
        )));
    }
    Ok(())
}

fn warn_of_symmetry(object: &TrainingObject, hear: &mut Listener<'_>) {
    for pose in object.info.symmetry_poses(0.1).iter().skip(1) {
        let deviation = symmetry_deviation(&object.mesh, pose);
        if deviation > 0.05 * object.info.diameter {
            hear(News::Warning(&format!(
                "object {}: under a declared symmetry its surface moves by {:.1} mm ({:.0} % of the diameter); \
                 check symmetries in models_info.json",
                object.id,
                1000.0 * deviation,
                100.0 * deviation / object.info.diameter
            )));
            return;
        }
    }
}
