//! Masks of the object in all photographs, and a mesh made from them.

use rayon::prelude::*;
use sixfold_board::Board;
use sixfold_geometry::{DepthImage, Image, Mask, Plane, Pose, Progress, Vec3};
use sixfold_mesh::{Mesh, simplify};
use sixfold_render::{Culling, RenderOptions, SceneObject, VisibilityBuffer};

use crate::error::TeachError;
use crate::fusion::{Carving, carved};
use crate::given::{given_masks, searched_volume};
use crate::grid::Grid;
use crate::hollow::hollowed;
use crate::hull::{Outlined, hull};
use crate::one_side::{self, OneSide};
use crate::paint::{SeenVertices, centre, finer};
use crate::placed::{PLACING_STEPS, placed};
use crate::silhouette::{Cues, Segmenter, consensus, masks};
use crate::standing::standing;
use crate::stereo::{Reach, StereoOptions, depths};
use crate::surface::surface;
use crate::unseen::rounded;
use crate::view::{PosedPhotograph, View, Volume};

/// Minimum number of photographs for a shape.
pub const FEWEST_PHOTOGRAPHS: usize = 4;
/// The same with measured depth.
pub const FEWEST_WITH_DEPTH: usize = 1;
/// Minimum angle between the directions from the object to two of the photographs, degrees.
pub(crate) const APART: f64 = 50.0;
/// A second part this large (fraction of the first) is a second object.
const SECOND: f64 = 0.2;
/// Parts whose boxes are this close belong to the same object, metres.
const TOGETHER: f64 = 0.015;
/// Why a photograph with an empty mask is left out.
pub(crate) const NOT_IN_SIGHT: &str = "the object is not in sight";
/// Overlap of a mask with the shape from all others below which it contradicts them.
const SAME: f64 = 0.7;
/// Maximum height of an object above the board, as a fraction of the sheet's longer side.
const HEIGHT: f64 = 1.0;
/// Steps of a reconstruction that are reported.
const SHAPE_STEPS: usize = 4;
/// Everything up to this height above the board belongs to the table, such as flat shadows and the sheet's own thickness; metres.
const TABLE: f64 = 0.0005;

/// Longer side of a view while the pose of a given mesh is found, pixels.
const LAID_SIDE: usize = 220;

/// Thickness of a wall into which stereo comparison makes no holes, voxels. Chosen by hand.
const WALL: f64 = 3.0;
/// The same for measured depth, metres. This, [`MEASURED_NOISE`] and [`JUMP`] were chosen by hand, on one simulated object (a ramekin).
const MEASURED_WALL: f64 = 0.0025;
/// Standard deviation of measured depth at half a metre, metres.
const MEASURED_NOISE: f64 = 0.0015;
/// A measured depth differs from that of the next pixel by more than this at the edge of a surface, metres: there cameras measure depths
/// between those of both surfaces.
const JUMP: f32 = 0.01;
/// Longer side of a view while hollows without texture are compared, pixels.
const HOLLOW_SIDE: usize = 200;
/// z of the up direction from which on an object counts as upright in the world.
const UPRIGHT: f64 = 0.999;

/// How far in front of and behind the hull depth is searched, metres.
const BEYOND: f32 = 0.003;

/// Resolutions of the reconstruction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShapeOptions {
    /// Pixels along the longer side of a view while the object is searched.
    pub coarse_side: usize,
    /// The same while its shape is made.
    pub fine_side: usize,
    /// Voxels along the longest side of the space that is searched.
    pub coarse_cells: usize,
    /// Voxels along the longest side of the object.
    pub fine_cells: usize,
    /// Pixels along the longer side of a view while photographs are compared with each other.
    pub stereo_side: usize,
    /// Whether hollows are carved where photographs show them.
    pub stereo: bool,
    /// Maximum number of faces of the mesh.
    pub faces: usize,
}

impl Default for ShapeOptions {
    fn default() -> Self {
        ShapeOptions {
            coarse_side: 320,
            fine_side: 512,
            coarse_cells: 96,
            fine_cells: 160,
            stereo_side: 288,
            stereo: true,
            faces: 20_000,
        }
    }
}

/// Photographs of one object that does not move in the world.
#[derive(Debug, Clone)]
pub struct Capture {
    /// The photographs.
    pub photographs: Vec<PosedPhotograph>,
    /// The board it stands on; the world is then the board's frame.
    pub board: Option<Board>,
    /// The plane on which the object stands, its normal upwards; `None` if unknown.
    pub floor: Option<Plane>,
    /// The up direction. If the floor is unknown, the object stands on the highest plane that the masks allow.
    pub up: Option<Vec3>,
    /// The volume in which the object is searched; `None` to compute it from masks.
    pub volume: Option<Volume>,
}

impl Capture {
    /// An object on a board.
    pub fn on_board(photographs: Vec<PosedPhotograph>, board: Board) -> Capture {
        let [low, high] = board.extent();
        let height = HEIGHT * (high - low).max();
        let volume = Volume { low: Vec3::new(low.x, low.y, 0.0), high: Vec3::new(high.x, high.y, height) };
        Capture {
            photographs,
            board: Some(board),
            floor: Some(Plane { normal: Vec3::z(), offset: 0.0 }),
            up: None,
            volume: Some(volume),
        }
    }

    /// An object in photographs with poses from elsewhere.
    pub fn without_board(photographs: Vec<PosedPhotograph>, floor: Option<Plane>) -> Capture {
        Capture { photographs, board: None, floor, up: None, volume: None }
    }

    /// The plane below which there is no object.
    fn floor(&self) -> Option<Plane> {
        self.floor.map(above_table)
    }
}

/// The plane below which there is no object that stands on a plane.
fn above_table(floor: Plane) -> Plane {
    Plane { offset: floor.offset + TABLE, ..floor }
}

pub(crate) fn step(progress: &dyn Progress, done: usize, total: usize) -> Result<(), TeachError> {
    if progress.report(done, total) { Ok(()) } else { Err(TeachError::Stopped) }
}

/// The object in the photographs: volume and masks.
#[derive(Debug, Clone)]
pub struct Segmentation {
    /// The volume that contains it.
    pub volume: Volume,
    /// For each photograph its mask, in the pixels of the whole photograph without lens distortion; `None` if the photograph was
    /// not used.
    pub masks: Vec<Option<Mask>>,
    /// Photographs that are not used, and why.
    pub left_out: Vec<(usize, String)>,
}

/// A mesh made from photographs.
#[derive(Debug, Clone)]
pub struct Shape {
    /// Closed, coloured, in metres; its frame has its origin at the centre of the mesh's box and the axes of the world.
    pub mesh: Mesh,
    /// Takes points of the object's frame to the world.
    pub world_from_object: Pose,
    /// Fraction of the surface that no photograph shows.
    pub unseen: f64,
    /// Fraction of the object's pixels in all photographs whose depth was measured or found by stereo comparison.
    pub with_depth: f64,
    /// Whether depth showed one side only: the other side is then assumed from symmetry.
    pub one_side: bool,
}

/// The views of the photographs that show a volume, with their numbers.
fn views_of(capture: &Capture, volume: &Volume, side: usize, used: &[usize]) -> Vec<(usize, View)> {
    let view = |i: &usize| View::new(&capture.photographs[*i], volume, side).map(|view| (*i, view));
    used.par_iter().filter_map(view).collect()
}

/// Finds the object in the photographs of a capture.
///
/// # Errors
/// [`TeachError`].
pub fn segment(
    capture: &Capture,
    segmenter: &dyn Segmenter,
    options: &ShapeOptions,
    progress: &dyn Progress,
) -> Result<Segmentation, TeachError> {
    check_count(capture)?;
    if (capture.volume.is_none() || capture.photographs.len() == 1)
        && let Some(found) = one_side::segmented(capture, segmenter, options)?
    {
        return Ok(found);
    }
    let searched = match capture.volume {
        Some(volume) => volume,
        None => searched_volume(capture, segmenter, options)?,
    };
    check_photographs(capture, &searched)?;
    if let Some(given) = given_masks(capture, &searched) {
        return Ok(given);
    }
    let all: Vec<usize> = (0..capture.photographs.len()).collect();
    let volume = rough_volume(capture, &searched, segmenter, options, progress)?;
    // Repeat in views of only the object and its surroundings.
    let around = volume.scaled(1.3).within(&searched);
    let views = views_of(capture, &around, options.fine_side, &all);
    let views = with_cues(views, capture, segmenter, progress, all.len())?;
    let odds: Vec<(View, Image<f32>)> = views.iter().map(|(_, v, c)| (v.clone(), c.sum())).collect();
    let shape = consensus(&odds, &around, options.coarse_cells, capture.floor());
    let shape = only_largest(&shape).ok_or_else(no_object)?;
    let numbers: Vec<usize> = views.iter().map(|v| v.0).collect();
    let views: Vec<(View, Cues)> = views.into_iter().map(|(_, v, c)| (v, c)).collect();
    let found = masks(&views, &shape, capture.floor());
    let (kept, left_out) = consistent(&views, found, &numbers, &around, capture, options)?;
    let mut whole = vec![None; capture.photographs.len()];
    for (number, view, mask) in &kept {
        whole[*number] = Some(in_photograph(&capture.photographs[*number], view, mask));
    }
    Ok(Segmentation { volume: around, masks: whole, left_out })
}

fn no_object() -> TeachError {
    TeachError::NoObject { hint: String::new() }
}

fn with_depth(capture: &Capture) -> bool {
    capture.photographs.iter().any(|p| p.depth.is_some())
}

fn check_count(capture: &Capture) -> Result<(), TeachError> {
    let found = capture.photographs.len();
    let minimum = if with_depth(capture) { FEWEST_WITH_DEPTH } else { FEWEST_PHOTOGRAPHS };
    if found < minimum {
        return Err(TeachError::TooFewPhotographs { found, minimum, reasons: String::new() });
    }
    Ok(())
}

fn check_photographs(capture: &Capture, searched: &Volume) -> Result<(), TeachError> {
    check_count(capture)?;
    if with_depth(capture) {
        return Ok(());
    }
    let centre = searched.centre();
    let towards: Vec<Vec3> = capture
        .photographs
        .iter()
        .map(|p| (p.camera_from_world.inverse().translation() - centre).normalize())
        .collect();
    let angle = |a: &Vec3, b: &Vec3| a.dot(b).clamp(-1.0, 1.0).acos().to_degrees();
    let largest = towards.iter().flat_map(|a| towards.iter().map(move |b| angle(a, b))).fold(0.0, f64::max);
    if largest < APART {
        return Err(TeachError::OneSide { degrees: largest, minimum: APART });
    }
    Ok(())
}

type Seen = (usize, View, Cues);

fn with_cues(
    views: Vec<(usize, View)>,
    capture: &Capture,
    segmenter: &dyn Segmenter,
    progress: &dyn Progress,
    first: usize,
) -> Result<Vec<Seen>, TeachError> {
    let total = 2 * capture.photographs.len();
    let mut seen = vec![];
    for (done, (number, view)) in views.into_iter().enumerate() {
        step(progress, first + done, total)?;
        let cues = Cues::new(&view, capture.board.as_ref(), segmenter).map_err(TeachError::Masks)?;
        seen.push((number, view, cues));
    }
    Ok(seen)
}

/// The box around the object.
fn rough_volume(
    capture: &Capture,
    searched: &Volume,
    segmenter: &dyn Segmenter,
    options: &ShapeOptions,
    progress: &dyn Progress,
) -> Result<Volume, TeachError> {
    let all: Vec<usize> = (0..capture.photographs.len()).collect();
    let views = views_of(capture, searched, options.coarse_side, &all);
    let minimum = if with_depth(capture) { 1 } else { FEWEST_PHOTOGRAPHS };
    if views.len() < minimum {
        return Err(TeachError::TooFewPhotographs { found: views.len(), minimum, reasons: String::new() });
    }
    let views = with_cues(views, capture, segmenter, progress, 0)?;
    let odds: Vec<(View, Image<f32>)> = views.into_iter().map(|(_, v, c)| (v, c.sum())).collect();
    let shape = consensus(&odds, searched, options.coarse_cells, capture.floor());
    let parts = objects(&shape);
    let Some(first) = parts.first() else { return Err(no_object()) };
    if let Some(second) = parts.get(1) {
        let fraction = second.len() as f64 / first.len() as f64;
        if fraction > SECOND {
            let found = parts.iter().filter(|p| p.len() as f64 > SECOND * first.len() as f64).count();
            return Err(TeachError::SeveralObjects { found, percent: 100.0 * fraction });
        }
    }
    let found = shape.volume_of(first).grown(2.0 * shape.step);
    Ok(found.within(searched))
}

/// Separate parts of a rough shape, largest first. Parts that are close together count as one object, because their connection
/// may be too thin to be visible.
fn objects(shape: &Grid) -> Vec<Vec<usize>> {
    let mut objects: Vec<(Volume, Vec<usize>)> = vec![];
    for part in shape.components() {
        let mut volume = shape.volume_of(&part).grown(0.5 * TOGETHER);
        let mut part = part;
        let mut apart = vec![];
        for (other, voxels) in objects {
            let common = volume.within(&other).size();
            if common.min() > 0.0 {
                part.extend(voxels);
                volume = Volume { low: volume.low.inf(&other.low), high: volume.high.sup(&other.high) };
            } else {
                apart.push((other, voxels));
            }
        }
        apart.push((volume, part));
        objects = apart;
    }
    let mut parts: Vec<Vec<usize>> = objects.into_iter().map(|(_, part)| part).collect();
    parts.sort_by_key(|p| std::cmp::Reverse(p.len()));
    parts
}

/// The field with only its largest object inside.
fn only_largest(shape: &Grid) -> Option<Grid> {
    let parts = objects(shape);
    let first = parts.first()?;
    let mut only = shape.clone();
    only.values.iter_mut().for_each(|v| *v = v.max(0.05));
    first.iter().for_each(|i| only.values[*i] = shape.values[*i]);
    Some(only)
}

type Kept = Vec<(usize, View, Mask)>;

/// Leaves out the photographs whose masks contradict the others.
fn consistent(
    views: &[(View, Cues)],
    found: Vec<Mask>,
    numbers: &[usize],
    volume: &Volume,
    capture: &Capture,
    options: &ShapeOptions,
) -> Result<(Kept, Vec<(usize, String)>), TeachError> {
    let mut left_out = vec![];
    let given = |i: usize| views[i].0.mask.is_some();
    let mut used: Vec<usize> = (0..views.len()).filter(|i| found[*i].as_slice().contains(&true)).collect();
    for i in (0..views.len()).filter(|i| !used.contains(i)) {
        left_out.push((numbers[i], NOT_IN_SIGHT.to_owned()));
    }
    // Repeat with the shape from the remaining masks, since a wrong mask also carved the first one.
    for _ in 0..3 {
        let outlined: Vec<Outlined<'_>> =
            used.iter().map(|i| Outlined::new(&views[*i].0, &found[*i])).collect();
        let shape = hull(&outlined, volume, options.coarse_cells, capture.floor());
        let overlap = |i: &usize| iou(&crate::silhouette::covered(&views[*i].0, &shape), &found[*i]);
        let overlaps: Vec<f64> = used.par_iter().map(overlap).collect();
        let worst = (0..used.len())
            .filter(|k| overlaps[*k] < SAME && !given(used[*k]))
            .min_by(|a, b| overlaps[*a].total_cmp(&overlaps[*b]));
        let Some(worst) = worst else { break };
        let bad = overlaps.iter().filter(|o| **o < SAME).count();
        if 2 * bad > used.len() {
            // It is unknown which one is wrong: leave out those that carve most, one after the other.
            let cutting = cutting_most(views, &found, &used).unwrap_or(worst);
            let number = numbers[used.remove(cutting)];
            left_out.push((number, "its mask cuts away what the others show".to_owned()));
        } else {
            let number = numbers[used.remove(worst)];
            left_out.push((number, "its mask contradicts the others: moved, or hidden?".to_owned()));
        }
    }
    let all = views.len();
    if 3 * left_out.len() > all.max(3) {
        return Err(TeachError::Contradicting { contradicting: left_out.len(), all });
    }
    left_out.sort();
    let kept = used.into_iter().map(|i| (numbers[i], views[i].0.clone(), found[i].clone())).collect();
    Ok((kept, left_out))
}

/// The view whose mask is smallest relative to its box in the image: it carves the hull most.
fn cutting_most(views: &[(View, Cues)], found: &[Mask], used: &[usize]) -> Option<usize> {
    let fraction = |k: usize| {
        let mask = &found[used[k]];
        let inside = mask.as_slice().iter().filter(|m| **m).count();
        inside as f64 / views[used[k]].0.image.as_slice().len() as f64
    };
    (0..used.len()).min_by(|a, b| fraction(*a).total_cmp(&fraction(*b)))
}

fn iou(a: &Mask, b: &Mask) -> f64 {
    let pairs = || a.as_slice().iter().zip(b.as_slice());
    let both = pairs().filter(|(a, b)| **a && **b).count();
    let either = pairs().filter(|(a, b)| **a || **b).count();
    if either == 0 { 0.0 } else { both as f64 / either as f64 }
}

/// A view's mask in the pixels of the photograph without its distortion.
fn in_photograph(photograph: &PosedPhotograph, view: &View, mask: &Mask) -> Mask {
    let (c, v) = (&photograph.camera, &view.camera);
    Image::from_fn(c.width, c.height, |x, y| {
        let along = |p: f64, from: (f64, f64), to: (f64, f64), length: usize| {
            let q = ((p - from.1) / from.0 * to.0 + to.1).round();
            (q >= 0.0 && q < length as f64).then_some(q as usize)
        };
        let u = along(x as f64, (c.fx, c.cx), (v.fx, v.cx), v.width);
        let w = along(y as f64, (c.fy, c.cy), (v.fy, v.cy), v.height);
        matches!((u, w), (Some(u), Some(w)) if mask[(u, w)])
    })
}

/// The inverse of [`in_photograph`].
fn in_view(view: &View, photograph: &PosedPhotograph, mask: &Mask) -> Mask {
    let (c, v) = (&photograph.camera, &view.camera);
    Image::from_fn(v.width, v.height, |x, y| {
        let u = ((x as f64 - v.cx) / v.fx * c.fx + c.cx).round();
        let w = ((y as f64 - v.cy) / v.fy * c.fy + c.cy).round();
        u >= 0.0 && w >= 0.0 && mask.get(u as usize, w as usize).copied().unwrap_or(false)
    })
}

/// The views of the photographs that show a volume, with their masks.
fn masked_views(
    capture: &Capture,
    found: &Segmentation,
    volume: &Volume,
    side: usize,
    used: &[usize],
) -> (Vec<View>, Vec<Mask>) {
    let masked = |(i, view): (usize, View)| {
        let mask = in_view(&view, &capture.photographs[i], found.masks[i].as_ref()?);
        Some((view, mask))
    };
    views_of(capture, volume, side, used).into_iter().filter_map(masked).unzip()
}

/// Makes a mesh of the object from photographs and masks.
///
/// # Errors
/// [`TeachError`].
pub fn reconstruct(
    capture: &Capture,
    found: &Segmentation,
    options: &ShapeOptions,
    progress: &dyn Progress,
) -> Result<Shape, TeachError> {
    let used: Vec<usize> = (0..found.masks.len()).filter(|i| found.masks[*i].is_some()).collect();
    step(progress, 0, SHAPE_STEPS)?;
    let one_side = OneSide::of(capture, &found.masks)?;
    let table = one_side.as_ref().and_then(|side| side.floor);
    let floor = capture.floor.or(table).map(above_table);
    let (views, masks) = masked_views(capture, found, &found.volume, options.fine_side, &used);
    let outlined: Vec<Outlined<'_>> = views.iter().zip(&masks).map(|(v, m)| Outlined::new(v, m)).collect();
    let volume = match &one_side {
        Some(side) => side.volume,
        None => {
            let rough = hull(&outlined, &found.volume, options.coarse_cells, floor);
            let parts = rough.components();
            let first = parts.first().ok_or_else(no_object)?;
            rough.volume_of(first).grown(2.0 * rough.step)
        }
    };
    step(progress, 1, SHAPE_STEPS)?;
    let fine = hull(&outlined, &volume, options.fine_cells, floor);
    let fine = match capture.up.filter(|_| floor.is_none()) {
        Some(up) => standing(fine, &views, &masks, &up),
        None => fine,
    };
    step(progress, 2, SHAPE_STEPS)?;
    let (fine, with_depth) = match depth_of(capture, &used, &found.volume, &fine, found, options) {
        Some(mut known) => {
            if let Some(side) = &one_side {
                side.replace(&known.views, &mut known.depths);
            }
            let wall = WALL * fine.step;
            let (wall, noise) =
                if known.measured { (wall.max(MEASURED_WALL), MEASURED_NOISE) } else { (wall, 0.0) };
            let carving = Carving {
                reach: 3.0 * fine.step,
                minimum: if known.measured { 1.0 } else { 3.0 },
                // The far side of one view's hull is unknown.
                wall: if one_side.is_some() { 0.0 } else { wall },
                noise,
            };
            let emptied = carved(&fine, &known.views, &known.depths, &carving);
            let upright = floor.map(|f| f.normal).or(capture.up).is_some_and(|up| up.z > UPRIGHT);
            let emptied = if !known.measured && upright {
                let (views, masks) = masked_views(capture, found, &volume, HOLLOW_SIDE, &used);
                hollowed(emptied, fine, &views, &masks)
            } else {
                emptied
            };
            (emptied, known.fraction)
        }
        None => (fine, 0.0),
    };
    let fine = match &one_side {
        Some(side) => side.completed(&fine),
        None => rounded(fine, &views, floor.map(|f| f.normal).or(capture.up)),
    };
    let mesh = surface(&fine.smoothed(0.8)).ok_or_else(no_object)?;
    step(progress, 3, SHAPE_STEPS)?;
    let mesh = simplify(&mesh, options.faces);
    let seen = SeenVertices::new(&mesh, &views);
    let (colors, unseen) = (seen.colors(), seen.unseen());
    let origin = centre(&mesh);
    let world_from_object = Pose::from_translation(origin);
    let mesh = mesh.transformed(&world_from_object.inverse());
    let mesh = mesh.clone().with_colors(colors).unwrap_or(mesh);
    step(progress, 4, SHAPE_STEPS)?;
    Ok(Shape { mesh, world_from_object, unseen, with_depth, one_side: one_side.is_some() })
}

/// Progress of one part of several: it continues the count of the previous part.
struct Part<'a> {
    whole: &'a dyn Progress,
    before: usize,
    total: usize,
}

impl Progress for Part<'_> {
    fn report(&self, done: usize, _: usize) -> bool {
        self.whole.report(self.before + done, self.total)
    }
}

/// Finds the pose of a given mesh in photographs with masks; the mesh keeps its frame, and its colours if it has any.
///
/// # Errors
/// [`TeachError`].
pub(crate) fn lay(
    capture: &Capture,
    found: &Segmentation,
    given: &Mesh,
    options: &ShapeOptions,
    progress: &dyn Progress,
) -> Result<Shape, TeachError> {
    let rough = ShapeOptions { stereo: false, ..*options };
    let total = SHAPE_STEPS + PLACING_STEPS;
    let hull = reconstruct(capture, found, &rough, &Part { whole: progress, before: 0, total })?;
    let hull_in_world = hull.mesh.transformed(&hull.world_from_object);
    let used: Vec<usize> = (0..found.masks.len()).filter(|i| found.masks[*i].is_some()).collect();
    let (low, high) = hull_in_world.bounding_box();
    let volume = Volume { low, high }.scaled(1.2);
    let (views, masks) = masked_views(capture, found, &volume, LAID_SIDE, &used);
    let part = Part { whole: progress, before: SHAPE_STEPS, total };
    let world_from_object = placed(given, &hull_in_world, &views, &masks, &part)?;
    let has_colors = given.colors().is_some() || given.texture().is_some();
    let mesh = if has_colors { given.clone() } else { finer(given, options.faces) };
    let views: Vec<View> =
        views_of(capture, &volume, options.fine_side, &used).into_iter().map(|(_, view)| view).collect();
    let in_world = mesh.transformed(&world_from_object);
    let seen = SeenVertices::new(&in_world, &views);
    let mesh = if has_colors { mesh } else { mesh.clone().with_colors(seen.colors()).unwrap_or(mesh) };
    Ok(Shape { mesh, world_from_object, unseen: seen.unseen(), with_depth: hull.with_depth, one_side: false })
}

/// Depth of views, measured or found by stereo comparison.
struct KnownDepth {
    views: Vec<View>,
    depths: Vec<DepthImage>,
    /// Whether it was measured.
    measured: bool,
    /// Fraction of the masks' pixels that have depth.
    fraction: f64,
}

fn depth_of(
    capture: &Capture,
    used: &[usize],
    volume: &Volume,
    hull: &Grid,
    found: &Segmentation,
    options: &ShapeOptions,
) -> Option<KnownDepth> {
    let measured = used.iter().all(|i| capture.photographs[*i].depth.is_some());
    if !measured && !options.stereo {
        return None;
    }
    let side = if measured { options.fine_side } else { options.stereo_side };
    let (views, masks) = masked_views(capture, found, volume, side, used);
    let all: Vec<DepthImage> = if measured {
        views.iter().filter_map(|v| v.depth.clone()).collect()
    } else {
        let mesh = surface(hull)?;
        let reaches: Vec<Reach> = views.par_iter().map(|view| reach(&mesh, view)).collect();
        depths(&views, &reaches, &StereoOptions::default())
    };
    // Keep only depth of the object, not of its surroundings.
    let depths: Vec<DepthImage> = all
        .iter()
        .zip(&masks)
        .zip(&views)
        .map(|((depth, mask), view)| {
            Image::from_fn(depth.width(), depth.height(), |x, y| {
                if mask[(x, y)] && !view.is_hidden((x, y)) { depth[(x, y)] } else { 0.0 }
            })
        })
        .collect();
    let pixels = masks.iter().map(|m| m.as_slice().iter().filter(|v| **v).count()).sum::<usize>();
    let known = depths.iter().map(|d| d.as_slice().iter().filter(|v| **v > 0.0).count()).sum::<usize>();
    let depths = if measured {
        depths.par_iter().zip(&all).map(|(depth, whole)| without_edges(depth, whole)).collect()
    } else {
        depths
    };
    Some(KnownDepth { views, depths, measured, fraction: known as f64 / pixels.max(1) as f64 })
}

/// A part of a depth image without the pixels next to a jump in the whole image.
fn without_edges(part: &DepthImage, whole: &DepthImage) -> DepthImage {
    let (width, height) = part.size();
    Image::from_fn(width, height, |x, y| {
        let here = part[(x, y)];
        let rows = y.saturating_sub(1)..(y + 2).min(height);
        let columns = x.saturating_sub(1)..(x + 2).min(width);
        let jumps = |there: f32| there > 0.0 && (there - here).abs() > JUMP;
        let at_edge = || rows.into_iter().any(|v| columns.clone().any(|u| jumps(whole[(u, v)])));
        if here > 0.0 && at_edge() { 0.0 } else { here }
    })
}

/// The depths at which the rays of a view's pixels enter a closed mesh and first leave it again, with a margin.
fn reach(mesh: &Mesh, view: &View) -> Reach {
    let depth_of = |mesh: &Mesh| {
        let mut buffer = VisibilityBuffer::new(&view.camera);
        let object = SceneObject { mesh, camera_from_object: view.camera_from_world };
        buffer.render(&[object], &RenderOptions { culling: Culling::Back, ..RenderOptions::default() });
        buffer.depth()
    };
    let front = depth_of(mesh).map(|d| d - BEYOND * f32::from(*d > 0.0));
    let negated = mesh.faces().iter().map(|[a, b, c]| [*a, *c, *b]).collect();
    let back = Mesh::new(mesh.vertices().to_vec(), negated);
    let back =
        back.map_or_else(|_| front.clone(), |back| depth_of(&back)).map(|d| d + BEYOND * f32::from(*d > 0.0));
    Reach { front, back }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_at_the_edge_of_a_surface_have_no_depth() {
        // A surface at 0.5 m before a table at 0.6 m, with depths between both at its edge; a slope; a pixel without depth.
        let depth =
            Image::from_vec(9, 1, vec![0.5, 0.5, 0.52, 0.595, 0.6, 0.6, 0.605, 0.0, 0.61f32]).unwrap();
        let left = without_edges(&depth, &depth);
        assert_eq!(left.as_slice(), [0.5, 0.0, 0.0, 0.0, 0.6, 0.6, 0.605, 0.0, 0.61]);
    }
}
