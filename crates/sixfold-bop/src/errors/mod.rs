//! The pose errors, one per file. Metres, pixels and radians; symmetries as lists of poses that map the object
//! onto itself, the identity among them.
//!
//! Poses are passed as [`Placement`]s; a [`sixfold_geometry::Pose`] is converted implicitly.

mod placement;
mod projection;
mod rotation_translation;
mod surface;
mod vsd;

pub use placement::Placement;
pub use projection::{mspd, projection_error};
pub use rotation_translation::{rotation_error, translation_error};
pub use surface::{add, add_s, adi, mssd};
pub use vsd::{PUBLISHED_TAU, Taus, VsdError, VsdOptions, vsd};
