//! Where in an image a target is looked for: ground truth's boxes, a file of detections, or anywhere.

use std::path::Path;

use anyhow::Result;
use sixfold_bop::{
    Adjustment, BopDataset, Detection, ReadDetections, Scene, Target, TargetObject, ground_truth_visibility,
    read_detections,
};
use sixfold_geometry::Rect;
use sixfold_mesh::Mesh;

/// Where targets are looked for.
pub(crate) enum Boxes {
    Anywhere,
    GroundTruth,
    Detections(Vec<Detection>),
}

impl Boxes {
    /// The detections of a file, and what was left out of them.
    pub fn read(dataset: &BopDataset, file: &Path) -> Result<(Boxes, Vec<String>)> {
        let options = ReadDetections { image_size: dataset.image_size(), ..ReadDetections::default() };
        let read = read_detections(file, &options)?;
        let mut skipped = vec![];
        for changed in read.adjusted {
            match changed.adjustment {
                Adjustment::Clipped => eprintln!("note: {}", changed.message),
                _ => skipped.push(changed.message),
            }
        }
        Ok((Boxes::Detections(read.detections), skipped))
    }

    /// Boxes of a target with their scores: detections best first, as many as there are instances, or the ground
    /// truth's.
    pub fn of_target<'m>(
        &self,
        scene: &Scene,
        target: &Target,
        object: &TargetObject,
        mesh_of: impl Fn(u32) -> Option<&'m Mesh>,
    ) -> Result<Vec<(Rect, f64)>> {
        Ok(match self {
            Boxes::Anywhere => vec![],
            Boxes::GroundTruth => ground_truth_boxes(scene, target.im_id, object.obj_id, mesh_of)?
                .into_iter()
                .map(|region| (region, 1.0))
                .collect(),
            Boxes::Detections(all) => {
                let mut mine: Vec<&Detection> = all
                    .iter()
                    .filter(|d| {
                        (d.scene_id, d.image_id, d.category_id)
                            == (target.scene_id, target.im_id, object.obj_id)
                    })
                    .collect();
                mine.sort_by(|x, y| y.score.total_cmp(&x.score));
                mine.iter().take(object.inst_count).filter_map(|d| Some((d.bbox?, d.score))).collect()
            }
        })
    }
}

/// The visible boxes of an object's instances: from `scene_gt_info.json`, or rendered.
fn ground_truth_boxes<'m>(
    scene: &Scene,
    im_id: u32,
    obj_id: u32,
    mesh_of: impl Fn(u32) -> Option<&'m Mesh>,
) -> Result<Vec<Rect>> {
    let image = scene.image(im_id)?;
    if let Some(info) = &image.info {
        return Ok(image
            .ground_truth
            .iter()
            .zip(info)
            .filter(|(g, _)| g.obj_id == obj_id)
            .filter_map(|(_, i)| i.bbox_visib)
            .collect());
    }
    let objects: Vec<_> = image
        .ground_truth
        .iter()
        .filter_map(|g| Some((g.obj_id, mesh_of(g.obj_id)?, g.camera_from_object)))
        .collect();
    let meshes: Vec<_> = objects.iter().map(|(_, mesh, pose)| (*mesh, *pose)).collect();
    let depth = scene.depth(im_id)?;
    let visible = ground_truth_visibility(&meshes, &scene.camera(im_id)?, depth.as_ref(), 0.015);
    Ok(objects
        .iter()
        .zip(visible)
        .filter(|((id, ..), _)| *id == obj_id)
        .filter_map(|(_, v)| v.info.bbox_visib)
        .collect())
}
