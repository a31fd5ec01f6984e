//! A detector of any object, for objects without a trained detector: one class, trained on synthetic toys, household shapes and
//! solids in piles in front of photographs.
//!
//! Its detections are *proposals*: boxes and masks without a class. CNOS (Nguyen et al. 2023) uses a foundation model for them;
//! here it is EfficientNet-Lite0 with a pyramid, as in the detector of known objects.

use std::collections::BTreeMap;
use std::path::PathBuf;

use rand::RngExt;
use sixfold_data::{TrainingObject, background_files, plain_backgrounds};
use sixfold_geometry::random::{Random, stream};
use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_nn::device;
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
use crate::tabletop::natural_color;
use crate::training::{DetectorTraining, DetectorTrainingOptions};

/// Id of the one class.
pub const ANY_OBJECT: u32 = 0;
/// Proposals with a lower score are left out by default.
const THRESHOLD: f32 = 0.1;
/// Stages of the encoder, all of which are frozen.
const STAGES: usize = 5;
/// Fraction of toys and household shapes; the others are solids in the textures of photographs.
const TOYS: f32 = 0.6;
/// Fraction of toys in one colour.
const ONE_COLOR: f32 = 0.4;
/// Fraction of toys with two or three colours, one for each solid; the others have smooth transitions.
const PARTS: f32 = 0.4;
/// Upper bound of the number of solids in a toy that have their own colour.
const MOST_SOLIDS: usize = 16;
/// Range of sizes of the solids, metres; toys have their own sizes.
const SOLID: [f64; 2] = [0.08, 0.25];

/// Options of the training of a detector of any object.
#[derive(Debug, Clone, PartialEq)]
pub struct ProposalsRecipe {
    /// Steps, learning rate, seed, images in a step.
    pub options: DetectorTrainingOptions,
    /// Number of synthetic objects.
    pub objects: usize,
    /// Side of the training images in pixels, a multiple of 32.
    pub size: usize,
    /// Folder of photographs for textures and backgrounds; procedural textures if `None`.
    pub backgrounds: Option<PathBuf>,
    /// The command, for the model's card.
    pub command: String,
}

impl Default for ProposalsRecipe {
    fn default() -> Self {
        // A frozen encoder transfers better from synthetic to real images (Hinterstoisser et al. 2017, "On pre-trained image
        // features and synthetic images for deep learning").
        let options = DetectorTrainingOptions { frozen_stages: STAGES, ..DetectorTrainingOptions::default() };
        ProposalsRecipe { options, objects: 400, size: 320, backgrounds: None, command: String::new() }
    }
}

impl ProposalsRecipe {
    fn scenes(&self) -> TrainingImageOptions {
        TrainingImageOptions {
            size: self.size,
            photograph_fraction: 0.0,
            empty_fraction: 0.05,
            scale: [0.4, 1.6],
            max_pasted: 10,
            tabletop_fraction: 0.85,
            rotation: std::f32::consts::PI,
            render_fraction: 1.0,
            max_distractors: 2,
            // Solids are objects here, not distractors.
            solid_fraction: 0.0,
            min_visibility: 0.2,
            random_color_probability: 0.0,
            near_real_fraction: 0.0,
            one_class: true,
            ..TrainingImageOptions::default()
        }
    }

    /// The source of the training images.
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

/// An object centred on the origin.
fn object(textures: &Backgrounds, random: &mut Random) -> Option<Mesh> {
    let mesh = if random.random::<f32>() < TOYS {
        let toy = toy(random).ok()?;
        match random.random::<f32>() {
            kind if kind < ONE_COLOR => {
                let colors = vec![natural_color(random); toy.vertices().len()];
                toy.with_colors(colors).ok()?
            }
            kind if kind < ONE_COLOR + PARTS => in_parts(toy, random)?,
            _ => randomly_colored(&toy, random),
        }
    } else {
        random_solid(textures, &[], random).scaled(SOLID[0] + (SOLID[1] - SOLID[0]) * random.random::<f64>())
    };
    let (low, high) = mesh.bounding_box();
    Some(mesh.transformed(&Pose::from_translation(-(low + high) * 0.5)))
}

/// The number of the unconnected solid to which each vertex belongs, numbered in the order of the vertices.
fn solids(mesh: &Mesh) -> Vec<usize> {
    fn root(parents: &[usize], mut at: usize) -> usize {
        while parents[at] != at {
            at = parents[at];
        }
        at
    }
    // Vertices at one place are connected: the sides of boxes have vertices of their own.
    let mut places = BTreeMap::new();
    let at_place = |(number, vertex): (usize, &Vec3)| {
        let place: [u64; 3] = std::array::from_fn(|axis| vertex[axis].to_bits());
        *places.entry(place).or_insert(number)
    };
    let mut parents: Vec<usize> = mesh.vertices().iter().enumerate().map(at_place).collect();
    for face in mesh.faces() {
        let roots = face.map(|v| root(&parents, v as usize));
        let first = roots.into_iter().min().unwrap_or_default();
        roots.into_iter().for_each(|r| parents[r] = first);
    }
    let mut numbers = BTreeMap::new();
    (0..parents.len())
        .map(|v| {
            let next = numbers.len();
            *numbers.entry(root(&parents, v)).or_insert(next)
        })
        .collect()
}

/// A mesh of several solids, each in one of two or three colours.
fn in_parts(mesh: Mesh, random: &mut Random) -> Option<Mesh> {
    let palette: Vec<[u8; 3]> = (0..random.random_range(2..=3u32)).map(|_| natural_color(random)).collect();
    let of_solid: Vec<[u8; 3]> = (0..mesh.vertices().len().min(MOST_SOLIDS))
        .map(|_| palette[random.random_range(0..palette.len())])
        .collect();
    let colors = solids(&mesh).into_iter().map(|solid| of_solid[solid % of_solid.len()]).collect();
    mesh.with_colors(colors).ok()
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
        if let Err(crate::samples::TrainingImageError::Option { field, found, expected }) =
            self.scenes().check()
        {
            return Err(OptionError { field, found, expected });
        }
        self.options.check()
    }

    fn inputs(&self, (): &()) -> Result<Fingerprint, TrainError> {
        // Every field by its name, so that the compiler reports a new one; the size is in the options of the samples.
        let ProposalsRecipe { options, objects, size: _, backgrounds, command: _ } = self;
        let backgrounds =
            background_files(backgrounds.as_deref()).map_err(TrainError::about("backgrounds"))?;
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
        let device = device::chosen().autodiff();

        let config = DetectorConfig::proposals();
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

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    #[test]
    fn every_option_and_every_background_counts() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("a.png"), b"one").unwrap();
        let of = |recipe: &ProposalsRecipe| recipe.inputs(&()).unwrap();
        let differs = |change: &dyn Fn(&mut ProposalsRecipe), name: &str| {
            let mut recipe = ProposalsRecipe::default();
            change(&mut recipe);
            let difference = of(&ProposalsRecipe::default()).difference(&of(&recipe)).unwrap();
            assert!(difference.contains(&format!("{name} was")), "{difference}");
        };
        differs(&|r| r.options.common.steps = 3, "steps");
        differs(&|r| r.options.common.seed = 3, "seed");
        differs(&|r| r.options.batch = 3, "batch");
        differs(&|r| r.objects = 3, "objects");
        differs(&|r| r.size = 96, "samples.size");
        differs(&|r| r.backgrounds = Some(folder.path().to_owned()), "backgrounds");
        let command = "another".to_owned();
        let same = ProposalsRecipe { command, ..ProposalsRecipe::default() };
        assert_eq!(of(&same), of(&ProposalsRecipe::default()));
    }

    #[test]
    fn a_training_leaves_the_encoder_as_imagenet_made_it() {
        use burn::tensor::Tensor;

        let device = Device::flex();
        let encoder = Encoder::Lite0(imagenet_encoder(&device).unwrap());
        let values = (0..3 * 64 * 64).map(|i| ((i * 37) % 255) as f32 / 128.0 - 1.0).collect();
        let input = Tensor::<4>::from_data(burn::tensor::TensorData::new(values, [1, 3, 64, 64]), &device);
        let shipped = DetectorModel::proposals().unwrap();
        let maps = [&encoder, shipped.encoder().unwrap()].map(|encoder| encoder.maps(input.clone()));
        for (own, shipped) in maps[0].iter().zip(&maps[1]) {
            let numbers = |map: &Tensor<4>| map.clone().into_data().try_to_vec::<f32>().unwrap();
            let (own, shipped) = (numbers(own), numbers(shipped));
            let largest = own.iter().fold(0.0f32, |most, v| most.max(v.abs()));
            // The shipped numbers have half precision.
            assert!(largest > 0.5 && own.iter().zip(&shipped).all(|(a, b)| (a - b).abs() < 0.02 * largest));
        }
    }

    #[test]
    fn each_solid_of_a_toy_has_one_color() {
        let mut random = stream(1, 0);
        let mut several = 0;
        for _ in 0..20 {
            let toy = toy(&mut random).unwrap();
            let numbers = solids(&toy);
            assert!(
                toy.faces().iter().all(|f| f.iter().all(|v| numbers[*v as usize] == numbers[f[0] as usize]))
            );
            let count = numbers.iter().max().unwrap() + 1;
            assert!((3..=8).contains(&count), "{count}");
            let colored = in_parts(toy, &mut random).unwrap();
            let colors = colored.colors().unwrap();
            let of_solid: std::collections::BTreeSet<_> = numbers.iter().zip(colors).collect();
            assert_eq!(of_solid.len(), count);
            let different: std::collections::BTreeSet<_> = colors.iter().collect();
            assert!(different.len() <= 3);
            several += usize::from(different.len() > 1);
        }
        assert!(several > 14, "{several}");
    }

    #[test]
    fn options_out_of_range_are_named() {
        let named = |change: &dyn Fn(&mut ProposalsRecipe)| {
            let mut recipe = ProposalsRecipe::default();
            change(&mut recipe);
            recipe.check().unwrap_err().field
        };
        assert_eq!(ProposalsRecipe::default().check(), Ok(()));
        assert_eq!(named(&|r| r.objects = 0), "objects");
        assert_eq!(named(&|r| r.size = 100), "size");
        assert_eq!(named(&|r| r.options.batch = 0), "batch");
    }

    #[test]
    fn all_objects_of_a_training_image_are_of_one_class_and_within_their_boxes() {
        let recipe = ProposalsRecipe { objects: 12, size: 160, ..ProposalsRecipe::default() };
        let source = recipe.source().unwrap();
        let mut objects = 0;
        for number in 0..12 {
            let image = source.sample(3, number);
            assert_eq!(image, source.sample(3, number));
            for (index, instance) in image.annotation.instances.iter().enumerate() {
                assert_eq!(instance.class, 0);
                let pixels = || (0..160 * 160).filter(|i| image.annotation.labels[*i] == index as u8 + 1);
                let [x0, y0, x1, y1] = instance.corners.map(|c| c as usize);
                assert!(pixels().all(|i| (x0..=x1).contains(&(i % 160)) && (y0..=y1).contains(&(i / 160))));
                assert!(pixels().count() > 0);
                objects += 1;
            }
        }
        assert!(objects > 24, "{objects} objects in 12 images");
    }

    #[test]
    fn the_built_in_detector_finds_objects_it_was_not_trained_on() {
        use crate::detector::TrainedDetector;
        use sixfold_estimator::ObjectDetector;
        use sixfold_geometry::Rect;

        let mut recipe = ProposalsRecipe { objects: 40, ..ProposalsRecipe::default() };
        // Objects and images with another seed than the training's.
        recipe.options.common.seed = 77;
        let source = recipe.source().unwrap();
        let detector = TrainedDetector::proposals().unwrap();
        let without = crate::detect::DetectOptions { voting: false, ..*detector.options() };
        let without = TrainedDetector::proposals().unwrap().with_options(without);
        let (mut found, mut all) = (0, 0);
        for number in 0..10 {
            let image = source.sample(77, number);
            let area = 320 * 320;
            let rgb = sixfold_geometry::RgbImage::from_fn(320, 320, |x, y| {
                std::array::from_fn(|c| (image.rgb[c * area + y * 320 + x] * 255.0).round() as u8)
            });
            let proposals = detector.detect(&rgb).unwrap();
            assert!(proposals.iter().all(|p| p.object_id == ANY_OBJECT));
            // The boxes are means: none would be the same without the others.
            let single = without.detect(&rgb).unwrap();
            assert_eq!(proposals.len(), single.len());
            assert!(proposals.iter().zip(&single).any(|(mean, one)| mean.region.bbox != one.region.bbox));
            for instance in &image.annotation.instances {
                let [x0, y0, x1, y1] = instance.corners.map(f64::from);
                let truth = Rect { x: x0, y: y0, width: x1 - x0, height: y1 - y0 };
                found += usize::from(proposals.iter().any(|p| p.region.bbox.iou(&truth) > 0.5));
                all += 1;
            }
        }
        assert!(all > 30 && 10 * found > 9 * all, "{found} of {all}");
    }
}
