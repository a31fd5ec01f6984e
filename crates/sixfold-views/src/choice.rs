//! Which of the refined poses in a given box is right: the one with the largest `similarity + 1.2 recognised + 0.6 covered + 1.3 within`, where
//! `covered` is the fraction of the given box that the pose's box covers, and `within` the fraction of the latter that is within the former.
//! The sum is ours; its weights were fitted so that right poses come first (listwise, Cao et al. 2007).

use rayon::prelude::*;
use sixfold_align::outline::projected_box;
use sixfold_geometry::{Camera, Rect, RgbImage};

use crate::error::ViewsError;
use crate::estimate::{Hypothesis, Views};

/// Number of the most similar poses among which the choice is made.
const COMPARED: usize = 4;
/// Weights relative to the similarity of a pose, fitted to the poses of 594 searches in simulated images, on no real image.
const RECOGNISED: f64 = 1.2;
const COVERED: f64 = 0.6;
const WITHIN: f64 = 1.3;

impl Views<'_> {
    /// The most similar of `poses`, which are sorted by similarity, sorted by what speaks for them: similarity, what the image is recognised
    /// as there ([`crate::Recogniser::similarity`]), and how well the pose's box and the given one cover each other. Similarity alone
    /// prefers poses that show little of the object, or something else beside it, where that looks right. Without a refiner, to whose similarity
    /// the weights were fitted, `poses` as they are.
    pub(crate) fn chosen(
        &self,
        mut poses: Vec<Hypothesis>,
        bbox: &Rect,
        image: &RgbImage,
        camera: &Camera,
    ) -> Result<Vec<Hypothesis>, ViewsError> {
        if poses.len() < 2 || self.refiner.is_none() {
            return Ok(poses);
        }
        let rest = poses.split_off(poses.len().min(COMPARED));
        let recogniser = self.extractor.recogniser();
        let score = |pose: Hypothesis| -> Result<(f64, Hypothesis), ViewsError> {
            let recognised = recogniser.similarity(self.mesh, image, camera, &pose.camera_from_object)?;
            let [covered, within] = self.cover(&pose, bbox, camera);
            let boxes = COVERED * covered + WITHIN * within;
            Ok((pose.similarity + RECOGNISED * recognised.unwrap_or(0.0) + boxes, pose))
        };
        let scored: Result<Vec<(f64, Hypothesis)>, ViewsError> = poses.into_par_iter().map(score).collect();
        let mut scored = scored?;
        scored.sort_by(|a, b| b.0.total_cmp(&a.0));
        Ok(scored.into_iter().map(|(_, pose)| pose).chain(rest).collect())
    }

    /// The fraction of a box that the box of the object at a pose covers, and the fraction of the latter, as far as it is in the image,
    /// that is within the former.
    fn cover(&self, pose: &Hypothesis, bbox: &Rect, camera: &Camera) -> [f64; 2] {
        let whole = Rect { x: 0.0, y: 0.0, width: camera.width as f64, height: camera.height as f64 };
        let own = projected_box(self.outline, camera, &pose.camera_from_object);
        let Some(own) = own.and_then(|own| own.intersect(&whole)) else { return [0.0; 2] };
        let common = own.intersect(bbox).map_or(0.0, |common| common.area());
        [common / bbox.area().max(1.0), common / own.area().max(1.0)]
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;
    use sixfold_geometry::nalgebra::UnitQuaternion;
    use sixfold_geometry::{Pose, Vec3};

    use super::*;
    use crate::estimate::ViewsOptions;
    use crate::estimate::tests::{part, photographed, without_refiner};
    use crate::features::Extractor;
    use crate::refiner::Refiner;
    use crate::refiner::network::RefinerNetwork;

    #[test]
    fn the_given_box_and_what_is_recognised_decide_between_poses_of_about_equal_similarity() {
        let camera = Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap();
        let (image, truth, bbox) = photographed(&camera);
        let (mesh, extractor, options) = (part(), Extractor::shipped().unwrap(), ViewsOptions::default());
        let plain = without_refiner(&extractor, &mesh, &[], &options);
        let device = Device::default();
        let refiner = Refiner::new(RefinerNetwork::shipped(&device).unwrap(), device);
        let views = Views { refiner: Some(&refiner), ..without_refiner(&extractor, &mesh, &[], &options) };
        let at = |camera_from_object: Pose, similarity: f64| Hypothesis {
            camera_from_object,
            similarity,
            inliers: 20,
            drawn: 0.0,
        };
        let first = |views: &Views<'_>, poses: &[Hypothesis]| {
            views.chosen(poses.to_vec(), &bbox, &image, &camera).unwrap()[0].camera_from_object
        };
        // Half as large, within the box: it covers a quarter of it.
        let far = truth.with_translation(truth.translation() * 2.0);
        let [covered, within] = views.cover(&at(truth, 0.0), &bbox, &camera);
        assert!(covered > 0.95 && within > 0.95, "{covered} {within}");
        let [covered, within] = views.cover(&at(far, 0.0), &bbox, &camera);
        assert!((covered - 0.25).abs() < 0.05 && within > 0.95, "{covered} {within}");
        // Twice as large: a quarter of it is within the box.
        let near = truth.with_translation(truth.translation() * 0.5);
        let [covered, within] = views.cover(&at(near, 0.0), &bbox, &camera);
        assert!(covered > 0.95 && (within - 0.25).abs() < 0.05, "{covered} {within}");
        // Each difference in similarity is larger than what is left without the weight that decides here.
        for (wrong, similarity) in [(far, 0.7), (near, 0.95)] {
            let poses = [at(wrong, similarity), at(truth, 0.05)];
            assert_eq!(first(&views, &poses), truth);
            assert_eq!(first(&plain, &poses), wrong);
        }
        assert_eq!(first(&views, &[at(far, 0.98), at(truth, 0.05)]), far);
        // Upside down in the same box.
        let half =
            Pose::new(UnitQuaternion::from_axis_angle(&Vec3::z_axis(), std::f64::consts::PI), Vec3::zeros());
        let centre = Pose::from_translation(truth.translation());
        let rotated = centre * half * centre.inverse() * truth;
        assert_eq!(first(&views, &[at(rotated, 0.75), at(truth, 0.35)]), truth);
        assert_eq!(first(&views, &[at(rotated, 0.95), at(truth, 0.2)]), rotated);
        // Only the most similar poses are compared.
        let many = [&[at(rotated, 0.6); COMPARED][..], &[at(truth, 0.59)]].concat();
        assert_eq!(first(&views, &many), rotated);
    }
}
