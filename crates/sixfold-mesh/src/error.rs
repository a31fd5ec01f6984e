//! Errors of mesh files: each names the file, the place in it, and what to do.

use thiserror::Error;

use crate::MeshError;

/// Why a mesh file could not be read or written.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum MeshFileError {
    /// The file, or one that it names (texture, material, buffer), cannot be opened, read or written.
    #[error("{file}: {source}")]
    Io {
        /// The file.
        file: String,
        /// The system's error.
        source: std::io::Error,
    },
    /// A file that the mesh file names cannot be read.
    #[error("{file}: {field} names \"{named}\": {reason}; put that file beside the mesh or remove the line")]
    Named {
        /// The mesh file.
        file: String,
        /// Where in the mesh file.
        field: String,
        /// The name found there.
        named: String,
        /// Why it cannot be used.
        reason: String,
    },
    /// The file name has an unknown extension.
    #[error(
        "{file}: unknown mesh format \"{found}\", expected a file ending in .ply, .obj, .stl, .gltf, .glb or .xyz"
    )]
    Format {
        /// The file.
        file: String,
        /// The extension.
        found: String,
    },
    /// A field holds an invalid value.
    #[error("{file}: {field}: expected {expected}, found {found}")]
    Field {
        /// The file.
        file: String,
        /// Element and property, or line, or object.
        field: String,
        /// The expected value.
        expected: String,
        /// The value found.
        found: String,
    },
    /// A `models_info.json` does not describe the mesh of an object.
    #[error(
        "{file}: object {object}, {field}: found {found}, expected {expected}; the file is of other meshes or in another unit \
         (lengths are millimetres): put the file of these meshes there, or correct the field"
    )]
    Info {
        /// The file.
        file: String,
        /// The object's id.
        object: u32,
        /// The field.
        field: String,
        /// The value found.
        found: String,
        /// The value computed from the mesh.
        expected: String,
    },
    /// The arrays of the file do not form a mesh.
    #[error("{file}: {source}")]
    Mesh {
        /// The file.
        file: String,
        /// What is wrong.
        source: MeshError,
    },
    /// The object does not have the size of a tabletop object: usually the unit is wrong.
    #[error("{file}: {explanation}")]
    Size {
        /// The file.
        file: String,
        /// The diameter that the given unit leads to, in metres.
        diameter: f64,
        /// What is suspicious and which unit to give.
        explanation: String,
    },
}

impl MeshFileError {
    /// Shorthand for [`MeshFileError::Field`].
    pub(crate) fn field(
        file: &str,
        field: impl Into<String>,
        expected: impl Into<String>,
        found: impl Into<String>,
    ) -> Self {
        MeshFileError::Field {
            file: file.to_owned(),
            field: field.into(),
            expected: expected.into(),
            found: found.into(),
        }
    }
}
