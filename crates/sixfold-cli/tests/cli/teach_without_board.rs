//! `sixfold teach --no-board`: an object from photographs of it on a patterned cloth, and the messages for unusable
//! photographs.

use std::path::Path;

use sixfold_geometry::{Camera, Pose, RgbImage, Vec3};
use sixfold_io::write_rgb;
use sixfold_mesh::Mesh;
use sixfold_teach::simulation::{SimulatedCapture, SimulationOptions, patterned};

use crate::support::{fails, sixfold};

const PHOTOGRAPHS: usize = 12;

fn camera() -> Camera {
    Camera { fx: 620.0, fy: 620.0, cx: 322.0, cy: 238.0, width: 640, height: 480, distortion: None }
}

/// A block, 90 x 60 x 70 mm.
fn block() -> Mesh {
    let corner = |i: usize| {
        let side = |bit: usize, half: f64| if i >> bit & 1 == 0 { -half } else { half };
        Vec3::new(side(0, 0.045), side(1, 0.03), 0.035 + side(2, 0.035))
    };
    let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let faces = sides.into_iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
    let mesh = Mesh::new((0..8).map(corner).collect(), faces).unwrap();
    mesh.with_colors((0..8).map(|i| [240 - 10 * i, 90 + 12 * i, 30]).collect()).unwrap()
}

/// Writes the photographs; returns the options for the scale.
fn write_photographs(folder: &Path) -> String {
    std::fs::create_dir(folder).unwrap();
    let (mesh, cloth, table) = (block(), patterned(1024, 2), RgbImage::filled(8, 8, [110, 105, 95]));
    let options = SimulationOptions {
        photographs: PHOTOGRAPHS,
        camera: camera(),
        distance: [0.4, 0.48],
        motion: 0.5,
        blur: 0.5,
        ..SimulationOptions::default()
    };
    let capture = SimulatedCapture::without_board(&mesh, (&cloth, 0.5), &table, &options, 5);
    for i in 0..PHOTOGRAPHS {
        write_rgb(&folder.join(format!("{i:02}.png")), &capture.photograph(i).unwrap()).unwrap();
    }
    let marked = |pose: &Pose, x: f64| {
        let p = camera().project(&pose.transform_point(&Vec3::new(x, 0.08, 0.0))).unwrap();
        format!("{:.1},{:.1}", p.x, p.y)
    };
    let ends = [0, 3, 6].map(|i| {
        let pose = &capture.camera_from_board[i];
        format!("{i:02}.png:{}:{}", marked(pose, -0.1), marked(pose, 0.1))
    });
    format!("--no-board --length 0.2 --ends {}", ends.join(" "))
}

#[test]
fn an_object_is_taught_without_a_board() {
    let case = tempfile::tempdir().unwrap();
    let scale = write_photographs(&case.path().join("photographs"));
    let teach = format!("teach block --photographs photographs --hull-only --json {scale}");
    let taught = sixfold(case.path(), &teach).expect(0).json();
    assert_eq!(taught["photographs"], PHOTOGRAPHS, "{taught}");
    let ratio = taught["diameter"].as_f64().unwrap() / block().diameter();
    assert!((ratio - 1.0).abs() < 0.06, "{ratio}: {taught}");
    let size = |key: &str| taught[key].as_array().map(|v| v.len());
    assert_eq!(size("left_out"), Some(0), "{taught}");
    let folder = case.path().join("out/teach/block");
    let state = std::fs::read_to_string(folder.join("teaching.json")).unwrap();
    let state: serde_json::Value = serde_json::from_str(&state).unwrap();
    assert_eq!((&state["world"], &state["length"]["metres"]), (&"features".into(), &0.2.into()));
    assert!(state["floor"].is_array() && state["located"].is_array(), "{state}");
}

#[test]
fn missing_arguments_are_reported_before_any_computation() {
    let case = tempfile::tempdir().unwrap();
    std::fs::create_dir(case.path().join("bare")).unwrap();
    for i in 0..4u8 {
        write_rgb(&case.path().join(format!("bare/{i}.png")), &RgbImage::filled(96, 64, [40 * i; 3]))
            .unwrap();
    }
    let run = |options: &str, expected: &[&str]| {
        fails(case.path(), &format!("teach none --photographs bare {options}"), expected);
    };
    run("--no-board", &["--length", "--ends", "depth images"]);
    let ends = "--ends 0.png:1,2:3,4 1.png:1,2:3,4";
    run(&format!("--no-board --length 0.1 {ends}"), &["0 photographs", "texture", "0.png: 0 features"]);
    run(&format!("--no-board --length 120 {ends}"), &["--length", "metres, 0.005 to 5"]);
    run(&format!("--length 0.1 {ends}"), &["--no-board"]);
    run(
        "--no-board --length 0.1 --ends 0.png:1,2:3,4",
        &["--ends: the first point is marked in 1 photographs"],
    );
    run(
        "--no-board --length 0.1 --ends 7.png:1,2:3,4 1.png:1,2:3,4",
        &["--ends: found 7.png", "4 photographs"],
    );
    run("--no-board --length 0.1 --ends 0.png:1,2:3 1.png:1,2:3,4", &["PHOTOGRAPH:X,Y:X,Y"]);
    run("--no-board --length 0.1 --ends 0.png:1,2:300,4 1.png:1,2:3,4", &["0.png: found 300,4", "96x64"]);
    run("--no-board --ruler 100", &["--ruler"]);
}
