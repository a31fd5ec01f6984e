//! Grasps from the nearest experiences: retrieval, transfer, stand-off, and search for a collision-free pose.

use std::collections::BTreeSet;

use rayon::prelude::*;
use sixfold_experience::{Crop, CropError, Match, StoreError, Summary, turn};
use sixfold_geometry::nalgebra::{UnitQuaternion, Vector3};
use sixfold_geometry::{IcpError, IndexedCloud, OptionError, Pose, Vec3};
use sixfold_grasp::{Grasp, GraspFitter, Gripper, centre_between_pads};
use thiserror::Error;

use super::Memory;
use super::align::{
    AlignmentHypothesis, ExperienceAlignmentOptions, Transferred, misfit, noc, pixels_near, transfer,
};
use crate::model::DgcmModel;

/// Errors of proposals from experience.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ProposeError {
    /// The object cannot be cropped.
    #[error(transparent)]
    Crop(#[from] CropError),
    /// The store.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The object's cloud has no normals.
    #[error(transparent)]
    Cloud(#[from] IcpError),
    /// An option is out of its range.
    #[error(transparent)]
    Option(#[from] OptionError),
}

/// Options of the transfer of grasps.
#[derive(Debug, Clone, PartialEq)]
pub struct ProposeOptions {
    /// Nearest features that are tried (dissertation: 10).
    pub neighbours: usize,
    /// How they are aligned.
    pub align: ExperienceAlignmentOptions,
    /// Also compare the shapes of upright objects, in addition to the network's predictions.
    pub shapes: bool,
    /// How far the tips reach over the nearest point of the object's surface, metres: the dissertation's fixed distance, at which a
    /// grasp is used as transferred. `None`: as far as in the experience, at the nearest pose where the gripper is free.
    pub reach: Option<f64>,
    /// The score of a grasp falls to 1/e if the mean distances between the visible surfaces, in both directions, are together larger by
    /// this than for the best alignment, metres. `None`: the score is that of equation 6.6, however well the surfaces fit.
    pub fit_scale: Option<f64>,
    /// Only experiences on parts with this name.
    pub part: Option<String>,
    /// Only the experiences with these numbers.
    pub only: Option<BTreeSet<i64>>,
    /// Exclude experiences with this object, for tests on it.
    pub without_object: Option<String>,
}

impl Default for ProposeOptions {
    fn default() -> Self {
        ProposeOptions {
            neighbours: 10,
            align: ExperienceAlignmentOptions::default(),
            shapes: true,
            reach: None,
            fit_scale: Some(FIT_SCALE),
            part: None,
            only: None,
            without_object: None,
        }
    }
}

/// The default of [`ProposeOptions::fit_scale`]. Chosen on the transfers of figure 6.7 with four experiences, where a quarter of it is
/// as good; not swept further.
const FIT_SCALE: f64 = 0.01;
/// [`ProposeOptions::reach`] of the published form. The dissertation does not state the distance; chosen among 1, 2, 3, 4 and 5 cm on
/// grasps of procedural objects (`sixfold grasp compare --published-rules`).
const PUBLISHED_REACH: f64 = 0.03;

impl ProposeOptions {
    /// The network alone (section 6.2.3): ten neighbours, theta_c = 0.3, the rotation of equation 6.5, the translation by extents,
    /// ICP, and the gripper at a fixed distance from the surface. Grasps that would collide are left out.
    pub fn published() -> ProposeOptions {
        ProposeOptions {
            align: ExperienceAlignmentOptions { only_scaled: true, ..ExperienceAlignmentOptions::default() },
            shapes: false,
            reach: Some(PUBLISHED_REACH),
            fit_scale: None,
            ..ProposeOptions::default()
        }
    }

    /// Checks every field, including those of the alignment.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_some("neighbours", self.neighbours)?;
        OptionError::unless_weight("reach", self.reach.unwrap_or(0.0))?;
        if let Some(scale) = self.fit_scale {
            OptionError::unless_positive("fit_scale", scale, "a length above 0, metres")?;
        }
        self.align.check()
    }
}

/// A grasp from experience.
#[derive(Debug, Clone, PartialEq)]
pub struct Proposal {
    /// The grasp, free of collisions with known points.
    pub grasp: Grasp,
    /// Equation 6.6: `exp(-distance of the features)`, lowered by [`ProposeOptions::fit_scale`].
    pub score: f64,
    /// The experience.
    pub from: Match,
    /// The assumption about the object's size or rotation.
    pub hypothesis: AlignmentHypothesis,
    /// Distance by which the grasp was moved from its transferred pose, metres.
    pub moved: f64,
    /// Whether the contacts are inside their friction cones, as far as known.
    pub firm: bool,
}

/// Everything that experience predicts for an object.
#[derive(Debug, Clone)]
pub struct Proposals {
    /// The nearest experiences, nearest first.
    pub nearest: Vec<Match>,
    /// The network's input for the object.
    pub crop: Crop,
    /// The grasps, those of the nearest experience first.
    pub proposals: Vec<Proposal>,
    /// For every pixel of the crop the fraction of experiences (weighted by equation 6.6) in which its counterpart was between the
    /// pads, 0 to 1.
    pub held_before: Vec<f64>,
    /// Centres between the pads, transferred from experience to this object, camera frame, with their weights; empty if shapes were
    /// not compared.
    pub grasp_centres: Vec<(Vec3, f64)>,
}

impl Proposals {
    /// How much a grasp holds the same part as the experience: the mean of [`Proposals::held_before`] over the pixels between its
    /// pads (0 if too few are visible), times a weight for the distance of the centre between its pads from those of the
    /// experiences.
    pub(crate) fn holds_the_same(&self, grasp: &Grasp, gripper: &Gripper) -> f64 {
        let held = between_pads(&self.crop, &grasp.camera_from_gripper, grasp.opening, gripper);
        if held.len() < FEWEST_HELD {
            return 0.0;
        }
        let same = held.iter().map(|&i| self.held_before[i]).sum::<f64>() / held.len() as f64;
        let weights: f64 = self.grasp_centres.iter().map(|m| m.1).sum();
        if weights <= 0.0 {
            return same;
        }
        let centre = centre_between_pads(&grasp.camera_from_gripper);
        let near = |m: &(Vec3, f64)| {
            m.1 * (-0.5 * (m.0 - centre).norm_squared() / (GRASP_CENTRE_SCALE * GRASP_CENTRE_SCALE)).exp()
        };
        same * self.grasp_centres.iter().map(near).sum::<f64>() / weights
    }
}

/// Standard deviation of the centre between the pads around that of the experience, metres.
const GRASP_CENTRE_SCALE: f64 = 0.02;

/// Fewest pixels between the pads of a grasp that can be rated.
pub(super) const FEWEST_HELD: usize = 4;
/// Pixels whose VD-NOC are closer than this to those of held pixels are their counterparts. It is less than the 0.3 by which a
/// whole region is located, because a handle is thin.
const COUNTERPART: f64 = 0.2;

/// Pixels whose points are between the pads of a gripper.
pub(super) fn between_pads(
    crop: &Crop,
    camera_from_gripper: &Pose,
    opening: f64,
    gripper: &Gripper,
) -> Vec<usize> {
    let gripper_from_camera = camera_from_gripper.inverse();
    let inside =
        |i: &usize| gripper.is_between_pads(&gripper_from_camera.transform_point(&crop.point(*i)), opening);
    crop.pixels().filter(inside).collect()
}

/// Number of nearest features, including in-plane copies, whose experiences are compared by shape.
const IN_SHAPES: usize = 60;

/// Proposes grasps on the object of a fitter's view, tested and rated by the fitter.
///
/// # Errors
/// [`ProposeError`]. It is not an error if there is no experience, or none that fits: then there are no proposals.
pub fn propose(
    fitter: &GraspFitter<'_>,
    model: &DgcmModel,
    memory: &mut Memory,
    options: &ProposeOptions,
) -> Result<Proposals, ProposeError> {
    options.check()?;
    let (view, gripper) = (fitter.view(), fitter.gripper());
    let crop = Crop::of_view(view, model.crop_options())?;
    let input = model.encode(&crop);
    let wanted = |s: &Summary| {
        options.part.as_ref().is_none_or(|part| s.part.as_ref() == Some(part))
            && options.only.as_ref().is_none_or(|only| only.contains(&s.id))
            && options.without_object.as_ref().is_none_or(|object| s.object != *object)
    };
    // One search for both methods; the network aligns the first of them.
    let in_shapes = memory.nearest(&input.feature, options.neighbours.max(IN_SHAPES), wanted);
    let nearest = in_shapes[..in_shapes.len().min(options.neighbours)].to_vec();
    let trim = model.crop_options().trim;
    let mut experiences = vec![];
    for m in &nearest {
        if let Some(stored) = memory.get(m.experience)? {
            let copy = if m.angle == 0.0 {
                stored.experience.crop.clone()
            } else {
                stored.experience.crop.rotated(m.angle, trim)
            };
            experiences.push((*m, stored, copy));
        }
    }
    experiences.retain(|(_, stored, copy)| copy.side == crop.side && !stored.experience.copies.is_empty());
    if experiences.is_empty() || view.object.is_empty() {
        let held_before = vec![0.0; crop.mask.len()];
        return Ok(Proposals { nearest, crop, proposals: vec![], held_before, grasp_centres: vec![] });
    }
    let cloud = IndexedCloud::new(view.object.clone())?;
    let planes: Vec<Vec<f32>> = experiences.iter().map(|(.., copy)| copy.vd_noc_planes()).collect();
    let asked: Vec<(&[f32], &[f32])> = experiences
        .iter()
        .zip(&planes)
        .map(|((m, stored, _), planes)| {
            let copies = &stored.experience.copies;
            let feature = copies.iter().find(|c| c.angle == m.angle).unwrap_or(&copies[0]);
            (feature.feature.as_slice(), planes.as_slice())
        })
        .collect();
    let coordinates = model.coordinates(&input, &asked);
    let mut held_before = vec![0.0; crop.mask.len()];
    let mut weights = 0.0;
    for ((from, stored, copy), coordinates) in experiences.iter().zip(&coordinates) {
        let e = &stored.experience;
        let pose = turn(from.angle) * e.camera_from_gripper;
        let held = between_pads(copy, &pose, e.opening, &e.gripper);
        if held.len() < FEWEST_HELD {
            continue;
        }
        let stride = held.len().div_ceil(60);
        let anchors: Vec<Vec3> = held.iter().step_by(stride).map(|&i| noc(&copy.vd_noc[i])).collect();
        let weight = (-from.distance).exp();
        weights += weight;
        for i in pixels_near(&crop, coordinates, &anchors, COUNTERPART) {
            held_before[i] += weight;
        }
    }
    held_before.iter_mut().for_each(|h| *h /= f64::max(weights, 1e-300));
    let found: Vec<Vec<(Proposal, f64)>> = experiences
        .par_iter()
        .zip(&coordinates)
        .map(|((from, stored, copy), coordinates)| {
            let e = &stored.experience;
            let region = rotated_region(&e.region, copy);
            let rotated_grasp = turn(from.angle) * e.camera_from_gripper;
            let aligned = transfer(&crop, &cloud, coordinates, copy, &region, &options.align);
            aligned
                .iter()
                .filter_map(|t| {
                    let source = Source { copy, grasp: &rotated_grasp, opening: e.opening, width: e.width };
                    let placed = match options.reach {
                        None => place(fitter, gripper, &source, t),
                        Some(reach) => at_distance(fitter, &source, t, reach).map(|g| (g, 0.0, false)),
                    };
                    placed.map(|(grasp, moved, firm)| {
                        let (score, hypothesis) = ((-from.distance).exp(), t.hypothesis);
                        let pose = &t.camera_from_experience;
                        let misfit = options.fit_scale.map_or(0.0, |_| misfit(&crop, &cloud, copy, pose));
                        (Proposal { grasp, score, from: *from, hypothesis, moved, firm }, misfit)
                    })
                })
                .collect()
        })
        .collect();
    let proposals = scored_by_fit(found.into_iter().flatten().collect(), options.fit_scale);
    let mut found = Proposals { nearest, crop, proposals, held_before, grasp_centres: vec![] };
    if options.shapes {
        found.add_shapes(fitter, memory, &in_shapes[..in_shapes.len().min(IN_SHAPES)])?;
    }
    Ok(found)
}

/// Proposals, given with the misfits of their alignments, with scores that are lower where the surfaces fit worse.
fn scored_by_fit(found: Vec<(Proposal, f64)>, scale: Option<f64>) -> Vec<Proposal> {
    let best = found.iter().map(|(_, misfit)| *misfit).fold(f64::INFINITY, f64::min);
    let lowered = |(proposal, misfit): (Proposal, f64)| {
        let factor = scale.map_or(1.0, |scale| ((best - misfit) / scale).exp());
        Proposal { score: proposal.score * factor, ..proposal }
    };
    found.into_iter().map(lowered).collect()
}

/// The region of an experience in its in-plane copy, from the source pixels of the copy.
fn rotated_region(region: &[bool], copy: &Crop) -> Vec<bool> {
    (0..copy.mask.len())
        .map(|i| copy.mask[i] && region.get(copy.source[i] as usize).copied().unwrap_or(false))
        .collect()
}

/// The grasp to be transferred.
pub(super) struct Source<'a> {
    pub copy: &'a Crop,
    pub grasp: &'a Pose,
    pub opening: f64,
    pub width: f64,
}

/// Places the transferred grasp at its stand-off, at the nearest pose where the gripper is free: slightly shifted and rotated, or
/// retracted. Returns the grasp, the distance by which it was moved, and whether its contacts are inside their friction cones.
pub(super) fn place(
    fitter: &GraspFitter<'_>,
    gripper: &Gripper,
    source: &Source<'_>,
    t: &Transferred,
) -> Option<(Grasp, f64, bool)> {
    let room = (source.opening - source.width).max(2.0 * fitter.options().clearance);
    // The scale across the fingers, along the closing direction of the experience.
    let closing = source.grasp.transform_direction(&Vec3::x()).map(f64::abs);
    let scale = (t.scale.dot(&closing.component_mul(&closing))).clamp(0.5, 2.0);
    let widths = [source.width, source.width * scale];
    let expected = widths.map(|w| w.max(0.002));
    let mut openings: Vec<f64> = widths
        .iter()
        .map(|w| w + room)
        .chain([gripper.max_opening])
        // Not `clamp`, because the maximum opening of a small gripper may be less than a centimetre.
        .map(|o| o.max(0.01).min(gripper.max_opening))
        .collect();
    openings.dedup_by(|a, b| (*a - *b).abs() < 0.002);
    let start = t.camera_from_experience * *source.grasp;
    let start = stand_off(fitter, gripper, source, &start);
    let mut best: Option<(f64, Grasp, f64)> = None;
    let mut loose: Option<(Grasp, f64)> = None;
    for back in [0.0, 0.008, 0.02, 0.035] {
        for angle in [0.0f64, -0.15, 0.15, -0.35, 0.35] {
            for shift in [0.0, -0.006, 0.006, -0.014, 0.014] {
                let about = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle);
                let pose = start * Pose::new(about, Vec3::new(shift, 0.0, -back));
                let moved = back + f64::abs(shift) + 0.05 * angle.abs();
                for &opening in &openings {
                    if let Some(grasp) = fitter.fit(&pose, opening) {
                        // A much wider or thinner part is another part of the object.
                        let other = expected.iter().map(|w| (grasp.width / w).ln().abs());
                        let other = other.fold(f64::INFINITY, f64::min);
                        if other > OTHER_PART.ln() {
                            continue;
                        }
                        let value = grasp.quality.total() * (-moved / 0.03 - other).exp();
                        if best.as_ref().is_none_or(|b| value > b.0) {
                            best = Some((value, grasp, moved));
                        }
                    } else if loose.is_none() && angle == 0.0 {
                        loose = fitter.accept(&pose, opening).map(|grasp| (grasp, moved));
                    }
                }
            }
        }
        if best.is_some() {
            break;
        }
    }
    best.map(|(_, grasp, moved)| (grasp, moved, true)).or(loose.map(|(grasp, moved)| (grasp, moved, false)))
}

/// The transferred grasp, moved along its approach until its tips reach `reach` metres over the object's surface (section 6.2.3);
/// `None` if nothing is between its pads there, or the gripper collides.
fn at_distance(fitter: &GraspFitter<'_>, source: &Source<'_>, t: &Transferred, reach: f64) -> Option<Grasp> {
    let pose = t.camera_from_experience * *source.grasp;
    let opening = fitter.gripper().max_opening;
    let surface = fitter.reach(&pose, opening)?;
    fitter.accept(&(pose * Pose::from_translation(Vec3::z() * (surface + reach))), opening)
}

/// Contacts whose distance differs from that in the experience by more than this factor are on another part.
const OTHER_PART: f64 = 2.2;

/// Moves a grasp along its approach until its tips reach over the object as far as they did in the experience.
fn stand_off(fitter: &GraspFitter<'_>, gripper: &Gripper, source: &Source<'_>, pose: &Pose) -> Pose {
    let gripper_from_camera = source.grasp.inverse();
    let then = source
        .copy
        .pixels()
        .map(|i| gripper_from_camera.transform_point(&source.copy.point(i)))
        .filter(|p| {
            p.x.abs() < 0.5 * source.opening && p.y.abs() < 0.5 * gripper.finger_width && p.z.abs() < 0.2
        })
        .map(|p| p.z)
        .min_by(f64::total_cmp);
    match (then, fitter.reach(pose, source.opening)) {
        (Some(then), Some(now)) => {
            *pose * Pose::from_translation(Vec3::z() * (now - then).clamp(-0.06, 0.06))
        }
        _ => *pose,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_experience::CropOptions;
    use sixfold_geometry::{Camera, Image, Mask};
    use sixfold_grasp::{AntipodalQuality, gripper_pose};

    #[test]
    fn options_out_of_range_are_named() {
        let options = ProposeOptions::default();
        assert_eq!(options.check(), Ok(()));
        assert!(options.fit_scale.is_some() && ProposeOptions::published().fit_scale.is_none());
        let none = ProposeOptions { neighbours: 0, ..options.clone() };
        assert_eq!(none.check().unwrap_err().option, "neighbours");
        let flat = ProposeOptions { fit_scale: Some(0.0), ..options.clone() };
        assert_eq!(flat.check().unwrap_err().option, "fit_scale");
        let align = ExperienceAlignmentOptions { threshold: f64::NAN, ..options.align };
        assert_eq!(ProposeOptions { align, ..options }.check().unwrap_err().option, "align.threshold");
    }

    #[test]
    fn a_grasp_whose_surfaces_fit_worse_has_a_lower_score() {
        let quality = AntipodalQuality { alignment: 1.0, support: 1.0, centring: 1.0, observed: 1.0 };
        let grasp = Grasp { camera_from_gripper: Pose::identity(), opening: 0.06, width: 0.04, quality };
        let from = Match { experience: 1, angle: 0.0, distance: 0.5 };
        let hypothesis = AlignmentHypothesis::Scaled;
        let proposal = |score| Proposal { grasp, score, from, hypothesis, moved: 0.0, firm: true };
        let found = || vec![(proposal(0.8), 0.025), (proposal(0.5), 0.005)];
        let scores = |scale| scored_by_fit(found(), scale).iter().map(|p| p.score).collect::<Vec<f64>>();
        assert_eq!(scores(None), [0.8, 0.5], "equation 6.6 alone");
        let lowered = scores(Some(0.01));
        assert!((lowered[0] - 0.8 * (-2f64).exp()).abs() < 1e-12 && lowered[1] == 0.5, "{lowered:?}");
        assert!(scored_by_fit(vec![], Some(0.01)).is_empty());
    }

    #[test]
    fn held_surface_is_looked_up_between_the_pads() {
        // A plate of 12 x 4 cm at 0.7 m, whose left third was held in experience.
        let camera = Camera::new(575.0, 575.0, 159.5, 119.5, 320, 240).unwrap();
        let inside = |x: usize, y: usize| (110..209).contains(&x) && (103..136).contains(&y);
        let depth = Image::from_fn(320, 240, |x, y| if inside(x, y) { 0.7 } else { 0.0 });
        let mask = Mask::from_fn(320, 240, inside);
        let crop = Crop::new(&depth, &camera, &mask, &CropOptions::compact()).unwrap();
        let mut held_before = vec![0.0; crop.mask.len()];
        for i in crop.pixels().filter(|&i| crop.points[i][0] < -0.02) {
            held_before[i] = 0.8;
        }
        let found =
            Proposals { nearest: vec![], crop, proposals: vec![], held_before, grasp_centres: vec![] };
        let gripper = Gripper::built_in("jaws-85").unwrap();
        let at = |x: f64| {
            let pose = gripper_pose(&Vec3::new(x, 0.0, 0.72), &Vec3::z(), &Vec3::y()).unwrap();
            let quality = AntipodalQuality { alignment: 1.0, support: 1.0, centring: 1.0, observed: 1.0 };
            let grasp = Grasp { camera_from_gripper: pose, opening: 0.06, width: 0.04, quality };
            found.holds_the_same(&grasp, &gripper)
        };
        assert!((at(-0.04) - 0.8).abs() < 1e-9);
        assert_eq!(at(0.04), 0.0);
        // Half of the pixels between the pads.
        assert!((at(-0.02) - 0.4).abs() < 0.06, "{}", at(-0.02));
        assert_eq!(at(0.5), 0.0, "beside the object");
        // In one experience the centre was 1.5 cm behind that of this grasp, in another one, which fits worse, far away.
        let grasp = |x: f64| {
            let pose = gripper_pose(&Vec3::new(x, 0.0, 0.72), &Vec3::z(), &Vec3::y()).unwrap();
            let quality = AntipodalQuality { alignment: 1.0, support: 1.0, centring: 1.0, observed: 1.0 };
            Grasp { camera_from_gripper: pose, opening: 0.06, width: 0.04, quality }
        };
        let centre = centre_between_pads(&grasp(-0.04).camera_from_gripper);
        let grasp_centres = vec![(centre + Vec3::z() * 0.015, 0.75), (centre + Vec3::x() * 0.3, 0.25)];
        let found = Proposals { grasp_centres, ..found };
        let fraction = 0.75 * (-0.5f64 * (0.015f64 / GRASP_CENTRE_SCALE).powi(2)).exp();
        assert!((found.holds_the_same(&grasp(-0.04), &gripper) - 0.8 * fraction).abs() < 1e-6);
    }
}
