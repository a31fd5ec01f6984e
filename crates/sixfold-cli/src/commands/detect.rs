//! `sixfold detect`: boxes and masks of a detector's objects, in images or in all of a dataset.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, anyhow, bail};
use serde::Serialize;
use sixfold_bop::{BopDataset, Detection, Rle, write_detections};
use sixfold_detect::detect::DetectOptions;
use sixfold_detect::model::DetectorModel;
use sixfold_geometry::RgbImage;
use sixfold_io::{read_rgb, write_rgb};

use super::detect_arguments::DetectArguments;
use sixfold_shell::Outcome;
use sixfold_shell::detector::Detector;
use sixfold_shell::folder::OutputFolder;
use sixfold_shell::frames::excepted;
use sixfold_shell::output::{report, write_atomically};
use sixfold_shell::overlay;
use sixfold_shell::progress::{Progress, check_interrupt};
use sixfold_shell::ranges::without_duplicates;

#[derive(Serialize)]
struct Found {
    object_id: u32,
    score: f64,
    /// x, y, width, height in pixels.
    bbox: [f64; 4],
    mask_pixels: Option<u64>,
}

impl Found {
    /// `None` for a detection without a box, which a detector does not give.
    fn new(d: &Detection) -> Option<Found> {
        let b = d.bbox?;
        Some(Found {
            object_id: d.category_id,
            score: d.score,
            bbox: [b.x, b.y, b.width, b.height],
            mask_pixels: d.segmentation.as_ref().map(Rle::area),
        })
    }
}

#[derive(Serialize)]
struct Many {
    images: Vec<OneOfMany>,
    detections: usize,
    detections_per_image: Option<f64>,
    skipped: Vec<String>,
}

#[derive(Serialize)]
struct OneOfMany {
    /// Its place, from 1.
    image: u32,
    file: PathBuf,
    detections: Vec<Found>,
    seconds: f64,
}

#[derive(Serialize)]
struct Whole {
    detections: Vec<Found>,
    seconds: f64,
    file: Option<PathBuf>,
    overlay: Option<PathBuf>,
}

#[derive(Serialize)]
struct Summary {
    images: usize,
    detections: usize,
    skipped: Vec<String>,
    seconds_per_image: Option<f64>,
    file: PathBuf,
}

pub(crate) fn run(a: &DetectArguments) -> Result<Outcome> {
    without_duplicates("--ids", &a.ids)?;
    let model = DetectorModel::load(&a.weights)?;
    for id in &a.ids {
        model.check_object(*id).with_context(|| "--ids".to_string())?;
    }
    let default = match a.dataset {
        Some(_) => DetectOptions::for_scores().threshold,
        None => model.usage().threshold,
    };
    let options = DetectOptions {
        threshold: a.threshold.unwrap_or(default),
        overlap: a.overlap,
        per_class: a.per_object,
        most: a.most,
        masks: !a.no_masks,
    };
    options.check().map_err(|message| anyhow!(message))?;
    let detector = Detector::new(model, options);
    match (&a.dataset, &a.rgb[..]) {
        (Some(root), _) => in_dataset(a, &detector, root),
        (None, [file]) => in_image(a, &detector, file),
        (None, []) => bail!("give --rgb FILE or --dataset DIR"),
        (None, files) => in_images(a, &detector, files),
    }
}

/// Whether an object was asked for.
fn wanted(a: &DetectArguments, id: u32) -> bool {
    a.ids.is_empty() || a.ids.contains(&id)
}

fn in_image(a: &DetectArguments, detector: &Detector, file: &Path) -> Result<Outcome> {
    let mut folder = a.out.as_deref().map(OutputFolder::take).transpose()?;
    let paths =
        folder.as_mut().map(|f| f.files(&["overlay.png", "detections.json", "result.json"])).transpose()?;
    let image = read_rgb(file)?;
    let start = Instant::now();
    let mut found = detector.detections(&image, 0, 0).with_context(|| file.display().to_string())?;
    let seconds = start.elapsed().as_secs_f64();
    found.retain(|d| wanted(a, d.category_id));
    let (mut overlay, mut json) = (None, None);
    if let Some(paths) = &paths {
        write_rgb(&paths[0], &picture(&image, &found))?;
        overlay = Some(paths[0].clone());
        write_detections(&paths[1], &found)?;
        json = Some(paths[1].clone());
    }
    let detections = found.iter().filter_map(Found::new).collect();
    let whole = Whole { detections, seconds, file: json, overlay };
    if let Some(paths) = &paths {
        write_atomically(&paths[2], serde_json::to_string_pretty(&whole)?.as_bytes())?;
    }
    report(&a.json, &whole, || {
        println!("{:>8} {:>8} {:>32} {:>10}", "object", "score", "box: x, y, width, height", "mask");
        for d in &whole.detections {
            let numbers: Vec<String> = d.bbox.iter().map(|v| format!("{v:.1}")).collect();
            let mask = d.mask_pixels.map_or("-".to_string(), |m| format!("{m} px"));
            println!("{:>8} {:>8.3} {:>32} {mask:>10}", d.object_id, d.score, numbers.join(", "));
        }
        if whole.detections.is_empty() {
            println!("nothing found");
        }
        println!("{:.0} ms", 1000.0 * whole.seconds);
        if let Some(folder) = &a.out {
            println!("detections.json and overlay.png are in {}", folder.display());
        }
    })?;
    Ok(if whole.detections.is_empty() { Outcome::NothingFound } else { Outcome::Found })
}

/// Several images that belong to no dataset; in `detections.json` their ids are their places, from 1.
fn in_images(a: &DetectArguments, detector: &Detector, files: &[PathBuf]) -> Result<Outcome> {
    let mut folder = a.out.as_deref().map(OutputFolder::take).transpose()?;
    let file = folder.as_mut().map(|f| f.file("detections.json")).transpose()?;
    let mut progress = Progress::new("images", files.len());
    let (mut images, mut all, mut skipped) = (vec![], vec![], vec![]);
    for (number, file) in (1..).zip(files) {
        check_interrupt("nothing was written")?;
        let found = read_rgb(file).map_err(anyhow::Error::from).and_then(|image| {
            let start = Instant::now();
            let mut found = detector.detections(&image, 0, number)?;
            let seconds = start.elapsed().as_secs_f64();
            found.retain(|d| wanted(a, d.category_id));
            if let Some(folder) = &mut folder {
                let stem = file.file_stem().unwrap_or_default().to_string_lossy();
                folder.write_rgb(&format!("overlays/{number:06}_{stem}.png"), &picture(&image, &found))?;
            }
            Ok((found, seconds))
        });
        match found {
            Ok((found, seconds)) => {
                let detections = found.iter().filter_map(Found::new).collect();
                images.push(OneOfMany { image: number, file: file.clone(), detections, seconds });
                all.extend(found);
            }
            Err(error) => skipped.push(format!("{}: {}", file.display(), sixfold_shell::describe(&error))),
        }
        progress.step(file.display().to_string());
    }
    progress.finish();
    for s in &skipped {
        eprintln!("skipped {s}");
    }
    if let Some(file) = &file {
        write_detections(file, &all)?;
    }
    let per_image = (!images.is_empty()).then(|| all.len() as f64 / images.len() as f64);
    let many = Many { images, detections: all.len(), detections_per_image: per_image, skipped };
    report(&a.json, &many, || {
        println!("{:>8} {:>8} {:>10}  file", "image", "objects", "best score");
        for i in &many.images {
            let best = i.detections.first().map_or("-".to_string(), |d| format!("{:.3}", d.score));
            println!("{:>8} {:>8} {best:>10}  {}", i.image, i.detections.len(), i.file.display());
        }
        println!("{} detections in {} images", many.detections, many.images.len());
        if let Some(folder) = &a.out {
            println!("detections.json and overlays are in {}", folder.display());
        }
    })?;
    Ok(if !many.skipped.is_empty() {
        Outcome::Incomplete
    } else if many.detections == 0 {
        Outcome::NothingFound
    } else {
        Outcome::Found
    })
}

fn in_dataset(a: &DetectArguments, detector: &Detector, root: &Path) -> Result<Outcome> {
    let out = a.out.as_deref().ok_or_else(|| anyhow!("--out FILE.json is missing"))?;
    if out.extension().is_none_or(|e| e != "json") {
        bail!("--out: found {}, expected a file that ends in .json", out.display());
    }
    let dataset = BopDataset::open(root, &a.split)?;
    let images = images(a, &dataset)?;
    let mut folder = a.overlays.as_deref().map(OutputFolder::take).transpose()?;
    let mut progress = Progress::new("images", images.len());
    let (mut all, mut skipped, mut seconds) = (vec![], vec![], vec![]);
    let mut scene = None;
    for (scene_id, im_id) in &images {
        check_interrupt("nothing was written")?;
        if scene.as_ref().is_none_or(|(id, _)| id != scene_id) {
            scene = Some((*scene_id, dataset.scene(*scene_id)?));
        }
        let Some((_, scene)) = &scene else { continue };
        let found = scene.rgb(*im_id).map_err(anyhow::Error::from).and_then(|image| {
            let image = image.ok_or_else(|| anyhow!("there is no colour image"))?;
            let start = Instant::now();
            let mut found = detector.detections(&image, *scene_id, *im_id)?;
            let time = start.elapsed().as_secs_f64();
            found.retain(|d| wanted(a, d.category_id));
            if let Some(folder) = &mut folder {
                let sure = detector.model().usage().threshold;
                let shown: Vec<Detection> =
                    found.iter().filter(|d| d.score >= f64::from(sure)).cloned().collect();
                folder.write_rgb(&format!("{scene_id:06}_{im_id:06}.png"), &picture(&image, &shown))?;
            }
            Ok((found, time))
        });
        match found {
            Ok((found, time)) => {
                all.extend(found);
                seconds.push(time);
            }
            Err(error) => {
                skipped.push(format!("image {scene_id}/{im_id}: {}", sixfold_shell::describe(&error)))
            }
        }
        progress.step(format!("{scene_id}/{im_id}"));
    }
    progress.finish();
    for s in &skipped {
        eprintln!("skipped {s}");
    }
    write_detections(out, &all)?;
    let summary = Summary {
        images: images.len(),
        detections: all.len(),
        skipped,
        seconds_per_image: (!seconds.is_empty()).then(|| seconds.iter().sum::<f64>() / seconds.len() as f64),
        file: out.to_owned(),
    };
    report(&a.json, &summary, || {
        println!("{} detections in {} images: {}", summary.detections, summary.images, out.display());
        if let Some(seconds) = summary.seconds_per_image {
            println!("{:.0} ms per image", 1000.0 * seconds);
        }
    })?;
    Ok(if !summary.skipped.is_empty() {
        Outcome::Incomplete
    } else if summary.detections == 0 {
        Outcome::NothingFound
    } else {
        Outcome::Found
    })
}

/// The images of the targets, or all of a dataset without targets, but those of `--except`.
fn images(a: &DetectArguments, dataset: &BopDataset) -> Result<Vec<(u32, u32)>> {
    let mut images: BTreeSet<(u32, u32)> = BTreeSet::new();
    if a.targets.is_some() || dataset.root().join("test_targets_bop19.json").is_file() {
        let targets = dataset.targets(a.targets.as_deref())?;
        images.extend(targets.iter().map(|t| (t.scene_id, t.im_id)));
    } else {
        for scene_id in dataset.scene_ids() {
            images.extend(dataset.scene(scene_id)?.image_ids().into_iter().map(|im_id| (scene_id, im_id)));
        }
    }
    for image in excepted(dataset, a.except.as_deref())? {
        images.remove(&image);
    }
    Ok(images.into_iter().collect())
}

/// Boxes and tinted masks over the image, the best on top.
fn picture(image: &RgbImage, found: &[Detection]) -> RgbImage {
    let mut out = image.clone();
    for d in found.iter().rev() {
        let color = overlay::color(d.category_id as usize);
        if let Some(mask) = d.segmentation.as_ref().map(Rle::decode) {
            for (pixel, inside) in out.as_mut_slice().iter_mut().zip(mask.as_slice()) {
                if *inside {
                    for (channel, tint) in pixel.iter_mut().zip(color) {
                        *channel = ((u16::from(*channel) + u16::from(tint)) / 2) as u8;
                    }
                }
            }
        }
        if let Some(b) = d.bbox {
            overlay::rectangle(&mut out, [b.x, b.y, b.x + b.width, b.y + b.height], color);
        }
    }
    for d in found.iter().rev() {
        if let Some(b) = d.bbox {
            let text = format!("{} {:.2}", d.category_id, d.score);
            overlay::label(&mut out, [b.x, b.y], &text, overlay::color(d.category_id as usize));
        }
    }
    out
}
