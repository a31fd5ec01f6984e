//! Statistics of a few numbers.

/// The median: the middle value, or the mean of the two middle ones; `None` without values. Reorders the values.
pub fn median(values: &mut [f64]) -> Option<f64> {
    let count = values.len();
    let upper = upper_median(values)?;
    if count % 2 == 1 {
        return Some(upper);
    }
    // The rank selection has put all smaller values before it.
    let lower = values[..count / 2].iter().copied().max_by(f64::total_cmp)?;
    Some(0.5 * (lower + upper))
}

/// The value of rank `count / 2`, counted from zero in ascending order: always one of the values, the upper of the two
/// middle ones if their number is even; `None` without values. Reorders the values.
pub fn upper_median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let half = values.len() / 2;
    Some(*values.select_nth_unstable_by(half, f64::total_cmp).1)
}

/// The logistic function, for a network's output: between 0 and 1.
#[inline]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_of_even_and_odd_counts() {
        assert_eq!((median(&mut []), upper_median(&mut [])), (None, None));
        assert_eq!(
            (median(&mut [5.0, 1.0, 3.0]), upper_median(&mut [5.0, 1.0, 3.0])),
            (Some(3.0), Some(3.0))
        );
        let four = [4.0, 1.0, 2.0, 8.0];
        assert_eq!((median(&mut four.clone()), upper_median(&mut four.clone())), (Some(3.0), Some(4.0)));
    }
}
