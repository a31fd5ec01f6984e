//! The dissertation's network with PnP, for `benches/pix2pose_vs_onnxruntime.py`: `bench_paper FOLDER CALLS`.
//!
//! Writes to FOLDER the weights (`paper.safetensors`, random ones: time does not depend on their values), the inputs of three
//! crops and what the network predicts for them (`input.f32`, `output.f32`: coordinates and error), and the correspondences of one crop
//! (`correspondences.f64`: fx, fy, cx, cy, the pose by rows, then X Y Z x y each). Prints milliseconds of every call as JSON.

use std::error::Error;
use std::path::Path;
use std::time::Instant;

use burn::tensor::{Device, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sixfold_geometry::{Camera, PnpOptions, Pose, Vec2, Vec3, pnp_ransac};
use sixfold_mesh::ModelInfo;
use sixfold_nn::weights::ModelCard;
use sixfold_pix2pose::model::{ImageSizes, Network, Pix2PoseModel, paper_input};
use sixfold_pix2pose::networks::{PaperGeneratorConfig, SIDE};
use sixfold_pix2pose::object::ObjectEntry;
use sixfold_render::BoundingBoxScale;

const CROPS: usize = 3;
/// Half the axes of the synthetic object, metres.
const HALF: [f64; 3] = [0.05, 0.04, 0.03];

/// Images of soft stripes.
fn crops() -> Vec<f32> {
    let value = |i: usize| {
        let (x, y) = ((i % SIDE) as f32, (i / SIDE % SIDE) as f32);
        let plane = (i / (SIDE * SIDE)) as f32;
        0.5 + 0.45 * (0.07 * x + 0.11 * y + plane + (0.002 * x * y).sin()).sin()
    };
    (0..CROPS * 3 * SIDE * SIDE).map(value).collect()
}

/// The model as it is read back from its file, whose numbers have 16 bits.
fn model(file: &Path) -> Result<Pix2PoseModel, Box<dyn Error>> {
    let (device, seed) = (Device::flex().autodiff(), 1);
    let network = PaperGeneratorConfig { seed }.init(&device);
    // Gives the batch normalisations statistics that are not those they begin with.
    for _ in 0..4 {
        let input = TensorData::new(paper_input(&crops()), [CROPS, 3, SIDE, SIDE]);
        network.forward(Tensor::from_data(input, &device));
    }
    let [x, y, z] = HALF;
    let half_size = Vec3::new(x, y, z);
    let info = ModelInfo {
        diameter: 2.0 * x,
        min: -half_size,
        size: 2.0 * half_size,
        symmetries_discrete: vec![],
        symmetries_continuous: vec![],
    };
    let scale = BoundingBoxScale { centre: Vec3::zeros(), half_size };
    let entries = vec![ObjectEntry::new(1, &info, &scale)];
    let sizes = ImageSizes { input: SIDE, output: SIDE };
    let card = ModelCard::new("", "Random weights, for timing");
    Pix2PoseModel::new(Network::Paper(Box::new(network)), entries, sizes, card).save(file)?;
    Ok(Pix2PoseModel::load(file)?)
}

/// What the network would say of an ellipsoid in the crop: a point for each of its pixels, off by 3 mm in every coordinate,
/// three of ten anywhere on it.
fn correspondences(camera: &Camera, pose: &Pose) -> (Vec<Vec3>, Vec<Vec2>) {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let mut gauss = || {
        let (a, b): (f64, f64) = (random.random_range(1e-12..1.0), random.random());
        (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
    };
    let object_from_camera = pose.inverse();
    let divide = |v: Vec3| v.component_div(&Vec3::from(HALF));
    let (mut points, mut pixels) = (vec![], vec![]);
    for index in 0..SIDE * SIDE {
        let pixel = Vec2::new((index % SIDE) as f64, (index / SIDE) as f64);
        // The ray against the unit sphere.
        let start = divide(object_from_camera.translation());
        let along = divide(object_from_camera.rotation() * camera.unproject(&pixel, 1.0));
        let (a, b, c) = (along.norm_squared(), start.dot(&along), start.norm_squared() - 1.0);
        let root = b * b - a * c;
        if root <= 0.0 {
            continue;
        }
        let on = (start + along * ((-b - root.sqrt()) / a)).component_mul(&Vec3::from(HALF));
        let noise = Vec3::new(gauss(), gauss(), gauss()) * 0.003;
        let stranger = Vec3::new(gauss(), gauss(), gauss()).normalize().component_mul(&Vec3::from(HALF));
        points.push(if index % 10 < 3 { stranger } else { on + noise });
        pixels.push(pixel);
    }
    (points, pixels)
}

fn bytes<const N: usize>(numbers: impl IntoIterator<Item = [u8; N]>) -> Vec<u8> {
    numbers.into_iter().flatten().collect()
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [folder, calls] = &arguments[..] else { return Err("expected FOLDER CALLS".into()) };
    let (folder, calls): (&Path, usize) = (Path::new(folder), calls.parse()?);
    let model = model(&folder.join("paper.safetensors"))?;
    let (crops, one) = (crops(), 3 * SIDE * SIDE);
    let predictions = model.predict(0, &crops);
    let planes = predictions.iter().flat_map(|p| {
        let plane = |c: usize| p.coordinates.iter().map(move |n| n[c]);
        (0..3).flat_map(plane).chain(p.error.iter().copied()).collect::<Vec<f32>>()
    });
    std::fs::write(folder.join("output.f32"), bytes(planes.map(f32::to_le_bytes)))?;
    let input = paper_input(&crops);
    std::fs::write(folder.join("input.f32"), bytes(input.into_iter().map(f32::to_le_bytes)))?;

    let centre = 0.5 * (SIDE as f64 - 1.0);
    let camera = Camera::new(900.0, 900.0, centre, centre, SIDE, SIDE)?;
    let pose = Pose::exp(&[0.0, 0.0, 0.0, 0.5, -0.4, 0.3].into());
    let pose = Pose::from_translation(Vec3::new(0.01, -0.005, 1.0)) * pose;
    let (points, pixels) = correspondences(&camera, &pose);
    let head = [camera.fx, camera.fy, camera.cx, camera.cy];
    let matrix = pose.to_matrix().transpose();
    let each = points.iter().zip(&pixels).flat_map(|(p, q)| [p.x, p.y, p.z, q.x, q.y]);
    let numbers = head.into_iter().chain(matrix.iter().copied()).chain(each);
    std::fs::write(folder.join("correspondences.f64"), bytes(numbers.map(f64::to_le_bytes)))?;

    let options = PnpOptions { threshold_px: 1.5, max_iterations: 1000, ..PnpOptions::default() };
    let found = pnp_ransac(&points, &pixels, &camera, &options)?.camera_from_object;
    let (degrees, millimetres) =
        (found.rotation_angle_to(&pose).to_degrees(), 1e3 * found.distance_to(&pose));
    let mut times = [vec![], vec![], vec![]];
    for _ in 0..calls {
        let mut time = |part: usize, call: &dyn Fn()| {
            let began = Instant::now();
            call();
            times[part].push(1e3 * began.elapsed().as_secs_f64());
        };
        time(0, &|| drop(std::hint::black_box(model.predict(0, &crops[..one]))));
        time(1, &|| drop(std::hint::black_box(model.predict(0, &crops))));
        time(2, &|| drop(std::hint::black_box(pnp_ransac(&points, &pixels, &camera, &options))));
    }
    let [first, second, pnp] = times;
    let summary = serde_json::json!({
        "first": first, "second": second, "pnp": pnp,
        "correspondences": points.len(), "degrees": degrees, "millimetres": millimetres,
    });
    println!("{summary}");
    Ok(())
}
