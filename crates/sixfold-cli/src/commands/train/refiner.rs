//! `sixfold train refiner`: trains a network that refines poses; the inputs are a seed and, preferably, photographs for
//! textures.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use sixfold_views::refiner::recipe::RefinerRecipe;

use super::options::ResultArguments;
use super::{Shown, Summary, checked, command_line, loss, summary, train_in};

fn default() -> RefinerRecipe {
    RefinerRecipe::default()
}

#[derive(Debug, Args)]
pub(crate) struct TrainRefinerArguments {
    /// Folder of photographs (PNG, JPEG) for textures, backgrounds and occluders (default: procedural textures only)
    #[arg(long, value_name = "DIR")]
    pub backgrounds: Option<PathBuf>,
    /// Training steps
    #[arg(long, value_name = "N", default_value_t = default().options.common.steps)]
    pub steps: u64,
    /// Maximum learning rate
    #[arg(long, value_name = "RATE", default_value_t = default().options.common.learning_rate)]
    pub learning_rate: f64,
    /// Continue from the weights of another training (default: random weights)
    #[arg(long, value_name = "FILE.safetensors")]
    pub init: Option<PathBuf>,
    /// Objects in a step, with four poses each
    #[arg(long, value_name = "N", default_value_t = default().options.batch)]
    pub batch: usize,
    /// Side of the crops around detections, pixels, a multiple of 32
    #[arg(long, value_name = "PIXELS", default_value_t = default().options.side)]
    pub side: usize,
    /// Side of the crops around poses, pixels, a multiple of 32
    #[arg(long, value_name = "PIXELS", default_value_t = default().options.close_side)]
    pub close_side: usize,
    /// Seed of the samples
    #[arg(long, default_value_t = default().options.common.seed)]
    pub seed: u64,
    #[command(flatten)]
    pub result: ResultArguments,
}

impl TrainRefinerArguments {
    pub(super) fn recipe(&self) -> RefinerRecipe {
        let mut options = default().options;
        options.common.steps = self.steps;
        options.common.learning_rate = self.learning_rate;
        options.common.seed = self.seed;
        options.batch = self.batch;
        options.side = self.side;
        options.close_side = self.close_side;
        RefinerRecipe {
            backgrounds: self.backgrounds.clone(),
            options,
            init: self.init.clone(),
            command: command_line(),
        }
    }
}

/// Trains, or resumes a training, and writes the model.
pub(super) fn train_refiner(a: &TrainRefinerArguments) -> Result<Summary<()>> {
    let recipe = checked(a.recipe())?;
    let shown = Shown {
        preparing: "samples",
        measuring: "model measured",
        message: |record| {
            format!(
                "error {:.3} cells, displacement {:.3}, near {:.3}, here {:.3}, {:.1} objects/s",
                loss(record, "error"),
                loss(record, "displacement"),
                loss(record, "near"),
                loss(record, "here"),
                record.samples_per_second
            )
        },
    };
    Ok(summary(train_in(&recipe, (), &a.result.out, a.result.export, shown)?, |()| ()))
}
