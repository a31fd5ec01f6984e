//! Recall: the fraction of target poses that are found, at one threshold and averaged over several.

use std::collections::BTreeMap;

use super::scores::RecallCurves;
use super::task_errors::TaskErrors;
use super::tasks::Task;
use crate::score::greedy_matches;

/// Recall at a threshold: the numbers of found poses and of targets per object.
pub(super) struct Counts(pub BTreeMap<u32, (usize, usize)>);

impl Counts {
    pub(super) fn recall(&self, obj_id: u32) -> Option<f64> {
        let &(found, wanted) = self.0.get(&obj_id)?;
        (wanted > 0).then(|| found as f64 / wanted as f64)
    }

    pub(super) fn overall(&self) -> Option<f64> {
        let (found, wanted) = self.0.values().fold((0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        (wanted > 0).then(|| found as f64 / wanted as f64)
    }
}

pub(super) type Scored<'p, 'a> = (&'p Task<'a>, TaskErrors);

pub(super) fn count(
    scored: &[Scored<'_, '_>],
    errors: impl Fn(&TaskErrors) -> &Vec<Vec<f64>>,
    threshold: f64,
) -> Counts {
    let mut counts = BTreeMap::new();
    for (task, all) in scored {
        let found = greedy_matches(errors(all), &task.valid, threshold).into_iter().flatten().count();
        let wanted = task.wanted();
        let entry = counts.entry(task.obj_id).or_insert((0, 0));
        entry.0 += found;
        entry.1 += wanted;
    }
    Counts(counts)
}

/// Mean recall over thresholds, overall and per object.
pub(super) fn average(list: &[Counts]) -> (Option<f64>, BTreeMap<u32, f64>) {
    let mean = |values: Vec<Option<f64>>| -> Option<f64> {
        let n = values.len();
        values.into_iter().sum::<Option<f64>>().filter(|_| n > 0).map(|sum| sum / n as f64)
    };
    let overall = mean(list.iter().map(Counts::overall).collect());
    let ids = list.first().map(|c| c.0.keys().copied().collect::<Vec<_>>()).unwrap_or_default();
    let of = |id: u32| mean(list.iter().map(|c| c.recall(id)).collect());
    (overall, ids.into_iter().filter_map(|id| Some((id, of(id)?))).collect())
}

pub(super) fn curves(unit: &'static str, list: &[(f64, Counts)]) -> Option<RecallCurves> {
    let mean: Option<Vec<f64>> = list.iter().map(|(_, c)| c.overall()).collect();
    let ids: Vec<u32> = list.first()?.1.0.keys().copied().collect();
    let of = |id: u32| list.iter().map(|(_, c)| c.recall(id)).collect::<Option<Vec<f64>>>();
    Some(RecallCurves {
        unit,
        thresholds: list.iter().map(|(t, _)| *t).collect(),
        objects: ids.into_iter().filter_map(|id| Some((id.to_string(), of(id)?))).collect(),
        mean: mean?,
    })
}
