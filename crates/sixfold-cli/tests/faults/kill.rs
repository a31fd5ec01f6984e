//! A command is killed at any moment; run again, it ends with the bytes of an undisturbed run and leaves no other files.

use std::path::Path;
use std::time::{Duration, Instant};

use crate::driver::{Row, Started, command, ended_well, prepared, reference, run, start, thorough};
use crate::outputs::{differences, fingerprint, leftovers, tree};

/// When a run is killed.
#[derive(Debug, Clone, Copy)]
enum Moment {
    /// At this fraction of an undisturbed run's time.
    Time(f64),
    /// When the files below its folder have changed this many times.
    Change(usize),
}

/// Moments over the whole run: by the clock, and in the middle of writing.
fn moments(duration: Duration) -> Vec<Moment> {
    if thorough() {
        let times = (0..20).map(|i| Moment::Time((f64::from(i) + 0.5) / 20.0));
        let changes = [1, 2, 3, 4, 5, 6, 8, 10, 13, 17, 22, 30].map(Moment::Change);
        return times.chain(changes).collect();
    }
    let few = [Moment::Change(1), Moment::Change(4), Moment::Time(0.6)];
    // A run of many seconds is killed once.
    let count = if duration > Duration::from_secs(6) { 1 } else { few.len() };
    few[few.len() - count..].to_vec()
}

/// Waits for a moment, or for the end of the run.
fn wait_for(moment: Moment, duration: Duration, run: &mut Started, folder: &Path) {
    let began = Instant::now();
    let mut last = fingerprint(folder);
    let mut changes = 0;
    while !run.is_done() {
        match moment {
            Moment::Time(fraction) => {
                if began.elapsed() >= duration.mul_f64(fraction) {
                    return;
                }
                std::thread::sleep(Duration::from_micros(500));
            }
            Moment::Change(count) => {
                let now = fingerprint(folder);
                changes += usize::from(now != last);
                if changes >= count {
                    return;
                }
                last = now;
                std::thread::sleep(Duration::from_micros(100));
            }
        }
    }
}

/// Kills a row's command at several moments, each time in a new folder, and runs it again.
pub fn killed_and_restarted(row: &Row) {
    let reference = reference(row);
    let mut wrong = vec![];
    let mut killed = 0;
    let moments = moments(reference.duration);
    for &moment in &moments {
        let folder = prepared(row);
        let mut first = start(command(row, folder.path()));
        wait_for(moment, reference.duration, &mut first, folder.path());
        killed += usize::from(first.kill());
        let second = run(row, folder.path());
        if !ended_well(row, &second) {
            wrong.push(format!("{moment:?}: exit status {}: {}", second.code, second.stderr.trim()));
            continue;
        }
        let left = leftovers(folder.path());
        if !left.is_empty() {
            wrong.push(format!("{moment:?}: left behind: {left:?}"));
        }
        let differing = differences(&reference.tree, &tree(folder.path()));
        wrong.extend(differing.iter().map(|line| format!("{moment:?}: {line}")));
    }
    println!("{}: {killed} of {} runs were killed while they ran", row.name, moments.len());
    assert!(wrong.is_empty(), "sixfold {}\n{}", row.arguments, wrong.join("\n"));
}
