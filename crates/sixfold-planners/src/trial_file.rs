//! The file of trials: the seed in the first line, then one scene per line, so that a stopped run resumes and both planners are
//! trained on the same trials.

use std::fs::{File, OpenOptions};
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sixfold_geometry::nalgebra::{Quaternion, UnitQuaternion};
use sixfold_geometry::{Pose, Vec3};
use sixfold_grasp::{AntipodalQuality, Grasp};
use sixfold_io::WriteLock;

use crate::trials::{Source, TrialSetOptions, TrialsError};

/// A pose as numbers: x, y, z, w of the rotation, then the translation in metres.
pub(crate) type PoseRow = [f64; 7];

/// One scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SceneRow {
    /// Its number.
    pub scene: u64,
    /// Pose of the object.
    pub world_from_object: PoseRow,
    /// The candidates tried; empty if the object did not come to rest or was not found.
    pub candidates: Vec<Candidate>,
}

/// A grasp that was tried.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Candidate {
    /// The planner that proposed it.
    pub source: Source,
    /// The commanded pose of the hand.
    pub camera_from_gripper: PoseRow,
    /// Distance of the pads before closing, metres.
    pub opening: f64,
    /// Whether it held.
    pub held: bool,
}

fn row_of(pose: &Pose) -> PoseRow {
    let (q, t) = (pose.rotation(), pose.translation());
    [q.i, q.j, q.k, q.w, t.x, t.y, t.z]
}

fn pose_of(row: &PoseRow) -> Pose {
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(row[3], row[0], row[1], row[2]));
    Pose::new(rotation, Vec3::new(row[4], row[5], row[6]))
}

impl SceneRow {
    pub(crate) fn new(scene: u64, world_from_object: &Pose) -> SceneRow {
        SceneRow { scene, world_from_object: row_of(world_from_object), candidates: vec![] }
    }

    pub(crate) fn world_from_object(&self) -> Pose {
        pose_of(&self.world_from_object)
    }
}

impl Candidate {
    pub(crate) fn new(source: Source, grasp: &Grasp, held: bool) -> Candidate {
        let camera_from_gripper = row_of(&grasp.camera_from_gripper);
        Candidate { source, camera_from_gripper, opening: grasp.opening, held }
    }

    /// The grasp, without width and quality.
    pub(crate) fn grasp(&self) -> Grasp {
        let quality = AntipodalQuality { alignment: 0.0, support: 0.0, centring: 0.5, observed: 1.0 };
        let (camera_from_gripper, opening) = (pose_of(&self.camera_from_gripper), self.opening);
        Grasp { camera_from_gripper, opening, width: opening, quality }
    }
}

/// The file, opened to append scenes.
pub(crate) struct TrialFile {
    file: File,
    path: PathBuf,
    rows: usize,
    _lock: WriteLock,
}

impl TrialFile {
    /// Opens or creates a file. An incomplete last line from a stopped run is removed. A file with fewer scenes is continued; one
    /// with more can be used as well.
    pub(crate) fn open(path: &Path, options: &TrialSetOptions) -> Result<TrialFile, TrialsError> {
        let io = |source| TrialsError::Io { file: path.display().to_string(), source };
        sixfold_io::make_folder_of(path).map_err(io)?;
        let lock = WriteLock::take(path)?;
        let text = match std::fs::read_to_string(path) {
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => String::new(),
            other => other.map_err(io)?,
        };
        let whole = text.rfind('\n').map_or("", |end| &text[..=end]);
        let mut file = OpenOptions::new().create(true).truncate(false).write(true).open(path).map_err(io)?;
        let header = serde_json::json!({ "trials": 1, "seed": options.seed }).to_string();
        if let Some(found) = whole.lines().next().filter(|found| *found != header) {
            let file = path.display().to_string();
            let expected =
                format!("{header}: trials with other options; give the same ones, or another file");
            return Err(TrialsError::Content { file, line: 1, found: found.to_owned(), expected });
        }
        file.set_len(whole.len() as u64).map_err(io)?;
        file.seek(SeekFrom::End(0)).map_err(io)?;
        let rows = whole.lines().count().saturating_sub(1);
        let mut opened = TrialFile { file, path: path.to_owned(), rows, _lock: lock };
        if whole.is_empty() {
            opened.line(&header)?;
        }
        Ok(opened)
    }

    /// Number of scenes in the file.
    pub(crate) fn len(&self) -> usize {
        self.rows
    }

    pub(crate) fn append(&mut self, row: &SceneRow) -> Result<(), TrialsError> {
        let line = serde_json::to_string(row).map_err(|e| self.io(e.into()))?;
        self.line(&line)?;
        self.rows += 1;
        Ok(())
    }

    fn line(&mut self, line: &str) -> Result<(), TrialsError> {
        // A single write, so that the file almost always ends with a complete line.
        let written = self.file.write_all(format!("{line}\n").as_bytes());
        written.map_err(|e| self.io(e))
    }

    fn io(&self, source: std::io::Error) -> TrialsError {
        TrialsError::Io { file: self.path.display().to_string(), source }
    }

    /// The first scenes.
    pub(crate) fn read(&self, scenes: u64) -> Result<Vec<SceneRow>, TrialsError> {
        let text = std::fs::read_to_string(&self.path).map_err(|e| self.io(e))?;
        let parsed = |(number, line): (usize, &str)| {
            let wrong = |found: String| TrialsError::Content {
                file: self.path.display().to_string(),
                line: number + 1,
                found,
                expected: format!("scene {} as this program writes it; delete the file", number - 1),
            };
            let row: SceneRow = serde_json::from_str(line).map_err(|e| wrong(e.to_string()))?;
            let finite = |pose: &PoseRow| pose.iter().all(|v| v.is_finite());
            let fits = row.scene + 1 == number as u64
                && finite(&row.world_from_object)
                && row.candidates.iter().all(|c| finite(&c.camera_from_gripper) && c.opening > 0.0);
            if fits { Ok(row) } else { Err(wrong(format!("scene {}", row.scene))) }
        };
        text.lines().enumerate().skip(1).take(scenes as usize).map(parsed).collect()
    }
}
