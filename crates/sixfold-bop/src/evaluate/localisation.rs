//! BOP'19: recall of the target poses, by VSD, MSSD and MSPD (Hodaň et al. 2020) and ADD(-S) (Hinterstoisser et al. 2012).

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;
use sixfold_geometry::Progress;
use sixfold_render::VisibilityBuffer;

use super::options::{EvalError, EvalOptions};
use super::recall::{Counts, Scored, average, count, curves};
use super::scores::{Curves, Evaluation, ObjectScores, RecallCurves};
use super::task_errors::{LARGEST_AUC_ERROR, TaskErrors, surface_and_projection, visible_surface};
use super::tasks::{ImageTasks, Mode, Prepared, prepare};
use crate::dataset::BopDataset;
use crate::errors::VsdOptions;
use crate::results::Estimate;
use crate::scene_files::Target;
use crate::score::{area_under_accuracy, fractions_05_to_50, pixels_5_to_50};

/// Mean seconds per image, where every estimate has a time and those of an image agree.
fn average_time(estimates: &[Estimate]) -> Result<f64, String> {
    let mut times: BTreeMap<(u32, u32), f64> = BTreeMap::new();
    for estimate in estimates {
        let (scene, image) = (estimate.scene_id, estimate.im_id);
        let Some(time) = estimate.time else {
            return Err(format!("no time is given for scene {scene}, image {image}"));
        };
        let known = *times.entry((scene, image)).or_insert(time);
        if (known - time).abs() > 1e-3 {
            return Err(format!("the estimates of scene {scene}, image {image} give {known} s and {time} s"));
        }
    }
    if times.is_empty() {
        return Err("there are no estimates".to_owned());
    }
    Ok(times.values().sum::<f64>() / times.len() as f64)
}

/// Why the scores of all targets are missing.
fn why_none(prepared: &Prepared<'_>) -> Option<String> {
    if prepared.wanted() == 0 {
        Some("there is no pose to be found: no target has ground truth".to_owned())
    } else if prepared.unusable.is_empty() {
        None
    } else {
        Some(prepared.unusable.values().cloned().collect::<Vec<_>>().join("; "))
    }
}

/// Why VSD cannot be computed.
fn why_no_vsd(prepared: &Prepared<'_>, options: &EvalOptions) -> Option<String> {
    let Prepared { scenes, objects, images, .. } = prepared;
    let without_depth = images.iter().filter(|i| scenes[&i.scene_id].depth_path(i.im_id).is_none()).count();
    if !options.compute_vsd {
        Some("VSD was not asked for".to_owned())
    } else if without_depth > 0 {
        Some(format!("{without_depth} of {} images with targets have no depth image", images.len()))
    } else {
        objects
            .iter()
            .find(|(_, o)| o.mesh.faces().is_empty())
            .map(|(id, _)| format!("the model of object {id} has no faces and cannot be rendered"))
    }
}

/// The errors of all tasks of an image; VSD errors only if options for VSD are given and the image has depth.
fn errors_of_image<'p, 'a>(
    prepared: &'p Prepared<'a>,
    image: &'p ImageTasks<'a>,
    vsd: Option<&VsdOptions>,
) -> Result<Vec<Scored<'p, 'a>>, EvalError> {
    let scene = &prepared.scenes[&image.scene_id];
    let camera = scene.camera(image.im_id)?;
    let test = if vsd.is_some() { scene.depth(image.im_id)? } else { None };
    let mut frame = test.as_ref().map(|_| VisibilityBuffer::new(&camera));
    let mut scored = Vec::new();
    for task in &image.tasks {
        let Some(object) = prepared.objects.get(&task.obj_id) else { continue };
        let mut errors = surface_and_projection(task, object, &camera, true);
        if let (Some(test), Some(frame), Some(vsd)) = (&test, &mut frame, vsd) {
            errors.vsd = Some(visible_surface(task, object, &camera, test, frame, vsd)?);
        }
        scored.push((task, errors));
    }
    Ok(scored)
}

/// The errors of all tasks.
fn errors_of_all<'p, 'a>(
    prepared: &'p Prepared<'a>,
    vsd: Option<&VsdOptions>,
    progress: &dyn Progress,
) -> Result<Vec<Scored<'p, 'a>>, EvalError> {
    let images = &prepared.images;
    let done = AtomicUsize::new(0);
    let scored: Vec<Vec<Scored<'_, '_>>> = images
        .par_iter()
        .map(|image| {
            let scored = errors_of_image(prepared, image, vsd)?;
            let finished = done.fetch_add(1, Ordering::Relaxed) + 1;
            if progress.report(finished, images.len()) { Ok(scored) } else { Err(EvalError::Stopped) }
        })
        .collect::<Result<_, _>>()?;
    Ok(scored.into_iter().flatten().collect())
}

/// An average recall, overall and by object.
type AverageRecall = (Option<f64>, BTreeMap<u32, f64>);

/// Average recall of VSD over taus and thresholds, and its curve; nothing where a task has no such errors.
fn recall_of_vsd(scored: &[Scored<'_, '_>], options: &EvalOptions) -> (AverageRecall, Option<RecallCurves>) {
    if !scored.iter().all(|(_, e)| e.vsd.is_some()) {
        return ((None, BTreeMap::new()), None);
    }
    let by_tau = |tau: usize, threshold: f64| {
        count(scored, |e| e.vsd.as_ref().map_or(&e.mssd, |v| &v[tau]), threshold)
    };
    let taus = options.vsd.taus.values().len();
    let all: Vec<Counts> = (0..taus)
        .flat_map(|tau| options.vsd_thresholds.iter().map(move |&t| (tau, t)))
        .map(|(a, b)| by_tau(a, b))
        .collect();
    // Poses found and targets are summed over the taus, which gives the mean recall.
    let steps = options.curve_steps;
    let list: Vec<(f64, Counts)> = (0..=steps)
        .map(|i| {
            let threshold = i as f64 / steps as f64;
            let mut sum: BTreeMap<u32, (usize, usize)> = BTreeMap::new();
            for tau in 0..taus {
                for (id, (found, wanted)) in by_tau(tau, threshold).0 {
                    let entry = sum.entry(id).or_default();
                    *entry = (entry.0 + found, entry.1 + wanted);
                }
            }
            (threshold, Counts(sum))
        })
        .collect();
    (average(&all), curves("discrepancy", &list))
}

/// Recall of all errors.
struct Recalls {
    vsd: AverageRecall,
    mssd: AverageRecall,
    mspd: AverageRecall,
    add: Counts,
    curves: Curves,
}

impl Recalls {
    fn of(scored: &[Scored<'_, '_>], options: &EvalOptions, with_vsd: bool) -> Recalls {
        let at = |errors: fn(&TaskErrors) -> &Vec<Vec<f64>>, thresholds: &[f64]| -> Vec<Counts> {
            thresholds.iter().map(|&t| count(scored, errors, t)).collect()
        };
        let steps = options.curve_steps;
        let curve = |errors: fn(&TaskErrors) -> &Vec<Vec<f64>>, unit, largest: f64| {
            let thresholds: Vec<f64> = (0..=steps).map(|i| largest * i as f64 / steps as f64).collect();
            let counts = at(errors, &thresholds);
            curves(unit, &thresholds.into_iter().zip(counts).collect::<Vec<_>>())
        };
        let (vsd, vsd_curve) =
            if with_vsd { recall_of_vsd(scored, options) } else { ((None, BTreeMap::new()), None) };
        Recalls {
            vsd,
            mssd: average(&at(|e| &e.mssd, &fractions_05_to_50())),
            mspd: average(&at(|e| &e.mspd, &pixels_5_to_50())),
            add: count(scored, |e| &e.add, 0.1),
            curves: Curves {
                mssd: curve(|e| &e.mssd, "diameters", 0.5),
                mspd: curve(|e| &e.mspd, "pixels (image 640 wide)", 50.0),
                vsd: vsd_curve,
                add: curve(|e| &e.add, "diameters", 0.2),
            },
        }
    }

    /// The scores of an object with this number of targets.
    fn of_object(&self, id: u32, targets: usize) -> ObjectScores {
        let of = |recall: &AverageRecall| recall.1.get(&id).copied();
        ObjectScores {
            targets,
            ar_vsd: of(&self.vsd),
            ar_mssd: of(&self.mssd),
            ar_mspd: of(&self.mspd),
            add_s_recall: self.add.recall(id),
        }
    }

    /// Recall of ADD(-S), each object counting the same.
    fn add_over_objects<'i>(&self, ids: impl Iterator<Item = &'i u32>) -> Option<f64> {
        let recalls: Vec<f64> = ids.filter_map(|&id| self.add.recall(id)).collect();
        (!recalls.is_empty()).then(|| recalls.iter().sum::<f64>() / recalls.len() as f64)
    }
}

/// Why scores are missing, under their names.
#[derive(Default)]
struct Reasons(BTreeMap<String, String>);

impl Reasons {
    /// The reasons for objects without recall of ADD(-S).
    fn of_objects(prepared: &Prepared<'_>, objects: &BTreeMap<u32, ObjectScores>) -> Reasons {
        let mut reasons = Reasons::default();
        for (id, _) in objects.iter().filter(|(_, scores)| scores.add_s_recall.is_none()) {
            let no_pose = || "no pose of this object is to be found".to_owned();
            let reason = prepared.unusable.get(id).cloned().unwrap_or_else(no_pose);
            reasons.0.insert(format!("add_s_recall.{id}"), reason);
        }
        reasons
    }

    /// Adds the reasons for missing scores over all targets.
    fn add_overall(&mut self, nothing: Option<&String>, no_vsd: Option<&String>, other_protocol: bool) {
        if let Some(reason) = nothing {
            for score in ["ar", "ar_vsd", "ar_mssd", "ar_mspd", "add_s_recall"] {
                self.0.insert(score.to_owned(), reason.clone());
            }
        }
        if let Some(reason) = no_vsd {
            self.0.insert("ar_vsd".to_owned(), reason.clone());
            self.0.entry("ar".to_owned()).or_insert_with(|| format!("needs ar_vsd: {reason}"));
        }
        if other_protocol {
            self.0.entry("ar".to_owned()).or_insert_with(|| "needs VSD as in the BOP Challenge".to_owned());
        }
    }

    /// The score; if there is none, its reason is kept under `name`.
    fn score(&mut self, name: &str, score: Result<f64, String>) -> Option<f64> {
        score.map_err(|reason| self.0.insert(name.to_owned(), reason)).ok()
    }
}

/// Scores estimates on a dataset.
///
/// `targets` as from [`BopDataset::targets`]; targets of whole images are expanded to objects from the ground truth.
/// `progress` is called for every image. The result is the same for any number of threads.
///
/// # Errors
/// [`EvalError`] when an option is out of range or a file of the dataset is broken. Missing data (depth, a model) leaves
/// scores empty, with reasons. [`EvalError::Stopped`] when `progress` asks to stop.
pub fn evaluate(
    dataset: &BopDataset,
    estimates: &[Estimate],
    targets: &[Target],
    options: &EvalOptions,
    progress: &dyn Progress,
) -> Result<Evaluation, EvalError> {
    options.check()?;
    let targets = dataset.object_targets(targets)?;
    let mode = Mode::Localisation { visib_gt_min: options.visib_gt_min };
    let prepared = prepare(dataset, estimates, &targets, &mode, options.models, options.max_symmetry_step)?;
    let (nothing, no_vsd) = (why_none(&prepared), why_no_vsd(&prepared, options));
    let vsd = Some(&options.vsd).filter(|_| no_vsd.is_none());
    let scored = errors_of_all(&prepared, vsd, progress)?;
    let recalls = Recalls::of(&scored, options, no_vsd.is_none());

    let targets_of = prepared.wanted_of_objects();
    let objects: BTreeMap<u32, ObjectScores> =
        targets_of.iter().map(|(&id, &targets)| (id, recalls.of_object(id, targets))).collect();
    let vsd_protocol = options.vsd_protocol();
    let mut reasons = Reasons::of_objects(&prepared, &objects);
    reasons.add_overall(nothing.as_ref(), no_vsd.as_ref(), vsd_protocol.is_some());

    let keep = |value: Option<f64>| value.filter(|_| nothing.is_none());
    let mut add_s_recall: BTreeMap<String, Option<f64>> =
        objects.iter().map(|(id, scores)| (id.to_string(), scores.add_s_recall)).collect();
    add_s_recall.insert("mean".to_owned(), keep(recalls.add.overall()));
    let over_objects = recalls.add_over_objects(targets_of.keys());
    add_s_recall.insert("mean_over_objects".to_owned(), keep(over_objects));
    let (ar_vsd, ar_mssd, ar_mspd) = (keep(recalls.vsd.0), keep(recalls.mssd.0), keep(recalls.mspd.0));
    let ar = match (ar_vsd, ar_mssd, ar_mspd) {
        (Some(a), Some(b), Some(c)) if vsd_protocol.is_none() => Some((a + b + c) / 3.0),
        _ => None,
    };
    let area = |which: usize| -> Option<f64> {
        let errors: Vec<f64> = scored.iter().flat_map(|(_, e)| &e.nearest).map(|n| n[which]).collect();
        keep(area_under_accuracy(&errors, LARGEST_AUC_ERROR))
    };
    let compared: usize = scored.iter().map(|(task, _)| task.estimates.len()).sum();
    Ok(Evaluation {
        ar,
        ar_vsd,
        vsd_protocol,
        ar_mssd,
        ar_mspd,
        add_s_recall,
        add_auc: area(0),
        add_s_auc: area(1),
        average_time_per_image: reasons.score("average_time_per_image", average_time(estimates)),
        reasons: reasons.0,
        targets: prepared.wanted(),
        estimates: compared,
        estimates_left_out: estimates.len() - compared,
        objects: objects.into_iter().map(|(id, scores)| (id.to_string(), scores)).collect(),
        curves: recalls.curves,
    })
}
