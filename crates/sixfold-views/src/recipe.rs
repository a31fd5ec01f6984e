//! A complete training of the network for views, from a seed alone (better: with photographs for textures and backgrounds). It can
//! be interrupted at any time and resumed.

use std::path::{Path, PathBuf};

use sixfold_data::background_files;
use sixfold_nn::device;
use sixfold_nn::fingerprint::Fingerprint;
use sixfold_nn::options::OptionError;
use sixfold_nn::recipe::{Prepared, Recipe, Session};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::weights::{ModelCard, save_weights, write_card_markdown};
use sixfold_synth::augment::{Backgrounds, PhotographOptions};

use crate::network::{ARCHITECTURE, ViewNetwork};
use crate::training::{ViewsTraining, ViewsTrainingOptions};

/// Fraction of procedural textures among the photographs.
const PROCEDURAL_FRACTION: f32 = 0.2;

/// Textures, backgrounds and occluders of the training objects.
pub(crate) fn textures(backgrounds: Option<&Path>) -> Result<Backgrounds, TrainError> {
    let Some(folder) = backgrounds else { return Ok(Backgrounds::procedural()) };
    let photographs = Backgrounds::from_folder(folder, &PhotographOptions::default());
    Ok(photographs.map_err(TrainError::about("backgrounds"))?.with_procedural_fraction(PROCEDURAL_FRACTION))
}

/// Description of the training objects for a model's card.
pub(crate) fn described(textures: &Backgrounds) -> String {
    let images = match textures.images() {
        0 => "noise".to_owned(),
        n => format!("{n} photographs and noise"),
    };
    format!(
        "synthetic toys and household shapes with random colours, textures, backgrounds and occluders from {images}; no scanned object"
    )
}

/// Options of the training.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ViewsRecipe {
    /// Folder of photographs for textures, backgrounds and occluders; procedural textures only if `None`.
    pub backgrounds: Option<PathBuf>,
    /// Steps, learning rate, seed, crops.
    pub options: ViewsTrainingOptions,
    /// The command, for the model's card.
    pub command: String,
}

impl Recipe for ViewsRecipe {
    type Data = ();
    type Samples = Backgrounds;
    type Training = ViewsTraining;
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
        self.options.check()
    }

    fn inputs(&self, (): &()) -> Result<Fingerprint, TrainError> {
        // Every field by name, so that the compiler reports a new one; fields left out are in the options or have no effect.
        let ViewsRecipe { backgrounds, options, command: _ } = self;
        let backgrounds =
            background_files(backgrounds.as_deref()).map_err(TrainError::about("backgrounds"))?;
        Fingerprint::of(options)?.with_files("backgrounds", &backgrounds)
    }

    fn prepare(
        &self,
        (): (),
        _: &mut Session<'_>,
    ) -> Result<Prepared<ViewsTraining, Backgrounds>, TrainError> {
        let device = device::chosen().autodiff();
        let network = ViewNetwork::untrained(&device)?;
        let textures = textures(self.backgrounds.as_deref())?;
        let mut card = ModelCard::new(ARCHITECTURE, "Views, features of known objects in colour images");
        let weights = "initial weights: XFeat (Potje et al. 2024, Apache-2.0)";
        card.data = format!("{}; {weights}", described(&textures));
        let options = self.options.clone();
        card.extra = serde_json::json!({ "training": options });
        Ok(Prepared { training: ViewsTraining::new(network, options, device), card, context: textures })
    }

    fn samples(
        &self,
        textures: &mut Backgrounds,
        _: &mut Session<'_>,
    ) -> Result<Option<Backgrounds>, TrainError> {
        Ok(Some(textures.clone()))
    }

    fn finish(
        &self,
        Prepared { training, card, .. }: Prepared<ViewsTraining, Backgrounds>,
        session: &mut Session<'_>,
    ) -> Result<Option<()>, TrainError> {
        let path = session.model();
        save_weights(&training.into_network(), &card, &path)?;
        write_card_markdown(&card, &path.with_extension("md"))?;
        Ok(Some(()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_option_and_every_background_counts() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("a.png"), b"one").unwrap();
        let of = |recipe: &ViewsRecipe| recipe.inputs(&()).unwrap();
        let differs = |recipe: ViewsRecipe, name: &str| {
            let difference = of(&ViewsRecipe::default()).difference(&of(&recipe)).unwrap();
            assert!(difference.contains(&format!("{name} was")), "{difference}");
        };
        let with = |change: &dyn Fn(&mut ViewsTrainingOptions)| {
            let mut recipe = ViewsRecipe::default();
            change(&mut recipe.options);
            recipe
        };
        differs(with(&|o| o.common.steps = 3), "steps");
        differs(with(&|o| o.common.learning_rate = 0.5), "learning_rate");
        differs(with(&|o| o.common.seed = 3), "seed");
        differs(with(&|o| o.batch = 3), "batch");
        differs(with(&|o| o.side = 96), "side");
        differs(with(&|o| o.temperature = 0.5), "temperature");
        let photographs =
            ViewsRecipe { backgrounds: Some(folder.path().to_owned()), ..ViewsRecipe::default() };
        differs(photographs.clone(), "backgrounds");
        let before = of(&photographs);
        std::fs::write(folder.path().join("a.png"), b"two").unwrap();
        assert!(before.difference(&of(&photographs)).unwrap().starts_with("backgrounds was"));
        let command = "another".to_owned();
        assert_eq!(of(&ViewsRecipe { command, ..ViewsRecipe::default() }), of(&ViewsRecipe::default()));
    }

    #[test]
    fn options_out_of_range_are_named() {
        let named = |change: &dyn Fn(&mut ViewsTrainingOptions)| {
            let mut options = ViewsTrainingOptions::default();
            change(&mut options);
            options.check().unwrap_err().field
        };
        assert_eq!(ViewsTrainingOptions::default().check(), Ok(()));
        assert_eq!(named(&|o| o.side = 100), "side");
        assert_eq!(named(&|o| o.batch = 0), "batch");
        assert_eq!(named(&|o| o.temperature = f32::NAN), "temperature");
        assert_eq!(named(&|o| o.common.steps = 0), "steps");
    }
}
