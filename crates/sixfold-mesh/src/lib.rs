//! Triangle meshes of objects: reading, writing, measuring, sampling, simplifying.

mod mesh;

pub use mesh::{Mesh, MeshError};
