//! Occluders that appear in some photographs and are not in any mask: where the colour of one photograph differs from that on which
//! the others agree, the pixels are removed from its visible part.
//!
//! This goes beyond the dissertation, whose network must learn to give such pixels a low weight.

use rayon::prelude::*;
use sixfold_mesh::Mesh;

use crate::maps::Maps;
use crate::refine::{Common, Light, PointSamples, sample_points};
use crate::source::SourceView;
use crate::surface::outwards;

/// Points of the surface that are compared.
const POINTS: usize = 6000;
/// Blur of the colours, crop pixels.
const BLUR: f32 = 2.0;
/// Difference in colour (root of the mean square over channels, 0 to 1) from which a photograph shows another object.
const OTHER: f32 = 0.13;
/// Smallest total weight of the other photographs at a point that is compared.
const MIN_OPINION: f32 = 1.2;

/// Removes pixels that do not agree with the other sources from the visible parts of `sources`, whose poses should already be
/// refined. Returns the fraction of each source's visible points that was removed.
pub fn leave_out_what_differs(sources: &mut [SourceView], mesh: &Mesh) -> Vec<f64> {
    let surface = mesh.sample_surface(POINTS, 1);
    let normals = outwards(mesh, &surface.normals);
    let raw: Vec<PointSamples> = sources
        .par_iter()
        .map(|source| {
            let maps = Maps::of_patch(&source.patch, BLUR);
            let allowed: Vec<f32> =
                source.visible.data.iter().map(|v| f32::from(u8::from(*v > 0.5))).collect();
            sample_points(source, &maps, &allowed, &surface.points, &normals)
        })
        .collect();
    let mut lit = raw.clone();
    for _ in 0..2 {
        let common = Common::new(&lit, 3);
        let lights: Vec<Light> = (0..raw.len())
            .into_par_iter()
            .map(|k| {
                let (target, known) = common.without(k, &lit[k]);
                Light::fit(&raw[k], &target, &known, 3)
            })
            .collect();
        for ((lit, raw), light) in lit.iter_mut().zip(&raw).zip(&lights) {
            lit.values.clone_from(&raw.values);
            light.apply(&mut lit.values);
        }
    }
    let common = Common::new(&lit, 3);
    sources
        .iter_mut()
        .enumerate()
        .map(|(k, source)| {
            let (target, known) = common.without(k, &lit[k]);
            let side = source.side();
            let (mut seen, mut out) = (0usize, 0usize);
            // Votes of the points around every pixel, for and against.
            let mut votes = vec![[0.0f32; 2]; side * side];
            let reach = (side as f32 / 40.0).ceil() as isize;
            for (i, (point, normal)) in surface.points.iter().zip(&normals).enumerate() {
                if lit[k].weights[i] <= 0.0 || known[i] < MIN_OPINION {
                    continue;
                }
                let Some(([x, y], _)) = source.see(point, normal) else { continue };
                let square: f32 =
                    (0..3).map(|c| (lit[k].values[3 * i + c] - target[3 * i + c]).powi(2)).sum();
                let other = (square / 3.0).sqrt() > OTHER;
                seen += 1;
                out += usize::from(other);
                let (x, y) = (x.round() as isize, y.round() as isize);
                for v in (y - reach).max(0)..=(y + reach).min(side as isize - 1) {
                    for u in (x - reach).max(0)..=(x + reach).min(side as isize - 1) {
                        let square = ((u - x).pow(2) + (v - y).pow(2)) as f32;
                        let weight = (-2.0 * square / (reach * reach) as f32).exp();
                        votes[v as usize * side + u as usize][usize::from(other)] += weight;
                    }
                }
            }
            for (visible, [same, other]) in source.visible.data.iter_mut().zip(&votes) {
                if *other > *same {
                    *visible = 0.0;
                }
            }
            out as f64 / seen.max(1) as f64
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use sixfold_data::PosedImage;

    use super::*;
    use crate::refine::tests::photographs;

    #[test]
    fn occluders_in_one_photograph_are_left_out() {
        let (mesh, truth, list) = photographs(40, [0.0, 0.0], 5);
        // A bright occluder hides half of the block in the first one.
        let side = 96;
        let centre = list[0].camera().project(&truth[0].translation()).unwrap().x;
        let mut image = (**list[0].image()).clone();
        for (x, y) in (0..240).flat_map(|y| (0..320).map(move |x| (x, y))) {
            if (x as f64) < centre {
                image[(x, y)] = [250, 250, 20];
            }
        }
        let first = PosedImage::new("0", 1, Arc::new(image), *list[0].camera(), truth[0]).unwrap();
        let mut views: Vec<SourceView> = std::iter::once(&first)
            .chain(&list[1..])
            .map(|p| SourceView::new(p, &mesh, side).unwrap())
            .collect();
        let before: Vec<Vec<f32>> = views.iter().map(|v| v.visible.data.clone()).collect();
        let fractions = leave_out_what_differs(&mut views, &mesh);
        assert!((0.3..0.7).contains(&fractions[0]), "{fractions:?}");
        assert!(fractions[1..].iter().all(|s| *s < 0.08), "{fractions:?}");
        // Left of the centre the pixels are removed, right of it they are kept, and outside the object nothing changes.
        let view = &views[0];
        let column = view.camera.project(&truth[0].translation()).unwrap().x;
        let fraction = |wanted: &dyn Fn(usize) -> bool| {
            let pixels: Vec<usize> = (0..side * side).filter(|i| wanted(*i)).collect();
            let kept = pixels.iter().filter(|i| view.visible.data[**i] > 0.5).count();
            kept as f64 / pixels.len() as f64
        };
        let on = |i: usize| view.depth()[i] > 0.0;
        let left = |i: usize| ((i % side) as f64) < column - 6.0;
        let right = |i: usize| ((i % side) as f64) > column + 6.0;
        assert!(fraction(&|i| on(i) && left(i)) < 0.1, "{}", fraction(&|i| on(i) && left(i)));
        assert!(fraction(&|i| on(i) && right(i)) > 0.9, "{}", fraction(&|i| on(i) && right(i)));
        let corner = |i: usize| i % side > side - 4 && i / side < 3 && before[0][i] > 0.5;
        assert!((fraction(&corner) - 1.0).abs() < 1e-9, "beside the object nothing is taken out");
    }
}
