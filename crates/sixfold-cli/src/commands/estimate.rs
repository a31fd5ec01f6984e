//! `sixfold estimate`: one image here, a dataset in `estimate_dataset`.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use serde::Serialize;
use sixfold_bop::{CameraFile, read_depth, read_mask, read_rgb, write_rgb};
use sixfold_geometry::{Camera, DepthImage, Mask, Rect, RgbImage, undistort_depth, undistort_rgb};
use sixfold_match::{Estimate, EstimateOptions, Scene, SceneOptions, VerificationScore, estimate};

use super::boxes::box_mask;
use crate::commands::estimate_arguments::EstimateArguments;
use sixfold_shell::Outcome;
use sixfold_shell::objects;
use sixfold_shell::output::{pose_rows, report};
use sixfold_shell::overlay::{self, Drawn};
use sixfold_shell::progress::{Progress, check_interrupt};

/// Least confidence of a pose in one image: on real frames most wrong poses lie below, most right ones above.
const SURE_ENOUGH: f64 = 0.25;

/// One image as methods on depth want it, without lens distortion.
pub(super) struct Input {
    pub depth: DepthImage,
    /// For the overlay.
    pub rgb: Option<RgbImage>,
    pub camera: Camera,
    pub scene: Scene,
}

impl Input {
    /// Reads the files that the arguments name.
    pub fn read(a: &EstimateArguments) -> Result<Input> {
        let depth_file = a
            .depth
            .as_deref()
            .ok_or_else(|| anyhow!("give --depth FILE (with --camera and --object) or --dataset DIR"))?;
        let camera_path = a.camera.as_deref().ok_or_else(|| anyhow!("--camera FILE is missing"))?;
        if a.objects.is_empty() {
            bail!("--object NAME_OR_MESH is missing: what is to be found?");
        }
        let file = CameraFile::read(camera_path)?;
        let depth = read_depth(depth_file, depth_scale(a, &file, camera_path)? / 1000.0)?;
        let (width, height) = depth.size();
        let camera = file.for_image(width, height, camera_path)?;
        let depth = undistort_depth(&depth, &camera)?;
        let rgb = match &a.rgb {
            None => None,
            Some(path) => {
                let raw = read_rgb(path)?;
                Some(undistort_rgb(&raw, &camera).with_context(|| path.display().to_string())?)
            }
        };
        let camera = camera.without_distortion();
        let mask = region_mask(a, &camera)?;
        let scene = Scene::new(&depth, &camera, mask.as_ref(), &scene_options(a))
            .with_context(|| depth_file.display().to_string())?;
        Ok(Input { depth, rgb, camera, scene })
    }
}

pub(crate) fn run(a: &EstimateArguments) -> Result<Outcome> {
    if a.templates_only {
        bail!("--templates-only belongs to --method mttm");
    }
    if a.weights.is_some() || a.object_id.is_some() || a.icp || a.detector.is_some() || a.looks.is_some() {
        bail!(
            "--weights, --object-id, --icp, --looks and, for one image, --detector belong to --method pix2pose; point pair features \
             need none of them"
        );
    }
    let Input { depth, rgb, camera, scene } = Input::read(a)?;
    let mut options = estimate_options(a, a.instances.get());
    // A person who asks about one image wants no guesses; a dataset's scores sort them out.
    options.min_score = a.min_score.unwrap_or(SURE_ENOUGH);
    let mut progress = Progress::new("objects", a.objects.len());
    let mut found: Vec<(objects::Object, Vec<Estimate>, f64)> = vec![];
    for name in &a.objects {
        check_interrupt("nothing was written")?;
        let start = std::time::Instant::now();
        let object = objects::find(name, a.unit, &a.store)?;
        let model = object.ppf_model()?;
        let estimates = estimate(&scene, &model, &options);
        progress.step(object.name.clone());
        found.push((object, estimates, start.elapsed().as_secs_f64()));
    }
    progress.finish();
    let overlay = match &a.out {
        None => None,
        Some(folder) => {
            let background = rgb.unwrap_or_else(|| overlay::depth_picture(&depth));
            let drawn: Vec<Drawn<'_>> = found
                .iter()
                .enumerate()
                .flat_map(|(i, (object, estimates, _))| {
                    estimates.iter().map(move |e| Drawn {
                        mesh: &object.mesh,
                        camera_from_object: e.camera_from_object,
                        color: overlay::color(i),
                    })
                })
                .collect();
            let path = folder.join("overlay.png");
            write_rgb(&path, &overlay::draw(&background, &camera, &drawn))?;
            Some(path)
        }
    };
    let results: Vec<Found> = found
        .iter()
        .flat_map(|(object, estimates, seconds)| {
            estimates.iter().map(|e| Found {
                object: object.name.clone(),
                camera_from_object: pose_rows(&e.camera_from_object),
                confidence: e.confidence,
                verification: e.score,
                seconds: *seconds,
            })
        })
        .collect();
    let missing: Vec<String> = found.iter().filter(|f| f.1.is_empty()).map(|f| f.0.name.clone()).collect();
    let any = !results.is_empty();
    let whole = Whole { poses: results, not_found: missing, overlay };
    if let Some(folder) = &a.out {
        let text = serde_json::to_string_pretty(&whole)?;
        sixfold_shell::output::write_atomically(&folder.join("poses.json"), text.as_bytes())?;
    }
    report(&a.json, &whole, || print_table(&whole, a.out.as_deref()))?;
    Ok(if any { Outcome::Found } else { Outcome::NothingFound })
}

#[derive(Serialize)]
struct Found {
    object: String,
    camera_from_object: [[f64; 4]; 4],
    confidence: f64,
    verification: VerificationScore,
    seconds: f64,
}

#[derive(Serialize)]
struct Whole {
    poses: Vec<Found>,
    not_found: Vec<String>,
    overlay: Option<PathBuf>,
}

fn print_table(whole: &Whole, folder: Option<&Path>) {
    println!(
        "{:<24} {:>10} {:>8} {:>26} {:>8}",
        "object", "confidence", "visible", "translation (m)", "seconds"
    );
    for f in &whole.poses {
        let t: Vec<String> = f.camera_from_object[..3].iter().map(|r| format!("{:8.4}", r[3])).collect();
        println!(
            "{:<24} {:>10.3} {:>7.0}% {:>26} {:>8.2}",
            f.object,
            f.confidence,
            100.0 * f.verification.visible_share(),
            t.join(" "),
            f.seconds
        );
    }
    for name in &whole.not_found {
        println!("{name:<24} not found");
    }
    if let Some(folder) = folder {
        println!("poses.json and overlay.png are in {}", folder.display());
    }
}

/// Millimetres per unit of the depth image.
pub(super) fn depth_scale(a: &EstimateArguments, file: &CameraFile, camera_path: &Path) -> Result<f64> {
    let scale = a.depth_scale.or(file.depth_scale).ok_or_else(|| {
        anyhow!(
            "{}: field depth_scale is missing: give it there or as --depth-scale (millimetres per unit of the depth image: 1 for most cameras)",
            camera_path.display()
        )
    })?;
    if !(scale > 0.0 && scale.is_finite()) {
        bail!("--depth-scale: found {scale}, expected above 0");
    }
    Ok(scale)
}

/// The options of the scene preparation that the command line sets.
pub(super) fn scene_options(a: &EstimateArguments) -> SceneOptions {
    SceneOptions { remove_plane: !a.keep_plane, seed: a.seed, ..SceneOptions::default() }
}

/// The options of the estimation that the command line sets.
pub(super) fn estimate_options(a: &EstimateArguments, instances: usize) -> EstimateOptions {
    let default = EstimateOptions::default();
    EstimateOptions {
        max_instances: instances,
        min_score: a.min_score.unwrap_or(default.min_score),
        ..default
    }
}

/// `--box`, which has a size and shows something of the image.
pub(super) fn given_box(a: &EstimateArguments, camera: &Camera) -> Result<Option<Rect>> {
    let Some(r) = &a.region else { return Ok(None) };
    let [x, y, width, height] = r[..] else {
        bail!("--box: found {} numbers, expected x, y, width, height", r.len())
    };
    if !(width > 0.0 && height > 0.0 && r.iter().all(|v| v.is_finite())) {
        bail!("--box: found {r:?}, expected x, y, width, height with a size above 0");
    }
    let region = Rect { x, y, width, height };
    let image = Rect { x: 0.0, y: 0.0, width: camera.width as f64, height: camera.height as f64 };
    if region.intersect(&image).is_none() {
        bail!("--box: {r:?} lies outside the {}x{} image", camera.width, camera.height);
    }
    Ok(Some(region))
}

pub(super) fn region_mask(a: &EstimateArguments, camera: &Camera) -> Result<Option<Mask>> {
    let mut mask = a.mask.as_deref().map(read_mask).transpose()?;
    if let (Some(m), Some(path)) = (&mask, &a.mask) {
        camera.check_image(m.width(), m.height()).with_context(|| path.display().to_string())?;
    }
    if let Some(region) = given_box(a, camera)? {
        let boxed = box_mask(&region, camera);
        mask = Some(match mask {
            None => boxed,
            Some(m) => Mask::from_fn(m.width(), m.height(), |x, y| m[(x, y)] && boxed[(x, y)]),
        });
    }
    if let Some(m) = &mask
        && !m.as_slice().contains(&true)
    {
        let from: Vec<String> = a.mask.iter().map(|p| p.display().to_string()).collect();
        let from = from.into_iter().chain(a.region.iter().map(|_| "--box".to_owned()));
        bail!(
            "{}: the mask is empty: no pixel is left in which the object could be",
            from.collect::<Vec<_>>().join(" and ")
        );
    }
    Ok(mask)
}
