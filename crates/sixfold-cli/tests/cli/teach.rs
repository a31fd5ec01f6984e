//! `sixfold teach`: an object from photographs, found in a new depth image; and unusable photographs.

use std::path::Path;

use sixfold_board::{Board, Paper};
use sixfold_geometry::{Camera, Image, Pose, RgbImage, Vec3};
use sixfold_io::{write_depth, write_rgb};
use sixfold_mesh::Mesh;
use sixfold_render::{SceneObject, VisibilityBuffer};
use sixfold_teach::simulation::{SimulatedCapture, SimulationOptions};

use crate::support::{fails, pose_of, sixfold};

/// A wedge with a wide foot: no rotation maps it onto itself.
fn wedge() -> Mesh {
    let foot = [(-0.05, -0.03), (0.05, -0.03), (0.05, 0.03), (-0.05, 0.03)];
    let head = [(-0.045, -0.02), (-0.005, -0.025), (-0.005, 0.02), (-0.045, 0.025)];
    let vertices = foot
        .iter()
        .map(|(x, y)| Vec3::new(*x, *y, 0.0))
        .chain(head.iter().map(|(x, y)| Vec3::new(*x, *y, 0.09)));
    let sides = (0..4u32).flat_map(|i| {
        let j = (i + 1) % 4;
        [[i, j, 4 + j], [i, 4 + j, 4 + i]]
    });
    let faces = sides.chain([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]]).collect();
    let mesh = Mesh::new(vertices.collect(), faces).unwrap();
    mesh.with_colors(vec![[180, 70, 40]; 8]).unwrap()
}

fn camera() -> Camera {
    Camera { fx: 620.0, fy: 618.0, cx: 322.0, cy: 238.0, width: 640, height: 480, distortion: None }
}

fn write_camera(path: &Path) {
    let c = camera();
    let text = serde_json::json!({
        "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "width": c.width, "height": c.height, "depth_scale": 0.1
    });
    std::fs::write(path, text.to_string()).unwrap();
}

/// Writes `count` photographs; returns the wedge's pose.
fn write_photographs(folder: &Path, count: usize) -> Pose {
    std::fs::create_dir(folder).unwrap();
    let (mesh, ground) =
        (wedge(), RgbImage::from_fn(64, 64, |x, y| [80 + 30 * ((x / 8 + y / 8) % 2) as u8, 95, 80]));
    let options = SimulationOptions {
        photographs: count,
        camera: camera(),
        motion: 0.5,
        blur: 0.5,
        ..SimulationOptions::default()
    };
    let capture = SimulatedCapture::new(&mesh, &Board::new(Paper::A4), &ground, &options, 11);
    for i in 0..count {
        write_rgb(&folder.join(format!("{i:02}.png")), &capture.photograph(i).unwrap()).unwrap();
    }
    capture.board_from_object
}

#[test]
fn a_taught_object_is_found_in_a_new_depth_image() {
    let case = tempfile::tempdir().unwrap();
    let board_from_object = write_photographs(&case.path().join("photographs"), 10);
    write_camera(&case.path().join("camera.json"));
    let teach = "teach wedge --photographs photographs --camera camera.json --hull-only --json";
    let run = sixfold(case.path(), teach).expect(0);
    let (taught, diameter) = (run.json(), wedge().diameter());
    assert_eq!(taught["photographs"], 10, "{taught}");
    assert!((taught["diameter"].as_f64().unwrap() / diameter - 1.0).abs() < 0.06, "{taught} {diameter}");
    for file in ["photographs.png", "mesh.ply", "teaching.json", "masks/000003.png"] {
        assert!(case.path().join("out/teach/wedge").join(file).is_file(), "{file}");
    }
    fails(case.path(), teach, &["wedge", "--replace"]);
    // The wedge on a table, viewed by a depth camera.
    let mesh = wedge();
    let table = [[-0.4, -0.4], [0.4, -0.4], [0.4, 0.4], [-0.4, 0.4]].map(|[x, y]| Vec3::new(x, y, 0.0));
    let table = Mesh::new(table.to_vec(), vec![[0, 1, 2], [0, 2, 3]]).unwrap();
    let tilt = sixfold_geometry::nalgebra::UnitQuaternion::from_axis_angle(&Vec3::x_axis(), 2.3);
    let camera_from_table = Pose::new(tilt, Vec3::new(0.0, 0.02, 0.55));
    let mut buffer = VisibilityBuffer::new(&camera());
    buffer.render(
        &[
            SceneObject { mesh: &mesh, camera_from_object: camera_from_table },
            SceneObject { mesh: &table, camera_from_object: camera_from_table },
        ],
        &Default::default(),
    );
    write_depth(&case.path().join("depth.png"), &buffer.depth(), 1e-4).unwrap();
    let run = sixfold(
        case.path(),
        "estimate --method ppf --depth depth.png --camera camera.json --object wedge --json",
    )
    .expect(0);
    let found = run.json();
    let found = pose_of(&found["poses"][0]["camera_from_object"]);
    // The centre of the taught mesh's box is that of the wedge's, rotated like the wedge.
    let centre = camera_from_table.transform_point(&Vec3::new(0.0, 0.0, 0.045));
    assert!((found.translation() - centre).norm() < 0.008, "{found:?} {centre:?}");
    let up = found.transform_direction(&Vec3::z()).dot(&camera_from_table.transform_direction(&Vec3::z()));
    assert!(up > 0.99, "{up}");
    let stood = board_from_object.transform_direction(&Vec3::x());
    let along = found.transform_direction(&stood).dot(&camera_from_table.transform_direction(&Vec3::x()));
    assert!(along > 0.98, "{along}");
    let run = sixfold(case.path(), "object export wedge --bop bop --id 3 --json").expect(0);
    assert_eq!(run.json()["images"], 10);
    assert!(case.path().join("bop/models/obj_000003.ply").is_file());
}

#[test]
fn unusable_photographs_are_an_error_with_advice() {
    let case = tempfile::tempdir().unwrap();
    write_photographs(&case.path().join("two"), 2);
    write_camera(&case.path().join("camera.json"));
    let expected = ["found 2 photographs", "8 to 40", "all sides"];
    fails(case.path(), "teach wedge --photographs two --camera camera.json", &expected);
    fails(case.path(), "teach wedge --photographs two --out fresh", &["sixfold calibrate", "--camera"]);
    fails(case.path(), "teach ../wedge --photographs two --camera camera.json --out w", &["letters, digits"]);
    fails(case.path(), "teach wedge --photographs two --out ruler --ruler 5", &["--ruler", "10 to 1000"]);
    std::fs::write(case.path().join("two/text.jpg"), "no image").unwrap();
    fails(
        case.path(),
        "teach other --photographs two --camera camera.json",
        &["text.jpg", "neither PNG nor JPEG"],
    );
    std::fs::create_dir(case.path().join("bare")).unwrap();
    for i in 0..5u8 {
        write_rgb(&case.path().join(format!("bare/{i}.png")), &Image::filled(64, 48, [40 * i; 3])).unwrap();
    }
    fails(case.path(), "teach none --photographs bare", &["sixfold board"]);
    assert!(!case.path().join("sixfold-objects").exists(), "nothing is stored");
}
