//! A sheet of training images with their boxes and masks, and how long they take to make.
//!
//!     cargo run --release -p sixfold-detect --example scene_sheet -- DATASET FRAMES.json BACKGROUNDS OUT.png
//!     cargo run --release -p sixfold-detect --example scene_sheet -- BACKGROUNDS OUT.png   # those of proposals

use sixfold_bop::{BopDataset, Models};
use sixfold_data::{FrameId, TrainingObject, read_posed_images};
use sixfold_detect::proposals::ProposalsRecipe;
use sixfold_detect::samples::{TrainingImageOptions, TrainingImageSource};
use sixfold_detect::training::sample_time;
use sixfold_geometry::{Image, RgbImage};
use sixfold_io::write_rgb;
use sixfold_synth::augment::{Backgrounds, PhotographOptions};
use std::error::Error;
use std::path::Path;

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    if let [backgrounds, out] = &args[..] {
        let recipe = ProposalsRecipe { backgrounds: Some(backgrounds.into()), ..ProposalsRecipe::default() };
        return sheet(&recipe.source()?, Path::new(out));
    }
    let [dataset, frames, backgrounds, out] = &args[..] else {
        return Err("usage: scene_sheet [DATASET FRAMES.json] BACKGROUNDS OUT.png".into());
    };
    let dataset = BopDataset::open(Path::new(dataset), "test")?;
    let frames: Vec<FrameId> = serde_json::from_slice(&std::fs::read(frames)?)?;
    let infos = dataset.models_info(Models::Rendering)?.unwrap_or_default();
    let ids: Vec<u32> = infos.0.keys().copied().collect();
    let real = read_posed_images(&dataset, &frames, &ids, 0.0)?;
    let cut = read_posed_images(&dataset, &frames, &ids, 0.6)?;
    let objects = ids
        .iter()
        .map(|id| {
            let mesh = dataset.model(*id, Models::Rendering)?;
            Ok(TrainingObject::new(*id, mesh, infos.0[id].clone()))
        })
        .collect::<Result<Vec<_>, Box<dyn Error>>>()?;
    let backgrounds = Backgrounds::from_folder(backgrounds, &PhotographOptions::default())?;
    println!("{} instances in photographs, {} to cut out", real.len(), cut.len());
    let source = TrainingImageSource::new(
        objects,
        &real,
        &cut,
        backgrounds.with_procedural_fraction(0.15),
        TrainingImageOptions::default(),
    )?;
    sheet(&source, Path::new(out))
}

fn sheet(source: &TrainingImageSource, out: &Path) -> Result<(), Box<dyn Error>> {
    println!("{:.1} ms per image on all threads", sample_time(source, 60));
    let side = source.options().size;
    let (columns, rows) = (6, 4);
    let mut sheet: RgbImage = Image::filled(columns * side, rows * side, [0; 3]);
    for number in 0..columns * rows {
        let sample = source.sample(0, number as u64);
        let (x0, y0) = (number % columns * side, number / columns * side);
        for y in 0..side {
            for x in 0..side {
                let at = y * side + x;
                let mut rgb = [0, 1, 2].map(|c| (sample.rgb[c * side * side + at] * 255.0) as u8);
                let label = sample.annotation.labels[at];
                if label > 0 {
                    let tint = [label.wrapping_mul(83), label.wrapping_mul(151), label.wrapping_mul(199)];
                    rgb = [0, 1, 2].map(|c| (u16::from(rgb[c]) * 3 / 4 + u16::from(tint[c]) / 4) as u8);
                }
                sheet[(x0 + x, y0 + y)] = rgb;
            }
        }
        for instance in &sample.annotation.instances {
            let [l, t, r, b] = instance.corners.map(|v| v as usize);
            for x in l..=r {
                sheet[(x0 + x, y0 + t)] = [255, 255, 0];
                sheet[(x0 + x, y0 + b)] = [255, 255, 0];
            }
            for y in t..=b {
                sheet[(x0 + l, y0 + y)] = [255, 255, 0];
                sheet[(x0 + r, y0 + y)] = [255, 255, 0];
            }
        }
    }
    Ok(write_rgb(out, &sheet)?)
}
