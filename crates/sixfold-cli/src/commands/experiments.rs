//! `sixfold reproduce`, `sixfold grasp compare` and `sixfold grasp measure`: run by the separate program `sixfold-experiments`
//! with the same arguments.

use std::ffi::OsString;
use std::process::Command;

use anyhow::{Context, Result, bail};
use clap::Args;
use sixfold_shell::Outcome;
use sixfold_shell::companion::companion;

/// The program that has the command.
const PROGRAM: &str = "sixfold-experiments";

/// Whatever follows is for the other program.
#[derive(Debug, Args)]
pub(crate) struct Forwarded {
    /// Arguments; --help shows them
    #[arg(
        value_name = "ARGUMENTS",
        num_args = 0..,
        trailing_var_arg = true,
        allow_hyphen_values = true
    )]
    pub arguments: Vec<OsString>,
}

/// Runs the other program with this one's arguments; its exit status becomes this one's.
pub(crate) fn run() -> Result<Outcome> {
    let Some(program) = companion(PROGRAM) else {
        bail!(
            "this command is run by the program {PROGRAM}, which is neither beside this one nor on PATH: install it with \
             `cargo install --locked --path crates/{PROGRAM}`, or build it in a checkout with `cargo build --release -p {PROGRAM}`"
        )
    };
    let mut command = Command::new(&program);
    command.args(std::env::args_os().skip(1));
    become_it(command).with_context(|| format!("cannot run {}", program.display()))
}

#[cfg(unix)]
fn become_it(mut command: Command) -> Result<Outcome> {
    // This returns only on failure.
    Err(std::os::unix::process::CommandExt::exec(&mut command).into())
}

#[cfg(not(unix))]
fn become_it(mut command: Command) -> Result<Outcome> {
    let status = command.status()?;
    std::process::exit(status.code().unwrap_or(2))
}
