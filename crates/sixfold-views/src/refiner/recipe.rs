//! The complete training of the refiner for the features of the shipped network, from a seed alone (better: with photographs for
//! textures and backgrounds). It can be interrupted at any time and resumed.

use std::path::PathBuf;

use sixfold_data::background_files;
use sixfold_nn::device;
use sixfold_nn::fingerprint::Fingerprint;
use sixfold_nn::options::OptionError;
use sixfold_nn::recipe::{Prepared, Recipe, Session, continued_from};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::weights::{ModelCard, save_weights, write_card_markdown};
use sixfold_synth::augment::Backgrounds;

use super::network::{ARCHITECTURE, RefinerNetwork};
use super::training::{RefinerTraining, RefinerTrainingOptions, Source};
use crate::features::Extractor;
use crate::network::shipped_hash;
use crate::recipe::{described, textures};

/// Options of the training.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RefinerRecipe {
    /// Folder of photographs for textures, backgrounds and occluders; procedural textures only if `None`.
    pub backgrounds: Option<PathBuf>,
    /// Steps, learning rate, seed, crops.
    pub options: RefinerTrainingOptions,
    /// Weights of another training to continue from; random ones if `None`.
    pub init: Option<PathBuf>,
    /// The command, for the model's card.
    pub command: String,
}

impl Recipe for RefinerRecipe {
    type Data = ();
    type Samples = Source;
    type Training = RefinerTraining;
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
        let RefinerRecipe { backgrounds, options, init, command: _ } = self;
        let backgrounds =
            background_files(backgrounds.as_deref()).map_err(TrainError::about("backgrounds"))?;
        let features = format!("{:016x}", shipped_hash());
        Fingerprint::of(options)?
            .with("features", features)
            .with_files("backgrounds", &backgrounds)?
            .with_file("init", init.as_deref())
    }

    fn prepare(
        &self,
        (): (),
        _: &mut Session<'_>,
    ) -> Result<Prepared<RefinerTraining, Backgrounds>, TrainError> {
        let device = device::chosen().autodiff();
        let network = match &self.init {
            Some(path) => RefinerNetwork::load(path, &device)?.0,
            None => RefinerNetwork::random(self.seed(), &device),
        };
        let textures = textures(self.backgrounds.as_deref())?;
        let mut card = ModelCard::new(ARCHITECTURE, "Refiner of poses of known objects in colour images");
        card.data = format!("{}; features: those of the views within the program", described(&textures));
        let options = self.options.clone();
        card.extra = serde_json::json!({ "training": options, "continued_from": continued_from(self.init.as_deref())? });
        Ok(Prepared { training: RefinerTraining::new(network, options, device), card, context: textures })
    }

    fn samples(&self, textures: &mut Backgrounds, _: &mut Session<'_>) -> Result<Option<Source>, TrainError> {
        let extractor = Extractor::shipped().map_err(TrainError::about("views"))?;
        Ok(Some(Source { textures: textures.clone(), extractor }))
    }

    fn finish(
        &self,
        Prepared { training, card, .. }: Prepared<RefinerTraining, Backgrounds>,
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
        let of = |recipe: &RefinerRecipe| recipe.inputs(&()).unwrap();
        let differs = |recipe: RefinerRecipe, name: &str| {
            let difference = of(&RefinerRecipe::default()).difference(&of(&recipe)).unwrap();
            assert!(difference.contains(&format!("{name} was")), "{difference}");
        };
        let with = |change: &dyn Fn(&mut RefinerTrainingOptions)| {
            let mut recipe = RefinerRecipe::default();
            change(&mut recipe.options);
            recipe
        };
        differs(with(&|o| o.common.steps = 3), "steps");
        differs(with(&|o| o.common.learning_rate = 0.5), "learning_rate");
        differs(with(&|o| o.common.seed = 3), "seed");
        differs(with(&|o| o.batch = 3), "batch");
        differs(with(&|o| o.side = 96), "side");
        differs(with(&|o| o.close_side = 96), "close_side");
        let photographs =
            RefinerRecipe { backgrounds: Some(folder.path().to_owned()), ..RefinerRecipe::default() };
        differs(photographs.clone(), "backgrounds");
        let before = of(&photographs);
        std::fs::write(folder.path().join("a.png"), b"two").unwrap();
        assert!(before.difference(&of(&photographs)).unwrap().starts_with("backgrounds was"));
        let file = folder.path().join("a.png");
        differs(RefinerRecipe { init: Some(file), ..RefinerRecipe::default() }, "init");
        let command = "another".to_owned();
        assert_eq!(of(&RefinerRecipe { command, ..RefinerRecipe::default() }), of(&RefinerRecipe::default()));
    }

    #[test]
    fn options_out_of_range_are_named() {
        let named = |change: &dyn Fn(&mut RefinerTrainingOptions)| {
            let mut options = RefinerTrainingOptions::default();
            change(&mut options);
            options.check().unwrap_err().field
        };
        assert_eq!(RefinerTrainingOptions::default().check(), Ok(()));
        assert_eq!(named(&|o| o.side = 100), "side");
        assert_eq!(named(&|o| o.close_side = 100), "close_side");
        assert_eq!(named(&|o| o.batch = 0), "batch");
        assert_eq!(named(&|o| o.common.steps = 0), "steps");
    }
}
