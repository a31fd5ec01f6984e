//! Output to the screen: errors as JSON, a standard output that cannot be written, texts with control characters.

use sixfold_mesh::{PlyFormat, Unit, write_ply};

use crate::support::*;

#[test]
fn errors_are_json_with_json() {
    let dir = tempfile::tempdir().unwrap();
    let eval = "eval --dataset nowhere --results results.csv";
    let run = sixfold(dir.path(), &format!("{eval} --json")).expect(2);
    let error = &run.json()["error"];
    assert_eq!((&error["kind"], &error["exit_status"]), (&"command".into(), &2.into()));
    let message = error["message"].as_str().unwrap();
    assert!(message.contains("nowhere") && run.stderr.contains(message), "{message}\n{}", run.stderr);

    // The command line itself is wrong.
    for arguments in ["eval --nonsense 3 --json", "grasp propose --json", "nonsense --json"] {
        let run = sixfold(dir.path(), arguments).expect(2);
        let json = run.json();
        let error = &json["error"];
        assert_eq!(error["kind"], "usage", "{arguments}: {json}");
        let message = error["message"].as_str().unwrap();
        assert!(!message.is_empty() && !message.contains("Usage:"), "{arguments}: {message}");
    }

    // Otherwise errors print nothing to standard output.
    for arguments in [eval.to_owned(), format!("{eval} --json out.json"), "eval --nonsense".into()] {
        assert_eq!(sixfold(dir.path(), &arguments).expect(2).stdout, "", "{arguments}");
    }
}

#[cfg(feature = "experience")]
#[test]
fn passwords_are_never_printed_with_an_address() {
    let dir = tempfile::tempdir().unwrap();
    for address in [
        "postgres://robot:secret@127.0.0.1:1/fleet",
        "Postgres://robot%3Asecret@127.0.0.1:1/fleet",
        "password=secret",
        "robot:sec,secret,ret@127.0.0.1/fleet",
    ] {
        for arguments in [
            "ADDRESS",
            "--ADDRESS",
            "--threads ADDRESS object list",
            "grasp ADDRESS",
            "grasp learn ADDRESS",
            "grasp learn --ADDRESS",
            "grasp learn --attempts ADDRESS",
            "grasp learn --attempts=ADDRESS",
            "grasp learn --out ADDRESS",
            "grasp store ADDRESS",
            "grasp store list a.db ADDRESS",
            "grasp store show a.db ADDRESS",
            "grasp store merge a.db ADDRESS",
            "grasp compare ADDRESS",
            "reproduce ADDRESS",
            "detect --weights w.safetensors --dataset lmo --out found.json --ids ADDRESS",
            "estimate --depth ADDRESS --camera c.json --object part.ply --unit mm",
            "estimate --method ADDRESS",
            "eval --dataset ADDRESS --results results.csv",
            "object show ADDRESS",
            "render --object ADDRESS --unit mm --out out",
            "completions ADDRESS",
        ] {
            for json in ["", " --json"] {
                let run = sixfold(dir.path(), &(arguments.replace("ADDRESS", address) + json));
                assert!(run.code != 0 && !run.stderr.is_empty(), "{arguments}: {run:?}");
                let printed = format!("{}{}", run.stdout, run.stderr);
                assert!(!printed.contains("secret"), "{arguments}: {printed}");
            }
        }
    }
}

#[cfg(target_os = "linux")]
#[test]
fn output_that_cannot_be_printed_is_an_error_not_a_panic() {
    let tiny = Tiny::new(false);
    tiny.write_truth_as_results("results.csv");
    let eval = "eval --dataset tiny --results results.csv";
    for arguments in [
        "object list --json",
        "object list",
        "completions bash",
        "--help",
        "--version",
        eval,
        &format!("{eval} --json"),
    ] {
        let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
        let output = std::process::Command::new(crate::PROGRAM)
            .args(arguments.split_whitespace())
            .current_dir(tiny.path())
            .stdout(full)
            .output()
            .unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments}: {stderr}");
        assert!(stderr.contains("standard output: cannot be written"), "{arguments}: {stderr}");
        assert!(!stderr.contains("panicked"), "{arguments}: {stderr}");
    }
}

#[test]
fn control_characters_of_names_do_not_reach_the_terminal() {
    let dir = tempfile::tempdir().unwrap();
    let name = "part\u{1b}]0;title\u{7}\u{9b}2J.ply";
    write_ply(dir.path().join(name), &part(), Unit::Millimetre, PlyFormat::BinaryLittleEndian).unwrap();
    sixfold(dir.path(), &format!("object add part {name} --unit mm")).expect(0);
    let shown = sixfold(dir.path(), "object show part").expect(0).stdout;
    assert!(shown.contains("part\\u001b]0;title\\u0007\\u009b2J.ply"), "{shown:?}");
    let json = sixfold(dir.path(), "object show part --json").expect(0);
    assert!(json.json().to_string().contains("]0;title"), "{}", json.stdout);
    let failed = sixfold(dir.path(), &format!("render --object {name}x --unit mm")).expect(2).stderr;
    for text in [shown, json.stdout, failed] {
        assert!(!text.contains(|c: char| c.is_control() && c != '\n'), "{text:?}");
    }
}
