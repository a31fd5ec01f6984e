//! Training samples: views of members of the families, and pairs of views.

mod pairs;
mod pool;

pub use pairs::{Pair, PairOptions};
pub use pool::{GraspPoolOptions, Pool, View};
