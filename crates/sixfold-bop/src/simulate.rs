//! Simulated depth images for a dataset that has poses but no depth.

use std::collections::BTreeMap;

use sixfold_geometry::Pose;
use sixfold_mesh::Mesh;
use sixfold_render::{DepthOnTable, DepthSensor, depth_on_table};

use crate::{
    BopDataset, DatasetError, Models, NewImage, Scene, SceneWriter, VISIBILITY_DELTA, ground_truth_visibility,
};

/// Simulates the depth of a dataset's images, one after the other.
pub struct DepthSimulation<'a> {
    /// The dataset with ground truth.
    pub dataset: &'a BopDataset,
    /// The depth camera; `None` for an ideal one.
    pub sensor: Option<DepthSensor>,
    /// Whether a table is added under the objects where a plane fits.
    pub with_table: bool,
    /// Whether colour images are copied.
    pub with_rgb: bool,
    /// Seed of the noise.
    pub seed: u64,
    meshes: BTreeMap<u32, Mesh>,
}

impl<'a> DepthSimulation<'a> {
    /// A simulation with an ideal camera and a table, without colour images.
    pub fn new(dataset: &'a BopDataset) -> Self {
        DepthSimulation {
            dataset,
            sensor: None,
            with_table: true,
            with_rgb: false,
            seed: 0,
            meshes: BTreeMap::new(),
        }
    }

    /// Simulates one image and gives it to `writer`, with its ground truth and the visibility in the new depth.
    ///
    /// # Errors
    /// When a file of the dataset cannot be read, or the new one not be written.
    pub fn image(
        &mut self,
        scene: &Scene,
        im_id: u32,
        writer: &mut SceneWriter,
    ) -> Result<DepthOnTable, DatasetError> {
        let image = scene.image(im_id)?;
        for g in &image.ground_truth {
            if let std::collections::btree_map::Entry::Vacant(place) = self.meshes.entry(g.obj_id) {
                place.insert(self.dataset.model(g.obj_id, Models::Rendering)?);
            }
        }
        let camera = scene.camera(im_id)?;
        let posed: Vec<(&Mesh, Pose)> =
            image.ground_truth.iter().map(|g| (&self.meshes[&g.obj_id], g.camera_from_object)).collect();
        let seed = self.seed ^ (u64::from(scene.scene_id) << 32 | u64::from(im_id));
        let seen = depth_on_table(&posed, &camera, self.with_table, self.sensor.as_ref().map(|s| (s, seed)));
        let visible = ground_truth_visibility(&posed, &camera, Some(&seen.measured), VISIBILITY_DELTA);
        let infos: Vec<_> = visible.into_iter().map(|v| v.info).collect();
        let rgb = if self.with_rgb { scene.rgb(im_id)? } else { None };
        writer.add(&NewImage {
            depth: Some(&seen.measured),
            rgb: rgb.as_ref(),
            ground_truth: &image.ground_truth,
            info: Some(&infos),
            ..NewImage::new(im_id, &camera)
        })?;
        Ok(seen)
    }
}
