//! `sixfold completions`.

use anyhow::Result;
use clap::CommandFactory;

use crate::Outcome;
use crate::arguments::{Arguments, CompletionsArguments};

pub(crate) fn run(a: &CompletionsArguments) -> Result<Outcome> {
    let mut script = vec![];
    clap_complete::generate(a.shell, &mut Arguments::command(), "sixfold", &mut script);
    print!("{}", String::from_utf8_lossy(&script));
    Ok(Outcome::Found)
}
