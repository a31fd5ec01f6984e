//! The parts of `sixfold estimate` that need networks: `--method pix2pose`, `--detector`, and the network of `--method mttm`.

use std::collections::BTreeSet;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use clap::Args;
use sixfold_auto::AutoMembers;
use sixfold_detect::detector::TrainedDetector;
use sixfold_detect::torchvision::existing_objects_file;
use sixfold_estimator::{ObjectDetector, PoseEstimator, Region};
use sixfold_geometry::RgbImage;
use sixfold_mttm::model::MttmModel;
use sixfold_mttm::{MatchedBy, MttmEstimator};
use sixfold_pix2pose::aligned::MAX_STARTS;
use sixfold_pix2pose::model::Pix2PoseModel;
use sixfold_pix2pose::own_weights::OwnWeights;
use sixfold_runner::RegionSource;
use sixfold_shell::ranges::{self, count};
use sixfold_views::ViewsRefiner;
use sixfold_views::estimator::ViewsEstimator;

use super::arguments::CommonArguments;
use super::methods::{Method, MethodArguments, PresetArguments, depth_options};

/// The default of `--matcher` for `--method mttm`.
pub(super) const DEFAULT_MATCHER: &str = "both";

/// Poses from colour.
pub(super) const PIX2POSE: Method = Method::of::<Pix2PoseArguments>(
    "pix2pose",
    "object coordinates from colour by a trained network, in boxes",
);

/// Poses from colour without training for the object.
pub(super) const VIEWS: Method = Method::of::<ViewsArguments>(
    "views",
    "rendered views of a mesh matched with a colour image, in given boxes or those of a class-agnostic \
     detector, no training",
);

/// All methods together, with probabilities.
pub(super) const AUTO: Method = Method::of::<AutoArguments>(
    "auto",
    "all methods that the images allow, until an object is found with a high probability; each pose with its probability",
);

#[derive(Debug, Args)]
struct AutoArguments {
    /// Weights that `sixfold train pix2pose` wrote (default: the object's own, from `sixfold teach --train`); for mttm and views a
    /// network to use instead of the built-in one
    #[arg(long, value_name = "FILE.safetensors")]
    weights: Option<PathBuf>,
    /// Start no further method for an object after this time, such as 1s or 500ms; the result then depends on the machine
    #[arg(long, value_name = "TIME", value_parser = ranges::duration)]
    budget: Option<Duration>,
    /// Search the plane of the table too
    #[arg(long)]
    keep_plane: bool,
}

impl MethodArguments for AutoArguments {
    fn build(self, common: &CommonArguments) -> Result<Box<dyn PoseEstimator>> {
        let members = AutoMembers {
            pix2pose: self.weights.as_deref().map(|weights| (weights, common.object_id)),
            depth: depth_options(self.keep_plane, common),
            seed: common.seed,
            ..AutoMembers::default()
        };
        let mut auto = members.estimator()?;
        auto.budget = self.budget;
        Ok(Box::new(auto))
    }
}

#[derive(Debug, Args)]
struct ViewsArguments {
    /// Network to use instead of the built-in one
    #[arg(long, value_name = "FILE.safetensors")]
    weights: Option<PathBuf>,
    /// Class-agnostic detector that proposes boxes if none is given, instead of the built-in one
    #[arg(long, value_name = "FILE.safetensors")]
    proposals: Option<PathBuf>,
    /// Leave out the last step, which aligns the rendered mesh with the image
    #[arg(long)]
    no_refine: bool,
}

impl MethodArguments for ViewsArguments {
    fn build(self, common: &CommonArguments) -> Result<Box<dyn PoseEstimator>> {
        let mut estimator = match &self.weights {
            Some(file) => ViewsEstimator::load(file).context("--weights")?,
            None => ViewsEstimator::shipped().context("the network within the program")?,
        };
        estimator.options.seed = common.seed;
        estimator.options.outline = !self.no_refine;
        let proposals = match &self.proposals {
            Some(file) => TrainedDetector::load(file).context("--proposals")?.for_proposals(),
            None => TrainedDetector::proposals().context("the detector within the program")?,
        };
        Ok(Box::new(estimator.with_proposals(Arc::new(proposals))))
    }
}

#[derive(Debug, Args)]
struct Pix2PoseArguments {
    /// Weights that `sixfold train pix2pose` wrote (default: the object's own, from `sixfold teach --train`); for mttm and views a
    /// network to use instead of the built-in one
    #[arg(long, value_name = "FILE.safetensors")]
    weights: Option<PathBuf>,
    #[command(flatten)]
    preset: PresetArguments,
    /// Leave out the last steps, which align the rendered mesh with the image and refine the pose
    #[arg(long)]
    no_refine: bool,
    /// Maximum number of passes over an object (default: 1). Each further pass crops the box of the previous pose, which helps with
    /// inaccurate boxes, and takes as long as the first
    #[arg(long, alias = "looks", value_name = "N", value_parser = count::<100>, conflicts_with = "preset")]
    passes: Option<NonZeroUsize>,
    /// Number of boxes from which a pose is estimated, 1 to 5 (default: 1): the given one and copies of it of other sizes. The pose
    /// with which the image agrees best is kept. Takes that many times as long
    #[arg(long, value_name = "N", value_parser = count::<{ MAX_STARTS }>, conflicts_with = "preset")]
    starts: Option<NonZeroUsize>,
    /// Align poses with the depth image (ICP)
    #[arg(long)]
    icp: bool,
}

impl MethodArguments for Pix2PoseArguments {
    fn build(self, common: &CommonArguments) -> Result<Box<dyn PoseEstimator>> {
        let mut own = if self.preset.published() { OwnWeights::published() } else { OwnWeights::default() };
        own.options.estimate.seed = common.seed;
        if let Some(passes) = self.passes {
            own.options.passes = passes.get();
        }
        if let Some(starts) = self.starts {
            own.options.starts = starts.get();
        }
        own.refine &= !self.no_refine;
        own.icp = self.icp;
        if own.refine {
            let refiner = ViewsRefiner::shipped().context("the refiner within the program")?;
            own.refiner = Some(Arc::new(refiner));
        }
        match self.weights {
            Some(file) => Ok(Box::new(own.with(Pix2PoseModel::load(&file)?, common.object_id))),
            None if common.dataset.is_none() && !common.objects.is_empty() => Ok(Box::new(own)),
            None => bail!(
                "--method pix2pose needs --weights FILE.safetensors, which `sixfold train pix2pose` writes, or --object NAME of an \
                 object with weights of its own (`sixfold teach NAME --train`)"
            ),
        }
    }
}

/// The file beside a detector's weights that maps its labels to objects, if there is one.
pub(super) fn objects_file(weights: &Path) -> Option<PathBuf> {
    existing_objects_file(weights)
}

/// The most confident region of the object by a detector, if there is one.
pub(super) fn detected(weights: &Path, image: &RgbImage, id: u32) -> Result<Option<Region>> {
    let detector = TrainedDetector::load(weights)?;
    detector.check_object(id).with_context(|| weights.display().to_string())?;
    Ok(detector.best(image, id)?)
}

/// The regions of the objects `ids` in a dataset by a detector.
pub(super) fn regions(weights: &Path, ids: BTreeSet<u32>) -> Result<RegionSource> {
    let detector = TrainedDetector::load(weights)?.for_dataset();
    let of_detector = RegionSource::of_detector(Box::new(detector), ids);
    of_detector.with_context(|| weights.display().to_string())
}

/// The estimator with a network, if its matcher needs one: from `weights`, or the built-in one.
pub(super) fn with_network(estimator: MttmEstimator, weights: Option<&Path>) -> Result<MttmEstimator> {
    let network = match (estimator.options.matched_by, weights) {
        (MatchedBy::Points, _) => None,
        (_, Some(file)) => Some(MttmModel::load(file).context("--weights")?),
        (_, None) => Some(MttmModel::shipped().context("the network within the program")?),
    };
    Ok(MttmEstimator { network: network.map(Arc::new), ..estimator })
}
