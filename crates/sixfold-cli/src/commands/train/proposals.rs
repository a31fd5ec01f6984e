//! `sixfold train proposals`: trains a detector of any object; the inputs are a seed and, preferably, photographs for
//! textures.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use sixfold_detect::proposals::ProposalsRecipe;

use super::options::ResultArguments;
use super::{Shown, Summary, checked, command_line, loss, summary, train_in};

fn default() -> ProposalsRecipe {
    ProposalsRecipe::default()
}

#[derive(Debug, Args)]
pub(crate) struct TrainProposalsArguments {
    /// Folder of photographs (PNG, JPEG) for textures and backgrounds (default: procedural textures only)
    #[arg(long, value_name = "DIR")]
    pub backgrounds: Option<PathBuf>,
    /// Training steps
    #[arg(long, value_name = "N", default_value_t = default().options.common.steps)]
    pub steps: u64,
    /// Maximum learning rate
    #[arg(long, value_name = "RATE", default_value_t = default().options.common.learning_rate)]
    pub learning_rate: f64,
    /// Images in a step
    #[arg(long, value_name = "N", default_value_t = default().options.batch)]
    pub batch: usize,
    /// Number of synthetic objects to train on
    #[arg(long, value_name = "N", default_value_t = default().objects)]
    pub objects: usize,
    /// Side of the training images in pixels, a multiple of 32
    #[arg(long, value_name = "PIXELS", default_value_t = default().size)]
    pub size: usize,
    /// Seed of objects, weights and samples
    #[arg(long, default_value_t = default().options.common.seed)]
    pub seed: u64,
    #[command(flatten)]
    pub result: ResultArguments,
}

impl TrainProposalsArguments {
    pub(super) fn recipe(&self) -> ProposalsRecipe {
        let mut options = default().options;
        options.common.steps = self.steps;
        options.common.learning_rate = self.learning_rate;
        options.common.seed = self.seed;
        options.batch = self.batch;
        ProposalsRecipe {
            options,
            objects: self.objects,
            size: self.size,
            backgrounds: self.backgrounds.clone(),
            command: command_line(),
        }
    }
}

/// Trains, or resumes a training, and writes the model.
pub(super) fn train_proposals(a: &TrainProposalsArguments) -> Result<Summary<()>> {
    let recipe = checked(a.recipe())?;
    let shown = Shown {
        preparing: "objects",
        measuring: "model measured",
        message: |record| {
            format!(
                "scores {:.3}, boxes {:.3}, masks {:.3}, {:.1} images/s",
                loss(record, "scores"),
                loss(record, "boxes"),
                loss(record, "masks"),
                record.samples_per_second
            )
        },
    };
    Ok(summary(train_in(&recipe, (), &a.result.out, a.result.export, shown)?, |()| ()))
}
