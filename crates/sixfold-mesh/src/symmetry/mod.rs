//! Rotations that map an object onto itself, found from its mesh and checked against its colours.
//!
//! Axes are proposed by a scan of all directions (`scan.rs`), refined on the surface (`axis.rs`), tested for every order and for
//! any angle, and completed to a group (`search.rs`). Each comes with its evidence: how far rotated points are from the
//! surface, and how much colours differ. Reflections are not searched, since no object can be rotated into its mirror image.
//!
//! Candidates by moments: after Martinet et al. 2006; proposals that are verified on the surface: after Mitra et al. 2006. What
//! counts as a symmetry: Hodan et al. 2020 (BOP), who bound the Hausdorff distance and leave out symmetries that the texture
//! resolves; their bound is the wider of the two here.

mod axis;
mod body;
mod color;
mod field;
mod scan;
mod search;

use sixfold_geometry::{OptionError, Pose, Vec3};

use crate::{ContinuousSymmetry, Mesh};
use axis::{Axis, angles_of_order};

/// A sure symmetry: 95 % of the points stay within this distance of the surface, as a fraction of the diameter. Scanned bowls, a
/// plate and a can stay below (docs/objects.md), and so does a cylinder with 16 facets.
const SURE_P95: f64 = 0.01;
/// A sure symmetry: all points stay within this distance. The handle of a mug is further away, and so is the knob of LM-O's glue.
const SURE_MAX: f64 = 0.04;
/// A likely symmetry: 95 % of the points. LM-O's egg box and glue, which its `models_info.json` calls symmetric, reach 0.02.
const LIKELY_P95: f64 = 0.03;
/// A likely symmetry: all points. A tenth of the diameter is the bound of Hodan et al. 2020, who then inspected every object
/// within it; with their 15 mm for small objects, any object of 5 cm would count as symmetric.
const LIKELY_MAX: f64 = 0.1;
/// The increase of the limits by expected noise, in standard deviations, added in squares. Both the moved point and the surface
/// have noise, but the distance is to the nearest point: boxes with independent noise on their vertices reach 1.7 and 3.3
/// (`noise_of_a_millimetre` in the tests).
const NOISE_P95: f64 = 2.0;
const NOISE_MAX: f64 = 4.0;
/// Colours are the same if 95 % of the smoothed ones differ by less than this, 0 to 1.
const SURE_COLOR: f64 = 0.1;
/// Colours may be the same if they differ by less than this: a scanned plate, whose texture contains the gloss of a lamp, reaches
/// 0.12.
const LIKELY_COLOR: f64 = 0.2;
/// Maximum noise that may be expected, metres, and as a fraction of the diameter: with more noise anything would be symmetric.
const MAX_NOISE: f64 = 0.02;
const MAX_RELATIVE_NOISE: f64 = 0.02;

/// Options of the search for symmetries.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SymmetryOptions {
    /// Standard deviation of the surface's noise, metres: 0 for a CAD mesh, 0.001 for a mesh from photographs.
    pub noise: f64,
    /// Points of the surface that are tested under every rotation.
    pub samples: usize,
    /// Seed of the surface samples.
    pub seed: u64,
}

impl Default for SymmetryOptions {
    fn default() -> Self {
        SymmetryOptions { noise: 0.0, samples: 1500, seed: 0 }
    }
}

impl SymmetryOptions {
    /// # Errors
    /// [`OptionError`] naming the option that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_within("noise", self.noise, 0.0..=MAX_NOISE, "0 to 0.02 m")?;
        OptionError::unless_within("samples", self.samples, 100..=100_000, "100 to 100000")
    }
}

/// How certain a symmetry is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Verdict {
    /// Not a symmetry.
    None,
    /// Proposed; it should be inspected.
    Likely,
    /// The deviation is as small as in meshes of symmetric objects.
    Sure,
}

impl Verdict {
    /// `none`, `likely` or `sure`.
    pub fn name(self) -> &'static str {
        match self {
            Verdict::None => "none",
            Verdict::Likely => "likely",
            Verdict::Sure => "sure",
        }
    }
}

/// How far points of the surface are from the surface after a rotation; the worst over several rotations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deviation {
    /// 95 % of the points are within this distance, metres.
    pub p95: f64,
    /// All tested points are within this distance, metres.
    pub max: f64,
}

/// How much smoothed colours differ after a rotation, 0 to 1 (black and white); the worst over several rotations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ColorDifference {
    /// Mean over the surface.
    pub mean: f64,
    /// 95 % of the points differ by less than this.
    pub p95: f64,
}

/// An axis about which an object can be rotated onto itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FoundSymmetry {
    /// Unit direction in the object's frame; its largest component is positive.
    pub axis: Vec3,
    /// The point of the axis nearest to the centroid of the surface, metres.
    pub point: Vec3,
    /// Rotations by multiples of a full turn over this number are symmetries; `None` where all rotations are.
    pub order: Option<u32>,
    /// Evidence of the shape.
    pub deviation: Deviation,
    /// Evidence of the colours; `None` for a mesh without any.
    pub color: Option<ColorDifference>,
    /// The largest extent of the object, metres.
    pub diameter: f64,
    /// By shape alone.
    pub by_shape: Verdict,
    /// By shape and colours; as by shape for a mesh without colours.
    pub by_shape_and_color: Verdict,
}

impl FoundSymmetry {
    /// The rotations of a discrete symmetry except the identity; empty for a continuous one.
    pub fn poses(&self) -> Vec<Pose> {
        let Some(order) = self.order else { return vec![] };
        let axis = Axis { direction: self.axis, point: self.point };
        angles_of_order(order).into_iter().map(|angle| axis.rotation(angle)).collect()
    }

    /// The axis of a continuous symmetry.
    pub fn continuous(&self) -> Option<ContinuousSymmetry> {
        let is_continuous = self.order.is_none();
        is_continuous.then_some(ContinuousSymmetry { axis: self.axis, offset: self.point })
    }

    /// The verdict by shape and colours, or by shape alone.
    pub fn verdict(&self, with_color: bool) -> Verdict {
        if with_color { self.by_shape_and_color } else { self.by_shape }
    }
}

/// The symmetries of a mesh that are at least likely by their shape, continuous ones first, then by order.
///
/// Sure discrete symmetries form a group: a square prism has one axis of order 4 and four of order 2. About a continuous axis no
/// discrete symmetry is listed; of the half turns perpendicular to it, one is listed, since the others follow. Where colours
/// allow fewer rotations than the shape, the largest order that they allow is listed too. A sphere has three continuous axes. The
/// same mesh and options give the same symmetries.
///
/// # Errors
/// [`OptionError`] for options out of their range, also for noise above a fiftieth of the object's diameter.
pub fn find_symmetries(mesh: &Mesh, options: &SymmetryOptions) -> Result<Vec<FoundSymmetry>, OptionError> {
    options.check()?;
    let body = body::Body::new(mesh, options);
    // A single point, or an object too small to have a shape in f64.
    if !(body.diameter > 1e-9) {
        return Ok(vec![]);
    }
    let expected = "at most a fiftieth of the object's diameter";
    OptionError::unless_within("noise", options.noise, ..=MAX_RELATIVE_NOISE * body.diameter, expected)?;
    Ok(search::Search::new(&body).run())
}

/// The sure symmetries in the form of an object's record: discrete rotations and continuous axes.
pub fn sure_symmetries(found: &[FoundSymmetry], with_color: bool) -> (Vec<Pose>, Vec<ContinuousSymmetry>) {
    let sure = || found.iter().filter(move |s| s.verdict(with_color) == Verdict::Sure);
    let mut discrete: Vec<Pose> = vec![];
    for pose in sure().flat_map(FoundSymmetry::poses) {
        // An order allowed by the colours may be listed besides the order of the shape.
        if discrete.iter().all(|d| d.rotation_angle_to(&pose) > 1e-3) {
            discrete.push(pose);
        }
    }
    (discrete, sure().filter_map(FoundSymmetry::continuous).collect())
}

/// The verdict on the shape.
fn shape_verdict(deviation: &Deviation, diameter: f64, noise: f64) -> Verdict {
    let within = |p95: f64, max: f64| {
        deviation.p95 <= (p95 * diameter).hypot(NOISE_P95 * noise)
            && deviation.max <= (max * diameter).hypot(NOISE_MAX * noise)
    };
    match (within(SURE_P95, SURE_MAX), within(LIKELY_P95, LIKELY_MAX)) {
        (true, _) => Verdict::Sure,
        (_, true) => Verdict::Likely,
        _ => Verdict::None,
    }
}

/// The verdict on the colours.
fn color_verdict(difference: &ColorDifference) -> Verdict {
    match difference.p95 {
        d if d <= SURE_COLOR => Verdict::Sure,
        d if d <= LIKELY_COLOR => Verdict::Likely,
        _ => Verdict::None,
    }
}

/// The value below which this fraction of values lies; 0 without values. Reorders them.
fn percentile(values: &mut [f64], fraction: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let rank = (fraction * (values.len() - 1) as f64).round() as usize;
    *values.select_nth_unstable_by(rank, f64::total_cmp).1
}
