//! Times of a trained detector on one image, and what the network predicts for it, for `benches/detector_vs_onnxruntime.py`.
//!
//!     cargo run --release -p sixfold-detect --example detect_times -- WEIGHTS.safetensors IMAGE.png OUT [ROUNDS]
//!
//! Writes OUT/input.f32 (3 x height x width) and OUT/output.f32 (scores of every level, boxes of every level, prototypes, one
//! after the other; 32-bit floats of low end first) and prints one line of JSON, times in milliseconds.

use std::error::Error;
use std::path::Path;
use std::time::Instant;

use sixfold_detect::detect::NetworkImage;
use sixfold_detect::model::DetectorModel;
use sixfold_io::read_rgb;

/// Milliseconds of every call after the first.
fn times<T>(rounds: usize, mut call: impl FnMut() -> T) -> Vec<f64> {
    call();
    (0..rounds)
        .map(|_| {
            let start = Instant::now();
            call();
            1000.0 * start.elapsed().as_secs_f64()
        })
        .collect()
}

fn bytes<'a>(values: impl IntoIterator<Item = &'a f32>) -> Vec<u8> {
    values.into_iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let (weights, image, out, rounds) = match &args[..] {
        [weights, image, out] => (weights, image, out, 20),
        [weights, image, out, rounds] => (weights, image, out, rounds.parse()?),
        _ => return Err("usage: detect_times WEIGHTS.safetensors IMAGE.png OUT [ROUNDS]".into()),
    };
    let model = DetectorModel::load(Path::new(weights))?;
    let image = read_rgb(Path::new(image))?;
    let anchorless = model.anchorless().ok_or("a detector of torchvision")?;
    let input = NetworkImage::new(&image, anchorless.config(), model.usage().longest_side);
    let input = input.ok_or("an empty image")?;
    let numbers = anchorless.run(&input);
    let out = Path::new(out);
    std::fs::create_dir_all(out)?;
    std::fs::write(out.join("input.f32"), bytes(&input.values))?;
    let all = numbers.scores.iter().chain(&numbers.boxes).flatten().chain(&numbers.prototypes);
    std::fs::write(out.join("output.f32"), bytes(all))?;
    let options = model.options();
    let network = times(rounds, || anchorless.run(&input));
    let whole = times(rounds, || model.detect(&image, &options));
    let (width, height) = (input.width, input.height);
    println!(
        "{}",
        serde_json::json!({ "width": width, "height": height, "network": network, "whole": whole })
    );
    Ok(())
}
