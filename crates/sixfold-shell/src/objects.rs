//! Meshes that a user names: files, or objects of the store.

use std::path::Path;

use anyhow::{Result, bail};
use sixfold_estimator::{Cache, ObjectStore};
use sixfold_mesh::{Mesh, ModelInfo, Unit};

/// A mesh under a name.
#[derive(Debug)]
pub struct MeshObject {
    /// Its name for people.
    pub name: String,
    /// Its surface, metres.
    pub mesh: Mesh,
    /// Diameter and symmetries.
    pub info: ModelInfo,
}

/// A mesh file (then `unit` is needed) or a stored object with a mesh.
///
/// # Errors
/// When there is none, or it cannot be read.
pub fn find(name_or_mesh: &str, unit: Option<Unit>, store: &Path) -> Result<MeshObject> {
    let (object, note) = ObjectStore::new(store).find(name_or_mesh, unit, &Cache::none())?;
    if let Some(note) = note {
        eprintln!("note: {note}");
    }
    let (Some(mesh), Some(info)) = (object.mesh, object.info) else {
        bail!("object {name_or_mesh} was added from depth images and has no mesh");
    };
    let mesh = std::sync::Arc::unwrap_or_clone(mesh);
    Ok(MeshObject { name: object.name, mesh, info })
}
