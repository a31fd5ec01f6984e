//! Detections of Faster R-CNN, Mask R-CNN or RetinaNet with given torchvision weights, for `checks/anchored_vs_torchvision.py`.
//!
//! `anchored_outputs WEIGHTS NORM_EPSILON|- OUTPUT.safetensors IMAGE ..`: the output holds of every image, under its number, `boxes`
//! (`count x 4`), `scores`, `labels`, the `masks` (`count x 28 x 28`) and the masks `pasted` into the image (`count x rows x columns`)
//! of a network that has them, and the `seconds` that it took.

use std::collections::BTreeMap;
use std::error::Error;
use std::path::Path;
use std::time::Instant;

use safetensors::tensor::{Dtype, TensorView};
use sixfold_detect::anchored::{AnchoredDetection, AnchoredNetwork, MASK_SIDE};

type Outputs = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [weights, epsilon, output, images @ ..] = arguments.as_slice() else {
        return Err("expected WEIGHTS NORM_EPSILON OUTPUT.safetensors IMAGE ..".into());
    };
    let epsilon = if epsilon == "-" { None } else { Some(epsilon.parse()?) };
    let network = AnchoredNetwork::recognised(Path::new(weights), |config| {
        config.norm_epsilon = epsilon.unwrap_or(config.norm_epsilon);
    })?;
    let network = network.ok_or("none of the three networks")?;
    let thresholds = network.config().thresholds();
    let mut outputs = Outputs::new();
    for (number, file) in images.iter().enumerate() {
        let image = sixfold_io::read_rgb(Path::new(file))?;
        let start = Instant::now();
        let found = network.detect(&image, &thresholds, true);
        let seconds = start.elapsed().as_secs_f32();
        outputs.insert(format!("{number} seconds"), (vec![1], vec![seconds]));
        keep(&mut outputs, number, &found, image.size());
    }
    write(&outputs, Path::new(output))
}

fn keep(outputs: &mut Outputs, number: usize, found: &[AnchoredDetection], size: (usize, usize)) {
    let count = found.len();
    let mut put = |name: &str, shape: Vec<usize>, values: Vec<f32>| {
        outputs.insert(format!("{number} {name}"), (shape, values));
    };
    put("boxes", vec![count, 4], found.iter().flat_map(|d| d.corners).collect());
    put("scores", vec![count], found.iter().map(|d| d.score).collect());
    put("labels", vec![count], found.iter().map(|d| d.label as f32).collect());
    let masks = found.iter().filter_map(|d| d.mask.as_ref());
    let values: Vec<f32> = masks.flat_map(|m| m.values.iter().copied()).collect();
    if values.is_empty() {
        return;
    }
    put("masks", vec![count, MASK_SIDE, MASK_SIDE], values);
    let mut pasted = vec![0.0; count * size.0 * size.1];
    for (d, image) in found.iter().zip(pasted.chunks_exact_mut(size.0 * size.1)) {
        let Some(mask) = &d.mask else { continue };
        let part = mask.pasted(&d.corners, size);
        for (row, values) in part.values.chunks_exact(part.size[0].max(1)).enumerate() {
            let first = (part.corner[1] + row) * size.0 + part.corner[0];
            image[first..first + values.len()].copy_from_slice(values);
        }
    }
    put("pasted", vec![count, size.1, size.0], pasted);
}

fn write(outputs: &Outputs, path: &Path) -> Result<(), Box<dyn Error>> {
    let bytes: Vec<(&String, &Vec<usize>, Vec<u8>)> = outputs
        .iter()
        .map(|(name, (shape, values))| (name, shape, values.iter().flat_map(|v| v.to_le_bytes()).collect()))
        .collect();
    let mut views = Vec::new();
    for (name, shape, bytes) in &bytes {
        views.push((*name, TensorView::new(Dtype::F32, (*shape).clone(), bytes)?));
    }
    std::fs::write(path, safetensors::serialize(views, None)?)?;
    Ok(())
}
