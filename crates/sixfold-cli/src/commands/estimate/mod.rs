//! `sixfold estimate`: any method on one image (`image.rs`) or on a dataset (`dataset.rs`).

pub(crate) mod arguments;
mod dataset;
mod image;
mod methods;
#[cfg(feature = "networks")]
mod networks;
#[cfg(not(feature = "networks"))]
#[path = "without_networks.rs"]
mod networks;
mod region;

use anyhow::Result;
use sixfold_shell::Outcome;

use self::arguments::EstimateArguments;

pub(crate) fn run(a: &EstimateArguments) -> Result<Outcome> {
    match &a.common.dataset {
        Some(root) => dataset::run(a, root),
        None => image::run(a),
    }
}
