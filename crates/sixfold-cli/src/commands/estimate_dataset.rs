//! `sixfold estimate --dataset`: all targets of a BOP dataset into a result CSV, image by image, resumable.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::time::Instant;

use anyhow::{Context, Result, anyhow, bail};
use serde::{Deserialize, Serialize};
use sixfold_bop::{BopDataset, Models, ResultsAppender, Target, write_rgb};
use sixfold_geometry::Pose;
use sixfold_match::{ObjectModel, Scene, estimate};
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_pix2pose::depth::DepthScene;
use sixfold_pix2pose::estimate::EstimateError;

use super::boxes::Boxes;
use super::estimate::{estimate_options, scene_options};
use super::frames::excepted;
use super::mttm;
use super::pix2pose::Pix2Pose;
use crate::commands::estimate_arguments::{EstimateArguments, Method};
use sixfold_shell::Outcome;
use sixfold_shell::objects::{self, Object};
use sixfold_shell::output::{report, write_atomically};
use sixfold_shell::overlay::{self, Drawn};
use sixfold_shell::progress::{Progress, check_interrupt};

/// What a result file was made with; kept beside it so that a later run goes on with the same.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct RunRecord {
    version: String,
    method: String,
    weights: Option<String>,
    refine: bool,
    /// Of Pix2Pose only.
    #[serde(default)]
    looks: Option<usize>,
    #[serde(default)]
    icp: bool,
    #[serde(default)]
    templates_only: bool,
    /// Of template matching only.
    #[serde(default)]
    matcher: Option<String>,
    dataset: String,
    split: String,
    targets: Option<String>,
    #[serde(default)]
    except: Option<String>,
    boxes: Option<String>,
    #[serde(default)]
    detector: Option<String>,
    min_score: Option<f64>,
    keep_plane: bool,
    seed: u64,
    /// Images that are done, `scene/image`.
    done: BTreeSet<String>,
}

#[derive(Serialize)]
struct Summary {
    images: usize,
    targets: usize,
    poses: usize,
    skipped: Vec<String>,
    seconds_per_image: Option<f64>,
    results: String,
}

/// A model of the dataset, read and described when it is first needed.
struct Known {
    mesh: Mesh,
    /// Its point pair features, for that method.
    ppf: Option<ObjectModel>,
    /// Its templates, for that method.
    mttm: Option<sixfold_mttm::KnownObject>,
}

/// A pose of an object with its confidence.
struct Posed {
    obj_id: u32,
    camera_from_object: Pose,
    confidence: f64,
}

pub(crate) fn run(a: &EstimateArguments) -> Result<Outcome> {
    let root = a.dataset.as_deref().ok_or_else(|| anyhow!("--dataset is missing"))?;
    let out = a.out.as_deref().ok_or_else(|| anyhow!("--out FILE.csv is missing"))?;
    if out.extension().is_none_or(|e| e != "csv") {
        bail!("--out: found {}, expected a file that ends in .csv", out.display());
    }
    let dataset = BopDataset::open(root, &a.split)?;
    let mut targets = dataset.targets(a.targets.as_deref())?;
    let left_out = excepted(&dataset, a.except.as_deref())?;
    targets.retain(|t| !left_out.contains(&(t.scene_id, t.im_id)));
    let targets = dataset.object_targets(&targets)?;
    let mut skipped: Vec<String> = vec![];
    let ids: BTreeSet<u32> = targets.iter().filter_map(|t| t.object).map(|o| o.obj_id).collect();
    let boxes = match (a.boxes.as_deref(), &a.detector) {
        (Some("gt"), _) => Boxes::GroundTruth,
        (None | Some("detect"), Some(weights)) => Boxes::of_detector(weights, ids)?,
        (Some("detect"), None) => {
            bail!("--boxes detect needs --detector FILE.safetensors, which `sixfold train detector` writes")
        }
        (None, None) => Boxes::Anywhere,
        (Some(file), _) => {
            let (boxes, left_out) = Boxes::read(&dataset, Path::new(file))?;
            skipped.extend(left_out);
            boxes
        }
    };
    let mut model = None;
    let pix2pose = match a.method {
        Method::Pix2pose if matches!(boxes, Boxes::Anywhere) => {
            bail!(
                "--method pix2pose needs boxes: give --detector FILE.safetensors, --boxes gt or a file of COCO detections"
            )
        }
        Method::Pix2pose => Some(Pix2Pose::new(a.weights.as_deref(), a.seed, a.looks, a.refines())?),
        Method::Ppf if a.weights.is_some() || a.icp || a.looks.is_some() => {
            bail!(
                "--weights, --icp and --looks belong to --method pix2pose; point pair features need none of them"
            )
        }
        Method::Mttm => {
            mttm::check(a)?;
            model = mttm::network::network(a.matcher, a.weights.as_deref())?;
            None
        }
        Method::Ppf => None,
    };
    if a.templates_only && a.method != Method::Mttm {
        bail!("--templates-only belongs to --method mttm");
    }
    let mut images: BTreeMap<(u32, u32), Vec<Target>> = BTreeMap::new();
    for t in &targets {
        images.entry((t.scene_id, t.im_id)).or_default().push(*t);
    }
    let record_path = out.with_extension("csv.run.json");
    let mut record = RunRecord {
        version: env!("CARGO_PKG_VERSION").into(),
        method: a.method.name().into(),
        weights: a.weights.as_ref().map(|w| w.display().to_string()),
        refine: a.refines(),
        looks: pix2pose.as_ref().map(Pix2Pose::looks),
        icp: a.icp,
        templates_only: a.templates_only,
        matcher: (a.method == Method::Mttm).then(|| format!("{:?}", a.matcher).to_lowercase()),
        dataset: root.display().to_string(),
        split: a.split.clone(),
        targets: a.targets.as_ref().map(|t| t.display().to_string()),
        except: a.except.as_ref().map(|t| t.display().to_string()),
        boxes: a.boxes.clone(),
        detector: a.detector.as_ref().map(|w| w.display().to_string()),
        min_score: a.min_score,
        keep_plane: a.keep_plane,
        seed: a.seed,
        done: BTreeSet::new(),
    };
    if out.exists() {
        let earlier = std::fs::read_to_string(&record_path)
            .ok()
            .and_then(|t| serde_json::from_str::<RunRecord>(&t).ok());
        let Some(earlier) = earlier else {
            bail!(
                "{} exists, but {} does not say what it was made with: remove it or choose another --out",
                out.display(),
                record_path.display()
            );
        };
        if (RunRecord { done: BTreeSet::new(), ..earlier }) != record {
            bail!(
                "{} was made with other options (see {}): remove both or choose another --out",
                out.display(),
                record_path.display()
            );
        }
        let text = std::fs::read_to_string(&record_path)?;
        record.done = serde_json::from_str::<RunRecord>(&text)?.done;
    } else {
        save(&record_path, &record)?;
    }
    let mut results = ResultsAppender::open(out)?;
    if let Some(torn) = results.torn() {
        eprintln!("note: {}: the last line was cut off and is dropped: {torn}", out.display());
    }
    // Rows are written image by image: only the last image can be there in part, and is done again unless it is known to be whole.
    if let Some(last) = results.existing().last()
        && !record.done.contains(&format!("{}/{}", last.scene_id, last.im_id))
    {
        let image = (last.scene_id, last.im_id);
        drop(results);
        drop_last_image(out, image)?;
        results = ResultsAppender::open(out)?;
    }
    for e in results.existing() {
        record.done.insert(format!("{}/{}", e.scene_id, e.im_id));
    }
    let infos = dataset.models_info(Models::Rendering)?;
    let mut known: BTreeMap<u32, Known> = BTreeMap::new();
    let mut poses = results.existing().len();
    let mut seconds = vec![];
    let mut progress = Progress::new("images", images.len());
    let mut scenes = BTreeMap::new();
    for ((scene_id, im_id), targets) in &images {
        check_interrupt("run the same command again to go on")?;
        let key = format!("{scene_id}/{im_id}");
        if record.done.contains(&key) {
            progress.step(format!("{key} was done"));
            continue;
        }
        for t in targets {
            let Some(o) = t.object else { continue };
            if let std::collections::btree_map::Entry::Vacant(place) = known.entry(o.obj_id) {
                let mesh = dataset.model(o.obj_id, Models::Rendering)?;
                let info = infos.as_ref().and_then(|i| i.0.get(&o.obj_id)).cloned();
                let file = dataset
                    .models_dir(Models::Rendering)
                    .unwrap_or_else(|| root.join("models"))
                    .join(format!("obj_{:06}.ply", o.obj_id));
                let object = Object {
                    name: format!("object {}", o.obj_id),
                    info: info.unwrap_or_else(|| ModelInfo::of_mesh(&mesh)),
                    mesh,
                    description: objects::description_beside(&file),
                };
                if let Some(pix2pose) = &pix2pose {
                    pix2pose.check_mesh(o.obj_id, &object.mesh, &file.display().to_string())?;
                }
                place.insert(match a.method {
                    Method::Ppf => Known { ppf: Some(object.ppf_model()?), mesh: object.mesh, mttm: None },
                    Method::Pix2pose => Known { mesh: object.mesh, ppf: None, mttm: None },
                    Method::Mttm => {
                        let mesh = object.mesh.clone();
                        let templates = mttm::templates_beside(&file);
                        let known =
                            mttm::known_by_mesh(object, &templates, a.templates_only, model.as_ref())?;
                        Known { mesh, ppf: None, mttm: Some(known.object) }
                    }
                });
            }
        }
        let scene = match scenes.entry(*scene_id) {
            std::collections::btree_map::Entry::Occupied(known) => known.into_mut(),
            std::collections::btree_map::Entry::Vacant(place) => place.insert(dataset.scene(*scene_id)?),
        };
        let start = Instant::now();
        let found = match &pix2pose {
            Some(pix2pose) => by_pix2pose(a, pix2pose, scene, *im_id, targets, &known, &boxes),
            None => by_depth(a, scene, *im_id, targets, &known, &boxes),
        };
        match found {
            Err(error) => skipped.push(format!("image {key}: {}", sixfold_shell::describe(&error))),
            Ok(found) => {
                let time = start.elapsed().as_secs_f64();
                seconds.push(time);
                let rows: Vec<sixfold_bop::Estimate> = found
                    .iter()
                    .map(|e| {
                        let mut row = sixfold_bop::Estimate::new(
                            *scene_id,
                            *im_id,
                            e.obj_id,
                            e.confidence,
                            e.camera_from_object,
                        );
                        row.time = Some(time);
                        row
                    })
                    .collect();
                results.append(&rows)?;
                poses += rows.len();
                if let Some(folder) = &a.overlays {
                    draw(folder, scene, *scene_id, *im_id, &found, &known)?;
                }
                record.done.insert(key.clone());
                if rows.is_empty() {
                    save(&record_path, &record)?;
                }
            }
        }
        progress.step(key);
    }
    progress.finish();
    save(&record_path, &record)?;
    for s in &skipped {
        eprintln!("skipped {s}");
    }
    let mean = (!seconds.is_empty()).then(|| seconds.iter().sum::<f64>() / seconds.len() as f64);
    let any = poses > 0;
    let incomplete = !skipped.is_empty();
    let summary = Summary {
        images: images.len(),
        targets: targets.len(),
        poses,
        skipped,
        seconds_per_image: mean,
        results: out.display().to_string(),
    };
    report(&a.json, &summary, || {
        println!(
            "{} poses for {} targets in {} images: {}",
            summary.poses, summary.targets, summary.images, summary.results
        );
        if let Some(mean) = summary.seconds_per_image {
            println!("{mean:.2} s per image");
        }
    })?;
    Ok(if incomplete {
        Outcome::Incomplete
    } else if any {
        Outcome::Found
    } else {
        Outcome::NothingFound
    })
}

/// Cuts the rows of this image off the end of a result file.
fn drop_last_image(path: &Path, (scene_id, im_id): (u32, u32)) -> Result<()> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    let of_image = |line: &&str| {
        let mut columns = line.split(',').map(|c| c.trim().parse::<u32>().ok());
        columns.next().flatten() == Some(scene_id) && columns.next().flatten() == Some(im_id)
    };
    let lines: Vec<&str> = text.split_inclusive('\n').collect();
    let cut: usize = lines.iter().rev().take_while(|l| of_image(l)).map(|l| l.len()).sum();
    let file = std::fs::OpenOptions::new().write(true).open(path);
    file.and_then(|f| f.set_len((text.len() - cut) as u64))
        .with_context(|| format!("cannot write {}", path.display()))
}

fn save(path: &Path, record: &RunRecord) -> Result<()> {
    write_atomically(path, serde_json::to_string_pretty(record)?.as_bytes())
}

/// The poses of an image's targets from colour alone.
fn by_pix2pose(
    a: &EstimateArguments,
    pix2pose: &Pix2Pose,
    scene: &sixfold_bop::Scene,
    im_id: u32,
    targets: &[Target],
    known: &BTreeMap<u32, Known>,
    boxes: &Boxes,
) -> Result<Vec<Posed>> {
    let camera = scene.camera(im_id)?;
    let image = scene.rgb(im_id)?.ok_or_else(|| anyhow!("has no colour image, which Pix2Pose needs"))?;
    let depth = match (a.icp, scene.depth(im_id)?) {
        (true, Some(depth)) => Some(DepthScene::new(&depth, &camera)),
        (true, None) => bail!("has no depth image, which --icp needs"),
        (false, _) => None,
    };
    let mut found = vec![];
    for target in targets {
        let Some(o) = target.object else { continue };
        let Some(k) = known.get(&o.obj_id) else { continue };
        for region in boxes.of_target(scene, target, &o, |id| known.get(&id).map(|k| &k.mesh))? {
            let posed = match pix2pose.estimate(&image, &camera, o.obj_id, &region.bbox, Some(&k.mesh)) {
                Ok(Some(posed)) => posed,
                Ok(None) => continue,
                // One bad box costs its own target only.
                Err(error) if error.downcast_ref::<EstimateError>().is_some_and(is_of_box) => {
                    eprintln!(
                        "note: image {}/{im_id}, object {}: {}",
                        target.scene_id,
                        o.obj_id,
                        sixfold_shell::describe(&error)
                    );
                    continue;
                }
                Err(error) => return Err(error),
            };
            let confidence = posed.score * region.score;
            if confidence < a.min_score.unwrap_or(0.0) {
                continue;
            }
            let aligned = match &depth {
                Some(depth) => {
                    let seen = region.pixels_for_icp();
                    pix2pose.align(depth, o.obj_id, &k.mesh, &posed, seen.as_ref())?
                }
                None => None,
            };
            let camera_from_object = aligned.map_or(posed.camera_from_object, |i| i.camera_from_object);
            found.push(Posed { obj_id: o.obj_id, camera_from_object, confidence });
        }
    }
    Ok(found)
}

/// Whether only the box is to blame.
fn is_of_box(error: &EstimateError) -> bool {
    matches!(error, EstimateError::Box(_) | EstimateError::Outside { .. })
}

/// The poses of an image's targets by point pair features or templates.
fn by_depth(
    a: &EstimateArguments,
    scene: &sixfold_bop::Scene,
    im_id: u32,
    targets: &[Target],
    known: &BTreeMap<u32, Known>,
    boxes: &Boxes,
) -> Result<Vec<Posed>> {
    let camera = scene.camera(im_id)?;
    let depth = scene.depth(im_id)?.ok_or_else(|| {
        anyhow!(
            "has no depth image: point pair features and templates need depth (simulate it with `sixfold simulate-depth`)"
        )
    })?;
    let options = scene_options(a);
    let whole = match boxes {
        Boxes::Anywhere => Some(Scene::new(&depth, &camera, None, &options).context("depth image")?),
        _ => None,
    };
    let shared = whole.as_ref().map(sixfold_mttm::Search::new);
    let mut found = vec![];
    for target in targets {
        let Some(o) = target.object else { continue };
        let Some(k) = known.get(&o.obj_id) else { continue };
        let regions = boxes.of_target(scene, target, &o, |id| known.get(&id).map(|k| &k.mesh))?;
        let posed = |camera_from_object: Pose, confidence: f64| Posed {
            obj_id: o.obj_id,
            camera_from_object,
            confidence,
        };
        let search = |scene: &Scene, instances: usize| -> Vec<Posed> {
            if let Some(object) = &k.mttm {
                let options = mttm::options(a, instances, 0.05);
                let found = match &shared {
                    Some(shared) => shared.estimate(object, &options).0,
                    None => sixfold_mttm::estimate(scene, object, &options).0,
                };
                return found.into_iter().map(|e| posed(e.camera_from_object, e.confidence)).collect();
            }
            let found = k.ppf.iter().flat_map(|ppf| estimate(scene, ppf, &estimate_options(a, instances)));
            found.map(|e| posed(e.camera_from_object, e.confidence)).collect()
        };
        if let Some(whole) = &whole {
            found.extend(search(whole, o.inst_count));
        }
        for region in regions {
            let scene = Scene::new(&depth, &camera, Some(&region.pixels(&camera)), &options)
                .context("depth image")?;
            found.extend(search(&scene, 1));
        }
    }
    Ok(found)
}

fn draw(
    folder: &Path,
    scene: &sixfold_bop::Scene,
    scene_id: u32,
    im_id: u32,
    found: &[Posed],
    known: &BTreeMap<u32, Known>,
) -> Result<()> {
    let camera = scene.camera(im_id)?;
    let background = match (scene.rgb(im_id)?, scene.depth(im_id)?) {
        (Some(rgb), _) => rgb,
        (None, Some(depth)) => overlay::depth_picture(&depth),
        (None, None) => return Ok(()),
    };
    let drawn: Vec<Drawn<'_>> = found
        .iter()
        .filter_map(|e| {
            Some(Drawn {
                mesh: &known.get(&e.obj_id)?.mesh,
                camera_from_object: e.camera_from_object,
                color: overlay::color(e.obj_id as usize),
            })
        })
        .collect();
    let path = folder.join(format!("{scene_id:06}_{im_id:06}.png"));
    write_rgb(&path, &overlay::draw(&background, &camera, &drawn))?;
    Ok(())
}
