//! The gripper of a command.

use std::path::Path;

use anyhow::{Context, Result, anyhow};
use sixfold_grasp::{Gripper, read_gripper};

/// A gripper by its built-in name, or from a file.
///
/// # Errors
/// When it is neither, or the file is not that of a gripper.
pub fn gripper(name_or_file: &str) -> Result<Gripper> {
    if let Some(gripper) = Gripper::built_in(name_or_file) {
        return Ok(gripper);
    }
    if !Path::new(name_or_file).exists() {
        return Err(anyhow!(
            "--gripper: {name_or_file} is neither a file nor one of {}",
            Gripper::BUILT_IN.join(", ")
        ));
    }
    read_gripper(name_or_file).context("--gripper")
}
