//! What all drivers of faults share: a row of the table of commands, its folder, its undisturbed run, and runs with a limit.

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
    /// Of the test.
    pub name: &'static str,
    /// Puts what the command works on into an empty folder.
    pub prepare: fn(&Path),
    /// With blanks between them.
    pub arguments: &'static str,
    /// Beginnings of what it writes, one of which a message about writing has to name.
    pub writes: &'static [&'static str],
    /// What else the command may end with when it is given again after it was complete: an exit status and words of its message.
    pub again: Option<(i32, &'static str)>,
}

/// A run that nothing disturbed.
pub struct Reference {
    /// Where it ran.
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
    /// The folder it ran in, which is not to be changed.
    pub fn folder(&self) -> &Path {
        &self.folder
    }
}

/// Longer than any command of the table takes: a run that is not done by then hangs.
const LIMIT: Duration = Duration::from_secs(300);

/// The program that is tested: that of this build, or the one that `SIXFOLD_PROGRAM` names, such as an installed one.
pub fn program() -> PathBuf {
    std::env::var_os("SIXFOLD_PROGRAM").map_or_else(|| crate::PROGRAM.into(), PathBuf::from)
}

/// Whether all moments and values are wanted.
pub fn thorough() -> bool {
    std::env::var_os("SIXFOLD_FAULTS").is_some_and(|v| v == "all")
}

/// A folder of this process for what several tests read. The next process removes it: nothing runs when the last test is done.
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

/// What methods derive from meshes, kept for all runs: it is no result.
fn cache() -> PathBuf {
    kept("cache")
}

/// Whether a row takes too long for a run that was not asked to be thorough: it shares all that writes with quicker ones.
pub fn is_left_out(row: &Row) -> bool {
    let left_out = !thorough() && ["train_nol", "train_mttm"].contains(&row.name);
    if left_out {
        println!("skipped: {} takes minutes; SIXFOLD_FAULTS=all runs it", row.name);
    }
    left_out
}

/// A folder with what a row works on.
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

/// Where a run happens, and where it keeps what it derives.
pub fn environment(command: &mut Command, folder: &Path) {
    command.current_dir(folder).env_remove("SIXFOLD_STORE").env("SIXFOLD_CACHE", cache());
}

/// A run that was started.
pub struct Started {
    child: Child,
    output: TempDir,
}

/// Starts a command whose output goes to files, which no pipe's size holds up.
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

    /// Ends it as the system does when memory is short. Whether it was still running.
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

    /// Waits for its end, not for ever.
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

/// Whether a run ended as the undisturbed one, or as one that found everything done.
pub fn ended_well(row: &Row, run: &Run) -> bool {
    run.code == reference(row).code
        || row.again.is_some_and(|(code, words)| {
            run.code == code && format!("{}{}", run.stdout, run.stderr).contains(words)
        })
}
