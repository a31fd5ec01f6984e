//! The steps of the default refinement, from coarse to fine: every pose separately, or cameras and the places of objects that stood
//! still. [`Places`] determines which objects did, from the poses after a first refinement.

use std::collections::BTreeSet;

use rayon::prelude::*;
use sixfold_align::outline::{Outline, color_odds};
use sixfold_geometry::{Pose, Progress, Vec3};
use sixfold_mesh::Mesh;

use super::appearance::{Common, Light, PointSamples, sample_points};
use super::arrangement::{Arrangement, Wanted};
use super::common_error::Shared;
use super::gauss_newton::PosedSource;
use super::measure::{Terms, Working, off, prior, wanted_by};
use super::options::{PoseRefinementOptions, SceneKind};
use super::stillness::{Joined, Places};
use crate::maps::Maps;

/// Disagreement of poses, in units of that explained by their roughness, above which objects are assumed to have moved.
const MOVED: f64 = 2.0;

/// The 80 % quantile of the mean of six squared standard normal numbers.
const EXPECTED: f64 = 1.43;

/// Data of one object.
pub(super) struct Object {
    pub points: Vec<Vec3>,
    pub normals: Vec<Vec3>,
    /// Its mesh, simplified to the faces that its outline needs.
    pub simple: Mesh,
    pub centre: Vec3,
    /// Numbers of its sources.
    pub sources: Vec<usize>,
}

/// The places of the objects as determined from the poses.
pub(super) struct Standing {
    /// The places of every object.
    pub places: Vec<Vec<usize>>,
    /// Whether each object had one place in all images.
    pub still: bool,
    /// Disagreement of the given poses with one place per object, in units of that explained by their roughness; `None` if there is
    /// nothing to compare.
    pub disagreement: Option<f64>,
}

/// State of the refinement.
pub(super) struct RefinementState<'a, 'b> {
    pub sources: &'a [PosedSource<'b>],
    pub meshes: &'a [Mesh],
    pub objects: &'a [Object],
    pub options: &'a PoseRefinementOptions,
    pub working: Vec<Working<'a>>,
    pub progress: &'a dyn Progress,
}

/// Reports a fraction of the work in millionths; returns whether to continue.
pub(super) fn report(progress: &dyn Progress, fraction: f64) -> bool {
    const PARTS: f64 = 1e6;
    progress.report((PARTS * fraction).round() as usize, PARTS as usize)
}

/// Roughness of poses after a first refinement, as a fraction of that of the given ones.
const LEFT: f64 = 0.6;
/// The level from which they are refined again with common places.
const AGAIN: usize = 1;

impl RefinementState<'_, '_> {
    /// Refines the poses: in one arrangement if, by the given poses, all objects stood still; otherwise every source separately,
    /// and then with common places for objects that, by these refined poses, stood still in some of the images.
    pub(crate) fn refine(&mut self) -> Standing {
        let given: Vec<Pose> = self.working.iter().map(|w| w.given).collect();
        let pairs: Vec<[usize; 2]> = self.sources.iter().map(|s| [s.image, s.object]).collect();
        let each: Vec<Vec<usize>> = (0..self.objects.len()).map(|object| vec![object]).collect();
        let mut disagreement = None;
        if self.options.scene != SceneKind::Moving
            && let Some((mut arrangement, off)) =
                self.fit(&pairs, self.objects.len(), &given, self.options.rough)
        {
            disagreement = Some(off);
            if self.options.scene == SceneKind::Still || off <= MOVED {
                self.align(&mut arrangement, &each, 0, [0.0, 1.0]);
                return Standing { places: each, still: true, disagreement };
            }
        }
        let judge = self.options.scene == SceneKind::Judge && disagreement.is_some();
        // With a separate camera for every source, the single place of an object does not constrain its poses.
        let apart = pairs.iter().enumerate().map(|(k, [_, object])| [k, *object]).collect();
        let mut arrangement = Arrangement::new(apart, &given, given.len(), self.objects.len());
        let fraction = if judge { 0.5 } else { 1.0 };
        if !self.align(&mut arrangement, &each, 0, [0.0, fraction]) || !judge {
            return Standing { places: each, still: false, disagreement };
        }
        let better: Vec<Pose> = self.working.iter().map(|w| w.pose).collect();
        let rough = self.options.rough.map(|deviation| LEFT * deviation);
        let centres: Vec<Vec3> = self.objects.iter().map(|o| o.centre).collect();
        let found = Places::new(&pairs, &better, &centres, rough);
        let placed: Vec<[usize; 2]> =
            pairs.iter().zip(&found.of_source).map(|([image, _], place)| [*image, *place]).collect();
        if let Some((mut arrangement, off)) = self.fit(&placed, found.count, &better, rough)
            && off <= MOVED
        {
            let mut places = vec![BTreeSet::new(); self.objects.len()];
            for ([_, object], place) in pairs.iter().zip(&found.of_source) {
                places[*object].insert(*place);
            }
            let places: Vec<Vec<usize>> = places.into_iter().map(|of| of.into_iter().collect()).collect();
            self.align(&mut arrangement, &places, AGAIN, [fraction, 1.0]);
            return Standing { places, still: false, disagreement };
        }
        Standing { places: each, still: false, disagreement }
    }

    /// Cameras and places (`pairs` of image and place for every source) fitted to poses of this roughness; and the disagreement of
    /// the poses with the fit, in units of that explained by their roughness. `None` if there is nothing to compare.
    fn fit(
        &self,
        pairs: &[[usize; 2]],
        places: usize,
        poses: &[Pose],
        rough: [f64; 2],
    ) -> Option<(Arrangement, f64)> {
        let images = pairs.iter().map(|[image, _]| image + 1).max().unwrap_or(0);
        let used = |which: usize| pairs.iter().map(|p| p[which]).collect::<BTreeSet<_>>().len();
        // Degrees of freedom: six per pair, minus six per camera and place, plus six for the common frame of each connected part.
        let free = 6.0 * ((pairs.len() + parts(pairs, images, places)) as f64 - (used(0) + used(1)) as f64);
        if free <= 0.0 {
            return None;
        }
        let centre = |k: usize| &self.objects[self.sources[k].object].centre;
        let mut arrangement = Arrangement::new(pairs.to_vec(), poses, images, places);
        for _ in 0..20 {
            let wanted: Vec<Wanted> = poses
                .iter()
                .enumerate()
                .map(|(k, pose)| wanted_by(pose, &arrangement.camera_from_object(k), centre(k), rough))
                .collect();
            if !arrangement.step(&wanted, 1e-6) {
                break;
            }
        }
        let mut off: Vec<f64> = poses
            .iter()
            .enumerate()
            .map(|(k, pose)| off(pose, &arrangement.camera_from_object(k), centre(k), rough).powi(2))
            .collect();
        // The 80 % quantile is used, because with few poses some always agree.
        let most = (off.len() * 4 / 5).min(off.len() - 1);
        let usual = *off.select_nth_unstable_by(most, f64::total_cmp).1 / EXPECTED;
        Some((arrangement, (usual * 6.0 * pairs.len() as f64 / free).sqrt()))
    }

    /// Moves cameras and objects from coarse to fine, starting at level `first`; `progress` receives fractions within `range`.
    /// Returns `false` if it stopped the run.
    fn align(
        &mut self,
        arrangement: &mut Arrangement,
        places: &[Vec<usize>],
        first: usize,
        range: [f64; 2],
    ) -> bool {
        let RefinementState { sources, objects, options, .. } = *self;
        self.follow(arrangement);
        let first = first.min(options.blurs.len() - 1);
        let all = ((options.blurs.len() - first) * options.steps).max(1) as f64;
        for (level, blur) in options.blurs.iter().enumerate().skip(first) {
            let maps: Vec<Maps> = self.working.par_iter().map(|w| w.maps(*blur, options)).collect();
            if options.line > 0.0 {
                self.working.par_iter_mut().zip(sources).for_each(|(w, source)| {
                    let odds = color_odds(&w.view.patch, &prior(&w.view));
                    let outline = Outline::new(&objects[source.object].simple, &w.view.camera, odds);
                    w.outline = Some(outline.with_edges(&w.view.patch, options.edges));
                });
            }
            for step in 0..options.steps {
                let done = ((level - first) * options.steps + step) as f64 / all;
                if !report(self.progress, range[0] + done * (range[1] - range[0])) {
                    return false;
                }
                let working = &mut self.working;
                working.par_iter_mut().for_each(|w| w.allow(*blur));
                let shown = shown(working, &maps, objects);
                let reach = options.reaches[level.min(options.reaches.len() - 1)];
                let wanted: Vec<Wanted> = working
                    .par_iter_mut()
                    .enumerate()
                    .map(|(k, w)| {
                        let object = &objects[sources[k].object];
                        let (target, known) = &shown.others[k];
                        let (points, normals, centre) = (&object.points, &object.normals, &object.centre);
                        w.measure(
                            &Terms { maps: &maps[k], points, normals, target, known, centre, reach },
                            options,
                        )
                    })
                    .collect();
                if !arrangement.step(&wanted, 1e-3) {
                    break;
                }
                self.follow(arrangement);
                if step + options.shared >= options.steps && options.colors > 0.0 {
                    for (number, object) in objects.iter().enumerate() {
                        let motion = shared_motion(object, &mut self.working, &maps, reach, *blur, options);
                        if let Some(motion) = motion {
                            places[number].iter().for_each(|place| arrangement.move_object(*place, &motion));
                        }
                    }
                    self.follow(arrangement);
                }
            }
        }
        true
    }

    /// Sets the poses of all sources to those of the arrangement.
    fn follow(&mut self, arrangement: &Arrangement) {
        let (sources, meshes) = (self.sources, self.meshes);
        self.working.par_iter_mut().enumerate().for_each(|(k, w)| {
            let pose = arrangement.camera_from_object(k);
            if pose.translation().z > 0.01 {
                w.pose = pose;
                w.view.set_pose(&meshes[sources[k].object], pose, &mut w.frame);
            }
        });
    }
}

/// The common motion of one object over all its photographs.
fn shared_motion(
    object: &Object,
    working: &mut [Working<'_>],
    maps: &[Maps],
    reach: f64,
    blur: f32,
    options: &PoseRefinementOptions,
) -> Option<Pose> {
    if object.sources.len() < 3 {
        return None;
    }
    let anchors = object
        .sources
        .iter()
        .map(|k| working[*k].measure_anchors(&object.centre, reach, options).equations.parts())
        .collect();
    let working: Vec<&Working<'_>> = object.sources.iter().map(|k| &working[*k]).collect();
    // The width of the blur on the surface at the median distance.
    let mut pixels: Vec<f64> = working.iter().map(|w| w.pose.translation().z / w.view.camera.fx).collect();
    pixels.sort_by(f64::total_cmp);
    let step = f64::from(blur) * pixels[pixels.len() / 2];
    let radius = object.points.iter().map(|p| (p - object.centre).norm()).fold(1e-6, f64::max);
    let shared = Shared {
        working,
        maps: object.sources.iter().map(|k| &maps[*k]).collect(),
        points: &object.points,
        normals: &object.normals,
        centre: object.centre,
        reach: [step, step / (0.6 * radius)],
        anchors,
    };
    shared.solve(options)
}

/// Number of connected parts of the graph of images and places, with sources as edges.
fn parts(pairs: &[[usize; 2]], images: usize, places: usize) -> usize {
    let mut joined = Joined::new(images + places);
    for [image, place] in pairs {
        joined.join(*image, images + place);
    }
    pairs.iter().map(|[image, _]| joined.root(*image)).collect::<BTreeSet<_>>().len()
}

/// The colours of all sources, adjusted to a common light.
pub(super) struct ObjectSamples {
    pub shown: Vec<PointSamples>,
    /// Per source: the mean colours of the other sources of its object, and their total weight.
    pub others: Vec<(Vec<f32>, Vec<f32>)>,
}

/// Colours of all sources at all points of their objects.
pub(super) fn shown(working: &mut [Working<'_>], maps: &[Maps], objects: &[Object]) -> ObjectSamples {
    let mut all = ObjectSamples { shown: vec![], others: vec![] };
    all.shown.resize_with(working.len(), PointSamples::default);
    all.others.resize_with(working.len(), Default::default);
    for object in objects {
        let raw: Vec<PointSamples> = object
            .sources
            .par_iter()
            .map(|k| {
                let w = &working[*k];
                sample_points(&w.view, &maps[*k], &w.allowed, &object.points, &object.normals)
            })
            .collect();
        // The first round fits each source's light, the second computes the colours with it.
        for round in 0..2 {
            let lit: Vec<PointSamples> = raw
                .par_iter()
                .zip(&object.sources)
                .map(|(raw, k)| {
                    let mut shown = raw.clone();
                    working[*k].light.apply(&mut shown.values);
                    shown
                })
                .collect();
            let common = Common::new(&lit, 3);
            let others: Vec<_> = (0..lit.len()).into_par_iter().map(|i| common.without(i, &lit[i])).collect();
            if round == 0 {
                let lights: Vec<Light> = raw
                    .par_iter()
                    .zip(&others)
                    .map(|(raw, (target, known))| Light::fit(raw, target, known, 3))
                    .collect();
                for (k, light) in object.sources.iter().zip(lights) {
                    working[*k].light = light;
                }
                continue;
            }
            for ((k, lit), others) in object.sources.iter().zip(lit).zip(others) {
                all.shown[*k] = lit;
                all.others[*k] = others;
            }
        }
    }
    all
}
