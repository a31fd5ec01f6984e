//! `sixfold reproduce teach`: objects taught from simulated photographs and compared with the ground truth: camera poses, mesh and
//! symmetries, and the search for the taught object among others in new depth images.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use clap::Args;
use serde::{Deserialize, Serialize};
use sixfold_align::PreparedDepth;
use sixfold_auto::AutoMembers;
use sixfold_board::{Board, Paper};
use sixfold_bop::{ModelPoints, add_s};
use sixfold_estimator::{Object, PoseEstimator, Query};
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::{Camera, DepthImage, KdTree, Pose, RgbImage, Vec3, stats::median};
use sixfold_io::read_rgb;
use sixfold_mesh::{Mesh, ModelInfo, SymmetryOptions, Unit, find_symmetries, read_mesh, sure_symmetries};
use sixfold_ppf::PpfEstimator;
use sixfold_render::{DepthSensor, Light, Material, SceneObject, VisibilityBuffer, shade, simulate_depth};
use sixfold_shell::Outcome;
use sixfold_shell::output::{JsonArguments, report, write_atomically};
use sixfold_shell::progress::{Progress, check_interrupt};
use sixfold_teach::simulation::{SimulatedCapture, SimulationOptions, ground_of, patterned};

use super::mesh_errors;
use super::teach_photographs::{
    board_from_world, errors, marked_length, teaching, write_depth_images, write_photographs,
};

pub(super) const AFTER_HELP: &str = "Example:\n  \
    sixfold reproduce teach --list benches/teach-objects.json --meshes DIR --ground photograph.jpg --out out/reproduce-teach\n\n\
    Finished objects are kept. After a stop, the same command resumes.";

/// Angular spatial frequency of the colours given to a mesh without colours, 1/m: patches of a few centimetres.
const PATCHES: f64 = 90.0;
/// New images of each object.
const NEW_IMAGES: usize = 5;
/// Side of the cloth that replaces the board, metres.
const CLOTH: f64 = 0.6;
/// A pose is right within this fraction of the diameter.
const RIGHT: f64 = 0.1;

#[derive(Debug, Args)]
pub(crate) struct ReproduceTeachArguments {
    /// JSON list of {name, mesh, unit}; z of each mesh points up
    #[arg(long, value_name = "FILE")]
    list: PathBuf,
    /// Folder of the meshes
    #[arg(long, value_name = "DIR")]
    meshes: PathBuf,
    /// Photograph for the texture of the table
    #[arg(long, value_name = "FILE")]
    ground: PathBuf,
    /// Photographs of each object
    #[arg(long, value_name = "N", default_value_t = 20)]
    photographs: usize,
    /// Seed of the photographs
    #[arg(long, value_name = "SEED", default_value_t = 7)]
    seed: u64,
    /// The object stands on a patterned cloth of 0.6 m in place of the board; a length of 0.29 m is marked in three photographs,
    /// accurate to a pixel. No new images are searched
    #[arg(long)]
    no_board: bool,
    /// Each photograph has a depth image, of a simulated RealSense
    #[arg(long)]
    depth: bool,
    /// One photograph with depth from a known camera, without a board
    #[arg(long, conflicts_with_all = ["photographs", "no_board"])]
    one_view: bool,
    /// Folder for the results
    #[arg(long, value_name = "DIR", default_value = "out/reproduce-teach")]
    out: PathBuf,
}

impl ReproduceTeachArguments {
    fn photographs(&self) -> usize {
        if self.one_view { 1 } else { self.photographs }
    }

    fn depth(&self) -> bool {
        self.depth || self.one_view
    }

    fn no_board(&self) -> bool {
        self.no_board || self.one_view
    }

    /// Folder of an object; each kind of photographs has its own.
    fn files(&self, name: &str) -> PathBuf {
        let kind = match (self.one_view, self.depth) {
            (true, _) => "-one-view",
            (false, true) => "-depth",
            (false, false) => "",
        };
        self.out.join(format!("{name}{kind}"))
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    mesh: PathBuf,
    unit: Unit,
}

/// One object; lengths in millimetres, angles in degrees.
#[derive(Debug, Serialize, Deserialize)]
struct Row {
    name: String,
    photographs: usize,
    seed: u64,
    #[serde(default)]
    no_board: bool,
    /// Whether the photographs had depth images.
    #[serde(default)]
    depth: bool,
    /// How many of the photographs have a pose.
    #[serde(default)]
    with_pose: usize,
    diameter_mm: f64,
    camera_mm: f64,
    camera_deg: f64,
    mask_iou: f64,
    /// Mean distance of the mesh to the true mesh, and of the photographed part of the true mesh to the mesh.
    mesh_mm: f64,
    truth_mm: f64,
    with_depth: f64,
    /// Number of sure axes and rotations: found, and true.
    symmetries: [usize; 2],
    symmetries_true: [usize; 2],
    /// Images in which point pair features found it, from depth alone.
    found: usize,
    images: usize,
    /// The same with the true mesh.
    found_with_true_mesh: usize,
    /// Images in which `auto` found it, from depth and colour.
    found_auto: usize,
    found_auto_with_true_mesh: usize,
    /// Wrong poses among those that `auto` reports with a probability of at least 0.5.
    wrong_auto: usize,
    seconds: f64,
}

#[derive(Serialize)]
struct Report {
    objects: Vec<Row>,
    camera_mm_median: f64,
    camera_deg_median: f64,
    mesh_mm_mean: f64,
    truth_mm_mean: f64,
    found: usize,
    images: usize,
    found_with_true_mesh: usize,
    found_auto: usize,
    found_auto_with_true_mesh: usize,
    wrong_auto: usize,
}

pub(super) fn run(a: &ReproduceTeachArguments, json: &JsonArguments) -> Result<Outcome> {
    let text = std::fs::read_to_string(&a.list).with_context(|| a.list.display().to_string())?;
    let entries: Vec<Entry> = serde_json::from_str(&text).with_context(|| a.list.display().to_string())?;
    if entries.is_empty() || a.photographs < 8 {
        bail!("expected at least one object and 8 photographs of it");
    }
    let ground = ground_of(&read_rgb(&a.ground)?, 1024);
    let meshes: Vec<Mesh> = entries
        .iter()
        .map(|e| Ok(colored(read_mesh(a.meshes.join(&e.mesh), e.unit)?)))
        .collect::<Result<_>>()?;
    let mut progress = Progress::new("objects", entries.len());
    let mut objects = vec![];
    for (i, entry) in entries.iter().enumerate() {
        check_interrupt("finished objects are kept; give the same command to continue")?;
        let file = a.files(&entry.name).with_extension("json");
        let row = match kept(&file, a) {
            Some(row) => row,
            None => {
                // Of a list of one or two objects, fewer: never a copy of the object itself.
                let others: Vec<&Mesh> =
                    (1..meshes.len().min(3)).map(|k| &meshes[(i + k) % meshes.len()]).collect();
                let row = measured(a, &entry.name, &meshes[i], &others, &ground)?;
                write_atomically(&file, serde_json::to_string_pretty(&row)?.as_bytes())?;
                row
            }
        };
        progress.step(entry.name.clone());
        objects.push(row);
    }
    progress.finish();
    let of = |f: fn(&Row) -> f64| objects.iter().map(f).collect::<Vec<f64>>();
    let mean = |values: Vec<f64>| values.iter().sum::<f64>() / values.len() as f64;
    let sum = |f: fn(&Row) -> usize| objects.iter().map(f).sum();
    let all = Report {
        camera_mm_median: median(&mut of(|r| r.camera_mm)).unwrap_or(f64::NAN),
        camera_deg_median: median(&mut of(|r| r.camera_deg)).unwrap_or(f64::NAN),
        mesh_mm_mean: mean(of(|r| r.mesh_mm)),
        truth_mm_mean: mean(of(|r| r.truth_mm)),
        found: sum(|r| r.found),
        images: sum(|r| r.images),
        found_with_true_mesh: sum(|r| r.found_with_true_mesh),
        found_auto: sum(|r| r.found_auto),
        found_auto_with_true_mesh: sum(|r| r.found_auto_with_true_mesh),
        wrong_auto: sum(|r| r.wrong_auto),
        objects,
    };
    write_atomically(&a.out.join("teach.json"), serde_json::to_string_pretty(&all)?.as_bytes())?;
    report(json, &all, || print(&all))?;
    Ok(Outcome::Found)
}

fn kept(file: &Path, a: &ReproduceTeachArguments) -> Option<Row> {
    let row: Row = serde_json::from_str(&std::fs::read_to_string(file).ok()?).ok()?;
    (row.photographs == a.photographs()
        && row.seed == a.seed
        && row.no_board == a.no_board()
        && row.depth == a.depth())
    .then_some(row)
}

/// A mesh with colours: smooth patches if it has none.
fn colored(mesh: Mesh) -> Mesh {
    if mesh.texture().is_some() || mesh.colors().is_some() {
        return mesh;
    }
    let wave = |v: &Vec3, f: f64, p: f64| {
        ((v.x * f * 1.3 + p).sin() + (v.y * f + 2.0 * p).sin() + (v.z * f * 0.9 - p).sin()) / 3.0
    };
    let color = |v: &Vec3| {
        let level = |base: f64, range: f64, f: f64, p: f64| (base + range * wave(v, f * PATCHES, p)) as u8;
        [level(150.0, 90.0, 1.0, 0.3), level(95.0, 75.0, 1.4, 1.1), level(75.0, 60.0, 0.8, 2.0)]
    };
    let colors = mesh.vertices().iter().map(color).collect();
    mesh.clone().with_colors(colors).unwrap_or(mesh)
}

fn measured(
    a: &ReproduceTeachArguments,
    name: &str,
    mesh: &Mesh,
    others: &[&Mesh],
    ground: &RgbImage,
) -> Result<Row> {
    let options = SimulationOptions { photographs: a.photographs(), ..SimulationOptions::default() };
    let cloth = patterned(2048, a.seed);
    let capture = if a.no_board() {
        SimulatedCapture::without_board(mesh, (&cloth, CLOTH), ground, &options, a.seed)
    } else {
        SimulatedCapture::new(mesh, &Board::new(Paper::A4), ground, &options, a.seed)
    };
    let length = (a.no_board && !a.one_view).then(|| marked_length(&capture, &options.camera, a.seed));
    let files = a.files(name);
    write_photographs(&capture, &files)?;
    if a.depth() {
        write_depth_images(&capture, &files)?;
    }
    let start = Instant::now();
    let camera = a.one_view.then_some(options.camera);
    let teaching = teaching(&files, a.photographs(), length, camera)?;
    let taught = teaching.mesh()?;
    let sure = sure_symmetries(&teaching.symmetries()?, true);
    let seconds = start.elapsed().as_secs_f64();
    let of_truth = sure_symmetries(&find_symmetries(mesh, &SymmetryOptions::default())?, true);
    let facts = teaching.shape().context("no mesh was made")?;
    let rows = facts.board_from_object;
    let world_from_taught = Pose::from_translation(Vec3::new(rows[0][3], rows[1][3], rows[2][3]));
    // Without a board the world's frame is arbitrary: align the cameras with their true poses.
    let board_from_world =
        if a.no_board() { board_from_world(&teaching, &capture)? } else { Pose::identity() };
    let board_from_taught = compose(&board_from_world, &world_from_taught);
    let errors = errors(&teaching, &capture, &board_from_world)?;
    let there = mesh.transformed(&capture.board_from_object);
    let seen = seen_points(&there, &capture, &options.camera);
    let placed = taught.transformed(&board_from_taught);
    let [mesh_mm, truth_mm] = distances(&placed, &there, &seen);
    sixfold_io::write_rgb(&files.join("errors.png"), &mesh_errors::picture(&placed, &there)?)?;
    let taught_from_true = compose(&board_from_taught.inverse(), &capture.board_from_object);
    let scene = NewScenes { mesh, others, ground, seed: a.seed };
    let mut info = ModelInfo::of_mesh(&taught);
    (info.symmetries_discrete, info.symmetries_continuous) = sure.clone();
    let symmetric = !(of_truth.0.is_empty() && of_truth.1.is_empty());
    let taught = Object::of_mesh(name, taught, info);
    let known = Object::of_mesh(name, mesh.clone(), ModelInfo::of_mesh(mesh));
    let (ppf, auto) = (PpfEstimator::default(), AutoMembers::default().estimator()?);
    let images = if a.no_board { 0 } else { NEW_IMAGES };
    let search = |estimator: &dyn PoseEstimator, object: &Object, from_true: &Pose| {
        if images == 0 { Ok([0, 0]) } else { scene.found(estimator, object, from_true, symmetric) }
    };
    let [found, _] = search(&ppf, &taught, &taught_from_true)?;
    let [found_with_true_mesh, _] = search(&ppf, &known, &Pose::identity())?;
    let [found_auto, wrong_auto] = search(&auto, &taught, &taught_from_true)?;
    let [found_auto_with_true_mesh, _] = search(&auto, &known, &Pose::identity())?;
    Ok(Row {
        name: name.to_owned(),
        photographs: a.photographs(),
        seed: a.seed,
        no_board: a.no_board(),
        depth: a.depth(),
        with_pose: errors.with_pose,
        diameter_mm: 1000.0 * mesh.diameter(),
        camera_mm: errors.camera_mm,
        camera_deg: errors.camera_deg,
        mask_iou: errors.mask_iou,
        mesh_mm,
        truth_mm,
        with_depth: facts.with_depth,
        symmetries: [sure.1.len(), sure.0.len()],
        symmetries_true: [of_truth.1.len(), of_truth.0.len()],
        found,
        images,
        found_with_true_mesh,
        found_auto,
        found_auto_with_true_mesh,
        wrong_auto,
        seconds,
    })
}

pub(super) fn compose(a: &Pose, b: &Pose) -> Pose {
    Pose::new(a.rotation() * b.rotation(), a.transform_point(&b.translation()))
}

/// Points of the true surface that are visible in a photograph.
fn seen_points(there: &Mesh, capture: &SimulatedCapture<'_>, camera: &Camera) -> Vec<Vec3> {
    let points = there.sample_surface(30_000, 2).points;
    let camera = camera.without_distortion();
    let mut seen = vec![false; points.len()];
    for pose in &capture.camera_from_board {
        let depth = sixfold_render::render_depth(there, pose, &camera);
        for (point, seen) in points.iter().zip(&mut seen) {
            let p = pose.transform_point(point);
            let Some(pixel) = camera.project(&p) else { continue };
            let front = depth.get(pixel.x.round().max(0.0) as usize, pixel.y.round().max(0.0) as usize);
            *seen |= front.is_some_and(|d| *d > 0.0 && p.z < f64::from(*d) + 0.0015);
        }
    }
    points.into_iter().zip(seen).filter(|(_, seen)| *seen).map(|(p, _)| p).collect()
}

/// Mean distance of points to their nearest neighbours among other points, millimetres.
pub(super) fn mean_millimetres<'a>(from: impl Iterator<Item = &'a Vec3>, to: &[Vec3]) -> f64 {
    let tree = KdTree::new(to);
    let all: Vec<f64> = from.filter_map(|p| tree.nearest(p)).map(|n| n.distance).collect();
    1000.0 * all.iter().sum::<f64>() / all.len().max(1) as f64
}

/// Mean distances in millimetres: of the mesh above the sheet to the true mesh, and of the visible part of the true mesh to the
/// mesh.
fn distances(found: &Mesh, there: &Mesh, seen: &[Vec3]) -> [f64; 2] {
    let (found, truth) = (found.sample_surface(100_000, 1).points, there.sample_surface(100_000, 3).points);
    let above = found.iter().filter(|p| p.z > 0.003);
    let seen = seen.iter().filter(|p| p.z > 0.003);
    [mean_millimetres(above, &truth), mean_millimetres(seen, &found)]
}

/// New images of an object that stands among others.
struct NewScenes<'a> {
    mesh: &'a Mesh,
    others: &'a [&'a Mesh],
    ground: &'a RgbImage,
    seed: u64,
}

impl NewScenes<'_> {
    /// The number of images in which a method's best pose of an object is right, and the number in which it is wrong with a
    /// confidence of 0.5 or more. `known_from_true` takes points of the true mesh to the known object's frame.
    fn found(
        &self,
        estimator: &dyn PoseEstimator,
        known: &Object,
        known_from_true: &Pose,
        symmetric: bool,
    ) -> Result<[usize; 2]> {
        let prepared = estimator.prepare(known)?;
        let points = ModelPoints::new(&self.mesh.sample_surface(2000, 5).points).context("no points")?;
        let (mut right, mut wrong) = (0, 0);
        for number in 0..NEW_IMAGES {
            let new = self.image(number);
            let depth = Arc::new(PreparedDepth::new(&new.depth, &new.camera, &estimator.depth_options())?);
            let query = Query { depth: Some(&depth), rgb: Some(&new.rgb), ..Query::new(&new.camera) };
            let estimates = estimator.estimate(prepared.as_ref(), &query)?;
            let Some(best) = estimates.first() else { continue };
            let camera_from_true = compose(&best.camera_from_object, known_from_true);
            let error = add_s(&points, symmetric, camera_from_true, new.truth);
            let is_right = error < RIGHT * self.mesh.diameter();
            right += usize::from(is_right);
            wrong += usize::from(!is_right && best.confidence >= 0.5);
        }
        Ok([right, wrong])
    }

    /// A simulated pair of images and the object's pose in it.
    fn image(&self, number: usize) -> NewImage {
        let camera =
            Camera { fx: 570.0, fy: 570.0, cx: 319.5, cy: 239.5, width: 640, height: 480, distortion: None };
        let upright = |angle: f64, x: f64, y: f64, mesh: &Mesh| {
            let (low, high) = mesh.bounding_box();
            let rotation = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), angle);
            let foot = Vec3::new(0.5 * (low.x + high.x), 0.5 * (low.y + high.y), low.z);
            Pose::new(rotation, Vec3::new(x, y, 0.0) - rotation * foot)
        };
        let turn = 1.3 * number as f64 + self.seed as f64;
        let radius = |mesh: &Mesh| {
            let (low, high) = mesh.bounding_box();
            0.5 * (high - low).xy().norm()
        };
        let mut placed = vec![(self.mesh, upright(turn, 0.0, 0.0, self.mesh))];
        for (k, other) in self.others.iter().enumerate() {
            // Two neighbours nearly touching the object: one in front of it, one behind.
            let apart = 0.85 * (radius(self.mesh) + radius(other));
            let angle = turn * 0.7 + if k == 0 { 0.4 } else { 3.6 };
            placed.push((*other, upright(2.0 * turn, apart * angle.cos(), apart * angle.sin(), other)));
        }
        let table = [[-0.6, -0.6], [0.6, -0.6], [0.6, 0.6], [-0.6, 0.6]].map(|[x, y]| Vec3::new(x, y, 0.0));
        let corners = vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        let table = Mesh::new(table.to_vec(), vec![[0, 1, 2], [0, 2, 3]])
            .and_then(|table| table.with_texture(corners, self.ground.clone()));
        let tilt = UnitQuaternion::from_axis_angle(&Vec3::x_axis(), 2.2 + 0.1 * (number % 3) as f64);
        let camera_from_table = Pose::new(tilt, Vec3::new(0.02 * number as f64 - 0.04, 0.03, 0.75));
        let mut objects: Vec<SceneObject<'_>> = placed
            .iter()
            .map(|(mesh, pose)| SceneObject { mesh, camera_from_object: compose(&camera_from_table, pose) })
            .collect();
        let truth = objects[0].camera_from_object;
        if let Ok(table) = &table {
            objects.push(SceneObject { mesh: table, camera_from_object: camera_from_table });
        }
        let mut buffer = VisibilityBuffer::new(&camera);
        buffer.render(&objects, &Default::default());
        let (depth, normals) = (buffer.depth(), buffer.normals(&objects));
        let noisy = simulate_depth(&depth, &normals, &DepthSensor::realsense(), self.seed + number as u64);
        let lamp = Light::Directional {
            direction: Vec3::new(0.4 - 0.2 * number as f64, 0.5, 1.0),
            color: [0.8, 0.76, 0.7],
        };
        let lights = [Light::Ambient { color: [0.3; 3] }, lamp];
        let rgb = shade(&buffer, &objects, &lights, &Material::default(), None);
        NewImage { camera, depth: noisy, rgb, truth }
    }
}

/// An image of a scene.
struct NewImage {
    camera: Camera,
    depth: DepthImage,
    rgb: RgbImage,
    /// True pose of the object.
    truth: Pose,
}

fn print(all: &Report) {
    println!(
        "{:<14} {:>8} {:>8} {:>7} {:>6} {:>8} {:>8} {:>6} {:>10} {:>8} {:>9} {:>6} {:>9} {:>5} {:>5}",
        "object",
        "diam mm",
        "cam mm",
        "cam deg",
        "IoU",
        "mesh mm",
        "truth mm",
        "depth",
        "symmetries",
        "found",
        "true mesh",
        "auto",
        "true mesh",
        "wrong",
        "s"
    );
    for r in &all.objects {
        println!(
            "{:<14} {:>8.1} {:>8.3} {:>7.3} {:>6.3} {:>8.2} {:>8.2} {:>6.2} {:>4}+{} of {}+{} {:>5}/{} {:>7}/{} {:>4}/{} {:>7}/{} {:>5} {:>5.0}",
            r.name,
            r.diameter_mm,
            r.camera_mm,
            r.camera_deg,
            r.mask_iou,
            r.mesh_mm,
            r.truth_mm,
            r.with_depth,
            r.symmetries[0],
            r.symmetries[1],
            r.symmetries_true[0],
            r.symmetries_true[1],
            r.found,
            r.images,
            r.found_with_true_mesh,
            r.images,
            r.found_auto,
            r.images,
            r.found_auto_with_true_mesh,
            r.images,
            r.wrong_auto,
            r.seconds
        );
    }
    println!(
        "median camera {:.3} mm, {:.3} degrees; mean mesh {:.2} mm, truth {:.2} mm; found {} of {}, with the true mesh {}; by auto {}, with the true mesh {}, wrong {}",
        all.camera_mm_median,
        all.camera_deg_median,
        all.mesh_mm_mean,
        all.truth_mm_mean,
        all.found,
        all.images,
        all.found_with_true_mesh,
        all.found_auto,
        all.found_auto_with_true_mesh,
        all.wrong_auto
    );
}
