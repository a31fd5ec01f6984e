//! Options of trainings on the command line, from the recipes' own types and defaults.

use std::fmt;
use std::str::FromStr;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use sixfold_nn::choice::Choice;

/// Parses one of the names of a choice.
pub(super) fn choices<C: Choice + Send + Sync>() -> impl TypedValueParser<Value = C> {
    let values = C::ALL.iter().map(|choice| PossibleValue::new(choice.name()).help(choice.help()));
    PossibleValuesParser::new(values)
        .try_map(|name| C::named(&name).ok_or_else(|| format!("{name} is none of the names")))
}

/// Help for an option whose default depends on the network.
pub(super) fn by_network(what: &str, default: impl fmt::Display, paper: impl fmt::Display) -> String {
    format!("{what} (default: {default}; the dissertation's network: {paper})")
}

/// An angle in the image plane: degrees from 0 to 180 on the command line, radians inside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Degrees {
    /// The angle.
    pub radians: f32,
}

impl FromStr for Degrees {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("found {text}, expected degrees from 0 to 180");
        let degrees: f32 = text.parse().map_err(|_| wrong())?;
        if !(0.0..=180.0).contains(&degrees) {
            return Err(wrong());
        }
        Ok(Degrees { radians: degrees.to_radians() })
    }
}

impl fmt::Display for Degrees {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // As it would be typed: without the rounding errors of the conversion.
        write!(f, "{}", (f64::from(self.radians).to_degrees() * 1e4).round() / 1e4)
    }
}
