//! A region with an object in it, a template of about the same pose, and one of another pose.

use rand::{Rng, RngExt};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use sixfold_align::DepthRegion;
use sixfold_geometry::nalgebra::{Unit, UnitQuaternion};
use sixfold_geometry::{Mask, Pose, Vec3};
use sixfold_mesh::Mesh;

use crate::from_mesh::draw_rotated;
use crate::patch::{PLANES, Patch, REACH, TemplateSurface};
use crate::pose_distance::pose_distance;
use crate::roi::{Cell, Roi, UNKNOWN};
use crate::template::Template;

/// Distance at which templates are rendered, metres; normals do not depend on it.
const DISTANCE: f64 = 0.8;

/// How regions and templates are made.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct AnchorOptions {
    /// Side of the network's input, pixels.
    pub side: usize,
    /// Border kept on each side for shifts, pixels.
    pub border: usize,
    /// Largest tilt and in-plane rotation between a region and its positive templates, radians: more than half the step between
    /// templates, because the nearest is not always the one that is found.
    pub tilt: f64,
    /// See `tilt`.
    pub turn: f64,
    /// Positive templates of an anchor.
    pub positives: usize,
}

impl AnchorOptions {
    /// For patches of `side` pixels.
    pub fn for_side(side: usize) -> Self {
        AnchorOptions { side, border: side * 3 / 14, tilt: 0.22, turn: 0.22, positives: 2 }
    }

    /// Side of a kept region, pixels.
    pub(crate) fn kept_side(&self) -> usize {
        self.side + 2 * self.border
    }
}

/// Quantisation steps of stored depth: 127 correspond to the patch's size.
const DEPTH_STEPS: f32 = 127.0;

/// A patch in bytes: normals in 127ths, depth in 127ths of the patch's size, and whether a pixel was measured.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SeenPatch {
    /// Pixels along a side.
    pub side: usize,
    /// Normal and depth of every pixel, row by row.
    pub cells: Vec<[i8; 4]>,
    /// Which of them were measured.
    pub known: Vec<bool>,
}

impl SeenPatch {
    fn of_cells(cells: &[Cell], size: f64, side: usize) -> SeenPatch {
        let byte = |v: f32| (v.clamp(-1.0, 1.0) * 127.0).round() as i8;
        let cell = |c: &Cell| match *c == UNKNOWN {
            true => [0; 4],
            false => [byte(c[1]), byte(c[2]), byte(c[3]), byte(c[0] / size as f32)],
        };
        let known = cells.iter().map(|c| *c != UNKNOWN).collect();
        SeenPatch { side, cells: cells.iter().map(cell).collect(), known }
    }

    fn of_patch(patch: &Patch) -> SeenPatch {
        let pixels = patch.side * patch.side;
        let byte = |v: f32| (v.clamp(-1.0, 1.0) * 127.0).round() as i8;
        let at = |k: usize, i: usize| patch.values[k * pixels + i];
        SeenPatch {
            side: patch.side,
            cells: (0..pixels)
                .map(|i| [byte(at(0, i)), byte(at(1, i)), byte(at(2, i)), byte(0.5 * at(3, i))])
                .collect(),
            known: (0..pixels).map(|i| at(4, i) > 0.5).collect(),
        }
    }

    /// The five planes of pixel `i` when the region's centre is `nearer` patch sizes further away.
    pub(super) fn planes(&self, i: usize, nearer: f32) -> [f32; PLANES] {
        if !self.known[i] {
            return [0.0; PLANES];
        }
        let [x, y, z, d] = self.cells[i].map(|v| f32::from(v) / 127.0);
        let depth = (2.0 * (d * 127.0 / DEPTH_STEPS - nearer)).clamp(-1.0, 1.0);
        [x, y, z, depth, 1.0]
    }
}

/// A template with its pose in the anchor's region.
#[derive(Debug, Clone)]
pub(super) struct Positive {
    pub patch: SeenPatch,
    /// Region from template.
    pub rotation: UnitQuaternion<f32>,
    /// The reference point in the region, in patch sizes.
    pub offset: [f32; 3],
}

/// A template of the same object in a pose that looks different.
#[derive(Debug, Clone)]
pub(super) struct Negative {
    pub patch: SeenPatch,
    /// Equation 5.2 between the region and this template.
    pub distance: f32,
}

/// A region of a scene and its templates.
#[derive(Debug, Clone)]
pub struct Anchor {
    /// Number of the object; `None` for a region without one.
    pub object: Option<usize>,
    pub(super) region: SeenPatch,
    /// Which pixels of the region belong to the object.
    pub(super) mask: Vec<bool>,
    pub(super) positives: Vec<Positive>,
    pub(super) negative: Option<Negative>,
}

/// A region with an object.
///
/// `visible` are the object's pixels in the scene. `None` when nothing of the object is rendered.
pub(super) fn anchor(
    scene: &DepthRegion,
    (number, mesh): (usize, &Mesh),
    camera_from_object: &Pose,
    visible: &Mask,
    options: &AnchorOptions,
    random: &mut ChaCha8Rng,
) -> Option<Anchor> {
    let diameter = mesh.diameter();
    let (size, side) = (REACH * diameter, options.side);
    let drawn_size = 1.1 * diameter;
    let draw = |rotation| draw_rotated(mesh, rotation, drawn_size, DISTANCE);
    let patch =
        |t: &Template| SeenPatch::of_patch(&TemplateSurface::new(t, drawn_size).patch(0.0, size, side));
    // The region is centred on the object's reference point, even if that is hidden.
    let (low, high) = mesh.bounding_box();
    let box_centre = camera_from_object.transform_point(&((low + high) * 0.5));
    let toward = Roi { centre: box_centre }.camera_from_roi().inverse() * *camera_from_object;
    let exact = draw(toward.rotation())?;
    let reference = |t: &Template| t.view_from_object.inverse().transform_point(&Vec3::zeros());
    let roi = Roi { centre: camera_from_object.transform_point(&reference(&exact)) };
    let roi_from_object = roi.camera_from_roi().inverse() * *camera_from_object;
    let rotation = roi_from_object.rotation();

    let kept = options.kept_side();
    let cells = roi.cells_on_grid(scene, size * kept as f64 / side as f64, kept, |_| true);
    let mask = looks_at(scene, &roi, size * kept as f64 / side as f64, kept, |p| visible.as_slice()[p]);
    let positives: Vec<Positive> = (0..options.positives)
        .filter_map(|_| {
            let template_from_roi = small_turn(options, random);
            let template = draw(template_from_roi * rotation)?;
            let offset = roi_from_object.transform_point(&reference(&template)) / size;
            Some(Positive {
                patch: patch(&template),
                rotation: template_from_roi.inverse().cast(),
                offset: [offset.x as f32, offset.y as f32, offset.z as f32],
            })
        })
        .collect();
    if positives.is_empty() {
        return None;
    }
    let negative = (0..3).find_map(|_| {
        let turn = any_rotation(random);
        let template = draw(turn * rotation)?;
        let distance = pose_distance((&rotation, &exact), (&(turn * rotation), &template));
        // Views that look the same are not negative templates.
        (turn.angle() > 0.5 && distance > 0.05)
            .then(|| Negative { patch: patch(&template), distance: distance as f32 })
    });
    Some(Anchor {
        object: Some(number),
        region: SeenPatch::of_cells(&cells, size, kept),
        mask,
        positives,
        negative,
    })
}

/// A region without an object around a point, of the size used for an object of `diameter` metres.
pub(super) fn without_object(
    scene: &DepthRegion,
    point: &Vec3,
    diameter: f64,
    options: &AnchorOptions,
) -> Anchor {
    let (size, kept) = (REACH * diameter, options.kept_side());
    let cells =
        Roi { centre: *point }.cells_on_grid(scene, size * kept as f64 / options.side as f64, kept, |_| true);
    Anchor {
        object: None,
        region: SeenPatch::of_cells(&cells, size, kept),
        mask: vec![false; kept * kept],
        positives: vec![],
        negative: None,
    }
}

/// Which cells of a region show pixels for which `of_kind` is true.
fn looks_at(
    scene: &DepthRegion,
    roi: &Roi,
    size: f64,
    side: usize,
    of_kind: impl Fn(usize) -> bool,
) -> Vec<bool> {
    roi.cells_on_grid(scene, size, side, of_kind).iter().map(|c| *c != UNKNOWN).collect()
}

/// A random rotation as occurs between a view and the templates near it.
fn small_turn(options: &AnchorOptions, random: &mut impl Rng) -> UnitQuaternion<f64> {
    let mut even = |limit: f64| limit * (2.0 * random.random::<f64>() - 1.0);
    let turn = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), even(options.turn));
    let axis = Unit::new_normalize(Vec3::new(even(1.0), even(1.0), 1e-9));
    turn * UnitQuaternion::from_axis_angle(&axis, even(options.tilt))
}

/// A uniformly random rotation (Shoemake 1992).
pub(super) fn any_rotation(random: &mut impl Rng) -> UnitQuaternion<f64> {
    let (u, v, w) = (random.random::<f64>(), random.random::<f64>(), random.random::<f64>());
    let (v, w) = (std::f64::consts::TAU * v, std::f64::consts::TAU * w);
    let (a, b) = ((1.0 - u).sqrt(), u.sqrt());
    UnitQuaternion::from_quaternion(sixfold_geometry::nalgebra::Quaternion::new(
        a * v.sin(),
        a * v.cos(),
        b * w.sin(),
        b * w.cos(),
    ))
}
