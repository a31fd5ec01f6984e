//! Triangle meshes of objects: reading, writing, measuring, sampling, simplifying.
//!
//! A [`Mesh`] is in metres and is checked once, when it is made. Files do not state their unit, so readers
//! take it as an argument ([`Unit`]). They refuse a size that no tabletop object has, with a message that
//! names the likely unit.
//!
//! ```
//! use sixfold_mesh::{Unit, no_resources, parse_ply};
//! let text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n\
//!             property float z\nend_header\n0 0 0\n30 40 0\n";
//! let mesh = parse_ply(text.as_bytes(), "two_points.ply", Unit::Millimetre, &no_resources)?;
//! assert!((mesh.diameter() - 0.05).abs() < 1e-12);
//! # Ok::<(), sixfold_mesh::MeshFileError>(())
//! ```

#![deny(clippy::print_stdout, clippy::print_stderr)]

mod contents;
mod convex_hull;
mod diameter;
mod error;
mod file;
mod gltf_file;
mod measure;
mod mesh;
mod models_check;
mod models_info;
mod obj;
mod paint;
mod ply;
mod ply_write;
mod sample;
mod simplify;
mod stl;
mod surface;
mod surfels;
mod symmetry;
mod unit;
mod xyz;

pub use error::MeshFileError;
pub use file::{
    LARGEST_AREA, LARGEST_DIAMETER, LARGEST_OFFSET, MeshOptions, Resources, SMALLEST_DIAMETER, check_size,
    no_resources, read_mesh, read_mesh_unchecked, read_mesh_with,
};
pub use gltf_file::parse_gltf;
pub use mesh::{Mesh, MeshError};
pub use models_info::{ContinuousSymmetry, ModelInfo, ModelsInfo};
pub use obj::parse_obj;
pub use ply::parse_ply;
pub use ply_write::{PlyFormat, ply_bytes, ply_files, write_ply};
pub use sample::SurfaceSamples;
pub use simplify::simplify;
pub use stl::parse_stl;
pub use symmetry::{
    ColorDifference, Deviation, FoundSymmetry, SymmetryOptions, Verdict, find_symmetries, sure_symmetries,
};
pub use unit::{Unit, UnitError};
pub use xyz::parse_xyz;
