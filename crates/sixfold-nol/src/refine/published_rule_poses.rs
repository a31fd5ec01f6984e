//! The dissertation's refinement for all photographs of an object: a first rendering of each photograph's own view from itself and
//! the others, then [`published_rule`] against it.

use rayon::prelude::*;
use sixfold_data::PosedImage;
use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::Mesh;

use super::published::{PublishedRuleOptions, published_rule};
use crate::error::NolError;
use crate::features::SourceFeatures;
use crate::maps::Maps;
use crate::model::NolModel;
use crate::projection::TargetSurface;
use crate::select::{choose_by_surface, shown_points};
use crate::source::SourceView;
use crate::surface::outwards;

/// Points of the surface by which sources are chosen.
const POINTS: usize = 3000;

/// New poses of photographs of one object by the published rule, in their order, with the rule's own error before and after. The
/// first rendering has `per_view` other photographs in addition to the one that moves (dissertation: 6), in crops of `side` pixels
/// (a multiple of 16). With a network it has colours (-1 to 1) and features; without one it is the mean colour of the photographs.
///
/// # Errors
/// [`NolError`] for a photograph that cannot be cropped.
pub fn published_rule_poses(
    photographs: &[PosedImage],
    mesh: &Mesh,
    model: Option<&NolModel>,
    side: usize,
    per_view: usize,
    options: &PublishedRuleOptions,
) -> Result<Vec<(Pose, [f64; 2])>, NolError> {
    let views: Vec<SourceView> =
        photographs.iter().map(|p| SourceView::new(p, mesh, side)).collect::<Result<_, _>>()?;
    let features: Vec<SourceFeatures> = model.map_or(vec![], |model| model.encode(&views));
    let maps: Vec<Maps> = match model {
        Some(_) => features.par_iter().map(|f| maps_of(f, side)).collect(),
        None => views.par_iter().map(colors).collect(),
    };
    let surface = mesh.sample_surface(POINTS, 0);
    let normals = outwards(mesh, &surface.normals);
    let shown: Vec<Vec<f32>> = views.par_iter().map(|v| shown_points(v, &surface.points, &normals)).collect();
    Ok((0..views.len())
        .into_par_iter()
        .map(|k| {
            let chosen = chosen(&views[k], k, &shown, &surface.points, &normals, per_view);
            let target = TargetSurface::new(mesh, &views[k].camera, views[k].camera_from_object());
            let (rendered, known) = match model {
                Some(model) => {
                    let sources: Vec<SourceView> = chosen.iter().map(|i| views[*i].clone()).collect();
                    let features: Vec<SourceFeatures> = chosen.iter().map(|i| features[*i].clone()).collect();
                    let rendering = model.render(&target, &sources, &features);
                    // Without the cosine, which photographs do not have.
                    let channels = maps[k].channels();
                    let rendered = rendering.channels.iter().flat_map(|c| c[..channels].to_vec()).collect();
                    (rendered, rendering.seen)
                }
                None => average(&target, &chosen, &views, &maps),
            };
            let mut view = views[k].clone();
            published_rule(&mut view, &maps[k], mesh, &target, &rendered, &known, options)
        })
        .collect())
}

/// The photograph itself and the others that show most of the same surface.
fn chosen(
    view: &SourceView,
    k: usize,
    shown: &[Vec<f32>],
    points: &[Vec3],
    normals: &[Vec3],
    per_view: usize,
) -> Vec<usize> {
    let only: Vec<bool> =
        points.iter().zip(normals).map(|(point, normal)| view.see(point, normal).is_some()).collect();
    let others: Vec<usize> = (0..shown.len()).filter(|i| *i != k).collect();
    let shown: Vec<Vec<f32>> = others.iter().map(|i| shown[*i].clone()).collect();
    let best = choose_by_surface(&shown, Some(&only), per_view, 1.0);
    std::iter::once(k).chain(best.into_iter().map(|i| others[i])).collect()
}

/// A photograph's colours, -1 to 1.
fn colors(view: &SourceView) -> Maps {
    let planes: Vec<f32> = view.patch.data.iter().map(|v| 2.0 * v - 1.0).collect();
    Maps::from_planes(&planes, 3, view.side())
}

/// Encoded maps at the crop's own resolution.
fn maps_of(features: &SourceFeatures, side: usize) -> Maps {
    let (channels, area) = (features.channels(), side * side);
    let mut planes = vec![0.0; channels * area];
    let mut at_place = vec![0.0; channels];
    for i in 0..area {
        features.sample((i % side) as f32, (i / side) as f32, &mut at_place);
        (0..channels).for_each(|c| planes[c * area + i] = at_place[c]);
    }
    Maps::from_planes(&planes, channels, side)
}

/// Mean over the sources that show a pixel, and which pixels any source shows.
fn average(
    target: &TargetSurface,
    chosen: &[usize],
    views: &[SourceView],
    maps: &[Maps],
) -> (Vec<f32>, Vec<bool>) {
    let mut sums = vec![0.0f32; 3 * target.pixels.len()];
    let mut counts = vec![0.0f32; target.pixels.len()];
    let mut color = [0.0f32; 3];
    for k in chosen {
        let projection = views[*k].project(target);
        for (i, ([x, y], cosine)) in projection.pixels.iter().zip(&projection.cosines).enumerate() {
            if *cosine > 0.0 && views[*k].visible.sample(*x, *y) >= 0.5 {
                maps[*k].sample(*x, *y, &mut color);
                (0..3).for_each(|c| sums[3 * i + c] += color[c]);
                counts[i] += 1.0;
            }
        }
    }
    for (i, count) in counts.iter().enumerate().filter(|(_, count)| **count > 0.0) {
        sums[3 * i..3 * i + 3].iter_mut().for_each(|v| *v /= count);
    }
    (sums, counts.iter().map(|c| *c > 0.0).collect())
}
