//! Standard output that cannot be written, and a folder that cannot be written.

use std::fs::File;
use std::path::Path;

use crate::driver::{Row, command, prepared, reference, start};
use crate::outputs::{differences, tree};
use crate::space::{Jail, jail};

/// Runs a row's command with a full standard output: its files are written nevertheless.
pub fn no_standard_output(row: &Row) {
    if !Path::new("/dev/full").exists() {
        println!("skipped: there is no /dev/full");
        return;
    }
    let reference = reference(row);
    let mut wrong = vec![];
    // The card of a network contains its command, so the arguments of a training are not changed.
    let as_it_is = row.arguments.contains("--json") || row.arguments.starts_with("train");
    let folder = prepared(row);
    let mut program = command(row, folder.path());
    if !as_it_is {
        program.arg("--json");
    }
    let output = program.stdout(File::options().write(true).open("/dev/full").unwrap()).output().unwrap();
    let message = String::from_utf8_lossy(&output.stderr);
    if output.status.code() != Some(2) || message.contains("panicked") || !message.contains("No space left") {
        wrong.push(format!("{}: {}", output.status, message.trim()));
    }
    wrong.extend(differences(&reference.tree, &tree(folder.path())));
    assert!(wrong.is_empty(), "sixfold {} > /dev/full\n{}", row.arguments, wrong.join("\n"));
}

/// Runs a row's command on a read-only file system.
pub fn read_only(row: &Row) {
    let Jail::Ready(wrap) = jail() else {
        println!("skipped: no file system can be mounted here");
        return;
    };
    let folder = prepared(row);
    let before = tree(folder.path());
    let inside = command(row, folder.path());
    let mut program = wrap(&[
        "sh",
        "-c",
        "mount --bind . . && mount -o remount,ro,bind . && cd \"$PWD\" && exec \"$@\"",
        "sh",
    ]);
    program.arg(inside.get_program()).args(inside.get_args());
    crate::driver::environment(&mut program, folder.path());
    let run = start(program).wait();
    let why = [
        "Read-only file system",
        "read-only",
        "readonly",
        "unable to open database file",
        "may only be read",
    ];
    let named = run.stderr.lines().any(|line| {
        why.iter().any(|words| line.contains(words)) && row.writes.iter().any(|name| line.contains(name))
    });
    assert!(run.code == 2 && named, "sixfold {}\nexit status {}: {}", row.arguments, run.code, run.stderr);
    assert_eq!(differences(&before, &tree(folder.path())), Vec::<String>::new());
}
