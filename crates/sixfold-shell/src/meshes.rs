//! The options with which every command reads meshes.

use clap::Args;
use sixfold_mesh::MeshOptions;

/// How mesh files are read, by whatever command and from datasets and stores alike.
#[derive(Debug, Clone, Copy, Args)]
pub struct MeshArguments {
    /// Let mesh files refer to textures, materials and buffers outside their folder (any file of this machine)
    #[arg(long, global = true)]
    pub allow_outside: bool,
}

impl MeshArguments {
    /// Applies the options to the whole process.
    pub fn apply(self) {
        if self.allow_outside {
            MeshOptions::allow_outside_everywhere();
        }
    }
}
