//! New views from refined photographs: combines the sources that show most of the view's surface, weighted per pixel, and marks the
//! pixels that none of them shows.

use rayon::prelude::*;
use sixfold_geometry::{Camera, Mask, Pose, Vec3};
use sixfold_mesh::Mesh;
use sixfold_synth::augment::Patch;

use crate::error::NolError;
use crate::features::SourceFeatures;
use crate::maps::Maps;
use crate::model::NolModel;
use crate::projection::TargetSurface;
use crate::select::{choose_by_surface, shown_points, unseen_fraction};
use crate::source::SourceView;
use crate::surface::outwards;

/// How the colours of several photographs at one point are combined.
#[derive(Debug, Clone, Copy)]
pub enum Weighting<'a> {
    /// The photograph with the most frontal view of the point: plain multi-view texturing.
    Best,
    /// All photographs with equal weights.
    Average,
    /// The network of NOL.
    Network(&'a NolModel),
}

/// A new view.
#[derive(Debug, Clone)]
pub struct NewView {
    /// Colours; 0 outside the object.
    pub patch: Patch,
    /// Where the object is.
    pub mask: Mask,
    /// Where the object is not shown by any source: filled from nearby pixels.
    pub unseen: Mask,
    /// Numbers of the sources that were used.
    pub sources: Vec<usize>,
}

impl NewView {
    /// Fraction of the object's pixels that no source shows, 0 to 1.
    pub fn unseen_fraction(&self) -> f64 {
        let count = |mask: &Mask| mask.as_slice().iter().filter(|v| **v).count() as f64;
        count(&self.unseen) / count(&self.mask).max(1.0)
    }
}

/// Points of the surface by which sources are chosen.
const POINTS: usize = 3000;
/// A source that adds fewer points to a view is not used for it.
const MIN_GAIN: f64 = 1.0;

/// Makes views of one object.
#[derive(Debug)]
pub struct ViewMaker<'a> {
    mesh: &'a Mesh,
    sources: Vec<SourceView>,
    features: Vec<SourceFeatures>,
    maps: Vec<Maps>,
    weighting: Weighting<'a>,
    per_view: usize,
    points: Vec<Vec3>,
    normals: Vec<Vec3>,
    shown: Vec<Vec<f32>>,
    mean: [f32; 3],
}

impl<'a> ViewMaker<'a> {
    /// `per_view` is the number of sources per view (dissertation: 6).
    ///
    /// # Errors
    /// [`NolError::Option`] without sources, or if none shows the object.
    pub fn new(
        mesh: &'a Mesh,
        sources: Vec<SourceView>,
        weighting: Weighting<'a>,
        per_view: usize,
    ) -> Result<Self, NolError> {
        let wrong = |field, expected, found: String| NolError::Option { field, expected, found };
        if sources.is_empty() {
            return Err(wrong("sources", "at least one photograph", "none".to_owned()));
        }
        if !(1..=64).contains(&per_view) {
            return Err(wrong("sources per view", "1 to 64", per_view.to_string()));
        }
        let surface = mesh.sample_surface(POINTS, 0);
        let normals = outwards(mesh, &surface.normals);
        let shown: Vec<Vec<f32>> =
            sources.par_iter().map(|s| shown_points(s, &surface.points, &normals)).collect();
        if unseen_fraction(&shown) >= 1.0 {
            let found = "masks that leave nothing of it".to_owned();
            return Err(wrong("sources", "photographs that show the object at their poses", found));
        }
        let features = match weighting {
            Weighting::Network(model) => model.encode(&sources),
            _ => vec![],
        };
        let maps: Vec<Maps> = sources.iter().map(|s| Maps::of_patch(&s.patch, 0.0)).collect();
        let mut maker = ViewMaker {
            mesh,
            features,
            maps,
            weighting,
            per_view,
            points: surface.points,
            normals,
            shown,
            mean: [0.5; 3],
            sources,
        };
        maker.mean = maker.mean_color();
        Ok(maker)
    }

    /// The object's mean colour, for views of which no source shows anything.
    fn mean_color(&self) -> [f32; 3] {
        let (mut sum, mut weight) = ([0.0f32; 3], 0.0f32);
        let mut color = [0.0; 3];
        for ((source, maps), shown) in self.sources.iter().zip(&self.maps).zip(&self.shown) {
            for ((point, normal), shown) in self.points.iter().zip(&self.normals).zip(shown) {
                if *shown <= 0.0 {
                    continue;
                }
                let Some(([x, y], _)) = source.see(point, normal) else { continue };
                maps.sample(x, y, &mut color);
                (0..3).for_each(|c| sum[c] += shown * color[c]);
                weight += shown;
            }
        }
        sum.map(|v| v / weight.max(1e-6))
    }

    /// Fraction of the surface that no source shows, 0 to 1.
    pub fn unseen_fraction(&self) -> f64 {
        unseen_fraction(&self.shown)
    }

    /// The sources.
    pub fn sources(&self) -> &[SourceView] {
        &self.sources
    }

    /// Renders the object at a pose.
    pub fn render(&self, camera: &Camera, camera_from_object: &Pose) -> NewView {
        let target = TargetSurface::new(self.mesh, camera, camera_from_object);
        let chosen = self.choose(camera, camera_from_object);
        let (width, height) = (camera.width, camera.height);
        let area = width * height;
        let (colors, seen) = match self.weighting {
            Weighting::Network(model) => {
                let sources: Vec<SourceView> = chosen.iter().map(|k| self.sources[*k].clone()).collect();
                let features: Vec<SourceFeatures> =
                    chosen.iter().map(|k| self.features[*k].clone()).collect();
                let rendering = model.render(&target, &sources, &features);
                (rendering.colours, rendering.seen)
            }
            Weighting::Best => self.plain(&target, &chosen, true),
            Weighting::Average => self.plain(&target, &chosen, false),
        };
        let mut view = NewView {
            patch: Patch::filled(width, height, [0.0; 3]),
            mask: Mask::filled(width, height, false),
            unseen: Mask::filled(width, height, false),
            sources: chosen,
        };
        for ((pixel, color), seen) in target.pixels.iter().zip(&colors).zip(&seen) {
            let at = *pixel as usize;
            view.mask.as_mut_slice()[at] = true;
            view.unseen.as_mut_slice()[at] = !seen;
            if *seen {
                (0..3).for_each(|c| view.patch.data[c * area + at] = color[c].clamp(0.0, 1.0));
            }
        }
        fill(&mut view, self.mean);
        view
    }

    /// The sources that together show most of the view's surface.
    fn choose(&self, camera: &Camera, pose: &Pose) -> Vec<usize> {
        let black = Patch::filled(camera.width, camera.height, [0.0; 3]);
        let whole = sixfold_synth::augment::Coverage::filled(camera.width, camera.height, 1.0);
        let view = SourceView::of_crop(black, whole, *camera, *pose, self.mesh);
        let only: Vec<bool> = self
            .points
            .iter()
            .zip(&self.normals)
            .map(|(point, normal)| view.see(point, normal).is_some())
            .collect();
        choose_by_surface(&self.shown, Some(&only), self.per_view, MIN_GAIN)
    }

    /// Colours without a network: of the most frontal source, or the mean of all.
    fn plain(&self, target: &TargetSurface, chosen: &[usize], best: bool) -> (Vec<[f32; 3]>, Vec<bool>) {
        let mut colors = vec![[0.0f32; 3]; target.pixels.len()];
        let mut weights = vec![0.0f32; target.pixels.len()];
        let mut color = [0.0; 3];
        for k in chosen {
            let source = &self.sources[*k];
            let projection = source.project(target);
            for (i, ([x, y], cosine)) in projection.pixels.iter().zip(&projection.cosines).enumerate() {
                if *cosine <= 0.0 || source.visible.sample(*x, *y) < 0.5 {
                    continue;
                }
                self.maps[*k].sample(*x, *y, &mut color);
                if best {
                    if *cosine > weights[i] {
                        (colors[i], weights[i]) = (color, *cosine);
                    }
                } else {
                    (0..3).for_each(|c| colors[i][c] += color[c]);
                    weights[i] += 1.0;
                }
            }
        }
        if !best {
            for (color, weight) in colors.iter_mut().zip(&weights).filter(|(_, w)| **w > 0.0) {
                color.iter_mut().for_each(|v| *v /= weight);
            }
        }
        (colors, weights.into_iter().map(|w| w > 0.0).collect())
    }
}

/// Iterations in which filled pixels are replaced by the mean of themselves and their neighbours.
const SMOOTHINGS: usize = 40;

/// Fills unseen pixels of the object with the colours of visible ones nearby: means over increasingly large neighbourhoods, from
/// repeatedly halved images.
fn fill(view: &mut NewView, mean: [f32; 3]) {
    let (width, height) = view.mask.size();
    if !view.unseen.as_slice().contains(&true) {
        return;
    }
    // Sums of colours and weights at full resolution, then repeatedly halved.
    let area = width * height;
    let known = |at: usize| view.mask.as_slice()[at] && !view.unseen.as_slice()[at];
    let mut levels: Vec<(usize, usize, Vec<[f32; 4]>)> = vec![(
        width,
        height,
        (0..area)
            .map(|at| {
                let w = f32::from(u8::from(known(at)));
                let d = &view.patch.data;
                [d[at] * w, d[area + at] * w, d[2 * area + at] * w, w]
            })
            .collect(),
    )];
    while levels.last().is_some_and(|(w, h, _)| *w > 1 || *h > 1) {
        let (w, h, fine) = &levels[levels.len() - 1];
        let (half_w, half_h) = (w.div_ceil(2), h.div_ceil(2));
        let mut coarse = vec![[0.0f32; 4]; half_w * half_h];
        for (i, value) in fine.iter().enumerate() {
            let sum = &mut coarse[i / w / 2 * half_w + i % w / 2];
            (0..4).for_each(|c| sum[c] += value[c]);
        }
        levels.push((half_w, half_h, coarse));
    }
    let unseen: Vec<usize> = (0..area).filter(|at| view.unseen.as_slice()[*at]).collect();
    for &at in &unseen {
        let (x, y) = (at % width, at / width);
        let color = levels
            .iter()
            .enumerate()
            .skip(1)
            .map(|(level, (w, _, data))| data[(y >> level) * w + (x >> level)])
            .find(|sum| sum[3] > 0.0)
            .map_or(mean, |sum| [sum[0] / sum[3], sum[1] / sum[3], sum[2] / sum[3]]);
        (0..3).for_each(|c| view.patch.data[c * area + at] = color[c]);
    }
    // Smooths the blocks of the halved images and their transition to visible pixels.
    for _ in 0..SMOOTHINGS {
        let before = view.patch.data.clone();
        for &at in &unseen {
            let (x, y) = (at % width, at / width);
            let near = [
                (x > 0).then(|| at - 1),
                (x + 1 < width).then(|| at + 1),
                (y > 0).then(|| at - width),
                (y + 1 < height).then(|| at + width),
            ];
            let near: Vec<usize> = near.into_iter().flatten().filter(|n| view.mask.as_slice()[*n]).collect();
            for c in 0..3 {
                let sum: f32 = near.iter().map(|n| before[c * area + n]).sum();
                view.patch.data[c * area + at] = (before[c * area + at] + sum) / (near.len() + 1) as f32;
            }
        }
    }
}
