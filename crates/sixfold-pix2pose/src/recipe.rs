//! A complete training: from objects and their photographs to a model file. It can be interrupted at any time and resumed.

use std::collections::BTreeMap;
use std::f32::consts::PI;
use std::path::PathBuf;

use burn::tensor::Device;
use sixfold_align::outline::outline_mesh;
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_nn::choice::Choice;
use sixfold_nn::device;
use sixfold_nn::fingerprint::Fingerprint;
use sixfold_nn::learner::Checkpointed;
use sixfold_nn::lite0::imagenet_encoder;
use sixfold_nn::options::{OptionError, TrainingOptions};
use sixfold_nn::recipe::{Prepared, Recipe, Session, TrainingEvent, continued_from};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::training::{Batches, Losses, Plan, Training};
use sixfold_nn::weights::{ModelCard, training_frames};

use crate::adversarial::{AdversarialBatch, AdversarialOptions, AdversarialTraining};
use crate::aligned::measure_corrections;
use crate::model::{ImageSizes, Network, Pix2PoseModel};
use crate::networks::{
    Compact, CompactConfig, PaperGenerator, PaperGeneratorConfig, ResNet50Generator, ResNet50GeneratorConfig,
};
use crate::object::{ObjectEntry, SymmetryMap, symmetry_deviation};
use crate::outlier_threshold::choose;
use crate::preset::Preset;
use crate::samples::{SampleOptions, SampleSource};
use crate::training::{CompactBatch, CompactTraining, Pix2PoseTrainingOptions};
use sixfold_data::{
    FrameId, PosedImage, TrainingObject, TrainingSet, background_files, backgrounds_with_images,
};
use sixfold_synth::augment::{Backgrounds, PhotographOptions};

/// Which network is trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum NetworkKind {
    /// ImageNet encoder shared by all objects, a small decoder for each; trains on two cores.
    #[default]
    Compact,
    /// The dissertation's generator with its discriminator, one object.
    Paper,
    /// The same generator with a ResNet-50 encoder, as in the entry to BOP 2020.
    ResNet50,
}

impl Choice for NetworkKind {
    const ALL: &'static [NetworkKind] = &[NetworkKind::Compact, NetworkKind::Paper, NetworkKind::ResNet50];

    fn name(self) -> &'static str {
        match self {
            NetworkKind::Compact => "compact",
            NetworkKind::Paper => "paper",
            NetworkKind::ResNet50 => "resnet50",
        }
    }

    fn help(self) -> &'static str {
        match self {
            NetworkKind::Compact => {
                "ImageNet encoder shared by all objects, a small decoder for each; trains on two cores"
            }
            NetworkKind::Paper => {
                "The dissertation's generator with its discriminator, one object; a step of 50 images takes about 20 s on two cores"
            }
            NetworkKind::ResNet50 => "The same with a ResNet-50 encoder, as in the entry to BOP 2020",
        }
    }
}

/// Options of the training.
#[derive(Debug, Clone, PartialEq)]
pub struct Pix2PoseRecipe {
    /// Which network is trained.
    pub network: NetworkKind,
    /// Number of steps; `None`: that of [`Pix2PoseTrainingOptions`], or of [`AdversarialOptions`] for the dissertation's networks,
    /// as for the next two fields. 0: keeps the weights of `init` and only measures the systematic error of their alignment again.
    pub steps: Option<u64>,
    /// Images of every object in a step.
    pub per_object: Option<usize>,
    /// Maximum learning rate.
    pub learning_rate: Option<f64>,
    /// Train against a discriminator; `None`: with one for the dissertation's networks, without one for the compact network.
    pub adversarial: Option<bool>,
    /// torchvision's ResNet-50 weights for [`NetworkKind::ResNet50`]; random ones if `None`.
    pub encoder: Option<PathBuf>,
    /// Number of frozen stages of the ImageNet encoder, of five.
    pub frozen_stages: usize,
    /// Fraction of renders among the images, 0 to 1.
    pub render_fraction: f32,
    /// Fraction of renders whose pose is near that of a photograph, 0 to 1.
    pub near_photographs: f32,
    /// Largest rotation of photographs in the image plane, radians.
    pub rotation: f32,
    /// Side of the network's input in pixels, a multiple of 32.
    pub size: usize,
    /// Continue from the weights of another training instead of ImageNet's.
    pub init: Option<PathBuf>,
    /// Render the meshes in their own colours; otherwise in random ones.
    pub mesh_colors: bool,
    /// Learn the coordinates of the meshes' convex hulls.
    pub convex_hull: bool,
    /// The transformer loss for symmetric objects (equation 3.2); otherwise plain L1.
    pub transformer_loss: bool,
    /// Plain L1, with one side of a symmetric object representing all equivalent ones.
    pub view_limits: bool,
    /// Symmetries, outlier thresholds and occlusion of one of the dissertation's experiments; `None`: symmetries as stated by the
    /// dataset, and the thresholds of the BOP entries.
    pub preset: Option<Preset>,
    /// Samples, loss and choice of the outlier threshold as in the dissertation ([`Pix2PoseRecipe::published`]).
    pub published: bool,
    /// Folder of photographs for backgrounds; procedural textures if `None`.
    pub backgrounds: Option<PathBuf>,
    /// Seed of weights and samples.
    pub seed: u64,
    /// The command, for the model's card.
    pub command: String,
}

impl Default for Pix2PoseRecipe {
    fn default() -> Self {
        let samples = SampleOptions::default();
        Pix2PoseRecipe {
            network: NetworkKind::Compact,
            steps: None,
            per_object: None,
            learning_rate: None,
            adversarial: None,
            encoder: None,
            frozen_stages: Pix2PoseTrainingOptions::default().frozen_stages,
            render_fraction: samples.render_fraction,
            near_photographs: samples.near_real_fraction,
            rotation: samples.rotation,
            size: samples.size,
            init: None,
            mesh_colors: true,
            convex_hull: false,
            transformer_loss: true,
            view_limits: false,
            preset: None,
            published: false,
            backgrounds: None,
            seed: 0,
            command: String::new(),
        }
    }
}

/// Smallest visibility of instances: those below it add label noise.
pub const MIN_VISIBILITY: f64 = 0.25;

/// Weight of the compact network's adversarial loss: the dissertation's lambda_1 is 100.
const ADVERSARIAL: f32 = 0.01;

/// Data prepared before the first step, in addition to the network.
pub struct Context {
    objects: Vec<TrainingObject>,
    real: Vec<PosedImage>,
    entries: Vec<ObjectEntry>,
    sizes: ImageSizes,
    outlines: BTreeMap<u32, (Mesh, ModelInfo)>,
}

impl Pix2PoseRecipe {
    /// The dissertation's training (section 3.4.1): its generator and discriminator, 25,000 batches of 50 that alternately imitate
    /// the first and the second stage, colours of table 3.2, photographs on random backgrounds and partly hidden by parts of them
    /// (table 3.3), beta on the whole mask (equation 3.1), and an outlier threshold that is chosen on training images with
    /// artificial occlusion, unless `preset` gives it.
    pub fn published() -> Self {
        let samples = SampleOptions::published(1);
        Pix2PoseRecipe {
            network: NetworkKind::Paper,
            render_fraction: samples.render_fraction,
            rotation: samples.rotation,
            published: true,
            ..Pix2PoseRecipe::default()
        }
    }

    /// Training options of the compact network.
    pub fn compact_options(&self) -> Pix2PoseTrainingOptions {
        let default = Pix2PoseTrainingOptions::default();
        Pix2PoseTrainingOptions {
            common: default.common.with(self.steps, self.learning_rate, self.seed),
            per_object: self.per_object.unwrap_or(default.per_object),
            frozen_stages: self.frozen_stages,
            transformer_loss: self.transformer_loss && !self.view_limits,
            adversarial: if self.adversarial == Some(true) { ADVERSARIAL } else { 0.0 },
            ..default
        }
    }

    /// Training options of the dissertation's networks.
    pub fn dissertation_options(&self) -> AdversarialOptions {
        let default = AdversarialOptions::default();
        AdversarialOptions {
            steps: self.steps.unwrap_or(default.steps),
            batch: self.per_object.unwrap_or(default.batch),
            learning_rate: self.learning_rate.unwrap_or(default.learning_rate),
            adversarial: self.adversarial.unwrap_or(default.adversarial),
            transformer_loss: self.transformer_loss && !self.view_limits,
            whole_mask: self.published,
            seed: self.seed,
            ..default
        }
    }

    /// Options of the samples.
    fn sample_options(&self, sizes: ImageSizes) -> SampleOptions {
        let default = match self.published {
            true => SampleOptions::published(self.dissertation_options().batch as u64),
            false => SampleOptions::default(),
        };
        SampleOptions {
            synchronised_masks: self.published && (self.convex_hull || self.preset == Some(Preset::Tless)),
            size: sizes.input,
            target_size: Some(sizes.output),
            render_fraction: self.render_fraction,
            near_real_fraction: self.near_photographs,
            rotation: self.rotation,
            random_color_probability: if self.mesh_colors { 0.0 } else { 1.0 },
            view_limits: self.view_limits,
            occlusion: self.preset.map_or(default.occlusion, Preset::occlusion),
            seed: self.seed,
            ..default
        }
    }

    /// Objects according to the preset and `convex_hull`, and a description of them.
    fn objects(
        &self,
        mut objects: Vec<TrainingObject>,
        mut description: String,
        session: &mut Session<'_>,
    ) -> Result<(Vec<TrainingObject>, String), TrainError> {
        if let Some(preset) = self.preset {
            for object in &mut objects {
                apply(preset, object, session)?;
            }
            description += &format!("; the dissertation's parameters for {}", preset.name());
        }
        for object in &objects {
            warn_of_symmetry(object, session);
        }
        if self.convex_hull {
            for object in &mut objects {
                let about = format!("object {}: its vertices have no convex hull", object.id);
                object.mesh = object.mesh.convex_hull().map_err(TrainError::about(about))?;
            }
            description += "; convex hulls in place of the meshes";
        }
        Ok((objects, description))
    }

    fn entry(&self, object: &TrainingObject) -> ObjectEntry {
        let mut entry = ObjectEntry::new(object.id, &object.info, &object.scale);
        if let Some(thresholds) = self.preset.and_then(|preset| preset.thresholds(object.id)) {
            entry.thresholds = thresholds;
        }
        entry
    }

    fn card(&self, description: String, frames: &[FrameId]) -> Result<ModelCard, TrainError> {
        // Training frames also include those of the initial weights and those on which corrections are measured.
        let frames = training_frames(self.init.as_deref(), frames).map_err(TrainError::method)?;
        if let (Some(file), Some(0)) = (&self.init, self.steps) {
            let mut card = Pix2PoseModel::load(file).map_err(TrainError::method)?.card().clone();
            card.extra["corrections"] = serde_json::json!({ "command": self.command, "data": description });
            card.training_frames = frames;
            return Ok(card);
        }
        let mut card = ModelCard::new("", "Pix2Pose, compact network");
        card.training_frames = frames;
        card.data = description;
        card.extra = serde_json::json!({
            "training": self.compact_options(), "continued_from": continued_from(self.init.as_deref())?
        });
        if self.network != NetworkKind::Compact {
            card.title = format!("Pix2Pose, the dissertation's schedule, {} network", self.network.name());
            card.extra = serde_json::json!({ "training": self.dissertation_options() });
        }
        Ok(card)
    }

    fn training(&self, objects: &[TrainingObject], device: Device) -> Result<Pix2PoseTraining, TrainError> {
        let ids: Vec<u32> = objects.iter().map(|o| o.id).collect();
        let mut pools: Vec<Vec<SymmetryMap>> =
            objects.iter().map(|o| SymmetryMap::pool(&o.info, &o.scale)).collect();
        Ok(match self.network {
            NetworkKind::Compact => {
                let network = self.compact(&ids, &device)?;
                let options = self.compact_options();
                Pix2PoseTraining::Compact(CompactTraining::new(network, pools, self.size, options, device))
            }
            NetworkKind::Paper => {
                let generator = PaperGeneratorConfig { seed: self.seed }.init(&device);
                let options = self.dissertation_options();
                Pix2PoseTraining::Paper(AdversarialTraining::new(generator, pools.remove(0), options, device))
            }
            NetworkKind::ResNet50 => {
                let config = ResNet50GeneratorConfig { seed: self.seed };
                let generator = match &self.encoder {
                    Some(file) => config.from_pytorch(file, &device).map_err(TrainError::method)?,
                    None => config.init(&device),
                };
                let options = self.dissertation_options();
                let training = AdversarialTraining::new(generator, pools.remove(0), options, device);
                Pix2PoseTraining::ResNet50(training)
            }
        })
    }

    fn compact(&self, ids: &[u32], device: &Device) -> Result<Compact, TrainError> {
        match &self.init {
            Some(file) => Pix2PoseModel::network_for_training(file, ids, device).map_err(TrainError::method),
            None => {
                let config = CompactConfig { objects: ids.len() };
                Ok(config.init(imagenet_encoder(device)?, self.seed, device))
            }
        }
    }
}

impl Recipe for Pix2PoseRecipe {
    type Data = TrainingSet;
    type Samples = SampleSource;
    type Training = Pix2PoseTraining;
    type Context = Context;
    type Report = ();

    fn steps(&self) -> u64 {
        match self.network {
            NetworkKind::Compact => self.compact_options().common.steps,
            _ => self.dissertation_options().steps,
        }
    }

    fn seed(&self) -> u64 {
        self.seed
    }

    fn command(&self) -> &str {
        &self.command
    }

    fn check(&self) -> Result<(), OptionError> {
        let fits = self.size.is_multiple_of(32) && (32..=512).contains(&self.size);
        OptionError::unless(fits, "size", self.size, "a multiple of 32 from 32 to 512")?;
        let fits = (0.0..=PI).contains(&self.rotation);
        OptionError::unless(fits, "rotation", self.rotation, "radians from 0 to half a turn")?;
        OptionError::unless_fraction("render_fraction", self.render_fraction)?;
        OptionError::unless_fraction("near_photographs", self.near_photographs)?;
        OptionError::unless_samples("per_object", self.per_object.unwrap_or(1), 1, "1 or more")?;
        let expected = "1 or more, or weights to begin with, whose alignment is then measured again";
        OptionError::unless(self.steps != Some(0) || self.init.is_some(), "steps", 0, expected)?;
        let fits = !self.published || self.network != NetworkKind::Compact;
        let found = format!("published with the {} network", self.network.name());
        OptionError::unless(fits, "preset", found, "network paper or resnet50 with it")?;
        let wrong = self.encoder.is_some() && self.network != NetworkKind::ResNet50;
        let found = format!("one for the {} network", self.network.name());
        OptionError::unless(!wrong, "encoder", found, "network resnet50; the others bring theirs along")?;
        if self.network == NetworkKind::Compact {
            let common = TrainingOptions { steps: self.steps().max(1), ..self.compact_options().common };
            Pix2PoseTrainingOptions { common, ..self.compact_options() }.check()
        } else {
            let fits = self.size == 128 && self.init.is_none();
            OptionError::unless(fits, "network", self.described(1), DISSERTATION)?;
            self.dissertation_options().check()
        }
    }

    fn inputs(&self, material: &TrainingSet) -> Result<Fingerprint, TrainError> {
        // Every field by its name, so that the compiler reports a new one.
        #[rustfmt::skip]
        let Pix2PoseRecipe {
            network, encoder, render_fraction, near_photographs, rotation, size, init, mesh_colors, convex_hull, view_limits, preset,
            published, backgrounds,
            // These are in the training's options.
            steps: _, per_object: _, learning_rate: _, adversarial: _, frozen_stages: _, transformer_loss: _, seed: _,
            // This does not affect the training.
            command: _,
        } = self;
        let training = match network {
            NetworkKind::Compact => Fingerprint::of(&self.compact_options())?,
            _ => Fingerprint::of(&self.dissertation_options())?,
        };
        let backgrounds = background_files(backgrounds.as_deref()).map_err(TrainError::method)?;
        training
            .with("network", network.name())
            .with("render_fraction", *render_fraction)
            .with("near_photographs", *near_photographs)
            .with("rotation", *rotation)
            .with("size", *size)
            .with("mesh_colors", *mesh_colors)
            .with("convex_hull", *convex_hull)
            .with("view_limits", *view_limits)
            .with("preset", preset.map(Preset::name))
            .with("published", *published)
            .with_contents(material.contents())
            .with_file("encoder", encoder.as_deref())?
            .with_file("init", init.as_deref())?
            .with_files("backgrounds", &backgrounds)
    }

    fn prepare(
        &self,
        material: TrainingSet,
        session: &mut Session<'_>,
    ) -> Result<Prepared<Pix2PoseTraining, Context>, TrainError> {
        let TrainingSet { objects, images: real, frames, description } = material;
        let compact = self.network == NetworkKind::Compact;
        let fits = compact || objects.len() == 1;
        OptionError::unless(fits, "network", self.described(objects.len()), DISSERTATION)?;
        let (objects, description) = self.objects(objects, description, session)?;
        let training = self.training(&objects, device::chosen().autodiff())?;
        let card = self.card(description, &frames)?;
        let context = Context {
            entries: objects.iter().map(|o| self.entry(o)).collect(),
            sizes: ImageSizes { input: self.size, output: if compact { self.size / 2 } else { self.size } },
            outlines: outlines(&objects, &real),
            objects,
            real,
        };
        Ok(Prepared { training, card, context })
    }

    fn samples(
        &self,
        context: &mut Context,
        session: &mut Session<'_>,
    ) -> Result<Option<SampleSource>, TrainError> {
        let Context { objects, real, sizes, .. } = context;
        let backgrounds = self.backgrounds_of(real, objects)?;
        session.note(&format!(
            "making {} objects and {} photographed instances ready",
            objects.len(),
            real.len()
        ));
        // The published form generates further samples at the end.
        let objects = if self.published { objects.clone() } else { std::mem::take(objects) };
        SampleSource::new(objects, real.clone(), backgrounds, self.sample_options(*sizes))
            .map(Some)
            .map_err(TrainError::method)
    }

    /// Measures the systematic error of the model's aligned poses on the photographs of the training.
    fn finish(
        &self,
        Prepared { training, card, context }: Prepared<Pix2PoseTraining, Context>,
        session: &mut Session<'_>,
    ) -> Result<Option<()>, TrainError> {
        let Context { objects, real, entries, sizes, outlines } = context;
        let mut model = match (&self.init, self.steps) {
            (Some(file), Some(0)) => Pix2PoseModel::load(file).map_err(TrainError::method)?.with_card(card),
            _ => {
                let mut model = Pix2PoseModel::new(training.into_network(), entries, sizes, card);
                if self.published && self.preset.is_none() {
                    let threshold = self.outlier_threshold(&model, objects, &real, sizes)?;
                    session.note(&format!("outlier threshold, chosen on training images: {threshold}"));
                    model.set_thresholds(&[threshold]);
                }
                model
            }
        };
        let path = session.model();
        model.save(&path).map_err(TrainError::method)?;
        if real.is_empty() {
            return Ok(Some(()));
        }
        let corrections = {
            let progress = session.progress(TrainingEvent::Measuring);
            measure_corrections(&model, &real, &outlines, &progress).map_err(TrainError::method)?
        };
        let Some(corrections) = corrections else { return Ok(None) };
        model.set_corrections(&corrections);
        model.save(&path).map_err(TrainError::method)?;
        Ok(Some(()))
    }
}

impl Pix2PoseRecipe {
    /// The backgrounds of the training images; as published only the photographs of the folder, if there is one.
    fn backgrounds_of(
        &self,
        real: &[PosedImage],
        objects: &[TrainingObject],
    ) -> Result<Backgrounds, TrainError> {
        let made = match (self.published, self.backgrounds.as_deref()) {
            (true, Some(folder)) => Backgrounds::from_folder(folder, &PhotographOptions::default())
                .map(|photographs| photographs.with_procedural_fraction(0.0)),
            (_, folder) => backgrounds_with_images(folder, real, objects),
        };
        made.map_err(TrainError::method)
    }

    /// The outlier threshold of the object, chosen on images of the first stage in which it is always partly hidden.
    fn outlier_threshold(
        &self,
        model: &Pix2PoseModel,
        objects: Vec<TrainingObject>,
        real: &[PosedImage],
        sizes: ImageSizes,
    ) -> Result<f32, TrainError> {
        let backgrounds = self.backgrounds_of(real, &objects)?;
        let options = SampleOptions { second_stage_fraction: 0.0, ..self.sample_options(sizes) };
        let source = SampleSource::new(objects, real.to_vec(), backgrounds, options);
        Ok(choose(model, 0, &source.map_err(TrainError::method)?, self.seed.wrapping_add(1)))
    }
}

/// The options that the dissertation's networks support.
const DISSERTATION: &str =
    "the compact network, or one object, images of 128 pixels and no weights to begin with";

impl Pix2PoseRecipe {
    fn described(&self, objects: usize) -> String {
        format!("{} for {objects} objects, images of {} pixels", self.network.name(), self.size)
    }
}

/// One of the networks in training.
#[allow(clippy::large_enum_variant)]
pub enum Pix2PoseTraining {
    /// See [`NetworkKind::Compact`].
    Compact(CompactTraining),
    /// See [`NetworkKind::Paper`].
    Paper(AdversarialTraining<PaperGenerator>),
    /// See [`NetworkKind::ResNet50`].
    ResNet50(AdversarialTraining<ResNet50Generator>),
}

/// The batch of a step of one of the networks.
pub enum Pix2PoseBatch {
    /// Images of all objects.
    Compact(CompactBatch),
    /// Images of one object.
    Adversarial(AdversarialBatch),
}

impl Pix2PoseTraining {
    /// The trained network.
    pub fn into_network(self) -> Network {
        match self {
            Pix2PoseTraining::Compact(training) => Network::Compact(Box::new(training.into_network())),
            Pix2PoseTraining::Paper(training) => Network::Paper(Box::new(training.into_network())),
            Pix2PoseTraining::ResNet50(training) => Network::ResNet50(Box::new(training.into_network())),
        }
    }
}

impl Training for Pix2PoseTraining {
    type Samples = SampleSource;
    type Batch = Pix2PoseBatch;

    fn plan(&self, source: &SampleSource) -> Result<Plan, TrainError> {
        match self {
            Pix2PoseTraining::Compact(training) => training.plan(source),
            Pix2PoseTraining::Paper(training) => training.plan(source),
            Pix2PoseTraining::ResNet50(training) => training.plan(source),
        }
    }

    fn batches<'a>(&self, source: &'a SampleSource) -> Batches<'a, Pix2PoseBatch> {
        let adversarial = match self {
            Pix2PoseTraining::Compact(training) => {
                let batches = training.batches(source);
                return Box::new(move |step| Pix2PoseBatch::Compact(batches(step)));
            }
            Pix2PoseTraining::Paper(training) => training.batches(source),
            Pix2PoseTraining::ResNet50(training) => training.batches(source),
        };
        Box::new(move |step| Pix2PoseBatch::Adversarial(adversarial(step)))
    }

    fn step(&mut self, batch: Pix2PoseBatch, rate: f64) -> Losses {
        match (self, batch) {
            (Pix2PoseTraining::Compact(t), Pix2PoseBatch::Compact(batch)) => t.step(batch, rate),
            (Pix2PoseTraining::Paper(t), Pix2PoseBatch::Adversarial(batch)) => t.step(batch, rate),
            (Pix2PoseTraining::ResNet50(t), Pix2PoseBatch::Adversarial(batch)) => t.step(batch, rate),
            _ => unreachable!("batches are those of the network"),
        }
    }

    fn learners(&mut self) -> Vec<&mut dyn Checkpointed> {
        match self {
            Pix2PoseTraining::Compact(training) => training.learners(),
            Pix2PoseTraining::Paper(training) => training.learners(),
            Pix2PoseTraining::ResNet50(training) => training.learners(),
        }
    }

    fn restored(&mut self) {
        if let Pix2PoseTraining::Compact(training) = self {
            training.restored();
        }
    }
}

/// Outline meshes for measuring the alignment, for objects with photographs.
fn outlines(objects: &[TrainingObject], photographs: &[PosedImage]) -> BTreeMap<u32, (Mesh, ModelInfo)> {
    if photographs.is_empty() {
        return BTreeMap::new();
    }
    objects.iter().map(|o| (o.id, (outline_mesh(&o.mesh), o.info.clone()))).collect()
}

/// Sets the symmetries of an object to those of a preset, which must include the object.
fn apply(preset: Preset, object: &mut TrainingObject, session: &mut Session<'_>) -> Result<(), OptionError> {
    if preset.thresholds(object.id).is_none() {
        let found = format!("{} with object {}", preset.name(), object.id);
        return Err(OptionError::new("preset", found, preset.objects()));
    }
    let pooled = preset.with_pool(object.id, &object.info);
    let stated = std::mem::replace(&mut object.info, pooled);
    let count = |info: &ModelInfo| (info.symmetries_discrete.len(), info.symmetries_continuous.len());
    if count(&stated) != count(&object.info) {
        session.note(&format!(
            "object {}: {} discrete and {} continuous symmetries of appendix A in place of the dataset's {} and {}",
            object.id,
            object.info.symmetries_discrete.len(),
            object.info.symmetries_continuous.len(),
            stated.symmetries_discrete.len(),
            stated.symmetries_continuous.len()
        ));
    }
    Ok(())
}

/// Warns of a symmetry that the mesh does not have, which would mislead the training, with the distance by which it moves the
/// surface.
fn warn_of_symmetry(object: &TrainingObject, session: &mut Session<'_>) {
    for pose in object.info.symmetry_poses(0.1).iter().skip(1) {
        let deviation = symmetry_deviation(&object.mesh, pose);
        if deviation > 0.05 * object.info.diameter {
            session.warn(&format!(
                "object {}: under a declared symmetry its surface moves by {:.1} mm ({:.0} % of the diameter); \
                 check symmetries in models_info.json",
                object.id,
                1000.0 * deviation,
                100.0 * deviation / object.info.diameter
            ));
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::Image;
    use sixfold_geometry::random::stream;

    #[test]
    fn published_backgrounds_are_the_photographs_of_the_folder_alone() {
        let folder = tempfile::tempdir().unwrap();
        sixfold_io::write_rgb(&folder.path().join("grey.png"), &Image::filled(64, 64, [90; 3])).unwrap();
        let recipe = Pix2PoseRecipe { backgrounds: Some(folder.path().into()), ..Pix2PoseRecipe::default() };
        // How many of 60 backgrounds show anything but the photograph.
        let others = |recipe: &Pix2PoseRecipe| {
            let backgrounds = recipe.backgrounds_of(&[], &[]).unwrap();
            let random = &mut stream(1, 2);
            let grey = |v: &f32| (255.0 * v - 90.0).abs() < 1.0;
            (0..60).filter(|_| !backgrounds.patch(16, 16, random).data.iter().all(grey)).count()
        };
        assert!(others(&recipe) > 0);
        assert_eq!(others(&Pix2PoseRecipe { published: true, ..recipe }), 0);
    }
}
