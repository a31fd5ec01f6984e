//! Runs every reader on a number of mutated files: `cargo run --release -p sixfold-fuzz -- --inputs 3000 --seed 1`.
//!
//! The inputs depend only on the seed. The current input is written to the folder of `--out`, so that it is available
//! after a panic, a stack overflow or a failed allocation; after a panic it gets its own name.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sixfold_fuzz::{Reader, mutated, readers, with_checksum};

const USAGE: &str = "usage: sixfold-fuzz [--inputs N] [--seed S] [--reader NAME] [--out DIR] [FILE]\n\n\
    --inputs N     mutated files for each reader, a fraction of it for slow ones (default: 2000)\n\
    --seed S       seed of the mutations (default: 0)\n\
    --reader NAME  this reader alone\n\
    --out DIR      folder for inputs that are findings (default: out/fuzz)\n\
    FILE           read this file with --reader and nothing else: a finding, again";
/// Longest time of a reader for a file of a few kilobytes; a longer time is a finding.
const LIMIT: Duration = Duration::from_secs(10);

struct Arguments {
    inputs: usize,
    seed: u64,
    reader: Option<String>,
    out: PathBuf,
    file: Option<PathBuf>,
}

fn main() -> ExitCode {
    let found = arguments().and_then(|a| run(&a));
    match found {
        Ok(0) => ExitCode::SUCCESS,
        Ok(findings) => {
            eprintln!("{findings} findings");
            ExitCode::from(1)
        }
        Err(message) => {
            eprintln!("{message}");
            ExitCode::from(2)
        }
    }
}

fn arguments() -> Result<Arguments, String> {
    let mut a = Arguments { inputs: 2000, seed: 0, reader: None, out: "out/fuzz".into(), file: None };
    let mut words = std::env::args().skip(1);
    while let Some(word) = words.next() {
        let mut value = || words.next().ok_or_else(|| format!("{word}: a value is missing\n\n{USAGE}"));
        let number =
            |text: String| text.parse().map_err(|_| format!("{word}: found {text}, expected a number"));
        match word.as_str() {
            "--inputs" => a.inputs = number(value()?)? as usize,
            "--seed" => a.seed = number(value()?)?,
            "--reader" => a.reader = Some(value()?),
            "--out" => a.out = value()?.into(),
            _ if word.starts_with('-') || a.file.is_some() => return Err(USAGE.to_owned()),
            _ => a.file = Some(word.into()),
        }
    }
    Ok(a)
}

/// Returns the number of findings.
fn run(a: &Arguments) -> Result<usize, String> {
    let all = readers();
    let names: Vec<&str> = all.iter().map(|r| r.name).collect();
    let chosen: Vec<(u64, Reader)> = (0u64..)
        .zip(all.iter().copied())
        .filter(|(_, r)| a.reader.as_deref().is_none_or(|name| name == r.name))
        .collect();
    if chosen.is_empty() {
        let name = a.reader.as_deref().unwrap_or_default();
        return Err(format!("--reader: found {name}, expected one of {}", names.join(", ")));
    }
    if let Some(file) = &a.file {
        let [(_, reader)] = chosen[..] else { return Err("FILE needs --reader".to_owned()) };
        let bytes = std::fs::read(file).map_err(|e| format!("{}: {e}", file.display()))?;
        (reader.check)(&bytes);
        println!("{}: no finding", reader.name);
        return Ok(0);
    }
    std::fs::create_dir_all(&a.out).map_err(|e| format!("{}: {e}", a.out.display()))?;
    let mut findings = 0;
    for (stream, reader) in chosen {
        findings += fuzz(a, &reader, stream)?;
    }
    Ok(findings)
}

fn fuzz(a: &Arguments, reader: &Reader, stream: u64) -> Result<usize, String> {
    let seeds = (reader.seeds)();
    let mut random = ChaCha8Rng::seed_from_u64(a.seed);
    random.set_stream(stream);
    let current = a.out.join(format!("{}.current", reader.name));
    let (mut findings, mut slowest, start) = (0, Duration::ZERO, Instant::now());
    let inputs = a.inputs.div_ceil(reader.cost);
    // The seeds themselves come first: they must be readable, so that mutations start from valid files.
    for number in 0..seeds.len() + inputs {
        let mut bytes = seeds.get(number).cloned().unwrap_or_else(|| mutated(&seeds, &mut random));
        if reader.checksum && number >= seeds.len() && random.random_bool(0.5) {
            bytes = with_checksum(bytes);
        }
        std::fs::write(&current, &bytes).map_err(|e| format!("{}: {e}", current.display()))?;
        let began = Instant::now();
        let held = catch_unwind(AssertUnwindSafe(|| (reader.check)(&bytes))).is_ok();
        let took = began.elapsed();
        slowest = slowest.max(took);
        if !held || took > LIMIT {
            findings += 1;
            let kept = a.out.join(format!("{}-{}-{number}", reader.name, a.seed));
            keep(&current, &kept)?;
            let what = if held { "took too long" } else { "does not hold" };
            eprintln!("{}: input {number} {what}: {}", reader.name, kept.display());
        }
    }
    let _ = std::fs::remove_file(&current);
    println!(
        "{:14} {inputs:6} inputs {:6.1} s, slowest {:7.1} ms, {findings} findings",
        reader.name,
        start.elapsed().as_secs_f64(),
        1000.0 * slowest.as_secs_f64()
    );
    Ok(findings)
}

fn keep(current: &Path, kept: &Path) -> Result<(), String> {
    std::fs::rename(current, kept).map_err(|e| format!("{}: {e}", kept.display()))
}
