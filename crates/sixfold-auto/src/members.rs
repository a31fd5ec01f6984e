//! Collects all methods of the program for `auto`.

use std::path::Path;
use std::sync::Arc;

use sixfold_align::DepthOptions;
use sixfold_detect::detector::TrainedDetector;
use sixfold_estimator::{EstimatorError, PoseEstimator};
use sixfold_mttm::model::MttmModel;
use sixfold_mttm::{MttmEstimator, MttmOptions};
use sixfold_pix2pose::model::Pix2PoseModel;
use sixfold_pix2pose::own_weights::OwnWeights;
use sixfold_ppf::PpfEstimator;
use sixfold_views::ViewsRefiner;
use sixfold_views::estimator::ViewsEstimator;

use crate::estimator::AutoEstimator;

/// Which methods are included.
#[derive(Debug, Clone, Copy, Default)]
pub struct AutoMembers<'a> {
    /// A trained model of Pix2Pose, and the number of its object, for objects that do not give one; `None`: the weights that an
    /// object has of its own, if it has any.
    pub pix2pose: Option<(&'a Path, Option<u32>)>,
    /// An object's own weights are preferred to the trained model.
    pub own_weights_first: bool,
    /// Leave out the views in colour.
    pub without_views: bool,
    /// How depth images are prepared.
    pub depth: DepthOptions,
    /// Seed of everything random.
    pub seed: u64,
}

impl AutoMembers<'_> {
    /// The method `auto` over point pair features, templates, Pix2Pose for what it was trained on, and views.
    ///
    /// # Errors
    /// [`EstimatorError::Method`] if the file of Pix2Pose is not such a model, or a shipped network cannot be read (never if the
    /// tests pass).
    pub fn estimator(&self) -> Result<AutoEstimator, EstimatorError> {
        let network = MttmModel::shipped().map_err(EstimatorError::method)?;
        let ppf = PpfEstimator { depth: self.depth, ..PpfEstimator::default() };
        let mttm = MttmEstimator {
            depth: self.depth,
            options: MttmOptions::default(),
            network: Some(Arc::new(network)),
            ..MttmEstimator::default()
        };
        let mut members: Vec<Arc<dyn PoseEstimator>> = vec![Arc::new(ppf), Arc::new(mttm)];
        let mut own = OwnWeights::default();
        own.options.estimate.seed = self.seed;
        own.refiner = Some(Arc::new(ViewsRefiner::shipped().map_err(EstimatorError::method)?));
        let model = self.pix2pose.map(|(file, _)| Pix2PoseModel::load(file));
        let model = model.transpose().map_err(EstimatorError::method)?;
        members.push(match (model, self.pix2pose) {
            (Some(model), Some((_, object_id))) if !self.own_weights_first => {
                Arc::new(own.with(model, object_id))
            }
            (others, _) => Arc::new(OwnWeights { others, ..own }),
        });
        if !self.without_views {
            let mut views = ViewsEstimator::shipped().map_err(EstimatorError::method)?;
            views.options.seed = self.seed;
            let proposals = TrainedDetector::proposals().map_err(EstimatorError::method)?;
            members.push(Arc::new(views.with_proposals(Arc::new(proposals))));
        }
        let mut auto = AutoEstimator::new(members).map_err(EstimatorError::method)?;
        auto.depth = self.depth;
        Ok(auto)
    }
}
