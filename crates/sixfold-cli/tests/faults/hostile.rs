//! Command lines with hostile values: every number and every file of every command, as its `--help` lists them, gets values that
//! are invalid for it. Each is refused with exit status 2 and a message that names the option, within ten seconds and two
//! gigabytes.

use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use tempfile::TempDir;

use crate::commands;
use crate::driver::{Row, environment, program, start, thorough};

/// Limit of CPU time in seconds, for `ulimit -t`: other tests use the processors too.
const SECONDS: u64 = 10;
/// Limit of waiting time for a run that does not compute.
const WAITING: Duration = Duration::from_secs(60);
/// Limit of memory in kilobytes, for `ulimit -v`.
const KILOBYTES: u64 = 2_000_000;

/// The kind of values that an option takes, by their name in the help.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Number,
    /// A path that is read.
    Input,
    /// A path that is written.
    Output,
    Other,
}

const NUMBERS: [&str; 16] = [
    "N", "RATE", "FRACTION", "DEGREES", "PIXELS", "SCORE", "MM", "METRES", "M", "ID", "WEIGHT", "DISTANCE",
    "SEED", "KG", "NUMBER", "NUMBERS",
];
/// Options whose files and folders are created.
const OUTPUTS: [&str; 10] =
    ["out", "json", "overlays", "pictures", "picture", "curves", "write-truth", "cache", "store", "outbox"];

/// An option of a command.
struct Opt {
    command: String,
    name: String,
    kind: Kind,
}

fn kind(name: &str, value: &str) -> Kind {
    let value = value.trim_end_matches("...");
    if OUTPUTS.contains(&name) {
        Kind::Output
    } else if value
        .split(',')
        .all(|part| NUMBERS.contains(&part) || ["X", "Y", "Z", "W", "H", "LOW", "HIGH"].contains(&part))
    {
        Kind::Number
    } else if ["FILE", "DIR", "PATH", "MESH"].iter().any(|word| value.contains(word)) {
        Kind::Input
    } else {
        Kind::Other
    }
}

/// The options of a command that take a value, from its help.
fn options(command: &str) -> Vec<Opt> {
    let words = command.split(' ').take_while(|word| !word.starts_with("--"));
    let output = Command::new(program()).args(words).arg("--help").output().unwrap();
    let help = String::from_utf8(output.stdout).unwrap();
    let mut found = vec![];
    for line in help.lines() {
        let Some(rest) = line.trim_start().strip_prefix("--") else { continue };
        let Some((name, value)) = rest.split_once(' ') else { continue };
        let Some((value, _)) =
            value.trim_start_matches('[').strip_prefix('<').and_then(|v| v.split_once('>'))
        else {
            continue;
        };
        found.push(Opt { command: command.into(), name: name.into(), kind: kind(name, value) });
    }
    assert!(!found.is_empty(), "{command}: {help}");
    found
}

/// A working command line for each command, into which a hostile value is inserted.
fn good() -> BTreeMap<&'static str, Row> {
    let of = |name: &str| *commands::ROWS.iter().find(|row| row.name == name).unwrap();
    let rows = [
        ("estimate", of("estimate_image")),
        ("detect", of("detect_image")),
        ("train pix2pose", of("train_pix2pose")),
        ("train detector", of("train_detector")),
        ("train nol", of("train_nol")),
        ("train views", of("train_views")),
        ("train refiner", of("train_refiner")),
        ("train proposals", of("train_proposals")),
        ("train mttm", of("train_mttm")),
        ("train dgcm", of("train_dgcm")),
        ("simulate-depth", of("simulate_depth")),
        ("simulate-scenes", of("simulate_scenes")),
        ("synthesize", of("synthesize")),
        ("object add", of("object_add_views")),
        ("grasp learn", of("grasp_learn")),
        ("grasp store add", of("grasp_store_add")),
        ("grasp store refresh", of("grasp_store_refresh")),
        ("eval", of("eval_detections")),
        ("render", of("render")),
        ("demo", of("demo")),
    ];
    let mut good = BTreeMap::from(rows);
    let arguments = "grasp try --object part.ply --unit mm --tip 0.0,0.0,0.01 --closing 0,1,0";
    good.insert("grasp try", Row { name: "grasp_try", arguments, ..of("render") });
    let arguments = "grasp propose --depth depth.png --camera camera.json --mask mask.png --experiences a.db --weights w.safetensors --out out";
    good.insert("grasp propose", Row { arguments, ..of("grasp_store_merge") });
    let arguments = "estimate --dataset tiny --targets targets.json --out results.csv";
    good.insert("estimate --dataset", Row { arguments, ..of("estimate_dataset") });
    let arguments =
        "detect --weights detector.safetensors --dataset tiny --targets targets.json --out found.json";
    good.insert("detect --dataset", Row { arguments, ..of("detect_dataset") });
    good
}

/// Values that are refused for all numbers, except those of [`ACCEPTED`].
fn hostile_numbers() -> &'static [&'static str] {
    if thorough() {
        &["nan", "inf", "-1", "0", "1e308", "18446744073709551615", ""]
    } else {
        &["nan", "-1", "1e308", ""]
    }
}

/// Paths that are not valid files for any command. `FOLDER` and `FIFO` are created.
fn hostile_files() -> &'static [&'static str] {
    if thorough() {
        &["FOLDER", "/dev/null", "/dev/zero", "FIFO", "", "missing"]
    } else {
        &["FOLDER", "/dev/zero", ""]
    }
}

/// Hostile values that are valid: command (`*`: all), option, values.
const ACCEPTED: &[(&str, &str, &[&str])] = &[
    // Any whole number is a seed.
    ("*", "seed", &["0", "18446744073709551615"]),
    // Above every confidence: nothing is found.
    ("estimate", "min-score", &["0", "1e308"]),
    // Any distance of an experience is accepted.
    ("grasp learn", "near", &["0", "1e308"]),
];

fn is_accepted(option: &Opt, value: &str) -> bool {
    ACCEPTED.iter().any(|(command, name, values)| {
        (*command == "*" || option.command.starts_with(command))
            && *name == option.name
            && values.contains(&value)
    })
}

/// A failure with a hostile command line.
struct Finding {
    what: &'static str,
    line: String,
    message: String,
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:<12} {}   {}", self.what, self.line, self.message)
    }
}

/// A working command line with one value changed, in parts.
fn with_value(arguments: &str, option: &str, value: &str) -> Vec<String> {
    let flag = format!("--{option}");
    let mut parts: Vec<String> = vec![];
    let mut skipping = false;
    for part in arguments.split_whitespace() {
        if part.starts_with("--") {
            skipping = part == flag;
        }
        if !skipping {
            parts.push(part.to_owned());
        }
    }
    parts.push(format!("{flag}={value}"));
    parts
}

/// Runs the program in a folder within the limits. `words`: one of them has to be in the message.
fn refused(folder: &Path, parts: &[String], words: &[&str]) -> Option<Finding> {
    let mut command = Command::new("sh");
    command
        .arg("-c")
        .arg(format!("ulimit -v {KILOBYTES}; ulimit -t {SECONDS}; exec \"$@\""))
        .arg("sh")
        .arg(program())
        .args(parts);
    environment(&mut command, folder);
    let mut run = start(command);
    let began = Instant::now();
    while !run.is_done() {
        if began.elapsed() > WAITING {
            run.kill();
            return Some(Finding { what: "hangs", line: parts.join(" "), message: String::new() });
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    let (code, message) = run.output();
    let last = message.trim().lines().next_back().unwrap_or_default();
    let error = message.lines().find(|l| l.starts_with("error") || l.contains("panicked")).unwrap_or(last);
    let what = if message.contains("panicked") {
        "panics"
    } else if message.contains("memory allocation") {
        "memory"
    } else if code.is_none() {
        // The system killed it.
        "hangs"
    } else if code != Some(2) {
        "accepted"
    } else if !words.iter().any(|word| plain(&message).contains(&plain(word))) {
        "not named"
    } else {
        return None;
    };
    Some(Finding { what, line: parts.join(" "), message: error.to_owned() })
}

/// An option's name without hyphens, underscores and capitals, to compare flags with field names.
fn plain(text: &str) -> String {
    text.replace(['-', '_'], " ").to_lowercase().trim().to_owned()
}

/// The folder that a row works in, with a folder and a pipe.
fn folder_of(row: &Row) -> TempDir {
    let folder = crate::driver::prepared(row);
    fs::create_dir(folder.path().join("FOLDER")).unwrap();
    let made = Command::new("mkfifo").arg(folder.path().join("FIFO")).status().unwrap();
    assert!(made.success());
    folder
}

/// Calls `work` for all jobs, on two threads.
fn on_two_threads<T: Sync>(jobs: &[T], work: impl Fn(&T) -> Option<Finding> + Sync) -> Vec<Finding> {
    let next = std::sync::atomic::AtomicUsize::new(0);
    let all = Mutex::new(vec![]);
    std::thread::scope(|scope| {
        for _ in 0..2 {
            scope.spawn(|| {
                while let Some(job) = jobs.get(next.fetch_add(1, std::sync::atomic::Ordering::Relaxed)) {
                    if let Some(found) = work(job) {
                        all.lock().unwrap().push(found);
                    }
                }
            });
        }
    });
    let mut all = all.into_inner().unwrap();
    all.sort_by(|a, b| (a.what, &a.line).cmp(&(b.what, &b.line)));
    all
}

/// Tries values on all options of a kind.
fn try_all(kind: Kind, values: &[&'static str]) {
    let good = good();
    let only = std::env::var("SIXFOLD_FAULTS_COMMAND").ok();
    let jobs: Vec<(Opt, Row, &str)> = good
        .iter()
        .filter(|(command, _)| only.as_deref().is_none_or(|only| only == **command))
        .flat_map(|(command, row)| options(command).into_iter().map(|option| (option, *row)))
        .filter(|(option, _)| option.kind == kind)
        .flat_map(|(option, row)| {
            let wanted = values.iter().filter(|v| !is_accepted(&option, v)).copied().collect::<Vec<_>>();
            let option = &option;
            wanted
                .into_iter()
                .map(|value| {
                    let copy = Opt { command: option.command.clone(), name: option.name.clone(), kind };
                    (copy, row, value)
                })
                .collect::<Vec<_>>()
        })
        .collect();
    let found = on_two_threads(&jobs, |(option, row, value)| {
        let folder = folder_of(row);
        let flag = format!("--{}", option.name);
        let mut words = vec![flag.as_str()];
        if !value.is_empty() {
            words.push(value);
        }
        refused(folder.path(), &with_value(row.arguments, &option.name, value), &words)
    });
    println!("{} command lines", jobs.len());
    let lines: Vec<String> = found.iter().map(Finding::to_string).collect();
    assert!(found.is_empty(), "{} of {} command lines:\n{}", found.len(), jobs.len(), lines.join("\n"));
}

#[test]
fn numbers() {
    try_all(Kind::Number, hostile_numbers());
}

#[test]
fn files_that_are_read() {
    try_all(Kind::Input, hostile_files());
}

/// Command lines that differ from a working one in more than one value: row of the inputs, arguments, words of the message.
const TABLE: &[(&str, &str, &[&str])] = &[
    ("render", "--threads 100000 render --object part.ply --unit mm --out out", &["--threads", "100000"]),
    ("render", "--threads 0 render --object part.ply --unit mm --out out", &["--threads"]),
    ("render", "render --object part.ply --unit mm --pose nan,0,0.6,0,0,0 --out out", &["--pose", "finite"]),
    ("render", "render --object part.ply --unit mm --camera huge.json --out out", &["huge.json", "pixels"]),
    ("render", "render --object part.ply --unit mm --camera narrow.json --out out", &["narrow.json", "fx"]),
    ("simulate_scenes", "simulate-scenes --toys 1000000 --scenes 1 --out out", &["--toys", "1000000"]),
    (
        "simulate_scenes",
        "simulate-scenes --families all --members 1000000 --scenes 1 --out out",
        &["--members", "1000000"],
    ),
    ("simulate_scenes", "simulate-scenes --toys 1 --camera huge.json --out out", &["huge.json", "pixels"]),
    ("simulate_scenes", "simulate-scenes --toys 1 --split ../../x --out out", &["--split", "letters"]),
    (
        "simulate_depth",
        "simulate-depth --dataset tiny --split ../tiny/test --out out",
        &["--split", "letters"],
    ),
    (
        "synthesize",
        "synthesize --dataset tiny --new-split ../../x --weighting best --out out",
        &["--new-split", "letters"],
    ),
    (
        "synthesize",
        "synthesize --dataset tiny --ids 1,1 --weighting best --step 90 --size 48 --out out",
        &["--ids", "1"],
    ),
    (
        "synthesize",
        "synthesize --dataset tiny --weighting best --step 90 --rotations 100000000 --out out",
        &["--rotations"],
    ),
    ("synthesize", "synthesize --dataset tiny --weighting best --step 90 --out tiny", &["tiny"]),
    ("train_detector", "train detector --dataset tiny --ids 1,1 --out out", &["--ids", "1"]),
    (
        "train_detector",
        "train detector --dataset tiny --frozen-stages 99 --out out",
        &["--frozen-stages", "99"],
    ),
    ("train_pix2pose", "train pix2pose --dataset tiny --ids 1,1 --out out", &["--ids", "1"]),
    (
        "train_pix2pose",
        "train pix2pose --dataset tiny --per-object 100000000 --out out",
        &["--per-object", "100000000"],
    ),
    ("train_mttm", "train mttm --steps 0 --out out", &["--steps", "0"]),
    ("train_dgcm", "train dgcm --views 100000000 --out out", &["--views", "100000000"]),
    (
        "detect_image",
        "detect --weights detector.safetensors --rgb tiny/test/000007/rgb/000004.png --per-object 0",
        &["--per-object", "0"],
    ),
    (
        "eval_detections",
        "eval --dataset tiny --detections found.json --min-score nan",
        &["--min-score", "nan"],
    ),
    (
        "grasp_store_add",
        "grasp store add a.db --depth depth.png --camera camera.json --mask mask.png --grasp grasps.json --object a --number 0 --weights w.safetensors",
        &["--number", "0"],
    ),
    (
        "grasp_learn",
        "grasp learn --experiences e.db --families can --members 18446744073709551615 --weights w.safetensors --out learn",
        &["--members"],
    ),
    (
        "grasp_learn",
        "grasp learn --experiences e.db --families can --attempts 18446744073709551615 --weights w.safetensors --out learn",
        &["--attempts"],
    ),
    ("object_add", "object add . part.ply --unit mm", &["letters"]),
    ("object_add", "object add -- -- part.ply --unit mm", &["--unit"]),
    (
        "estimate_image",
        "estimate --depth huge.png --camera camera.json --object part.ply --unit mm",
        &["huge.png"],
    ),
];

/// A PNG file whose header states 60,000 x 60,000 pixels of 16 bits, a camera of that size, and a camera of half a pixel.
fn bombs(folder: &Path) {
    let mut png = fs::read(folder.join("depth.png")).unwrap_or_default();
    if png.len() > 24 {
        png[16..20].copy_from_slice(&60_000_u32.to_be_bytes());
        png[20..24].copy_from_slice(&60_000_u32.to_be_bytes());
        fs::write(folder.join("huge.png"), png).unwrap();
    }
    let camera = |f: f64, size: u32| {
        format!(
            "{{\"fx\": {f}, \"fy\": {f}, \"cx\": 100, \"cy\": 100, \"width\": {size}, \"height\": {size}, \"depth_scale\": 1}}"
        )
    };
    fs::write(folder.join("huge.json"), camera(60_000.0, 200_000)).unwrap();
    fs::write(folder.join("narrow.json"), camera(0.5, 640)).unwrap();
}

#[test]
fn the_table() {
    let found = on_two_threads(TABLE, |(name, arguments, words)| {
        let row = commands::ROWS.iter().find(|row| row.name == *name).unwrap();
        let folder = folder_of(row);
        bombs(folder.path());
        let parts: Vec<String> = arguments.split_whitespace().map(str::to_owned).collect();
        words.iter().find_map(|word| refused(folder.path(), &parts, &[word]))
    });
    let lines: Vec<String> = found.iter().map(Finding::to_string).collect();
    assert!(found.is_empty(), "{} of {} command lines:\n{}", found.len(), TABLE.len(), lines.join("\n"));
}
