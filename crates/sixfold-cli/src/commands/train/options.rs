//! Options of trainings on the command line, based on the types and defaults of the recipes.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use clap::Args;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use sixfold_nn::choice::Choice;

/// A preset, and its older name, which help does not show.
const PUBLISHED: &str = "published";
const PAPER: &str = "paper";

/// Parses one of the names of a choice.
pub(super) fn choices<C: Choice + Send + Sync>() -> impl TypedValueParser<Value = C> {
    let value = |choice: &C| {
        let value = PossibleValue::new(choice.name()).help(choice.help());
        if choice.name() == PUBLISHED { value.alias(PAPER) } else { value }
    };
    PossibleValuesParser::new(C::ALL.iter().map(value)).try_map(|name| {
        // The older name of a preset; networks are still called so.
        let name = if C::named(&name).is_none() && name == PAPER { PUBLISHED } else { &name };
        C::named(name).ok_or_else(|| format!("{name} is none of the names"))
    })
}

/// The published form of a training, where there is no other preset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Preset {
    /// As in the dissertation.
    Published,
}

impl Choice for Preset {
    const ALL: &'static [Preset] = &[Preset::Published];

    fn name(self) -> &'static str {
        PUBLISHED
    }

    fn help(self) -> &'static str {
        "As in the dissertation; other options still count (docs/coverage.md)"
    }
}

/// Help for an option whose default depends on the network.
pub(super) fn by_network(what: &str, default: impl fmt::Display, paper: impl fmt::Display) -> String {
    format!("{what} (default: {default}; the dissertation's network: {paper})")
}

/// Help for an option whose default depends on the preset.
pub(super) fn presets(what: &str, default: impl fmt::Display, published: impl fmt::Display) -> String {
    format!("{what} (default: {default}; with --preset published: {published})")
}

/// What a training that learns from procedural objects writes.
#[derive(Debug, Args)]
pub(crate) struct ResultArguments {
    /// Do not train: write the model of the last checkpoint in --out
    #[arg(long)]
    pub export: bool,
    /// Folder for the model and the training's checkpoints, log and curves
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
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
        // In the form in which it would be typed, without the rounding errors of the conversion.
        write!(f, "{}", (f64::from(self.radians).to_degrees() * 1e4).round() / 1e4)
    }
}
