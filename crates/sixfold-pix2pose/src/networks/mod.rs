//! The networks: RGB crop in, per-pixel object coordinates and expected error out.

mod compact;
mod paper;
mod resnet50;

pub use compact::{Compact, CompactConfig, Decoder};
pub use paper::{GeneratorOutput, PaperGenerator, PaperGeneratorConfig, SIDE};
pub use resnet50::{ResNet50Generator, ResNet50GeneratorConfig};
