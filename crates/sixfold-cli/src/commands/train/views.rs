//! `sixfold train views`: trains a network that matches rendered views; the inputs are a seed and, preferably, photographs for
//! textures.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use sixfold_views::recipe::ViewsRecipe;

use super::options::ResultArguments;
use super::{Shown, Summary, checked, command_line, loss, summary, train_in};

fn default() -> ViewsRecipe {
    ViewsRecipe::default()
}

#[derive(Debug, Args)]
pub(crate) struct TrainViewsArguments {
    /// Folder of photographs (PNG, JPEG) for textures, backgrounds and occluders (default: procedural textures only)
    #[arg(long, value_name = "DIR")]
    pub backgrounds: Option<PathBuf>,
    /// Training steps
    #[arg(long, value_name = "N", default_value_t = default().options.common.steps)]
    pub steps: u64,
    /// Maximum learning rate
    #[arg(long, value_name = "RATE", default_value_t = default().options.common.learning_rate)]
    pub learning_rate: f64,
    /// Objects in a step
    #[arg(long, value_name = "N", default_value_t = default().options.batch)]
    pub batch: usize,
    /// Seed of the samples
    #[arg(long, default_value_t = default().options.common.seed)]
    pub seed: u64,
    #[command(flatten)]
    pub result: ResultArguments,
}

impl TrainViewsArguments {
    pub(super) fn recipe(&self) -> ViewsRecipe {
        let mut options = default().options;
        options.common.steps = self.steps;
        options.common.learning_rate = self.learning_rate;
        options.common.seed = self.seed;
        options.batch = self.batch;
        ViewsRecipe { backgrounds: self.backgrounds.clone(), options, command: command_line() }
    }
}

/// Trains, or resumes a training, and writes the model.
pub(super) fn train_views(a: &TrainViewsArguments) -> Result<Summary<()>> {
    let recipe = checked(a.recipe())?;
    let shown = Shown {
        preparing: "samples",
        measuring: "model measured",
        message: |record| {
            format!(
                "right cells {:.0} %, photograph {:.3}, templates {:.3}, {:.1} objects/s",
                100.0 * loss(record, "accuracy"),
                loss(record, "photograph"),
                loss(record, "templates"),
                record.samples_per_second
            )
        },
    };
    Ok(summary(train_in(&recipe, (), &a.result.out, a.result.export, shown)?, |()| ()))
}
