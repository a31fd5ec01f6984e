//! Search of single images by a detector, and its output: first the detections, then the images.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result};
use serde::Serialize;
use sixfold_bop::{Detection, write_detections};
use sixfold_estimator::ObjectDetector;
use sixfold_geometry::RgbImage;
use sixfold_io::read_rgb;
use sixfold_runner::{FoundDetection, detections};

use crate::Outcome;
use crate::folder::OutputFolder;
use crate::output::{JsonArguments, report, write_atomically};
use crate::overlay::detections_over;
use crate::pictures::Pictures;
use crate::progress::Progress;

#[derive(Serialize)]
struct Many {
    images: Vec<OneOfMany>,
    detections: usize,
    detections_per_image: Option<f64>,
    skipped: Vec<String>,
}

#[derive(Serialize)]
struct OneOfMany {
    /// Its index, from 1.
    image: u32,
    file: PathBuf,
    detections: Vec<FoundDetection>,
    seconds: f64,
}

#[derive(Serialize)]
struct Whole {
    detections: Vec<FoundDetection>,
    seconds: f64,
    file: Option<PathBuf>,
    overlay: Option<PathBuf>,
}

/// The outcome for a number of detections.
pub fn outcome(detections: usize, skipped: &[String]) -> Outcome {
    match (skipped.is_empty(), detections) {
        (false, _) => Outcome::Incomplete,
        (true, 0) => Outcome::NothingFound,
        (true, _) => Outcome::Found,
    }
}

/// A detector, and where its detections in single images go.
pub struct ImageSearch<'a> {
    /// The detector.
    pub detector: &'a dyn ObjectDetector,
    /// Names of the objects that have one.
    pub names: &'a BTreeMap<u32, String>,
    /// Only detections of these objects are kept; all if empty.
    pub ids: &'a [u32],
    /// The folder for detections and overlays.
    pub out: Option<&'a Path>,
    /// Whether the result is printed as JSON.
    pub json: &'a JsonArguments,
}

impl ImageSearch<'_> {
    /// Reads and searches an image; returns it, its detections under the number `image`, and the seconds it took.
    fn search(&self, file: &Path, image: u32) -> Result<(RgbImage, Vec<Detection>, f64)> {
        let rgb = read_rgb(file)?;
        let start = Instant::now();
        let found = detections(self.detector, &rgb, self.ids, (0, image))
            .with_context(|| file.display().to_string())?;
        Ok((rgb, found, start.elapsed().as_secs_f64()))
    }

    /// Searches one image. Writes detections and overlay into the folder and prints a table.
    ///
    /// # Errors
    /// When the image cannot be read or searched, or the detections cannot be written.
    pub fn one(&self, file: &Path) -> Result<Outcome> {
        let mut folder = self.out.map(OutputFolder::take).transpose()?;
        let names = ["detections.json", "overlay.png", "result.json"];
        let paths = folder.as_mut().map(|f| f.files(&names)).transpose()?;
        let (image, found, seconds) = self.search(file, 0)?;
        let whole = Whole {
            detections: found.iter().filter_map(|d| FoundDetection::new(d, self.names)).collect(),
            seconds,
            file: paths.as_ref().map(|p| p[0].clone()),
            overlay: paths.as_ref().map(|p| p[1].clone()),
        };
        if let Some(paths) = &paths {
            write_detections(&paths[0], &found)?;
            write_atomically(&paths[2], serde_json::to_string_pretty(&whole)?.as_bytes())?;
        }
        report(self.json, &whole, || {
            println!("{:>8} {:>8} {:>32} {:>10}", "object", "score", "box: x, y, width, height", "mask");
            for d in &whole.detections {
                let numbers: Vec<String> = d.bbox.iter().map(|v| format!("{v:.1}")).collect();
                let mask = d.mask_pixels.map_or("-".to_string(), |m| format!("{m} px"));
                let object = d.object.clone().unwrap_or_else(|| d.object_id.to_string());
                println!("{object:>8} {:>8.3} {:>32} {mask:>10}", d.score, numbers.join(", "));
            }
            if whole.detections.is_empty() {
                println!("nothing found");
            }
            println!("{:.0} ms", 1000.0 * whole.seconds);
            if let Some(folder) = self.out {
                println!("detections.json and overlay.png are in {}", folder.display());
            }
        })?;
        let mut pictures = Pictures::of(folder);
        if whole.overlay.is_some() {
            pictures.write("overlay.png", &detections_over(&image, &found, self.names));
        }
        Ok(pictures.outcome(outcome(whole.detections.len(), &[])))
    }

    /// Searches several images; in `detections.json` their ids are their indices, from 1. Those that cannot be searched are reported.
    ///
    /// # Errors
    /// When the detections cannot be written.
    pub fn many(&self, files: &[PathBuf]) -> Result<Outcome> {
        let mut folder = self.out.map(OutputFolder::take).transpose()?;
        let file = folder.as_mut().map(|f| f.file("detections.json")).transpose()?;
        let mut pictures = Pictures::of(folder);
        let mut progress = Progress::new("images", files.len());
        let (mut images, mut all, mut skipped) = (vec![], vec![], vec![]);
        for (number, file) in (1..).zip(files) {
            match self.search(file, number) {
                Ok((image, found, seconds)) => {
                    if self.out.is_some() {
                        let stem = file.file_stem().unwrap_or_default().to_string_lossy();
                        let name = format!("overlays/{number:06}_{stem}.png");
                        pictures.write(&name, &detections_over(&image, &found, self.names));
                    }
                    let detections =
                        found.iter().filter_map(|d| FoundDetection::new(d, self.names)).collect();
                    images.push(OneOfMany { image: number, file: file.clone(), detections, seconds });
                    all.extend(found);
                }
                Err(error) => skipped.push(format!("{}: {}", file.display(), crate::describe(&error))),
            }
            progress.step(file.display().to_string());
        }
        progress.finish();
        skipped.append(&mut pictures.take_failed());
        for s in &skipped {
            eprintln!("skipped {s}");
        }
        if let Some(file) = &file {
            write_detections(file, &all)?;
        }
        let per_image = (!images.is_empty()).then(|| all.len() as f64 / images.len() as f64);
        let many = Many { images, detections: all.len(), detections_per_image: per_image, skipped };
        report(self.json, &many, || {
            println!("{:>8} {:>8} {:>10}  file", "image", "objects", "best score");
            for i in &many.images {
                let best = i.detections.first().map_or("-".to_string(), |d| format!("{:.3}", d.score));
                println!("{:>8} {:>8} {best:>10}  {}", i.image, i.detections.len(), i.file.display());
            }
            println!("{} detections in {} images", many.detections, many.images.len());
            if let Some(folder) = self.out {
                println!("detections.json and overlays are in {}", folder.display());
            }
        })?;
        Ok(outcome(many.detections, &many.skipped))
    }
}
