//! `sixfold detect`: boxes and masks of a detector's objects, in single images (written at the end) or in all images of a
//! dataset (resumable).

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, anyhow, bail};
use sixfold_bop::{BopDataset, Detection, Models};
use sixfold_detect::detect::DetectOptions;
use sixfold_detect::detector::TrainedDetector;
use sixfold_detect::torchvision::existing_objects_file;
use sixfold_estimator::ObjectDetector;
use sixfold_io::read_rgb;
use sixfold_runner::{DetectionEvent, DetectionRun, RunOptions};
use sixfold_shell::Outcome;
use sixfold_shell::detected::{ImageSearch, outcome};
use sixfold_shell::detectors::NumberedObjects;
use sixfold_shell::folder::OutputFolder;
use sixfold_shell::frames::excepted;
use sixfold_shell::output::report;
use sixfold_shell::overlay::detections_over;
use sixfold_shell::pictures::Pictures;
use sixfold_shell::progress::{Progress, interrupted};
use sixfold_shell::ranges::without_duplicates;
use sixfold_views::detector::ViewsDetectOptions;

use super::detect_arguments::{DetectArguments, DetectMethod};

/// A detector with what is said about its objects.
struct Chosen {
    detector: Box<dyn ObjectDetector>,
    /// Names of the objects that have one.
    names: BTreeMap<u32, String>,
    /// Detections with a lower score are not drawn over a dataset's images.
    sure: f64,
}

pub(crate) fn run(a: &DetectArguments) -> Result<Outcome> {
    without_duplicates("--ids", &a.ids)?;
    // The weights are hashed before they are read, so that a change in between is noticed.
    let mut of_run = run_options(a);
    let dataset = a.dataset.as_deref().map(|root| opened(a, root)).transpose()?;
    let chosen = match a.method {
        DetectMethod::Network => by_network(a)?,
        DetectMethod::Views => by_views(a, dataset.as_ref().map(|(dataset, _)| dataset), &mut of_run)?,
    };
    match (&dataset, &a.rgb[..]) {
        (Some((dataset, out)), _) => in_dataset(a, &chosen, (dataset, out), &of_run),
        (None, []) => bail!("give --rgb FILE or --dataset DIR"),
        (None, files) => {
            let detector = chosen.detector.as_ref();
            let search = ImageSearch {
                detector,
                names: &chosen.names,
                ids: &a.ids,
                out: a.out.as_deref(),
                json: &a.json,
            };
            match files {
                [file] => search.one(file),
                files => search.many(files),
            }
        }
    }
}

/// The dataset and the file for its detections, both checked before anything is computed.
fn opened<'a>(a: &'a DetectArguments, root: &Path) -> Result<(BopDataset, &'a Path)> {
    let out = a.out.as_deref().ok_or_else(|| anyhow!("--out FILE.json is missing"))?;
    if out.extension().is_none_or(|e| e != "json") {
        bail!("--out: found {}, expected a file that ends in .json", out.display());
    }
    Ok((BopDataset::open(root, &a.split)?, out))
}

/// A trained detector, or that of any object.
fn by_network(a: &DetectArguments) -> Result<Chosen> {
    for (option, given) in [("--object", !a.objects.is_empty()), ("--quick", a.quick)] {
        if given {
            bail!("{option} is no option of --method network, but of --method views");
        }
    }
    let detector = match &a.weights {
        Some(weights) => TrainedDetector::load(weights)?,
        None => TrainedDetector::proposals().context("the detector within the program")?,
    };
    for id in &a.ids {
        detector.model().check_object(*id).with_context(|| "--ids".to_string())?;
    }
    let own = detector.options();
    let default = match a.dataset {
        Some(_) => DetectOptions::for_scores().threshold,
        None => own.threshold,
    };
    let options = DetectOptions {
        threshold: a.threshold.unwrap_or(default),
        overlap: a.overlap.unwrap_or(own.overlap),
        per_class: a.per_object.unwrap_or(own.per_class),
        max_detections: a.max_detections.unwrap_or(own.max_detections),
        scales: a.scales.unwrap_or(own.scales),
        voting: own.voting,
        masks: !a.no_masks,
    };
    options.check().map_err(|message| anyhow!(message))?;
    let sure = f64::from(detector.model().usage().threshold);
    let detector = Box::new(detector.with_options(options));
    Ok(Chosen { detector, names: BTreeMap::new(), sure })
}

/// The detector of objects by their views.
fn by_views(a: &DetectArguments, dataset: Option<&BopDataset>, of_run: &mut RunOptions) -> Result<Chosen> {
    for (option, given) in [("--weights", a.weights.is_some()), ("--scales", a.scales.is_some())] {
        if given {
            bail!("{option} is no option of --method views, but of --method network");
        }
    }
    let own = ViewsDetectOptions::default();
    let options = ViewsDetectOptions {
        threshold: a.threshold.map_or(if dataset.is_some() { 0.0 } else { own.threshold }, f64::from),
        overlap: a.overlap.map_or(own.overlap, f64::from),
        per_object: a.per_object.unwrap_or(own.per_object),
        max_detections: a.max_detections.unwrap_or(own.max_detections),
        poses: !a.quick,
        masks: !a.no_masks,
    };
    options.check()?;
    // Rendering takes time, so a file that is not there is reported before.
    if let [file] = &a.rgb[..] {
        read_rgb(file)?;
    }
    let cache = a.cache.cache();
    let (objects, names) = match dataset {
        Some(dataset) => {
            let ids = NumberedObjects::ids_in(dataset, &a.ids)?;
            // A run resumes only with the same models; they are hashed before they are read, as weights are.
            for id in &ids {
                let file = dataset.model_path(*id, Models::Rendering);
                of_run.add(&format!("object {id}"), &file.to_string_lossy());
            }
            (NumberedObjects::of_dataset(dataset, &ids, &cache)?, BTreeMap::new())
        }
        None if a.objects.is_empty() => {
            bail!("--method views needs --object NAME_OR_MESH ...: what is to be detected?")
        }
        None => {
            let objects = NumberedObjects::of_names(&a.objects, a.unit, &a.store.store(), &cache)?;
            let names = objects.names();
            if let Some(id) = a.ids.iter().find(|id| !names.contains_key(id)) {
                bail!("--ids: found {id}, expected 1 to {}, the numbers of --object", names.len());
            }
            (objects, names)
        }
    };
    let mut detector = objects.detector(options)?;
    if let ([_], None) = (&a.rgb[..], dataset) {
        detector.searched = Some(objects.progress());
    }
    Ok(Chosen { detector: Box::new(detector), names, sure: own.threshold })
}

/// The options on which the detections of an image depend. The choice of images is not among them.
fn run_options(a: &DetectArguments) -> RunOptions {
    // All fields are listed, so that a new one has to be considered.
    let DetectArguments {
        method,
        quick,
        weights,
        dataset,
        split,
        ids,
        threshold,
        overlap,
        per_object,
        max_detections,
        scales,
        no_masks,
        objects: _,
        unit: _,
        store: _,
        cache: _,
        rgb: _,
        targets: _,
        except: _,
        out: _,
        overlays: _,
        json: _,
    } = a;
    let mut options = RunOptions::default();
    options.add("method", &format!("{method:?}"));
    options.add("quick", &quick.to_string());
    let weights = weights.as_deref();
    options.add("weights", &weights.map_or("any object".into(), Path::to_string_lossy));
    if let Some(file) = weights.and_then(existing_objects_file) {
        options.add("objects of the weights", &file.to_string_lossy());
    }
    options.add("dataset", &dataset.as_deref().map_or_else(String::new, |d| d.to_string_lossy().into()));
    options.add("split", split);
    options.add("ids", &format!("{ids:?}"));
    options.add("threshold", &format!("{threshold:?}"));
    options.add("overlap", &format!("{overlap:?}"));
    options.add("per-object", &format!("{per_object:?}"));
    options.add("max_detections", &format!("{max_detections:?}"));
    options.add("scales", &format!("{scales:?}"));
    options.add("no-masks", &no_masks.to_string());
    options
}

fn in_dataset(
    a: &DetectArguments,
    chosen: &Chosen,
    (dataset, out): (&BopDataset, &Path),
    options: &RunOptions,
) -> Result<Outcome> {
    // The images of the targets, or all images of a dataset without targets, except those of `--except`.
    let mut images = dataset.images(a.targets.as_deref().or(dataset.targets_file().as_deref()))?;
    for image in excepted(dataset, a.except.as_deref())? {
        images.remove(&image);
    }
    let images: Vec<(u32, u32)> = images.into_iter().collect();
    let mut progress = Progress::new("images", images.len());
    let mut pictures = Pictures::of(a.overlays.as_deref().map(OutputFolder::take).transpose()?);
    let detector = chosen.detector.as_ref();
    let run = DetectionRun { detector, dataset, images: &images, ids: &a.ids, options };
    let summary = run.run(out, interrupted(), &mut |event| match event {
        DetectionEvent::Image { image, earlier: true } => progress.step(format!("{image} was done")),
        DetectionEvent::Image { image, earlier: false } => progress.step(image),
        DetectionEvent::Found { scene, im_id, image, detections } => {
            if a.overlays.is_some() {
                let shown: Vec<Detection> =
                    detections.iter().filter(|d| d.score >= chosen.sure).cloned().collect();
                let name = format!("{:06}_{im_id:06}.png", scene.scene_id);
                pictures.write(&name, &detections_over(image, &shown, &chosen.names));
            }
        }
    });
    progress.finish();
    let mut summary = summary?;
    summary.skipped.append(&mut pictures.take_failed());
    for s in &summary.skipped {
        eprintln!("skipped {s}");
    }
    report(&a.json, &summary, || {
        println!("{} detections in {} images: {}", summary.detections, summary.images, out.display());
        if let Some(seconds) = summary.seconds_per_image {
            println!("{:.0} ms per image", 1000.0 * seconds);
        }
    })?;
    Ok(outcome(summary.detections, &summary.skipped))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arguments::{Arguments, Command};
    use clap::Parser;

    #[test]
    fn the_objects_of_torchvisions_labels_decide_about_a_run() {
        let folder = tempfile::tempdir().unwrap();
        let weights = folder.path().join("mask.pth");
        let of = || {
            let words = ["sixfold", "detect", "--rgb", "a.png", "--weights", &weights.to_string_lossy()];
            match Arguments::try_parse_from(words).unwrap().command {
                Command::Detect(a) => run_options(&a),
                _ => panic!("no detection"),
            }
        };
        let without = of();
        let write = |text: &str| std::fs::write(folder.path().join("mask.objects.json"), text).unwrap();
        write("{}");
        let with = of();
        write(r#"{"objects": {"1": 2}}"#);
        assert!(without != with && with != of());
        std::fs::write(&weights, b"").unwrap();
        let parsed =
            Arguments::try_parse_from(["sixfold", "estimate", "--detector", &weights.to_string_lossy()]);
        let Command::Estimate(a) = parsed.unwrap().command else { panic!("no estimate") };
        let before = a.run_options();
        write(r#"{"objects": {"1": 3}}"#);
        assert!(a.run_options() != before);
    }
}
