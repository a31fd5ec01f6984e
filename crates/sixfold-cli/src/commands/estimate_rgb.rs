//! `sixfold estimate --method pix2pose` on one image: a pose from colour in a box, and pictures of what the network saw.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, anyhow, bail};
use serde::Serialize;
use sixfold_bop::{CameraFile, read_depth, read_mask, read_rgb, write_rgb};
use sixfold_detect::detect::DetectOptions;
use sixfold_detect::model::DetectorModel;
use sixfold_geometry::{Camera, Mask, Pose, Rect, RgbImage, Vec2, Vec3, undistort_depth, undistort_rgb};
use sixfold_mesh::Mesh;
use sixfold_pix2pose::depth::DepthScene;
use sixfold_pix2pose::object::ObjectEntry;

use super::boxes::Region;
use super::detect;
use super::estimate::{depth_scale, given_box};
use super::pix2pose::{Pix2Pose, view_picture};
use crate::commands::estimate_arguments::EstimateArguments;
use sixfold_shell::Outcome;
use sixfold_shell::objects;
use sixfold_shell::output::{pose_rows, report, write_atomically};
use sixfold_shell::overlay::{self, Drawn};

#[derive(Serialize)]
struct Found {
    object: String,
    object_id: u32,
    camera_from_object: [[f64; 4]; 4],
    /// Correspondences that fit over the object's pixels, 0 to 1.
    confidence: f64,
    /// Whether the mesh's outline was aligned with the image.
    refined: bool,
    icp: Option<Icp>,
    /// The square of the image that the last pass saw: x, y, side.
    window: [f64; 3],
    /// As PnP left them, best first; before refinement and ICP.
    hypotheses: Vec<Kept>,
    seconds: f64,
}

#[derive(Serialize)]
struct Icp {
    inliers: usize,
    rms_mm: f64,
}

#[derive(Serialize)]
struct Kept {
    camera_from_object: [[f64; 4]; 4],
    confidence: f64,
    inliers: usize,
    /// Outlier threshold on the expected error.
    threshold: f32,
}

#[derive(Serialize)]
struct Whole {
    poses: Vec<Found>,
    not_found: Vec<String>,
    overlay: Option<PathBuf>,
    coordinates: Option<PathBuf>,
}

pub(crate) fn run(a: &EstimateArguments) -> Result<Outcome> {
    let pix2pose = Pix2Pose::new(a.weights.as_deref(), a.seed, a.looks, a.refines())?;
    let rgb_file = a.rgb.as_deref().ok_or_else(|| {
        anyhow!("--method pix2pose needs a colour image: give --rgb FILE (with --camera and --box) or --dataset DIR")
    })?;
    let camera_path = a.camera.as_deref().ok_or_else(|| anyhow!("--camera FILE is missing"))?;
    if a.objects.len() > 1 {
        bail!(
            "--object: found {} of them; --method pix2pose takes one object and its --box at a time",
            a.objects.len()
        );
    }
    if a.icp && (a.depth.is_none() || a.objects.is_empty()) {
        bail!("--icp needs the depth image (--depth FILE) and the mesh (--object NAME_OR_MESH)");
    }
    let entry = pix2pose.entry(a.object_id)?;
    let object = match a.objects.first() {
        Some(name) => {
            let object = objects::find(name, a.unit, &a.store)?;
            pix2pose.check_mesh(entry.id, &object.mesh, name)?;
            Some(object)
        }
        None => {
            eprintln!(
                "note: without --object NAME_OR_MESH the outline is not aligned, and the overlay shows a box"
            );
            None
        }
    };
    let raw = read_rgb(rgb_file)?;
    let (width, height) = raw.size();
    let file = CameraFile::read(camera_path)?;
    let lens = file.for_image(width, height, camera_path)?;
    // Lens distortion ends here: everything behind works on pinhole images.
    let image = undistort_rgb(&raw, &lens).with_context(|| rgb_file.display().to_string())?;
    let region = match (&a.detector, &a.region, &a.mask) {
        (Some(weights), None, None) => detected(weights, &image, entry.id)?,
        _ => Some(region(a, &lens)?),
    };
    let depth = match (&a.depth, a.icp) {
        (Some(path), true) => {
            let raw = read_depth(path, depth_scale(a, &file, camera_path)? / 1000.0)?;
            let depth = undistort_depth(&raw, &lens).with_context(|| path.display().to_string())?;
            Some(DepthScene::new(&depth, &lens.without_distortion()))
        }
        (Some(_), false) => {
            eprintln!("note: --depth is not used without --icp");
            None
        }
        (None, _) => None,
    };
    let camera = lens.without_distortion();
    let name = object.as_ref().map_or_else(|| format!("object {}", entry.id), |o| o.name.clone());
    let mesh = object.as_ref().map(|o| &o.mesh);
    let start = Instant::now();
    let posed = match &region {
        Some(region) => pix2pose.estimate(&image, &camera, entry.id, &region.bbox, mesh)?,
        None => None,
    };
    let posed = posed.filter(|p| p.score >= a.min_score.unwrap_or(0.0));
    let mut pose: Option<Pose> = posed.as_ref().map(|p| p.camera_from_object);
    let mut aligned = None;
    if let (Some(depth), Some(posed), Some(mesh)) = (&depth, &posed, mesh) {
        let seen = region.as_ref().and_then(Region::pixels_for_icp);
        aligned = pix2pose.align(depth, entry.id, mesh, posed, seen.as_ref())?;
        match &aligned {
            Some(aligned) => pose = Some(aligned.camera_from_object),
            None => eprintln!("note: too little depth is measured on {name}: its pose is that from colour"),
        }
    }
    let seconds = start.elapsed().as_secs_f64();
    let mut whole = Whole { poses: vec![], not_found: vec![], overlay: None, coordinates: None };
    match (&posed, pose) {
        (Some(posed), Some(pose)) => whole.poses.push(Found {
            object: name,
            object_id: entry.id,
            camera_from_object: pose_rows(&pose),
            confidence: posed.score,
            refined: posed.refined,
            icp: aligned.map(|i| Icp { inliers: i.inliers, rms_mm: 1000.0 * i.rms }),
            window: [posed.found.view.window.x, posed.found.view.window.y, posed.found.view.window.width],
            hypotheses: posed
                .found
                .hypotheses
                .iter()
                .map(|h| Kept {
                    camera_from_object: pose_rows(&h.camera_from_object),
                    confidence: h.score,
                    inliers: h.inliers,
                    threshold: h.threshold,
                })
                .collect(),
            seconds,
        }),
        _ => whole.not_found.push(name),
    }
    if let Some(folder) = &a.out {
        let solid = match mesh {
            Some(mesh) => mesh.clone(),
            None => box_of(entry)?,
        };
        let color = overlay::color(entry.id as usize);
        let drawn: Vec<Drawn<'_>> =
            pose.iter().map(|p| Drawn { mesh: &solid, camera_from_object: *p, color }).collect();
        let path = folder.join("overlay.png");
        write_rgb(&path, &overlay::draw(&image, &camera, &drawn))?;
        whole.overlay = Some(path);
        if let Some(posed) = &posed {
            let path = folder.join("coordinates.png");
            write_rgb(&path, &view_picture(&posed.found.view))?;
            whole.coordinates = Some(path);
        }
        write_atomically(&folder.join("poses.json"), serde_json::to_string_pretty(&whole)?.as_bytes())?;
    }
    report(&a.json, &whole, || print_table(&whole, a.out.as_deref()))?;
    Ok(if whole.poses.is_empty() { Outcome::NothingFound } else { Outcome::Found })
}

fn print_table(whole: &Whole, folder: Option<&Path>) {
    println!(
        "{:<24} {:>10} {:>8} {:>26} {:>8}",
        "object", "confidence", "inliers", "translation (m)", "seconds"
    );
    for f in &whole.poses {
        let t: Vec<String> = f.camera_from_object[..3].iter().map(|r| format!("{:8.4}", r[3])).collect();
        println!(
            "{:<24} {:>10.3} {:>8} {:>26} {:>8.2}",
            f.object,
            f.confidence,
            f.hypotheses.first().map_or(0, |h| h.inliers),
            t.join(" "),
            f.seconds
        );
    }
    for name in &whole.not_found {
        println!("{name:<24} not found");
    }
    if let Some(folder) = folder {
        let coordinates = if whole.coordinates.is_some() { ", coordinates.png" } else { "" };
        println!("poses.json, overlay.png{coordinates} are in {}", folder.display());
    }
}

/// Least score of an object that was asked for: it is more likely there than any of the detector's objects.
const ASKED_FOR: f32 = 0.4;

/// Where a detector sees the object best, if at all.
fn detected(weights: &Path, image: &RgbImage, id: u32) -> Result<Option<Region>> {
    let model = DetectorModel::load(weights)?;
    model.check_object(id).with_context(|| weights.display().to_string())?;
    let options = model.options();
    let options = DetectOptions { threshold: options.threshold.min(ASKED_FOR), ..options };
    let found = model.detect(image, &options)?;
    Ok(detect::best(&found, &model, id).map(|d| Region {
        bbox: d.bbox,
        score: f64::from(d.score),
        mask: d.mask.clone(),
    }))
}

/// Where the object is: `--box`, or the box of `--mask`; in the pinhole image.
fn region(a: &EstimateArguments, lens: &Camera) -> Result<Region> {
    let (bbox, mask) = match (given_box(a, lens)?, &a.mask) {
        (Some(region), None) => (region, None),
        (None, Some(path)) => {
            let mask = read_mask(path)?;
            lens.check_image(mask.width(), mask.height()).with_context(|| path.display().to_string())?;
            let bbox = box_of_mask(&mask).ok_or_else(|| {
                anyhow!("{}: the mask is empty: it has to be above zero on the object", path.display())
            })?;
            // Of a distorted image it fits no pixel of the pinhole image exactly: its box has to do.
            (bbox, lens.distortion.is_none().then_some(mask))
        }
        (Some(_), Some(_)) => bail!("--box and --mask: give one of them, --method pix2pose needs one box"),
        (None, None) => {
            bail!(
                "--method pix2pose needs to know where the object is: give --detector FILE.safetensors, --box X,Y,W,H or \
                 --mask FILE"
            )
        }
    };
    Ok(Region { bbox: undistorted(&bbox, lens), score: 1.0, mask })
}

fn box_of_mask(mask: &Mask) -> Option<Rect> {
    let (mut x0, mut y0, mut x1, mut y1) = (usize::MAX, usize::MAX, 0, 0);
    for y in 0..mask.height() {
        for (x, inside) in mask.row(y).iter().enumerate() {
            if *inside {
                (x0, y0, x1, y1) = (x0.min(x), y0.min(y), x1.max(x + 1), y1.max(y + 1));
            }
        }
    }
    let (x, y) = (x0 as f64, y0 as f64);
    (x1 > x0).then(|| Rect { x, y, width: (x1 - x0) as f64, height: (y1 - y0) as f64 })
}

/// The box that holds what a box of the raw image shows, in the pinhole image.
fn undistorted(region: &Rect, lens: &Camera) -> Rect {
    if lens.distortion.is_none() {
        return *region;
    }
    let (mut low, mut high) = (Vec2::repeat(f64::INFINITY), Vec2::repeat(f64::NEG_INFINITY));
    for (u, v) in (0..=4).flat_map(|u| (0..=4).map(move |v| (u, v))) {
        let share = |i: i32, start: f64, size: f64| start + 0.25 * f64::from(i) * size;
        let at = Vec2::new(share(u, region.x, region.width), share(v, region.y, region.height));
        if let Some(at) = lens.undistort_point(&at) {
            (low, high) = (low.inf(&at), high.sup(&at));
        }
    }
    if low.x > high.x {
        return *region;
    }
    Rect { x: low.x, y: low.y, width: high.x - low.x, height: high.y - low.y }
}

/// The box of the model's coordinates, for an overlay without a mesh.
fn box_of(entry: &ObjectEntry) -> Result<Mesh> {
    let scale = entry.scale();
    let corner =
        |i: usize| scale.restore(&Vec3::from_fn(|axis, _| if i >> axis & 1 == 0 { -1.0 } else { 1.0 }));
    let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let faces = sides.iter().flat_map(|s| [[s[0], s[1], s[2]], [s[0], s[2], s[3]]]).collect();
    Ok(Mesh::new((0..8).map(corner).collect(), faces)?)
}
