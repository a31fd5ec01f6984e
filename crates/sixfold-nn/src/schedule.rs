//! Schedules of the learning rate.

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

use crate::options::OptionError;

/// Learning rate as a function of the step. Steps count from 0.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum LearningRate {
    /// The same rate at every step.
    Constant {
        /// The rate, above 0.
        rate: f64,
    },
    /// The rate is multiplied by `factor` at each of the given steps.
    StepDecay {
        /// Rate before the first decay, above 0.
        rate: f64,
        /// Factor on the rate, above 0 and at most 1.
        factor: f64,
        /// Steps at which the rate is reduced, in rising order.
        at: Vec<u64>,
    },
    /// A linear rise to `rate` over `warm_up` steps, then half a cosine down to `last` at step `steps` (Loshchilov and Hutter 2017,
    /// without restarts).
    Cosine {
        /// Highest rate, above 0.
        rate: f64,
        /// Rate at and after step `steps`, 0 or more.
        last: f64,
        /// Steps of the rise; 0 for none.
        warm_up: u64,
        /// Length of the training in steps, including the rise.
        steps: u64,
    },
}

impl LearningRate {
    /// Checks every number.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        let positive = |field, value: f64| {
            let fits = value.is_finite() && value > 0.0;
            OptionError::unless(fits, field, value, "a finite number above 0")
        };
        match self {
            LearningRate::Constant { rate } => positive("rate", *rate),
            LearningRate::StepDecay { rate, factor, at } => {
                positive("rate", *rate)?;
                OptionError::unless(
                    *factor > 0.0 && *factor <= 1.0,
                    "factor",
                    factor,
                    "above 0 and at most 1",
                )?;
                let rising = at.windows(2).all(|w| w[0] < w[1]);
                OptionError::unless(rising, "at", format!("{at:?}"), "steps in rising order")
            }
            LearningRate::Cosine { rate, last, warm_up, steps } => {
                positive("rate", *rate)?;
                OptionError::unless(*last >= 0.0 && last <= rate, "last", last, "between 0 and rate")?;
                OptionError::unless(warm_up < steps, "warm_up", warm_up, "less than steps")
            }
        }
    }

    /// The rate of step `step`.
    pub fn at(&self, step: u64) -> f64 {
        match self {
            LearningRate::Constant { rate } => *rate,
            LearningRate::StepDecay { rate, factor, at } => {
                at.iter().filter(|s| **s <= step).fold(*rate, |rate, _| rate * factor)
            }
            LearningRate::Cosine { rate, last, warm_up, steps } => {
                if step < *warm_up {
                    return rate * (step + 1) as f64 / *warm_up as f64;
                }
                let length = steps.saturating_sub(*warm_up).max(1);
                let done = ((step - warm_up) as f64 / length as f64).min(1.0);
                last + (rate - last) * 0.5 * (1.0 + (PI * done).cos())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn constant_stays() {
        let schedule = LearningRate::Constant { rate: 1e-4 };
        assert_eq!((schedule.at(0), schedule.at(1_000_000)), (1e-4, 1e-4));
    }

    #[test]
    fn steps_decay_from_their_step_on() {
        let schedule = LearningRate::StepDecay { rate: 1.0, factor: 0.1, at: vec![10, 20] };
        assert_eq!((schedule.at(9), schedule.at(10), schedule.at(19)), (1.0, 0.1, 0.1));
        assert!((schedule.at(20) - 0.01).abs() < 1e-12);
    }

    #[test]
    fn cosine_rises_and_falls() {
        let schedule = LearningRate::Cosine { rate: 1.0, last: 0.1, warm_up: 4, steps: 104 };
        assert_eq!((schedule.at(0), schedule.at(3), schedule.at(4)), (0.25, 1.0, 1.0));
        assert!((schedule.at(54) - 0.55).abs() < 1e-12, "half way lies in the middle");
        assert!((schedule.at(104) - 0.1).abs() < 1e-12 && (schedule.at(1000) - 0.1).abs() < 1e-12);
    }

    #[test]
    fn wrong_numbers_are_named() {
        let error = LearningRate::Constant { rate: -1.0 }.check().unwrap_err();
        assert_eq!(error.to_string(), "rate: found -1, expected a finite number above 0");
        let schedule = LearningRate::StepDecay { rate: 1.0, factor: 0.5, at: vec![20, 10] };
        assert_eq!(schedule.check().unwrap_err().field, "at");
        let schedule = LearningRate::Cosine { rate: 1.0, last: 0.0, warm_up: 5, steps: 5 };
        assert_eq!(schedule.check().unwrap_err().field, "warm_up");
        assert!(LearningRate::Constant { rate: f64::NAN }.check().is_err());
    }

    #[test]
    fn written_and_read_again() {
        let schedule = LearningRate::Cosine { rate: 1e-3, last: 0.0, warm_up: 5, steps: 50 };
        let text = serde_json::to_string(&schedule).unwrap();
        assert!(text.contains("\"kind\":\"cosine\""));
        assert_eq!(serde_json::from_str::<LearningRate>(&text).unwrap(), schedule);
    }
}
