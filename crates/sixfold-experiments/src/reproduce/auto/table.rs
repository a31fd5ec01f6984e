//! Statistics of all searches: the calibration error of their probabilities (Naeini et al. 2015), and what exact probabilities would have
//! (consistency resampling, Bröcker and Smith 2007).

use std::fmt::Write;

use rand::RngExt;
use serde::Serialize;
use sixfold_geometry::random::stream;

use super::{Given, Search};

/// Bins of the reliability diagram.
const BINS: usize = 10;
/// Poses of at least this probability are reported.
pub(super) const REPORTED: f64 = 0.5;
/// Draws for [`Row::error_by_chance`].
const DRAWS: u64 = 1000;

/// One bin of a reliability diagram.
#[derive(Debug, Clone, Copy, Default, Serialize, PartialEq)]
pub(super) struct Bin {
    /// Poses in it.
    pub poses: usize,
    /// Their mean probability.
    pub probability: f64,
    /// The fraction of them that is right.
    pub right: f64,
}

/// Statistics of the searches with the same kind of images.
#[derive(Debug, Serialize)]
pub(super) struct Row {
    pub given: Given,
    /// Objects searched in images that show them.
    pub present: usize,
    /// Fraction of these whose best pose is right.
    pub found: f64,
    /// Objects searched in images that do not show them.
    pub absent: usize,
    /// By the probabilities of the best poses.
    #[serde(flatten)]
    pub single: Fractions,
    /// By the probabilities of the best poses together with their alternatives, as `sixfold estimate` reports them; right if one of them is.
    pub together: Fractions,
    /// The same when the objects of an image are searched at once, as by `sixfold estimate` with all of them: a pose most of whose pixels
    /// belong to a more probable one is not reported.
    pub at_once: Fractions,
    /// Expected calibration error of the best poses (Naeini et al. 2015, ten bins).
    pub expected_error: f64,
    /// The same for exact probabilities: the mean over random draws in which each of these poses is right with its probability. It is
    /// above 0 because a bin of few poses does not hold the expected number of right ones; a measured error like it shows no
    /// miscalibration.
    pub error_by_chance: f64,
    /// Area under the ROC curve of the best poses.
    pub auc: f64,
    /// Mean seconds per search.
    pub seconds: f64,
    pub bins: Vec<Bin>,
}

/// What is reported with a probability of at least [`REPORTED`].
#[derive(Debug, PartialEq, Serialize)]
pub(super) struct Fractions {
    /// Fraction of the right poses that is reported.
    pub kept: f64,
    /// Fraction of right poses among those reported.
    pub precision: f64,
    /// Fraction of absent objects that are reported.
    pub accepted: f64,
}

/// All rows.
#[derive(Debug, Serialize)]
pub(super) struct Whole {
    pub rows: Vec<Row>,
}

impl Whole {
    pub fn of(searches: &[Search]) -> Whole {
        Whole { rows: Given::ALL.into_iter().filter_map(|given| row(given, searches)).collect() }
    }
}

fn row(given: Given, searches: &[Search]) -> Option<Row> {
    let of: Vec<&Search> = searches.iter().filter(|s| s.given == given).collect();
    if of.is_empty() {
        return None;
    }
    let fraction = |a: usize, b: usize| if b == 0 { 0.0 } else { a as f64 / b as f64 };
    // The best pose of each search: its probability and whether it is right.
    let judged = |s: &Search| s.poses.first().map(|p| (s.present, p.probability, p.right));
    let best: Vec<(bool, f64, bool)> = of.iter().filter_map(|s| judged(s)).collect();
    let present = of.iter().filter(|s| s.present).count();
    let absent = of.len() - present;
    // Which fraction of the right poses is among these, which fraction of these is right, and which of the absent objects has one.
    let fractions = |poses: &[(bool, f64, bool)], right: usize| {
        let reported = poses.iter().filter(|(_, p, _)| *p >= REPORTED);
        let reported_right = reported.clone().filter(|(_, _, right)| *right).count();
        let accepted = reported.clone().filter(|(there, _, _)| !there).count();
        let (kept, precision) = (fraction(reported_right, right), fraction(reported_right, reported.count()));
        Fractions { kept, precision, accepted: fraction(accepted, absent) }
    };
    let count = |poses: &[(bool, f64, bool)]| poses.iter().filter(|(_, _, right)| *right).count();
    let right = count(&best);
    let with_others = |s: &Search| s.together.map(|t| (s.present, t.probability, t.right));
    let together: Vec<(bool, f64, bool)> = of.iter().filter_map(|s| with_others(s)).collect();
    let left: Vec<(bool, f64, bool)> =
        of.iter().filter(|s| !s.overruled).filter_map(|s| with_others(s)).collect();
    let bins = binned(best.iter().map(|(_, p, right)| (*p, *right)));
    let drawn = |draw: u64| {
        let mut random = stream(0, draw);
        error(&binned(best.iter().map(|(_, p, _)| (*p, random.random::<f64>() < *p))))
    };
    Some(Row {
        given,
        present,
        found: fraction(right, present),
        absent,
        single: fractions(&best, right),
        together: fractions(&together, count(&together)),
        at_once: fractions(&left, count(&together)),
        expected_error: error(&bins),
        error_by_chance: (0..DRAWS).map(drawn).sum::<f64>() / DRAWS as f64,
        auc: auc(&best),
        seconds: of.iter().map(|s| s.seconds).sum::<f64>() / of.len() as f64,
        bins,
    })
}

/// Poses, each with its probability and whether it is right, in ten bins of equal width.
fn binned(poses: impl Iterator<Item = (f64, bool)>) -> Vec<Bin> {
    let mut bins = vec![Bin::default(); BINS];
    for (p, right) in poses {
        let bin = &mut bins[((p * BINS as f64) as usize).min(BINS - 1)];
        bin.poses += 1;
        bin.probability += p;
        bin.right += f64::from(u8::from(right));
    }
    for bin in bins.iter_mut().filter(|b| b.poses > 0) {
        bin.probability /= bin.poses as f64;
        bin.right /= bin.poses as f64;
    }
    bins
}

/// Expected calibration error of binned poses; 0 without poses.
fn error(bins: &[Bin]) -> f64 {
    let poses = bins.iter().map(|b| b.poses).sum::<usize>().max(1) as f64;
    bins.iter().map(|b| b.poses as f64 * (b.probability - b.right).abs()).sum::<f64>() / poses
}

/// The probability that a right pose has a higher probability than a wrong one.
fn auc(best: &[(bool, f64, bool)]) -> f64 {
    let (mut wins, mut pairs) = (0.0, 0.0);
    for (_, p, _) in best.iter().filter(|b| b.2) {
        for (_, q, _) in best.iter().filter(|b| !b.2) {
            pairs += 1.0;
            wins += if p > q {
                1.0
            } else if p == q {
                0.5
            } else {
                0.0
            };
        }
    }
    if pairs == 0.0 { 0.5 } else { wins / pairs }
}

/// The rows as a page of markdown.
pub(super) fn markdown(whole: &Whole) -> String {
    let mut out = "| given | objects in the image | best pose right | of these at least 0.5 | right of those at least 0.5 | \
                   objects not in the image | of these at least 0.5 | expected calibration error | the same for exact probabilities | AUC | s a search |\n\
                   |---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n"
        .to_owned();
    for r in &whole.rows {
        // Writing to a string cannot fail.
        let _ = writeln!(
            out,
            "| {} | {} | {:.3} | {:.3} | {:.3} | {} | {:.3} | {:.3} | {:.3} | {:.3} | {:.3} | {:.3} | {:.3} | {:.2} |",
            r.given.name(),
            r.present,
            r.found,
            r.single.kept,
            r.single.precision,
            r.absent,
            r.single.accepted,
            r.at_once.kept,
            r.at_once.precision,
            r.at_once.accepted,
            r.expected_error,
            r.error_by_chance,
            r.auc,
            r.seconds
        );
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::{FoundPose, Together};
    use super::*;

    fn search(present: bool, probability: f64, right: bool) -> Search {
        let numbers = [None; sixfold_auto::NAMES.len()];
        let poses = vec![FoundPose { method: "ppf".into(), numbers, probability, right }];
        let together = Some(Together { probability, right });
        Search {
            object: "a".into(),
            given: Given::Depth,
            present,
            poses,
            together,
            overruled: false,
            seconds: 2.0,
        }
    }

    #[test]
    fn a_row_counts_kept_and_accepted_poses() {
        let mut searches = vec![
            search(true, 0.95, true),
            search(true, 0.95, true),
            search(true, 0.35, true),
            search(true, 0.65, false),
            search(false, 0.75, false),
            search(false, 0.05, false),
        ];
        searches.push(Search { poses: vec![], ..search(true, 0.0, false) });
        let whole = Whole::of(&searches);
        let r = &whole.rows[0];
        assert_eq!((whole.rows.len(), r.present, r.absent), (1, 5, 2));
        let of = |kept, precision, accepted| Fractions { kept, precision, accepted };
        assert_eq!(r.found, 0.6);
        assert_eq!((&r.single, &r.at_once), (&of(2.0 / 3.0, 0.5, 0.5), &of(2.0 / 3.0, 0.5, 0.5)));
        // The absent object's pose has the pixels of a more probable one, and so has a right one.
        [0, 4].into_iter().for_each(|k| searches[k].overruled = true);
        let again = &Whole::of(&searches).rows[0];
        assert_eq!((&again.single, again.expected_error), (&r.single, r.expected_error));
        assert_eq!((&again.at_once, &again.together), (&of(1.0 / 3.0, 0.5, 0.0), &r.single));
        // With its alternatives the right pose of 0.35 is reported, and so is the absent object's pose; the wrong one of 0.65 has a right
        // alternative.
        searches[2].together = Some(Together { probability: 0.55, right: true });
        searches[5].together = Some(Together { probability: 0.5, right: false });
        searches[3].together = Some(Together { probability: 0.65, right: true });
        let all = &Whole::of(&searches).rows[0];
        assert_eq!((&all.single, &all.together), (&r.single, &of(1.0, 4.0 / 6.0, 1.0)));
        assert_eq!(all.at_once, of(0.75, 0.75, 0.5));
        // .05 in the bins of two poses, .65 in two of one, .75, .05 in one of one each.
        let expected = (2.0 * 0.05 + 0.65 + 0.65 + 0.75 + 0.05) / 6.0;
        assert!((r.expected_error - expected).abs() < 1e-9, "{}", r.expected_error);
        // Exactly: one bin of two poses, of which none, one or both are right, and four bins of one.
        let one = |p: f64| 2.0 * p * (1.0 - p);
        let two =
            |p: f64| (1.0 - p).powi(2) * 2.0 * p + one(p) * (1.0 - 2.0 * p).abs() + p * p * 2.0 * (1.0 - p);
        let chance = (two(0.95) + one(0.35) + one(0.65) + one(0.75) + one(0.05)) / 6.0;
        assert!((r.error_by_chance - chance).abs() < 0.015, "{} {chance}", r.error_by_chance);
        // Seven of the nine pairs of a right and a wrong pose are in order.
        assert!((r.auc - 7.0 / 9.0).abs() < 1e-9);
        assert_eq!(r.seconds, 2.0);
        assert!(markdown(&whole).contains("| depth | 5 | 0.600 | 0.667 | 0.500 | 2 | 0.500 |"));
    }
}
