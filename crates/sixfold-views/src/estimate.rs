//! Poses from a crop: similar templates, correspondences with the best of them, PnP, then repeatedly render, compare and update
//! (the order of the steps is that of FoundPose, Örnek et al. 2024; the steps themselves are ours).

use rayon::prelude::*;
use sixfold_align::outline::projected_box;
use sixfold_geometry::{
    Camera, OptionError, PnpOptions, Pose, Rect, RefineOptions, RgbImage, Vec2, Vec3, pnp_ransac, refine_pose,
};
use sixfold_mesh::Mesh;
use sixfold_nn::xfeat::{CELL, MULTIPLE};
use sixfold_render::VisibilityBuffer;
use sixfold_synth::augment::Patch;

use crate::colour::{Chroma, chromas, grey};
use crate::crop::Crop;
use crate::error::ViewsError;
use crate::features::{Extractor, FeatureMap};
use crate::matching::{Match, best_near, dot, mutual_matches, similarity};
use crate::network::input;
use crate::printed::{ImageKeypoints, PrintMatches, Printed};
use crate::refiner::{Displaced, Refined, Refiner, Target};
use crate::templates::{CROP_FACTOR, Template, cells_on_object, gathered, input_over_grey, render};

/// Options of the pose estimation.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewsOptions {
    /// Side of a crop, pixels; that of the templates.
    pub side: usize,
    /// Largest distance of a feature from its position in the template when templates are compared, cells.
    pub reach: usize,
    /// Number of templates for which correspondences are computed.
    pub candidates: usize,
    /// Largest distance of correspondences, cells.
    pub match_reach: usize,
    /// Inlier threshold of PnP, crop pixels.
    pub reprojection: f64,
    /// Number of poses that are rendered and compared.
    pub hypotheses: usize,
    /// Iterations of rendering, comparing and updating each pose.
    pub refinements: usize,
    /// Search distance of a rendered feature in these iterations, cells.
    pub refine_reach: usize,
    /// Number of poses that are refined once more in a crop around the whole object.
    pub close: usize,
    /// Side of that crop, pixels.
    pub close_side: usize,
    /// Align the outline in that crop.
    pub outline: bool,
    /// Align what is drawn on the object in that crop.
    pub direct: bool,
    /// Fraction of the distance by which poses that are not aligned so are too far, which is taken off at the end.
    pub too_far: f64,
    /// If no region is given: number of proposals of an image that are compared with templates, those with the highest scores.
    pub proposals: usize,
    /// Of these, the number most similar to the object in which poses are estimated, plus one for each further instance.
    pub places: usize,
    /// As `hypotheses`, for each of these places.
    pub place_hypotheses: usize,
    /// As `close`, for the poses of all these places together.
    pub place_close: usize,
    /// Weight of the similarity of colours, relative to that of features, when proposals are compared with templates; without
    /// effect for objects without colours and in grey images.
    pub place_colour: f32,
    /// Weight of the similarity of features trained on ImageNet, likewise.
    pub place_recognition: f32,
    /// Number of poses by what is printed on the object that are refined in that crop, plus one for each further instance.
    pub printed: usize,
    /// Seed of RANSAC.
    pub seed: u64,
}

/// Chosen by AR_MSSD on 86 targets of every ninth LM-O development frame: `reprojection` from 3, 4, 6, 9 pixels, `refine_reach`
/// from 2, 3 cells; with the refiner AR_MSSD / AR_MSPD / ADD(-S) recall with 8 hypotheses were .436 / .650 / .326, with 12 .462 /
/// .659 / .326, with 12 and `close` 4 instead of 2 .470 / .669 / .349 (without the refiner .431 / .643 / .302), with `close_side`
/// 192 and `close` 2 .444 / .636 / .279. Without a region, on 85 targets: 100 proposals of one scale, 4 places and features
/// alone .228 / .316 / .200; colours with `place_colour` 0.5 .236 / .359 / .200 (the right one is among the first 4 places 42 times instead of 32; with 0.2 and 1.2 38 and
/// 40 times); 8 places .253 / .369 / .200; 200 proposals of three scales .260 / .380 / .188, with 6 hypotheses instead of 12
/// .256 / .378 / .188 in 0.6 of the time. On 76 targets of other frames: as before .272 / .357 / .224; with `place_recognition` 2
/// .379 / .488 / .303 (the right one is among the first 4 places 50 times instead of 36; with 0.5, 1 and 4 42, 45 and 49 times), with 16
/// places .343 / .436 / .276; with 8 places, `place_close` 12 instead of 4 and all poses ordered by what is recognised .408 / .537 / .316;
/// with 12 places and `place_close` 20 .428 / .546 / .355 in 1.4 times the time; 8 places by similarities relative to those of all places .430 /
/// .534 / .368 (on these 161 targets the right place is among the first 8 for 70 % instead of 65 %), with a mean over the other objects searched for
/// subtracted as well 70 %, too (first place: 50 % instead of 45 %). With the present proposals, on 85 targets: 8 places .395 / .507 / .365, 20
/// places with poses stopped early .413 / .532 / .365 in the same time, at most two poses of a place .404 / .522 / .353, of 24 such poses the 12 that are
/// recognised best .404 / .520 / .353; recognition relative to that of the image's places, of 24 and of 12 poses, .420 / .554 / .365 (76 targets of other
/// frames: .426 / .545 / .329 instead of .420 / .533 / .329), with the render's colours as well, of 36 and of 12 poses, .420 / .549 / .365; with 40 places and
/// three poses each .376 / .502 / .306; with 12 of the boxes enlarged by 1.35 as well, with three poses each, .422 / .549 / .353 (with
/// 72 and 24 poses going on, the latter by what is recognised, .421 / .559 / .353 in 1.25 times the time). Colours do not help to choose templates in a given region (.452 / .652 / .388 with a
/// weight of 0.2 instead of .481 / .673 / .424). The others were chosen by hand.
///
/// `too_far`: median over the poses with the right rotation: 1.2 % of the distance on 443 of LM-O's development frames (with the
/// published poses of MegaPose: -0.3 %), 0.1 % on 36 of simulated images; the cause was not found. Poses of printed objects
/// that are aligned directly are unbiased in simulated images and keep their distance.
impl Default for ViewsOptions {
    fn default() -> Self {
        ViewsOptions {
            side: 160,
            reach: 2,
            candidates: 32,
            match_reach: 6,
            reprojection: 4.0,
            hypotheses: 12,
            refinements: 4,
            refine_reach: 3,
            close: 4,
            close_side: 224,
            outline: true,
            direct: true,
            too_far: 0.01,
            proposals: 200,
            places: 20,
            place_hypotheses: 6,
            place_close: 12,
            place_colour: 0.5,
            place_recognition: 2.0,
            printed: 6,
            seed: 0,
        }
    }
}

impl ViewsOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        for (option, side) in [("side", self.side), ("close_side", self.close_side)] {
            if !(side.is_multiple_of(MULTIPLE) && (MULTIPLE..=512).contains(&side)) {
                return Err(OptionError::new(option, side, "a multiple of 32 from 32 to 512 pixels"));
            }
        }
        OptionError::unless_some("candidates", self.candidates)?;
        OptionError::unless_some("hypotheses", self.hypotheses)?;
        OptionError::unless_within("too_far", self.too_far, -0.5..=0.5, "-0.5 to 0.5")?;
        OptionError::unless_some("proposals", self.proposals)?;
        OptionError::unless_some("places", self.places)?;
        OptionError::unless_some("place_hypotheses", self.place_hypotheses)?;
        OptionError::unless_some("place_close", self.place_close)?;
        OptionError::unless_weight("place_colour", f64::from(self.place_colour))?;
        OptionError::unless_weight("place_recognition", f64::from(self.place_recognition))?;
        OptionError::unless_positive("reprojection", self.reprojection, "pixels above 0")
    }
}

/// A pose with its similarity and inliers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Hypothesis {
    /// From the object's frame to the camera's; to the crop's during the refinement in it.
    pub camera_from_object: Pose,
    /// Agreement of the crop with the object rendered at the pose, 0 to 1: the fraction of the object that the crop shows at the
    /// same position as the render, as predicted by the refiner; without a refiner the mean of the squared products of features,
    /// with 0 for negative ones.
    pub similarity: f64,
    /// Number of correspondences that agree with it.
    pub inliers: usize,
    /// Mean correlation of what is drawn on the object with the image, 0 if it was not compared.
    pub drawn: f64,
}

/// Poses, best first, and the rival of the first ([`crate::close::Settled`]).
type WithRival = (Vec<Hypothesis>, Option<Hypothesis>);

/// Everything that estimating one object's poses needs.
pub(crate) struct Views<'a> {
    /// Computes features.
    pub extractor: &'a Extractor,
    /// The object's surface.
    pub mesh: &'a Mesh,
    /// A mesh for its outline ([`sixfold_align::outline::outline_mesh`]).
    pub outline: &'a Mesh,
    /// Its templates.
    pub templates: &'a [Template],
    /// What is printed on the object; none for an object without colours.
    pub printed: Option<&'a Printed>,
    /// Refines poses; without one the products of features are used.
    pub refiner: Option<&'a Refiner>,
    /// Options.
    pub options: &'a ViewsOptions,
}

/// Objects rendered closer than this would be inside the camera, diameters.
const MIN_DISTANCE: f64 = 0.3;

impl Views<'_> {
    /// Searches the object in a box of a pinhole image; `None` if the box does not overlap the image.
    ///
    /// # Errors
    /// [`ViewsError`].
    pub(crate) fn find(
        &self,
        image: &RgbImage,
        camera: &Camera,
        bbox: &Rect,
        keypoints: Option<&ImageKeypoints>,
    ) -> Result<Option<WithRival>, ViewsError> {
        let Some(part) = Part::new(self.extractor, image, camera, bbox, self.options.side)? else {
            return Ok(None);
        };
        let ranked = self.ranked(&part);
        let mut hypotheses = self.coarse(&part, &ranked, self.options.hypotheses)?;
        let close = self.options.close.min(hypotheses.len());
        let inside = keypoints.map(|keypoints| keypoints.within(&bbox.scaled(CROP_FACTOR)));
        let prints = self.prints(inside.as_ref(), camera);
        let mut chosen: Vec<(Hypothesis, Rect)> = hypotheses[..close].iter().map(|h| (*h, *bbox)).collect();
        chosen.extend(self.by_print(prints.as_ref(), camera, 1));
        let closer = self.closer_all(chosen, prints.as_ref(), image, camera)?;
        let mut closer = self.chosen(closer, bbox, image, camera)?;
        let mut rival = None;
        if let Some(best) = closer.first_mut() {
            let settled = self.settled(*best, prints.as_ref(), image, camera)?;
            (*best, rival) = (settled.pose, settled.rival);
        }
        hypotheses.splice(..close, closer);
        Ok(Some((hypotheses, rival)))
    }

    /// The matches of what is printed on the object with an image's keypoints.
    pub(crate) fn prints(&self, keypoints: Option<&ImageKeypoints>, camera: &Camera) -> Option<PrintMatches> {
        Some(self.printed?.matches(keypoints?, camera))
    }

    /// Poses by what is printed on the object, with their boxes in the image.
    pub(crate) fn by_print(
        &self,
        prints: Option<&PrintMatches>,
        camera: &Camera,
        instances: usize,
    ) -> Vec<(Hypothesis, Rect)> {
        let Some(prints) = prints else { return vec![] };
        let boxed =
            |pose: Hypothesis| Some((pose, projected_box(self.outline, camera, &pose.camera_from_object)?));
        let most = self.options.printed.saturating_add(instances - 1);
        prints.poses().into_iter().take(most).filter_map(boxed).collect()
    }

    /// The templates most similar to a crop, best first: number and similarity.
    pub(crate) fn ranked(&self, part: &Part) -> Vec<(usize, f32)> {
        let reach = self.options.reach;
        let mut ranked: Vec<(usize, f32)> =
            self.templates.par_iter().map(|t| similarity(t, &part.map, reach)).enumerate().collect();
        ranked.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        ranked.truncate(self.options.candidates);
        ranked
    }

    /// Poses from a crop and the templates most similar to it, at most `hypotheses`, best first.
    pub(crate) fn coarse(
        &self,
        part: &Part,
        ranked: &[(usize, f32)],
        hypotheses: usize,
    ) -> Result<Vec<Hypothesis>, ViewsError> {
        let starts = self.starts(part, ranked, hypotheses);
        let mut hypotheses: Vec<Hypothesis> = self.moved(starts, part)?.into_iter().map(|(h, _)| h).collect();
        for hypothesis in &mut hypotheses {
            hypothesis.camera_from_object = part.crop.to_camera(&hypothesis.camera_from_object);
        }
        hypotheses.sort_by(|a, b| b.similarity.total_cmp(&a.similarity));
        Ok(hypotheses)
    }

    /// Poses, in the crop's camera, by the correspondences with each of the templates, no two about the same, those with most inliers first.
    pub(crate) fn starts(&self, part: &Part, ranked: &[(usize, f32)], most: usize) -> Vec<Hypothesis> {
        let mut first: Vec<Hypothesis> =
            ranked.par_iter().filter_map(|(i, _)| self.pose_by(&self.templates[*i], part)).collect();
        first.sort_by(|a, b| b.inliers.cmp(&a.inliers).then(b.similarity.total_cmp(&a.similarity)));
        let mut kept: Vec<Hypothesis> = Vec::new();
        for hypothesis in first {
            if kept.len() < most && kept.iter().all(|k| !self.same(k, &hypothesis)) {
                kept.push(hypothesis);
            }
        }
        kept
    }

    /// Whether two poses are so close that refining both is useless.
    pub(crate) fn same(&self, a: &Hypothesis, b: &Hypothesis) -> bool {
        let (a, b) = (&a.camera_from_object, &b.camera_from_object);
        a.rotation_angle_to(b) < 0.17 && a.distance_to(b) < 0.05 * a.translation().norm()
    }

    /// The pose from correspondences with a template.
    fn pose_by(&self, template: &Template, Part { crop, map, .. }: &Part) -> Option<Hypothesis> {
        let matches = mutual_matches(template, map, self.options.match_reach);
        let (points, pixels): (Vec<Vec3>, Vec<Vec2>) = matches
            .iter()
            .map(|m: &Match| {
                let point = template.points[m.index].map(f64::from);
                (Vec3::from(point), peak(template.feature(m.index), map, m.cell))
            })
            .unzip();
        let options = PnpOptions {
            threshold_px: self.options.reprojection,
            max_iterations: 400,
            min_iterations: 60,
            seed: self.options.seed,
            ..PnpOptions::default()
        };
        let report = pnp_ransac(&points, &pixels, &crop.camera, &options).ok()?;
        let similarity = matches
            .iter()
            .zip(&report.inliers)
            .filter(|(_, inlier)| **inlier)
            .map(|(m, _)| f64::from(m.similarity))
            .sum();
        Some(Hypothesis {
            camera_from_object: report.camera_from_object,
            similarity,
            inliers: report.inlier_count,
            drawn: 0.0,
        })
    }

    /// Refines poses in a crop with the refiner, with what was seen at each of them, or with the products of features if there is none.
    pub(crate) fn moved(
        &self,
        hypotheses: Vec<Hypothesis>,
        part: &Part,
    ) -> Result<Vec<(Hypothesis, Option<Correspondences>)>, ViewsError> {
        let Some(refiner) = self.refiner else {
            return Ok(self.refined(hypotheses, part)?.into_iter().map(|h| (h, None)).collect());
        };
        let poses: Vec<Pose> = hypotheses.iter().map(|h| h.camera_from_object).collect();
        let nearest = self.nearest();
        let times = self.options.refinements;
        let refined = refiner.refine(self.extractor, self.mesh, &part.target(), &poses, nearest, times)?;
        let moved = hypotheses.into_iter().zip(refined).map(|(hypothesis, refined)| {
            let Refined { pose, score, seen } = refined;
            (
                Hypothesis { camera_from_object: pose, similarity: score, ..hypothesis },
                seen.map(Displaced::sure),
            )
        });
        Ok(moved.collect())
    }

    /// Several iterations of rendering the object at each pose, comparing and updating.
    fn refined(&self, mut hypotheses: Vec<Hypothesis>, part: &Part) -> Result<Vec<Hypothesis>, ViewsError> {
        let mut best = hypotheses.clone();
        for pass in 0..=self.options.refinements {
            let compared = self.compared(&hypotheses, part)?;
            for ((hypothesis, best), compared) in hypotheses.iter_mut().zip(&mut best).zip(compared) {
                let Some(compared) = compared else { continue };
                hypothesis.similarity = compared.similarity;
                if pass == 0 || compared.similarity > best.similarity {
                    *best = *hypothesis;
                }
                let refined = refine_pose(
                    &compared.points,
                    &compared.pixels,
                    &part.crop.camera,
                    &hypothesis.camera_from_object,
                    &RefineOptions { threshold_px: self.options.reprojection, ..RefineOptions::default() },
                );
                if let Ok(refined) = refined {
                    hypothesis.camera_from_object = refined.camera_from_object;
                    hypothesis.inliers = refined.inlier_count;
                }
            }
        }
        Ok(best)
    }

    /// Compares the object rendered at each pose with the crop; `None` if it is not visible.
    fn compared(
        &self,
        hypotheses: &[Hypothesis],
        Part { crop, map, .. }: &Part,
    ) -> Result<Vec<Option<Compared>>, ViewsError> {
        let side = crop.camera.width;
        let rendered: Vec<_> = hypotheses
            .par_iter()
            .map_init(
                || VisibilityBuffer::new(&crop.camera),
                |frame, h| {
                    let t = h.camera_from_object.translation();
                    if t.z < self.nearest() {
                        return None;
                    }
                    let rendered = render(frame, self.mesh, &h.camera_from_object, None);
                    let (cells, points) = cells_on_object(&rendered, side / CELL);
                    (!cells.is_empty()).then(|| (input_over_grey(&rendered), cells, points))
                },
            )
            .collect();
        let inputs: Vec<Vec<f32>> = rendered.iter().flatten().map(|r| r.0.clone()).collect();
        let mut maps = self.extractor.features(&inputs, side)?.into_iter();
        let mut out = Vec::with_capacity(rendered.len());
        for one in rendered {
            let Some((_, cells, points)) = one else {
                out.push(None);
                continue;
            };
            let Some(seen) = maps.next() else { break };
            let features = gathered(&seen, &cells);
            out.push(Some(compare(&cells, &features, &points, map, self.options.refine_reach)));
        }
        Ok(out)
    }

    /// The distance from which on objects are rendered, metres.
    pub(crate) fn nearest(&self) -> f64 {
        let (low, high) = self.mesh.bounding_box();
        MIN_DISTANCE * (high - low).norm()
    }

    /// Correspondences at a pose, and the similarity of the rendered object and the crop.
    pub(crate) fn seen_at(
        &self,
        hypothesis: &Hypothesis,
        part: &Part,
    ) -> Result<Option<(Correspondences, f64)>, ViewsError> {
        let Some(refiner) = self.refiner else {
            let compared = self.compared(&[*hypothesis], part)?.into_iter().next().flatten();
            return Ok(compared.map(|c| (c.points.into_iter().zip(c.pixels).collect(), c.similarity)));
        };
        let nearest = self.nearest();
        let poses = [hypothesis.camera_from_object];
        let seen = refiner.compare(self.extractor, self.mesh, &part.target(), &poses, nearest)?;
        Ok(seen.into_iter().next().flatten().map(|seen| {
            let score = seen.score;
            (seen.sure(), score)
        }))
    }
}

/// A crop with the networks' inputs and features.
pub(crate) struct Part {
    pub(crate) crop: Crop,
    pub(crate) patch: Patch,
    input: Vec<f32>,
    pub(crate) map: FeatureMap,
}

impl Part {
    /// The part of an image around a box in a crop of `side` pixels; `None` if the box does not overlap the image.
    pub(crate) fn new(
        extractor: &Extractor,
        image: &RgbImage,
        camera: &Camera,
        bbox: &Rect,
        side: usize,
    ) -> Result<Option<Part>, ViewsError> {
        let Some(crop) = Crop::of_box(camera, bbox, CROP_FACTOR, side) else { return Ok(None) };
        let patch = crop.cut(image, camera, [0.5; 3]);
        let input = input(&patch.data);
        let maps = extractor.features(std::slice::from_ref(&input), side)?;
        Ok(maps.into_iter().next().map(|map| Part { crop, patch, input, map }))
    }

    /// The colours of its cells; `None` if they are all grey.
    pub(crate) fn chromas(&self) -> Option<Vec<Chroma>> {
        Some(chromas(&self.patch.data, self.patch.width, |_| true)).filter(|chromas| !grey(chromas))
    }

    pub(crate) fn target(&self) -> Target<'_> {
        Target { camera: &self.crop.camera, input: &self.input, map: &self.map }
    }
}

/// Points of the object, and the pixels that show them.
pub(crate) type Correspondences = Vec<(Vec3, Vec2)>;

/// Comparison of a render with a crop.
struct Compared {
    similarity: f64,
    points: Vec<Vec3>,
    pixels: Vec<Vec2>,
}

fn compare(cells: &[u16], features: &[f32], points: &[[f32; 3]], map: &FeatureMap, reach: usize) -> Compared {
    let mut out = Compared { similarity: 0.0, points: Vec::new(), pixels: Vec::new() };
    let width = features.len() / cells.len().max(1);
    for ((cell, feature), point) in cells.iter().zip(features.chunks_exact(width.max(1))).zip(points) {
        let cell = usize::from(*cell);
        let (best, _) = best_near(feature, map, cell, reach);
        out.similarity += f64::from(dot(feature, map.feature(cell)).max(0.0)).powi(2);
        out.points.push(Vec3::from(point.map(f64::from)));
        out.pixels.push(peak(feature, map, best));
    }
    out.similarity /= cells.len().max(1) as f64;
    out
}

/// Position near a cell at which the product with a feature is largest, crop pixels: the vertex of a parabola along each axis.
fn peak(feature: &[f32], map: &FeatureMap, cell: usize) -> Vec2 {
    let n = map.cells;
    let (x, y) = (cell % n, cell / n);
    let value = |x: usize, y: usize| f64::from(dot(feature, map.feature(y * n + x)));
    let here = value(x, y);
    let top = |before: f64, after: f64| {
        let curve = before - 2.0 * here + after;
        if curve < -1e-6 { (0.5 * (before - after) / curve).clamp(-0.5, 0.5) } else { 0.0 }
    };
    let dx = if x > 0 && x + 1 < n { top(value(x - 1, y), value(x + 1, y)) } else { 0.0 };
    let dy = if y > 0 && y + 1 < n { top(value(x, y - 1), value(x, y + 1)) } else { 0.0 };
    Vec2::new((x as f64 + dx) * CELL as f64, (y as f64 + dy) * CELL as f64)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::templates::{TemplateOptions, make_templates};
    use sixfold_geometry::nalgebra::UnitQuaternion;
    use sixfold_render::{Light, Material, RenderOptions, SceneObject, shade};

    pub(crate) fn cuboid(low: [f64; 3], high: [f64; 3], color: [u8; 3]) -> Mesh {
        let corner =
            |i: usize| Vec3::from_fn(|axis, _| if i >> axis & 1 == 0 { low[axis] } else { high[axis] });
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let faces = quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect();
        Mesh::new((0..8).map(corner).collect(), faces).unwrap().with_colors(vec![color; 8]).unwrap()
    }

    /// A body with an arm and a foot in three colours: no rotation maps it onto itself.
    pub(crate) fn part() -> Mesh {
        Mesh::merged(&[
            cuboid([-0.06, -0.03, -0.03], [0.06, 0.03, 0.03], [200, 60, 40]),
            cuboid([0.02, 0.0, 0.03], [0.06, 0.03, 0.09], [40, 90, 190]),
            cuboid([-0.06, -0.09, -0.03], [-0.03, -0.03, 0.0], [220, 200, 60]),
        ])
        .unwrap()
    }

    /// Everything for estimating the poses of an object without anything printed on it, by the products of features.
    pub(crate) fn without_refiner<'a>(
        extractor: &'a Extractor,
        mesh: &'a Mesh,
        templates: &'a [Template],
        options: &'a ViewsOptions,
    ) -> Views<'a> {
        Views { extractor, mesh, outline: mesh, templates, printed: None, refiner: None, options }
    }

    /// [`part`] in an image of 640x480 pixels, its pose, and its box.
    pub(crate) fn photographed(camera: &Camera) -> (RgbImage, Pose, Rect) {
        let mesh = part();
        let truth = Pose::new(UnitQuaternion::from_euler_angles(2.1, 0.5, 0.7), Vec3::new(0.15, -0.1, 0.9));
        let mut frame = VisibilityBuffer::new(camera);
        let objects = [SceneObject { mesh: &mesh, camera_from_object: truth }];
        frame.render(&objects, &RenderOptions::default());
        let lights = [
            Light::Ambient { color: [0.3; 3] },
            Light::Directional { direction: Vec3::new(-0.8, 0.9, 0.6), color: [0.7; 3] },
        ];
        let table = RgbImage::from_fn(640, 480, |x, y| {
            let noise = ((x / 9 * 7 + y / 7 * 13) % 37) as u8;
            [120 + noise, 110 + noise, 100]
        });
        let image = shade(&frame, &objects, &lights, &Material::default(), Some(&table));
        (image, truth, frame.bounding_box().unwrap())
    }

    #[test]
    fn a_part_is_found_in_other_light_than_its_templates_have() {
        let mesh = part();
        let extractor = Extractor::shipped().unwrap();
        let options = TemplateOptions { directions: 60, rotations: 12, ..TemplateOptions::default() };
        let templates = make_templates(&mesh, "part", mesh.diameter(), &extractor, &options).unwrap();
        let camera = Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap();
        let (image, truth, bbox) = photographed(&camera);
        let find = |outline: bool, bbox: &Rect| {
            let options = ViewsOptions { outline, ..ViewsOptions::default() };
            let views = without_refiner(&extractor, &mesh, &templates, &options);
            views.find(&image, &camera, bbox, None).unwrap().unwrap().0
        };
        for outline in [false, true] {
            let found = find(outline, &bbox);
            let pose = found[0].camera_from_object;
            let distance = |p: &Vec3| (pose.transform_point(p) - truth.transform_point(p)).norm();
            let add = mesh.vertices().iter().map(distance).sum::<f64>() / mesh.vertices().len() as f64;
            let bound = if outline { 0.05 } else { 0.1 };
            assert!(add < bound * mesh.diameter(), "outline {outline}: {add} m off");
        }
        // The same in a box without the object: less similar.
        let beside = Rect { x: 40.0, y: 300.0, ..bbox };
        let nothing = find(true, &beside).first().map_or(0.0, |h| h.similarity);
        assert!(nothing < 0.6 * find(true, &bbox)[0].similarity, "{nothing}");
    }

    #[test]
    fn options_out_of_range_are_named() {
        let named = |options: ViewsOptions| options.check().map_err(|e| e.option);
        let default = ViewsOptions::default;
        assert_eq!(named(default()), Ok(()));
        assert_eq!(named(ViewsOptions { candidates: 0, ..default() }), Err("candidates"));
        assert_eq!(named(ViewsOptions { hypotheses: 0, ..default() }), Err("hypotheses"));
        assert_eq!(named(ViewsOptions { reprojection: f64::NAN, ..default() }), Err("reprojection"));
        assert_eq!(named(ViewsOptions { side: 100, ..default() }), Err("side"));
        assert_eq!(named(ViewsOptions { close_side: 100, ..default() }), Err("close_side"));
    }
}
