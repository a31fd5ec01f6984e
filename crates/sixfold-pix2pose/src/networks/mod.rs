//! The networks: RGB crop in, per-pixel object coordinates and expected error out.

mod compact;

pub use compact::{Compact, CompactConfig};
