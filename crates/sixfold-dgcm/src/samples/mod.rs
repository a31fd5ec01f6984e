//! Training samples: views of members of the families, and pairs of views.

mod pairs;
mod pool;
mod preview;

pub use pairs::{Pair, PairOptions};
pub use pool::{GraspPoolOptions, Pool, View};
