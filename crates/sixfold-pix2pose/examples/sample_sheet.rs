//! Draws training samples to look at: colour, coordinates, silhouette and visible part side by side, and how long one
//! takes.
//!
//! ```text
//! sample_sheet DATASET SPLIT FRAMES OUT.png [BACKGROUND_FOLDER|-] [real|render|both] [OBJECT_IDS|-] [close]
//! ```
//! `close` draws few samples large, without changes of colour, occluders and second stage: to check borders.
//! `FRAMES` is `scene:image,image,...` (only these images are opened), or `scene:/N` for every N-th.

use sixfold_bop::{BopDataset, Models};
use sixfold_data::{FrameId, TrainingObject, read_posed_images};
use sixfold_geometry::RgbImage;
use sixfold_io::write_rgb;
use sixfold_mesh::ModelInfo;
use sixfold_pix2pose::samples::{Sample, SampleOptions, SampleSource};
use sixfold_synth::augment::{Backgrounds, ColorAugmentation, PhotographOptions};
use std::error::Error;
use std::path::Path;
use std::time::Instant;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [dataset, split, frames, out, rest @ ..] = arguments.as_slice() else {
        return Err(
            "usage: sample_sheet DATASET SPLIT SCENE:IMAGES OUT.png [BACKGROUNDS] [real|render|both] [IDS]"
                .into(),
        );
    };
    let dataset = BopDataset::open(Path::new(dataset), split)?;
    let (scene_id, images) = frames.split_once(':').ok_or("frames look like 2:3,17,36 or 2:/6")?;
    let scene_id: u32 = scene_id.parse()?;
    let scene = dataset.scene(scene_id)?;
    let frames: Vec<FrameId> = match images.strip_prefix('/') {
        Some(step) => {
            // Only frames whose image is there count.
            let there = scene.image_ids().into_iter().filter(|id| scene.rgb_path(*id).is_some());
            there.step_by(step.parse::<usize>()?.max(1)).map(|im_id| FrameId { scene_id, im_id }).collect()
        }
        None => images
            .split(',')
            .map(|id| Ok(FrameId::new(scene_id, id.parse()?)))
            .collect::<Result<_, std::num::ParseIntError>>()?,
    };
    let infos = dataset.models_info(Models::Rendering)?.unwrap_or_default();
    let ids: Vec<u32> = match rest.get(2).filter(|list| *list != "-") {
        Some(list) => list.split(',').map(str::parse).collect::<Result<_, _>>()?,
        None => infos.0.keys().copied().collect(),
    };
    let started = Instant::now();
    let real = read_posed_images(&dataset, &frames, &ids, 0.3)?;
    println!("{} frames, {} crops, {:.1} s", frames.len(), real.len(), started.elapsed().as_secs_f64());
    let mut objects = Vec::new();
    for &id in &ids {
        let mesh = dataset.model(id, Models::Rendering)?;
        let info = infos.0.get(&id).cloned().unwrap_or_else(|| ModelInfo::of_mesh(&mesh));
        objects.push(TrainingObject::new(id, mesh, info));
    }
    let backgrounds = match rest.first().filter(|folder| *folder != "-") {
        Some(folder) => {
            Backgrounds::from_folder(folder, &PhotographOptions::default())?.with_procedural_fraction(0.1)
        }
        None => Backgrounds::procedural(),
    };
    let render_fraction = match rest.get(1).map(String::as_str) {
        Some("real") => 0.0,
        Some("render") => 1.0,
        _ => 0.5,
    };
    let close = rest.get(3).is_some_and(|word| word == "close");
    let mut options = SampleOptions { target_size: Some(64), render_fraction, ..SampleOptions::default() };
    if close {
        options.color = ColorAugmentation::none();
        options.render_color = ColorAugmentation::none();
        options.occlusion_probability = 0.0;
        options.second_stage_fraction = 0.0;
    }
    let started = Instant::now();
    let source = SampleSource::new(objects, real, backgrounds, options)?;
    println!("{source:?}\nready after {:.1} s", started.elapsed().as_secs_f64());

    let size = source.options().size;
    let target = source.options().target();
    let (columns, rows, zoom) = if close { (3, 4, 3) } else { (8, 8, 1) };
    let mut sheet = RgbImage::filled(columns * (2 * size * zoom + 8), rows * (size * zoom + 8), [255; 3]);
    for i in 0..columns * rows {
        let sample = source.sample(i % source.objects(), 1, i as u64);
        let drawn = if close { outlined(size, target, &sample) } else { quarters(size, target, &sample) };
        let (left, top) = (i % columns * (2 * size * zoom + 8), i / columns * (size * zoom + 8));
        for y in 0..size * zoom {
            for x in 0..2 * size * zoom {
                sheet[(left + x, top + y)] = drawn[(x / zoom, y / zoom)];
            }
        }
    }
    write_rgb(Path::new(out), &sheet)?;

    let count = 400u64;
    let started = Instant::now();
    let sum: f32 = (0..count).map(|n| source.sample(n as usize % source.objects(), 2, n).rgb[0]).sum();
    let ms = started.elapsed().as_secs_f64() * 1e3 / count as f64;
    println!("{ms:.2} ms per sample on one thread ({sum:.1})");
    Ok(())
}

fn byte(v: f32) -> u8 {
    (v.clamp(0.0, 1.0) * 255.0).round() as u8
}

fn color(sample: &Sample, size: usize, x: usize, y: usize) -> [u8; 3] {
    std::array::from_fn(|c| byte(sample.rgb[c * size * size + y * size + x]))
}

fn coordinate(sample: &Sample, target: usize, at: usize) -> [u8; 3] {
    std::array::from_fn(|c| byte(0.5 * (sample.coordinates[c * target * target + at] + 1.0)))
}

/// Whether the silhouette ends right of or below a target pixel.
fn border(sample: &Sample, target: usize, u: usize, v: usize) -> bool {
    let inside = |u: usize, v: usize| sample.object[v.min(target - 1) * target + u.min(target - 1)] > 0.5;
    inside(u, v) != inside(u + 1, v) || inside(u, v) != inside(u, v + 1)
}

/// Left: the input. Right: coordinates; silhouette in red, its visible part in yellow; the input dimmed where the object
/// is not visible; the input with the silhouette's outline.
fn quarters(size: usize, target: usize, sample: &Sample) -> RgbImage {
    let half = size / 2;
    RgbImage::from_fn(2 * size, size, |x, y| {
        if x < size {
            return color(sample, size, x, y);
        }
        let x = x - size;
        let (qx, qy) = (x % half, y % half);
        let (u, v) = (qx * target / half, qy * target / half);
        let at = v * target + u;
        let small = color(sample, size, qx * 2, qy * 2);
        match (x < half, y < half) {
            (true, true) => coordinate(sample, target, at),
            (false, true) => [byte(sample.object[at]), byte(sample.visible[at]), 0],
            (true, false) if sample.visible[at] > 0.5 => small,
            (true, false) => small.map(|v| v / 4),
            (false, false) if border(sample, target, u, v) => [255, 0, 255],
            (false, false) => small,
        }
    })
}

/// Left: the input with the outline of the silhouette. Right: coordinates over the input where the object is visible.
fn outlined(size: usize, target: usize, sample: &Sample) -> RgbImage {
    RgbImage::from_fn(2 * size, size, |x, y| {
        let (px, left) = (x % size, x < size);
        let (u, v) = (px * target / size, y * target / size);
        let input = color(sample, size, px, y);
        if left {
            return if border(sample, target, u, v) { [255, 0, 255] } else { input };
        }
        if sample.visible[v * target + u] > 0.5 { coordinate(sample, target, v * target + u) } else { input }
    })
}
