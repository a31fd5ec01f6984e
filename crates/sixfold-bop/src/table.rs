//! Scores as tables for people.

use std::fmt::Write;

use crate::evaluate::{DetectionEvaluation, Evaluation};

/// A score with three digits, `-` where it cannot be computed.
fn digits(score: Option<f64>) -> String {
    score.map_or_else(|| "-".into(), |s| format!("{s:.3}"))
}

/// The scores of a result file, one line per object, and the reasons for missing scores.
pub fn score_table(e: &Evaluation) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail, here and below.
    let mut line = |columns: [&str; 6]| {
        let [object, targets, vsd, mssd, mspd, add] = columns;
        let _ = writeln!(text, "{object:>8} {targets:>8} {vsd:>8} {mssd:>8} {mspd:>8} {add:>12}");
    };
    let vsd = if e.vsd_protocol.is_some() { "VSD" } else { "AR_VSD" };
    line(["object", "targets", vsd, "AR_MSSD", "AR_MSPD", "ADD(-S)<0.1d"]);
    let mut objects: Vec<_> = e.objects.iter().collect();
    objects.sort_by_key(|(id, _)| id.parse::<u32>().unwrap_or(u32::MAX));
    for (id, o) in objects {
        let [vsd, mssd, mspd, add] = [o.ar_vsd, o.ar_mssd, o.ar_mspd, o.add_s_recall].map(digits);
        line([id, &o.targets.to_string(), &vsd, &mssd, &mspd, &add]);
    }
    let mean = e.add_s_recall.get("mean").copied().flatten();
    let [vsd, mssd, mspd, add] = [e.ar_vsd, e.ar_mssd, e.ar_mspd, mean].map(digits);
    line(["all", &e.targets.to_string(), &vsd, &mssd, &mspd, &add]);
    if let Some(protocol) = &e.vsd_protocol {
        let _ = writeln!(text, "VSD: recall of {protocol}");
    }
    let [ar, add, add_s] = [e.ar, e.add_auc, e.add_s_auc].map(digits);
    let _ = writeln!(text, "AR {ar}   AUC of ADD {add}, of ADD-S {add_s} (to 10 cm)");
    for (score, reason) in &e.reasons {
        let _ = writeln!(text, "{score} not computed: {reason}");
    }
    if let Some(t) = e.average_time_per_image {
        let _ = writeln!(text, "{t:.2} s per image");
    }
    text
}

/// The scores of 6D detection, and the reasons for missing scores.
pub fn detection_score_table(d: &DetectionEvaluation) -> String {
    let [ap, mssd, mspd] = [d.ap, d.ap_mssd, d.ap_mspd].map(digits);
    let mut text = format!("6D detection (BOP'24): AP {ap} AP_MSSD {mssd} AP_MSPD {mspd}\n");
    for (score, reason) in &d.reasons {
        let _ = writeln!(text, "{score} not computed: {reason}");
    }
    text
}
