//! The default refinement: all poses at once, by Gauss-Newton against what the other photographs show, from coarse to fine.
//!
//! The residual is the dissertation's (equation 4.3), in the photograph's own pixels, with robust weights and the step that
//! its curvature asks for. Where surfaces have no texture it says little; the outline of the mesh against the border of the
//! object in the photograph is the second term. The third says that the given pose is rough, not wrong. Objects that stood
//! still share the poses of the cameras.

use rayon::prelude::*;
use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::Mesh;
use sixfold_outline::{Outline, color_odds, outline_mesh};
use sixfold_render::Frame;

use super::appearance::{Common, Light, Shown, look};
use super::arrangement::{Arrangement, Wanted};
use super::common_error::Shared;
use super::measure::{Terms, Working, prior};
use super::options::{RefineOptions, Refinement, SceneKind, SourceReport};
use crate::maps::Maps;
use crate::photograph::{NolError, Photograph};
use crate::source::SourceView;
use crate::surface::outwards;

/// One object in one image.
#[derive(Debug, Clone, Copy)]
pub struct SceneSource<'a> {
    /// Number of the object in the list of meshes.
    pub object: usize,
    /// Number of the image: sources of one image share its camera.
    pub image: usize,
    /// The photograph with the object's pose.
    pub photograph: &'a Photograph,
}

/// Makes the poses of photographs of one object better; see [`refine_scene`].
///
/// # Errors
/// [`NolError`] for options out of range.
pub fn refine_poses(
    photographs: &[Photograph],
    mesh: &Mesh,
    options: &RefineOptions,
    progress: impl FnMut(f64) -> bool,
) -> Result<Refinement, NolError> {
    let sources: Vec<SceneSource<'_>> = photographs
        .iter()
        .enumerate()
        .map(|(image, photograph)| SceneSource { object: 0, image, photograph })
        .collect();
    refine_scene(&sources, std::slice::from_ref(mesh), options, progress)
}

/// Disagreement of poses, in units of what their roughness explains, from which objects are taken to have moved.
const MOVED: f64 = 2.0;

/// Four fifths of the means of six squared unit normal numbers are below this.
const EXPECTED: f64 = 1.43;

/// What belongs to an object.
struct Object {
    points: Vec<Vec3>,
    normals: Vec<Vec3>,
    simple: Mesh,
    centre: Vec3,
    /// Numbers of its sources.
    sources: Vec<usize>,
}

/// Makes the poses of objects in photographs better. `progress` hears the share that is done, and stops the work by returning
/// `false` (the poses of that moment are the result).
///
/// # Errors
/// [`NolError`] for options out of range.
pub fn refine_scene(
    sources: &[SceneSource<'_>],
    meshes: &[Mesh],
    options: &RefineOptions,
    mut progress: impl FnMut(f64) -> bool,
) -> Result<Refinement, NolError> {
    options.check()?;
    if let Some(wrong) = sources.iter().find(|s| s.object >= meshes.len()) {
        let expected = "numbers of given meshes";
        return Err(NolError::Option { field: "sources.object", expected, found: wrong.object.to_string() });
    }
    let objects: Vec<Object> = meshes
        .par_iter()
        .enumerate()
        .map(|(number, mesh)| {
            let surface = mesh.sample_surface(options.points, options.seed);
            let (low, high) = mesh.bounding_box();
            Object {
                normals: outwards(mesh, &surface.normals),
                points: surface.points,
                simple: outline_mesh(mesh),
                centre: (low + high) * 0.5,
                sources: (0..sources.len()).filter(|i| sources[*i].object == number).collect(),
            }
        })
        .collect();
    let mut working = Vec::with_capacity(sources.len());
    for source in sources {
        let view = SourceView::new(source.photograph, &meshes[source.object], options.side)?;
        let pose = *source.photograph.camera_from_object();
        working.push(Working {
            given: pose,
            pose,
            allowed: vec![],
            outline: None,
            light: Light::neutral(3),
            frame: Frame::new(&view.camera),
            lines: 0,
            view,
        });
    }
    let (mut arrangement, still, disagreement) = arrange(sources, &objects, &mut working, options);
    let before = differences(&mut working, &objects, options);
    for (w, source) in working.iter_mut().zip(sources) {
        w.view.set_pose(&meshes[source.object], w.pose, &mut w.frame);
    }
    let all = (options.blurs.len() * options.steps).max(1) as f64;
    'levels: for (level, blur) in options.blurs.iter().enumerate() {
        let maps: Vec<Maps> = working.par_iter().map(|w| w.maps(*blur, options)).collect();
        if options.line > 0.0 {
            working.par_iter_mut().zip(sources).for_each(|(w, source)| {
                let odds = color_odds(&w.view.patch, &prior(&w.view));
                let outline = Outline::new(&objects[source.object].simple, &w.view.camera, odds);
                w.outline = Some(outline.with_edges(&w.view.patch, options.edges));
            });
        }
        for step in 0..options.steps {
            let done = (level * options.steps + step) as f64 / all;
            if !progress(done) {
                break 'levels;
            }
            working.par_iter_mut().for_each(|w| w.allow(*blur));
            let shown = shown(&mut working, &maps, &objects);
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
            follow(&mut working, &arrangement, sources, meshes);
            if step + options.shared >= options.steps && options.colors > 0.0 {
                for (number, object) in objects.iter().enumerate() {
                    if let Some(motion) = shared_motion(object, &mut working, &maps, reach, *blur, options) {
                        arrangement.move_object(number, &motion);
                    }
                }
                follow(&mut working, &arrangement, sources, meshes);
            }
        }
    }
    progress(1.0);
    let after = differences(&mut working, &objects, options);
    let mut reports: Vec<SourceReport> = working
        .iter()
        .enumerate()
        .map(|(k, w)| w.report(&objects[sources[k].object].centre, [before[k], after[k]], options))
        .collect();
    for object in &objects {
        drop_strangers(&mut reports, &working, &object.sources, options);
    }
    Ok(Refinement { sources: reports, still, disagreement })
}

/// Takes the poses of the arrangement over.
fn follow(
    working: &mut [Working<'_>],
    arrangement: &Arrangement,
    sources: &[SceneSource<'_>],
    meshes: &[Mesh],
) {
    working.par_iter_mut().enumerate().for_each(|(k, w)| {
        let pose = arrangement.camera_from_object(k);
        if pose.translation().z > 0.01 {
            w.pose = pose;
            w.view.set_pose(&meshes[sources[k].object], pose, &mut w.frame);
        }
    });
}

/// The motion of one object that all its photographs ask for.
fn shared_motion(
    object: &Object,
    working: &mut [Working<'_>],
    maps: &[Maps],
    reach: f64,
    blur: f32,
    options: &RefineOptions,
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
    // A blur's width on the surface, seen from the usual distance.
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

/// Drops photographs that show something else than the others where the object should be: their poses are wrong by more than
/// refinement can mend. Needs three others to say so.
fn drop_strangers(
    reports: &mut [SourceReport],
    working: &[Working<'_>],
    sources: &[usize],
    options: &RefineOptions,
) {
    let mut differences: Vec<f64> =
        sources.iter().map(|k| reports[*k].difference[1]).filter(|d| d.is_finite()).collect();
    if differences.len() < 4 {
        return;
    }
    let middle = differences.len() / 2;
    let median = *differences.select_nth_unstable_by(middle, f64::total_cmp).1;
    let most = (options.most_different * median).max(LEAST_STRANGE);
    for k in sources {
        let report = &mut reports[*k];
        if report.dropped.is_none() && report.difference[1] > most {
            report.camera_from_object = working[*k].given;
            report.dropped = Some(format!(
                "where the object should be it differs from the other photographs by {:.0} % of the full range of colours \
                 (theirs: {:.0} %); is its pose right?",
                100.0 * report.difference[1],
                100.0 * median
            ));
        }
    }
}

/// Differences in colour below this are light, not another object.
const LEAST_STRANGE: f64 = 0.09;

/// The arrangement to start from, by the given poses alone; whether the objects stood still, and by how much the poses
/// disagree with that.
fn arrange(
    sources: &[SceneSource<'_>],
    objects: &[Object],
    working: &mut [Working<'_>],
    options: &RefineOptions,
) -> (Arrangement, bool, Option<f64>) {
    let given: Vec<_> = working.iter().map(|w| w.given).collect();
    let images = sources.iter().map(|s| s.image + 1).max().unwrap_or(0);
    let pairs: Vec<[usize; 2]> = sources.iter().map(|s| [s.image, s.object]).collect();
    let apart = || {
        let pairs = pairs.iter().enumerate().map(|(k, [_, object])| [k, *object]).collect();
        Arrangement::new(pairs, &given, given.len(), objects.len())
    };
    let used = |which: usize| pairs.iter().map(|p| p[which]).collect::<std::collections::BTreeSet<_>>().len();
    // Six numbers of every pair against those of every camera and object, less one common frame.
    let free = 6.0 * (pairs.len() as f64 - (used(0) + used(1)) as f64 + 1.0);
    if options.scene == SceneKind::Moving || free <= 0.0 {
        return (apart(), false, None);
    }
    let mut arrangement = Arrangement::new(pairs.clone(), &given, images, objects.len());
    for _ in 0..20 {
        for (k, w) in working.iter_mut().enumerate() {
            w.pose = arrangement.camera_from_object(k);
        }
        let wanted: Vec<Wanted> = working
            .iter()
            .zip(sources)
            .map(|(w, s)| w.measure_given(&objects[s.object].centre, options))
            .collect();
        if !arrangement.step(&wanted, 1e-6) {
            break;
        }
    }
    let mut off: Vec<f64> = Vec::with_capacity(sources.len());
    for (k, w) in working.iter_mut().enumerate() {
        w.pose = arrangement.camera_from_object(k);
        off.push(w.off(&objects[sources[k].object].centre, options).powi(2));
    }
    // Nearly all poses must agree: with few of them, some always do.
    let most = (off.len() * 4 / 5).min(off.len() - 1);
    let usual = *off.select_nth_unstable_by(most, f64::total_cmp).1 / EXPECTED;
    let disagreement = (usual * 6.0 * pairs.len() as f64 / free).sqrt();
    if options.scene == SceneKind::Judge && disagreement > MOVED {
        for w in working.iter_mut() {
            w.pose = w.given;
        }
        return (apart(), false, Some(disagreement));
    }
    (arrangement, true, Some(disagreement))
}

/// What all sources show, in a common light.
struct AllShown {
    shown: Vec<Shown>,
    /// Per source: what the other sources of its object show, and the weight behind it.
    others: Vec<(Vec<f32>, Vec<f32>)>,
}

/// Colours of all sources at all points of their objects.
fn shown(working: &mut [Working<'_>], maps: &[Maps], objects: &[Object]) -> AllShown {
    let mut all = AllShown { shown: vec![], others: vec![] };
    all.shown.resize_with(working.len(), Shown::default);
    all.others.resize_with(working.len(), Default::default);
    for object in objects {
        let raw: Vec<Shown> = object
            .sources
            .par_iter()
            .map(|k| {
                let w = &working[*k];
                look(&w.view, &maps[*k], &w.allowed, &object.points, &object.normals)
            })
            .collect();
        // The light twice: fitted to colours in the light of before, then the colours in the new one.
        for round in 0..2 {
            let lit: Vec<Shown> = raw
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

/// Mean difference of every source to the others of its object, in the finest blur.
fn differences(working: &mut [Working<'_>], objects: &[Object], options: &RefineOptions) -> Vec<f64> {
    let blur = options.blurs.last().copied().unwrap_or(1.0);
    let maps: Vec<Maps> = working.par_iter().map(|w| Maps::of_patch(&w.view.patch, blur)).collect();
    working.par_iter_mut().for_each(|w| w.allow(blur));
    let all = shown(working, &maps, objects);
    all.shown
        .par_iter()
        .zip(&all.others)
        .map(|(shown, (target, known))| {
            let (mut sum, mut weight) = (0.0, 0.0);
            for (i, known) in known.iter().enumerate() {
                let w = f64::from(shown.weights[i]);
                if w > 0.0 && *known > 0.0 {
                    let range = 3 * i..3 * i + 3;
                    let pairs = shown.values[range.clone()].iter().zip(&target[range]);
                    sum += w * pairs.map(|(a, b)| f64::from((a - b).abs())).sum::<f64>() / 3.0;
                    weight += w;
                }
            }
            if weight > 0.0 { sum / weight } else { f64::NAN }
        })
        .collect()
}
