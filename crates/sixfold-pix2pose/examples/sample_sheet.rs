//! Draws training samples to look at: colour, coordinates, silhouette and visible part side by side, and how long one
//! takes.
//!
//! ```text
//! sample_sheet DATASET SPLIT FRAMES OUT.png [BACKGROUND_FOLDER] [real|render|both] [OBJECT_IDS]
//! ```
//! `FRAMES` is `scene:image,image,...` (only these images are opened), or `scene:/N` for every N-th.

use std::error::Error;
use std::path::Path;
use std::time::Instant;

use sixfold_augment::{Backgrounds, PhotographOptions};
use sixfold_bop::{BopDataset, Models, write_rgb};
use sixfold_geometry::RgbImage;
use sixfold_mesh::ModelInfo;
use sixfold_pix2pose::samples::{Sample, SampleOptions, SampleSource, TrainingObject, read_real_crops};
use sixfold_render::BoundingBoxScale;

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
    let frames: Vec<(u32, u32)> = match images.strip_prefix('/') {
        Some(step) => {
            // Only frames whose picture is there count.
            let there = scene.image_ids().into_iter().filter(|id| scene.rgb_path(*id).is_some());
            there.step_by(step.parse::<usize>()?.max(1)).map(|id| (scene_id, id)).collect()
        }
        None => images
            .split(',')
            .map(|id| Ok((scene_id, id.parse()?)))
            .collect::<Result<_, std::num::ParseIntError>>()?,
    };
    let infos = dataset.models_info(Models::Rendering)?.unwrap_or_default();
    let ids: Vec<u32> = match rest.get(2) {
        Some(list) => list.split(',').map(str::parse).collect::<Result<_, _>>()?,
        None => infos.0.keys().copied().collect(),
    };
    let started = Instant::now();
    let real = read_real_crops(&dataset, &frames, &ids, 0.3)?;
    println!("{} frames, {} crops, {:.1} s", frames.len(), real.len(), started.elapsed().as_secs_f64());
    let mut objects = Vec::new();
    for &id in &ids {
        let mesh = dataset.model(id, Models::Rendering)?;
        let (low, high) = mesh.bounding_box();
        let scale = BoundingBoxScale::of_corners(&low, &high);
        let info = infos.0.get(&id).cloned().unwrap_or_else(|| ModelInfo::of_mesh(&mesh));
        objects.push(TrainingObject { id, mesh, info, scale });
    }
    let backgrounds = match rest.first().filter(|folder| *folder != "-") {
        Some(folder) => {
            Backgrounds::from_folder(folder, &PhotographOptions::default())?.with_procedural_share(0.1)
        }
        None => Backgrounds::procedural(),
    };
    let render_share = match rest.get(1).map(String::as_str) {
        Some("real") => 0.0,
        Some("render") => 1.0,
        _ => 0.5,
    };
    let options = SampleOptions { target_size: Some(64), render_share, ..SampleOptions::default() };
    let started = Instant::now();
    let source = SampleSource::new(objects, real, backgrounds, options)?;
    println!("{source:?}\nready after {:.1} s", started.elapsed().as_secs_f64());

    const COLUMNS: usize = 8;
    const ROWS: usize = 8;
    let size = source.options().size;
    let target = source.options().target();
    // Colour and coordinates above, coordinates over colour and both masks below.
    let mut sheet = RgbImage::filled(COLUMNS * (2 * size + 8), ROWS * (size + 8), [255; 3]);
    for i in 0..COLUMNS * ROWS {
        let sample = source.sample(i % source.objects(), 1, i as u64);
        let (left, top) = (i % COLUMNS * (2 * size + 8), i / COLUMNS * (size + 8));
        draw(&mut sheet, left, top, size, target, &sample);
    }
    write_rgb(Path::new(out), &sheet)?;

    let count = 400u64;
    let started = Instant::now();
    let sum: f32 = (0..count).map(|n| source.sample(n as usize % source.objects(), 2, n).rgb[0]).sum();
    let ms = started.elapsed().as_secs_f64() * 1e3 / count as f64;
    println!("{ms:.2} ms per sample on one thread ({sum:.1})");
    Ok(())
}

/// Left: the input. Right: coordinates; silhouette in red with its visible part in green; the input dimmed where the
/// object is not visible.
fn draw(sheet: &mut RgbImage, left: usize, top: usize, size: usize, target: usize, sample: &Sample) {
    let byte = |v: f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
    let rgb = |x: usize, y: usize| -> [u8; 3] {
        std::array::from_fn(|c| byte(sample.rgb[c * size * size + y * size + x]))
    };
    let half = size / 2;
    for y in 0..size {
        for x in 0..size {
            sheet[(left + x, top + y)] = rgb(x, y);
            let (qx, qy) = (x % half, y % half);
            let (u, v) = (qx * target / half, qy * target / half);
            let at = v * target + u;
            let coordinate =
                || std::array::from_fn(|c| byte(0.5 * (sample.coordinates[c * target * target + at] + 1.0)));
            let color = match (x < half, y < half) {
                (true, true) => coordinate(),
                (false, true) => [byte(sample.object[at]), byte(sample.visible[at]), 0],
                (true, false) => {
                    let c = rgb(qx * 2, qy * 2);
                    if sample.visible[at] > 0.5 { c } else { c.map(|v| v / 4) }
                }
                (false, false) => {
                    let inside = |u: usize, v: usize| {
                        sample.object[v.min(target - 1) * target + u.min(target - 1)] > 0.5
                    };
                    let border = inside(u, v) != inside(u + 1, v) || inside(u, v) != inside(u, v + 1);
                    if border { [255, 0, 255] } else { rgb(qx * 2, qy * 2) }
                }
            };
            sheet[(left + size + x, top + y)] = color;
        }
    }
}
