//! Arguments of `sixfold grasp`.

use clap::{Args, Subcommand};

use super::propose::ProposeArguments;
use crate::commands::experiments::Forwarded;

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
        Without --mask the largest object on the table is taken. The gripper's frame: origin midway between the finger \
        tips, z the approach, x the closing direction.")]
    Propose(ProposeArguments),
    /// Try one grasp in a physics engine: approach, close, lift 10 cm, shake (exit status 0 when it holds)
    #[cfg(feature = "physics")]
    #[command(after_help = "Example:\n  sixfold grasp try --object can.ply --unit mm --tip 0,0,0.06\n\n\
        The object stands on the table z = 0 with its own z axis up, at the origin of the world frame.")]
    Try(super::try_one::TryArguments),
    /// Measure the planner: objects on a table, simulated depth views, proposals tried (runs sixfold-experiments)
    #[command(disable_help_flag = true)]
    Measure(Forwarded),
    /// Try grasps with a simulated gripper, and store those that hold as experience
    #[cfg(all(feature = "physics", feature = "experience"))]
    #[command(after_help = "Examples:\n  \
        sixfold grasp learn --experiences experience.db --families all --members 6 --attempts 4 --out out/learn\n  \
        sixfold grasp learn --experiences experience.db --object drill.ply --unit mm --attempts 12 --out out/drill\n\n\
        If the nearest experience is near enough, its grasp is tried, otherwise the geometric \
        planner's. After a stop, the same command resumes.")]
    Learn(Box<sixfold_shell::grasp::learn::LearnArguments>),
    /// Compare geometry, experience and both on the same simulated scenes (runs sixfold-experiments)
    #[command(disable_help_flag = true)]
    Compare(Forwarded),
    /// The store of experiences: add, list, show, forget, merge, export, refresh
    #[cfg(feature = "experience")]
    #[command(after_help = "Example:\n  sixfold grasp store list experience.db\n\n\
        A store is a file, or, in a program built with the feature postgres, a server for several robots: \
        postgres://user@host:port/database, the password in PGPASSWORD. The connection is not encrypted.")]
    Store(Box<super::store::StoreArguments>),
}
