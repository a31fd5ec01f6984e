//! Files of grasps: `grasps.json` of `sixfold grasp propose`, one grasp written by a person, or a trial of `sixfold grasp measure`.

use std::path::Path;

use serde::Deserialize;
use serde::de::DeserializeOwned;
use sixfold_geometry::{Pose, PoseError};
use thiserror::Error;

use crate::{AntipodalQuality, Grasp};

/// Errors of grasp files.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum GraspFileError {
    /// The file cannot be read.
    #[error("{file}: {source}")]
    Io {
        /// The file.
        file: String,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file is not JSON, or lacks a field.
    #[error("{file}: expected {expected}: {source}")]
    Json {
        /// The file.
        file: String,
        /// The contents expected.
        expected: &'static str,
        /// Position and cause.
        source: serde_json::Error,
    },
    /// A length is impossible.
    #[error("{file}: field {field}: found {found}, expected above 0 and below 1 m")]
    Length {
        /// The file.
        file: String,
        /// The field.
        field: &'static str,
        /// Its value.
        found: f64,
    },
    /// A matrix is not a pose.
    #[error("{file}: field {field}: {source}")]
    Pose {
        /// The file.
        file: String,
        /// The field.
        field: &'static str,
        /// The cause.
        source: PoseError,
    },
    /// There is no grasp of this number.
    #[error("--number: found {found}, expected 1 to {count}: {file} holds {count} grasps")]
    Number {
        /// The file.
        file: String,
        /// The number given.
        found: usize,
        /// Number of grasps in the file.
        count: usize,
    },
}

type Rows = [[f64; 4]; 4];

#[derive(Deserialize)]
struct OneGrasp {
    camera_from_gripper: Rows,
    opening: f64,
    width: f64,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Grasps {
    List { grasps: Vec<OneGrasp> },
    One(OneGrasp),
}

/// Reads a grasp by its number, counted from 1, from a file with one grasp or a list of them. It has no quality.
///
/// # Errors
/// [`GraspFileError`].
pub fn read_grasp(path: &Path, number: usize) -> Result<Grasp, GraspFileError> {
    const EXPECTED: &str =
        "camera_from_gripper (4x4, metres), opening and width (metres), or a list of them as `grasps`";
    let file = path.display().to_string();
    let grasps = match read(path, EXPECTED)? {
        Grasps::List { grasps } => grasps,
        Grasps::One(grasp) => vec![grasp],
    };
    let count = grasps.len();
    let Some(grasp) = number.checked_sub(1).and_then(|i| grasps.into_iter().nth(i)) else {
        return Err(GraspFileError::Number { file, found: number, count });
    };
    for (field, found) in [("opening", grasp.opening), ("width", grasp.width)] {
        if !(found > 0.0 && found < 1.0) {
            return Err(GraspFileError::Length { file, field, found });
        }
    }
    let quality = AntipodalQuality { alignment: 0.0, support: 0.0, centring: 0.0, observed: 0.0 };
    let camera_from_gripper = pose(&file, "camera_from_gripper", &grasp.camera_from_gripper)?;
    Ok(Grasp { camera_from_gripper, opening: grasp.opening, width: grasp.width, quality })
}

/// A grasp that was tried in simulation.
#[derive(Debug, Clone, PartialEq)]
pub struct TriedGrasp {
    /// Pose of the object.
    pub world_from_object: Pose,
    /// Pose of the gripper when it closed.
    pub world_from_gripper: Pose,
    /// Distance of the pads before closing, metres.
    pub opening: f64,
}

#[derive(Deserialize)]
struct Tried {
    world_from_object: Rows,
    world_from_gripper: Rows,
    opening: f64,
}

/// Reads a trial.
///
/// # Errors
/// [`GraspFileError`].
pub fn read_tried_grasp(path: &Path) -> Result<TriedGrasp, GraspFileError> {
    const EXPECTED: &str = "world_from_object, world_from_gripper (4x4, metres) and opening (metres)";
    let tried: Tried = read(path, EXPECTED)?;
    let file = path.display().to_string();
    Ok(TriedGrasp {
        world_from_object: pose(&file, "world_from_object", &tried.world_from_object)?,
        world_from_gripper: pose(&file, "world_from_gripper", &tried.world_from_gripper)?,
        opening: tried.opening,
    })
}

fn read<T: DeserializeOwned>(path: &Path, expected: &'static str) -> Result<T, GraspFileError> {
    let file = || path.display().to_string();
    let text = std::fs::read_to_string(path).map_err(|source| GraspFileError::Io { file: file(), source })?;
    serde_json::from_str(&text).map_err(|source| GraspFileError::Json { file: file(), expected, source })
}

fn pose(file: &str, field: &'static str, rows: &Rows) -> Result<Pose, GraspFileError> {
    Pose::from_rows(rows).map_err(|source| GraspFileError::Pose { file: file.to_owned(), field, source })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_of_a_grasp_file_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("grasp.json");
        let eye = "[[1,0,0,0.1],[0,1,0,0],[0,0,1,0.7],[0,0,0,1]]";
        let good = format!(r#"{{"camera_from_gripper": {eye}, "opening": 0.05, "width": 0.03}}"#);
        let read = |text: &str, number| {
            std::fs::write(&path, text).unwrap();
            read_grasp(&path, number).map_err(|e| e.to_string())
        };
        let grasp = read(&good, 1).unwrap();
        assert_eq!(
            (grasp.opening, grasp.width, grasp.camera_from_gripper.translation().x),
            (0.05, 0.03, 0.1)
        );
        let list = format!(r#"{{"grasps": [{good}, {}]}}"#, good.replace("0.05", "0.06"));
        assert_eq!(read(&list, 2).unwrap().opening, 0.06);
        for (text, number, word) in [
            (list.as_str(), 3, "holds 2 grasps"),
            (&list, 0, "expected 1 to 2"),
            (&good.replace("0.05", "-1"), 1, "field opening: found -1"),
            (&good.replace("0.03", "1e300"), 1, "field width"),
            (&good.replace("[1,0,0,0.1]", "[2,0,0,0.1]"), 1, "camera_from_gripper"),
            ("{", 1, "camera_from_gripper (4x4, metres)"),
        ] {
            let error = read(text, number).unwrap_err();
            assert!(error.contains(word) && error.contains("grasp.json"), "{error}");
        }
        std::fs::write(&path, r#"{"opening": 1}"#).unwrap();
        let error = read_tried_grasp(&path).unwrap_err().to_string();
        assert!(error.contains("world_from_object"), "{error}");
        assert!(read_grasp(&folder.path().join("none"), 1).unwrap_err().to_string().contains("none"));
    }
}
