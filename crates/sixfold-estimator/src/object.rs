//! An object to be found.

use std::path::PathBuf;
use std::sync::Arc;

use sixfold_mesh::{Mesh, ModelInfo};

use crate::error::EstimatorError;

/// An object to be found: a mesh, or an object known to methods without one.
#[derive(Debug, Clone)]
pub struct Object {
    /// Its name for people; not a file name.
    pub name: String,
    /// Its number in a dataset, in a trained model or in a detector.
    pub id: Option<u32>,
    /// Its surface, metres.
    pub mesh: Option<Arc<Mesh>>,
    /// Diameter and symmetries; `None` without a mesh.
    pub info: Option<ModelInfo>,
    /// The folder in which methods store derived data; `None` to store nothing.
    pub folder: Option<PathBuf>,
}

impl Object {
    /// An object that is known only by its number in a trained model.
    pub fn of_model(id: Option<u32>) -> Object {
        Object { name: String::new(), id, mesh: None, info: None, folder: None }
    }

    /// A mesh under a name.
    pub fn of_mesh(name: impl Into<String>, mesh: Mesh, info: ModelInfo) -> Object {
        Object { name: name.into(), id: None, mesh: Some(Arc::new(mesh)), info: Some(info), folder: None }
    }

    /// The file in which a method stores derived data; `None` to store nothing. `name` states method and
    /// content: `ppf.bin`.
    pub fn file(&self, name: &str) -> Option<PathBuf> {
        self.folder.as_ref().map(|folder| folder.join(name))
    }

    /// The mesh, for methods that need one.
    ///
    /// # Errors
    /// [`EstimatorError::Lacks`].
    pub fn needed_mesh(&self, method: &'static str) -> Result<&Arc<Mesh>, EstimatorError> {
        self.mesh.as_ref().ok_or_else(|| EstimatorError::Lacks {
            object: self.name.clone(),
            what: "mesh",
            method,
            advice: "it was added from depth images: only --method mttm and --method auto can look for it",
        })
    }
}
