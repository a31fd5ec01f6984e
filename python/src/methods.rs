//! The methods of `Estimator`: their names and options, and how estimators are made from them, as in `sixfold estimate`.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use pyo3::prelude::*;
use sixfold::align::DepthOptions;
use sixfold::auto::AutoMembers;
use sixfold::detect::detector::TrainedDetector;
use sixfold::estimator::PoseEstimator;
use sixfold::mttm::{MatchedBy, MttmEstimator, MttmOptions};
use sixfold::pix2pose::estimator::Pix2PoseEstimator;
use sixfold::ppf::PpfEstimator;
use sixfold::runner::RunOptions;
use sixfold::views::ViewsRefiner;
use sixfold::views::estimator::ViewsEstimator;

use crate::arrays::bad;
use crate::guard::interruptible;
use crate::mttm::{coverage, matched_by, network};
use crate::training::file_or_value;

/// The methods' options as given.
pub(crate) struct Options {
    pub weights: Option<PathBuf>,
    pub keep_plane: bool,
    pub matcher: String,
    pub templates_only: bool,
    pub templates: Option<String>,
    pub refine: bool,
    pub passes: Option<usize>,
    pub starts: Option<usize>,
    pub icp: bool,
    pub budget: Option<f64>,
    pub seed: u64,
}

/// Each method with its own options, besides the seed.
const METHODS: [(&str, &[&str]); 5] = [
    ("ppf", &["keep_plane"]),
    ("mttm", &["keep_plane", "weights", "matcher", "templates_only", "templates"]),
    ("pix2pose", &["weights", "refine", "passes", "starts", "icp"]),
    ("views", &["weights", "refine"]),
    ("auto", &["weights", "keep_plane", "budget"]),
];

/// The default of `matcher`.
const BOTH: &str = "both";

impl Options {
    /// The options that differ from their defaults: names and values.
    fn given(&self) -> Vec<(&'static str, String)> {
        let all = [
            ("weights", self.weights.as_ref().map(|w| w.display().to_string())),
            ("keep_plane", self.keep_plane.then(|| "True".to_owned())),
            ("matcher", (self.matcher != BOTH).then(|| self.matcher.clone())),
            ("templates_only", self.templates_only.then(|| "True".to_owned())),
            ("templates", self.templates.clone()),
            ("refine", (!self.refine).then(|| "False".to_owned())),
            ("passes", self.passes.map(|p| p.to_string())),
            ("starts", self.starts.map(|s| s.to_string())),
            ("icp", self.icp.then(|| "True".to_owned())),
            ("budget", self.budget.map(|b| b.to_string())),
        ];
        all.into_iter().filter_map(|(name, value)| Some((name, value?))).collect()
    }

    /// Checks that the method exists and has every given option; returns its name.
    pub fn check(&self, method: &str) -> PyResult<&'static str> {
        let names = || METHODS.map(|(name, _)| format!("{name:?}")).join(" or ");
        let known = METHODS.iter().find(|(name, _)| *name == method);
        let (method, own) = known.ok_or_else(|| bad("method", names(), format!("{method:?}")))?;
        for (option, value) in self.given() {
            if !own.contains(&option) {
                let users = METHODS.iter().filter(|(_, own)| own.contains(&option));
                let users = users.map(|(name, _)| format!("{name:?}")).collect::<Vec<_>>().join(" and ");
                let expected = format!("its default: it is an option of {users}, not of {method:?}");
                return Err(bad(option, expected, value));
            }
        }
        Ok(method)
    }

    /// The options that are recorded with a run over a dataset; it resumes only with the same ones.
    pub fn record(&self) -> RunOptions {
        let mut record = RunOptions::default();
        for (name, value) in self.given() {
            record.add(name, &value);
        }
        record.add("seed", &self.seed.to_string());
        record
    }
}

/// A method's estimator, and the ids of the objects that its weights contain.
pub(crate) type Made = (Arc<dyn PoseEstimator>, Vec<u32>);

pub(crate) fn make(py: Python<'_>, method: &str, options: &Options) -> PyResult<Made> {
    let depth =
        DepthOptions { remove_plane: !options.keep_plane, seed: options.seed, ..DepthOptions::default() };
    let weights = options.weights.clone();
    Ok(match method {
        "ppf" => (Arc::new(PpfEstimator { depth, ..PpfEstimator::default() }), vec![]),
        "mttm" => {
            let matched_by = matched_by(&options.matcher)?;
            let network = match (matched_by, weights) {
                (MatchedBy::Points, None) => None,
                (MatchedBy::Points, Some(file)) => {
                    return Err(bad("weights", "None with matcher=\"points\"", file.display().to_string()));
                }
                (_, weights) => {
                    let read = interruptible(py, move |_| network(weights))?;
                    Some(read.map_err(|error| file_or_value(&error))?)
                }
            };
            let estimator = MttmEstimator {
                depth,
                options: MttmOptions { matched_by, ..MttmOptions::default() },
                network,
                templates_only: options.templates_only,
                coverage: options.templates.as_deref().map(|c| coverage("templates", c)).transpose()?,
                ..MttmEstimator::default()
            };
            (Arc::new(estimator), vec![])
        }
        "auto" => {
            let budget = options.budget.map(|b| Duration::try_from_secs_f64(b).ok().filter(|b| !b.is_zero()));
            let budget = match budget {
                Some(None) => {
                    let found = options.budget.map(|b| b.to_string()).unwrap_or_default();
                    return Err(bad("budget", "seconds above 0", found));
                }
                given => given.flatten(),
            };
            let seed = options.seed;
            let made = interruptible(py, move |_| {
                let pix2pose = weights.as_deref().map(|weights| (weights, None));
                AutoMembers { pix2pose, depth, seed, ..AutoMembers::default() }.estimator()
            })?;
            let mut estimator = made.map_err(|error| file_or_value(&error))?;
            estimator.budget = budget;
            (Arc::new(estimator), vec![])
        }
        "views" => {
            let read = interruptible(py, move |_| match weights {
                Some(file) => ViewsEstimator::load(&file),
                None => ViewsEstimator::shipped(),
            })?;
            let mut estimator = read.map_err(|error| file_or_value(&error))?;
            estimator.options.seed = options.seed;
            estimator.options.outline = options.refine;
            let proposals = interruptible(py, |_| TrainedDetector::proposals())?;
            let proposals = proposals.map_err(|error| file_or_value(&error))?;
            (Arc::new(estimator.with_proposals(Arc::new(proposals))), vec![])
        }
        _ => {
            let weights = weights.ok_or_else(|| {
                bad("weights", "a file that train_pix2pose or `sixfold train pix2pose` wrote", "None")
            })?;
            let read = interruptible(py, move |_| Pix2PoseEstimator::load(&weights))?;
            let mut estimator = read.map_err(|error| file_or_value(&error))?;
            estimator.options.estimate.seed = options.seed;
            if let Some(passes) = options.passes {
                estimator.options.passes = passes;
            }
            if let Some(starts) = options.starts {
                estimator.options.starts = starts;
            }
            estimator.refine = options.refine;
            let refiner = interruptible(py, |_| ViewsRefiner::shipped())?.map_err(|e| file_or_value(&e))?;
            let mut estimator = estimator.with_refiner(Arc::new(refiner));
            estimator.icp = options.icp;
            let ids = estimator.model.objects().iter().map(|o| o.id).collect();
            (Arc::new(estimator), ids)
        }
    })
}
