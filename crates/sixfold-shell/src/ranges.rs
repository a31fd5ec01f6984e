//! Ranges of numbers on the command line, with messages that name the option, what was found and what is expected.

use std::fmt::Display;
use std::num::NonZeroUsize;
use std::ops::RangeInclusive;
use std::time::Duration;

use anyhow::{Result, bail};

/// An error for a number outside its range, or for NaN.
///
/// # Errors
/// For such a number.
pub fn in_range<T: PartialOrd + Display>(option: &str, value: T, range: RangeInclusive<T>) -> Result<()> {
    if !range.contains(&value) {
        bail!("{option}: found {value}, expected {} to {}", range.start(), range.end());
    }
    Ok(())
}

/// Largest number of threads: more only cost memory.
const MAX_THREADS: usize = 1024;

/// Longest time on the command line, seconds.
const MAX_SECONDS: f64 = 3600.0;

/// Parses a number of threads.
///
/// # Errors
/// What is wrong with it.
pub fn threads(text: &str) -> Result<NonZeroUsize, String> {
    count::<MAX_THREADS>(text)
}

/// Parses a number from 1 to `MOST`.
///
/// # Errors
/// What is wrong with it.
pub fn count<const MOST: usize>(text: &str) -> Result<NonZeroUsize, String> {
    let number = text.parse().ok().filter(|number: &NonZeroUsize| number.get() <= MOST);
    number.ok_or_else(|| format!("found {text}, expected a whole number from 1 to {MOST}"))
}

/// Parses a length of time: a number with s or ms behind it.
///
/// # Errors
/// What is wrong with it.
pub fn duration(text: &str) -> Result<Duration, String> {
    let seconds = match (text.strip_suffix("ms"), text.strip_suffix('s')) {
        (Some(number), _) => number.trim().parse::<f64>().ok().map(|ms| ms / 1000.0),
        (None, Some(number)) => number.trim().parse::<f64>().ok(),
        (None, None) => None,
    };
    let seconds = seconds.filter(|s| *s > 0.0 && *s <= MAX_SECONDS);
    seconds
        .map(Duration::from_secs_f64)
        .ok_or_else(|| format!("found {text}, expected a time above 0, at most an hour, such as 1s or 500ms"))
}

/// Parses millimetres per unit of a depth image.
///
/// # Errors
/// What is wrong with it.
pub fn depth_scale(text: &str) -> Result<f64, String> {
    let scale = text.parse().ok().filter(|scale: &f64| *scale > 0.0 && *scale <= 1000.0);
    scale.ok_or_else(|| format!("found {text}, expected millimetres above 0, at most 1000"))
}

/// Parses a measured length in metres.
///
/// # Errors
/// What is wrong with it.
pub fn length(text: &str) -> Result<f64, String> {
    let length = text.parse().ok().filter(|length: &f64| (0.005..=5.0).contains(length));
    length.ok_or_else(|| format!("found {text}, expected metres, 0.005 to 5"))
}

/// Parses the noise of a surface in millimetres.
///
/// # Errors
/// What is wrong with it.
pub fn surface_noise(text: &str) -> Result<f64, String> {
    let noise = text.parse().ok().filter(|noise: &f64| (0.0..=100.0).contains(noise));
    noise.ok_or_else(|| format!("found {text}, expected millimetres, 0 to 100"))
}

/// Parses the step between views in degrees.
///
/// # Errors
/// What is wrong with it.
pub fn view_step(text: &str) -> Result<f64, String> {
    let step = text.parse().ok().filter(|step: &f64| (1.0..=90.0).contains(step));
    step.ok_or_else(|| format!("found {text}, expected degrees from 1 to 90"))
}

/// Parses the name of a folder within another, such as a split of a dataset.
///
/// # Errors
/// What is wrong with it.
pub fn folder_name(text: &str) -> Result<String, String> {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-');
    if text.is_empty() || !text.chars().all(is_plain) {
        return Err(format!("found {text:?}, expected letters, digits, _ and -"));
    }
    Ok(text.to_owned())
}

/// An error for an id that is named twice.
///
/// # Errors
/// For such an id.
pub fn without_duplicates(option: &str, ids: &[u32]) -> Result<()> {
    let mut seen = std::collections::BTreeSet::new();
    if let Some(id) = ids.iter().find(|id| !seen.insert(**id)) {
        bail!("{option}: found {id} twice, expected each id once");
    }
    Ok(())
}
