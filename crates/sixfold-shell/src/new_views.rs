//! New views of objects as a training set in a dataset folder (Neural Object Learning; K. Park, dissertation, chapter 4): the run of
//! `sixfold synthesize`, and the first part of `sixfold teach --train`.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use anyhow::{Context, Result, anyhow, bail};
use serde::Serialize;
use sixfold_bop::write_camera;
use sixfold_data::{RoughImages, RoughObject};
use sixfold_geometry::stats::upper_median;
use sixfold_nol::agreement::leave_out_what_differs;
use sixfold_nol::pose_file::PoseFile;
use sixfold_nol::refine::PoseRefinementOptions;
use sixfold_nol::select::{choose_images, choose_images_by_pose};
use sixfold_nol::synthesis::{ViewMaker, Weighting};
use sixfold_nol::view_grid::ViewGrid;
use sixfold_nol::{SourceView, ViewSplit, WrittenViews};
use sixfold_synth::augment::{Backgrounds, PhotographOptions};

use crate::folder::{Contents, DatasetFolder};
use crate::pictures::Pictures;
use crate::progress::Watch;
use crate::sheets::write_sheet;

/// Side of the crops that provide the colours of new views, pixels.
const CROP: usize = 256;

/// How photographs are chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChosenBy {
    /// Those that add the most surface.
    Surface,
    /// By the distance of their poses, with this seed.
    Pose(u64),
}

/// How poses are refined.
#[derive(Debug, Clone)]
pub enum Refinement {
    /// They are used as given.
    Given,
    /// All photographs together, on points of the surface.
    Ours(PoseRefinementOptions),
    /// Each photograph against a rendering from the others (equation 4.3).
    Published,
}

/// How new views are made.
pub struct NewViews<'a> {
    /// Name of the split.
    pub split: &'a str,
    /// How photographs are chosen.
    pub chosen_by: ChosenBy,
    /// Maximum number of photographs of an object.
    pub sources: usize,
    /// Number of photographs used for each view.
    pub per_view: usize,
    /// How the colours of several photographs are combined.
    pub weighting: Weighting<'a>,
    /// How poses are refined.
    pub refinement: Refinement,
    /// Whether the poses were disturbed.
    pub disturbed: bool,
    /// The viewpoints.
    pub grid: ViewGrid,
    /// Folder of photographs for backgrounds; procedural textures if `None`.
    pub backgrounds: Option<&'a Path>,
    /// Also add the photographs, cropped to the object.
    pub with_photographs: bool,
    /// Whether pixels of a photograph that contradict the others are left out.
    pub compare_photographs: bool,
}

/// What was made.
#[derive(Serialize)]
pub struct ViewsSummary {
    /// Folder of the dataset.
    pub out: String,
    /// Its split.
    pub split: String,
    /// By object.
    pub objects: Vec<ObjectViews>,
    /// Whether the poses were refined.
    pub refined: bool,
    /// Whether the objects stood still in all photographs.
    pub still: bool,
    /// Number of places at which objects stood.
    pub places: usize,
    /// Disagreement of the given poses with one arrangement, in units of the disagreement that their roughness explains.
    pub disagreement: Option<f64>,
    /// Time in seconds.
    pub seconds: f64,
}

/// The views of one object.
#[derive(Serialize)]
pub struct ObjectViews {
    /// Its id.
    pub id: u32,
    /// Number of photographs that were used.
    pub photographs: usize,
    /// Number of chosen photographs that could not be used.
    pub dropped: usize,
    /// Number of images, photographs included.
    pub images: usize,
    /// Fraction of the visible parts that was left out because other photographs show another colour there.
    pub pixels_differing: f64,
    /// Fraction of the surface that no photograph shows.
    pub surface_unseen: f64,
    /// Fraction of the object's pixels in all views that no photograph shows; they are filled from their surroundings.
    pub pixels_unseen: f64,
    /// Median distance by which the refinement moved the object, millimetres.
    pub median_moved_mm: f64,
    /// Median angle by which it rotated the object, degrees.
    pub median_rotated_degrees: f64,
}

/// Adds meshes, photographs, poses and masks to the hashes of a dataset's inputs.
pub fn add_contents(contents: &mut Contents, images: &RoughImages) {
    let mut known = BTreeSet::new();
    for object in &images.objects {
        contents.add_object(&format!("object {}", object.id), &object.mesh, &object.info);
        for image in &object.images {
            let posed = &image.posed;
            let hash = contents.of("photographs");
            if known.insert(image.number) {
                hash.write(posed.image().as_slice().as_flattened());
            }
            let pose = posed.camera_from_object().to_matrix();
            pose.iter().for_each(|x| hash.write(&x.to_le_bytes()));
            hash.write(format!("{} {:?} {:?}", posed.name(), posed.camera(), posed.mask()).as_bytes());
        }
    }
}

/// Counts the views of all objects.
struct Views<'a> {
    watch: &'a dyn Watch,
    done: AtomicUsize,
    all: usize,
}

impl Views<'_> {
    /// One more view of an object is done; whether to go on.
    fn next(&self, object: u32) -> bool {
        let done = self.done.fetch_add(1, Ordering::Relaxed) + 1;
        self.watch.report("views", done, self.all, format!("object {object}"));
        !self.watch.stop().load(Ordering::Relaxed)
    }
}

impl NewViews<'_> {
    /// Makes the views of all objects in `folder`, or those that are not there yet. Images for people that could not be written are
    /// in the second value.
    ///
    /// # Errors
    /// For photographs that cannot be used, a folder that cannot be written, and when `watch` stops it.
    pub fn make(
        &self,
        folder: &DatasetFolder,
        mut images: RoughImages,
        watch: &dyn Watch,
    ) -> Result<(ViewsSummary, Pictures)> {
        let start = Instant::now();
        for object in &mut images.objects {
            match self.chosen_by {
                ChosenBy::Surface => {
                    for note in choose_images(object, self.sources)? {
                        watch.note(&format!("note: {note}"));
                    }
                }
                ChosenBy::Pose(seed) => choose_images_by_pose(object, self.sources, seed),
            }
        }
        let counts: Vec<usize> = images.objects.iter().map(|o| o.images.len()).collect();
        let mut sheets = Pictures::default();
        let poses = self.refined_poses(folder.path(), &mut images, &mut sheets, watch)?;
        folder.write_models(images.objects.iter().map(|o| (o.id, &o.mesh, &o.info)))?;
        let backgrounds = match self.backgrounds {
            Some(folder) => Backgrounds::from_folder(folder, &PhotographOptions::default())?,
            None => Backgrounds::procedural(),
        };
        let split = ViewSplit {
            dataset: folder.path(),
            split: self.split,
            grid: self.grid,
            backgrounds: &backgrounds,
            with_photographs: self.with_photographs,
        };
        let progress =
            Views { watch, done: AtomicUsize::new(0), all: self.grid.count() * images.objects.len() };
        let (mut rows, mut objects, mut first_camera) = (vec![], vec![], None);
        for (object, count) in images.objects.iter().zip(&counts) {
            if object.images.is_empty() {
                watch.note(&format!(
                    "note: object {}: none of its photographs can be used; left out",
                    object.id
                ));
                continue;
            }
            let (summary, written) = self.of_object(&split, object, *count, &poses, &progress)?;
            objects.push(summary);
            rows.push(written.preview);
            first_camera = first_camera.or(written.camera);
        }
        sheets.did(write_sheet(&folder.path().join("preview.png"), &rows));
        // BOP has one such file per dataset, for tools that need any camera: it holds that of the first image. Each image's own
        // intrinsics are in scene_camera.json.
        if let Some(camera) = first_camera {
            write_camera(folder.path(), &camera, 1e-3)?;
        }
        let summary = ViewsSummary {
            out: folder.path().display().to_string(),
            split: self.split.to_owned(),
            objects,
            refined: poses.refined,
            still: poses.still,
            places: poses.places,
            disagreement: poses.disagreement,
            seconds: start.elapsed().as_secs_f64(),
        };
        Ok((summary, sheets))
    }

    /// Refines the poses, draws them, and replaces the given ones.
    fn refined_poses(
        &self,
        out: &Path,
        images: &mut RoughImages,
        sheets: &mut Pictures,
        watch: &dyn Watch,
    ) -> Result<PoseFile> {
        let file = out.join("poses.json");
        let ours = match &self.refinement {
            Refinement::Ours(options) => Some(options),
            Refinement::Given | Refinement::Published => None,
        };
        let poses = if let Refinement::Published = self.refinement {
            let network = if let Weighting::Network(network) = self.weighting { Some(network) } else { None };
            Some(PoseFile::refined_as_published(images, network, self.disturbed, &file)?)
        } else {
            PoseFile::refined(images, ours, self.disturbed, &file, &|done, total| {
                watch.report("poses, per cent", 100 * done / total, 100, String::new());
                !watch.stop().load(Ordering::Relaxed)
            })?
        };
        let Some(poses) = poses else { bail!("interrupted; give the same command again") };
        sheets.did(write_sheet(&out.join("poses.png"), &poses.outlines(images, &file)?));
        poses.apply(images, &file)?.iter().for_each(|note| watch.note(&format!("note: {note}")));
        Ok(poses)
    }

    /// Writes the views of one object; returns their report and the written entries.
    fn of_object(
        &self,
        split: &ViewSplit<'_>,
        object: &RoughObject,
        count: usize,
        poses: &PoseFile,
        progress: &Views<'_>,
    ) -> Result<(ObjectViews, WrittenViews)> {
        let mut sources: Vec<SourceView> = object
            .images
            .iter()
            .map(|i| SourceView::new(&i.posed, &object.mesh, CROP))
            .collect::<Result<_, _>>()?;
        let differing = if self.compare_photographs {
            leave_out_what_differs(&mut sources, &object.mesh)
        } else {
            vec![]
        };
        let maker = ViewMaker::new(&object.mesh, sources, self.weighting, self.per_view)
            .with_context(|| format!("object {}", object.id))?;
        let written = split.write(object, &maker, &|_, _| progress.next(object.id))?;
        let written =
            written.ok_or_else(|| anyhow!("interrupted; give the same command again to continue"))?;
        let of_object = || poses.photographs.iter().filter(|p| p.object == object.id);
        let summary = ObjectViews {
            id: object.id,
            photographs: object.images.len(),
            dropped: count - object.images.len(),
            images: written.images,
            pixels_differing: differing.iter().sum::<f64>() / differing.len().max(1) as f64,
            surface_unseen: maker.unseen_fraction(),
            pixels_unseen: written.unseen,
            median_moved_mm: median(of_object().map(|p| p.moved_mm)),
            median_rotated_degrees: median(of_object().map(|p| p.rotated_degrees)),
        };
        Ok((summary, written))
    }
}

impl ViewsSummary {
    /// Prints it for people, with the next command.
    pub fn print(&self) {
        println!("object  photographs  moved     rotated   surface unseen  views  pixels unseen");
        for o in &self.objects {
            println!(
                "{:6}  {:11}  {:5.1} mm  {:5.2} deg {:13.1} %  {:5}  {:11.1} %",
                o.id,
                o.photographs,
                o.median_moved_mm,
                o.median_rotated_degrees,
                100.0 * o.surface_unseen,
                o.images,
                100.0 * o.pixels_unseen
            );
        }
        match self.places {
            _ if self.still => {
                println!("the objects did not move: each photograph has one camera pose for all of them")
            }
            places if places > self.objects.len() => {
                println!("between photographs objects were moved: they stood at {places} places");
            }
            _ => {}
        }
        let ViewsSummary { out, split, .. } = self;
        println!(
            "{out}/preview.png: new views; {out}/poses.png: outlines at the given and the refined poses"
        );
        println!(
            "next: sixfold train pix2pose --dataset {out} --split {split} --render-fraction 0 --out DIR"
        );
    }
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    upper_median(&mut values).unwrap_or(0.0)
}
