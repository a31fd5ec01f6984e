//! Shared parts of the fault drivers: a row of the table of commands, its folder, its undisturbed run, and runs with a time
//! limit.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, LazyLock, Mutex, OnceLock};
use std::time::{Duration, Instant};

use tempfile::TempDir;

use crate::outputs::{Tree, size, tree};
use crate::support::Run;

/// A command that writes.
#[derive(Clone, Copy)]
pub struct Row {
    /// Name of the test.
    pub name: &'static str,
    /// Puts the inputs of the command into an empty folder.
    pub prepare: fn(&Path),
    /// Arguments separated by blanks.
    pub arguments: &'static str,
    /// Prefixes of the paths that it writes; a message about writing has to name one of them.
    pub writes: &'static [&'static str],
    /// An alternative result when the command is run again after completion: an exit status and words of its message.
    pub again: Option<(i32, &'static str)>,
}

/// An undisturbed run.
pub struct Reference {
    /// The folder in which it ran.
    folder: PathBuf,
    /// Files after it.
    pub tree: Tree,
    /// Exit status.
    pub code: i32,
    /// How long it took.
    pub duration: Duration,
    /// Bytes that it wrote.
    pub written: u64,
}

impl Reference {
    /// The folder in which it ran; it must not be changed.
    pub fn folder(&self) -> &Path {
        &self.folder
    }
}

/// Longer than any command of the table takes: a run that is not done by then counts as hanging.
const LIMIT: Duration = Duration::from_secs(300);

/// The program under test: from this build, or the one that `SIXFOLD_PROGRAM` names, such as an installed one.
pub fn program() -> PathBuf {
    std::env::var_os("SIXFOLD_PROGRAM").map_or_else(|| crate::PROGRAM.into(), PathBuf::from)
}

/// Whether all moments and values are tested.
pub fn thorough() -> bool {
    std::env::var_os("SIXFOLD_FAULTS").is_some_and(|v| v == "all")
}

/// A folder of this process for files that several tests read. The next process removes it, because no code runs after the last
/// test.
pub fn kept(name: &str) -> PathBuf {
    static ROOT: LazyLock<PathBuf> = LazyLock::new(|| {
        let all = Path::new(env!("CARGO_TARGET_TMPDIR")).join("faults");
        for entry in fs::read_dir(&all).into_iter().flatten().flatten() {
            let process = Path::new("/proc").join(entry.file_name());
            if Path::new("/proc/self").exists() && !process.exists() {
                let _ = fs::remove_dir_all(entry.path());
            }
        }
        all.join(std::process::id().to_string())
    });
    let folder = ROOT.join(name);
    fs::create_dir_all(&folder).unwrap();
    folder
}

/// The cache of derived data of meshes, shared by all runs, since it is not a result.
fn cache() -> PathBuf {
    kept("cache")
}

/// Whether a row takes too long for a run that is not thorough: quicker rows cover all of its writing code.
pub fn is_left_out(row: &Row) -> bool {
    let left_out = !thorough() && ["train_nol", "train_mttm"].contains(&row.name);
    if left_out {
        println!("skipped: {} takes minutes; SIXFOLD_FAULTS=all runs it", row.name);
    }
    left_out
}

/// A folder with the inputs of a row.
pub fn prepared(row: &Row) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    (row.prepare)(folder.path());
    folder
}

/// Copies everything below a folder into another one.
pub fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = to.join(path.file_name().unwrap());
        if path.is_dir() {
            copy(&path, &target);
        } else {
            fs::copy(&path, &target).unwrap();
        }
    }
}

/// The undisturbed run of a row, made once.
pub fn reference(row: &Row) -> &'static Reference {
    type Cell = Arc<OnceLock<&'static Reference>>;
    static ALL: Mutex<BTreeMap<&str, Cell>> = Mutex::new(BTreeMap::new());
    let cell = ALL.lock().unwrap().entry(row.name).or_default().clone();
    cell.get_or_init(|| {
        let folder = kept(row.name);
        (row.prepare)(&folder);
        let before = size(&folder);
        let began = Instant::now();
        let run = run(row, &folder);
        let duration = began.elapsed();
        assert!(run.code == 0 || run.code == 1, "{}: {}", row.arguments, run.stderr);
        let written = size(&folder).saturating_sub(before);
        println!(
            "{}: {:.2} s, {} kB, exit status {}",
            row.name,
            duration.as_secs_f64(),
            written / 1024,
            run.code
        );
        let tree = tree(&folder);
        // Lives as long as the process.
        Box::leak(Box::new(Reference { tree, code: run.code, duration, written, folder }))
    })
}

/// The program with a row's arguments, to be run in a folder.
pub fn command(row: &Row, folder: &Path) -> Command {
    let mut command = Command::new(program());
    command.args(row.arguments.split_whitespace());
    environment(&mut command, folder);
    command
}

/// Sets the folder of a run and its cache.
pub fn environment(command: &mut Command, folder: &Path) {
    command.current_dir(folder).env_remove("SIXFOLD_STORE").env("SIXFOLD_CACHE", cache());
}

/// A run that was started.
pub struct Started {
    child: Child,
    output: TempDir,
}

/// Starts a command with its output in files, so that a full pipe cannot block it.
pub fn start(mut command: Command) -> Started {
    let output = tempfile::tempdir().unwrap();
    let file = |name: &str| File::create(output.path().join(name)).unwrap();
    let child = command.stdin(Stdio::null()).stdout(file("out")).stderr(file("err")).spawn().unwrap();
    Started { child, output }
}

impl Started {
    /// Whether it is done.
    pub fn is_done(&mut self) -> bool {
        self.child.try_wait().unwrap().is_some()
    }

    /// Kills it as the system does when memory is short. Returns whether it was still running.
    pub fn kill(&mut self) -> bool {
        let running = !self.is_done();
        self.child.kill().unwrap();
        self.child.wait().unwrap();
        running
    }

    /// Exit status and standard error of a run that is done.
    pub fn output(mut self) -> (Option<i32>, String) {
        let code = self.child.wait().unwrap().code();
        (code, String::from_utf8_lossy(&fs::read(self.output.path().join("err")).unwrap()).into_owned())
    }

    /// Waits for its end, with a time limit.
    pub fn wait(mut self) -> Run {
        let began = Instant::now();
        while !self.is_done() {
            if began.elapsed() > LIMIT {
                self.kill();
                panic!("not done after {LIMIT:?}");
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        let code = self.child.wait().unwrap().code().unwrap_or(-1);
        let text = |name: &str| {
            String::from_utf8_lossy(&fs::read(self.output.path().join(name)).unwrap()).into_owned()
        };
        let run = Run { code, stdout: text("out"), stderr: text("err") };
        assert!(!run.stderr.contains("panicked"), "{}", run.stderr);
        run
    }
}

/// Runs a row in a folder.
pub fn run(row: &Row, folder: &Path) -> Run {
    start(command(row, folder)).wait()
}

/// Whether a run ended like the undisturbed one, or like one that found everything done.
pub fn ended_well(row: &Row, run: &Run) -> bool {
    run.code == reference(row).code
        || row.again.is_some_and(|(code, words)| {
            run.code == code && format!("{}{}", run.stdout, run.stderr).contains(words)
        })
}
