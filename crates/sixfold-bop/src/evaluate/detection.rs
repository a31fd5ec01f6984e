//! BOP'24: every instance of every object is a target, and false detections lower the score (AP of MSSD and
//! MSPD).

use std::collections::BTreeMap;

use rayon::prelude::*;

use super::options::{EvalError, EvalOptions};
use super::recall::Scored;
use super::scores::DetectionEvaluation;
use super::task_errors::{TaskErrors, surface_and_projection};
use super::tasks::{Mode, prepare};
use crate::dataset::BopDataset;
use crate::results::Estimate;
use crate::scene_files::Target;
use crate::score::{average_precision, by_falling_score, fractions_05_to_50, greedy_matches, pixels_5_to_50};

/// Scores estimates as 6D detections (BOP Challenge 2024): per image the 100 most confident estimates count;
/// ground truth below 10 % visibility (unknown counts as visible) is ignored.
///
/// # Errors
/// As [`evaluate`](super::evaluate).
pub fn evaluate_detection(
    dataset: &BopDataset,
    estimates: &[Estimate],
    targets: &[Target],
    options: &EvalOptions,
) -> Result<DetectionEvaluation, EvalError> {
    options.check()?;
    let prepared =
        prepare(dataset, estimates, targets, &Mode::Detection, options.models, options.max_symmetry_step)?;
    let minimum = options.visib_gt_min.unwrap_or(0.1);
    let scored: Vec<Vec<Scored<'_, '_>>> = prepared
        .images
        .par_iter()
        .map(|image| -> Result<_, EvalError> {
            let camera = prepared.scenes[&image.scene_id].camera(image.im_id)?;
            let usable = image.tasks.iter().filter_map(|t| Some((t, prepared.objects.get(&t.obj_id)?)));
            Ok(usable.map(|(task, o)| (task, surface_and_projection(task, o, &camera, false))).collect())
        })
        .collect::<Result<_, _>>()?;
    let scored: Vec<Scored<'_, '_>> = scored.into_iter().flatten().collect();
    let mut by_object: BTreeMap<u32, Vec<&Scored<'_, '_>>> = BTreeMap::new();
    for item in &scored {
        by_object.entry(item.0.obj_id).or_default().push(item);
    }
    let precision = |list: &[&Scored<'_, '_>], errors: &dyn Fn(&TaskErrors) -> &Vec<Vec<f64>>, th: f64| {
        let mut positives = 0;
        let mut found: Vec<(f64, bool)> = Vec::new();
        for (task, all) in list {
            positives += task.visible.iter().filter(|v| **v >= minimum).count();
            let matches = greedy_matches(errors(all), &task.valid, th);
            for (estimate, matched) in task.estimates.iter().zip(matches) {
                match matched {
                    Some(g) if task.visible[g] < minimum => {}
                    other => found.push((estimate.score, other.is_some())),
                }
            }
        }
        by_falling_score(&mut found, |f| f.0);
        let right: Vec<bool> = found.into_iter().map(|f| f.1).collect();
        average_precision(&right, positives)
    };
    let mean_over =
        |list: &[&Scored<'_, '_>], errors: &dyn Fn(&TaskErrors) -> &Vec<Vec<f64>>, ths: &[f64]| {
            let all: Option<Vec<f64>> = ths.iter().map(|&th| precision(list, errors, th)).collect();
            all.map(|all| all.iter().sum::<f64>() / all.len() as f64)
        };
    let mut objects = BTreeMap::new();
    let (mut mssd_all, mut mspd_all, mut mm_all) = (Vec::new(), Vec::new(), Vec::new());
    for (&id, list) in &by_object {
        let diameter = prepared.objects[&id].diameter;
        let millimetres: Vec<f64> = (1..=10).map(|i| 2e-3 * f64::from(i) / diameter).collect();
        let mssd = mean_over(list, &|e| &e.mssd, &fractions_05_to_50());
        let mspd = mean_over(list, &|e| &e.mspd, &pixels_5_to_50());
        let mm = mean_over(list, &|e| &e.mssd, &millimetres);
        if let (Some(mssd), Some(mspd), Some(mm)) = (mssd, mspd, mm) {
            mssd_all.push(mssd);
            mspd_all.push(mspd);
            mm_all.push(mm);
            objects.insert(id.to_string(), 0.5 * (mssd + mspd));
        }
    }
    let mut reasons = BTreeMap::new();
    if !prepared.unusable.is_empty() {
        let reason = prepared.unusable.values().cloned().collect::<Vec<_>>().join("; ");
        reasons.insert("ap".to_owned(), reason);
    } else if mssd_all.is_empty() {
        reasons.insert("ap".to_owned(), "no visible ground truth in the target images".to_owned());
    }
    let complete = reasons.is_empty();
    let mean = |all: &[f64]| complete.then(|| all.iter().sum::<f64>() / all.len() as f64);
    let (ap_mssd, ap_mspd) = (mean(&mssd_all), mean(&mspd_all));
    let ap = ap_mssd.zip(ap_mspd).map(|(a, b)| 0.5 * (a + b));
    Ok(DetectionEvaluation { ap, ap_mssd, ap_mspd, ap_mssd_mm: mean(&mm_all), objects, reasons })
}
