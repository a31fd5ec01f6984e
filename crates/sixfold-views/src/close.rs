//! The last refinement of a pose, in a crop around the whole object at this pose: refiner (Lipson et al. 2022), outline (Prisacariu and
//! Reid 2012), and what is drawn on the object (Lucas and Kanade 1981). The choice between poses rotated by 180 degrees is ours.

use rayon::prelude::*;
use sixfold_align::outline::{Alignment, AlignmentOptions, Outline, log_odds, projected_box};
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::{Camera, Pose, Rect, RgbImage, Vec3};
use sixfold_render::VisibilityBuffer;
use sixfold_synth::augment::Coverage;

use crate::crop::Crop;
use crate::direct::Direct;
use crate::distinction::distinction;
use crate::error::ViewsError;
use crate::estimate::{Correspondences, Hypothesis, Part, Views};
use crate::printed::PrintMatches;

/// Weight of colour relative to the initial pose in the object probability of the outline alignment.
const COLOUR: f32 = 2.0;
/// Bonus to the log likelihood of a border where colours change sharply.
const EDGES: f64 = 8.0;
/// Standard deviation of the band around the outline in which the pose does not determine the object's pixels, crop pixels.
const UNDECIDED: f32 = 5.0;
/// Probability that the pose gives to pixels inside, and its complement to those outside.
const DECIDED: f32 = 0.9;
/// Largest ratio of the bounding box of a whole object to that of its visible part.
const MAX_GROWTH: f64 = 4.0;
/// An aligned outline is kept unless the agreement of features drops by more than this; chosen by hand, not swept.
const TOLERANCE: f64 = 0.02;
/// A pose rotated by 180 degrees is refined if the image agrees with it at least this much, relative to the pose itself.
const ROTATED: f64 = 0.3;
/// Both agree with the image about equally if the agreements differ by less.
const ROTATED_TOLERANCE: f64 = 0.15;
/// The rotated pose comes before the pose if the image is more like it by this much: of 1 where they differ, otherwise in similarity. Chosen by
/// hand, after looking at HOPE's three images (0.15 leaves a box of theirs upside down); kept for its gain on simulated ones.
const DISTINCT: f64 = 0.05;
/// The other of both is reported too if the image agrees with it at most by this much less: prints on scanned meshes are not exact.
const AS_GOOD: f64 = 0.05;
/// As [`TOLERANCE`], for a pose aligned directly; poses that are off by less than a pixel differ by up to this much.
const DIRECT_TOLERANCE: f64 = 0.05;
/// Smallest mean correlation of what is drawn on the object with the image, after alignment, at which the alignment is kept; chosen on
/// simulated images (0.45 and less are as good there, 0.5 is not).
const MIN_DRAWN: f64 = 0.4;
/// Each further `DRAWN` divide the disagreement with the image by e.
const DRAWN: f64 = 0.3;
/// Number of keypoints that agree with a wrong pose by chance.
const CHANCE: usize = 6;
/// Each further `PRINT` keypoints that agree divide the disagreement with the image by e.
const PRINT: f64 = 20.0;

/// A pose with its rival.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Settled {
    pub(crate) pose: Hypothesis,
    /// The pose rotated by 180 degrees, with which the image agrees hardly less.
    pub(crate) rival: Option<Hypothesis>,
}

impl Views<'_> {
    /// Poses with the boxes in which they were found, each refined once more ([`Views::closer`]), best first.
    pub(crate) fn closer_all(
        &self,
        poses: Vec<(Hypothesis, Rect)>,
        prints: Option<&PrintMatches>,
        image: &RgbImage,
        camera: &Camera,
    ) -> Result<Vec<Hypothesis>, ViewsError> {
        let closer = |(pose, bbox): (Hypothesis, Rect)| self.closer(pose, image, camera, &bbox);
        let mut closer: Vec<Hypothesis> = poses.into_par_iter().map(closer).collect::<Result<_, _>>()?;
        closer.iter_mut().for_each(|hypothesis| add_prints(hypothesis, prints));
        closer.sort_by(|a, b| b.similarity.total_cmp(&a.similarity));
        Ok(closer)
    }

    /// A pose rotated by 180 degrees about the axes of the object's bounding box, where the image could show that as well: both faces of a
    /// box often have the same print, and then only its sides tell which one is in front.
    fn rotated(
        &self,
        pose: &Hypothesis,
        image: &RgbImage,
        camera: &Camera,
    ) -> Result<Vec<(Hypothesis, Rect)>, ViewsError> {
        let Some(whole) = projected_box(self.outline, camera, &pose.camera_from_object) else {
            return Ok(vec![]);
        };
        let part = Part::new(self.extractor, image, camera, &whole, self.options.side)?;
        let Some(part) = part else { return Ok(vec![]) };
        let (low, high) = self.mesh.bounding_box();
        let centre = Pose::from_translation((low + high) * 0.5);
        let rotated = [Vec3::x_axis(), Vec3::y_axis(), Vec3::z_axis()].map(|axis| {
            let half = UnitQuaternion::from_axis_angle(&axis, std::f64::consts::PI);
            let half_rotation = centre * Pose::new(half, Vec3::zeros()) * centre.inverse();
            let camera_from_object = pose.camera_from_object * half_rotation;
            Hypothesis { camera_from_object, drawn: 0.0, ..*pose }
        });
        let mut out = Vec::new();
        for hypothesis in rotated {
            let crop_from_object = part.crop.to_crop(&hypothesis.camera_from_object);
            let seen =
                self.seen_at(&Hypothesis { camera_from_object: crop_from_object, ..hypothesis }, &part)?;
            if seen.is_some_and(|(_, similarity)| similarity > ROTATED * pose.similarity)
                && let Some(bbox) = projected_box(self.outline, camera, &hypothesis.camera_from_object)
            {
                out.push((hypothesis, bbox));
            }
        }
        Ok(out)
    }

    /// A pose, or that rotated by 180 degrees about an axis of the object's bounding box if the image is more similar to that. If the image agrees with both
    /// about equally and something is drawn on the object, what differs between both decides ([`distinction`]). With the other of both, if the image
    /// agrees with it hardly less.
    pub(crate) fn settled(
        &self,
        pose: Hypothesis,
        prints: Option<&PrintMatches>,
        image: &RgbImage,
        camera: &Camera,
    ) -> Result<Settled, ViewsError> {
        let rival = |(rotated, bbox): (Hypothesis, Rect)| -> Result<(f64, Hypothesis), ViewsError> {
            let mut rotated = self.closer(rotated, image, camera, &bbox)?;
            add_prints(&mut rotated, prints);
            let poses = [&pose.camera_from_object, &rotated.camera_from_object];
            let close = (pose.similarity - rotated.similarity).abs() < ROTATED_TOLERANCE;
            // Shading alone does not tell one from the other: without a print the similarity decides.
            let both_drawn = pose.drawn.min(rotated.drawn) > 0.0;
            let towards = if close && both_drawn {
                distinction(self.mesh, image, camera, poses)
            } else {
                pose.similarity - rotated.similarity
            };
            Ok((towards, rotated))
        };
        let rivals = self.rotated(&pose, image, camera)?.into_par_iter().map(rival);
        let rivals: Vec<(f64, Hypothesis)> = rivals.collect::<Result<_, _>>()?;
        let nearest = rivals.into_iter().min_by(|a, b| a.0.total_cmp(&b.0));
        let Some((towards, rotated)) = nearest else { return Ok(Settled { pose, rival: None }) };
        let similarity = pose.similarity.max(rotated.similarity);
        let equal = |rival: Hypothesis| (similarity - rival.similarity < AS_GOOD).then_some(rival);
        Ok(if towards < -DISTINCT {
            Settled { pose: Hypothesis { similarity, ..rotated }, rival: equal(pose) }
        } else {
            Settled { pose, rival: equal(rotated) }
        })
    }

    /// A pose refined in a crop of higher resolution around the whole object at this pose, with its outline aligned there.
    pub(crate) fn closer(
        &self,
        hypothesis: Hypothesis,
        image: &RgbImage,
        camera: &Camera,
        bbox: &Rect,
    ) -> Result<Hypothesis, ViewsError> {
        let Some(whole) = projected_box(self.outline, camera, &hypothesis.camera_from_object) else {
            return Ok(hypothesis);
        };
        if whole.width.max(whole.height) > MAX_GROWTH * bbox.width.max(bbox.height) {
            return Ok(hypothesis);
        }
        let side = self.options.close_side;
        let part = Part::new(self.extractor, image, camera, &whole, side)?;
        let Some(part) = part else { return Ok(hypothesis) };
        let start = Hypothesis {
            camera_from_object: part.crop.to_crop(&hypothesis.camera_from_object),
            ..hypothesis
        };
        let Some((mut best, seen)) = self.moved(vec![start], &part)?.pop() else { return Ok(hypothesis) };
        if self.options.outline {
            self.align(&mut best, seen, &part)?;
        }
        let direct = self.options.direct && self.align_directly(&mut best, &part)?;
        let found = part.crop.to_camera(&best.camera_from_object);
        if direct {
            return Ok(Hypothesis { camera_from_object: found, ..best });
        }
        let nearer = found.translation() * (1.0 - self.options.too_far);
        Ok(Hypothesis { camera_from_object: found.with_translation(nearer), ..best })
    }

    /// Aligns the outline of a pose, at which the crop was `seen` before; keeps the old pose if the features agree less afterwards.
    fn align(
        &self,
        best: &mut Hypothesis,
        seen: Option<Correspondences>,
        part: &Part,
    ) -> Result<(), ViewsError> {
        let Part { crop, patch, .. } = part;
        let seen = if seen.is_some() { seen } else { self.seen_at(best, part)?.map(|(seen, _)| seen) };
        let Some(seen) = seen else { return Ok(()) };
        let prior = self.prior(&best.camera_from_object, crop);
        // As for Pix2Pose, whose crops have the same size; weights from a fifth to five times of these change AR_MSSD by less than
        // 0.01.
        let options = AlignmentOptions {
            reaches: vec![8.0, 5.0, 3.0],
            iterations: 5,
            correspondences: 5.0,
            shape: 30.0,
            line: 0.3,
            robust: 1.0,
        };
        let (low, high) = self.mesh.bounding_box();
        let mut alignment = Alignment {
            camera: &crop.camera,
            outline: Outline::new(self.outline, &crop.camera, log_odds(patch, &prior, COLOUR))
                .with_edges(patch, EDGES),
            crop: crop.camera,
            centre: (low + high) * 0.5,
            correspondences: seen,
            options: &options,
        };
        if let Some(aligned) = alignment.run(&best.camera_from_object) {
            let moved = Hypothesis { camera_from_object: aligned.camera_from_object, ..*best };
            if let Some((_, again)) = self.seen_at(&moved, part)?
                && again > best.similarity - TOLERANCE
            {
                *best = Hypothesis { similarity: again.max(best.similarity), ..moved };
            }
        }
        Ok(())
    }

    /// Aligns a pose directly with the crop; keeps the old pose, and returns false, if what is drawn on the object does not agree with
    /// the crop well, or the features agree less afterwards.
    fn align_directly(&self, best: &mut Hypothesis, part: &Part) -> Result<bool, ViewsError> {
        let direct = Direct::new(self.mesh, &part.crop.camera, &part.patch);
        let Some((pose, drawn)) = direct.run(&best.camera_from_object) else { return Ok(false) };
        best.drawn = drawn;
        if drawn < MIN_DRAWN {
            return Ok(false);
        }
        let moved = Hypothesis { camera_from_object: pose, ..*best };
        let Some((_, again)) = self.seen_at(&moved, part)? else { return Ok(false) };
        if again < best.similarity - DIRECT_TOLERANCE {
            return Ok(false);
        }
        let doubt = (-(drawn - MIN_DRAWN) / DRAWN).exp();
        *best = Hypothesis { similarity: 1.0 - (1.0 - again.max(best.similarity)) * doubt, ..moved };
        Ok(true)
    }

    /// Probability that each pixel of the crop shows the object at a pose: uncertain near its outline.
    fn prior(&self, pose: &Pose, crop: &Crop) -> Vec<f32> {
        let mut frame = VisibilityBuffer::new(&crop.camera);
        let objects = [sixfold_render::SceneObject { mesh: self.outline, camera_from_object: *pose }];
        frame.render(&objects, &sixfold_render::RenderOptions::default());
        let side = crop.camera.width;
        let inverse_depth = frame.inverse_depth();
        let mut soft = Coverage::from_fn(side, side, |x, y| f32::from(inverse_depth[y * side + x] > 0.0));
        soft.blur(UNDECIDED);
        soft.data.iter().map(|v| v.clamp(1.0 - DECIDED, DECIDED)).collect()
    }
}

/// Keypoints that agree with a pose raise its similarity.
fn add_prints(pose: &mut Hypothesis, prints: Option<&PrintMatches>) {
    let Some(prints) = prints else { return };
    let agreeing = prints.agreeing(&pose.camera_from_object);
    let doubt = (-(agreeing.saturating_sub(CHANCE) as f64) / PRINT).exp();
    pose.similarity = 1.0 - (1.0 - pose.similarity) * doubt;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::ViewsOptions;
    use crate::features::Extractor;
    use crate::printed::tests::{photograph, printed_box_with};
    use crate::refiner::Refiner;
    use crate::refiner::network::RefinerNetwork;

    #[test]
    fn of_two_equal_faces_the_sides_tell_which_one_is_in_front() {
        // Rotated by 180 degrees about the x axis the box shows the same print, but not on the sides of that axis.
        let mesh = printed_box_with(|axis, side| axis == 0 || side < 0.0);
        let extractor = Extractor::shipped().unwrap();
        let device = burn::tensor::Device::default();
        let refiner = Refiner::new(RefinerNetwork::shipped(&device).unwrap(), device);
        let options = ViewsOptions::default();
        let views = Views {
            extractor: &extractor,
            mesh: &mesh,
            outline: &mesh,
            templates: &[],
            printed: None,
            refiner: Some(&refiner),
            options: &options,
        };
        let camera = Camera::new(900.0, 900.0, 319.5, 239.5, 640, 480).unwrap();
        let truth =
            Pose::exp(&[0.0, 0.0, 0.0, 0.35, 0.75, 0.3].into()).with_translation(Vec3::new(0.02, 0.01, 0.5));
        let image = photograph(&mesh, &truth, &camera);
        let half = UnitQuaternion::from_axis_angle(&Vec3::x_axis(), std::f64::consts::PI);
        let rotated = truth * Pose::new(half, Vec3::zeros());
        let bbox = projected_box(&mesh, &camera, &rotated).unwrap();
        let start = Hypothesis { camera_from_object: rotated, similarity: 0.0, inliers: 0, drawn: 0.0 };
        let found = views.closer_all(vec![(start, bbox)], None, &image, &camera).unwrap();
        assert!(found[0].camera_from_object.rotation_angle_to(&rotated) < 0.1, "first what it started from");
        let settled = views.settled(found[0], None, &image, &camera).unwrap();
        assert!(settled.pose.similarity >= found[0].similarity);
        let best = settled.pose.camera_from_object;
        assert!(best.rotation_angle_to(&truth) < 0.01, "{}", best.rotation_angle_to(&truth));
        // Precise, as what is drawn on the box is aligned.
        assert!(best.distance_to(&truth) < 0.001, "{}", best.distance_to(&truth));
        // For an object without a print the similarity decides, and it hardly differs.
        let plain = Hypothesis { drawn: 0.0, ..found[0] };
        let settled = views.settled(plain, None, &image, &camera).unwrap();
        assert_eq!(settled.pose, plain);
    }

    #[test]
    fn of_two_faces_that_look_the_same_both_poses_are_reported() {
        // The box has the same print after half a turn about x, also on its sides.
        let mesh = printed_box_with(|_, side| side < 0.0);
        let extractor = Extractor::shipped().unwrap();
        let device = burn::tensor::Device::default();
        let refiner = Refiner::new(RefinerNetwork::shipped(&device).unwrap(), device);
        let options = ViewsOptions::default();
        let plain = crate::estimate::tests::without_refiner(&extractor, &mesh, &[], &options);
        let views = Views { refiner: Some(&refiner), ..plain };
        let camera = Camera::new(900.0, 900.0, 319.5, 239.5, 640, 480).unwrap();
        let truth =
            Pose::exp(&[0.0, 0.0, 0.0, 0.35, 0.0, 0.0].into()).with_translation(Vec3::new(0.02, 0.01, 0.5));
        let image = photograph(&mesh, &truth, &camera);
        let bbox = projected_box(&mesh, &camera, &truth).unwrap();
        let start = Hypothesis { camera_from_object: truth, similarity: 0.0, inliers: 0, drawn: 0.0 };
        let found = views.closer(start, &image, &camera, &bbox).unwrap();
        let settled = views.settled(found, None, &image, &camera).unwrap();
        let rival = settled.rival.expect("the other face").camera_from_object;
        let angle = rival.rotation_angle_to(&settled.pose.camera_from_object);
        assert!((angle - std::f64::consts::PI).abs() < 0.05, "{angle}");
        // With a print of its own on every face there is no other pose.
        let mesh = crate::printed::tests::printed_box();
        let views = Views { mesh: &mesh, outline: &mesh, ..views };
        let image = photograph(&mesh, &truth, &camera);
        let found = views.closer(start, &image, &camera, &bbox).unwrap();
        assert_eq!(
            views.settled(found, None, &image, &camera).unwrap(),
            Settled { pose: found, rival: None }
        );
    }
}
