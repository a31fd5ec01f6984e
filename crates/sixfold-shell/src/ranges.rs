//! Ranges of numbers on the command line, with messages that name the option, what was found and what is expected.

use std::fmt::Display;
use std::num::NonZeroUsize;
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

/// Most threads: more only cost memory.
const MOST_THREADS: usize = 1024;

/// Parses a number of threads.
///
/// # Errors
/// What is wrong with it.
pub fn threads(text: &str) -> Result<NonZeroUsize, String> {
    count::<MOST_THREADS>(text)
}

/// Parses a number from 1 to `MOST`.
///
/// # Errors
/// What is wrong with it.
pub fn count<const MOST: usize>(text: &str) -> Result<NonZeroUsize, String> {
    let number = text.parse().ok().filter(|number: &NonZeroUsize| number.get() <= MOST);
    number.ok_or_else(|| format!("found {text}, expected a whole number from 1 to {MOST}"))
}

/// An error for a name that could lead out of the folder in which something of that name is made.
///
/// # Errors
/// As it says.
pub fn folder_name(option: &str, name: &str) -> Result<()> {
    let plain = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if name.is_empty() || !name.chars().all(plain) {
        bail!("{option}: found {name:?}, expected letters, digits, _ and -");
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
