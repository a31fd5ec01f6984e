//! Imitates the input of the second stage: everything outside the object's mask from the first stage is grey (dissertation, section
//! 3.3). The first stage makes errors, so the mask is perturbed: its border grows, shrinks and varies, rectangles are missing or
//! added, and there are holes.

use rand::RngExt;
use sixfold_geometry::random::{Random, uniform};
use sixfold_synth::augment::{Coverage, Patch};

/// Value of masked-out pixels, in images of 0..1.
pub(crate) const GREY: f32 = 0.5;

/// Greys out everything outside a perturbed form of `visible`; `whole` is the silhouette with its hidden parts, which the first
/// stage sometimes keeps.
pub(super) fn imitate(image: &mut Patch, visible: &Coverage, whole: &Coverage, random: &mut Random) {
    let side = image.width as f32;
    let scale = side / 128.0;
    let base = if random.random::<f32>() < 0.25 { whole } else { visible };
    let grow = uniform(random, [-2.0, 5.0]) * scale;
    let wobble = uniform(random, [0.3, 4.0]) * scale;
    let mut kept = base.disturbed(grow, wobble, random);
    let before = common(&kept, visible);
    let mut cut = kept.clone();
    if random.random::<f32>() < 0.4 {
        fill(&mut cut, 0.5, 0.0, random);
    }
    if random.random::<f32>() < 0.25 {
        // Holes where a noise field, fine compared with the object, is high.
        let field = Coverage::filled(kept.width, kept.height, 0.5);
        let holes = field.disturbed(-uniform(random, [1.5, 3.5]) * scale, 4.0 * scale, random);
        cut.remove(&holes);
    }
    // The remaining part must be large enough to determine a pose.
    if common(&cut, visible) > 0.4 * before {
        kept = cut;
    }
    if random.random::<f32>() < 0.4 {
        fill(&mut kept, 0.4, 1.0, random);
    }
    let pixels = image.width * image.height;
    for plane in image.data.chunks_exact_mut(pixels.max(1)) {
        plane.iter_mut().zip(&kept.data).for_each(|(v, k)| *v = GREY + (*v - GREY) * k);
    }
}

fn common(a: &Coverage, b: &Coverage) -> f32 {
    a.data.iter().zip(&b.data).map(|(a, b)| a * b).sum()
}

/// Sets a random rectangle with sides of at most the fraction `largest` of the crop.
fn fill(mask: &mut Coverage, largest: f32, value: f32, random: &mut Random) {
    let mut span = |size: usize| {
        let length = uniform(random, [0.05, largest]) * size as f32;
        let start = uniform(random, [0.0, size as f32 - length]);
        start as usize..((start + length) as usize).min(size)
    };
    let (columns, rows) = (span(mask.width), span(mask.height));
    for y in rows {
        mask.data[y * mask.width..(y + 1) * mask.width][columns.clone()].fill(value);
    }
}
