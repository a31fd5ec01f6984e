//! From a prepared scene and an object's templates to poses: sample regions, match, mask, merge, match again, align, verify
//! (dissertation, sections 5.2.4 and 5.2.5).

use std::sync::Arc;
use std::time::Instant;

use rayon::prelude::*;
use serde::Serialize;
use sixfold_align::{
    DepthRegion, VerificationOptions, VerificationScore, VerifiedPose, verify, verify_published,
};
use sixfold_geometry::{OptionError, Pose, Vec3};
use sixfold_mesh::Mesh;

use crate::align::{align, camera_from_view};
use crate::judge::{Surface, judge};
use crate::mask::{Pixels, common, template_mask};
use crate::matching::{Match, MatchOptions, Matcher};
use crate::roi::{ProposalOptions, Roi, propose};
use crate::template::{ObjectTemplates, Source};
use crate::views::ViewCoverage;
use crate::{by_network, learned::Learned, published, regions::RegionCache, segmentation};

/// How regions are matched with templates.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MatchedBy {
    /// [`Matcher`]: templates and regions point by point.
    Points,
    /// The network's descriptors alone (dissertation, section 5.2.4).
    Network,
    /// The network's descriptors choose the regions; points and network both match them with templates.
    Both,
}

/// Where the masks of estimates come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MaskSource {
    /// From the matched template, aligned with the scene.
    Aligned,
    /// Predicted by the network before any alignment (dissertation, section 5.3.2). Regions and hypotheses are then those of the
    /// network alone.
    Network,
}

/// Options of the search for objects.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MttmOptions {
    /// How regions are matched; without a network always by points.
    pub matched_by: MatchedBy,
    /// Use the rotation and the position that the network predicts for a matched template (dissertation, table 5.2: with and
    /// without).
    pub predicted_pose: bool,
    /// Where regions are sampled.
    pub proposals: ProposalOptions,
    /// Regions of the first matching whose templates are aligned with the scene.
    pub placed: usize,
    /// Those of them that get a mask; in the published form, regions left after the rejection (dissertation: 50).
    pub masked: usize,
    /// Regions left after merging.
    pub regions: usize,
    /// Pose hypotheses of a region (dissertation: 5), for matching by points and for the published form.
    pub hypotheses: usize,
    /// Pose hypotheses that the network adds to those of a region; not used in the published form.
    pub network_hypotheses: usize,
    /// Hypotheses that are refined and verified with the mesh, if there is one.
    pub verified: usize,
    /// Where masks come from; without a network always from aligned templates.
    pub masks: MaskSource,
    /// Regions, masks and hypotheses as published, if there is a network; see [`MttmOptions::published`].
    pub published: bool,
    /// Align matched templates with the scene's surface; otherwise the pose is that of the nearest template, as matched.
    pub align: bool,
    /// Thresholds of the scores.
    pub verification: VerificationOptions,
    /// Maximum number of instances.
    pub max_instances: usize,
    /// Estimates with a lower confidence are not returned.
    pub min_score: f64,
}

/// [`MttmOptions::placed`]; chosen by hand for run time, not swept.
const PLACED: usize = 160;
/// [`MttmOptions::masked`]; chosen by hand for run time, not swept.
const MASKED: usize = 50;
/// [`MttmOptions::regions`]; chosen by hand, not swept.
const REGIONS: usize = 10;
/// [`MttmOptions::hypotheses`] (dissertation: 5).
const HYPOTHESES: usize = 5;
/// [`MttmOptions::network_hypotheses`]; chosen by hand, not swept.
const NETWORK_HYPOTHESES: usize = 2;
/// [`MttmOptions::verified`]; chosen by hand for run time, not swept.
const VERIFIED: usize = 16;
/// [`MttmOptions::min_score`]: estimates below it are guesses. Chosen by hand; not swept.
const MIN_SCORE: f64 = 0.05;

/// Smallest distance of regions of the first matching, as a fraction of the diameter; chosen by hand, not swept.
pub(crate) const APART: f64 = 0.15;
/// Poses whose rotations differ by less than this are the same hypothesis, radians: about the step of 15 degrees between in-plane
/// rotations. Chosen by hand; not swept.
pub(crate) const SAME_ROTATION: f64 = 0.3;
/// Two masks of the first matching are merged when this multiple of their intersection exceeds the smaller mask, that is when they
/// share half of it. Chosen by hand; not swept.
const OVERLAP: usize = 2;
/// Fewest pixels of a region's mask, counted on every second column and row; chosen by hand, not swept.
const MIN_MASK: usize = 20;
/// Cells of the masks' grid by which a region is widened for the second matching, because other templates may extend beyond the
/// mask. Chosen by hand; not swept.
const WIDENED: usize = 2;
/// Shift of the centres that the second matching tries along every axis, as a fraction of the diameter; chosen by hand, not swept.
const SHIFT: f64 = 0.07;
/// Best matches examined per hypothesis of a region: most of them are neighbours of one another. Chosen by hand; not swept.
const RANKED: usize = 40;
/// Fewest hypotheses that are verified for each instance; chosen by hand, not swept.
const VERIFIED_OF_INSTANCE: usize = 2;
/// Exponent of the matched template's agreement, next to the verification with the mesh; chosen by hand, not swept.
const TEMPLATE_POWER: f64 = 0.2;
/// Largest fraction (numerator, denominator) of its pixels that an estimate may share with a better one; the same as for point pair
/// features. Chosen by hand; not swept.
const MAX_SHARED: (usize, usize) = (3, 10);

impl Default for MttmOptions {
    fn default() -> Self {
        MttmOptions {
            matched_by: MatchedBy::Both,
            predicted_pose: true,
            proposals: ProposalOptions::default(),
            placed: PLACED,
            masked: MASKED,
            regions: REGIONS,
            hypotheses: HYPOTHESES,
            network_hypotheses: NETWORK_HYPOTHESES,
            verified: VERIFIED,
            masks: MaskSource::Aligned,
            published: false,
            align: true,
            verification: VerificationOptions::default(),
            max_instances: 1,
            min_score: MIN_SCORE,
        }
    }
}

/// [`MttmOptions::verified`] for templates from all sides: the best of 16, 48, 120 and 400 ([`MttmOptions::for_templates`]).
const AROUND_VERIFIED: usize = 400;
/// [`MttmOptions::placed`], [`MttmOptions::masked`], [`MttmOptions::regions`], [`MttmOptions::hypotheses`] and
/// [`MttmOptions::network_hypotheses`] for templates from all sides: better than half as many of each; not swept one by one.
const AROUND_PLACED: usize = 400;
const AROUND_MASKED: usize = 160;
const AROUND_REGIONS: usize = 40;
const AROUND_HYPOTHESES: usize = 20;
const AROUND_NETWORK_HYPOTHESES: usize = 12;
/// Diameter between those of duck (0.109 m) and holepuncher (0.145 m) of LineMOD, metres.
const SMALL: f64 = 0.12;
/// Hypotheses that are refined and verified as published (section 5.3.3).
const PUBLISHED_VERIFIED: usize = 15;

impl MttmOptions {
    /// The dissertation's form (sections 5.2.4, 5.2.5, 5.3.3): the network alone, masks before any alignment, five hypotheses per
    /// region, regions rejected after three iterations of ICP, at most 50 of them, 15 hypotheses verified by the published score.
    pub fn published() -> MttmOptions {
        let default = MttmOptions::default();
        MttmOptions {
            matched_by: MatchedBy::Network,
            published: true,
            verified: PUBLISHED_VERIFIED,
            verification: VerificationOptions { occluders_have_edges: false, ..default.verification },
            ..default
        }
    }

    /// Largest distance in depth at which a pixel agrees, metres; as published 10 mm, and 5 mm for small objects (section 5.3.1:
    /// ape and duck, the two smallest).
    pub(crate) fn depth_threshold(&self, diameter: f64) -> f64 {
        match self.verification.depth_threshold {
            None if self.published => {
                if diameter < SMALL {
                    0.005
                } else {
                    0.01
                }
            }
            _ => self.verification.threshold_for(diameter),
        }
    }

    /// Enough masks, regions and hypotheses for these templates. Rendered from all sides there are seven times as many templates as
    /// from above, more of them match well by chance, and the right one is seldom among the few candidates that suffice from above.
    /// Other fields, options for other templates and the published form are unchanged.
    ///
    /// ADD(-S) on 90 instances in simulated piles, with the number of verified hypotheses: .58 (16), .68 (48), .74 (120), .79 (400,
    /// from twice as many regions); by point pair features .89 (docs/measured.md has the commands).
    #[must_use]
    pub fn for_templates(self, templates: &ObjectTemplates) -> MttmOptions {
        let around = templates.source == Source::Mesh && templates.options.coverage == ViewCoverage::Around;
        if !around || self.published {
            return self;
        }
        MttmOptions {
            placed: self.placed.max(AROUND_PLACED),
            masked: self.masked.max(AROUND_MASKED),
            regions: self.regions.max(AROUND_REGIONS),
            hypotheses: self.hypotheses.max(AROUND_HYPOTHESES),
            network_hypotheses: self.network_hypotheses.max(AROUND_NETWORK_HYPOTHESES),
            verified: self.verified.max(AROUND_VERIFIED),
            ..self
        }
    }

    /// Checks every field, including those of proposals and verification.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        self.proposals.check()?;
        for (option, value) in [
            ("placed", self.placed),
            ("masked", self.masked),
            ("regions", self.regions),
            ("hypotheses", self.hypotheses),
            ("network_hypotheses", self.network_hypotheses),
            ("verified", self.verified),
            ("max_instances", self.max_instances),
        ] {
            OptionError::unless_some(option, value)?;
        }
        self.verification.check()?;
        OptionError::unless_within("min_score", self.min_score, 0.0.., "0 or more")
    }
}

/// An object ready to be searched: its templates prepared, and its mesh, if there is one.
#[derive(Debug, Clone)]
pub struct KnownObject {
    pub(crate) templates: ObjectTemplates,
    pub(crate) matcher: Matcher,
    pub(crate) surfaces: Vec<Surface>,
    mesh: Option<Mesh>,
    pub(crate) learned: Option<Learned>,
}

/// Points of a template that ICP uses; chosen by hand, not swept.
const ICP_POINTS: usize = 160;

impl KnownObject {
    /// Prepares templates; `mesh` is what verification renders ([`sixfold_align::verification_mesh`]), `None` to verify with the
    /// templates alone.
    pub fn new(templates: ObjectTemplates, mesh: Option<Mesh>) -> KnownObject {
        let matcher = Matcher::new(&templates, &MatchOptions::default());
        let surfaces =
            templates.templates.par_iter().map(|t| Surface::new(t, templates.size, ICP_POINTS)).collect();
        KnownObject { templates, matcher, surfaces, mesh, learned: None }
    }

    /// The object's pose when a template has the pose `camera_from_view`.
    pub(crate) fn object_pose(&self, camera_from_view: &Pose, template: usize) -> Pose {
        *camera_from_view * self.templates.templates[template].view_from_object
    }

    /// The templates.
    pub fn templates(&self) -> &ObjectTemplates {
        &self.templates
    }

    /// Whether poses are verified with a mesh.
    pub fn has_mesh(&self) -> bool {
        self.mesh.is_some()
    }

    /// The same object without its mesh.
    pub fn without_mesh(mut self) -> KnownObject {
        self.mesh = None;
        self
    }
}

/// A pose with its confidence and scores.
#[derive(Debug, Clone, PartialEq)]
pub struct MttmEstimate {
    /// The pose. For templates from depth images without poses it is the pose of the matched template's own frame.
    pub camera_from_object: Pose,
    /// Confidence from 0 to 1, by which estimates are ranked.
    pub confidence: f64,
    /// Scores of the verification, with the mesh or the template.
    pub score: VerificationScore,
    /// The matched template.
    pub template: usize,
    /// Pixels of the object according to the matched template, before any refinement with a mesh; with [`MaskSource::Network`] and in
    /// the published form according to the network, before any alignment.
    pub mask: Pixels,
}

/// Run time of each stage in seconds, and numbers of regions.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Stages {
    /// Sampling and first matching.
    pub matching: f64,
    /// Masks and their merging.
    pub masks: f64,
    /// Second matching and alignment.
    pub rematching: f64,
    /// Verification.
    pub verification: f64,
    /// Regions sampled.
    pub sampled: usize,
    /// Regions left after merging.
    pub regions: usize,
}

impl Stages {
    /// Seconds of all stages before the verification.
    pub fn hypotheses(&self) -> f64 {
        self.matching + self.masks + self.rematching
    }
}

/// A template placed in the scene.
#[derive(Debug, Clone)]
pub(crate) struct Placed {
    pub template: usize,
    pub camera_from_view: Pose,
    pub score: VerificationScore,
    /// Score by which they are ranked: agreement of the surface, and of the match it came from.
    pub support: f64,
    /// The object's pixels as predicted by the network, if it predicted them before any alignment.
    pub mask: Option<Arc<Pixels>>,
}

/// A scene in which several objects are searched. The network's predictions for its regions are shared by objects of about the same
/// size.
#[derive(Debug)]
pub struct Search<'a> {
    scene: &'a DepthRegion,
    regions: RegionCache,
}

impl<'a> Search<'a> {
    /// A scene before any search.
    pub fn new(scene: &'a DepthRegion) -> Search<'a> {
        Search { scene, regions: RegionCache::default() }
    }

    /// Finds an object, as [`estimate`] does and with the same result.
    pub fn estimate(&self, object: &KnownObject, options: &MttmOptions) -> (Vec<MttmEstimate>, Stages) {
        search(self.scene, &self.regions, object, options)
    }
}

/// Finds the object in the scene, best first; empty when nothing scores high enough. The same input gives the same output at
/// any number of threads. For several objects in one scene [`Search`] is faster.
pub fn estimate(
    scene: &DepthRegion,
    object: &KnownObject,
    options: &MttmOptions,
) -> (Vec<MttmEstimate>, Stages) {
    Search::new(scene).estimate(object, options)
}

/// As [`estimate`]; the network's predictions for the image's regions are kept in `regions`.
pub(crate) fn search(
    scene: &DepthRegion,
    regions: &RegionCache,
    object: &KnownObject,
    options: &MttmOptions,
) -> (Vec<MttmEstimate>, Stages) {
    let mut stages = Stages::default();
    let mut clock = Instant::now();
    let mut lap = || {
        let seconds = clock.elapsed().as_secs_f64();
        clock = Instant::now();
        seconds
    };
    let network = match options.matched_by {
        MatchedBy::Points => None,
        MatchedBy::Network | MatchedBy::Both => object.learned.as_ref(),
    };
    let of_network = match (options.published, options.masks) {
        (true, _) => network.map(|n| published::hypotheses(scene, object, n, regions, options, &mut stages)),
        (false, MaskSource::Network) => object
            .learned
            .as_ref()
            .map(|n| segmentation::hypotheses(scene, object, n, regions, options, &mut stages)),
        (false, MaskSource::Aligned) => None,
    };
    if let Some(mut hypotheses) = of_network {
        hypotheses.sort_by(|a, b| b.support.total_cmp(&a.support));
        stages.matching = lap();
        let estimates = verify_all(scene, object, &hypotheses, options);
        stages.verification = lap();
        return (estimates, stages);
    }
    let placed = match network {
        Some(learned) => by_network::first_matching(scene, object, learned, regions, options, &mut stages),
        None => first_matching(scene, object, options, &mut stages),
    };
    stages.matching = lap();
    let regions = merge(scene, object, &placed, options);
    stages.regions = regions.len();
    stages.masks = lap();
    let mut hypotheses: Vec<Vec<Placed>> = regions
        .par_iter()
        .map(|(seed, mask)| {
            let mut found = vec![seed.clone()];
            if network.is_none() || options.matched_by == MatchedBy::Both {
                second_matching(scene, object, mask, options, &mut found);
            }
            found
        })
        .collect();
    if let Some(learned) = network {
        by_network::second_matching(scene, object, learned, options, &mut hypotheses);
    }
    let mut hypotheses = hypotheses.concat();
    // A stable sort: ties keep the order of their regions.
    hypotheses.sort_by(|a, b| b.support.total_cmp(&a.support));
    stages.rematching = lap();
    let estimates = verify_all(scene, object, &hypotheses, options);
    stages.verification = lap();
    (estimates, stages)
}

/// Samples regions, matches them, and aligns the best matches with the scene.
fn first_matching(
    scene: &DepthRegion,
    object: &KnownObject,
    options: &MttmOptions,
    stages: &mut Stages,
) -> Vec<Placed> {
    let size = object.templates.size;
    let rois = propose(scene, object.templates.diameter, &options.proposals);
    stages.sampled = rois.len();
    let matches = object.matcher.best(rois.len(), |i| rois[i].cells(scene, size, |_| true));
    let mut order: Vec<usize> = (0..rois.len()).filter(|&i| matches[i].score > 0.0).collect();
    order.sort_by(|&a, &b| matches[b].score.total_cmp(&matches[a].score).then(a.cmp(&b)));
    let chosen = apart(&rois, order, APART * object.templates.diameter, options.placed);
    chosen.par_iter().map(|&i| place(scene, object, &rois[i], matches[i], options)).collect()
}

/// The first regions of `order` that are further apart than `distance` metres, at most `most` of them.
pub(crate) fn apart(rois: &[Roi], order: Vec<usize>, distance: f64, most: usize) -> Vec<usize> {
    let mut chosen: Vec<usize> = vec![];
    for i in order {
        if chosen.len() >= most {
            break;
        }
        if chosen.iter().all(|&k| (rois[k].centre - rois[i].centre).norm() > distance) {
            chosen.push(i);
        }
    }
    chosen
}

/// Aligns a matched template with the scene.
pub(crate) fn place(
    scene: &DepthRegion,
    object: &KnownObject,
    roi: &Roi,
    matched: Match,
    options: &MttmOptions,
) -> Placed {
    let entry = object.matcher.entries()[matched.entry];
    let start = camera_from_view(&roi.camera_from_roi(), entry.turn);
    place_at(scene, object, entry.template, start, f64::from(matched.score).max(0.0).sqrt(), options)
}

/// Aligns a template with the scene from an approximate pose; `trust` (0 to 1) rates the match that gave it.
pub(crate) fn place_at(
    scene: &DepthRegion,
    object: &KnownObject,
    template: usize,
    start: Pose,
    trust: f64,
    options: &MttmOptions,
) -> Placed {
    let surface = &object.surfaces[template];
    let mut pose = start;
    if options.align {
        pose = align(scene, &surface.sparse, &pose, object.matcher.tolerance());
    }
    let threshold = options.depth_threshold(object.templates.diameter);
    let score = judge(scene, surface, &pose, threshold, &options.verification);
    let support = score.ranking() * trust;
    Placed { template, camera_from_view: pose, score, support, mask: None }
}

/// Whether a template at a pose is the same hypothesis as one of those found. Views without poses have their own frames, so only
/// templates of the same view can be compared.
pub(crate) fn is_known(object: &KnownObject, found: &[Placed], template: usize, start: &Pose) -> bool {
    let new = object.object_pose(start, template);
    found.iter().any(|f| {
        object.object_pose(&f.camera_from_view, f.template).rotation_angle_to(&new) < SAME_ROTATION
            && (object.templates.source != crate::Source::Depth || f.template == template)
    })
}

/// While regions are merged, masks use every n-th column and row; chosen by hand, not swept.
const STRIDE: usize = 2;

/// The masks of the placed templates, without those that overlap a better one by more than half.
fn merge(
    scene: &DepthRegion,
    object: &KnownObject,
    placed: &[Placed],
    options: &MttmOptions,
) -> Vec<(Placed, Pixels)> {
    let tolerance = object.matcher.tolerance();
    let mut order: Vec<usize> = (0..placed.len()).collect();
    order.sort_by(|&a, &b| placed[b].support.total_cmp(&placed[a].support).then(a.cmp(&b)));
    order.truncate(options.masked);
    let masks: Vec<Pixels> = order
        .par_iter()
        .map(|&i| {
            let p = &placed[i];
            let template = &object.templates.templates[p.template];
            template_mask(scene, template, object.templates.size, &p.camera_from_view, tolerance, STRIDE)
        })
        .collect();
    let mut regions: Vec<(Placed, Pixels)> = vec![];
    for (&i, mask) in order.iter().zip(&masks) {
        if regions.len() >= options.regions {
            break;
        }
        let overlaps = |other: &Pixels| OVERLAP * common(mask, other) > mask.len().min(other.len());
        if mask.len() >= MIN_MASK && !regions.iter().any(|(_, other)| overlaps(other)) {
            regions.push((placed[i].clone(), mask.clone()));
        }
    }
    regions
}

/// Matches a region again, centred on its template and without its background, and aligns the nearest templates that differ with
/// the scene.
fn second_matching(
    scene: &DepthRegion,
    object: &KnownObject,
    mask: &Pixels,
    options: &MttmOptions,
    found: &mut Vec<Placed>,
) {
    let Some(seed) = found.first().cloned() else { return };
    let (width, height) = scene.depth().size();
    let (columns, rows) = (width.div_ceil(STRIDE), height.div_ceil(STRIDE));
    let mut inside = vec![false; columns * rows];
    for &p in mask {
        let (x, y) = (p as usize % width / STRIDE, p as usize / width / STRIDE);
        for v in y.saturating_sub(WIDENED)..=(y + WIDENED).min(rows - 1) {
            for u in x.saturating_sub(WIDENED)..=(x + WIDENED).min(columns - 1) {
                inside[v * columns + u] = true;
            }
        }
    }
    let seen = |pixel: usize| inside[pixel / width / STRIDE * columns + pixel % width / STRIDE];
    let centre = seed.camera_from_view.translation();
    let shift = SHIFT * object.templates.diameter;
    let shifts = [
        Vec3::zeros(),
        Vec3::x() * shift,
        Vec3::x() * -shift,
        Vec3::y() * shift,
        Vec3::y() * -shift,
        Vec3::z() * shift,
        Vec3::z() * -shift,
    ];
    let rois = shifts.map(|s| Roi { centre: centre + s });
    let cells: Vec<_> = rois.iter().map(|r| r.cells(scene, object.templates.size, seen)).collect();
    for (matched, region) in object.matcher.ranked(&cells).into_iter().take(RANKED * options.hypotheses) {
        if found.len() > options.hypotheses {
            break;
        }
        let entry = object.matcher.entries()[matched.entry];
        let start = camera_from_view(&rois[region].camera_from_roi(), entry.turn);
        if !is_known(object, found, entry.template, &start) {
            found.push(place(scene, object, &rois[region], matched, options));
        }
    }
}

/// Final verification, with the mesh if there is one; removes estimates that explain the same pixels as a better one.
fn verify_all(
    scene: &DepthRegion,
    object: &KnownObject,
    hypotheses: &[Placed],
    options: &MttmOptions,
) -> Vec<MttmEstimate> {
    let templates = &object.templates;
    let threshold = options.depth_threshold(templates.diameter);
    let most = options.verified.max(VERIFIED_OF_INSTANCE * options.max_instances);
    let pose_of = |p: &Placed| p.camera_from_view * templates.templates[p.template].view_from_object;
    let best: Vec<&Placed> = hypotheses.iter().take(most).collect();
    // Pose, confidence, score, and the number of the hypothesis.
    let mut judged: Vec<(Pose, f64, VerificationScore, usize)> = match &object.mesh {
        None => best.iter().enumerate().map(|(i, p)| (pose_of(p), p.support, p.score, i)).collect(),
        Some(mesh) if options.published => {
            // Sections 5.2.5 and 5.3.3: S_D S_B S_N of the rendered mesh alone, of all hypotheses and then of the best ones.
            let poses: Vec<Pose> = hypotheses.iter().map(pose_of).collect();
            verify_published(scene, mesh, &poses, most, threshold, &options.verification)
                .into_iter()
                .map(|(i, v)| (v.camera_from_object, v.score.total, v.score, i))
                .collect()
        }
        Some(mesh) => {
            let poses: Vec<Pose> = best.iter().map(|p| pose_of(p)).collect();
            let verified = verify(scene, mesh, &poses, threshold, &options.verification);
            // Both the rendered mesh and the matched template count, and how much of the object is visible.
            let confidence = |v: &VerifiedPose, p: &Placed| {
                v.score.ranking() * p.support.clamp(0.0, 1.0).powf(TEMPLATE_POWER)
            };
            let numbered = verified.iter().zip(&best).enumerate();
            numbered.map(|(i, (v, p))| (v.camera_from_object, confidence(v, p), v.score, i)).collect()
        }
    };
    judged.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.3.cmp(&b.3)));
    let mut estimates: Vec<MttmEstimate> = vec![];
    for (camera_from_object, confidence, score, i) in judged {
        if estimates.len() >= options.max_instances || confidence < options.min_score {
            break;
        }
        let template = hypotheses[i].template;
        let of_template = || {
            let (pose, tolerance) = (&hypotheses[i].camera_from_view, object.matcher.tolerance());
            template_mask(scene, &templates.templates[template], templates.size, pose, tolerance, 1)
        };
        let mask = hypotheses[i].mask.as_deref().cloned().unwrap_or_else(of_template);
        let shared =
            |other: &MttmEstimate| MAX_SHARED.1 * common(&mask, &other.mask) > MAX_SHARED.0 * mask.len();
        if mask.is_empty() || estimates.iter().any(shared) {
            continue;
        }
        estimates.push(MttmEstimate { camera_from_object, confidence, score, template, mask });
    }
    estimates
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::template::TemplateOptions;
    use sixfold_align::{DepthOptions, PreparedDepth};
    use sixfold_geometry::{Camera, DepthImage};

    /// A box from `low` to `high`, metres.
    fn cuboid(low: [f64; 3], high: [f64; 3]) -> Mesh {
        let corner =
            |i: usize| Vec3::from_fn(|axis, _| if i >> axis & 1 == 1 { high[axis] } else { low[axis] });
        let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles = sides.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
        Mesh::new((0..8).map(corner).collect(), triangles).unwrap()
    }

    /// Section 5.3.3: S_final of the rendered mesh decides which hypotheses are refined. In our form it is the support.
    #[test]
    fn as_published_the_score_of_the_mesh_chooses_the_hypotheses() {
        let mesh = Mesh::merged(&[
            cuboid([-0.05, -0.04, 0.0], [0.05, 0.04, 0.03]),
            cuboid([-0.05, -0.04, 0.03], [-0.01, 0.0, 0.09]),
        ])
        .unwrap();
        let templates = ObjectTemplates::from_mesh(&mesh, &TemplateOptions::default()).unwrap();
        let object = KnownObject::new(templates, Some(mesh.clone()));
        // A view in which three sides are visible, so that alignment determines the position.
        let shows_three = |t: &crate::template::Template| {
            let along = t.view_from_object.rotation().inverse() * Vec3::z();
            along.iter().all(|a| a.abs() > 0.4)
        };
        let oblique = object.templates.templates.iter().position(shows_three).unwrap();
        let at = |x: f64| Placed {
            template: oblique,
            camera_from_view: Pose::from_translation(Vec3::new(x, 0.0, 0.7)),
            score: VerificationScore::default(),
            support: 0.9,
            mask: None,
        };
        let truth = object.object_pose(&at(0.0).camera_from_view, oblique);
        let camera = Camera::new(500.0, 500.0, 159.5, 119.5, 320, 240).unwrap();
        let rendered = sixfold_render::render_depth(&mesh, &truth, &camera);
        let of_wall = |z: f32| if z > 0.0 { z } else { 0.9 };
        let depth = DepthImage::from_fn(320, 240, |x, y| of_wall(rendered[(x, y)]));
        let options = DepthOptions { remove_plane: false, ..DepthOptions::default() };
        let scene = DepthRegion::whole(&PreparedDepth::new(&depth, &camera, &options).unwrap());
        // Twenty beside the object, and the least supported one 4 mm from it.
        let mut hypotheses = vec![at(0.12); 20];
        hypotheses.push(Placed { support: 0.1, ..at(0.004) });
        let off = |options: MttmOptions| {
            let found = verify_all(&scene, &object, &hypotheses, &MttmOptions { min_score: 0.0, ..options });
            found.first().map_or(f64::INFINITY, |e| e.camera_from_object.distance_to(&truth))
        };
        let (published, ours) = (off(MttmOptions::published()), off(MttmOptions::default()));
        assert!(published < 1e-3 && ours > 0.05, "{published} {ours}");
    }

    #[test]
    fn templates_from_all_sides_get_more_hypotheses() {
        let templates = |coverage, source| ObjectTemplates {
            diameter: 0.1,
            size: 0.11,
            options: TemplateOptions { coverage, ..TemplateOptions::default() },
            source,
            made_from: 0,
            templates: vec![],
        };
        let default = MttmOptions::default();
        let around = default.for_templates(&templates(ViewCoverage::Around, Source::Mesh));
        assert!(around.verified > 10 * default.verified && around.hypotheses > default.hypotheses);
        assert!(around.regions > default.regions && around.check().is_ok());
        let many = MttmOptions { verified: 1000, min_score: 0.4, max_instances: 3, ..default };
        let many = many.for_templates(&templates(ViewCoverage::Around, Source::Mesh));
        assert_eq!((many.verified, many.min_score, many.max_instances), (1000, 0.4, 3));
        // Options for other templates and the published form are unchanged.
        assert_eq!(default.for_templates(&templates(ViewCoverage::Above, Source::Mesh)), default);
        assert_eq!(default.for_templates(&templates(ViewCoverage::Around, Source::Depth)), default);
        let published = MttmOptions::published();
        assert_eq!(published.for_templates(&templates(ViewCoverage::Around, Source::Mesh)), published);
        assert_eq!([0.109, 0.145, 0.26].map(|d| published.depth_threshold(d)), [0.005, 0.01, 0.01]);
        let ours = [0.08, 0.145, 0.26].map(|d| MttmOptions::default().depth_threshold(d));
        assert!(ours.iter().zip([0.005, 0.00725, 0.01]).all(|(a, b)| (a - b).abs() < 1e-9), "{ours:?}");
    }

    #[test]
    fn options_out_of_range_are_named() {
        let options = MttmOptions::default();
        assert_eq!(options.check(), Ok(()));
        assert_eq!(MttmOptions { min_score: 1.1, ..options }.check(), Ok(()));
        let named = |options: MttmOptions| options.check().unwrap_err().option;
        assert_eq!(named(MttmOptions { min_score: f64::NAN, ..options }), "min_score");
        assert_eq!(named(MttmOptions { hypotheses: 0, ..options }), "hypotheses");
        let proposals = ProposalOptions { step: f64::NAN, ..options.proposals };
        assert_eq!(named(MttmOptions { proposals, ..options }), "proposals.step");
        let verification = VerificationOptions { depth_threshold: Some(-1.0), ..options.verification };
        assert_eq!(named(MttmOptions { verification, ..options }), "verification.depth_threshold");
        let templates = TemplateOptions::default();
        assert_eq!(templates.check(), Ok(()));
        let distance = TemplateOptions { distance: f64::NAN, ..templates };
        assert_eq!(distance.check().unwrap_err().option, "templates.distance");
        let margin = TemplateOptions { margin: 0.0, ..templates };
        assert_eq!(margin.check().unwrap_err().option, "templates.margin");
    }
}
