//! Masks of what is salient in photographs with the shipped U2-Net-p, beside true masks, and how long one image takes.
//!
//! ```text
//! salience FOLDER [SCORES.json]
//! ```
//!
//! `FOLDER` holds a folder for each photograph with `rgb.png` and `mask.png`. The table says for each the intersection over union of the
//! mask (above 0.5 after stretching to 0 to 1) with the true one, and the network's largest answer; `SCORES.json` gets the values for
//! `checks/convert_u2netp.py --scores`. The time is the best of five after one, from the image to its map.

use std::collections::BTreeMap;
use std::error::Error;
use std::fs;
use std::path::PathBuf;
use std::time::Instant;

use burn::tensor::Device;
use sixfold_geometry::Mask;
use sixfold_io::{read_mask, read_rgb};
use sixfold_nn::salient::SalientNetwork;

fn iou(a: &Mask, b: &Mask) -> f64 {
    let pairs = || a.as_slice().iter().zip(b.as_slice());
    pairs().filter(|(a, b)| **a && **b).count() as f64 / pairs().filter(|(a, b)| **a || **b).count() as f64
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<PathBuf> = std::env::args().skip(1).map(PathBuf::from).collect();
    let (folder, scores_file) = match arguments.as_slice() {
        [folder] => (folder, None),
        [folder, scores] => (folder, Some(scores)),
        _ => return Err("usage: salience FOLDER [SCORES.json]".into()),
    };
    let network = SalientNetwork::shipped(&Device::default())?;
    let mut folders: Vec<PathBuf> =
        fs::read_dir(folder)?.map(|e| Ok(e?.path())).collect::<Result<_, std::io::Error>>()?;
    folders.retain(|f| f.join("rgb.png").is_file() && f.join("mask.png").is_file());
    folders.sort();
    let mut scores = BTreeMap::new();
    let mut best = f64::INFINITY;
    println!("| photograph | IoU | largest answer |\n|---|---|---|");
    for folder in &folders {
        let (image, truth) = (read_rgb(&folder.join("rgb.png"))?, read_mask(&folder.join("mask.png"))?);
        let seen = network.salience(&image)?;
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let score = iou(&seen.mask(0.5), &truth);
        println!("| {name} | {score:.3} | {:.3} |", seen.highest);
        scores.insert(format!("intersection over union, {name}"), score);
        if best.is_infinite() {
            for _ in 0..5 {
                let start = Instant::now();
                network.salience(&image)?;
                best = best.min(start.elapsed().as_secs_f64());
            }
        }
    }
    if scores.is_empty() {
        return Err(
            format!("{}: expected folders with rgb.png and mask.png, found none", folder.display()).into()
        );
    }
    let mean = scores.values().sum::<f64>() / scores.len() as f64;
    println!("| mean of {} | {mean:.3} | |\n\none image: {best:.3} s", scores.len());
    scores.insert("intersection over union, mean".to_owned(), mean);
    scores.values_mut().for_each(|score| *score = (*score * 1e4).round() / 1e4);
    if let Some(path) = scores_file {
        fs::write(path, serde_json::to_string_pretty(&scores)?)?;
    }
    Ok(())
}
