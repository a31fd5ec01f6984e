//! Arguments of `sixfold object`.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use sixfold_mesh::Unit;
use sixfold_mttm::ViewCoverage;
use sixfold_shell::depth_views::DepthViewArguments;
use sixfold_shell::output::JsonArguments;
use sixfold_shell::ranges;

use super::symmetries::{Evidence, SymmetriesArguments};

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
        sixfold object add mug mug.ply --unit mm --symmetric-about z --templates\n  \
        sixfold object add mug --depth d.png --mask mask.png --camera camera.json")]
    Add(Box<AddArguments>),
    /// List the stored objects
    #[command(after_help = "Example:\n  sixfold object list")]
    List,
    /// Show one object, and render it
    #[command(after_help = "Example:\n  sixfold object show mug --picture mug.png")]
    Show {
        /// Name of the object
        name: String,
        /// Image to write
        #[arg(long, value_name = "FILE.png")]
        picture: Option<PathBuf>,
    },
    /// Find the rotations that map an object onto itself, with evidence of shape and colours
    #[command(after_help = "Examples:\n  \
        sixfold object symmetries bottle.ply --unit mm --out symmetries.png\n  \
        sixfold object symmetries can --noise 1 --json")]
    Symmetries(SymmetriesArguments),
    /// Write one object as a BOP dataset: its model, and the photographs it was taught from
    #[cfg(feature = "networks")]
    #[command(after_help = "Example:\n  sixfold object export mug --bop out/mug")]
    Export {
        /// Name of the object
        name: String,
        /// Folder of the new dataset
        #[arg(long, value_name = "DIR")]
        bop: PathBuf,
        /// Object id in the dataset
        #[arg(long, value_name = "ID", default_value_t = 1)]
        id: u32,
    },
    /// Remove one object
    #[command(after_help = "Example:\n  sixfold object remove mug")]
    Remove {
        /// Name of the object
        name: String,
    },
}

/// `sixfold object add`.
#[derive(Debug, Args)]
pub(crate) struct AddArguments {
    /// Name: letters, digits, - and _
    pub name: String,
    /// Mesh file: PLY, OBJ, STL, glTF, GLB
    #[arg(required_unless_present = "depth")]
    pub mesh: Option<PathBuf>,
    /// Unit of the mesh file: m, cm, mm, in
    #[arg(long, value_name = "UNIT", required_unless_present = "depth")]
    pub unit: Option<Unit>,
    /// Also make the mesh's templates for `estimate --method mttm`, from these sides
    #[arg(long, value_enum, value_name = "VIEWS", num_args = 0..=1, default_missing_value = "above", conflicts_with = "depth")]
    pub templates: Option<TemplateViews>,
    #[command(flatten)]
    pub views: DepthViewArguments,
    /// BOP models_info.json to take the symmetries from
    #[arg(long, value_name = "FILE", requires = "model_id")]
    pub models_info: Option<PathBuf>,
    /// Object id in models_info.json
    #[arg(long, value_name = "ID")]
    pub model_id: Option<u32>,
    /// Axis of a continuous symmetry, in the object's frame: x, y or z
    #[arg(long, alias = "turns-about", value_name = "AXIS", conflicts_with = "models_info")]
    pub symmetric_about: Option<Axis>,
    /// Find the mesh's symmetries (`sixfold object symmetries`) and store those that are certain, by shape and colours or by shape
    /// alone
    #[arg(long, value_enum, value_name = "BY", num_args = 0..=1, default_missing_value = "colors",
        conflicts_with_all = ["symmetric_about", "depth"])]
    pub find_symmetries: Option<Evidence>,
    /// Noise of the mesh's surface, standard deviation in millimetres, for --find-symmetries
    #[arg(long, value_name = "MM", default_value_t = 0.0, requires = "find_symmetries", conflicts_with = "depth", value_parser = ranges::surface_noise)]
    pub noise: f64,
    /// Replace an object of the same name
    #[arg(long)]
    pub replace: bool,
}

/// An axis of an object's own frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Axis {
    X,
    Y,
    Z,
}

/// From which sides templates are rendered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum TemplateViews {
    /// From above, the camera upright: 305 views with 7 rotations each, for objects on a table with their z axis up
    Above,
    /// From all sides, the camera rotated about its axis in any way: 642 views with 24 rotations each
    Around,
}

impl TemplateViews {
    pub fn coverage(self) -> ViewCoverage {
        match self {
            TemplateViews::Above => ViewCoverage::Above,
            TemplateViews::Around => ViewCoverage::Around,
        }
    }
}
