//! The default refinement: all poses at once, by Gauss-Newton against the colours of the other photographs, from coarse to fine.
//!
//! The residual is the dissertation's (equation 4.3), in the photograph's own pixels, with robust weights and Gauss-Newton steps.
//! It carries little information on surfaces without texture, so the second term compares the outline of the mesh with the border
//! of the object in the photograph. The third is a prior around the given pose. Objects that stood still share the poses of the
//! cameras ([`super::alignment`]).

use rayon::prelude::*;
use sixfold_align::outline::outline_mesh;
use sixfold_data::PosedImage;
use sixfold_geometry::Progress;
use sixfold_mesh::Mesh;
use sixfold_render::VisibilityBuffer;

use super::alignment::{Object, RefinementState, report, shown};
use super::appearance::Light;
use super::measure::Working;
use super::options::{PoseRefinementOptions, Refinement, SourceReport};
use crate::error::NolError;
use crate::maps::Maps;
use crate::source::SourceView;
use crate::surface::outwards;

/// One object in one image.
#[derive(Debug, Clone, Copy)]
pub struct PosedSource<'a> {
    /// Number of the object in the list of meshes.
    pub object: usize,
    /// Number of the image: sources in one image share its camera.
    pub image: usize,
    /// The photograph, with the object's pose.
    pub photograph: &'a PosedImage,
}

/// Refines the poses of photographs of one object; see [`refine_scene`].
///
/// # Errors
/// [`NolError`] for options out of range.
pub fn refine_poses(
    photographs: &[PosedImage],
    mesh: &Mesh,
    options: &PoseRefinementOptions,
    progress: &dyn Progress,
) -> Result<Refinement, NolError> {
    let sources: Vec<PosedSource<'_>> = photographs
        .iter()
        .enumerate()
        .map(|(image, photograph)| PosedSource { object: 0, image, photograph })
        .collect();
    refine_scene(&sources, std::slice::from_ref(mesh), options, progress)
}

/// Refines the poses of objects in photographs. If `progress` stops it, the poses at that moment are the result. It receives
/// millionths of the work, because there are no parts of equal size.
///
/// # Errors
/// [`NolError`] for options out of range.
pub fn refine_scene(
    sources: &[PosedSource<'_>],
    meshes: &[Mesh],
    options: &PoseRefinementOptions,
    progress: &dyn Progress,
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
    let mut working: Vec<Working<'_>> = Vec::with_capacity(sources.len());
    for source in sources {
        let view = SourceView::new(source.photograph, &meshes[source.object], options.side)?;
        let pose = *source.photograph.camera_from_object();
        working.push(Working {
            given: pose,
            pose,
            allowed: vec![],
            outline: None,
            light: Light::neutral(3),
            frame: VisibilityBuffer::new(&view.camera),
            lines: 0,
            view,
        });
    }
    let before = differences(&mut working, &objects, options);
    let mut scene = RefinementState { sources, meshes, objects: &objects, options, working, progress };
    let standing = scene.refine();
    let RefinementState { mut working, .. } = scene;
    report(progress, 1.0);
    let after = differences(&mut working, &objects, options);
    let mut reports: Vec<SourceReport> = working
        .iter()
        .enumerate()
        .map(|(k, w)| w.report(&objects[sources[k].object].centre, [before[k], after[k]], options))
        .collect();
    for object in &objects {
        drop_strangers(&mut reports, &working, &object.sources, options);
    }
    Ok(Refinement {
        sources: reports,
        still: standing.still,
        places: standing.places.iter().map(Vec::len).sum(),
        disagreement: standing.disagreement,
    })
}

/// Drops photographs whose colours differ from the others where the object should be: their pose errors are too large for the
/// refinement. Needs three others.
fn drop_strangers(
    reports: &mut [SourceReport],
    working: &[Working<'_>],
    sources: &[usize],
    options: &PoseRefinementOptions,
) {
    let mut differences: Vec<f64> =
        sources.iter().map(|k| reports[*k].difference[1]).filter(|d| d.is_finite()).collect();
    if differences.len() < 4 {
        return;
    }
    let half = differences.len() / 2;
    let median = *differences.select_nth_unstable_by(half, f64::total_cmp).1;
    let most = (options.max_different * median).max(MIN_STRANGE);
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

/// Differences in colour below this are attributed to the light, not to another object.
const MIN_STRANGE: f64 = 0.08;

/// Mean difference of every source to the others of its object, at the finest blur.
fn differences(working: &mut [Working<'_>], objects: &[Object], options: &PoseRefinementOptions) -> Vec<f64> {
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
