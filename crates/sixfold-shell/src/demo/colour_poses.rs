//! Poses from colour in the samples. The regions of the objects come from a detector or, without its weights, from the
//! ground truth.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Result, bail};
use rayon::prelude::*;
use sixfold_bop::{BopDataset, GroundTruth, Target};
use sixfold_data::FrameId;
use sixfold_detect::detector::TrainedDetector;
use sixfold_geometry::Rect;
use sixfold_mesh::Mesh;
use sixfold_pix2pose::estimator::{Pix2PoseEstimator, Pix2PoseObject, Pix2PosePose};
use sixfold_runner::RegionSource;
use sixfold_views::ViewsRefiner;

use super::SamplePose;
use super::colour::Colour;
use super::samples::{Known, add_s};
use super::{DemoFiles, RIGHT};
use crate::overlay::{self, Drawn};
use crate::pictures::Pictures;
use crate::progress::Progress;
use crate::shipped::{DETECTOR, PIX2POSE};
use crate::training::was_trained_on;

pub(super) fn run(
    files: &DemoFiles<'_>,
    out: &mut Pictures,
    dataset: &BopDataset,
    targets: &[Target],
    known: &BTreeMap<u32, Known>,
) -> Result<Colour> {
    let weights = match files.weights.map_or_else(|| PIX2POSE.find(), |file| Ok(file.to_owned())) {
        Ok(weights) => weights,
        Err(error) => return Ok(Colour::none(None, error.to_string())),
    };
    // Weights that the user named must be valid.
    let detector = match files.detector.map(Path::to_owned).or_else(|| DETECTOR.find().ok()) {
        None => None,
        Some(file) => match TrainedDetector::load(&file) {
            Ok(detector) => Some((detector, file)),
            Err(error) if files.detector.is_some() => return Err(error.into()),
            Err(error) => return Ok(Colour::none(Some(weights), crate::describe(&error.into()))),
        },
    };
    let refiner = ViewsRefiner::shipped()?;
    let result = Pix2PoseEstimator::load(&weights)
        .map(|pix2pose| pix2pose.with_refiner(Arc::new(refiner)))
        .map_err(anyhow::Error::from)
        .and_then(|pix2pose| with_model(out, &pix2pose, &weights, detector, dataset, targets, known));
    match result {
        Ok(colour) => Ok(colour),
        Err(error) if files.weights.is_some() => Err(error),
        Err(error) => Ok(Colour::none(Some(weights), crate::describe(&error))),
    }
}

/// The targets' objects in the model; an error unless it was trained on their meshes.
fn objects(
    pix2pose: &Pix2PoseEstimator,
    targets: &[Target],
    known: &BTreeMap<u32, Known>,
) -> Result<BTreeMap<u32, Pix2PoseObject>> {
    let wanted = |id: &u32| targets.iter().any(|t| t.object.is_some_and(|o| o.obj_id == *id));
    let wanted = known.iter().filter(|(id, _)| wanted(id));
    let objects: Result<BTreeMap<u32, Pix2PoseObject>> =
        wanted.map(|(id, k)| Ok((*id, pix2pose.object(&k.object)?))).collect();
    let objects = objects?;
    objects.par_iter().for_each(|(_, object)| pix2pose.prepare_alignment(object));
    Ok(objects)
}

/// A target with the box in which its object is searched.
struct Boxed<'a> {
    id: u32,
    known: &'a Known,
    bbox: Rect,
    truth: &'a GroundTruth,
    mesh: &'a Mesh,
    object: &'a Pix2PoseObject,
}

fn with_model(
    out: &mut Pictures,
    pix2pose: &Pix2PoseEstimator,
    weights: &Path,
    detector: Option<(TrainedDetector, PathBuf)>,
    dataset: &BopDataset,
    targets: &[Target],
    known: &BTreeMap<u32, Known>,
) -> Result<Colour> {
    let objects = objects(pix2pose, targets, known)?;
    let (mut regions, mut detector_card, mut detector_file) = (RegionSource::GroundTruth, None, None);
    if let Some((trained, file)) = detector {
        detector_card = Some(trained.model().card().clone());
        detector_file = Some(file);
        regions = RegionSource::of_detector(Box::new(trained.for_dataset()), known.keys().copied())?;
    }
    let mut colour = Colour {
        weights: Some(weights.to_owned()),
        detector: detector_file,
        reason: None,
        ..Colour::none(None, String::new())
    };
    let mut progress = Progress::new("poses from colour", targets.len());
    for scene_id in dataset.scene_ids() {
        let scene = dataset.scene(scene_id)?;
        for im_id in scene.image_ids() {
            let Some(image) = scene.rgb(im_id)? else { continue };
            let detector = detector_card.as_ref().zip(colour.detector.as_deref());
            for (card, file) in [(pix2pose.model.card(), weights)].into_iter().chain(detector) {
                if was_trained_on(card, file, FrameId { scene_id, im_id })? {
                    bail!("{}: was trained on frame {scene_id}/{im_id} of the samples", file.display());
                }
            }
            let camera = scene.camera(im_id)?;
            let mut boxed = vec![];
            for t in targets.iter().filter(|t| (t.scene_id, t.im_id) == (scene_id, im_id)) {
                let Some((o, k)) = t.object.and_then(|o| Some((o, known.get(&o.obj_id)?))) else { continue };
                colour.targets += 1;
                let found = regions.of_target(&scene, t, &o, |id| known.get(&id).and_then(Known::mesh))?;
                let truth = scene.image(im_id)?.ground_truth.iter().find(|g| g.obj_id == o.obj_id);
                match (found.first(), truth, k.mesh(), objects.get(&o.obj_id)) {
                    (Some(region), Some(truth), Some(mesh), Some(object)) => {
                        boxed.push(Boxed { id: o.obj_id, known: k, bbox: region.bbox, truth, mesh, object });
                    }
                    _ => progress.step(format!("image {im_id}, object {}: no region", o.obj_id)),
                }
            }
            // Several objects at a time: a single pose hardly uses more than one core.
            let found: Vec<Result<Option<(Pix2PosePose, f64)>>> = boxed
                .par_iter()
                .map(|b| {
                    let start = Instant::now();
                    let posed = pix2pose.pose_in_box(&image, &camera, b.object, &b.bbox)?;
                    Ok(posed.map(|posed| (posed, start.elapsed().as_secs_f64())))
                })
                .collect();
            let mut drawn = vec![];
            for (b, found) in boxed.iter().zip(found) {
                progress.step(format!("image {im_id}, object {}", b.id));
                let Some((posed, seconds)) = found? else { continue };
                let error = add_s(b.known, posed.camera_from_object, b.truth);
                colour.poses.push(SamplePose {
                    depth: None,
                    image: format!("{scene_id}/{im_id}"),
                    object: b.id,
                    add_s_mm: 1000.0 * error,
                    add_s_of_diameter: error / b.known.info.diameter,
                    confidence: posed.score,
                    seconds,
                });
                drawn.push(Drawn::of_dataset(b.id, b.mesh, posed.camera_from_object, posed.score));
            }
            let picture = overlay::draw(&image, &camera, &drawn);
            colour.pictures.extend(out.write(&format!("{scene_id:06}_{im_id:06}_colour.png"), &picture));
        }
    }
    progress.finish();
    colour.correct = colour.poses.iter().filter(|r| r.add_s_of_diameter < RIGHT).count();
    if colour.targets == 0 {
        colour.reason = Some("the samples have no colour images".into());
    }
    Ok(colour)
}
