//! `sixfold reproduce`: a method measured on a dataset as its paper does, with its ablations, one table from one command.

mod auto;
mod dgcm;
mod kept;
mod mttm;
mod nol;
mod pix2pose;
mod teach;

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
    /// Do the probabilities of --method auto hold, and what of absent objects? Also fits them
    #[command(after_help = auto::AFTER_HELP)]
    Auto(Box<auto::ReproduceAutoArguments>),
    /// Recall and AR of Pix2Pose per object, what each part of the method is worth, and times
    #[command(after_help = "Example:\n  \
        sixfold reproduce pix2pose --dataset lmo --frames frames.json --weights model.safetensors --published lmo/published/cnos-fastsam-megapose_lmo-test.csv --out out/reproduce\n\n\
        Every row is kept; interrupted, it continues when the same command is given again.")]
    Pix2pose(Box<pix2pose::ReproducePix2PoseArguments>),
    /// Masks and poses of template matching per object, with its ablations, point pair features, and times
    #[command(after_help = "Example:\n  \
        sixfold reproduce mttm --dataset lmo-simulated --out out/reproduce-mttm\n\n\
        Every image is kept; interrupted, it continues when the same command is given again.")]
    Mttm(mttm::ReproduceMttmArguments),
    /// Poses and views of Neural Object Learning beside truth and real pixels, wrong meshes, another lamp, and times
    #[command(after_help = nol::arguments::AFTER_HELP)]
    Nol(nol::arguments::ReproduceNolArguments),
    /// Objects taught from simulated photographs: poses, meshes and symmetries beside the truth, found again in new images
    #[command(after_help = teach::AFTER_HELP)]
    Teach(teach::ReproduceTeachArguments),
    /// Grasps from experience: table 6.2, figure 6.7, learning from nothing, handles
    #[command(after_help = "Example:\n  \
        sixfold reproduce dgcm --list benches/grasp-objects.json --meshes DIR --out out/reproduce-dgcm\n\n\
        Every part is kept; interrupted, it continues when the same command is given again.")]
    Dgcm(Box<dgcm::ReproduceDgcmArguments>),
}

pub(crate) fn run(a: &ReproduceArguments) -> Result<Outcome> {
    match &a.command {
        ReproduceCommand::Auto(arguments) => auto::run(arguments, &a.json),
        ReproduceCommand::Pix2pose(arguments) => pix2pose::run(arguments, &a.json),
        ReproduceCommand::Mttm(arguments) => mttm::run(arguments, &a.json),
        ReproduceCommand::Nol(arguments) => nol::run(arguments, &a.json),
        ReproduceCommand::Teach(arguments) => teach::run(arguments, &a.json),
        ReproduceCommand::Dgcm(arguments) => dgcm::run(arguments, &a.json),
    }
}
