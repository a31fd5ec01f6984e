//! The poses of roughly posed images, refined once and kept in a file, from which a resumed run starts.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use serde::{Deserialize, Serialize};
use sixfold_data::{PosedImage, RoughImage, RoughImages, TrainingSetError};
use sixfold_geometry::nalgebra::Matrix4;
use sixfold_geometry::{Pose, Progress};
use sixfold_mesh::Mesh;

use crate::error::NolError;
use crate::model::NolModel;
use crate::refine::{
    PoseRefinementOptions, PosedSource, PublishedRuleOptions, published_rule_poses, refine_scene,
};

/// A pose as four rows, translation in metres.
type Rows = [[f64; 4]; 4];

/// Number of other photographs in the first rendering of the published rule (section 4.3.3: six at inference).
const PER_VIEW: usize = 6;

/// Why poses could not be refined.
#[derive(Debug, thiserror::Error)]
pub enum PoseFileError {
    /// The images cannot be used.
    #[error(transparent)]
    Nol(#[from] NolError),
    /// A mask or pose does not fit its image.
    #[error(transparent)]
    Images(#[from] TrainingSetError),
    /// The file cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file has other contents.
    #[error("{}: not the poses of these images: {reason}; remove it to have them made again", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
}

/// One image's poses of one object, as written to the file.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct PoseRecord {
    /// The object.
    pub object: u32,
    /// Name of the image.
    pub name: String,
    /// Number of the image.
    pub image: usize,
    /// Scene and image in a dataset.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub frame: Option<(u32, u32)>,
    /// The given pose (disturbed, if that was requested): four rows, translation in metres.
    pub given: Rows,
    /// The pose before it was disturbed.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub undisturbed: Option<Rows>,
    /// The pose that is used.
    pub camera_from_object: Rows,
    /// Distance by which the object's centre moved, millimetres.
    pub moved_mm: f64,
    /// Angle by which it was rotated, degrees.
    pub rotated_degrees: f64,
    /// Mean difference in colour to the other images of the object, 0 to 1, before and after.
    pub difference: [Option<f64>; 2],
    /// Why the image is not used.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub dropped: Option<String>,
}

impl PoseRecord {
    /// The pose that is used.
    ///
    /// # Errors
    /// If it is not a valid pose.
    pub fn pose(&self) -> Result<Pose, String> {
        let matrix = Matrix4::from_fn(|i, j| self.camera_from_object[i][j]);
        Pose::from_matrix(&matrix).map_err(|error| format!("{}: {error}", self.name))
    }
}

/// All poses, and whether the objects stood still.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct PoseFile {
    /// Whether they were refined.
    pub refined: bool,
    /// Whether the objects stood still in all images.
    pub still: bool,
    /// Number of places at which objects stood; equal to the number of objects if nothing moved or this is unknown.
    #[serde(default)]
    pub places: usize,
    /// Disagreement of the given poses with one arrangement, in units of the disagreement that their roughness explains.
    pub disagreement: Option<f64>,
    /// By object, then in the order of the images.
    pub photographs: Vec<PoseRecord>,
}

/// The images of all objects, in one list with the number of their object.
fn all(images: &RoughImages) -> Vec<(usize, &RoughImage)> {
    let numbered = images.objects.iter().enumerate();
    numbered.flat_map(|(object, o)| o.images.iter().map(move |i| (object, i))).collect()
}

impl PoseFile {
    /// The poses as given; `disturbed` says whether they differ from those of the input.
    fn given(images: &RoughImages, refined: bool, disturbed: bool) -> PoseFile {
        let record = |(object, image): &(usize, &RoughImage)| PoseRecord {
            object: images.objects[*object].id,
            name: image.posed.name().to_owned(),
            image: image.number,
            frame: image.posed.frame().map(|frame| (frame.scene_id, frame.im_id)),
            given: image.posed.camera_from_object().rows(),
            undisturbed: disturbed.then(|| image.given.rows()),
            camera_from_object: image.posed.camera_from_object().rows(),
            moved_mm: 0.0,
            rotated_degrees: 0.0,
            difference: [None, None],
            dropped: None,
        };
        PoseFile {
            refined,
            still: false,
            places: images.objects.len(),
            disagreement: None,
            photographs: all(images).iter().map(record).collect(),
        }
    }

    /// Refines the poses, unless `file` already has them or `options` is `None`, and writes them there. Returns `None` if
    /// `progress` stops it.
    ///
    /// # Errors
    /// [`PoseFileError`].
    pub fn refined(
        images: &RoughImages,
        options: Option<&PoseRefinementOptions>,
        disturbed: bool,
        file: &Path,
        progress: &dyn Progress,
    ) -> Result<Option<PoseFile>, PoseFileError> {
        let mut poses = PoseFile::given(images, options.is_some(), disturbed);
        if let Some(options) = options {
            if file.exists() {
                return PoseFile::read(file).map(Some);
            }
            let stopped = AtomicBool::new(false);
            poses.refine(images, options, &|done, total| {
                let stops = !progress.report(done, total);
                !(stopped.fetch_or(stops, Ordering::Relaxed) || stops)
            })?;
            // `progress` may have stopped the last step.
            if stopped.into_inner() || !progress.report(1, 1) {
                return Ok(None);
            }
        }
        poses.write(file)?;
        // Numbers written as text may lose their last digit: the file is read back, so that a resumed run does not differ from one
        // that was never stopped.
        PoseFile::read(file).map(Some)
    }

    /// The same by the published rule (section 4.2.3), without detecting which objects stood still; without a network each
    /// photograph is compared with the mean of the others.
    ///
    /// # Errors
    /// [`PoseFileError`].
    pub fn refined_as_published(
        images: &RoughImages,
        model: Option<&NolModel>,
        disturbed: bool,
        file: &Path,
    ) -> Result<PoseFile, PoseFileError> {
        if !file.exists() {
            let mut poses = PoseFile::given(images, true, disturbed);
            let mut records = poses.photographs.iter_mut();
            for object in &images.objects {
                let of: Vec<PosedImage> = object.images.iter().map(|i| i.posed.clone()).collect();
                let (side, rule) = (PoseRefinementOptions::default().side, PublishedRuleOptions::default());
                let found = published_rule_poses(&of, &object.mesh, model, side, PER_VIEW, &rule)?;
                let (low, high) = object.mesh.bounding_box();
                let centre = (low + high) * 0.5;
                for ((image, (pose, _)), record) in of.iter().zip(&found).zip(&mut records) {
                    let given = image.camera_from_object();
                    let moved = pose.transform_point(&centre) - given.transform_point(&centre);
                    record.camera_from_object = pose.rows();
                    record.moved_mm = 1e3 * moved.norm();
                    record.rotated_degrees = pose.rotation_angle_to(given).to_degrees();
                }
            }
            poses.write(file)?;
        }
        PoseFile::read(file)
    }

    fn refine(
        &mut self,
        images: &RoughImages,
        options: &PoseRefinementOptions,
        progress: &dyn Progress,
    ) -> Result<(), PoseFileError> {
        let sources = all(images);
        let meshes: Vec<Mesh> = images.objects.iter().map(|o| o.mesh.clone()).collect();
        // Images are numbered without gaps.
        let mut numbers = BTreeMap::new();
        for (_, source) in &sources {
            let next = numbers.len();
            numbers.entry(source.number).or_insert(next);
        }
        let listed: Vec<PosedSource<'_>> = sources
            .iter()
            .map(|(object, source)| PosedSource {
                object: *object,
                image: numbers[&source.number],
                photograph: &source.posed,
            })
            .collect();
        let refined = refine_scene(&listed, &meshes, options, progress)?;
        self.still = refined.still;
        self.places = refined.places;
        self.disagreement = refined.disagreement;
        for (record, report) in self.photographs.iter_mut().zip(&refined.sources) {
            record.camera_from_object = report.camera_from_object.rows();
            record.moved_mm = report.moved * 1e3;
            record.rotated_degrees = report.rotated.to_degrees();
            record.difference = report.difference.map(|d| d.is_finite().then_some(d));
            record.dropped.clone_from(&report.dropped);
        }
        Ok(())
    }

    fn read(file: &Path) -> Result<PoseFile, PoseFileError> {
        let text = std::fs::read_to_string(file)
            .map_err(|source| PoseFileError::Io { path: file.to_owned(), source })?;
        serde_json::from_str(&text).map_err(|error| content(file, error.to_string()))
    }

    fn write(&self, file: &Path) -> Result<(), PoseFileError> {
        let text = serde_json::to_string_pretty(self).map_err(|error| content(file, error.to_string()))?;
        sixfold_io::write_atomically(file, text.as_bytes())
            .map_err(|source| PoseFileError::Io { path: file.to_owned(), source })
    }

    /// Replaces the given poses by these and removes dropped images; returns a note for each of those.
    ///
    /// # Errors
    /// If these are the poses of other images; `file` is the file from which they were read.
    pub fn apply(&self, images: &mut RoughImages, file: &Path) -> Result<Vec<String>, PoseFileError> {
        let mut records = self.photographs.iter();
        let (mut refined, mut notes) = (vec![], vec![]);
        for object in &mut images.objects {
            let mut kept = vec![];
            for mut image in object.images.drain(..) {
                let record = records.next().ok_or_else(|| content(file, "there are fewer".into()))?;
                if let Some(reason) = &record.dropped {
                    notes.push(format!("photograph {} is left out: {reason}", record.name));
                    continue;
                }
                let pose = record.pose().map_err(|reason| content(file, reason))?;
                image.posed = image.posed.with_pose(pose).map_err(TrainingSetError::from)?;
                refined.push((image.number, object.id, pose));
                kept.push(image);
            }
            object.images = kept;
        }
        images.render_masks_again(&refined)?;
        Ok(notes)
    }
}

fn content(file: &Path, reason: String) -> PoseFileError {
    PoseFileError::Content { path: file.to_owned(), reason }
}
