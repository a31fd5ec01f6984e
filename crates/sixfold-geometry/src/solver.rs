//! The 6x6 normal equations that ICP, PnP refinement and pose refinement share.
//!
//! One residual with Jacobian `j` (1x6, twist `(v, w)` as in [`Pose::exp`](crate::Pose::exp)) adds `j^T j` and `j^T r`; the
//! step solves `(H + lambda diag(H)) x = -g` (Levenberg 1944, Marquardt 1963).

use nalgebra::{Matrix6, Vector6};

/// Sums of `w j^T j`, `w j^T r` and `w r^2`.
#[derive(Debug, Clone, Copy)]
pub struct NormalEquations {
    /// Upper triangle of `H`, row by row.
    h: [f64; 21],
    g: [f64; 6],
    /// Weighted sum of squared residuals.
    pub cost: f64,
    /// How many residuals were added.
    pub count: usize,
}

impl Default for NormalEquations {
    fn default() -> Self {
        NormalEquations { h: [0.0; 21], g: [0.0; 6], cost: 0.0, count: 0 }
    }
}

impl NormalEquations {
    /// Adds one residual.
    #[inline]
    pub fn add(&mut self, jacobian: &[f64; 6], residual: f64, weight: f64) {
        let mut k = 0;
        for i in 0..6 {
            let wj = weight * jacobian[i];
            for &j in &jacobian[i..] {
                self.h[k] += wj * j;
                k += 1;
            }
            self.g[i] += wj * residual;
        }
        self.cost += weight * residual * residual;
        self.count += 1;
    }

    /// Adds another sum.
    pub fn merge(&mut self, other: &NormalEquations) {
        for (a, b) in self.h.iter_mut().zip(&other.h) {
            *a += b;
        }
        for (a, b) in self.g.iter_mut().zip(&other.g) {
            *a += b;
        }
        self.cost += other.cost;
        self.count += other.count;
    }

    /// `H` and `g`, for a larger system of which these six unknowns are a part.
    pub fn parts(&self) -> (Matrix6<f64>, Vector6<f64>) {
        let mut h = Matrix6::zeros();
        let mut k = 0;
        for i in 0..6 {
            for j in i..6 {
                h[(i, j)] = self.h[k];
                h[(j, i)] = self.h[k];
                k += 1;
            }
        }
        (h, Vector6::from(self.g))
    }

    /// The step that lowers the cost, damped by `lambda` (0 for Gauss-Newton); `None` when the residuals do not determine
    /// all six degrees of freedom.
    pub fn solve(&self, lambda: f64) -> Option<Vector6<f64>> {
        let (mut h, g) = self.parts();
        for i in 0..6 {
            h[(i, i)] += lambda * h[(i, i)] + 1e-12;
        }
        let step = h.cholesky()?.solve(&-g);
        step.iter().all(|v| v.is_finite()).then_some(step)
    }
}
