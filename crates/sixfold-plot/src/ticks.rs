//! Round numbers for an axis.

/// Positions and labels of the marks of an axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Ticks {
    /// Value at the start of the axis.
    pub low: f64,
    /// Value at the end of the axis.
    pub high: f64,
    /// Value and label of every mark, in rising order.
    pub marks: Vec<(f64, String)>,
}

/// Marks at round distances (1, 2 or 5 times a power of ten) for values from `low` to `high`, about five of them.
pub fn ticks(low: f64, high: f64) -> Ticks {
    let (low, high) = if low.is_finite() && high.is_finite() { (low, high) } else { (0.0, 1.0) };
    let (low, high) = if high - low > 1e-12 * high.abs().max(low.abs()) { (low, high) } else { around(low) };
    let rough = (high - low) / 5.0;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|f| f * power).into_iter().find(|s| *s >= rough).unwrap_or(rough);
    let (first, last) = ((low / step).floor(), (high / step).ceil());
    let decimals = (-step.log10().floor()).max(0.0) as usize;
    let marks = (0..=(last - first) as usize)
        .map(|i| {
            let value = (first + i as f64) * step;
            (value, label(value, decimals))
        })
        .collect();
    Ticks { low: first * step, high: last * step, marks }
}

/// Marks at the powers of ten that enclose `low` to `high`, both positive.
pub fn ticks_logarithmic(low: f64, high: f64) -> Ticks {
    let (low, high) = if low > 0.0 && high >= low && high.is_finite() { (low, high) } else { (0.1, 1.0) };
    let (first, last) = (low.log10().floor() as i32, high.log10().ceil() as i32);
    let last = last.max(first + 1);
    let stride = ((last - first) / 8 + 1).max(1);
    let marks = (first..=last).step_by(stride as usize).map(|e| (10f64.powi(e), format!("1e{e}"))).collect();
    Ticks { low: 10f64.powi(first), high: 10f64.powi(last), marks }
}

fn around(value: f64) -> (f64, f64) {
    let half = (0.1 * value.abs()).max(1e-6);
    (value - half, value + half)
}

fn label(value: f64, decimals: usize) -> String {
    match value.abs() {
        v if v >= 1e6 => format!("{value:.1e}"),
        v if v > 0.0 && decimals > 4 => format!("{value:.1e}"),
        _ => format!("{value:.decimals$}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_enclose_the_values() {
        let t = ticks(0.13, 9.2);
        assert_eq!((t.low, t.high), (0.0, 10.0));
        assert_eq!(t.marks.iter().map(|m| m.1.as_str()).collect::<Vec<_>>(), ["0", "2", "4", "6", "8", "10"]);
        let t = ticks_logarithmic(0.013, 3.0);
        assert_eq!(t.marks.iter().map(|m| m.1.as_str()).collect::<Vec<_>>(), ["1e-2", "1e-1", "1e0", "1e1"]);
    }

    #[test]
    fn a_constant_or_nothing_has_ticks_too() {
        for t in [ticks(3.0, 3.0), ticks(0.0, 0.0), ticks(f64::NAN, 1.0), ticks_logarithmic(0.0, 1.0)] {
            assert!(t.high > t.low && t.marks.len() >= 2, "{t:?}");
        }
    }
}
