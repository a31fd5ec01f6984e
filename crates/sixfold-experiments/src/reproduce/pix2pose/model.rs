//! A trained model with its objects, for the rows of the table.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::Result;
use sixfold_estimator::Object;
use sixfold_geometry::{Camera, Rect, RgbImage};
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_pix2pose::aligned::AlignOptions;
use sixfold_pix2pose::estimator::{Pix2PoseEstimator, Pix2PoseObject, Pix2PosePose};
use sixfold_pix2pose::model::Pix2PoseModel;
use sixfold_views::ViewsRefiner;

/// A model with options, and its objects, prepared when first needed.
#[derive(Clone)]
pub(super) struct Pix2Pose {
    estimator: Pix2PoseEstimator,
    objects: Arc<Mutex<BTreeMap<u32, Arc<Pix2PoseObject>>>>,
}

impl Pix2Pose {
    /// The model of a weight file with the default options.
    pub fn load(weights: &Path) -> Result<Pix2Pose> {
        let estimator = Pix2PoseEstimator::load(weights)?.with_refiner(Arc::new(ViewsRefiner::shipped()?));
        Ok(Pix2Pose { estimator, objects: Arc::default() })
    }

    /// The same model with other options.
    pub fn varied(&self, options: AlignOptions, refine: bool) -> Pix2Pose {
        let estimator = Pix2PoseEstimator { options, refine, ..self.estimator.clone() };
        Pix2Pose { estimator, objects: self.objects.clone() }
    }

    /// The network.
    pub fn model(&self) -> &Pix2PoseModel {
        &self.estimator.model
    }

    /// An error unless the mesh matches the model's object `id`: the same position and size in its frame.
    pub fn check_mesh(&self, id: u32, mesh: &Mesh, name: &str) -> Result<()> {
        self.object(id, mesh, name).map(|_| ())
    }

    fn object(&self, id: u32, mesh: &Mesh, name: &str) -> Result<Arc<Pix2PoseObject>> {
        let mut objects = self.objects.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(object) = objects.get(&id) {
            return Ok(object.clone());
        }
        let object = Object::of_mesh(name, mesh.clone(), ModelInfo::of_mesh(mesh));
        let object = Arc::new(self.estimator.object(&Object { id: Some(id), ..object })?);
        objects.insert(id, object.clone());
        Ok(object)
    }

    /// The best pose of an object in a box of a pinhole image.
    pub fn estimate(
        &self,
        image: &RgbImage,
        camera: &Camera,
        object_id: u32,
        bbox: &Rect,
        mesh: &Mesh,
    ) -> Result<Option<Pix2PosePose>> {
        let object = self.object(object_id, mesh, &format!("object {object_id}"))?;
        Ok(self.estimator.pose_in_box(image, camera, &object, bbox)?)
    }
}
