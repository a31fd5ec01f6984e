//! `sixfold object`, `sixfold render`, `sixfold completions` and the help.

use crate::support::*;

#[test]
fn objects_are_added_listed_shown_used_and_removed() {
    let case = OneImage::new();
    let dir = case.path();
    sixfold(dir, "object list").expect(1);
    let run = sixfold(dir, "object add my-part part.ply --unit mm").expect(0);
    assert!(run.stdout.contains("my-part"), "{}", run.stdout);
    let listed = sixfold(dir, "object list --json").expect(0).json();
    assert_eq!(listed[0]["name"], "my-part");
    assert!((listed[0]["diameter"].as_f64().unwrap() - part().diameter()).abs() < 1e-6);
    let shown = sixfold(dir, "object show my-part --picture part.png --json").expect(0).json();
    assert_eq!(shown["faces"], part().faces().len());
    assert_eq!(shown["version"], 1);
    let picture = image::open(dir.join("part.png")).unwrap().to_rgb8();
    assert!(picture.pixels().any(|p| p.0 != [255; 3]));

    // The store knows the unit, so estimate and render need the name only.
    let run =
        sixfold(dir, "estimate --depth depth.png --camera camera.json --object my-part --json").expect(0);
    assert_eq!(run.json()["poses"][0]["object"], "my-part");
    assert_near(&pose_of(&run.json()["poses"][0]["camera_from_object"]), &case.truth);

    fails(dir, "object add my-part part.ply --unit mm", &["my-part", "--replace"]);
    sixfold(dir, "object add my-part part.ply --unit mm --turns-about z --replace").expect(0);
    let shown = sixfold(dir, "object show my-part --json").expect(0).json();
    assert_eq!(shown["symmetries_continuous"].as_array().unwrap().len(), 1);

    sixfold(dir, "object remove my-part").expect(0);
    fails(dir, "object show my-part", &["my-part", "none yet", "sixfold object add"]);
    fails(dir, "object remove my-part", &["my-part"]);
    sixfold(dir, "object list").expect(1);
    // Nothing of it stays behind, no half-written folder either.
    assert_eq!(std::fs::read_dir(dir.join("sixfold-objects")).unwrap().count(), 0);
}

#[test]
fn a_unit_off_by_a_thousand_is_explained() {
    let case = OneImage::new();
    fails(case.path(), "object add big part.ply --unit m", &["part.ply", "--unit mm", "181 mm"]);
    sixfold(case.path(), "object list").expect(1);
}

#[test]
fn a_name_cannot_lead_out_of_the_store() {
    let case = OneImage::new();
    fails(case.path(), "object add ../part part.ply --unit mm", &["../part", "letters"]);
    fails(case.path(), "object remove ..", &["\"..\""]);
    assert!(case.path().join("part.ply").is_file());
}

#[test]
fn symmetries_come_from_models_info() {
    let tiny = Tiny::new(false);
    let info = tiny.file("models/models_info.json");
    let mut json: serde_json::Value = serde_json::from_slice(&std::fs::read(&info).unwrap()).unwrap();
    json["2"]["symmetries_discrete"] =
        serde_json::json!([[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]);
    std::fs::write(&info, json.to_string()).unwrap();
    let add =
        "object add two tiny/models/obj_000002.ply --unit mm --models-info tiny/models/models_info.json";
    let json = sixfold(tiny.path(), &format!("{add} --model-id 2 --json")).expect(0).json();
    assert_eq!(json["symmetries_discrete"][0][0][0], -1.0);
    fails(tiny.path(), &format!("{add} --model-id 9 --replace"), &["models_info.json", "9"]);
}

#[test]
fn render_writes_what_is_seen() {
    let case = OneImage::new();
    let dir = case.path();
    let t = case.truth.translation();
    let r = case.truth.rotation().scaled_axis();
    let pose = format!("{},{},{},{},{},{}", t.x, t.y, t.z, r.x, r.y, r.z);
    let arguments =
        format!("render --object part.ply --unit mm --camera camera.json --pose {pose} --out seen --json");
    let json = sixfold(dir, &arguments).expect(0).json();
    assert_near(&pose_of(&json["camera_from_object"]), &case.truth);
    let names = ["depth.png", "mask.png", "normals.png", "coordinates.png", "rgb.png"];
    assert_eq!(json["files"].as_array().unwrap().len(), names.len());
    for name in names {
        let picture = image::open(dir.join("seen").join(name)).unwrap();
        assert_eq!((picture.width(), picture.height()), (WIDTH as u32, HEIGHT as u32), "{name}");
    }
    // The mask covers exactly where the library sees the object, and its depth is the same.
    let expected = sixfold_render::render_depth(&part(), &case.truth, &camera());
    let found = sixfold_io::read_depth(&dir.join("seen/depth.png"), 1e-4).unwrap();
    let mask = sixfold_io::read_mask(&dir.join("seen/mask.png")).unwrap();
    let mut pixels = 0;
    for (i, z) in expected.as_slice().iter().enumerate() {
        let seen = *z > 0.0;
        assert_eq!(mask.as_slice()[i], seen);
        assert!((found.as_slice()[i] - z).abs() < 1e-4, "{} {z}", found.as_slice()[i]);
        pixels += usize::from(seen);
    }
    assert_eq!(json["pixels"], pixels);

    // Behind the camera there is nothing to see.
    sixfold(dir, "render --object part.ply --unit mm --pose 0,0,-0.5,0,0,0 --out behind").expect(1);
    fails(dir, "render --object part.ply --unit mm --pose 0,0,1", &["--pose", "3 numbers"]);
    let mirrored = "-1,0,0,0,0,1,0,0,0,0,1,0.5,0,0,0,1";
    fails(dir, &format!("render --object part.ply --unit mm --pose {mirrored}"), &["--pose", "rotation"]);
}

#[test]
fn completions_know_the_commands() {
    let dir = tempfile::tempdir().unwrap();
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let run = sixfold(dir.path(), &format!("completions {shell}")).expect(0);
        for word in ["estimate", "simulate-depth", "completions"] {
            assert!(run.stdout.contains(word), "{shell}: {word}");
        }
    }
}

/// The names under `Commands:` of a help text.
fn commands(help: &str) -> Vec<String> {
    help.lines()
        .skip_while(|l| *l != "Commands:")
        .skip(1)
        .take_while(|l| !l.is_empty())
        // A name stands two columns in; a wrapped description further right.
        .filter_map(|l| l.strip_prefix("  ").filter(|l| !l.starts_with(' '))?.split_whitespace().next())
        .filter(|name| *name != "help")
        .map(str::to_owned)
        .collect()
}

#[test]
fn every_command_has_help_with_an_example() {
    let dir = tempfile::tempdir().unwrap();
    let top = sixfold(dir.path(), "--help").expect(0).stdout;
    let mut paths = commands(&top);
    assert!(paths.len() >= 7, "{top}");
    let mut seen = 0;
    while let Some(path) = paths.pop() {
        let help = sixfold(dir.path(), &format!("{path} --help")).expect(0).stdout;
        assert!(
            help.contains("Example") && help.contains("  sixfold "),
            "{path} --help has no example:\n{help}"
        );
        paths.extend(commands(&help).into_iter().map(|c| format!("{path} {c}")));
        seen += 1;
    }
    assert!(seen >= 11, "{seen} commands");
    assert!(sixfold(dir.path(), "--version").expect(0).stdout.starts_with("sixfold "));
}

#[test]
fn a_reader_that_went_away_ends_the_program_without_a_panic() {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_sixfold"))
        .args(["completions", "bash"])
        .stdout(writer)
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(141));
    assert!(output.stderr.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));
}
