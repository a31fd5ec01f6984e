//! Options common to all trainings: the optimiser's options, the pace, and the error for an option out of its range.

use serde::{Deserialize, Serialize};

use crate::lite0::ENCODER_STAGES;
use crate::schedule::LearningRate;

/// An option is out of its range.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: found {found}, expected {expected}")]
pub struct OptionError {
    /// Its name.
    pub field: &'static str,
    /// Its value.
    pub found: String,
    /// The values allowed.
    pub expected: &'static str,
}

impl OptionError {
    /// The error for an option out of its range.
    pub fn new(field: &'static str, found: impl ToString, expected: &'static str) -> Self {
        OptionError { field, found: found.to_string(), expected }
    }

    /// Returns this error unless `fits` is true.
    ///
    /// # Errors
    /// [`OptionError`].
    pub fn unless(
        fits: bool,
        field: &'static str,
        found: impl ToString,
        expected: &'static str,
    ) -> Result<(), OptionError> {
        if fits { Ok(()) } else { Err(OptionError::new(field, found, expected)) }
    }

    /// Returns this error unless `value` is a fraction, 0 to 1.
    ///
    /// # Errors
    /// [`OptionError`].
    pub fn unless_fraction(field: &'static str, value: impl Into<f64>) -> Result<(), OptionError> {
        let value = value.into();
        // Printed as f32, so that f32 values appear as given.
        OptionError::unless((0.0..=1.0).contains(&value), field, value as f32, "0 to 1")
    }

    /// Returns this error unless `value` is a valid number of steps of a training.
    ///
    /// # Errors
    /// [`OptionError`].
    pub fn unless_steps(value: u64) -> Result<(), OptionError> {
        OptionError::unless(value > 0, "steps", value, "1 or more")?;
        OptionError::unless(value <= MAX_STEPS, "steps", value, "at most 100000000")
    }

    /// Returns this error unless the number of samples per step is at least `minimum` and not more than fit into memory.
    ///
    /// # Errors
    /// [`OptionError`].
    pub fn unless_samples(
        field: &'static str,
        value: usize,
        minimum: usize,
        expected: &'static str,
    ) -> Result<(), OptionError> {
        OptionError::unless(value >= minimum, field, value, expected)?;
        OptionError::unless(value <= MAX_SAMPLES, field, value, "at most 1024")
    }

    /// Returns this error unless `value` is a valid number of frozen stages of the five-stage ImageNet encoder.
    ///
    /// # Errors
    /// [`OptionError`].
    pub fn unless_frozen_stages(value: usize) -> Result<(), OptionError> {
        OptionError::unless(value <= ENCODER_STAGES, "frozen_stages", value, "0 to 5")
    }

    /// Returns this error unless `value` is a valid weight of a loss: finite, 0 or more.
    ///
    /// # Errors
    /// [`OptionError`].
    pub fn unless_weight(field: &'static str, value: f64) -> Result<(), OptionError> {
        let fits = (0.0..=MAX_WEIGHT).contains(&value);
        OptionError::unless(fits, field, value, "a number from 0 to 1000000")
    }
}

/// Largest learning rate: with larger ones the first step gives NaN, after all samples were generated.
const MAX_RATE: f64 = 1000.0;
/// Largest weight of a part of a loss.
const MAX_WEIGHT: f64 = 1e6;
/// Largest number of steps of a training.
const MAX_STEPS: u64 = 100_000_000;
/// Largest number of samples per step: they are in memory at the same time.
const MAX_SAMPLES: usize = 1024;

/// Length, learning rate and regularisation of a training: AdamW (Loshchilov and Hutter 2019) with a cosine schedule. All fields
/// affect the result. Methods flatten them into their own options.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainingOptions {
    /// Optimiser steps, 1 or more.
    pub steps: u64,
    /// Maximum learning rate, above 0; it falls to zero as a cosine.
    pub learning_rate: f64,
    /// Initial steps over which the rate rises linearly. In a shorter training it rises until the last step.
    pub warm_up: u64,
    /// Decoupled weight decay, as a multiple of the learning rate, 0 or more.
    pub weight_decay: f32,
    /// Gradient-norm clip: a tensor's gradient of a larger Euclidean norm is scaled down to it. `None`: no clipping.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_grad_norm: Option<f32>,
    /// Seed of weights and samples.
    pub seed: u64,
}

impl TrainingOptions {
    /// Checks every number.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_steps(self.steps)?;
        let positive = |value: f64| value.is_finite() && value > 0.0;
        let above = "a finite number above 0";
        let fits = positive(self.learning_rate) && self.learning_rate <= MAX_RATE;
        let expected = "a number above 0, at most 1000";
        OptionError::unless(fits, "learning_rate", self.learning_rate, expected)?;
        OptionError::unless_weight("weight_decay", f64::from(self.weight_decay))?;
        let norm = self.max_grad_norm.unwrap_or(1.0);
        OptionError::unless(positive(f64::from(norm)), "max_grad_norm", norm, above)
    }

    /// The same with the values given by a user.
    pub fn with(self, steps: Option<u64>, learning_rate: Option<f64>, seed: u64) -> Self {
        TrainingOptions {
            steps: steps.unwrap_or(self.steps),
            learning_rate: learning_rate.unwrap_or(self.learning_rate),
            seed,
            ..self
        }
    }

    /// The schedule of the learning rate.
    pub fn schedule(&self) -> LearningRate {
        LearningRate::Cosine {
            rate: self.learning_rate,
            last: 0.0,
            warm_up: self.warm_up.min(self.steps.saturating_sub(1)),
            steps: self.steps,
        }
    }
}

/// How often a training is logged and saved, and the number of threads that generate its samples. It does not affect the result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pace {
    /// Steps between checkpoints, 1 or more.
    pub checkpoint_every: u64,
    /// Steps between records of the log, 1 or more.
    pub log_every: u64,
    /// Threads that generate batches, in addition to the training itself.
    pub sample_threads: usize,
}

impl Default for Pace {
    fn default() -> Self {
        Pace { checkpoint_every: 250, log_every: 25, sample_threads: 1 }
    }
}

impl Pace {
    /// Checks every number.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless(self.log_every > 0, "log_every", self.log_every, "1 or more")?;
        OptionError::unless(self.checkpoint_every > 0, "checkpoint_every", self.checkpoint_every, "1 or more")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_out_of_range_are_named() {
        let options = TrainingOptions {
            steps: 10,
            learning_rate: 1e-3,
            warm_up: 20,
            weight_decay: 1e-4,
            max_grad_norm: Some(5.0),
            seed: 0,
        };
        assert_eq!(options.check(), Ok(()));
        options.schedule().check().unwrap();
        let wrong = [
            (TrainingOptions { steps: 0, ..options.clone() }, "steps: found 0, expected 1 or more"),
            (
                TrainingOptions { steps: u64::MAX, ..options.clone() },
                "steps: found 18446744073709551615, expected at most",
            ),
            (TrainingOptions { learning_rate: f64::NAN, ..options.clone() }, "learning_rate: found NaN"),
            (TrainingOptions { learning_rate: 1e308, ..options.clone() }, "learning_rate: found 1000"),
            (TrainingOptions { weight_decay: -1.0, ..options.clone() }, "weight_decay: found -1"),
            (TrainingOptions { max_grad_norm: Some(0.0), ..options.clone() }, "max_grad_norm: found 0"),
        ];
        for (options, message) in wrong {
            let error = options.check().unwrap_err().to_string();
            assert!(error.starts_with(message), "{error}");
        }
        assert!(OptionError::unless_samples("pairs", 1024, 1, "1 or more").is_ok());
        let error = OptionError::unless_samples("pairs", 100_000, 1, "1 or more").unwrap_err().to_string();
        assert_eq!(error, "pairs: found 100000, expected at most 1024");
        assert!(OptionError::unless_frozen_stages(5).is_ok());
        let error = OptionError::unless_frozen_stages(6).unwrap_err().to_string();
        assert_eq!(error, "frozen_stages: found 6, expected 0 to 5");
        assert_eq!(Pace { log_every: 0, ..Pace::default() }.check().unwrap_err().field, "log_every");
    }

    #[test]
    fn gradients_that_are_not_clipped_are_not_mentioned() {
        let text = r#"{"steps":10,"learning_rate":0.001,"warm_up":2,"weight_decay":0.5,"seed":7}"#;
        let options: TrainingOptions = serde_json::from_str(text).unwrap();
        assert_eq!((options.max_grad_norm, options.seed), (None, 7));
        assert_eq!(serde_json::to_string(&options).unwrap(), text);
    }
}
