//! The networks: from an RGB crop to per-pixel object coordinates and their expected error.

mod compact;
mod paper;
mod resnet50;

pub use compact::{Compact, CompactConfig, Decoder};
pub use paper::{GeneratorOutput, PaperGenerator, PaperGeneratorConfig, SIDE};
pub use resnet50::{ResNet50Generator, ResNet50GeneratorConfig};
