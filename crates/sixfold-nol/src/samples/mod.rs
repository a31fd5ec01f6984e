//! Training samples (dissertation, section 4.2.2): synthetic objects with random textures in cluttered images, with inaccurate
//! poses.
//!
//! The dissertation renders 1,000 sets of ten images of scanned objects before the training; here every sample is generated on
//! demand, as a function of seed and number alone, and no scanned objects are used.

mod batch;
mod object;
mod view;

pub(crate) use batch::look_up;
pub use batch::{Batch, Lookup, ViewBatchOptions};
pub(crate) use batch::{order, relative};
pub use object::PaintedObject;
pub use view::{Sample, ViewSampleOptions, make_sample};
