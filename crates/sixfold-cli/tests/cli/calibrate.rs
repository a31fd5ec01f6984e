//! `sixfold board` and `sixfold calibrate`.

use std::path::Path;

use sixfold_board::simulation::{Conditions, photograph};
use sixfold_board::{Board, Paper};
use sixfold_geometry::nalgebra::{Unit, UnitQuaternion};
use sixfold_geometry::{BrownConrady, Camera, Image, Pose, Vec3};
use sixfold_io::{read_rgb, write_rgb};

use crate::support::{fails, pose_of, sixfold};

fn lens() -> Camera {
    let distortion = BrownConrady { k1: -0.1, k2: 0.03, ..BrownConrady::default() };
    Camera {
        fx: 610.0,
        fy: 610.0,
        cx: 322.0,
        cy: 238.0,
        width: 640,
        height: 480,
        distortion: Some(distortion),
    }
}

fn pose(i: u32) -> Pose {
    let azimuth = 0.9 * f64::from(i);
    let facing = UnitQuaternion::from_axis_angle(&Vec3::x_axis(), std::f64::consts::PI);
    let axis = Unit::new_normalize(Vec3::new(azimuth.cos(), azimuth.sin(), 0.0));
    let rotation = UnitQuaternion::from_axis_angle(&axis, 0.35 + 0.07 * f64::from(i)) * facing;
    Pose::new(rotation, Vec3::new(0.0, 0.01, 0.36 + 0.01 * f64::from(i)))
}

/// Seven photographs of the board with an object at its centre.
fn write_photographs(folder: &Path) {
    std::fs::create_dir(folder).unwrap();
    let conditions = Conditions { hidden: (0.01, 0.0, 0.035), ..Conditions::default() };
    for i in 0..7 {
        let image = photograph(&Board::new(Paper::A4), &lens(), &pose(i), &conditions, u64::from(i));
        write_rgb(&folder.join(format!("{i}.png")), &image).unwrap();
    }
}

#[test]
fn a_board_is_written_for_every_paper() {
    let case = tempfile::tempdir().unwrap();
    for (paper, tags) in [("a4", 35), ("a3", 70), ("letter", 30)] {
        let run = sixfold(case.path(), &format!("board --paper {paper} --out {paper}.pdf --json")).expect(0);
        assert_eq!(run.json()["tags"], tags);
        let pdf = std::fs::read(case.path().join(format!("{paper}.pdf"))).unwrap();
        assert!(pdf.starts_with(b"%PDF-1.4") && pdf.ends_with(b"%%EOF\n"));
    }
    sixfold(case.path(), "board --out sheet.png").expect(0);
    assert_eq!(read_rgb(&case.path().join("sheet.png")).unwrap().size(), (1680, 2376));
    fails(case.path(), "board --paper a5", &["a5", "a4, a3 or letter"]);
    fails(case.path(), "board --out sheet.svg", &["sheet.svg", ".pdf or .png"]);
}

#[test]
fn photographs_of_the_board_give_the_camera_and_its_poses() {
    let case = tempfile::tempdir().unwrap();
    let photographs = case.path().join("photographs");
    write_photographs(&photographs);
    let run = sixfold(case.path(), "calibrate photographs --out out --json").expect(0);
    let found = run.json();
    let focal = found["camera"]["fx"].as_f64().unwrap();
    assert!((focal / 610.0 - 1.0).abs() < 0.005, "{focal}");
    for i in 0..7 {
        let listed = &found["photographs"][i];
        assert!(listed["left_out"].is_null(), "{listed}");
        let pose_found = pose_of(&listed["camera_from_board"]);
        assert!(pose_found.distance_to(&pose(i as u32)) < 2e-3, "{listed}");
    }
    for file in ["camera.json", "photographs.json", "photographs.png", "residuals.png"] {
        assert!(case.path().join("out").join(file).metadata().unwrap().len() > 100, "{file}");
    }
    // The program accepts the camera file, and with it the poses are the same; a larger print is further away.
    let again = "calibrate photographs --camera out/camera.json --out again --json";
    let again = sixfold(case.path(), again).expect(0).json();
    let larger = "calibrate photographs --camera out/camera.json --ruler 141.4 --out larger --json";
    let larger = sixfold(case.path(), larger).expect(0).json();
    for i in 0..7 {
        let of = |value: &serde_json::Value| pose_of(&value["photographs"][i]["camera_from_board"]);
        assert!(of(&again).distance_to(&of(&found)) < 1e-4);
        let ratio = of(&larger).translation().norm() / of(&found).translation().norm();
        assert!((ratio - 1.414).abs() < 1e-3, "{ratio}");
    }
    // The same on one thread.
    let one = sixfold(case.path(), "calibrate photographs --out one --threads 1 --json").expect(0);
    assert_eq!(one.stdout, run.stdout);
}

/// A JPEG with EXIF data that say how the phone was held: 6 is upright, 3 upside down.
fn with_orientation(jpeg: &[u8], orientation: u8) -> Vec<u8> {
    // A little-endian TIFF header and one directory with one entry: tag 0x0112, a short.
    let tiff =
        [b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".as_slice(), &[orientation, 0, 0, 0], &[0; 4]]
            .concat();
    let exif = [b"Exif\0\0".as_slice(), &tiff].concat();
    let length = u16::try_from(exif.len() + 2).unwrap().to_be_bytes();
    [&jpeg[..2], b"\xff\xe1", &length, &exif, &jpeg[2..]].concat()
}

#[test]
fn however_the_phone_was_held_its_camera_is_the_same() {
    let case = tempfile::tempdir().unwrap();
    let [plain, held] = ["plain", "held"].map(|name| case.path().join(name));
    write_photographs(&plain);
    std::fs::create_dir(&held).unwrap();
    for i in 0..7u32 {
        let file = plain.join(format!("{i}.png"));
        let image = read_rgb(&file).unwrap();
        std::fs::remove_file(file).unwrap();
        let mut jpeg = Vec::new();
        let pixels = image.as_slice().as_flattened();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 95)
            .encode(pixels, 640, 480, image::ExtendedColorType::Rgb8)
            .unwrap();
        std::fs::write(plain.join(format!("{i}.jpg")), &jpeg).unwrap();
        let orientation = [1, 6, 3, 8][i as usize % 4];
        std::fs::write(held.join(format!("{i}.jpg")), with_orientation(&jpeg, orientation)).unwrap();
    }
    let of = |folder: &str| {
        let found =
            sixfold(case.path(), &format!("calibrate {folder} --out out-{folder} --json")).expect(0).json();
        let poses: Vec<_> = (0..7).map(|i| found["photographs"][i]["camera_from_board"].clone()).collect();
        (found["camera"].clone(), poses)
    };
    let (camera, poses) = of("held");
    assert_eq!((camera.clone(), poses.clone()), of("plain"));
    assert!((camera["fx"].as_f64().unwrap() / 610.0 - 1.0).abs() < 0.005, "{camera}");
    assert!(pose_of(&poses[1]).distance_to(&pose(1)) < 2e-3, "{}", poses[1]);
}

#[test]
fn photographs_that_cannot_be_used_are_left_out_with_the_reason() {
    let case = tempfile::tempdir().unwrap();
    let photographs = case.path().join("photographs");
    write_photographs(&photographs);
    let good = read_rgb(&photographs.join("0.png")).unwrap();
    write_rgb(&photographs.join("mirrored.png"), &Image::from_fn(640, 480, |x, y| good[(639 - x, y)]))
        .unwrap();
    write_rgb(&photographs.join("small.png"), &Image::from_fn(600, 440, |x, y| good[(x, y)])).unwrap();
    write_rgb(&photographs.join("table.png"), &Image::filled(640, 480, [120; 3])).unwrap();
    let found = sixfold(case.path(), "calibrate photographs --out out --json").expect(0).json();
    let reason = |name: &str| {
        let all = found["photographs"].as_array().unwrap();
        let listed = all.iter().find(|p| p["file"].as_str().unwrap().ends_with(name)).unwrap();
        listed["left_out"].as_str().unwrap_or_default().to_owned()
    };
    assert!(reason("mirrored.png").contains("mirrored"));
    assert!(reason("small.png").contains("600x440"));
    assert!(reason("table.png").contains("0 tags"));
    assert_eq!(reason("0.png"), "");
    // A file that is not an image is reported, and the others are used.
    std::fs::write(photographs.join("notes.jpg"), "no image").unwrap();
    std::fs::write(photographs.join("phone.heic"), b"\0\0\0\x18ftypheic\0\0\0\0mif1heic").unwrap();
    let found = sixfold(case.path(), "calibrate photographs --out out --json").expect(2).json();
    let text = found.to_string();
    assert!(text.contains("neither PNG nor JPEG") && text.contains("export it as JPEG"), "{text}");
}

#[test]
fn errors_of_calibration_give_advice() {
    let case = tempfile::tempdir().unwrap();
    let dir = case.path();
    write_photographs(&dir.join("photographs"));
    fails(dir, "calibrate photographs/0.png photographs/1.png --out out", &["2 photographs", "at least 4"]);
    write_rgb(&dir.join("table.png"), &Image::filled(640, 480, [120; 3])).unwrap();
    fails(dir, "calibrate table.png --out out", &["no photograph shows a board"]);
    fails(dir, "calibrate none --out out", &["none"]);
    std::fs::create_dir(dir.join("empty")).unwrap();
    fails(dir, "calibrate empty --out out", &["empty", "no photograph"]);
    fails(dir, "calibrate photographs --ruler 5000 --out out", &["--ruler", "10 to 1000"]);
    std::fs::write(
        dir.join("wrong.json"),
        r#"{"fx": 900, "fy": 900, "cx": 400, "cy": 300, "width": 800, "height": 600}"#,
    )
    .unwrap();
    fails(dir, "calibrate photographs --camera wrong.json --out out", &["800x600", "640x480"]);
    fails(dir, "calibrate photographs --camera wrong.json --wide --out out", &["--wide"]);
    assert!(!dir.join("out/camera.json").exists());
}
