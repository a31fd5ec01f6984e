//! The methods of `sixfold estimate`: a name, options, and how they become an estimator. A new method is one struct of options
//! and one line in [`METHODS`].

use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, Result, anyhow};
use clap::{ArgMatches, Args, Command, Id, ValueEnum};
use sixfold_align::DepthOptions;
use sixfold_estimator::PoseEstimator;
use sixfold_mttm::model::MttmModel;
use sixfold_mttm::{MatchedBy, MttmEstimator, MttmOptions};
use sixfold_pix2pose::estimator::Pix2PoseEstimator;
use sixfold_ppf::PpfEstimator;

use super::arguments::CommonArguments;

/// What makes an estimator of options.
type Build = fn(&ArgMatches, &CommonArguments) -> Result<Box<dyn PoseEstimator>>;

/// A method as the command line knows it.
#[derive(Debug)]
pub(crate) struct Method {
    /// As it is typed.
    pub name: &'static str,
    /// What it is, for `--help`.
    pub about: &'static str,
    options: fn(Command) -> Command,
    build: Build,
}

impl Method {
    const fn of<A: MethodArguments>(name: &'static str, about: &'static str) -> Method {
        Method {
            name,
            about,
            options: A::augment_args,
            build: |matches, common| A::from_arg_matches(matches)?.build(common),
        }
    }

    /// Its own options.
    pub fn arguments(&self) -> Vec<clap::Arg> {
        (self.options)(Command::new(self.name)).get_arguments().cloned().collect()
    }

    /// Whether an option is one of its own.
    pub fn has(&self, id: &Id) -> bool {
        self.arguments().iter().any(|a| a.get_id() == id)
    }

    /// The estimator that these options ask for.
    pub fn build(&self, matches: &ArgMatches, common: &CommonArguments) -> Result<Box<dyn PoseEstimator>> {
        (self.build)(matches, common)
    }
}

/// The options of a method.
trait MethodArguments: Args {
    fn build(self, common: &CommonArguments) -> Result<Box<dyn PoseEstimator>>;
}

/// All methods; the first is the default.
pub(crate) static METHODS: &[Method] = &[
    Method::of::<PpfArguments>("ppf", "point pair features on depth, no training"),
    Method::of::<Pix2PoseArguments>(
        "pix2pose",
        "object coordinates from colour by a trained network, in boxes",
    ),
    Method::of::<MttmArguments>(
        "mttm",
        "templates in depth, from a mesh or from depth images of the object, no training",
    ),
];

#[derive(Debug, Args)]
struct PpfArguments {
    /// Match points on the table plane too
    #[arg(long)]
    keep_plane: bool,
}

impl MethodArguments for PpfArguments {
    fn build(self, common: &CommonArguments) -> Result<Box<dyn PoseEstimator>> {
        Ok(Box::new(PpfEstimator {
            depth: depth_options(self.keep_plane, common),
            ..PpfEstimator::default()
        }))
    }
}

#[derive(Debug, Args)]
struct Pix2PoseArguments {
    /// Trained model that `sixfold train pix2pose` wrote; for mttm another network than that within the program
    #[arg(long, value_name = "FILE.safetensors")]
    weights: Option<PathBuf>,
    /// Leave out the last step, which aligns the rendered mesh with the image
    #[arg(long)]
    no_refine: bool,
    /// Most passes over an object: each but the first is into the box of the pose before, which helps where boxes are poor and
    /// takes as long again (default: 1)
    #[arg(long, alias = "looks", value_name = "N")]
    passes: Option<NonZeroUsize>,
    /// Align poses with the depth image (ICP)
    #[arg(long)]
    icp: bool,
}

impl MethodArguments for Pix2PoseArguments {
    fn build(self, common: &CommonArguments) -> Result<Box<dyn PoseEstimator>> {
        let weights = self.weights.as_deref().ok_or_else(|| {
            anyhow!(
                "--method pix2pose needs --weights FILE.safetensors, which `sixfold train pix2pose` writes"
            )
        })?;
        let mut estimator = Pix2PoseEstimator::load(weights)?;
        estimator.options.estimate.seed = common.seed;
        if let Some(passes) = self.passes {
            estimator.options.looks = passes.get();
        }
        estimator.refine = !self.no_refine;
        estimator.icp = self.icp;
        estimator.object_id = common.object_id;
        Ok(Box::new(estimator))
    }
}

#[derive(Debug, Args)]
struct MttmArguments {
    /// Another network than that within the program
    #[arg(long, value_name = "FILE.safetensors")]
    weights: Option<PathBuf>,
    /// Who matches regions with templates
    #[arg(long, value_enum, default_value = "both")]
    matcher: Matcher,
    /// Judge poses by the templates alone, as if there were no mesh
    #[arg(long)]
    templates_only: bool,
    /// Match points on the table plane too
    #[arg(long)]
    keep_plane: bool,
}

impl MethodArguments for MttmArguments {
    fn build(self, common: &CommonArguments) -> Result<Box<dyn PoseEstimator>> {
        let network = match (self.matcher, &self.weights) {
            (Matcher::Points, _) => None,
            (_, Some(file)) => Some(MttmModel::load(file).context("--weights")?),
            (_, None) => Some(MttmModel::shipped().context("the network within the program")?),
        };
        Ok(Box::new(MttmEstimator {
            depth: depth_options(self.keep_plane, common),
            options: MttmOptions { matched_by: self.matcher.matched_by(), ..MttmOptions::default() },
            network: network.map(Arc::new),
            templates_only: self.templates_only,
            ..MttmEstimator::default()
        }))
    }
}

/// Who matches regions with templates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Matcher {
    /// Template and region point by point, without a network
    Points,
    /// The network's descriptors alone, as in the dissertation
    Network,
    /// The network says where to look, and both say with which template
    Both,
}

impl Matcher {
    fn matched_by(self) -> MatchedBy {
        match self {
            Matcher::Points => MatchedBy::Points,
            Matcher::Network => MatchedBy::Network,
            Matcher::Both => MatchedBy::Both,
        }
    }
}

/// How depth images are prepared by the options that methods on depth share.
fn depth_options(keep_plane: bool, common: &CommonArguments) -> DepthOptions {
    DepthOptions { remove_plane: !keep_plane, seed: common.seed, ..DepthOptions::default() }
}
