//! `sixfold reproduce teach-dataset`: objects of a BOP dataset taught from a few of its real images, with annotated poses and masks
//! and without their meshes, then compared with these meshes and searched in the other images.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use serde::{Deserialize, Serialize};
use sixfold_bop::{
    BopDataset, GroundTruthInfo, ModelPoints, Models, Scene, VISIBILITY_DELTA, add_s, ground_truth_visibility,
};
use sixfold_data::{FloorEntry, PhotographEntry, PhotographFile};
use sixfold_estimator::{Object, PoseEstimator, Query, Region};
use sixfold_geometry::{Camera, Mask, Plane, Pose, Vec3, stats::median};
use sixfold_io::write_mask_and_hidden;
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_shell::Outcome;
use sixfold_shell::output::{JsonArguments, report, write_atomically};
use sixfold_shell::progress::{Progress, check_interrupt};
use sixfold_shell::ranges::in_range;
use sixfold_teach::{MAX_PHOTOGRAPHS, SalientSegmenter, ShapeOptions, Teaching};
use sixfold_views::estimator::ViewsEstimator;

use super::mesh_errors;
use super::teach::{compose, mean_millimetres};

pub(super) const AFTER_HELP: &str = "Example:\n  \
    sixfold reproduce teach-dataset --dataset lmo --objects 5 6 8 9 12 --out out/reproduce-teach-dataset\n\n\
    Finished objects are kept. After a stop, the same command resumes.";

/// Minimum visible fraction of an object that is searched in an image, as in the BOP Challenge.
const VISIBLE_TO_FIND: f64 = 0.1;
/// Points of each other object that stands on the board.
const BODY_POINTS: usize = 3000;
/// Steps of the search for the board's normal, as tangents of the angle: it is within 45 degrees of the camera's direction.
const FIRST_STEP: f64 = 1.0;
const LAST_STEP: f64 = 0.001;
/// Minimum number of other objects for a plane, and the largest mean deviation of their lowest points from it, metres.
/// Chosen by hand.
const FEWEST_BODIES: usize = 4;
const BELOW: f64 = 0.006;
/// A pose is right within this fraction of the diameter (Hinterstoisser et al. 2012).
const RIGHT: f64 = 0.1;

#[derive(Debug, Args)]
pub(crate) struct TeachDatasetArguments {
    /// BOP dataset folder
    #[arg(long, value_name = "DIR")]
    dataset: PathBuf,
    /// Split of the dataset
    #[arg(long, value_name = "SPLIT", default_value = "test")]
    split: String,
    /// Objects to teach, by their ids
    #[arg(long, value_name = "ID", num_args = 1.., required = true)]
    objects: Vec<u32>,
    /// Number of images from which each object is learned, chosen from viewpoints as different as possible
    #[arg(long, value_name = "N", default_value_t = 16)]
    photographs: usize,
    /// Minimum visible fraction of an object in the images from which it is learned
    #[arg(long, value_name = "FRACTION", default_value_t = 0.5)]
    min_visible: f64,
    /// Maximum number of other images in which each object is searched for
    #[arg(long, value_name = "N", default_value_t = 1000)]
    images: usize,
    /// Folder for the results
    #[arg(long, value_name = "DIR", default_value = "out/reproduce-teach-dataset")]
    out: PathBuf,
}

/// The inputs of a row.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Asked {
    photographs: usize,
    min_visible: f64,
    images: usize,
}

impl Asked {
    fn of(a: &TeachDatasetArguments) -> Asked {
        Asked { photographs: a.photographs, min_visible: a.min_visible, images: a.images }
    }
}

/// One object; lengths in millimetres.
#[derive(Debug, Serialize, Deserialize)]
struct Row {
    object: u32,
    asked: Asked,
    /// Images that taught it, as scene/image.
    taught_from: Vec<String>,
    diameter_mm: f64,
    /// Mean distance of the taught mesh to the true mesh, and of the visible part of the true mesh to the taught mesh.
    mesh_mm: f64,
    truth_mm: f64,
    /// Fraction of the taught surface that no image shows.
    unseen: f64,
    images: usize,
    /// Right by ADD(-S), by `views` in ground-truth boxes, with the taught object and with the true mesh.
    found: usize,
    found_with_true_mesh: usize,
}

#[derive(Serialize)]
struct Report {
    objects: Vec<Row>,
    mesh_mm_mean: f64,
    truth_mm_mean: f64,
    images: usize,
    found: usize,
    found_with_true_mesh: usize,
}

/// An object in an image.
struct Seen {
    scene: u32,
    image: u32,
    camera: Camera,
    pose: Pose,
    visible: Mask,
    /// The pixels of other annotated objects.
    others: Mask,
    info: GroundTruthInfo,
}

impl Seen {
    fn name(&self) -> String {
        format!("{:06}/{:06}", self.scene, self.image)
    }

    /// The viewing direction in the object's frame.
    fn direction(&self) -> Vec3 {
        self.pose.inverse().translation().normalize()
    }
}

pub(super) fn run(a: &TeachDatasetArguments, json: &JsonArguments) -> Result<Outcome> {
    in_range("--min-visible", a.min_visible, 0.0..=1.0)?;
    in_range("--photographs", a.photographs, 4..=MAX_PHOTOGRAPHS)?;
    let dataset = BopDataset::open(&a.dataset, &a.split)?;
    let info = dataset.models_info(Models::Rendering)?.unwrap_or_default();
    let mut meshes = BTreeMap::new();
    let mut scenes = vec![];
    for id in dataset.scene_ids() {
        scenes.push(dataset.scene(id)?);
    }
    for scene in &scenes {
        for im_id in scene.image_ids() {
            for truth in &scene.image(im_id)?.ground_truth {
                if let Entry::Vacant(place) = meshes.entry(truth.obj_id) {
                    place.insert(dataset.model(truth.obj_id, Models::Rendering)?);
                }
            }
        }
    }
    let mut progress = Progress::new("objects", a.objects.len());
    let mut objects = vec![];
    for &id in &a.objects {
        check_interrupt("finished objects are kept; give the same command to continue")?;
        let mesh = meshes.get(&id).with_context(|| format!("--objects: no image shows object {id}"))?;
        let file = a.out.join(format!("{id:06}.json"));
        let row = match kept(&file, a) {
            Some(row) => row,
            None => {
                let info = info.0.get(&id).cloned().unwrap_or_else(|| ModelInfo::of_mesh(mesh));
                let row = measured(a, (id, mesh, &info), &seen(&scenes, id, &meshes)?, (&scenes, &meshes))?;
                write_atomically(&file, serde_json::to_string_pretty(&row)?.as_bytes())?;
                row
            }
        };
        progress.step(format!("object {id}"));
        objects.push(row);
    }
    progress.finish();
    let mean = |f: fn(&Row) -> f64| objects.iter().map(f).sum::<f64>() / objects.len() as f64;
    let all = Report {
        mesh_mm_mean: mean(|r| r.mesh_mm),
        truth_mm_mean: mean(|r| r.truth_mm),
        images: objects.iter().map(|r| r.images).sum(),
        found: objects.iter().map(|r| r.found).sum(),
        found_with_true_mesh: objects.iter().map(|r| r.found_with_true_mesh).sum(),
        objects,
    };
    report(json, &all, || print(&all))?;
    Ok(Outcome::Found)
}

fn kept(file: &Path, a: &TeachDatasetArguments) -> Option<Row> {
    let row: Row = serde_json::from_str(&std::fs::read_to_string(file).ok()?).ok()?;
    (row.asked == Asked::of(a)).then_some(row)
}

/// All images that show an object.
fn seen(scenes: &[Scene], id: u32, meshes: &BTreeMap<u32, Mesh>) -> Result<Vec<Seen>> {
    let mut all = vec![];
    for scene in scenes {
        for im_id in scene.image_ids() {
            let truths = &scene.image(im_id)?.ground_truth;
            let posed: Vec<(&Mesh, Pose)> =
                truths.iter().filter_map(|t| Some((meshes.get(&t.obj_id)?, t.camera_from_object))).collect();
            let Some(index) = truths.iter().position(|t| t.obj_id == id) else { continue };
            let camera = scene.camera(im_id)?;
            let mut found = ground_truth_visibility(&posed, &camera, None, VISIBILITY_DELTA);
            let this = found.remove(index);
            let others = Mask::from_fn(camera.width, camera.height, |x, y| {
                found.iter().any(|other| other.mask_visible[(x, y)])
            });
            all.push(Seen {
                scene: scene.scene_id,
                image: im_id,
                camera,
                pose: truths[index].camera_from_object,
                visible: this.mask_visible,
                others,
                info: this.info,
            });
        }
    }
    Ok(all)
}

/// Images from different sides: each is the one whose direction is farthest from those chosen before.
fn chosen(seen: &[Seen], most: usize, visible: f64) -> Vec<usize> {
    let good: Vec<usize> = (0..seen.len()).filter(|i| seen[*i].info.visib_fract >= visible).collect();
    let Some(first) =
        good.iter().max_by(|a, b| seen[**a].info.visib_fract.total_cmp(&seen[**b].info.visib_fract))
    else {
        return vec![];
    };
    let mut chosen = vec![*first];
    while chosen.len() < most.min(good.len()) {
        let nearest = |i: usize| {
            let cosines = chosen.iter().map(|j| seen[i].direction().dot(&seen[*j].direction()));
            cosines.fold(-1.0, f64::max)
        };
        let farthest =
            good.iter().filter(|i| !chosen.contains(i)).min_by(|a, b| nearest(**a).total_cmp(&nearest(**b)));
        let Some(farthest) = farthest else { break };
        chosen.push(*farthest);
    }
    chosen.sort_unstable();
    chosen
}

fn image_file(scenes: &[Scene], seen: &Seen) -> Result<PathBuf> {
    let scene = scenes.iter().find(|s| s.scene_id == seen.scene);
    scene
        .and_then(|s| s.rgb_path(seen.image))
        .with_context(|| format!("{}: found no colour image", seen.name()))
}

/// Writes the input of `sixfold teach`: poses, masks and the images' paths.
fn photograph_file(
    folder: &Path,
    scenes: &[Scene],
    used: &[&Seen],
    floor: Option<FloorEntry>,
) -> Result<PathBuf> {
    let mut photographs = vec![];
    for (number, seen) in used.iter().enumerate() {
        let mask = format!("{number:06}_mask.png");
        let either = Mask::from_fn(seen.camera.width, seen.camera.height, |x, y| {
            seen.visible[(x, y)] || seen.others[(x, y)]
        });
        sixfold_io::make_folder_of(&folder.join(&mask))?;
        write_mask_and_hidden(&folder.join(&mask), &either, Some(&seen.others))?;
        let (rotation, t) = (seen.pose.rotation_matrix(), 1000.0 * seen.pose.translation());
        photographs.push(PhotographEntry {
            image: std::path::absolute(image_file(scenes, seen)?)?.display().to_string(),
            camera: "camera.json".to_owned(),
            cam_R_m2c: std::array::from_fn(|i| rotation[(i / 3, i % 3)]),
            cam_t_m2c: [t.x, t.y, t.z],
            mask: Some(mask),
            depth: None,
            depth_scale: None,
        });
    }
    let camera = used.first().map(|s| s.camera).context("no image shows enough of the object")?;
    write_atomically(&folder.join("camera.json"), serde_json::to_string_pretty(&camera)?.as_bytes())?;
    let file = folder.join("photographs.json");
    let list = PhotographFile { mesh: None, unit: None, floor, photographs };
    write_atomically(&file, serde_json::to_string_pretty(&list)?.as_bytes())?;
    Ok(file)
}

fn measured(
    a: &TeachDatasetArguments,
    (id, mesh, info): (u32, &Mesh, &ModelInfo),
    seen: &[Seen],
    (scenes, meshes): (&[Scene], &BTreeMap<u32, Mesh>),
) -> Result<Row> {
    let numbers = chosen(seen, a.photographs, a.min_visible);
    let used: Vec<&Seen> = numbers.iter().map(|i| &seen[*i]).collect();
    if used.len() < 4 {
        bail!("object {id}: {} images show {} of it, expected at least 4", used.len(), a.min_visible);
    }
    let folder = a.out.join(format!("{id:06}"));
    let floor = up(scenes, id, &used, meshes)?;
    let file = photograph_file(&folder, scenes, &used, floor)?;
    let mut teaching = Teaching::open_file(folder.join("teaching"), &file, None)?;
    let shape = ShapeOptions::default();
    teaching.locate(&())?;
    teaching.find_masks(&SalientSegmenter::shipped()?, &shape, &())?;
    teaching.reconstruct(&shape, &())?;
    sixfold_io::write_rgb(&folder.join("photographs.png"), &teaching.picture()?)?;
    let taught = teaching.mesh()?;
    let facts = teaching.shape().context("no mesh was made")?;
    let rows = facts.board_from_object;
    let true_from_taught = Pose::from_translation(Vec3::new(rows[0][3], rows[1][3], rows[2][3]));
    let placed = taught.transformed(&true_from_taught);
    let [mesh_mm, truth_mm] = distances(&placed, mesh, &used);
    sixfold_io::write_rgb(&folder.join("errors.png"), &mesh_errors::picture(&placed, mesh)?)?;
    let visible = |s: &&Seen| s.info.visib_fract >= VISIBLE_TO_FIND;
    let others: Vec<&Seen> = (0..seen.len())
        .filter(|i| !numbers.contains(i))
        .map(|i| &seen[i])
        .filter(visible)
        .take(a.images)
        .collect();
    let name = format!("object {id}");
    let views = ViewsEstimator::shipped()?;
    let taught_info = ModelInfo::of_mesh(&taught);
    let taught = Object::of_mesh(&name, taught, taught_info);
    let known = Object::of_mesh(&name, mesh.clone(), info.clone());
    let symmetric = !(info.symmetries_discrete.is_empty() && info.symmetries_continuous.is_empty());
    let search = Search { mesh, symmetric, diameter: info.diameter, scenes, images: &others };
    Ok(Row {
        object: id,
        asked: Asked::of(a),
        taught_from: used.iter().map(|s| s.name()).collect(),
        diameter_mm: 1000.0 * info.diameter,
        mesh_mm,
        truth_mm,
        unseen: facts.unseen,
        images: others.len(),
        found: search.right(&views, &taught, &true_from_taught.inverse())?,
        found_with_true_mesh: search.right(&views, &known, &Pose::identity())?,
    })
}

/// The up direction in the object's frame, which a printed board would give: the normal of the plane on which the other annotated
/// objects of each image stand, as the median over the images. The object's true mesh is not used.
fn up(scenes: &[Scene], id: u32, used: &[&Seen], meshes: &BTreeMap<u32, Mesh>) -> Result<Option<FloorEntry>> {
    let points: BTreeMap<u32, Vec<Vec3>> =
        meshes.iter().map(|(id, mesh)| (*id, mesh.sample_surface(BODY_POINTS, 7).points)).collect();
    let mut normals = vec![];
    for seen in used {
        let Some(scene) = scenes.iter().find(|s| s.scene_id == seen.scene) else { continue };
        let object_from_camera = seen.pose.inverse();
        let mut bodies = vec![];
        for truth in scene.image(seen.image)?.ground_truth.iter().filter(|t| t.obj_id != id) {
            let Some(points) = points.get(&truth.obj_id) else { continue };
            let pose = object_from_camera * truth.camera_from_object;
            bodies.push(points.iter().map(|p| pose.transform_point(p)).collect::<Vec<Vec3>>());
        }
        normals.extend(standing_plane(&bodies, &object_from_camera.translation()).map(|plane| plane.normal));
    }
    let of = |axis: usize| median(&mut normals.iter().map(|n| n[axis]).collect::<Vec<f64>>());
    let (Some(x), Some(y), Some(z)) = (of(0), of(1), of(2)) else { return Ok(None) };
    Ok(Some(FloorEntry { normal: [x, y, z], point: None }))
}

/// The plane that bodies touch from above, on the cameras' side: the normal along which their lowest points are at the same height.
fn standing_plane(bodies: &[Vec<Vec3>], eye: &Vec3) -> Option<Plane> {
    let lowest = |normal: &Vec3| -> Vec<f64> {
        bodies.iter().map(|body| body.iter().map(|p| normal.dot(p)).fold(f64::INFINITY, f64::min)).collect()
    };
    // The mean distance from the median, because one body may stand on another.
    let spread = |normal: &Vec3| {
        let mut heights = lowest(normal);
        let median_height = median(&mut heights).unwrap_or(f64::NAN);
        (heights.iter().map(|h| (h - median_height).abs()).sum::<f64>() / heights.len() as f64, median_height)
    };
    let mut best = eye.try_normalize(1e-9)?;
    let mut step = FIRST_STEP;
    while step > LAST_STEP {
        let across =
            best.cross(&Vec3::x()).try_normalize(0.1).unwrap_or_else(|| best.cross(&Vec3::y()).normalize());
        let other = best.cross(&across);
        let around = (-4..=4).flat_map(|i| (-4..=4).map(move |j| (0.25 * f64::from(i), 0.25 * f64::from(j))));
        let tried = around.map(|(i, j)| (best + step * (i * across + j * other)).normalize());
        best = tried.min_by(|a, b| spread(a).0.total_cmp(&spread(b).0))?;
        step *= 0.6;
    }
    let (error, offset) = spread(&best);
    (bodies.len() >= FEWEST_BODIES && error < BELOW).then_some(Plane { normal: best, offset })
}

/// Mean distances in millimetres: of the found mesh to the true mesh, and of the visible part of the true mesh to the found mesh.
fn distances(found: &Mesh, truth: &Mesh, used: &[&Seen]) -> [f64; 2] {
    /// How far behind the rendered surface a point still counts as visible, metres.
    const BEHIND: f64 = 0.0015;
    let points = truth.sample_surface(30_000, 2).points;
    let mut is_seen = vec![false; points.len()];
    for seen in used {
        let depth = sixfold_render::render_depth(truth, &seen.pose, &seen.camera);
        for (point, is_seen) in points.iter().zip(&mut is_seen) {
            let p = seen.pose.transform_point(point);
            let Some(pixel) = seen.camera.project(&p) else { continue };
            let at = (pixel.x.round().max(0.0) as usize, pixel.y.round().max(0.0) as usize);
            let front = depth.get(at.0, at.1).copied().unwrap_or(0.0);
            let visible = seen.visible.get(at.0, at.1).copied().unwrap_or(false);
            *is_seen |= visible && front > 0.0 && p.z < f64::from(front) + BEHIND;
        }
    }
    let shown: Vec<Vec3> = points.into_iter().zip(is_seen).filter(|(_, s)| *s).map(|(p, _)| p).collect();
    let (found, truth) = (found.sample_surface(100_000, 1).points, truth.sample_surface(100_000, 3).points);
    [mean_millimetres(found.iter(), &truth), mean_millimetres(shown.iter(), &found)]
}

/// Images in which an object is searched.
struct Search<'a> {
    mesh: &'a Mesh,
    symmetric: bool,
    /// The object's diameter, metres.
    diameter: f64,
    scenes: &'a [Scene],
    images: &'a [&'a Seen],
}

impl Search<'_> {
    /// The number of images in which the best pose in the ground truth's box is right. `known_from_true` takes points of the true
    /// mesh to the known object's frame.
    fn right(&self, estimator: &dyn PoseEstimator, known: &Object, known_from_true: &Pose) -> Result<usize> {
        let prepared = estimator.prepare(known)?;
        let points = ModelPoints::new(&self.mesh.sample_surface(2000, 5).points).context("no points")?;
        let mut right = 0;
        for seen in self.images {
            check_interrupt("finished objects are kept; give the same command to continue")?;
            let Some(bbox) = seen.info.bbox_visib else { continue };
            let rgb = sixfold_io::read_rgb(&image_file(self.scenes, seen)?)?;
            let region = Region::of_box(bbox);
            let query = Query { rgb: Some(&rgb), region: Some(&region), ..Query::new(&seen.camera) };
            let Some(best) = estimator.estimate(prepared.as_ref(), &query)?.into_iter().next() else {
                continue;
            };
            let camera_from_true = compose(&best.camera_from_object, known_from_true);
            let error = add_s(&points, self.symmetric, camera_from_true, seen.pose);
            right += usize::from(error < RIGHT * self.diameter);
        }
        Ok(right)
    }
}

fn print(all: &Report) {
    println!(
        "{:<7} {:>7} {:>8} {:>8} {:>9} {:>7} {:>7} {:>7} {:>10}",
        "object", "taught", "diam mm", "mesh mm", "truth mm", "unseen", "images", "found", "true mesh"
    );
    for r in &all.objects {
        println!(
            "{:<7} {:>7} {:>8.1} {:>8.2} {:>9.2} {:>7.2} {:>7} {:>7} {:>10}",
            r.object,
            r.taught_from.len(),
            r.diameter_mm,
            r.mesh_mm,
            r.truth_mm,
            r.unseen,
            r.images,
            r.found,
            r.found_with_true_mesh
        );
    }
    println!(
        "mean mesh {:.2} mm, truth {:.2} mm; found {} of {}, with the true mesh {}",
        all.mesh_mm_mean, all.truth_mm_mean, all.found, all.images, all.found_with_true_mesh
    );
}
