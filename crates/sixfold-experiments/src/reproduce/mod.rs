//! `sixfold reproduce`: a method measured on a dataset as in its paper, with its ablations: one table from one command.

mod auto;
mod dgcm;
mod kept;
mod loss_curve;
mod mesh_errors;
mod mttm;
mod nol;
mod pix2pose;
mod teach;
mod teach_dataset;
mod teach_photographs;

use anyhow::Result;
use clap::{Args, Subcommand};
use sixfold_shell::Outcome;
use sixfold_shell::output::JsonArguments;

#[derive(Debug, Args)]
pub(crate) struct ReproduceArguments {
    #[command(subcommand)]
    pub command: ReproduceCommand,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Debug, Subcommand)]
pub(crate) enum ReproduceCommand {
    /// Measure how accurate the probabilities of --method auto are, also for absent objects; or fit them
    #[command(after_help = auto::AFTER_HELP)]
    Auto(Box<auto::ReproduceAutoArguments>),
    /// Measure recall and AR of Pix2Pose per object, the contribution of each part, and times
    #[command(after_help = "Example:\n  \
        sixfold reproduce pix2pose --dataset lmo --frames frames.json --weights model.safetensors --published lmo/published/cnos-fastsam-megapose_lmo-test.csv --out out/reproduce\n\n\
        Finished rows are kept. After a stop, the same command resumes.")]
    Pix2pose(Box<pix2pose::ReproducePix2PoseArguments>),
    /// Plot the losses of symmetric objects against their rotation: figure 3.3
    #[command(after_help = loss_curve::AFTER_HELP)]
    LossCurve(loss_curve::LossCurveArguments),
    /// Measure masks and poses of template matching per object, with ablations, point pair features and times
    #[command(after_help = "Example:\n  \
        sixfold reproduce mttm --dataset lmo-simulated --out out/reproduce-mttm\n\n\
        Finished images are kept. After a stop, the same command resumes.")]
    Mttm(mttm::ReproduceMttmArguments),
    /// Measure poses and views of Neural Object Learning, with wrong meshes, under other light, and times
    #[command(after_help = nol::arguments::AFTER_HELP)]
    Nol(nol::arguments::ReproduceNolArguments),
    /// Teach objects from simulated photographs; measure poses, meshes and symmetries, and find them in new images
    #[command(after_help = teach::AFTER_HELP)]
    Teach(teach::ReproduceTeachArguments),
    /// Teach objects of a dataset from a few of its images, without their meshes; measure meshes, and poses in the other images
    #[command(after_help = teach_dataset::AFTER_HELP)]
    TeachDataset(teach_dataset::TeachDatasetArguments),
    /// Measure grasps from experience: table 6.2, figure 6.7, learning from an empty store, handles
    #[command(after_help = "Example:\n  \
        sixfold reproduce dgcm --list benches/grasp-objects.json --meshes DIR --out out/reproduce-dgcm\n\n\
        Finished parts are kept. After a stop, the same command resumes.")]
    Dgcm(Box<dgcm::ReproduceDgcmArguments>),
}

pub(crate) fn run(a: &ReproduceArguments) -> Result<Outcome> {
    match &a.command {
        ReproduceCommand::Auto(arguments) => auto::run(arguments, &a.json),
        ReproduceCommand::Pix2pose(arguments) => pix2pose::run(arguments, &a.json),
        ReproduceCommand::LossCurve(arguments) => loss_curve::run(arguments, &a.json),
        ReproduceCommand::Mttm(arguments) => mttm::run(arguments, &a.json),
        ReproduceCommand::Nol(arguments) => nol::run(arguments, &a.json),
        ReproduceCommand::Teach(arguments) => teach::run(arguments, &a.json),
        ReproduceCommand::TeachDataset(arguments) => teach_dataset::run(arguments, &a.json),
        ReproduceCommand::Dgcm(arguments) => dgcm::run(arguments, &a.json),
    }
}
