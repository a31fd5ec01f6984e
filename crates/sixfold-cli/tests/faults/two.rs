//! The same command twice at once on the same output: both end with the right output, or one is refused with a
//! reason.

use std::time::Duration;

use crate::driver::{Row, command, ended_well, prepared, reference, start, thorough};
use crate::outputs::{differences, leftovers, take_over_logs, tree};

/// Words of a refusal with a reason.
const WHY: [&str; 3] = ["another process", "exists", "there is already"];

/// Runs a row's command twice at once.
pub fn two_at_once(row: &Row) {
    let reference = reference(row);
    let mut wrong = vec![];
    let offsets: &[f64] = if thorough() { &[0.0, 0.0, 0.0, 0.0, 0.2, 0.5, 0.8, 0.95] } else { &[0.0] };
    for offset in offsets {
        let folder = prepared(row);
        let first = start(command(row, folder.path()));
        std::thread::sleep(reference.duration.min(Duration::from_secs(20)).mul_f64(*offset));
        let second = start(command(row, folder.path()));
        let runs = [first.wait(), second.wait()];
        let refused =
            |run: &crate::support::Run| run.code == 2 && WHY.iter().any(|words| run.stderr.contains(words));
        for run in runs.iter().filter(|run| !ended_well(row, run) && !refused(run)) {
            wrong.push(format!("exit status {}: {}", run.code, run.stderr.trim()));
        }
        if !runs.iter().any(|run| run.code == reference.code) {
            wrong.push("neither of both succeeded".to_owned());
        }
        take_over_logs(folder.path());
        let left = leftovers(folder.path());
        if !left.is_empty() {
            wrong.push(format!("left behind: {left:?}"));
        }
        wrong.extend(differences(&reference.tree, &tree(folder.path())));
    }
    assert!(wrong.is_empty(), "twice at once: sixfold {}\n{}", row.arguments, wrong.join("\n"));
}
