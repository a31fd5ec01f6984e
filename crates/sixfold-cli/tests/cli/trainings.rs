//! Trainings on other data than those in their folder, two at once in one folder, and invalid options.

use std::time::{Duration, Instant};

use sixfold_mesh::{PlyFormat, Unit, read_mesh, write_ply};

use crate::support::*;

const PIX2POSE: &str =
    "train pix2pose --dataset tiny --size 64 --per-object 1 --render-fraction 0 --steps 2 --out trained";
const DETECTOR: &str = "train detector --dataset tiny --size 96 --batch 1 --steps 2 --out trained";

/// Replaces a file of the dataset while `run` runs.
fn with_another(tiny: &Tiny, file: &str, other: &[u8], run: impl FnOnce()) {
    let file = tiny.file(file);
    let before = std::fs::read(&file).unwrap();
    std::fs::write(&file, other).unwrap();
    run();
    std::fs::write(&file, before).unwrap();
}

#[test]
fn a_training_on_other_data_is_refused_and_signs_no_card() {
    for train in [PIX2POSE, DETECTOR] {
        let tiny = Tiny::coloured();
        let dir = tiny.path();
        let frames = r#"[{"scene_id": 7, "im_id": 0}, {"scene_id": 7, "im_id": 11}]"#;
        std::fs::write(dir.join("two.json"), frames).unwrap();
        std::fs::write(
            dir.join("other.json"),
            r#"[{"scene_id": 7, "im_id": 0}, {"scene_id": 7, "im_id": 4}]"#,
        )
        .unwrap();
        let same = format!("{train} --ids 1 --frames two.json");
        sixfold(dir, &same).expect(0);
        let kept = || {
            ["safetensors", "md"].map(|end| std::fs::read(dir.join(format!("trained/model.{end}"))).unwrap())
        };
        let model = kept();
        let refused = |command: &str, words: &[&str]| {
            // For a resumed or finished training, and for an export.
            for end in ["", " --export"] {
                let words = [&["trained", "other inputs", "another folder"], words].concat();
                fails(dir, &format!("{command}{end}"), &words);
                assert!(kept() == model, "{command}{end} wrote the model");
            }
        };
        refused(&same.replace("--ids 1", "--ids 2"), &[r#"ids was "1", is "2""#]);
        refused(&same.replace("--ids 1", "--ids 1,2"), &[r#"ids was "1", is "1, 2""#]);
        refused(
            &same.replace("two.json", "other.json"),
            &[r#"frames was "7/0 7/11", is "7/0 7/4""#, "photographs was"],
        );
        refused(&format!("{same} --rotation 20"), &["rotation was"]);
        refused(&format!("{same} --no-mesh-colors"), &["color"]);
        // The same paths with other contents: a photograph, a mesh, a pose.
        let photograph = std::fs::read(tiny.file("test/000007/rgb/000004.png")).unwrap();
        with_another(&tiny, "test/000007/rgb/000000.png", &photograph, || {
            refused(&same, &["photographs was"])
        });
        let mesh = read_mesh(tiny.file("models/obj_000001.ply"), Unit::Millimetre).unwrap().scaled(1.01);
        write_ply(dir.join("larger.ply"), &mesh, Unit::Millimetre, PlyFormat::BinaryLittleEndian).unwrap();
        let larger = std::fs::read(dir.join("larger.ply")).unwrap();
        with_another(&tiny, "models/obj_000001.ply", &larger, || refused(&same, &["mesh of object 1 was"]));
        // Initial weights, and photographs for backgrounds.
        std::fs::create_dir(dir.join("photographs")).unwrap();
        std::fs::copy(tiny.file("test/000007/rgb/000004.png"), dir.join("photographs/a.png")).unwrap();
        refused(&format!("{same} --backgrounds photographs"), &[r#"backgrounds was "none", is "1 files"#]);
        refused(&format!("{same} --init trained/model.safetensors"), &["init was null, is"]);
        // The same data at another path count as the same.
        std::fs::rename(dir.join("tiny"), dir.join("moved")).unwrap();
        sixfold(dir, &same.replace("tiny", "moved")).expect(0);
    }
}

#[cfg(all(feature = "experience", feature = "physics"))]
#[test]
fn trainings_without_data_know_their_options_before_they_make_anything() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    for command in [
        "train mttm --steps 1 --objects 16 --scenes 4 --anchors 2",
        "train dgcm --steps 1 --views 64 --pairs 2",
    ] {
        let method = command.split(' ').nth(1).unwrap();
        let train = format!("{command} --out {method}");
        sixfold(dir, &train).expect(0);
        let other_number = if method == "mttm" { "--scenes 100000" } else { "--views 500000" };
        let (before, _) =
            train.split_once(if method == "mttm" { "--scenes 4" } else { "--views 64" }).unwrap();
        let more = format!("{before} {other_number} --out {method}");
        for other in [format!("{train} --seed 1"), format!("{train} --learning-rate 0.5"), more] {
            fails(dir, &other, &[method, "other inputs", "was", "another folder"]);
            fails(dir, &format!("{other} --export"), &[method, "other inputs"]);
        }
        sixfold(dir, &format!("{train} --export")).expect(0);
    }
    // Another training continues from the first one's weights, and says so in its card.
    let more = "train dgcm --init dgcm/model.safetensors --steps 1 --views 64 --pairs 2 --out more --json";
    let more = sixfold(dir, more).expect(0).json();
    assert_eq!((&more["quality"]["pairs"], &more["views"]), (&8.into(), &64.into()));
    assert!(more["quality"]["coordinates"].as_f64().is_some_and(|error| error > 0.0 && error < 2.0));
    let card = std::fs::read_to_string(dir.join("more/model.md")).unwrap();
    assert!(card.contains("continued_from") && card.contains("dgcm/model.safetensors"), "{card}");
    fails(dir, "train dgcm --init none.safetensors --views 64 --out fresh", &["init", "none.safetensors"]);
    // The alignment alone.
    let alignment =
        "train dgcm --alignment-only --init more/model.safetensors --steps 1 --views 64 --pairs 2";
    let run = sixfold(dir, &format!("{alignment} --out aligned")).expect(0);
    assert!(run.stderr.contains("after alignment") && !run.stderr.contains("metric"), "{}", run.stderr);
    fails(dir, &alignment.replace("--init more/model.safetensors", "--out fresh"), &["--init"]);
    fails(dir, &format!("{alignment} --out fresh --network paper"), &["--alignment-only", "network compact"]);
}

#[test]
fn two_trainings_in_one_folder_one_is_refused() {
    let tiny = Tiny::coloured();
    let run = |steps: u32| {
        std::process::Command::new(crate::PROGRAM)
            .args(PIX2POSE.replace("--steps 2", &format!("--steps {steps} --ids 1")).split(' '))
            .current_dir(tiny.path())
            .stderr(std::process::Stdio::null())
            .spawn()
            .unwrap()
    };
    let mut first = run(100_000);
    let log = tiny.path().join("trained/training/log.jsonl");
    let started = Instant::now();
    while !log.exists() && started.elapsed() < Duration::from_secs(120) {
        std::thread::sleep(Duration::from_millis(50));
    }
    let second = PIX2POSE.replace("--steps 2", "--steps 100000 --ids 1");
    let words = ["trained", "another process", &format!("({})", first.id())];
    fails(tiny.path(), &second, &words);
    fails(tiny.path(), &format!("{second} --export"), &words);
    // After it was killed, nothing is locked.
    first.kill().unwrap();
    first.wait().unwrap();
    sixfold(tiny.path(), &format!("{second} --export")).expect(0);
}

#[test]
fn options_that_no_training_can_have() {
    let tiny = Tiny::coloured();
    let p = format!("{PIX2POSE} --ids 1");
    let d = format!("{DETECTOR} --ids 1");
    let without = |command: &str, option: &str| {
        let words: Vec<&str> = command.split(' ').collect();
        let at = words.iter().position(|w| *w == option).unwrap();
        [&words[..at], &words[at + 2..]].concat().join(" ")
    };
    let cases = [
        (format!("{p} --frozen-stages 99"), "--frozen-stages: found 99, expected 0 to 5"),
        (format!("{d} --frozen-stages 6"), "--frozen-stages: found 6, expected 0 to 5"),
        (format!("{PIX2POSE} --ids 2,1,2"), "--ids: object 2 is named more than once"),
        (format!("{DETECTOR} --ids 1,1"), "--ids: object 1 is named more than once"),
        (
            without(&p, "--per-object") + " --per-object 100000",
            "--per-object: found 100000, expected at most 1024",
        ),
        (without(&p, "--per-object") + " --per-object 0", "--per-object: found 0, expected 1 or more"),
        (without(&d, "--batch") + " --batch 100000000", "--batch: found 100000000, expected at most 1024"),
        (
            without(&p, "--steps") + " --steps 18446744073709551615",
            "--steps: found 18446744073709551615, expected at most",
        ),
        (without(&p, "--render-fraction") + " --render-fraction nan", "--render-fraction: found NaN"),
        (format!("{p} --near-photographs nan"), "--near-photographs: found NaN"),
        (format!("{p} --learning-rate nan"), "--learning-rate: found NaN"),
        (format!("{p} --learning-rate inf"), "--learning-rate: found inf"),
        (format!("{p} --rotation nan"), "found nan, expected degrees from 0 to 180"),
        (format!("{d} --threshold nan"), "--threshold: found NaN"),
        (format!("{d} --encoder-rate nan"), "--encoder-rate: found NaN"),
        (format!("{d} --photograph-fraction nan"), "--photograph-fraction: found NaN"),
        (without(&d, "--size") + " --size 50", "--size: found 50, expected a multiple of 32"),
        (without(&d, "--steps") + " --steps 0", "--steps: found 0, expected 1 or more"),
        ("train nol --out trained --steps 0".to_owned(), "--steps: found 0, expected 1 or more"),
        #[cfg(feature = "physics")]
        ("train mttm --out trained --steps 0".to_owned(), "--steps: found 0, expected 1 or more"),
        #[cfg(feature = "physics")]
        (
            "train mttm --out trained --anchors 100000".to_owned(),
            "--anchors: found 100000, expected at most 1024",
        ),
        #[cfg(feature = "experience")]
        ("train dgcm --out trained --steps 0".to_owned(), "--steps: found 0, expected 1 or more"),
        #[cfg(feature = "experience")]
        ("train dgcm --out trained --lambda nan".to_owned(), "--lambda: found NaN"),
        #[cfg(feature = "experience")]
        (
            "train dgcm --out trained --pairs 100000".to_owned(),
            "--pairs: found 100000, expected at most 1024",
        ),
    ];
    for (command, message) in cases {
        fails(tiny.path(), &command, &[message]);
        // Nothing was started.
        assert!(!tiny.path().join("trained").exists(), "{command}");
    }
}

#[test]
fn help_shows_the_defaults() {
    let dir = tempfile::tempdir().unwrap();
    let shown = [
        ("pix2pose", "(default: 8000; the dissertation's networks: 25000). 0: keep the weights"),
        ("pix2pose", "(default: 4; the dissertation's networks: 50)"),
        ("pix2pose", "(default: 0.002; the dissertation's networks: 0.0001)"),
        ("pix2pose", "Largest rotation of photographs in the image plane, degrees [default: 45]"),
        ("pix2pose", "Side of the network's input in pixels; the output has half of it [default: 128]"),
        ("pix2pose", "- tless: T-LESS"),
        ("detector", "Maximum learning rate [default: 0.002]"),
        ("detector", "Largest rotation in the image plane, degrees [default: 15]"),
        ("detector", "Default score threshold of the detector, 0 to 1 [default: 0.4]"),
        ("nol", "(default: 5000; the dissertation's network: 350000)"),
        ("nol", "- average: Their mean, for comparison"),
        ("nol", "[default: lstm]"),
        #[cfg(feature = "physics")]
        ("mttm", "Regions with an object in a step (default: 40; the dissertation's network: 16)"),
        #[cfg(feature = "experience")]
        ("dgcm", "(default: 10, with 3 negative ones; the dissertation's network: 25 of both)"),
        #[cfg(feature = "experience")]
        ("dgcm", "feature loss (default: 300; the dissertation's network: 1)"),
    ];
    for (training, text) in shown {
        let help = sixfold(dir.path(), &format!("train {training} --help")).expect(0).stdout;
        let help = help.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(help.contains(text), "{training}: {text}\n{help}");
    }
}
