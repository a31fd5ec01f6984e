//! Arguments of `sixfold grasp`.

use std::num::NonZeroUsize;
use std::path::PathBuf;

use clap::{Args, Subcommand};
#[cfg(feature = "physics")]
use sixfold_mesh::Unit;

#[cfg(feature = "physics")]
use super::object_list::ObjectsArguments;
use crate::arguments::JsonArguments;

#[derive(Debug, Args)]
pub(crate) struct GraspArguments {
    #[command(subcommand)]
    pub command: GraspCommand,
}

#[derive(Debug, Subcommand)]
pub(crate) enum GraspCommand {
    /// Propose grasps on an object seen in one depth image, by geometry alone
    #[command(after_help = "Examples:\n  \
        sixfold grasp propose --depth d.png --camera camera.json --mask mask.png --rgb c.png --out out\n  \
        sixfold grasp propose --depth d.png --camera camera.json --gripper my-gripper.json --json\n\n\
        Without --mask the largest thing on the table is taken. The gripper's frame: origin midway between the finger \
        tips, z the approach, x the closing direction.")]
    Propose(ProposeArguments),
    /// Try one grasp in a physics engine: approach, close, lift 10 cm, shake (exit status 0 when it holds)
    #[cfg(feature = "physics")]
    #[command(after_help = "Example:\n  sixfold grasp try --object can.ply --unit mm --tip 0,0,0.06\n\n\
        The object stands on the table z = 0 with its own z axis up, in the middle of the world's frame.")]
    Try(TryArguments),
    /// Measure the planner: objects on a table, simulated depth views, proposals tried in a physics engine
    #[cfg(feature = "physics")]
    #[command(after_help = "Examples:\n  \
        sixfold grasp measure --object can.ply mug.ply --unit mm --trials 20\n  \
        sixfold grasp measure --list benches/grasp-objects.json --meshes DIR --out out/grasps")]
    Measure(MeasureArguments),
    /// Learn by doing: a simulated hand tries grasps, and what works becomes experience
    #[cfg(all(feature = "physics", feature = "experience"))]
    #[command(after_help = "Examples:\n  \
        sixfold grasp learn --experiences experience.db --families all --members 6 --attempts 4 --out out/learn\n  \
        sixfold grasp learn --experiences experience.db --object drill.ply --unit mm --attempts 12 --out out/drill\n\n\
        When the nearest experience is near enough, its grasp is tried, else the geometric planner's. Stopped, the same \
        command goes on.")]
    Learn(Box<super::learn::LearnArguments>),
    /// Compare geometry, experience and both on the same simulated scenes
    #[cfg(all(feature = "physics", feature = "experience"))]
    #[command(after_help = "Example:\n  \
        sixfold grasp compare --experiences experience.db --list benches/grasp-objects.json --meshes DIR --hard --out out/compare\n\n\
        Stopped, the same command goes on.")]
    Compare(Box<super::compare::CompareArguments>),
    /// The store of experiences: add, list, show, forget, merge, export, refresh
    #[cfg(feature = "experience")]
    #[command(after_help = "Example:\n  sixfold grasp store list experience.db\n\n\
        A store is a file, or, in a program built with the feature postgres, a server for several robots: \
        postgres://user@host:port/database, the password in PGPASSWORD. The connection is not encrypted.")]
    Store(Box<super::store::StoreArguments>),
}

/// A depth image and what belongs to it.
#[derive(Debug, Args)]
pub(crate) struct InputArguments {
    /// Depth image: PNG, one channel of 16 bits
    #[arg(long, value_name = "FILE")]
    pub depth: PathBuf,
    /// Camera: a JSON file with fx fy cx cy or cam_K, and depth_scale (millimetres per unit of the depth image)
    #[arg(long, value_name = "FILE")]
    pub camera: PathBuf,
    /// Millimetres per unit of the depth image, in place of the camera file's depth_scale
    #[arg(long, value_name = "MM")]
    pub depth_scale: Option<f64>,
    /// The object's mask: PNG, above zero inside (default: the largest thing on the table)
    #[arg(long, value_name = "FILE")]
    pub mask: Option<PathBuf>,
    /// Colour image for the overlay
    #[arg(long, value_name = "FILE")]
    pub rgb: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub(crate) struct ProposeArguments {
    #[command(flatten)]
    pub input: InputArguments,
    /// Gripper: jaws-140, jaws-85, or a file
    #[arg(long, value_name = "NAME_OR_FILE", default_value = "jaws-140")]
    pub gripper: String,
    /// Most grasps
    #[arg(long, value_name = "N", default_value = "5")]
    pub number: NonZeroUsize,
    /// Propose from experience too: a store that `sixfold grasp learn` or `sixfold grasp store add` wrote, a file or
    /// postgres://user@host/database
    #[cfg(feature = "experience")]
    #[arg(long, value_name = "FILE")]
    pub experiences: Option<sixfold_experience::StorePlace>,
    #[cfg(feature = "experience")]
    #[command(flatten)]
    pub network: super::experience::NetworkArguments,
    /// Only experiences on parts of this name, such as handle, and only grasps that hold what they held
    #[cfg(feature = "experience")]
    #[arg(long, value_name = "NAME", requires = "experiences")]
    pub part: Option<String>,
    /// Take only what was seen: assume nothing of the object's far side
    #[arg(long)]
    pub seen_only: bool,
    /// Folder for grasps.json and overlay.png
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Seed of everything random
    #[arg(long, default_value = "0")]
    pub seed: u64,
    #[command(flatten)]
    pub json: JsonArguments,
}

/// Numbers of the simulated trial.
#[cfg(feature = "physics")]
#[derive(Debug, Args)]
pub(crate) struct PhysicsArguments {
    /// Gripper: jaws-140, jaws-85, or a file
    #[arg(long, value_name = "NAME_OR_FILE", default_value = "jaws-140")]
    pub gripper: String,
    /// Mass of the objects, kg
    #[arg(long, value_name = "KG", default_value = "0.2")]
    pub mass: f64,
    /// Friction coefficient of the pads (default: the gripper's)
    #[arg(long, value_name = "MU")]
    pub friction: Option<f64>,
    /// Force of each finger, newtons (default: the gripper's)
    #[arg(long, value_name = "N")]
    pub force: Option<f64>,
}

#[cfg(feature = "physics")]
#[derive(Debug, Args)]
pub(crate) struct TryArguments {
    /// Mesh file, or the name of a stored object
    #[arg(long, value_name = "NAME_OR_MESH")]
    pub object: String,
    /// Unit of the mesh file: m, cm, mm, in
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// Where the middle of the finger tips is when they close, metres
    #[arg(
        long,
        value_name = "X,Y,Z",
        value_delimiter = ',',
        allow_hyphen_values = true,
        required_unless_present = "grasp"
    )]
    pub tip: Option<Vec<f64>>,
    /// Approach direction
    #[arg(
        long,
        value_name = "X,Y,Z",
        value_delimiter = ',',
        allow_hyphen_values = true,
        default_value = "0,0,-1"
    )]
    pub approach: Vec<f64>,
    /// Closing direction
    #[arg(
        long,
        value_name = "X,Y,Z",
        value_delimiter = ',',
        allow_hyphen_values = true,
        default_value = "1,0,0"
    )]
    pub closing: Vec<f64>,
    /// Distance of the pads before they close, metres (default: as far as they go)
    #[arg(long, value_name = "M")]
    pub opening: Option<f64>,
    /// A trial of `sixfold grasp measure` in place of --tip: JSON with world_from_object, world_from_gripper, opening
    #[arg(long, value_name = "FILE", conflicts_with_all = ["tip", "opening"])]
    pub grasp: Option<PathBuf>,
    #[command(flatten)]
    pub physics: PhysicsArguments,
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[cfg(feature = "physics")]
#[derive(Debug, Args)]
pub(crate) struct MeasureArguments {
    #[command(flatten)]
    pub objects: ObjectsArguments,
    /// Attempts on each object
    #[arg(long, value_name = "N", default_value = "15")]
    pub trials: NonZeroUsize,
    /// Let the objects fall in any orientation; otherwise they stand with their own z axis up
    #[arg(long)]
    pub any_orientation: bool,
    /// Ideal depth images, without a sensor's noise
    #[arg(long)]
    pub no_noise: bool,
    #[command(flatten)]
    pub physics: PhysicsArguments,
    /// Folder for trials.json (all poses and outcomes, the objects' convex parts) and pictures of the first attempts
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Seed of poses, view points, noise and the planner
    #[arg(long, default_value = "0")]
    pub seed: u64,
    #[command(flatten)]
    pub json: JsonArguments,
}
