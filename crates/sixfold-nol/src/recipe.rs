//! A complete training of the network that renders new views, from a seed alone (better: with photographs for textures). It can be
//! interrupted at any time and resumed.

use std::path::PathBuf;

use sixfold_data::background_files;
use sixfold_nn::choice::Choice;
use sixfold_nn::device;
use sixfold_nn::fingerprint::Fingerprint;
use sixfold_nn::options::OptionError;
use sixfold_nn::recipe::{Prepared, Recipe, Session};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::weights::ModelCard;
use sixfold_synth::augment::{Backgrounds, PhotographOptions};

use crate::loss::Perceptual;
use crate::model::NolModel;
use crate::network::{CompactConfig, Network, PaperConfig, Parts};
use crate::quality::{Quality, QualityOptions, quality};
use crate::training::{NolLosses, NolTraining, NolTrainingOptions};

/// Fraction of procedural textures among the photographs.
const PROCEDURAL_FRACTION: f32 = 0.2;

/// Which network is trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum NolKind {
    /// On a frozen EfficientNet-Lite0; trains on two cores.
    #[default]
    Compact,
    /// The dissertation's, on DenseNet-121.
    Paper,
}

impl Choice for NolKind {
    const ALL: &'static [NolKind] = &[NolKind::Compact, NolKind::Paper];

    fn name(self) -> &'static str {
        match self {
            NolKind::Compact => "compact",
            NolKind::Paper => "paper",
        }
    }

    fn help(self) -> &'static str {
        match self {
            NolKind::Compact => "On a frozen EfficientNet-Lite0; trains on two cores",
            NolKind::Paper => "The dissertation's, on DenseNet-121; needs weeks on two cores",
        }
    }
}

impl NolKind {
    /// Its default training options.
    pub fn options(self) -> NolTrainingOptions {
        match self {
            NolKind::Compact => NolTrainingOptions::default(),
            NolKind::Paper => NolTrainingOptions::published(),
        }
    }
}

/// How the network is trained.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct NolRecipe {
    /// Which network is trained.
    pub network: NolKind,
    /// ImageNet weights of DenseNet-121 in torchvision's layout for [`NolKind::Paper`]; random ones if `None`.
    pub encoder: Option<PathBuf>,
    /// How sources are integrated, and whether there is a decoder.
    pub parts: Parts,
    /// Which losses are summed; `None`: those of [`NolKind::options`].
    pub losses: Option<NolLosses>,
    /// Folder of photographs for textures, backgrounds and clutter; procedural textures only if `None`.
    pub backgrounds: Option<PathBuf>,
    /// Number of steps; `None`: the value of [`NolKind::options`], as for the next field.
    pub steps: Option<u64>,
    /// Maximum learning rate.
    pub learning_rate: Option<f64>,
    /// Seed of weights and samples.
    pub seed: u64,
    /// The command, for the model's card.
    pub command: String,
}

impl NolRecipe {
    /// The dissertation's training (section 4.3.3): its network, its losses, eight sources with rough poses.
    pub fn published() -> Self {
        NolRecipe { network: NolKind::Paper, ..NolRecipe::default() }
    }

    /// How the network is trained.
    pub fn options(&self) -> NolTrainingOptions {
        let default = self.network.options();
        let default = match self.losses {
            Some(losses) => default.with_losses(losses),
            None => default,
        };
        NolTrainingOptions {
            common: default.common.with(self.steps, self.learning_rate, self.seed),
            ..default
        }
    }
}

impl Recipe for NolRecipe {
    type Data = ();
    type Samples = Backgrounds;
    type Training = NolTraining;
    type Context = Backgrounds;
    type Report = Quality;

    fn steps(&self) -> u64 {
        self.options().common.steps
    }

    fn seed(&self) -> u64 {
        self.seed
    }

    fn command(&self) -> &str {
        &self.command
    }

    fn check(&self) -> Result<(), OptionError> {
        let wrong = self.encoder.is_some() && self.network == NolKind::Compact;
        let expected = "network paper; the compact network brings its encoder along";
        OptionError::unless(!wrong, "encoder", "one for the compact network", expected)?;
        self.options().check()
    }

    fn inputs(&self, (): &()) -> Result<Fingerprint, TrainError> {
        // Every field by name, so that the compiler reports a new one; fields left out are in the options or have no effect.
        #[rustfmt::skip]
        let NolRecipe { network, encoder, parts, backgrounds, losses: _, steps: _, learning_rate: _, seed: _, command: _ } = self;
        let backgrounds =
            background_files(backgrounds.as_deref()).map_err(TrainError::about("backgrounds"))?;
        Fingerprint::of(&self.options())?
            .merged(&Fingerprint::of(&serde_json::json!({ "parts": parts }))?)
            .with("network", network.name())
            .with_file("encoder", encoder.as_deref())?
            .with_files("backgrounds", &backgrounds)
    }

    fn prepare(&self, _: (), _: &mut Session<'_>) -> Result<Prepared<NolTraining, Backgrounds>, TrainError> {
        let device = device::chosen().autodiff();
        let parts = self.parts;
        let network = match (self.network, &self.encoder) {
            (NolKind::Compact, _) => Network::Compact(CompactConfig { parts }.init(self.seed, &device)?),
            (NolKind::Paper, None) => Network::Paper(PaperConfig { parts }.init(self.seed, &device)),
            (NolKind::Paper, Some(file)) => {
                let network = PaperConfig { parts }.from_imagenet(file, self.seed, &device);
                Network::Paper(network.map_err(TrainError::about("encoder"))?)
            }
        };
        // As published, photographs alone.
        let procedural = if self.network == NolKind::Paper { 0.0 } else { PROCEDURAL_FRACTION };
        let textures = match &self.backgrounds {
            Some(folder) => Backgrounds::from_folder(folder, &PhotographOptions::default())
                .map_err(TrainError::about("backgrounds"))?
                .with_procedural_fraction(procedural),
            None => Backgrounds::procedural(),
        };
        let mut card = ModelCard::new("", "Neural Object Learning, new views from few photographs");
        card.data = format!(
            "synthetic household shapes (procedural families, alone and grown together) with textures from {}; no scanned object",
            match textures.images() {
                0 => "noise".to_owned(),
                n => format!("{n} photographs and noise"),
            }
        );
        let options = self.options();
        card.extra = serde_json::json!({ "training": options });
        let perceptual = Perceptual::of(&network, &device)?;
        let training = NolTraining::new(network, parts, perceptual, options, device).with_preview(&textures);
        Ok(Prepared { training, card, context: textures })
    }

    fn samples(
        &self,
        textures: &mut Backgrounds,
        _: &mut Session<'_>,
    ) -> Result<Option<Backgrounds>, TrainError> {
        Ok(Some(textures.clone()))
    }

    /// Measures the similarity of its renderings to the ground truth, on synthetic objects that it was not trained on.
    fn finish(
        &self,
        Prepared { training, card, context: textures }: Prepared<NolTraining, Backgrounds>,
        session: &mut Session<'_>,
    ) -> Result<Option<Quality>, TrainError> {
        let path = session.model();
        let mut model = NolModel::new(training.into_network(), self.parts, card);
        model.save(&path).map_err(TrainError::method)?;
        session.note("measuring the model on synthetic objects");
        let quality = quality(&model, &textures, &self.options().samples, &QualityOptions::default())
            .map_err(TrainError::method)?;
        model.card_mut().scores = quality.scores();
        model.save(&path).map_err(TrainError::method)?;
        Ok(Some(quality))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::IntegratorKind;

    #[test]
    fn every_option_and_every_background_counts() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str| folder.path().join(name);
        std::fs::write(file("a.png"), b"one").unwrap();
        let default = NolRecipe::default;
        let of = |recipe: &NolRecipe| recipe.inputs(&()).unwrap();
        let differs = |recipe: NolRecipe, name: &str| {
            let difference = of(&default()).difference(&of(&recipe)).unwrap();
            assert!(difference.contains(&format!("{name} was")), "{difference}");
        };
        differs(NolRecipe { network: NolKind::Paper, ..default() }, "batch.sides");
        differs(NolRecipe { encoder: Some(file("a.png")), ..default() }, "encoder");
        let parts = Parts { integrator: IntegratorKind::Average, ..Parts::default() };
        differs(NolRecipe { parts, ..default() }, "parts.integrator");
        differs(NolRecipe { steps: Some(3), ..default() }, "steps");
        differs(NolRecipe { learning_rate: Some(0.5), ..default() }, "learning_rate");
        differs(NolRecipe { seed: 3, ..default() }, "seed");
        let photographs = NolRecipe { backgrounds: Some(folder.path().to_owned()), ..default() };
        differs(photographs.clone(), "backgrounds");
        let before = of(&photographs);
        std::fs::write(file("notes.txt"), b"no photograph").unwrap();
        assert_eq!(of(&photographs), before);
        std::fs::write(file("a.png"), b"two").unwrap();
        assert!(before.difference(&of(&photographs)).unwrap().starts_with("backgrounds was"));
        // The text of the command has no effect, and stating a default value explicitly gives the same result.
        let command = "another".to_owned();
        assert_eq!(of(&NolRecipe { command, steps: Some(default().steps()), ..default() }), of(&default()));
    }
}
