//! Times a model at the size of the dissertation's renderings, and measures it beside averaging: `render_speed MODEL.safetensors
//! [PHOTOGRAPHS [published]]`; with `published` on the test views of `sixfold train nol --preset published`.

use std::path::Path;
use std::time::Instant;

use sixfold_nol::model::NolModel;
use sixfold_nol::quality::{QualityOptions, quality};
use sixfold_nol::recipe::NolKind;
use sixfold_nol::samples::{ViewSampleOptions, make_sample};
use sixfold_synth::augment::{Backgrounds, PhotographOptions};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let Some(file) = arguments.next() else { return Err("expected a model file".into()) };
    let model = NolModel::load(Path::new(&file))?;
    let textures = match arguments.next() {
        Some(folder) => Backgrounds::from_folder(folder, &PhotographOptions::default())?,
        None => Backgrounds::procedural(),
    };
    let published = arguments.next().is_some_and(|preset| preset == "published");
    let (textures, options) = if published {
        (textures.with_procedural_fraction(0.0), NolKind::Paper.options().samples)
    } else {
        (textures, ViewSampleOptions::default())
    };
    for sources in [1, 6, 16] {
        let sample = make_sample(&textures, &options, 256, sources, 1, 0);
        let began = Instant::now();
        let features = model.encode(&sample.sources);
        let encoded = began.elapsed().as_secs_f64();
        let times: Vec<f64> = (0..3)
            .map(|_| {
                let began = Instant::now();
                let rendering = model.render(&sample.surface, &sample.sources, &features);
                assert_eq!(rendering.colours.len(), sample.surface.points.len());
                began.elapsed().as_secs_f64()
            })
            .collect();
        let best = times.iter().copied().fold(f64::INFINITY, f64::min);
        println!(
            "{sources} sources of 256x256: encoded in {encoded:.3} s, {} pixels rendered in {best:.3} s",
            sample.surface.points.len()
        );
    }
    for (side, sources) in [(128, 6), (256, 6)] {
        let measured = quality(
            &model,
            &textures,
            &options,
            &QualityOptions { side, sources, ..QualityOptions::default() },
        )?;
        println!("{side} pixels, {sources} sources: {:#?}", measured.scores());
    }
    Ok(())
}
