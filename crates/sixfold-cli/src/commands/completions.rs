//! `sixfold completions`.

use anyhow::Result;
use clap::CommandFactory;

use crate::Outcome;
use crate::arguments::{Arguments, CompletionsArguments};

pub(crate) fn run(a: &CompletionsArguments) -> Result<Outcome> {
    clap_complete::generate(a.shell, &mut Arguments::command(), "sixfold", &mut std::io::stdout());
    Ok(Outcome::Found)
}
