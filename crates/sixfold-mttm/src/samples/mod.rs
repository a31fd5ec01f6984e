//! Training material (dissertation, sections 5.2.1, 5.2.3 and 5.3.1): cluttered scenes of synthetic objects as seen by depth
//! cameras. Regions and their templates are cut out once and augmented again in every step.

mod anchor;
mod batch;
mod pool;
#[cfg(feature = "recipe")]
mod preview;

pub use anchor::{Anchor, AnchorOptions};
pub use batch::{Augmentation, Batch, PairBatchOptions};
#[cfg(any(feature = "recipe", test))]
pub(crate) use pool::Arrangement;
pub use pool::{DepthPoolOptions, Pool};
#[cfg(feature = "recipe")]
pub(crate) use preview::preview;
