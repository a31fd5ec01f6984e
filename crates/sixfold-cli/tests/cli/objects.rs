//! `sixfold object`, `sixfold render`, `sixfold completions` and the help.

use sixfold_geometry::Vec3;
use sixfold_mesh::{Mesh, PlyFormat, Unit, write_ply};

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

    // The store contains the unit, so estimate and render need only the name.
    let run =
        sixfold(dir, "estimate --depth depth.png --camera camera.json --object my-part --json").expect(0);
    assert_eq!(run.json()["poses"][0]["object"], "my-part");
    assert_near(&pose_of(&run.json()["poses"][0]["camera_from_object"]), &case.truth);

    fails(dir, "object add my-part part.ply --unit mm", &["my-part", "--replace"]);
    sixfold(dir, "object add my-part part.ply --unit mm --symmetric-about z --replace").expect(0);
    let shown = sixfold(dir, "object show my-part --json").expect(0).json();
    assert_eq!(shown["symmetries_continuous"].as_array().unwrap().len(), 1);

    sixfold(dir, "object remove my-part").expect(0);
    fails(dir, "object show my-part", &["my-part", "none yet", "sixfold object add"]);
    fails(dir, "object remove my-part", &["my-part"]);
    sixfold(dir, "object list").expect(1);
    // Nothing of it remains, not even an incomplete folder.
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

/// A box in the file `box.ply`, one of its sides red.
fn write_box(dir: &std::path::Path) {
    let corner = |i: u32| Vec3::new(0.03, 0.04, 0.055).component_mul(&sign(i));
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let vertices = quads.as_flattened().iter().map(|i| corner(*i)).collect();
    let faces = (0..6).flat_map(|q| [[4 * q, 4 * q + 1, 4 * q + 2], [4 * q, 4 * q + 2, 4 * q + 3]]);
    let colors = (0..24).map(|v| if v < 4 { [200, 20, 20] } else { [200; 3] }).collect();
    let mesh = Mesh::new(vertices, faces.collect()).unwrap().with_colors(colors).unwrap();
    write_ply(dir.join("box.ply"), &mesh, Unit::Millimetre, PlyFormat::Ascii).unwrap();
}

/// The signs of a corner of a box.
fn sign(i: u32) -> Vec3 {
    Vec3::from([0, 1, 2].map(|k| if i >> k & 1 == 1 { 1.0 } else { -1.0 }))
}

#[test]
fn symmetries_are_found_shown_and_stored() {
    let case = OneImage::new();
    let dir = case.path();
    write_box(dir);
    let find = "object symmetries box.ply --unit mm";
    let json = sixfold(dir, &format!("{find} --json --out box.png")).expect(0).json();
    let found = json.as_array().unwrap();
    assert_eq!(found.len(), 3, "{json:#}");
    assert!(found.iter().all(|s| s["order"] == 2 && s["by_shape"] == "sure"));
    // The red side is at the bottom: half turns about z keep it there.
    let kept: Vec<_> = found.iter().filter(|s| s["by_shape_and_color"] == "sure").collect();
    assert!(kept.len() == 1 && kept[0]["axis"][2].as_f64().unwrap() > 0.999, "{json:#}");
    assert_eq!(kept[0]["poses"][0][2][2].as_f64().unwrap().round(), 1.0);
    let sheet = image::open(dir.join("box.png")).unwrap().to_rgb8();
    assert_eq!(sheet.width() % 4, 0);
    // Four images: the object unchanged, and after each half turn.
    for i in 0..4 {
        let tile =
            image::imageops::crop_imm(&sheet, i * sheet.width() / 4, 40, sheet.width() / 4, 440).to_image();
        assert!(tile.pixels().filter(|p| p.0 != [255; 3]).count() > 5_000);
    }
    let table = sixfold(dir, find).expect(0).stdout;
    assert!(table.contains("symmetries: 3") && table.contains("by shape and colour"), "{table}");

    let count = |add: &str| {
        let json = sixfold(dir, &format!("object add {add} --replace --json")).expect(0).json();
        let length = |field: &str| json[field].as_array().unwrap().len();
        (length("symmetries_discrete"), length("symmetries_continuous"))
    };
    assert_eq!(count("box box.ply --unit mm --find-symmetries"), (1, 0));
    assert_eq!(count("box box.ply --unit mm --find-symmetries shape"), (3, 0));
    assert_eq!(count("box box.ply --unit mm"), (0, 0));
    let said = sixfold(dir, "object add box box.ply --unit mm --replace --find-symmetries").expect(0).stdout;
    assert!(said.contains("stored: order 2 about (0.000, 0.000, 1.000)"), "{said}");
    assert_eq!(said.matches("not stored, colours differ").count(), 2, "{said}");
    // By its name, as stored.
    assert_eq!(sixfold(dir, "object symmetries box --json").expect(0).json().as_array().unwrap().len(), 3);

    // An object without symmetries.
    assert_eq!(
        sixfold(dir, "object symmetries part.ply --unit mm --json").expect(1).json(),
        serde_json::json!([])
    );
    let said = sixfold(dir, "object add part part.ply --unit mm --find-symmetries").expect(0).stdout;
    assert!(said.contains("no symmetry found"), "{said}");
}

#[test]
fn symmetries_are_not_found_twice() {
    let tiny = Tiny::new(false);
    let dir = tiny.path();
    write_box(dir);
    fails(dir, "object symmetries box.ply", &["--unit"]);
    fails(dir, "object symmetries box.ply --unit mm --noise 50", &["--noise", "50", "0 to 0.02 m"]);
    fails(
        dir,
        "object add box box.ply --unit mm --find-symmetries --symmetric-about z",
        &["--symmetric-about"],
    );
    fails(dir, "object add box box.ply --unit mm --noise 1", &["--find-symmetries"]);
    // An entry with symmetries excludes other options; an entry without symmetries allows them.
    let info = tiny.file("models/models_info.json");
    let add = "object add box box.ply --unit mm --find-symmetries shape --model-id 2 --models-info \
               tiny/models/models_info.json --replace";
    let json = sixfold(dir, &format!("{add} --json")).expect(0).json();
    assert_eq!(json["symmetries_discrete"].as_array().unwrap().len(), 3);
    let mut json: serde_json::Value = serde_json::from_slice(&std::fs::read(&info).unwrap()).unwrap();
    json["2"]["symmetries_discrete"] =
        serde_json::json!([[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]);
    std::fs::write(&info, json.to_string()).unwrap();
    fails(dir, add, &["--find-symmetries", "--models-info", "leave out one"]);
}

#[test]
fn render_writes_the_visible_object() {
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
    // The mask covers exactly the pixels of the library's rendering, and its depth is the same.
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

    // Behind the camera nothing is visible.
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
        // Names are indented by two columns, wrapped descriptions by more.
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
