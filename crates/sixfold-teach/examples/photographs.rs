//! Writes simulated photographs of a mesh on the board, to try `sixfold teach` and the page Teach without a camera:
//! `cargo run --release -p sixfold-teach --example photographs -- MESH UNIT OUT [NUMBER [cloth]]`.
//! With `cloth` it stands on a patterned cloth instead of the board, and the options for `sixfold teach --no-board` are printed.
//!
//! `OUT/photographs/00.jpg ...` are the photographs, `OUT/camera.json` their camera; `OUT/scene` holds one more photograph with depth, to
//! find the object in, and `OUT/truth.json` the true poses.

use std::path::Path;

use image::codecs::jpeg::JpegEncoder;
use serde_json::json;
use sixfold_board::{Board, Paper};
use sixfold_geometry::{Camera, Image, Pose, RgbImage, Vec3};
use sixfold_mesh::{Unit, read_mesh};
use sixfold_teach::simulation::{SimulatedCapture, SimulationOptions, patterned};

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [mesh, unit, out, number @ ..] = arguments.as_slice() else {
        return Err("expected MESH UNIT OUT [NUMBER [cloth]]".into());
    };
    let unit: Unit = unit.parse()?;
    let mesh = read_mesh(Path::new(mesh), unit)?;
    let photographs = number.first().map_or(Ok(10), |n| n.parse())?;
    let camera =
        Camera { fx: 620.0, fy: 618.0, cx: 322.0, cy: 238.0, width: 640, height: 480, distortion: None };
    let options = SimulationOptions { photographs, camera, motion: 0.5, blur: 0.5, ..Default::default() };
    // A view with another step around the object is between the others.
    let between = SimulationOptions { photographs: photographs + 1, ..options.clone() };
    let ground = Image::from_fn(64, 64, |x, y| [90 + 30 * ((x / 8 + y / 8) % 2) as u8, 85, 70]);
    let board = Board::new(Paper::A4);
    let cloth = number.get(1).map(|_| patterned(2048, 3));
    let capture = match &cloth {
        Some(cloth) => SimulatedCapture::without_board(&mesh, (cloth, 0.6), &ground, &options, 3),
        None => SimulatedCapture::new(&mesh, &board, &ground, &options, 3),
    };
    let scene = SimulatedCapture::new(&mesh, &board, &ground, &between, 3);
    let out = Path::new(out);
    std::fs::create_dir_all(out.join("photographs"))?;
    std::fs::create_dir_all(out.join("scene"))?;
    for number in 0..photographs {
        let image = capture.photograph(number).ok_or("no such photograph")?;
        write_jpeg(&out.join(format!("photographs/{number:02}.jpg")), &image)?;
    }
    let last = photographs;
    write_jpeg(&out.join("scene/rgb.jpg"), &scene.photograph(last).ok_or("no such photograph")?)?;
    sixfold_io::write_depth(&out.join("scene/depth.png"), &scene.depth(last).ok_or("no depth")?, 1e-3)?;
    if cloth.is_some() {
        // Two points of the cloth, to the pixel, as a person would mark them.
        let pixel = |i: usize, x: f64, y: f64| {
            let p = capture.camera_from_board[i].transform_point(&Vec3::new(x, y, 0.0));
            camera.project(&p).map_or(String::from("-"), |p| format!("{:.0},{:.0}", p.x, p.y))
        };
        let ends = [0, photographs / 3, photographs / 2]
            .map(|i| format!("{i:02}.jpg:{}:{}", pixel(i, -0.08, -0.06), pixel(i, 0.08, 0.06)));
        println!("--no-board --length 0.2 --ends {}", ends.join(" "));
    }
    let numbers = json!({ "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "width": camera.width, "height": camera.height, "depth_scale": 1.0 });
    std::fs::write(out.join("camera.json"), numbers.to_string())?;
    let rows = |pose: &Pose| pose.to_matrix().row_iter().map(|r| r.iter().copied().collect()).collect();
    let rows = |pose: &Pose| -> Vec<Vec<f64>> { rows(pose) };
    let truth = json!({
        "camera_from_board": capture.camera_from_board.iter().map(rows).collect::<Vec<_>>(),
        "board_from_object": rows(&capture.board_from_object),
        "scene_camera_from_board": rows(&scene.camera_from_board[last]),
    });
    std::fs::write(out.join("truth.json"), serde_json::to_string_pretty(&truth)?)?;
    Ok(())
}

fn write_jpeg(path: &Path, image: &RgbImage) -> Result<(), Failure> {
    let data: Vec<u8> = image.as_slice().iter().flatten().copied().collect();
    let file = std::io::BufWriter::new(std::fs::File::create(path)?);
    let encoder = JpegEncoder::new_with_quality(file, 92);
    let size = (image.width() as u32, image.height() as u32);
    image::ImageEncoder::write_image(encoder, &data, size.0, size.1, image::ExtendedColorType::Rgb8)?;
    Ok(())
}
