//! Commands that another program runs: `sixfold reproduce`, `sixfold grasp compare`, `sixfold grasp measure`.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::support::Run;

const OTHER: &str = "sixfold-experiments";

/// Runs a copy of the program that is alone in `folder`, with `path` as PATH.
fn run(folder: &Path, path: &str, arguments: &str) -> Run {
    let program = folder.join("sixfold");
    if !program.exists() && fs::hard_link(crate::PROGRAM, &program).is_err() {
        fs::copy(crate::PROGRAM, &program).unwrap();
    }
    let output = Command::new(program).args(arguments.split_whitespace()).env("PATH", path).output().unwrap();
    Run {
        code: output.status.code().unwrap_or(-1),
        stdout: String::from_utf8(output.stdout).unwrap(),
        stderr: String::from_utf8(output.stderr).unwrap(),
    }
}

/// A stand-in for the other program, which prints its arguments.
fn other(folder: &Path) -> PathBuf {
    let file = folder.join(OTHER);
    fs::write(&file, "#!/bin/sh\necho \"told: $*\"\nexit 7\n").unwrap();
    fs::set_permissions(&file, fs::Permissions::from_mode(0o755)).unwrap();
    file
}

const COMMANDS: [&str; 4] = [
    "reproduce mttm --dataset lmo --out out --json",
    "--threads 2 grasp measure --object a.ply --unit mm",
    "grasp compare --hard --help",
    "reproduce --help",
];

#[test]
fn the_other_program_is_run_from_beside_or_from_the_path() {
    let alone = tempfile::tempdir().unwrap();
    let elsewhere = tempfile::tempdir().unwrap();
    other(elsewhere.path());
    let path = format!("/nowhere:{}:/bin:/usr/bin", elsewhere.path().display());
    for command in COMMANDS {
        let found = run(alone.path(), &path, command).expect(7);
        assert_eq!(found.stdout, format!("told: {command}\n"));
    }
    // The program beside it comes first.
    let file = other(alone.path());
    fs::write(&file, "#!/bin/sh\nexit 5\n").unwrap();
    run(alone.path(), &path, COMMANDS[0]).expect(5);
}

#[test]
fn without_the_other_program_it_explains_the_installation() {
    let alone = tempfile::tempdir().unwrap();
    for command in COMMANDS {
        let failed = run(alone.path(), "/nowhere", command).expect(2);
        for words in [
            "cargo install --locked --path crates/sixfold-experiments",
            "cargo build --release -p sixfold-experiments",
        ] {
            assert!(failed.stderr.contains(words), "{}", failed.stderr);
        }
    }
    let help = run(alone.path(), "/nowhere", "--help").expect(0);
    assert!(help.stdout.contains("reproduce"), "{}", help.stdout);
    let help = run(alone.path(), "/nowhere", "grasp --help").expect(0);
    assert!(help.stdout.contains("compare") && help.stdout.contains("measure"), "{}", help.stdout);
}
