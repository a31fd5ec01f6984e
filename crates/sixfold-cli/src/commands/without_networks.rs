//! Replaces the commands that need a network when the feature `networks` is off: they print a message.

use std::ffi::OsString;

use anyhow::{Result, anyhow};
use clap::Args;
use sixfold_shell::{Outcome, WITHOUT_NETWORKS};

/// Whatever is asked, the answer is the same.
#[derive(Debug, Args)]
#[command(disable_help_flag = true)]
pub(crate) struct Unanswered {
    #[arg(num_args = 0.., trailing_var_arg = true, allow_hyphen_values = true)]
    _arguments: Vec<OsString>,
}

pub(crate) type DetectArguments = Unanswered;
pub(crate) type SynthesizeArguments = Unanswered;
pub(crate) type TeachArguments = Unanswered;
pub(crate) type TrainArguments = Unanswered;

/// Empty, because the command is not built in.
pub(crate) const AFTER_HELP: &str = "";

pub(crate) fn run(_: &Unanswered) -> Result<Outcome> {
    Err(anyhow!(WITHOUT_NETWORKS))
}
