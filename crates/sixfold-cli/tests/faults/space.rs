//! A disk that fills up while a command writes: the command reports it, damages no existing files, and can be completed by the
//! same command once there is space. The disk is a small file system in memory, mounted in a name space of its own.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::sync::OnceLock;

use crate::driver::{Row, command, ended_well, environment, prepared, reference, start, thorough};
use crate::outputs::{Tree, differences, leftovers, tree};
use crate::support::Run;

/// Whether file systems can be mounted without changing anything outside.
#[derive(Clone, Copy)]
pub enum Jail {
    /// Makes a command that runs others in their own mount name space.
    Ready(fn(&[&str]) -> Command),
    /// Not available here.
    Missing,
}

fn as_root(arguments: &[&str]) -> Command {
    let mut command = Command::new("unshare");
    command.arg("--mount").args(arguments);
    command
}

fn as_user(arguments: &[&str]) -> Command {
    let mut command = Command::new("unshare");
    command.args(["--user", "--map-root-user", "--mount"]).args(arguments);
    command
}

/// Determined once.
pub fn jail() -> Jail {
    static JAIL: OnceLock<Jail> = OnceLock::new();
    *JAIL.get_or_init(|| {
        let works = |wrap: fn(&[&str]) -> Command| {
            let folder = tempfile::tempdir().unwrap();
            let mount = wrap(&["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs"]).arg(folder.path()).output();
            mount.is_ok_and(|output| output.status.success())
        };
        let ways: [fn(&[&str]) -> Command; 2] = [as_root, as_user];
        ways.into_iter().find(|wrap| works(*wrap)).map_or(Jail::Missing, Jail::Ready)
    })
}

/// Runs a command twice on a small disk: with little space, then with enough. The files after each run are copied out.
const SCRIPT: &str = r#"
set -e
disk=$1 from=$2 free=$3 results=$4
shift 4
mount -t tmpfs -o size=512m tmpfs "$disk"
cp -a "$from/." "$disk/"
used=$(df --output=used -k "$disk" | tail -1)
mount -o remount,size=$((used + free))k "$disk"
cd "$disk"
set +e
"$@" >"$results/out1" 2>"$results/err1"
echo $? >"$results/code1"
cp -a . "$results/full"
mount -o remount,size=512m "$disk"
"$@" >"$results/out2" 2>"$results/err2"
echo $? >"$results/code2"
cp -a . "$results/after"
"#;

/// A run on the small disk and its files.
struct Ended {
    run: Run,
    folder: std::path::PathBuf,
}

/// Runs a row's command on a disk that holds `from` and has `free` kilobytes more, then with much space.
fn on_small_disk(
    wrap: fn(&[&str]) -> Command,
    row: &Row,
    from: &Path,
    free: u64,
    results: &Path,
) -> [Ended; 2] {
    let disk = results.join("disk");
    fs::create_dir(&disk).unwrap();
    let inside = command(row, from);
    let mut program = wrap(&["sh", "-c", SCRIPT, "sh"]);
    program
        .args([&disk, from])
        .arg(free.to_string())
        .arg(results)
        .arg(inside.get_program())
        .args(inside.get_args());
    environment(&mut program, from);
    let whole = start(program).wait();
    assert!(results.join("after").exists(), "{}", whole.stderr);
    [("1", "full"), ("2", "after")].map(|(number, folder)| {
        let text = |name: &str| {
            String::from_utf8_lossy(&fs::read(results.join(format!("{name}{number}"))).unwrap()).into_owned()
        };
        let run =
            Run { code: text("code").trim().parse().unwrap(), stdout: text("out"), stderr: text("err") };
        Ended { run, folder: results.join(folder) }
    })
}

/// The message names what cannot be written.
fn says_it(row: &Row, stderr: &str) -> bool {
    stderr.lines().any(|line| {
        let full = line.contains("No space left") || line.contains("disk is full");
        full && row.writes.iter().any(|name| line.contains(name))
    })
}

/// Fills the disk while a row's command writes, and after everything was written.
pub fn small_disk(row: &Row) {
    let Jail::Ready(wrap) = jail() else {
        println!("skipped: no file system can be mounted here (needs root, or name spaces for users)");
        return;
    };
    let reference = reference(row);
    let mut wrong = vec![];
    let kilobytes = reference.written / 1024;
    let fractions: &[u64] = if thorough() { &[0, 10, 30, 50, 70, 90] } else { &[40] };
    for fraction in fractions {
        let (folder, results) = (prepared(row), tempfile::tempdir().unwrap());
        let before = tree(folder.path());
        let free = kilobytes * fraction / 100;
        let [full, after] = on_small_disk(wrap, row, folder.path(), free, results.path());
        let at = format!("{free} kB free of {kilobytes} kB needed");
        // A command that removes something may need no space.
        let done = full.run.code == 0 && completed(row, &full).is_empty();
        let refused = full.run.code == 2 && says_it(row, &full.run.stderr);
        if !(done || refused) || full.run.stderr.contains("panicked") {
            wrong.push(format!("{at}: exit status {}: {}", full.run.code, full.run.stderr.trim()));
        }
        if done {
            continue;
        }
        wrong.extend(harmed(&before, &tree(&full.folder)).iter().map(|d| format!("{at}: {d}")));
        wrong.extend(completed(row, &after).iter().map(|d| format!("{at}, then enough: {d}")));
    }
    // Files of an earlier run stay, or are replaced by the same content.
    let results = tempfile::tempdir().unwrap();
    let [full, after] = on_small_disk(wrap, row, reference.folder(), 0, results.path());
    if full.run.stderr.contains("panicked") {
        wrong.push(full.run.stderr);
    }
    wrong.extend(harmed(&reference.tree, &tree(&full.folder)).iter().map(|d| format!("earlier output: {d}")));
    wrong.extend(completed(row, &after).iter().map(|d| format!("earlier output, then enough: {d}")));
    assert!(wrong.is_empty(), "on a full disk: sixfold {}\n{}", row.arguments, wrong.join("\n"));
}

/// The earlier files that have changed or are missing.
fn harmed(before: &Tree, now: &Tree) -> Vec<String> {
    let kept: Tree = now
        .iter()
        .filter(|(path, _)| before.contains_key(*path))
        .map(|(p, b)| (p.clone(), b.clone()))
        .collect();
    differences(before, &kept)
}

/// The failures of the run with enough space.
fn completed(row: &Row, after: &Ended) -> Vec<String> {
    if !ended_well(row, &after.run) {
        return vec![format!("exit status {}: {}", after.run.code, after.run.stderr.trim())];
    }
    let mut wrong = differences(&reference(row).tree, &tree(&after.folder));
    wrong.extend(leftovers(&after.folder).iter().map(|path| format!("left behind: {}", path.display())));
    wrong
}
