//! Refines poses that another method found in a colour image.

use std::sync::Arc;

use burn::tensor::Device;
use sixfold_align::outline::{outline_mesh, projected_box};
use sixfold_estimator::{EstimatorError, PoseRefiner, RefinedObject, RefinedPose};
use sixfold_geometry::{Camera, Pose, RgbImage};
use sixfold_mesh::Mesh;

use crate::error::ViewsError;
use crate::estimate::{Hypothesis, Views, ViewsOptions};
use crate::features::Extractor;
use crate::refiner::Refiner;
use crate::refiner::network::RefinerNetwork;
use crate::templates::view_mesh;

/// Refines poses of any object with a mesh, by the networks that refine those of
/// [`ViewsEstimator`](crate::estimator::ViewsEstimator).
#[derive(Clone)]
pub struct ViewsRefiner {
    extractor: Arc<Extractor>,
    refiner: Arc<Refiner>,
    /// Those for a pose that is known already: side of the crop, iterations, alignment of the outline.
    pub options: ViewsOptions,
}

impl ViewsRefiner {
    /// With the shipped networks.
    ///
    /// # Errors
    /// [`ViewsError::Weights`].
    pub fn shipped() -> Result<ViewsRefiner, ViewsError> {
        let device = Device::default();
        let refiner = Arc::new(Refiner::new(RefinerNetwork::shipped(&device)?, device));
        Ok(ViewsRefiner {
            extractor: Arc::new(Extractor::shipped()?),
            refiner,
            options: ViewsOptions { outline: false, ..ViewsOptions::default() },
        })
    }
}

impl PoseRefiner for ViewsRefiner {
    fn object(&self, mesh: &Mesh) -> Arc<dyn RefinedObject> {
        Arc::new(Refined { by: self.clone(), view: view_mesh(mesh), outline: outline_mesh(mesh) })
    }
}

struct Refined {
    by: ViewsRefiner,
    view: Mesh,
    outline: Mesh,
}

impl RefinedObject for Refined {
    fn refine(
        &self,
        image: &RgbImage,
        camera: &Camera,
        camera_from_object: &Pose,
    ) -> Result<Option<RefinedPose>, EstimatorError> {
        let Some(bbox) = projected_box(&self.outline, camera, camera_from_object) else { return Ok(None) };
        let views = Views {
            extractor: &self.by.extractor,
            mesh: &self.view,
            outline: &self.outline,
            templates: &[],
            refiner: Some(&self.by.refiner),
            options: &self.by.options,
        };
        let start = Hypothesis { camera_from_object: *camera_from_object, similarity: 0.0, inliers: 0 };
        let refined = views.closer(start, image, camera, &bbox).map_err(EstimatorError::method)?;
        let (camera_from_object, agreement) = (refined.camera_from_object, refined.similarity);
        Ok((agreement > 0.0).then_some(RefinedPose { camera_from_object, agreement }))
    }
}
