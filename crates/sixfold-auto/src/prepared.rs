//! Prepares an object for all methods at once.

use std::error::Error;

use sixfold_estimator::{Object, PoseEstimator};
use sixfold_mttm::{MttmEstimator, ObjectTemplates, TEMPLATES_FILE, TemplateOptions};
use sixfold_ppf::PpfEstimator;
use sixfold_views::estimator::ViewsEstimator;

/// Computes in advance the files that methods without per-object training keep in an object's folder, instead of at the first
/// estimate.
///
/// # Errors
/// Those of the methods: for a mesh that one of them cannot use, or a file that cannot be written.
pub fn prepare_all(object: &Object) -> Result<(), Box<dyn Error + Send + Sync>> {
    PpfEstimator::default().prepare(object)?;
    if let (Some(mesh), Some(file)) = (&object.mesh, object.file(TEMPLATES_FILE)) {
        ObjectTemplates::from_mesh(mesh, &TemplateOptions::default())?.write(&file)?;
        MttmEstimator::default().prepare(object)?;
    }
    ViewsEstimator::shipped()?.prepare(object)?;
    Ok(())
}
