//! What `sixfold object` is told.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use sixfold_mesh::Unit;
use sixfold_shell::output::JsonArguments;

use super::mttm::arguments::{DepthViewArguments, TemplateViews};

#[derive(Debug, Args)]
pub(crate) struct ObjectArguments {
    /// Folder of stored objects
    #[arg(long, global = true, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
    #[command(subcommand)]
    pub command: ObjectCommand,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Debug, Subcommand)]
pub(crate) enum ObjectCommand {
    /// Store a mesh under a name, or an object seen in depth images
    #[command(after_help = "Examples:\n  \
        sixfold object add mug mug.ply --unit mm --turns-about z --templates\n  \
        sixfold object add mug --depth d.png --mask mask.png --camera camera.json")]
    Add {
        /// Name: letters, digits, - and _
        name: String,
        /// Mesh file: PLY, OBJ, STL, glTF, GLB
        #[arg(required_unless_present = "depth")]
        mesh: Option<PathBuf>,
        /// Unit of the mesh file: m, cm, mm, in
        #[arg(long, value_name = "UNIT", required_unless_present = "depth")]
        unit: Option<Unit>,
        /// Also make the mesh's templates for `estimate --method mttm`, from these sides
        #[arg(long, value_enum, value_name = "VIEWS", num_args = 0..=1, default_missing_value = "above", conflicts_with = "depth")]
        templates: Option<TemplateViews>,
        #[command(flatten)]
        views: DepthViewArguments,
        /// BOP models_info.json to take the symmetries from
        #[arg(long, value_name = "FILE", requires = "model_id")]
        models_info: Option<PathBuf>,
        /// Object id in models_info.json
        #[arg(long, value_name = "ID")]
        model_id: Option<u32>,
        /// The object may turn freely about this axis of its own frame: x, y or z
        #[arg(long, value_name = "AXIS", conflicts_with = "models_info")]
        turns_about: Option<Axis>,
        /// Replace an object of the same name
        #[arg(long)]
        replace: bool,
    },
    /// List the stored objects
    #[command(after_help = "Example:\n  sixfold object list")]
    List,
    /// Show one object, and draw it
    #[command(after_help = "Example:\n  sixfold object show mug --picture mug.png")]
    Show {
        /// Its name
        name: String,
        /// Picture to write
        #[arg(long, value_name = "FILE.png")]
        picture: Option<PathBuf>,
    },
    /// Remove one object
    #[command(after_help = "Example:\n  sixfold object remove mug")]
    Remove {
        /// Its name
        name: String,
    },
}

/// An axis of an object's own frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Axis {
    X,
    Y,
    Z,
}
