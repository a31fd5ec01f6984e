//! The network behind template matching: the one within the program or another, and what it knows of an object.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result};
use sixfold_mttm::KnownObject;
use sixfold_mttm::model::MttmModel;

use super::arguments::Matcher;

/// The network that is asked for; none where points match alone.
pub(crate) fn network(matcher: Matcher, weights: Option<&Path>) -> Result<Option<Arc<MttmModel>>> {
    if matcher == Matcher::Points {
        return Ok(None);
    }
    let model = match weights {
        Some(file) => MttmModel::load(file).context("--weights")?,
        None => MttmModel::shipped().context("the network within the program")?,
    };
    Ok(Some(Arc::new(model)))
}

/// The object as the network knows it too, its descriptors kept beside its templates (a file whose name ends in
/// `sixfold-templates` or `bin`).
pub(crate) fn with_network(
    object: KnownObject,
    model: Option<&Arc<MttmModel>>,
    templates: &Path,
    name: &str,
) -> KnownObject {
    let Some(model) = model else { return object };
    let (object, note) =
        object.with_network_cached(model.clone(), &templates.with_extension("sixfold-descriptors"));
    if let Some(note) = note {
        eprintln!("note: descriptors of {name} not kept or renewed: {note}");
    }
    object
}
