//! Ranges of numbers on the command line, with messages that name the option, what was found and what is expected.

use std::fmt::Display;
use std::ops::RangeInclusive;

use anyhow::{Result, bail};

/// An error for a number outside its range, or that is none.
///
/// # Errors
/// As it says.
pub fn in_range<T: PartialOrd + Display>(option: &str, value: T, range: RangeInclusive<T>) -> Result<()> {
    if !range.contains(&value) {
        bail!("{option}: found {value}, expected {} to {}", range.start(), range.end());
    }
    Ok(())
}

/// An error for an id that is named twice.
///
/// # Errors
/// As it says.
pub fn without_duplicates(option: &str, ids: &[u32]) -> Result<()> {
    let mut seen = std::collections::BTreeSet::new();
    if let Some(id) = ids.iter().find(|id| !seen.insert(**id)) {
        bail!("{option}: found {id} twice, expected each id once");
    }
    Ok(())
}
