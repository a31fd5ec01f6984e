//! Confidence intervals of success rates.

/// The 95 % confidence interval of a success rate (Wilson 1927, "Probable inference, the law of succession, and statistical
/// inference"); 0 to 1 without trials.
pub fn wilson_interval(successes: usize, trials: usize) -> (f64, f64) {
    wilson_interval_of_fraction(successes as f64 / trials.max(1) as f64, trials)
}

/// The same for a mean success rate in which each trial was repeated several times: as wide as if each trial had run once, which is
/// never too narrow.
pub fn wilson_interval_of_fraction(fraction: f64, trials: usize) -> (f64, f64) {
    const Z: f64 = 1.959_963_984_540_054;
    if trials == 0 {
        return (0.0, 1.0);
    }
    let n = trials as f64;
    let p = fraction;
    let centre = (p + Z * Z / (2.0 * n)) / (1.0 + Z * Z / n);
    let half = Z / (1.0 + Z * Z / n) * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
    ((centre - half).max(0.0), (centre + half).min(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_intervals() {
        // Newcombe 1998, table I: 81 of 263 gives 0.2553 to 0.3662; 0 of 20 gives 0 to 0.1611.
        let (low, high) = wilson_interval(81, 263);
        assert!((low - 0.2553).abs() < 1e-4 && (high - 0.3662).abs() < 1e-4, "{low} {high}");
        let (low, high) = wilson_interval(0, 20);
        assert!(low == 0.0 && (high - 0.1611).abs() < 1e-4, "{low} {high}");
        assert_eq!(wilson_interval(0, 0), (0.0, 1.0));
        // Five trials, one of which held in half of its repetitions.
        let (low, high) = wilson_interval_of_fraction(0.9, 5);
        assert!(low > wilson_interval(4, 5).0 && high < wilson_interval(5, 5).1, "{low} {high}");
    }
}
