//! Refines poses that another method found in a colour image.

use std::sync::Arc;

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
use sixfold_nn::device;

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
        let device = device::chosen();
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
            printed: None,
            refiner: Some(&self.by.refiner),
            options: &self.by.options,
        };
        let start =
            Hypothesis { camera_from_object: *camera_from_object, similarity: 0.0, inliers: 0, drawn: 0.0 };
        let refined = views.closer(start, image, camera, &bbox).map_err(EstimatorError::method)?;
        let (camera_from_object, agreement) = (refined.camera_from_object, refined.similarity);
        Ok((agreement > 0.0).then_some(RefinedPose { camera_from_object, agreement }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::tests::{part, photographed};
    use sixfold_geometry::Vec3;

    #[test]
    fn poses_of_another_method_move_to_the_image() {
        let camera = Camera::new(570.0, 570.0, 320.0, 240.0, 640, 480).unwrap();
        let (image, truth, _) = photographed(&camera);
        let object = ViewsRefiner::shipped().unwrap().object(&part());
        let error = |pose: &Pose| [pose.distance_to(&truth), pose.rotation_angle_to(&truth).to_degrees()];
        let near = truth * Pose::exp(&[0.004, -0.003, 0.03, 0.08, -0.1, 0.06].into());
        let refined = object.refine(&image, &camera, &near).unwrap().unwrap();
        let (before, after) = (error(&near), error(&refined.camera_from_object));
        assert!(after[0] < 0.5 * before[0] && after[1] < 0.5 * before[1], "{before:?} {after:?}");
        let there = object.refine(&image, &camera, &truth).unwrap().unwrap();
        assert!(there.agreement > 0.5, "{}", there.agreement);
        let behind = truth.with_translation(Vec3::new(0.0, 0.0, -1.0));
        assert_eq!(object.refine(&image, &camera, &behind).unwrap(), None);
    }
}
