//! Logistic regression with a normal prior about zero (Cox 1958; the most probable weights by Newton's method), and its
//! calibration.

use serde::{Deserialize, Serialize};
use sixfold_geometry::nalgebra::{DMatrix, DVector};

use crate::numbers::{Numbers, SPEAKS_FOR};

/// Inverse variance of the prior on the weights of standardised numbers, per row of the fit; chosen by hand, not swept.
const PRECISION: f64 = 2.0;
/// Maximum number of steps of Newton's method.
const STEPS: usize = 50;

/// A model that computes a probability from numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LogisticModel {
    /// Which numbers it uses, by their index in [`crate::NAMES`].
    pub takes: Vec<usize>,
    /// Their means, which replace unknown values.
    pub means: Vec<f64>,
    /// Their standard deviations.
    pub deviations: Vec<f64>,
    /// Weights of the standardised numbers.
    pub weights: Vec<f64>,
    /// The constant.
    pub constant: f64,
    /// Factor and offset applied to the sum, so that the probabilities of reported poses are calibrated (Platt 1999).
    pub scaling: [f64; 2],
}

/// One row of a fit.
#[derive(Debug, Clone, Copy)]
pub struct Fit<'a> {
    /// The numbers of a pose.
    pub numbers: &'a Numbers,
    /// Whether it is right.
    pub right: bool,
}

pub(crate) fn sigmoid(z: f64) -> f64 {
    1.0 / (1.0 + (-z).exp())
}

impl LogisticModel {
    /// The log odds before [`LogisticModel::scaling`].
    pub fn raw(&self, numbers: &Numbers) -> f64 {
        let standard =
            |k: usize| numbers[self.takes[k]].map_or(0.0, |v| (v - self.means[k]) / self.deviations[k]);
        (0..self.takes.len()).map(|k| self.weights[k] * standard(k)).sum::<f64>() + self.constant
    }

    /// The probability that the pose is right.
    pub fn probability(&self, numbers: &Numbers) -> f64 {
        sigmoid(self.scaling[0] * self.raw(numbers) + self.scaling[1])
    }

    /// Whether the lengths are consistent and all numbers are finite.
    pub(crate) fn is_whole(&self) -> bool {
        let n = self.takes.len();
        let all = [&self.means, &self.deviations, &self.weights];
        all.iter().all(|v| v.len() == n && v.iter().all(|x| x.is_finite()))
            && self.takes.iter().all(|k| *k < crate::NAMES.len())
            && self.deviations.iter().all(|d| *d > 0.0)
            && self.constant.is_finite()
            && self.scaling.iter().all(|s| s.is_finite())
    }

    /// The same model with the scaling that calibrates the probabilities of `rows` best.
    #[must_use]
    pub(crate) fn scaled_to(self, rows: &[Fit<'_>]) -> LogisticModel {
        let z: Vec<[f64; 2]> = rows.iter().map(|r| [self.raw(r.numbers), 1.0]).collect();
        let right: Vec<bool> = rows.iter().map(|r| r.right).collect();
        // The prior is centred on a scaling of one, so that few rows change little.
        let weights = newton(&z, &right, &[1.0, 0.0], &[1.0, 0.01]);
        let scaling = if weights[0] > 0.0 { [weights[0], weights[1]] } else { [1.0, 0.0] };
        LogisticModel { scaling, ..self }
    }
}

/// The most probable model of some rows; `takes` lists the numbers it may use. Numbers whose weight would have the wrong sign are
/// removed one by one, the worst first. All rows have the same weight; the same rows in the same order give the same model.
pub fn fit(rows: &[Fit<'_>], takes: &[usize]) -> LogisticModel {
    // Numbers that are equal in all rows carry no information.
    let varies = |k: &usize| {
        let mut known = rows.iter().filter_map(|r| r.numbers[*k]);
        let first = known.next();
        known.any(|v| Some(v) != first)
    };
    let mut takes: Vec<usize> = takes.iter().copied().filter(varies).collect();
    loop {
        let model = fit_all(rows, &takes);
        let wrong = |k: &usize| if SPEAKS_FOR[takes[*k]] { -model.weights[*k] } else { model.weights[*k] };
        let worst = (0..takes.len()).max_by(|a, b| wrong(a).total_cmp(&wrong(b)));
        match worst.filter(|k| wrong(k) > 0.0) {
            Some(worst) => takes.remove(worst),
            None => return model,
        };
    }
}

/// The same, using all of `takes`.
fn fit_all(rows: &[Fit<'_>], takes: &[usize]) -> LogisticModel {
    let known = |k: usize| rows.iter().filter_map(move |r| r.numbers[k]);
    let mean = |k: usize| known(k).sum::<f64>() / known(k).count().max(1) as f64;
    let means: Vec<f64> = takes.iter().map(|&k| mean(k)).collect();
    let deviation = |(&k, m): (&usize, &f64)| {
        let square = known(k).map(|v| (v - m).powi(2)).sum::<f64>() / known(k).count().max(1) as f64;
        square.sqrt().max(1e-6)
    };
    let deviations: Vec<f64> = takes.iter().zip(&means).map(deviation).collect();
    let standard = |r: &Fit<'_>| -> Vec<f64> {
        let value = |(i, &k): (usize, &usize)| r.numbers[k].map_or(0.0, |v| (v - means[i]) / deviations[i]);
        takes.iter().enumerate().map(value).chain([1.0]).collect()
    };
    let inputs: Vec<Vec<f64>> = rows.iter().map(standard).collect();
    let right: Vec<bool> = rows.iter().map(|r| r.right).collect();
    let mut precision = vec![PRECISION; takes.len()];
    precision.push(1e-3);
    let mut weights = newton(&inputs, &right, &vec![0.0; takes.len() + 1], &precision);
    let constant = weights.pop().unwrap_or(0.0);
    LogisticModel { takes: takes.to_vec(), means, deviations, weights, constant, scaling: [1.0, 0.0] }
}

/// The weights that make `right` most probable, under a normal prior with mean `prior`.
fn newton<R: AsRef<[f64]>>(inputs: &[R], right: &[bool], prior: &[f64], precision: &[f64]) -> Vec<f64> {
    let rows: Vec<DVector<f64>> = inputs.iter().map(|r| DVector::from_row_slice(r.as_ref())).collect();
    let prior = DVector::from_row_slice(prior);
    let precision = DMatrix::from_diagonal(&DVector::from_row_slice(precision));
    let loss = |w: &DVector<f64>| {
        let of = |(x, right): (&DVector<f64>, &bool)| {
            let z = if *right { -w.dot(x) } else { w.dot(x) };
            z.max(0.0) + (-z.abs()).exp().ln_1p()
        };
        let off = w - &prior;
        rows.iter().zip(right).map(of).sum::<f64>() + 0.5 * off.dot(&(&precision * &off))
    };
    let mut weights = prior.clone();
    let mut value = loss(&weights);
    for _ in 0..STEPS {
        let mut gradient = &precision * (&weights - &prior);
        let mut curvature = precision.clone();
        for (x, right) in rows.iter().zip(right) {
            let p = sigmoid(weights.dot(x));
            gradient.axpy(p - f64::from(u8::from(*right)), x, 1.0);
            curvature.ger(p * (1.0 - p), x, x, 1.0);
        }
        let Some(step) = curvature.cholesky().map(|c| c.solve(&gradient)) else { break };
        // Newton's step may be too long where the sigmoid is flat.
        let mut length = 1.0;
        let mut next = &weights - &step;
        while loss(&next) > value && length > 1e-6 {
            length *= 0.5;
            next = &weights - &step * length;
        }
        let reached = loss(&next);
        if !(reached < value) {
            break;
        }
        let gained = value - reached;
        (weights, value) = (next, reached);
        if gained < 1e-9 {
            break;
        }
    }
    weights.iter().copied().collect()
}

#[cfg(test)]
mod tests {
    use rand::RngExt;
    use sixfold_geometry::random::stream;

    use super::*;

    /// Rows whose outcome is sampled with log odds of `2 x - 1`, where x is number 3.
    fn drawn(count: usize, seed: u64) -> Vec<(Numbers, bool)> {
        let mut random = stream(seed, 0);
        (0..count)
            .map(|_| {
                let x: f64 = random.random_range(-2.0..2.0);
                let mut numbers: Numbers = [None; crate::NAMES.len()];
                numbers[3] = Some(x);
                numbers[5] = Some(random.random_range(-1.0..1.0));
                (numbers, random.random_bool(sigmoid(2.0 * x - 1.0)))
            })
            .collect()
    }

    fn rows(of: &[(Numbers, bool)]) -> Vec<Fit<'_>> {
        of.iter().map(|(numbers, right)| Fit { numbers, right: *right }).collect()
    }

    #[test]
    fn it_recovers_the_probabilities_of_sampled_outcomes() {
        let (known, new) = (drawn(4000, 1), drawn(2000, 2));
        let model = fit(&rows(&known), &[3, 5]).scaled_to(&rows(&known));
        assert!(model.is_whole());
        for (numbers, _) in &new {
            let x = numbers[3].unwrap();
            let (found, drawn) = (model.probability(numbers), sigmoid(2.0 * x - 1.0));
            assert!((found - drawn).abs() < 0.05, "{x}: {found} instead of {drawn}");
        }
        // Unknown values count as the mean.
        let unknown = model.probability(&[None; crate::NAMES.len()]);
        let mut mean: Numbers = [None; crate::NAMES.len()];
        for (k, value) in model.takes.iter().zip(&model.means) {
            mean[*k] = Some(*value);
        }
        assert_eq!(unknown, model.probability(&mean));
    }

    #[test]
    fn features_with_the_wrong_sign_are_left_out() {
        // A larger number 3 makes a pose more probable; if the rows show the opposite, it is not used.
        let negated: Vec<(Numbers, bool)> =
            drawn(2000, 5).into_iter().map(|(n, right)| (n, !right)).collect();
        let model = fit(&rows(&negated), &[3, 5]);
        assert!(!model.takes.contains(&3), "{model:?}");
        assert!(model.is_whole());
    }

    #[test]
    fn scaling_makes_up_for_rows_that_were_chosen() {
        // If half as many of the reported poses are right as of all, the probabilities decrease accordingly.
        let known = drawn(4000, 3);
        let model = fit(&rows(&known), &[3, 5]);
        let mut random = stream(4, 0);
        let chosen: Vec<(Numbers, bool)> =
            known.iter().map(|(n, right)| (*n, *right && random.random_bool(0.5))).collect();
        let scaled = model.clone().scaled_to(&rows(&chosen));
        let mean = |m: &LogisticModel| {
            chosen.iter().map(|(n, _)| m.probability(n)).sum::<f64>() / chosen.len() as f64
        };
        let right = chosen.iter().filter(|(_, right)| *right).count() as f64 / chosen.len() as f64;
        assert!((mean(&scaled) - right).abs() < 0.02, "{} {right}", mean(&scaled));
        assert!(mean(&model) > right + 0.05);
    }
}
