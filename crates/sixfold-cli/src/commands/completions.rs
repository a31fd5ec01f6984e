//! `sixfold completions`.

use anyhow::Result;
use clap::Args;
use sixfold_shell::Outcome;

#[derive(Debug, Args)]
pub(crate) struct CompletionsArguments {
    /// Which shell
    #[arg(value_enum)]
    pub shell: clap_complete::Shell,
}

/// Prints completions for the program's command line.
pub(crate) fn run(a: &CompletionsArguments, mut program: clap::Command) -> Result<Outcome> {
    let mut script = vec![];
    clap_complete::generate(a.shell, &mut program, "sixfold", &mut script);
    print!("{}", String::from_utf8_lossy(&script));
    Ok(Outcome::Found)
}
