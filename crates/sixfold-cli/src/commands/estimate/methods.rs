//! The methods of `sixfold estimate`: a name, options, and the construction of an estimator from them. A new method is one
//! struct of options and one line in [`METHODS`].

use std::path::PathBuf;

use anyhow::Result;
use clap::{ArgMatches, Args, Command, Id, ValueEnum};
use sixfold_align::DepthOptions;
use sixfold_estimator::PoseEstimator;
use sixfold_mttm::{MaskSource, MatchedBy, MttmEstimator, MttmOptions};
use sixfold_ppf::PpfEstimator;
use sixfold_shell::image_templates::ImageTemplateArguments;

use super::arguments::CommonArguments;
use super::networks;
use crate::commands::object::arguments::TemplateViews;

/// Constructs an estimator from options.
type Build = fn(&ArgMatches, &CommonArguments) -> Result<Box<dyn PoseEstimator>>;

/// A method on the command line.
#[derive(Debug)]
pub(crate) struct Method {
    /// Its name on the command line.
    pub name: &'static str,
    /// Its description for `--help`.
    pub about: &'static str,
    options: fn(Command) -> Command,
    build: Build,
}

impl Method {
    pub const fn of<A: MethodArguments>(name: &'static str, about: &'static str) -> Method {
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

    /// The estimator for these options.
    pub fn build(&self, matches: &ArgMatches, common: &CommonArguments) -> Result<Box<dyn PoseEstimator>> {
        (self.build)(matches, common)
    }
}

/// Which form of a method of the dissertation runs.
#[derive(Debug, Args)]
pub(super) struct PresetArguments {
    /// Run the method as the dissertation describes it (docs/coverage.md lists what still differs)
    #[arg(long, value_name = "NAME", value_enum)]
    preset: Option<Preset>,
}

impl PresetArguments {
    /// Whether the published form was requested.
    pub fn published(&self) -> bool {
        matches!(self.preset, Some(Preset::Published))
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Preset {
    /// As in the dissertation
    #[value(alias = "paper")]
    Published,
}

/// The options of a method.
pub(crate) trait MethodArguments: Args {
    fn build(self, common: &CommonArguments) -> Result<Box<dyn PoseEstimator>>;
}

/// All methods; the first is the default: all of them together, and without networks point pair features.
pub(crate) static METHODS: &[Method] = &[
    #[cfg(feature = "networks")]
    networks::AUTO,
    Method::of::<PpfArguments>("ppf", "point pair features on depth, no training"),
    #[cfg(feature = "networks")]
    networks::PIX2POSE,
    #[cfg(feature = "networks")]
    networks::VIEWS,
    Method::of::<MttmArguments>(
        "mttm",
        "templates in depth, from a mesh or from depth images of the object, no training",
    ),
];

#[derive(Debug, Args)]
struct PpfArguments {
    /// Search the plane of the table too
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
struct MttmArguments {
    /// Network to use instead of the built-in one
    #[arg(long, value_name = "FILE.safetensors")]
    weights: Option<PathBuf>,
    #[command(flatten)]
    preset: PresetArguments,
    /// How regions are matched with templates (with --preset published: network)
    #[arg(long, value_enum, default_value = networks::DEFAULT_MATCHER, conflicts_with = "preset")]
    matcher: Matcher,
    /// Where masks come from; with network, regions and hypotheses are those of the network alone too (with --preset published:
    /// network)
    #[arg(long, value_enum, default_value = "aligned", conflicts_with = "preset")]
    masks: Masks,
    /// Directions from which a mesh's templates are rendered; around is for objects in any orientation (default: as in `object
    /// add`, else above)
    #[arg(long, value_enum, value_name = "VIEWS")]
    templates: Option<TemplateViews>,
    #[command(flatten)]
    images: ImageTemplateArguments,
    /// Verify poses with the templates, not with the mesh
    #[arg(long)]
    templates_only: bool,
    /// Search the plane of the table too
    #[arg(long)]
    keep_plane: bool,
}

impl MethodArguments for MttmArguments {
    fn build(self, common: &CommonArguments) -> Result<Box<dyn PoseEstimator>> {
        let options = if self.preset.published() {
            MttmOptions::published()
        } else {
            MttmOptions {
                matched_by: self.matcher.matched_by(),
                masks: self.masks.source(),
                ..MttmOptions::default()
            }
        };
        let estimator = MttmEstimator {
            depth: depth_options(self.keep_plane, common),
            options,
            coverage: self.templates.map(TemplateViews::coverage),
            templates_only: self.templates_only,
            given: self.images.templates(
                common.dataset.as_deref(),
                &common.split,
                common.models.as_deref(),
                &common.ids,
            )?,
            ..MttmEstimator::default()
        };
        Ok(Box::new(networks::with_network(estimator, self.weights.as_deref())?))
    }
}

/// Where the masks of `--method mttm` come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Masks {
    /// The matched template, aligned with the scene
    Aligned,
    /// The network, before any alignment
    Network,
}

impl Masks {
    fn source(self) -> MaskSource {
        match self {
            Masks::Aligned => MaskSource::Aligned,
            Masks::Network => MaskSource::Network,
        }
    }
}

/// Who matches regions with templates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Matcher {
    /// Compare points of template and region, without a network
    Points,
    /// The network's descriptors alone, as in the dissertation
    Network,
    /// The network proposes regions; both match templates
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

/// The preparation of depth images according to the options that depth methods share.
pub(super) fn depth_options(keep_plane: bool, common: &CommonArguments) -> DepthOptions {
    DepthOptions { remove_plane: !keep_plane, seed: common.seed, ..DepthOptions::default() }
}
