//! A detector of anything that could be an object, for objects nobody trained on: one class, learnt from synthetic toys,
//! household shapes and solids that lie in heaps before photographs.
//!
//! What it finds are *proposals*: boxes and masks without a name. CNOS (Nguyen et al. 2023) takes them from a foundation
//! model; this one is EfficientNet-Lite0 with a pyramid, as the detector of known objects.

use std::path::PathBuf;

use burn::tensor::Device;
use rand::RngExt;
use sixfold_data::{TrainingObject, background_files, plain_backgrounds};
use sixfold_geometry::Pose;
use sixfold_geometry::random::{Random, stream};
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_nn::fingerprint::Fingerprint;
use sixfold_nn::lite0::imagenet_encoder;
use sixfold_nn::options::OptionError;
use sixfold_nn::recipe::{Prepared, Recipe, Session};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::weights::ModelCard;
use sixfold_synth::augment::Backgrounds;
use sixfold_synth::distractors::random_solid;
use sixfold_synth::randomly_colored;
use sixfold_synth::shapes::toy;

use crate::model::{ClassEntry, DetectorModel, DetectorUse};
use crate::network::{DetectorConfig, Encoder};
use crate::samples::{TrainingImageOptions, TrainingImageSource};
use crate::training::{DetectorTraining, DetectorTrainingOptions};

/// Id of the one class.
pub const ANY_OBJECT: u32 = 0;
/// Proposals with a lower score are left out unless something else is asked for.
const THRESHOLD: f32 = 0.1;
/// Fraction of toys and household shapes; the others are solids in the textures of photographs.
const TOYS: f32 = 0.6;
/// Fraction of toys in one colour; the others are in several that change slowly.
const PLAIN: f32 = 0.7;
/// Sizes of the objects, metres: a toy's are its own.
const SOLID: [f64; 2] = [0.08, 0.25];

/// How a detector of any object is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct ProposalsRecipe {
    /// Steps, learning rate, seed, images in a step.
    pub options: DetectorTrainingOptions,
    /// Synthetic objects to learn from.
    pub objects: usize,
    /// Side of the training images in pixels, a multiple of 32.
    pub size: usize,
    /// Folder of photographs for textures and backgrounds; procedural textures without.
    pub backgrounds: Option<PathBuf>,
    /// What was asked for, for the model's card.
    pub command: String,
}

impl Default for ProposalsRecipe {
    fn default() -> Self {
        let options = DetectorTrainingOptions::default();
        ProposalsRecipe { options, objects: 400, size: 320, backgrounds: None, command: String::new() }
    }
}

impl ProposalsRecipe {
    fn scenes(&self) -> TrainingImageOptions {
        TrainingImageOptions {
            size: self.size,
            photograph_share: 0.0,
            empty_fraction: 0.05,
            scale: [0.4, 1.6],
            max_pasted: 10,
            tabletop_fraction: 0.75,
            rotation: std::f32::consts::PI,
            render_share: 1.0,
            max_distractors: 2,
            // Solids are objects.
            solid_fraction: 0.0,
            min_visibility: 0.2,
            random_color_probability: 0.0,
            near_real_fraction: 0.0,
            one_class: true,
            ..TrainingImageOptions::default()
        }
    }

    /// What a training draws its images from.
    ///
    /// # Errors
    /// [`TrainError`] for backgrounds that cannot be read and options out of range.
    pub fn source(&self) -> Result<TrainingImageSource, TrainError> {
        self.source_of(self.backgrounds()?)
    }

    fn source_of(&self, textures: Backgrounds) -> Result<TrainingImageSource, TrainError> {
        let objects = objects(&textures, self.objects, self.seed());
        TrainingImageSource::new(objects, &[], &[], textures, self.scenes()).map_err(TrainError::method)
    }

    fn backgrounds(&self) -> Result<Backgrounds, TrainError> {
        let (backgrounds, fraction) =
            plain_backgrounds(self.backgrounds.as_deref()).map_err(TrainError::method)?;
        Ok(backgrounds.with_procedural_fraction(fraction))
    }
}

/// An object about the origin.
fn object(textures: &Backgrounds, random: &mut Random) -> Option<Mesh> {
    let mesh = if random.random::<f32>() < TOYS {
        let toy = toy(random).ok()?;
        if random.random::<f32>() < PLAIN {
            let color = std::array::from_fn(|_| random.random_range(15..=240u8));
            let count = toy.vertices().len();
            toy.with_colors(vec![color; count]).ok()?
        } else {
            randomly_colored(&toy, random)
        }
    } else {
        random_solid(textures, &[], random).scaled(SOLID[0] + (SOLID[1] - SOLID[0]) * random.random::<f64>())
    };
    let (low, high) = mesh.bounding_box();
    Some(mesh.transformed(&Pose::from_translation(-(low + high) * 0.5)))
}

fn objects(textures: &Backgrounds, count: usize, seed: u64) -> Vec<TrainingObject> {
    let made = (0..).filter_map(|number| object(textures, &mut stream(seed ^ 0x0b1e_c75a, number)));
    let numbered = (1..).zip(made.take(count));
    numbered.map(|(id, mesh)| TrainingObject::new(id, mesh.clone(), ModelInfo::of_mesh(&mesh))).collect()
}

impl Recipe for ProposalsRecipe {
    type Data = ();
    type Samples = TrainingImageSource;
    type Training = DetectorTraining;
    type Context = Backgrounds;
    type Report = ();

    fn steps(&self) -> u64 {
        self.options.common.steps
    }

    fn seed(&self) -> u64 {
        self.options.common.seed
    }

    fn command(&self) -> &str {
        &self.command
    }

    fn check(&self) -> Result<(), OptionError> {
        let objects = (1..=100_000).contains(&self.objects);
        OptionError::unless(objects, "objects", self.objects, "1 to 100000")?;
        if let Err(crate::samples::TrainingImageError::Option { field, found, expected }) = self.scenes().check() {
            return Err(OptionError { field, found, expected });
        }
        self.options.check()
    }

    fn inputs(&self, (): &()) -> Result<Fingerprint, TrainError> {
        // Every field by its name, so that a new one finds its place; the size is in the options of the samples.
        let ProposalsRecipe { options, objects, size: _, backgrounds, command: _ } = self;
        let backgrounds = background_files(backgrounds.as_deref()).map_err(TrainError::about("backgrounds"))?;
        Fingerprint::of(options)?
            .merged(&Fingerprint::of(&serde_json::json!({ "samples": self.scenes() }))?)
            .with("objects", *objects as u64)
            .with_files("backgrounds", &backgrounds)
    }

    fn prepare(
        &self,
        (): (),
        _: &mut Session<'_>,
    ) -> Result<Prepared<DetectorTraining, Backgrounds>, TrainError> {
        let device = Device::flex().autodiff();
        let config = DetectorConfig::compact(1);
        let encoder = Encoder::Lite0(imagenet_encoder(&device)?);
        let network = config.init_with(encoder, self.seed(), &device);
        let textures = self.backgrounds()?;
        let images = match textures.images() {
            0 => "noise".to_owned(),
            n => format!("{n} photographs and noise"),
        };
        let mut card = ModelCard::new("", "Proposals: a detector of any object in colour images");
        card.data = format!(
            "{} synthetic toys, household shapes and solids with random colours, textures and backgrounds from {images}; no scanned object; encoder initialised from ImageNet (EfficientNet-Lite0, Apache-2.0)",
            self.objects
        );
        card.extra = serde_json::json!({ "training": self.options });
        let training = DetectorTraining::new(network, config, self.size, self.options.clone(), device);
        Ok(Prepared { training, card, context: textures })
    }

    fn samples(
        &self,
        textures: &mut Backgrounds,
        session: &mut Session<'_>,
    ) -> Result<Option<TrainingImageSource>, TrainError> {
        session.note(&format!("making {} objects", self.objects));
        self.source_of(textures.clone()).map(Some)
    }

    fn finish(
        &self,
        Prepared { training, card, .. }: Prepared<DetectorTraining, Backgrounds>,
        session: &mut Session<'_>,
    ) -> Result<Option<()>, TrainError> {
        let usage = DetectorUse { threshold: THRESHOLD, ..DetectorUse::default() };
        let (network, config) = training.into_network();
        let classes = vec![ClassEntry { id: ANY_OBJECT }];
        DetectorModel::new(network, config, classes, usage, card)
            .save(&session.model())
            .map_err(TrainError::method)?;
        Ok(Some(()))
    }
}
