//! Pix2Pose as the commands use it: model, options and refinement in one.

use anyhow::{Result, anyhow};
use sixfold_geometry::{Camera, Pose, Rect, RgbImage};
use sixfold_mesh::Mesh;
use sixfold_pix2pose::estimate::{EstimateOptions, Found, estimate};
use sixfold_pix2pose::model::Pix2PoseModel;
use sixfold_pix2pose::refine::{RefineOptions, refine};

use crate::arguments::EstimateArguments;

/// A model ready to be used.
pub(crate) struct Pix2Pose {
    model: Pix2PoseModel,
    options: EstimateOptions,
    refine: Option<RefineOptions>,
}

/// A pose with its score and what it came from.
pub(crate) struct Pix2PosePose {
    pub camera_from_object: Pose,
    pub score: f64,
    pub found: Found,
}

impl Pix2Pose {
    pub fn new(a: &EstimateArguments) -> Result<Pix2Pose> {
        let weights = a
            .weights
            .as_deref()
            .ok_or_else(|| anyhow!("--method pix2pose needs --weights FILE.safetensors, which `sixfold train pix2pose` writes"))?;
        let model = Pix2PoseModel::load(weights)?;
        let options = EstimateOptions { seed: a.seed, ..EstimateOptions::default() };
        Ok(Pix2Pose { model, options, refine: a.refines().then(RefineOptions::default) })
    }

    /// The best pose of an object in a box of a pinhole image, `None` if it is not seen there.
    pub fn estimate(
        &self,
        image: &RgbImage,
        camera: &Camera,
        object_id: u32,
        region: &Rect,
        mesh: &Mesh,
    ) -> Result<Option<Pix2PosePose>> {
        let Some(found) = estimate(&self.model, image, camera, object_id, region, &self.options)? else {
            return Ok(None);
        };
        let Some(best) = found.hypotheses.first() else { return Ok(None) };
        let camera_from_object = match &self.refine {
            Some(options) => refine(image, camera, mesh, &found, options).camera_from_object,
            None => best.camera_from_object,
        };
        Ok(Some(Pix2PosePose { camera_from_object, score: best.score, found }))
    }
}
