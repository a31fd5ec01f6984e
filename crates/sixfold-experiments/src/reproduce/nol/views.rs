//! Views rendered from photographs compared with the real pixels (table 4.6), also with wrong meshes (section 4.4.3).

use anyhow::Result;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use sixfold_data::PosedImage;
use sixfold_geometry::{Mask, Vec3};
use sixfold_mesh::{Mesh, simplify};
use sixfold_nn::layers::normal;
use sixfold_nol::SourceView;
use sixfold_nol::agreement::leave_out_what_differs;
use sixfold_nol::model::NolModel;
use sixfold_nol::similarity::{ImageSimilarity, Similarity, in_light_of, in_place_of, without_border};
use sixfold_nol::synthesis::{ViewMaker, Weighting};
use sixfold_render::{Light, Material as Surface, RenderOptions, SceneObject, VisibilityBuffer, shade};
use sixfold_synth::augment::Patch;

/// Photographs per view (dissertation: 6).
pub(super) const PER_VIEW: usize = 6;
/// Targets with fewer pixels that all variants show are left out.
const MIN_PIXELS: usize = 200;
/// Views are shifted by up to this many pixels of the crop to maximise their similarity to the photograph.
pub(super) const MOVED: usize = 6;
/// The set of the model's own colours, which is not a view from photographs.
pub(super) const MODEL: &str = "model";

/// The networks for views: names and models; the first is the one of --weights.
pub(super) type Networks = [(String, NolModel)];

/// One variant of rendering a target.
pub(super) struct Way<'a> {
    /// Poses and mesh.
    pub set: &'static str,
    /// The method of combining colours.
    pub method: String,
    pub maker: ViewMaker<'a>,
}

/// The result of one variant on one target.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Cell {
    pub set: String,
    pub method: String,
    /// As rendered.
    pub plain: Similarity,
    /// After the best gain and offset per channel.
    pub lit: Similarity,
    /// After that and the best shift, without pixels near the border; `None` if too little of the object is left.
    pub placed: Option<Similarity>,
    /// Fraction of the object's pixels that no source shows.
    pub unseen: f64,
}

/// One target, rendered with all variants; without cells if too little of it is shown by all.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct ViewRow {
    /// Name of its file.
    pub key: String,
    pub frame: (u32, u32),
    pub object: u32,
    /// Pixels of the crop that are compared.
    pub pixels: usize,
    pub cells: Vec<Cell>,
}

/// Plain texturing, averaging and every network with these sources; `judged` removes from each photograph the pixels that
/// the others contradict.
pub(super) fn ways<'a>(
    set: &'static str,
    mesh: &'a Mesh,
    sources: &[PosedImage],
    networks: &'a Networks,
    side: usize,
    judged: bool,
) -> Vec<Way<'a>> {
    // A photograph that cannot be cropped contributes nothing.
    let mut views: Vec<SourceView> =
        sources.iter().filter_map(|p| SourceView::new(p, mesh, side).ok()).collect();
    if judged {
        leave_out_what_differs(&mut views, mesh);
    }
    let plain = [("best", Weighting::Best), ("average", Weighting::Average)];
    let weightings = plain
        .into_iter()
        .map(|(name, weighting)| (name.to_owned(), weighting))
        .chain(networks.iter().map(|(name, model)| (name.clone(), Weighting::Network(model))));
    weightings
        .filter_map(|(method, weighting)| {
            let maker = ViewMaker::new(mesh, views.clone(), weighting, PER_VIEW).ok()?;
            Some(Way { set, method, maker })
        })
        .collect()
}

/// A target to be rendered.
pub(super) struct Target<'a> {
    pub key: &'a str,
    pub frame: (u32, u32),
    pub object: u32,
    pub photograph: &'a PosedImage,
    /// The mesh for the view of the model itself, with colours if it has any.
    pub mesh: &'a Mesh,
    pub side: usize,
}

/// Renders a target with all variants and compares them; also returns the images: the photograph, then one per cell.
pub(super) fn compare(
    target: &Target<'_>,
    ways: &[Way<'_>],
    judge: &ImageSimilarity,
) -> Result<(ViewRow, Vec<Patch>)> {
    let side = target.side;
    let real = SourceView::new(target.photograph, target.mesh, side)?;
    let camera = real.camera;
    let pose = *target.photograph.camera_from_object();
    let views: Vec<_> = ways.iter().map(|way| way.maker.render(&camera, &pose)).collect();
    let common = Mask::from_fn(side, side, |x, y| {
        let at = y * side + x;
        real.depth()[at] > 0.0
            && real.visible.data[at] > 0.5
            && views.iter().all(|v| v.mask.as_slice()[at] && !v.unseen.as_slice()[at])
    });
    let pixels = common.as_slice().iter().filter(|m| **m).count();
    let mut row = ViewRow {
        key: target.key.to_owned(),
        frame: target.frame,
        object: target.object,
        pixels,
        cells: vec![],
    };
    let mut pictures = vec![real.patch.clone()];
    let truth = judge.truth(&real.patch, &common);
    let inner = without_border(&common, MOVED);
    let large = inner.as_slice().iter().filter(|m| **m).count() >= MIN_PIXELS;
    let truth_in_inner = judge.truth(&real.patch, &inner);
    let mut add = |set: &str, method: &str, patch: &Patch, mask: &Mask, unseen: f64| {
        pictures.push(on_grey(patch, mask));
        let lit_patch = in_light_of(patch, &real.patch, &common);
        if let (Some(plain), Some(lit)) = (judge.compare(patch, &truth), judge.compare(&lit_patch, &truth)) {
            let placed = large
                .then(|| in_place_of(&lit_patch, &real.patch, &inner, MOVED))
                .and_then(|placed| judge.compare(&placed, &truth_in_inner));
            row.cells.push(Cell {
                set: set.to_owned(),
                method: method.to_owned(),
                plain,
                lit,
                placed,
                unseen,
            });
        }
    };
    if target.mesh.colors().is_some() || target.mesh.texture().is_some() {
        let whole = vec![Light::Ambient { color: [1.0; 3] }];
        for (method, lights) in [("its own colours", whole), ("under a lamp", Light::default_set())] {
            let mut frame = VisibilityBuffer::new(&camera);
            let objects = [SceneObject { mesh: target.mesh, camera_from_object: pose }];
            frame.render(&objects, &RenderOptions::default());
            let image = shade(&frame, &objects, &lights, &Surface::default(), None);
            add(MODEL, method, &Patch::from_rgb(&image), &frame.mask(0), 0.0);
        }
    }
    for (way, view) in ways.iter().zip(&views) {
        add(way.set, &way.method, &view.patch, &view.mask, view.unseen_fraction());
    }
    if pixels < MIN_PIXELS {
        row.cells.clear();
    }
    Ok((row, pictures))
}

/// The object on a grey background.
fn on_grey(patch: &Patch, mask: &Mask) -> Patch {
    let area = mask.as_slice().len();
    let mut out = Patch::filled(patch.width, patch.height, [0.5; 3]);
    for at in (0..area).filter(|at| mask.as_slice()[*at]) {
        (0..3).for_each(|c| out.data[c * area + at] = patch.data[c * area + at]);
    }
    out
}

/// The mesh with at most `faces` faces.
pub(super) fn coarse(mesh: &Mesh, faces: usize) -> Result<Mesh> {
    let simple = simplify(mesh, faces);
    Ok(Mesh::new(simple.vertices().to_vec(), simple.faces().to_vec())?)
}

/// The mesh with normally distributed noise on the vertices, metres along each axis.
pub(super) fn rough(mesh: &Mesh, deviation: f64, seed: u64) -> Result<Mesh> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut moved = |v: &Vec3| v + Vec3::from_fn(|_, _| deviation * f64::from(normal(&mut random)));
    let vertices: Vec<Vec3> = mesh.vertices().iter().map(&mut moved).collect();
    Ok(Mesh::new(vertices, mesh.faces().to_vec())?)
}

/// Means of one variant over the targets.
#[derive(Debug, Clone, Serialize)]
pub(super) struct ViewsSummary {
    pub set: String,
    pub method: String,
    pub targets: usize,
    pub plain: Similarity,
    pub lit: Similarity,
    /// Mean over the targets that are large enough.
    pub placed: Similarity,
    pub unseen: f64,
    /// Fraction of the targets on which it is perceptually more similar to the photograph than averaging from the same
    /// sources.
    pub better_than_average: Option<f64>,
}

/// Means over targets, in the order in which the variants first appear.
pub(super) fn summaries(rows: &[ViewRow]) -> Vec<ViewsSummary> {
    let mut names: Vec<(&str, &str)> = vec![];
    for cell in rows.iter().flat_map(|r| &r.cells) {
        if !names.contains(&(&cell.set, &cell.method)) {
            names.push((&cell.set, &cell.method));
        }
    }
    // If a variant is not possible for the photographs of one target, that order may be wrong.
    names.sort_by_key(|(set, _)| super::SETS.iter().position(|s| s == set));
    let find = |row: &ViewRow, set: &str, method: &str| {
        row.cells.iter().find(|c| c.set == set && c.method == method).cloned()
    };
    let mean = |cells: &[Cell], f: &dyn Fn(&Cell) -> Option<Similarity>| {
        let known: Vec<Similarity> = cells.iter().filter_map(f).collect();
        let of = |g: &dyn Fn(Similarity) -> f64| {
            known.iter().map(|s| g(*s)).sum::<f64>() / known.len().max(1) as f64
        };
        Similarity { psnr: of(&|s| s.psnr), ssim: of(&|s| s.ssim), perceptual: of(&|s| s.perceptual) }
    };
    names
        .into_iter()
        .map(|(set, method)| {
            let cells: Vec<Cell> = rows.iter().filter_map(|r| find(r, set, method)).collect();
            let pairs: Vec<bool> = rows
                .iter()
                .filter_map(|r| {
                    let (cell, average) = (find(r, set, method)?, find(r, set, "average")?);
                    Some(cell.plain.perceptual < average.plain.perceptual)
                })
                .collect();
            let better = pairs.iter().filter(|b| **b).count() as f64 / pairs.len().max(1) as f64;
            ViewsSummary {
                set: set.to_owned(),
                method: method.to_owned(),
                targets: cells.len(),
                plain: mean(&cells, &|c| Some(c.plain)),
                lit: mean(&cells, &|c| Some(c.lit)),
                placed: mean(&cells, &|c| c.placed),
                unseen: cells.iter().map(|c| c.unseen).sum::<f64>() / cells.len().max(1) as f64,
                better_than_average: (method != "average" && !pairs.is_empty()).then_some(better),
            }
        })
        .collect()
}
