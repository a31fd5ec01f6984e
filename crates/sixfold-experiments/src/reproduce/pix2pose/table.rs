//! The rows as one page of markdown.

use std::collections::BTreeSet;
use std::fmt::Write;

use super::Whole;
use super::row::Row;

fn digits(score: Option<f64>) -> String {
    score.map_or_else(|| "-".into(), |s| format!("{s:.3}"))
}

/// Pose recall against detector quality, as in table 3.9 of the dissertation; empty without detections.
fn against_detection(rows: &[Row]) -> String {
    if rows.iter().all(|r| r.detection.is_none()) {
        return String::new();
    }
    let mut out =
        "\nPoses against detections (as the dissertation's table 3.9)\n\n| what | boxes | right boxes | ADD(-S) 10 %, all targets | of right boxes alone |\n|---|---|---|---|---|\n"
            .to_owned();
    for row in rows {
        let (fraction, of_right) = match row.detection {
            Some(d) => (Some(d.fraction), d.add_s),
            None if row.key == "default" || row.key == "no-refinement" => (Some(1.0), row.scores.add_s),
            None => continue,
        };
        let (fraction, all, right) = (digits(fraction), digits(row.scores.add_s), digits(of_right));
        let _ = writeln!(out, "| {} | {} | {fraction} | {all} | {right} |", row.title, row.boxes);
    }
    out
}

/// The page: scores of all rows, then the first row per object beside the published one.
pub(super) fn markdown(whole: &Whole) -> String {
    let mut out = String::new();
    let i = &whole.inputs;
    let _ = writeln!(
        out,
        "Pix2Pose on {} targets in {} frames of `{}`, none of the {} frames that the model was trained on. Colour only.{}\n",
        whole.targets,
        whole.frames,
        i.dataset,
        i.trained_on.len(),
        if i.quick { " **Quick: every eighth frame.**" } else { "" }
    );
    out += "| what | boxes | targets | AR_MSSD | AR_MSPD | ADD(-S) 10 %, all targets | mean over objects | \
         ms per box, mean / median |\n";
    out += "|---|---|---|---|---|---|---|---|\n";
    for row in &whole.rows {
        let s = &row.scores;
        let time =
            row.milliseconds.map_or_else(|| "-".into(), |t| format!("{:.0} / {:.0}", t.mean, t.median));
        let _ = writeln!(
            out,
            "| {} | {} | {} | {} | {} | {} | {} | {time} |",
            row.title,
            row.boxes,
            s.targets,
            digits(s.ar_mssd),
            digits(s.ar_mspd),
            digits(s.add_s),
            digits(s.add_s_mean_of_objects)
        );
    }
    out += &against_detection(&whole.rows);
    let aligned = |r: &Row| r.detection.is_some() && !r.key.ends_with("-no-refinement");
    let compared: Vec<&Row> = whole
        .rows
        .iter()
        .filter(|r| ["default", "no-refinement", "published"].contains(&r.key.as_str()) || aligned(r))
        .collect();
    out += "\nPer object: AR_MSSD / AR_MSPD / ADD(-S) 10 %\n\n| object | targets |";
    for row in &compared {
        let _ = write!(out, " {} |", row.title);
    }
    let _ = writeln!(out, "\n|---|---|{}", "---|".repeat(compared.len()));
    let ids: BTreeSet<u32> = compared.iter().flat_map(|r| r.scores.objects.keys().copied()).collect();
    for id in ids {
        let targets = compared.first().and_then(|r| r.scores.objects.get(&id)).map_or(0, |o| o.targets);
        let _ = write!(out, "| {id} | {targets} |");
        for row in &compared {
            match row.scores.objects.get(&id) {
                Some(o) => {
                    let _ =
                        write!(out, " {} / {} / {} |", digits(o.ar_mssd), digits(o.ar_mspd), digits(o.add_s));
                }
                None => out += " - |",
            }
        }
        out.push('\n');
    }
    out +=
        "\nNot measured here, on all 200 frames of LM-O's test split with the methods' own detections:\n\n";
    for (what, value) in &whole.literature {
        let _ = writeln!(out, "- {what}: {value:.3}");
    }
    out
}
