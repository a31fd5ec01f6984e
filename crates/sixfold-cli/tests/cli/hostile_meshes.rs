//! Meshes that refer to forbidden files, degenerate meshes, and two processes that change one stored object at
//! once.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use crate::support::*;

/// Commands that read a mesh file.
const COMMANDS: [&str; 3] = [
    "object add thing MESH --unit m --replace",
    "render --object MESH --unit m --camera camera.json --pose 0,0,0.5,0.4,0,0 --out seen",
    "estimate --depth depth.png --camera camera.json --object MESH --unit m",
];

fn ply(vertices: &[[f64; 3]], faces: &[[u32; 3]]) -> String {
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n\
         element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        vertices.len(),
        faces.len()
    );
    vertices.iter().for_each(|[x, y, z]| text += &format!("{x:e} {y:e} {z:e}\n"));
    faces.iter().for_each(|[a, b, c]| text += &format!("3 {a} {b} {c}\n"));
    text
}

fn obj(vertices: &[[f64; 3]], faces: &[[u32; 3]]) -> String {
    let mut text = String::new();
    vertices.iter().for_each(|[x, y, z]| text += &format!("v {x:e} {y:e} {z:e}\n"));
    faces.iter().for_each(|[a, b, c]| text += &format!("f {} {} {}\n", a + 1, b + 1, c + 1));
    text
}

fn stl(vertices: &[[f64; 3]], faces: &[[u32; 3]]) -> String {
    let mut text = "solid a\n".to_owned();
    for face in faces {
        text += "facet normal 0 0 0\nouter loop\n";
        for [x, y, z] in face.map(|i| vertices[i as usize]) {
            text += &format!("vertex {x:e} {y:e} {z:e}\n");
        }
        text += "endloop\nendfacet\n";
    }
    text + "endsolid a\n"
}

fn xyz(vertices: &[[f64; 3]], _: &[[u32; 3]]) -> String {
    vertices.iter().map(|[x, y, z]| format!("{x:e} {y:e} {z:e}\n")).collect()
}

type Writer = fn(&[[f64; 3]], &[[u32; 3]]) -> String;
const FORMATS: [(&str, Writer); 4] = [("ply", ply), ("obj", obj), ("stl", stl), ("xyz", xyz)];

/// A name, vertices, faces, and words of the message; none if a result is acceptable too.
type Degenerate = (&'static str, Vec<[f64; 3]>, Vec<[u32; 3]>, &'static [&'static str]);

fn degenerate() -> Vec<Degenerate> {
    let triangle = vec![[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]];
    let strip = |n: u32| (0..n - 2).map(|k| [k, k + 1, k + 2]).collect::<Vec<_>>();
    let line = |k: u32| [f64::from(k) * 1e-4, f64::from(k) * 2e-4, 0.0];
    let moved = |by: f64| triangle.iter().map(|[x, y, z]| [x + by, *y, *z]).collect::<Vec<_>>();
    let large: Vec<[f64; 3]> = triangle.iter().map(|v| v.map(|c| c * 1e31)).collect();
    vec![
        ("equal", vec![[0.1, 0.2, 0.3]; 5000], strip(5000), &["the same point"]),
        ("line", (0..1000).map(line).collect(), strip(1000), &[]),
        (
            "sheet",
            (0..1000).map(|k| [f64::from(k % 32) * 3e-3, f64::from(k / 32) * 3e-3, 0.0]).collect(),
            strip(1000),
            &[],
        ),
        ("one-face", triangle.clone(), vec![[0, 1, 2]], &[]),
        (
            "no-number",
            vec![[0.0, 0.0, 0.0], [0.1, f64::NAN, 0.0], [0.0, 0.1, 0.0]],
            vec![[0, 1, 2]],
            &["finite"],
        ),
        ("large", large, vec![[0, 1, 2]], &[]),
        ("far", moved(1e6), vec![[0, 1, 2]], &[]),
        ("repeated", triangle.clone(), vec![[0, 1, 2]; 50_000], &[]),
    ]
}

#[test]
fn objects_without_a_shape_are_a_message_or_a_result_at_once_in_every_format() {
    let case = OneImage::new();
    let dir = case.path();
    for (name, vertices, faces, words) in degenerate() {
        for (ending, write) in FORMATS {
            let file = format!("{name}.{ending}");
            std::fs::write(dir.join(&file), write(&vertices, &faces)).unwrap();
            for command in COMMANDS {
                let start = Instant::now();
                let run = sixfold(dir, &command.replace("MESH", &file));
                let took = start.elapsed();
                // The limit is for a debug build on a loaded machine; in a release build each takes less than two
                // seconds.
                assert!(took < Duration::from_secs(60), "{command} {file}: {took:?}");
                assert!((0..=2).contains(&run.code), "{command} {file}: {run:?}");
                if !words.is_empty() && ending != "xyz" {
                    assert_eq!(run.code, 2, "{command} {file}: {run:?}");
                    let said =
                        words.iter().all(|word| run.stderr.contains(word)) && run.stderr.contains(&file);
                    assert!(said, "{command} {file}: {}", run.stderr);
                }
            }
        }
    }
}

#[cfg(feature = "physics")]
#[test]
fn objects_without_a_shape_are_dropped_or_explained() {
    let case = OneImage::new();
    let dir = case.path();
    for (name, vertices, faces, words) in degenerate() {
        let file = format!("{name}.ply");
        std::fs::write(dir.join(&file), ply(&vertices, &faces)).unwrap();
        for exact in ["", "--exact"] {
            let start = Instant::now();
            let command = format!(
                "simulate-scenes --object {file} --unit m {exact} --scenes 1 --views 1 --objects-per-scene 1,1 \
                 --camera camera.json --out scenes-{name}{exact}"
            );
            let run = sixfold(dir, &command);
            assert!(start.elapsed() < Duration::from_secs(120), "{command}: {:?}", start.elapsed());
            assert!((0..=2).contains(&run.code), "{command}: {run:?}");
            if !words.is_empty() {
                assert!(run.code == 2 && words.iter().all(|w| run.stderr.contains(w)), "{command}: {run:?}");
            }
        }
    }
}

#[cfg(unix)]
#[test]
fn a_mesh_reads_files_outside_its_folder_only_when_asked_for() {
    let case = OneImage::new();
    let dir = case.path();
    std::fs::create_dir(dir.join("meshes")).unwrap();
    std::fs::write(dir.join("colours.mtl"), "newmtl red\nKd 1 0 0\n").unwrap();
    let corners =
        "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nusemtl red\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
    std::fs::write(dir.join("meshes/part.obj"), format!("mtllib ../colours.mtl\n{corners}")).unwrap();
    for command in COMMANDS {
        let command = command.replace("MESH", "meshes/part.obj");
        fails(
            dir,
            &command,
            &["meshes/part.obj", "../colours.mtl", "outside the mesh's folder", "--allow-outside"],
        );
        let run = sixfold(dir, &format!("{command} --allow-outside"));
        assert!(run.code < 2, "{command}: {run:?}");
    }
    let pipe = dir.join("meshes/pipe.ply");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    for (file, found) in [("meshes/pipe.ply", "a pipe"), ("zeros.ply", "a device")] {
        if file == "zeros.ply" {
            std::os::unix::fs::symlink("/dev/zero", dir.join(file)).unwrap();
        }
        for command in COMMANDS {
            fails(dir, &command.replace("MESH", file), &[file, found, "expected a regular file"]);
        }
    }
}

/// Starts the program and does not wait for it.
fn start(dir: &Path, arguments: &str) -> std::process::Child {
    Command::new(crate::PROGRAM)
        .args(arguments.split_whitespace())
        .current_dir(dir)
        .env_remove("SIXFOLD_STORE")
        .stdout(std::process::Stdio::null())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap()
}

#[test]
fn an_object_survives_concurrent_replacement_and_kills() {
    let case = OneImage::new();
    let dir = case.path();
    let add = "object add part part.ply --unit mm --replace";
    sixfold(dir, add).expect(0);
    for round in 0..12u64 {
        let mut both = [start(dir, add), start(dir, add)];
        std::thread::sleep(Duration::from_millis(40 * round));
        // In every second round one of them is killed.
        if round % 2 == 0 {
            let _ = both[0].kill();
        }
        let listed = sixfold(dir, "object list --json").expect(0).json();
        assert_eq!(listed.as_array().unwrap().len(), 1, "{listed}");
        let codes = both.map(|mut child| child.wait().unwrap().code());
        assert!(codes.iter().all(|code| matches!(code, Some(0 | 2) | None)), "{codes:?}");
        assert!(round % 2 == 0 || codes.contains(&Some(0)), "{codes:?}");
        let shown = sixfold(dir, "object show part --json").expect(0).json();
        assert_eq!(shown["faces"], part().faces().len());
    }
    sixfold(dir, add).expect(0);
    let left: Vec<_> =
        std::fs::read_dir(dir.join("sixfold-objects")).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left, ["part"]);
    sixfold(dir, "object remove part").expect(0);
    sixfold(dir, "object list").expect(1);
}
