//! Complete trainings of both planners on the same trials, from a seed alone. They can be interrupted at any time and resumed.

use std::path::PathBuf;
use std::sync::Arc;

use serde::Serialize;
use sixfold_grasp::learned::{ClosingRegion, HafModel, HeightGrid, write_haf};
use sixfold_grasp::{Grasp, GraspView, Gripper};
use sixfold_io::write_atomically;
use sixfold_nn::device;
use sixfold_nn::fingerprint::Fingerprint;
use sixfold_nn::options::{OptionError, TrainingOptions};
use sixfold_nn::recipe::{Prepared, Recipe, Session, TrainingEvent};
use sixfold_nn::train_error::TrainError;
use sixfold_nn::weights::{ModelCard, WeightsError, write_card_markdown};

use crate::gpd_training::GpdTraining;
use crate::haf_training::{HafSamples, HafTraining};
use crate::model::GpdModel;
use crate::network::GpdConfig;
use crate::quality::{PlannerQuality, group_quality};
use crate::samples::{Sample, Samples, samples};
use crate::trials::{TrialSetOptions, complete};

/// Options of both trainings.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PlannerOptions {
    /// The trials.
    pub trials: TrialSetOptions,
    /// The file from which they are read or to which they are written; `None`: `trials.jsonl` next to the model.
    pub file: Option<PathBuf>,
    /// Number of steps; `None`: the planner's default.
    pub steps: Option<u64>,
    /// Seed of weights and of the order of samples.
    pub seed: u64,
    /// The command, for the model's card.
    pub command: String,
}

impl PlannerOptions {
    fn check(&self, steps: u64) -> Result<(), OptionError> {
        self.trials.check()?;
        OptionError::unless_steps(steps)
    }

    fn inputs(&self, planner: &str, steps: u64) -> Result<Fingerprint, TrainError> {
        #[derive(Serialize)]
        struct Inputs<'a> {
            planner: &'a str,
            trials: TrialSetOptions,
            steps: u64,
            seed: u64,
        }
        Fingerprint::of(&Inputs { planner, trials: self.trials, steps, seed: self.seed })
    }

    fn card(&self, title: &str) -> ModelCard {
        let mut card = ModelCard::new("", title);
        card.data = format!(
            "grasps of jaws-140 in {} simulated scenes of procedural families, tried in a physics engine in the hard setting; no scanned object and no photograph",
            self.trials.scenes
        );
        card.training_frames = Some(vec![]);
        card.extra = serde_json::json!({ "trials": self.trials });
        card
    }

    /// The trials, run if they are missing, as samples for a planner.
    fn samples<T: Send>(
        &self,
        see: impl Fn(&GraspView, &Gripper, &Grasp) -> T + Sync,
        session: &mut Session<'_>,
    ) -> Result<Option<Samples<T>>, TrainError> {
        let file = self.file.clone().unwrap_or_else(|| session.out.join("trials.jsonl"));
        session.note(&format!("trying grasps in {} scenes, kept in {}", self.trials.scenes, file.display()));
        let rows = complete(&file, &self.trials, &session.progress(TrainingEvent::Preparing));
        let Some(rows) = rows.map_err(TrainError::method)? else { return Ok(None) };
        session.note("computing what the planner sees of them");
        samples(&rows, &self.trials, see, &session.progress(TrainingEvent::Preparing))
            .map_err(TrainError::method)
    }
}

/// Trials that are not used in the training, for the measurement at the end.
struct HeldOut<T> {
    new_members: Vec<Sample<T>>,
    new_shapes: Vec<Sample<T>>,
}

impl<T> HeldOut<T> {
    /// The quality of a planner with these scores.
    fn quality(&self, scores: impl Fn(&[Sample<T>]) -> Vec<f64>) -> PlannerQuality {
        let of = |samples: &[Sample<T>]| {
            let scored: Vec<(f64, bool, u64)> =
                scores(samples).into_iter().zip(samples).map(|(v, s)| (v, s.held, s.scene)).collect();
            group_quality(&scored)
        };
        PlannerQuality { new_members: of(&self.new_members), new_shapes: of(&self.new_shapes) }
    }
}

fn with_quality(card: &mut ModelCard, quality: &PlannerQuality) {
    card.scores = quality.scores().into_iter().collect();
}

/// Options of the training of GPD's network.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct GpdRecipe {
    /// Options of both planners.
    pub common: PlannerOptions,
    /// Maximum learning rate; `None`: 0.001.
    pub learning_rate: Option<f64>,
}

/// Context of GPD's training: the held-out trials, once there are samples.
pub struct GpdContext {
    held_out: Option<HeldOut<ClosingRegion>>,
}

impl GpdRecipe {
    /// Training options of the network. Chosen by hand; not swept.
    pub fn options(&self) -> TrainingOptions {
        TrainingOptions {
            steps: 3000,
            learning_rate: 1e-3,
            warm_up: 100,
            weight_decay: 1e-2,
            max_grad_norm: None,
            seed: 0,
        }
        .with(self.common.steps, self.learning_rate, self.common.seed)
    }
}

impl Recipe for GpdRecipe {
    type Data = ();
    type Samples = Vec<Sample<ClosingRegion>>;
    type Training = GpdTraining;
    type Context = GpdContext;
    type Report = PlannerQuality;

    fn steps(&self) -> u64 {
        self.options().steps
    }

    fn seed(&self) -> u64 {
        self.common.seed
    }

    fn command(&self) -> &str {
        &self.common.command
    }

    fn check(&self) -> Result<(), OptionError> {
        self.common.check(self.steps())?;
        self.options().check()
    }

    fn inputs(&self, (): &()) -> Result<Fingerprint, TrainError> {
        let inputs = self.common.inputs("gpd", self.steps())?;
        Ok(inputs.with("learning_rate", self.options().learning_rate))
    }

    fn prepare(&self, _: (), _: &mut Session<'_>) -> Result<Prepared<GpdTraining, GpdContext>, TrainError> {
        let device = device::chosen().autodiff();
        let network = GpdConfig.init(self.common.seed, &device);
        let training = GpdTraining::new(network, self.options(), device);
        let mut card = self.common.card("GPD, success probability of a grasp");
        card.extra["training"] = serde_json::to_value(self.options()).map_err(TrainError::method)?;
        Ok(Prepared { training, card, context: GpdContext { held_out: None } })
    }

    fn samples(
        &self,
        context: &mut GpdContext,
        session: &mut Session<'_>,
    ) -> Result<Option<Self::Samples>, TrainError> {
        let Some(all) = self.common.samples(ClosingRegion::new, session)? else { return Ok(None) };
        let Samples { training, new_members, new_shapes } = all;
        context.held_out = Some(HeldOut { new_members, new_shapes });
        Ok(Some(training))
    }

    fn finish(
        &self,
        Prepared { training, mut card, mut context }: Prepared<GpdTraining, GpdContext>,
        session: &mut Session<'_>,
    ) -> Result<Option<PlannerQuality>, TrainError> {
        let network = training.into_network();
        let model = GpdModel::new(network.clone(), card.clone());
        model.save(&session.model())?;
        // In an export there are no samples yet.
        if context.held_out.is_none() && self.samples(&mut context, session)?.is_none() {
            return Ok(None);
        }
        let Some(held_out) = &context.held_out else { return Ok(None) };
        let regions = |samples: &[Sample<ClosingRegion>]| -> Vec<ClosingRegion> {
            samples.iter().map(|s| s.seen.clone()).collect()
        };
        let quality = held_out.quality(|samples| model.scores(&regions(samples)));
        with_quality(&mut card, &quality);
        GpdModel::new(network, card).save(&session.model())?;
        Ok(Some(quality))
    }
}

/// Options of the training of HAF's classifier: a step is a pass over all grasps.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct HafRecipe {
    /// Options of both planners.
    pub common: PlannerOptions,
}

/// Context of HAF's training: the samples and the held-out trials, once there are any.
#[derive(Default)]
pub struct HafContext {
    samples: Option<(Arc<HafSamples>, HeldOut<HeightGrid>)>,
}

impl HafRecipe {
    /// Default number of passes: after it the loss no longer changes in its third digit.
    pub const PASSES: u64 = 100;
    /// The model's file in the training's folder.
    pub const FILE: &str = "model.json";
}

impl Recipe for HafRecipe {
    type Data = ();
    type Samples = Arc<HafSamples>;
    type Training = HafTraining;
    type Context = HafContext;
    type Report = PlannerQuality;

    fn steps(&self) -> u64 {
        self.common.steps.unwrap_or(Self::PASSES)
    }

    fn seed(&self) -> u64 {
        self.common.seed
    }

    fn command(&self) -> &str {
        &self.common.command
    }

    fn model_file(&self) -> &'static str {
        Self::FILE
    }

    fn check(&self) -> Result<(), OptionError> {
        self.common.check(self.steps())
    }

    fn inputs(&self, (): &()) -> Result<Fingerprint, TrainError> {
        self.common.inputs("haf", self.steps())
    }

    fn prepare(&self, _: (), _: &mut Session<'_>) -> Result<Prepared<HafTraining, HafContext>, TrainError> {
        let training = HafTraining::new(self.steps(), self.common.seed);
        let mut card = self.common.card("HAF, success probability of a grasp");
        card.architecture = "haf-linear".to_owned();
        Ok(Prepared { training, card, context: HafContext::default() })
    }

    fn samples(
        &self,
        context: &mut HafContext,
        session: &mut Session<'_>,
    ) -> Result<Option<Arc<HafSamples>>, TrainError> {
        let see = |view: &GraspView, _: &Gripper, grasp: &Grasp| HeightGrid::new(view, grasp);
        let Some(all) = self.common.samples(see, session)? else { return Ok(None) };
        let Samples { training, new_members, new_shapes } = all;
        let samples = Arc::new(HafSamples::new(&training, self.common.seed));
        context.samples = Some((samples.clone(), HeldOut { new_members, new_shapes }));
        Ok(Some(samples))
    }

    fn finish(
        &self,
        Prepared { training, mut card, mut context }: Prepared<HafTraining, HafContext>,
        session: &mut Session<'_>,
    ) -> Result<Option<PlannerQuality>, TrainError> {
        // The classifier's features are selected from the trials: without them there is no model yet.
        if context.samples.is_none() && self.samples(&mut context, session)?.is_none() {
            return Ok(None);
        }
        let Some((samples, held_out)) = &context.samples else { return Ok(None) };
        let model = |card: &ModelCard| -> Result<HafModel, TrainError> {
            let card = serde_json::to_value(card).map_err(TrainError::method)?;
            Ok(samples.model(&training.weights, card))
        };
        let untested = model(&card)?;
        let scores = |samples: &[Sample<HeightGrid>]| -> Vec<f64> {
            samples.iter().map(|s| untested.score(&s.seen)).collect()
        };
        let quality = held_out.quality(scores);
        with_quality(&mut card, &quality);
        let file = session.out.join(Self::FILE);
        let text = write_haf(&model(&card)?).map_err(TrainError::method)?;
        write_atomically(&file, text.as_bytes())
            .map_err(|source| WeightsError::Write { file: file.clone(), source })?;
        write_card_markdown(&card, &file.with_extension("md"))?;
        Ok(Some(quality))
    }
}
