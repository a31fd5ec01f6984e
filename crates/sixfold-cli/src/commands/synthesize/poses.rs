//! Makes the poses of the photographs better, and keeps what became of them.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};
use sixfold_geometry::Pose;
use sixfold_mesh::Mesh;
use sixfold_nol::refine::{PoseRefinementOptions, PosedSource, SceneKind, refine_scene};

use super::arguments::{SceneArgument, SynthesizeArguments};
use super::input::{Input, Source};
use sixfold_shell::output::{pose_rows, write_atomically};
use sixfold_shell::progress::{Progress, interrupted};

/// One photograph's poses, as they are written.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct PoseRecord {
    pub object: u32,
    /// The photograph.
    pub name: String,
    pub image: usize,
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub frame: Option<(u32, u32)>,
    /// As given (disturbed, where that was asked for): four rows, translation in metres.
    pub given: [[f64; 4]; 4],
    /// Before it was disturbed (`--disturb`).
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub undisturbed: Option<[[f64; 4]; 4]>,
    /// Used.
    pub camera_from_object: [[f64; 4]; 4],
    /// How far the object's centre moved, millimetres.
    pub moved_mm: f64,
    pub turned_degrees: f64,
    /// Mean difference in colour to the other photographs of the object, 0 to 1, before and after.
    pub difference: [Option<f64>; 2],
    /// Why the photograph is not used.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub dropped: Option<String>,
}

/// All poses, and whether the objects stood still.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct PoseFile {
    pub refined: bool,
    pub still: bool,
    /// At how many places the objects stood; as many as objects if nothing moved, or nothing is known of it.
    #[serde(default)]
    pub places: usize,
    /// Disagreement of the given poses with one arrangement, in units of what their roughness explains.
    pub disagreement: Option<f64>,
    pub photographs: Vec<PoseRecord>,
}

/// Sources of all subjects, in one list.
fn all_sources(input: &Input) -> Vec<(usize, &Source)> {
    let numbered = input.subjects.iter().enumerate();
    numbered.flat_map(|(object, s)| s.photographs.iter().map(move |p| (object, p))).collect()
}

/// Refines the poses unless that was done already or is not wanted. `None` when the user stopped it.
pub(super) fn refine(a: &SynthesizeArguments, input: &Input, file: &Path) -> Result<Option<PoseFile>> {
    let sources = all_sources(input);
    let unrefined = |(object, source): &(usize, &Source)| PoseRecord {
        object: input.subjects[*object].id,
        name: source.photograph.name().to_owned(),
        image: source.image,
        frame: source.frame,
        given: pose_rows(source.photograph.camera_from_object()),
        undisturbed: (!a.disturb.is_empty()).then(|| pose_rows(&source.given)),
        camera_from_object: pose_rows(source.photograph.camera_from_object()),
        moved_mm: 0.0,
        turned_degrees: 0.0,
        difference: [None, None],
        dropped: None,
    };
    let mut poses = PoseFile {
        refined: !a.no_refine,
        still: false,
        places: input.subjects.len(),
        disagreement: None,
        photographs: sources.iter().map(unrefined).collect(),
    };
    if a.no_refine {
        write(file, &poses)?;
        return read(file).map(Some);
    }
    if file.exists() {
        return read(file).map(Some);
    }
    let meshes: Vec<Mesh> = input.subjects.iter().map(|s| s.mesh.clone()).collect();
    // Images are numbered without gaps.
    let mut numbers = BTreeMap::new();
    for (_, source) in &sources {
        let next = numbers.len();
        numbers.entry(source.image).or_insert(next);
    }
    let listed: Vec<PosedSource<'_>> = sources
        .iter()
        .map(|(object, source)| PosedSource {
            object: *object,
            image: numbers[&source.image],
            photograph: &source.photograph,
        })
        .collect();
    let options = PoseRefinementOptions {
        scene: match a.scene {
            SceneArgument::Judge => SceneKind::Judge,
            SceneArgument::Still => SceneKind::Still,
            SceneArgument::Moving => SceneKind::Moving,
        },
        rough: [a.rough[0] * 1e-3, a.rough[1].to_radians()],
        seed: a.seed,
        ..PoseRefinementOptions::default()
    };
    let mut progress = Progress::new("poses, per cent", 100);
    let stop = interrupted();
    let refined = refine_scene(&listed, &meshes, &options, |done| {
        progress.set((100.0 * done) as usize);
        !stop.load(std::sync::atomic::Ordering::Relaxed)
    })?;
    progress.finish();
    if stop.load(std::sync::atomic::Ordering::Relaxed) {
        return Ok(None);
    }
    poses.still = refined.still;
    poses.places = refined.places;
    poses.disagreement = refined.disagreement;
    for (record, report) in poses.photographs.iter_mut().zip(&refined.sources) {
        record.camera_from_object = pose_rows(&report.camera_from_object);
        record.moved_mm = report.moved * 1e3;
        record.turned_degrees = report.turned.to_degrees();
        record.difference = report.difference.map(|d| d.is_finite().then_some(d));
        record.dropped.clone_from(&report.dropped);
    }
    write(file, &poses)?;
    read(file).map(Some)
}

/// The poses as they were written: numbers in text may lose their last digit, and a run that continues must not differ from one
/// that was never stopped.
fn read(file: &Path) -> Result<PoseFile> {
    let text = std::fs::read_to_string(file).with_context(|| file.display().to_string())?;
    serde_json::from_str(&text)
        .with_context(|| format!("{}: not the poses of this command; remove it", file.display()))
}

fn write(file: &Path, poses: &PoseFile) -> Result<()> {
    let text = serde_json::to_string_pretty(poses).context("cannot write the poses as JSON")?;
    write_atomically(file, text.as_bytes())
}

/// Puts the refined poses in place of the given ones and leaves out the photographs that were dropped, with a note for each.
pub(super) fn apply(input: &mut Input, poses: &PoseFile) -> Result<()> {
    let mut records = poses.photographs.iter();
    let mut refined = vec![];
    for subject in &mut input.subjects {
        let mut kept = vec![];
        for mut source in subject.photographs.drain(..) {
            let record = records.next().context("the kept poses are of other photographs; remove them")?;
            if let Some(reason) = &record.dropped {
                eprintln!("note: photograph {} is left out: {reason}", record.name);
                continue;
            }
            let rows = record.camera_from_object;
            let matrix = sixfold_geometry::nalgebra::Matrix4::from_fn(|i, j| rows[i][j]);
            let pose = Pose::from_matrix(&matrix).with_context(|| record.name.clone())?;
            source.photograph = source.photograph.with_pose(pose)?;
            refined.push((source.image, subject.id, pose));
            kept.push(source);
        }
        subject.photographs = kept;
    }
    input.redraw_masks(&refined)
}
