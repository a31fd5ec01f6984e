//! The same frames with exact poses: the coloured models rendered over images of other frames, under a lamp above the first
//! object (so it stays at the same place relative to the object when the camera moves), and with table 4.1's colour
//! augmentation.
//!
//! Annotated poses of real photographs have errors of some pixels, so no measured error can be smaller than these. Exact
//! poses are known only for rendered objects.

use std::path::Path;
use std::sync::Arc;

use anyhow::Result;
use sixfold_geometry::random::{Random, stream, uniform};
use sixfold_geometry::{RgbImage, Vec3};
use sixfold_io::write_rgb;
use sixfold_render::{Light, Material as Surface, RenderOptions, SceneObject, VisibilityBuffer, shade};
use sixfold_synth::augment::{Backgrounds, ColorAugmentation, Coverage, Patch};

use super::material::{Material, PosedFrame};

/// Each pixel is rendered as a square of this many by this many pixels.
const FINE: usize = 2;
/// Blur of the lens and the sensor's mosaic, pixels.
const LENS: f32 = 0.7;

/// The material with rendered sources; targets and poses stay.
pub(super) fn drawn(material: &Material, seed: u64) -> Result<Material> {
    let others = material.targets.iter().map(|f| f.image.clone()).collect();
    let backgrounds = Backgrounds::from_images(others)?;
    let sources = material.sources.iter().enumerate().map(|(number, frame)| {
        let random = &mut stream(seed, number as u64);
        let image = Arc::new(draw(material, frame, &backgrounds, random));
        PosedFrame { image, truth: frame.truth.clone(), ..*frame }
    });
    Ok(Material { meshes: material.meshes.clone(), sources: sources.collect(), targets: vec![] })
}

/// Writes an image of all rendered frames at half their size.
pub(super) fn picture(drawn: &Material, file: &Path) -> Result<()> {
    const COLUMNS: usize = 4;
    let size = |of: fn(&RgbImage) -> usize| drawn.sources.iter().map(|f| of(&f.image) / 2).max().unwrap_or(0);
    let (width, height) = (size(RgbImage::width), size(RgbImage::height));
    let columns = drawn.sources.len().min(COLUMNS);
    let sheet = RgbImage::from_fn(columns * width, drawn.sources.len().div_ceil(COLUMNS) * height, |x, y| {
        let frame = drawn.sources.get(y / height * COLUMNS + x / width);
        frame.and_then(|f| f.image.get(2 * (x % width), 2 * (y % height))).copied().unwrap_or([255; 3])
    });
    Ok(write_rgb(file, &sheet)?)
}

fn draw(material: &Material, frame: &PosedFrame, backgrounds: &Backgrounds, random: &mut Random) -> RgbImage {
    let (width, height) = (frame.camera.width, frame.camera.height);
    let mut picture = backgrounds.patch(width, height, random);
    let camera = frame.camera.without_distortion().resize(FINE * width, FINE * height);
    let objects: Vec<SceneObject<'_>> = frame
        .truth
        .iter()
        .map(|(id, pose)| SceneObject { mesh: &material.meshes[id], camera_from_object: *pose })
        .collect();
    let mut fine = VisibilityBuffer::new(&camera);
    fine.render(&objects, &RenderOptions::default());
    // The room's lamp: above the first object, whose z axis points up, and a little to its side.
    let down = -Vec3::new(0.4, 0.3, 1.0);
    let direction = frame.truth.first().map_or(Vec3::z(), |(_, pose)| pose.transform_direction(&down));
    let lights = [
        Light::Ambient { color: [uniform(random, [0.5, 0.7]); 3] },
        Light::Directional { direction, color: [uniform(random, [0.4, 0.6]); 3] },
    ];
    let surface = Surface { specular: 0.2, ..Surface::default() };
    let colors = Patch::from_rgb(&shade(&fine, &objects, &lights, &surface, None));
    let covered: Vec<f32> = fine.inverse_depth().iter().map(|z| f32::from(u8::from(*z > 0.0))).collect();
    let coverage = Coverage { width, height, data: coarse(&covered, width, height) };
    let mut over = Patch::filled(width, height, [0.0; 3]);
    for (plane, fine) in over.planes_mut().zip(colors.data.chunks_exact(covered.len())) {
        // Pixels that are not covered are black and contribute nothing.
        plane.copy_from_slice(&coarse(fine, width, height));
        plane.iter_mut().zip(&coverage.data).filter(|(_, c)| **c > 0.0).for_each(|(v, c)| *v /= c);
    }
    picture.blend(&over, &coverage);
    picture.blur(LENS);
    ColorAugmentation::table_4_1().apply(&mut picture, random);
    picture.to_rgb()
}

/// Means over squares of [`FINE`] pixels.
fn coarse(plane: &[f32], width: usize, height: usize) -> Vec<f32> {
    let stride = FINE * width;
    (0..width * height)
        .map(|i| {
            let first = i / width * FINE * stride + i % width * FINE;
            let sum: f32 = (0..FINE * FINE).map(|k| plane[first + k / FINE * stride + k % FINE]).sum();
            sum / (FINE * FINE) as f32
        })
        .collect()
}
