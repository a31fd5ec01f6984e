//! The error for an option that is out of its range, and checks for option structs.

use std::fmt::Display;
use std::ops::RangeBounds;

use thiserror::Error;

/// An option is out of its range.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("option {option}: found {found}, expected {expected}")]
pub struct OptionError {
    /// Its name, with the field of a nested struct in front: `voting.bin_margin`.
    pub option: &'static str,
    /// Its value.
    pub found: String,
    /// The allowed values.
    pub expected: &'static str,
}

impl OptionError {
    /// An option that is out of its range.
    pub fn new(option: &'static str, found: impl Display, expected: &'static str) -> OptionError {
        OptionError { option, found: found.to_string(), expected }
    }

    /// This error unless `value` is within `range`; NaN is outside every range with a bound.
    ///
    /// # Errors
    /// [`OptionError`].
    pub fn unless_within<T: PartialOrd + Display>(
        option: &'static str,
        value: T,
        range: impl RangeBounds<T>,
        expected: &'static str,
    ) -> Result<(), OptionError> {
        if range.contains(&value) { Ok(()) } else { Err(OptionError::new(option, value, expected)) }
    }

    /// This error unless `value` is a fraction, 0 to 1.
    ///
    /// # Errors
    /// [`OptionError`].
    pub fn unless_fraction(option: &'static str, value: f64) -> Result<(), OptionError> {
        OptionError::unless_within(option, value, 0.0..=1.0, "0 to 1")
    }

    /// This error unless `value` is finite and above 0; `expected` names the unit.
    ///
    /// # Errors
    /// [`OptionError`].
    pub fn unless_positive(
        option: &'static str,
        value: f64,
        expected: &'static str,
    ) -> Result<(), OptionError> {
        let fits = value > 0.0 && value.is_finite();
        if fits { Ok(()) } else { Err(OptionError::new(option, value, expected)) }
    }

    /// This error unless `value` is a weight: finite, 0 or more.
    ///
    /// # Errors
    /// [`OptionError`].
    pub fn unless_weight(option: &'static str, value: f64) -> Result<(), OptionError> {
        let fits = value >= 0.0 && value.is_finite();
        if fits { Ok(()) } else { Err(OptionError::new(option, value, "a finite number, 0 or more")) }
    }

    /// This error unless `value` is a count of at least 1.
    ///
    /// # Errors
    /// [`OptionError`].
    pub fn unless_some(option: &'static str, value: usize) -> Result<(), OptionError> {
        OptionError::unless_within(option, value, 1.., "1 or more")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nan_is_in_no_range_and_the_message_names_the_option() {
        let nan = f64::NAN;
        assert!(OptionError::unless_within("a", nan, 0.0.., "a number").is_err());
        assert!(OptionError::unless_fraction("a", nan).is_err());
        assert!(OptionError::unless_positive("a", nan, "metres above 0").is_err());
        assert!(OptionError::unless_positive("a", f64::INFINITY, "metres above 0").is_err());
        assert!(OptionError::unless_weight("a", nan).is_err());
        assert!(OptionError::unless_weight("a", 0.0).is_ok());
        assert!(OptionError::unless_fraction("a", 1.0).is_ok());
        let error = OptionError::unless_some("rounds", 0).unwrap_err();
        assert_eq!(error.to_string(), "option rounds: found 0, expected 1 or more");
    }
}
