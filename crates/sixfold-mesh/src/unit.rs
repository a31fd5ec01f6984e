//! The length unit of a mesh file: files do not state it, so readers take it as an argument.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// The unit of the lengths in a mesh file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Unit {
    /// `m`.
    #[serde(rename = "m")]
    Metre,
    /// `mm`, what BOP models use.
    #[serde(rename = "mm")]
    Millimetre,
    /// `cm`.
    #[serde(rename = "cm")]
    Centimetre,
    /// `in`, 25.4 mm.
    #[serde(rename = "in")]
    Inch,
}

/// A word that is not a unit.
#[derive(Debug, Error, Clone, PartialEq, Eq)]
#[error("unit: found \"{found}\", expected one of m, mm, cm, in")]
pub struct UnitError {
    /// The given value.
    pub found: String,
}

impl Unit {
    /// Every unit, in the order in which messages suggest them.
    pub const ALL: [Unit; 4] = [Unit::Metre, Unit::Millimetre, Unit::Centimetre, Unit::Inch];

    /// The length of one unit in metres.
    pub fn to_metres(self) -> f64 {
        match self {
            Unit::Metre => 1.0,
            Unit::Millimetre => 1e-3,
            Unit::Centimetre => 1e-2,
            Unit::Inch => 0.0254,
        }
    }

    /// The full word, as messages use it.
    pub(crate) fn plural(self) -> &'static str {
        match self {
            Unit::Metre => "metres",
            Unit::Millimetre => "millimetres",
            Unit::Centimetre => "centimetres",
            Unit::Inch => "inches",
        }
    }
}

impl fmt::Display for Unit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Unit::Metre => "m",
            Unit::Millimetre => "mm",
            Unit::Centimetre => "cm",
            Unit::Inch => "in",
        })
    }
}

impl FromStr for Unit {
    type Err = UnitError;
    fn from_str(word: &str) -> Result<Self, UnitError> {
        Unit::ALL
            .into_iter()
            .find(|unit| unit.to_string() == word)
            .ok_or_else(|| UnitError { found: word.to_owned() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_and_units_go_both_ways() {
        for unit in Unit::ALL {
            assert_eq!(unit.to_string().parse(), Ok(unit));
        }
        let error = "feet".parse::<Unit>().unwrap_err();
        assert_eq!(error.to_string(), "unit: found \"feet\", expected one of m, mm, cm, in");
        assert_eq!(2.0 * Unit::Inch.to_metres(), 0.0508);
    }
}
