//! The accuracy of camera poses without a board: photographs are registered by their features and compared with known poses.
//!
//! `cargo run --release -p sixfold-teach --example poses_without_board -- simulated MESH UNIT SEED [GROUND.jpg]` renders 20 photographs of a mesh on a
//! patterned cloth, or on one with a photograph as texture, without giving the camera. `... -- bop DATASET SCENE OBJECT IM_ID,IM_ID,...` takes images of
//! a dataset with its camera; the object's ground truth gives the camera's poses.
//!
//! Both print how many photographs were registered and the errors of the cameras after the best similarity between their centres.

use std::path::Path;

use sixfold_bop::BopDataset;
use sixfold_geometry::random::{normal, stream};
use sixfold_geometry::{Camera, Pose, RgbImage, Vec2, Vec3, stats::median, umeyama};
use sixfold_mesh::{Unit, read_mesh};
use sixfold_nn::keypoints::KeypointFinder;
use sixfold_teach::simulation::{SimulatedCapture, SimulationOptions, patterned};
use sixfold_teach::{KnownLength, PutTogether, SeenFeatures, TeachError, features_of, put_together};

type Failure = Box<dyn std::error::Error>;

fn main() -> Result<(), Failure> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>().as_slice() {
        ["simulated", mesh, unit, seed, ground @ ..] => {
            simulated(Path::new(mesh), unit.parse()?, seed.parse()?, ground)
        }
        ["bop", dataset, scene, object, images] => {
            let images: Result<Vec<u32>, _> = images.split(',').map(str::parse).collect();
            bop(Path::new(dataset), scene.parse()?, object.parse()?, &images?)
        }
        _ => {
            Err("expected simulated MESH UNIT SEED [GROUND], or bop DATASET SCENE OBJECT IM_ID,IM_ID,..."
                .into())
        }
    }
}

fn simulated(mesh: &Path, unit: Unit, seed: u64, ground: &[&str]) -> Result<(), Failure> {
    let mesh = read_mesh(mesh, unit)?;
    let options = SimulationOptions::default();
    let cloth = match ground.first() {
        Some(file) => sixfold_io::read_rgb(Path::new(file))?,
        None => patterned(2048, seed),
    };
    let table = RgbImage::filled(16, 16, [120, 110, 100]);
    let capture = SimulatedCapture::without_board(&mesh, (&cloth, 0.6), &table, &options, seed);
    let images: Vec<RgbImage> = (0..options.photographs).filter_map(|i| capture.photograph(i)).collect();
    // Two corners of the cloth, marked in three photographs to a pixel.
    let ends = [Vec3::new(-0.12, -0.08, 0.0), Vec3::new(0.12, 0.08, 0.0)];
    let mut random = stream(seed, 9);
    let mut marked = |i: usize| {
        let pose = capture.camera_from_board[i];
        let mut error = || Vec2::new(f64::from(normal(&mut random)), f64::from(normal(&mut random)));
        let ends = ends.map(|end| {
            let pixel = options.camera.project(&pose.transform_point(&end))?;
            Some((options.camera.distort_point(&pixel) + error()).into())
        });
        (i, ends)
    };
    let length =
        KnownLength { metres: (ends[0] - ends[1]).norm(), ends: [0, 5, 10].map(&mut marked).to_vec() };
    let found = located(&images, None, Some(&length))?;
    let (c, truth) = (found.camera, options.camera);
    println!(
        "camera: fx {:.1} (true {:.1}), cx {:.1} ({:.1}), cy {:.1} ({:.1}), floor {:?}",
        c.fx, truth.fx, c.cx, truth.cx, c.cy, truth.cy, found.floor
    );
    compare(&found, &capture.camera_from_board.iter().map(|p| Some(*p)).collect::<Vec<_>>())
}

fn bop(dataset: &Path, scene: u32, object: u32, images: &[u32]) -> Result<(), Failure> {
    let dataset = BopDataset::open(dataset, "test")?;
    let scene = dataset.scene(scene)?;
    let camera = scene.camera(images[0])?;
    let (mut photographs, mut truth) = (vec![], vec![]);
    for image in images {
        photographs.push(scene.rgb(*image)?.ok_or("an image without colours")?);
        let all = &scene.image(*image)?.ground_truth;
        truth.push(all.iter().find(|t| t.obj_id == object).map(|t| t.camera_from_object));
    }
    // The scores need no scale, but the reconstruction does: 0.1 m along x of the object's frame, according to its ground truth.
    let end = |pose: &Pose, x: f64| {
        camera.project(&pose.transform_point(&Vec3::new(x, 0.0, 0.0))).map(<[f64; 2]>::from)
    };
    let marked = truth.iter().enumerate().filter_map(|(i, pose)| Some((i, pose.as_ref()?)));
    let ends = marked.map(|(i, pose)| (i, [end(pose, -0.05), end(pose, 0.05)])).collect();
    let found = located(&photographs, Some(&camera), Some(&KnownLength { metres: 0.1, ends }))?;
    compare(&found, &truth)
}

fn located(
    images: &[RgbImage],
    camera: Option<&Camera>,
    length: Option<&KnownLength>,
) -> Result<PutTogether, Failure> {
    let finder = KeypointFinder::shipped()?;
    let start = std::time::Instant::now();
    let of = |(i, image): (usize, &RgbImage)| {
        let (name, size) = (i.to_string(), image.size());
        Ok(SeenFeatures { name, size, features: features_of(&finder, image)?, focal_length: None })
    };
    let seen: Vec<SeenFeatures> = images.iter().enumerate().map(of).collect::<Result<_, TeachError>>()?;
    let counts: Vec<usize> = seen.iter().map(|s| s.features.points.len()).collect();
    println!("features: {counts:?}, {:.1} s", start.elapsed().as_secs_f64());
    let found = put_together(&seen, camera, length, &|_| Ok(None), &())?;
    println!("put together: {:.1} s", start.elapsed().as_secs_f64());
    for (i, pose) in found.camera_from_world.iter().enumerate() {
        if let Err(reason) = pose {
            println!("left out {i}: {reason}");
        }
    }
    Ok(found)
}

fn compare(found: &PutTogether, truth: &[Option<Pose>]) -> Result<(), Failure> {
    let both: Vec<(Pose, Pose)> = found
        .camera_from_world
        .iter()
        .zip(truth)
        .filter_map(|(found, truth)| Some((*found.as_ref().ok()?, (*truth)?)))
        .collect();
    let eyes: Vec<Vec3> = both.iter().map(|(found, _)| found.inverse().translation()).collect();
    let there: Vec<Vec3> = both.iter().map(|(_, truth)| truth.inverse().translation()).collect();
    let fit = umeyama(&eyes, &there, None)?;
    let mut shifts: Vec<f64> = eyes
        .iter()
        .zip(&there)
        .map(|(eye, there)| 1000.0 * (fit.transform_point(eye) - there).norm())
        .collect();
    let world_from_truth = fit.target_from_source.inverse();
    let mut rotations: Vec<f64> = both
        .iter()
        .map(|(found, truth)| {
            (found.rotation() * world_from_truth.rotation()).angle_to(&truth.rotation()).to_degrees()
        })
        .collect();
    println!(
        "{} of {} put together, rms {:.2} px; error: median {:.3} degrees, {:.2} mm; largest {:.3} degrees, {:.2} mm; scale {:.4}",
        eyes.len(),
        truth.len(),
        found.rms,
        median(&mut rotations).unwrap_or(f64::NAN),
        median(&mut shifts).unwrap_or(f64::NAN),
        rotations.iter().copied().fold(0.0, f64::max),
        shifts.iter().copied().fold(0.0, f64::max),
        fit.scale,
    );
    Ok(())
}
