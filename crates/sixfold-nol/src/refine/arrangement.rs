//! One camera pose per image and one place per object instead of a pose for every pair of them: the normal equations of all
//! pairs in one system (bundle adjustment; Triggs et al. 2000, with the dense solver that a few dozen poses allow).
//!
//! A separate pose for an object in an image is the special case of an image with one object.

use sixfold_geometry::nalgebra::{DMatrix, DVector, Matrix3, Matrix6, Vector6};
use sixfold_geometry::{NormalEquations, Pose, Vec3};

/// Poses of cameras and objects in one scene.
#[derive(Debug, Clone)]
pub(super) struct Arrangement {
    camera_from_scene: Vec<Pose>,
    scene_from_object: Vec<Pose>,
    /// Image and object of every source.
    pairs: Vec<[usize; 2]>,
}

/// The pose correction that one source requests.
pub(super) struct Wanted {
    /// Normal equations of a twist about `centre`.
    pub equations: NormalEquations,
    /// The object's centre in the camera's frame.
    pub centre: Vec3,
}

impl Arrangement {
    /// An arrangement from given poses. It reproduces exactly those that form a spanning tree of images and objects.
    pub(crate) fn new(pairs: Vec<[usize; 2]>, poses: &[Pose], images: usize, objects: usize) -> Self {
        let mut cameras: Vec<Option<Pose>> = vec![None; images];
        let mut places: Vec<Option<Pose>> = vec![None; objects];
        while let Some(first) = (0..objects).find(|o| places[*o].is_none()) {
            places[first] = Some(Pose::identity());
            // Alternates between objects and the images that show them.
            loop {
                let mut changed = false;
                for ([image, object], pose) in pairs.iter().zip(poses) {
                    match (cameras[*image], places[*object]) {
                        (None, Some(place)) => cameras[*image] = Some(*pose * place.inverse()),
                        (Some(camera), None) => places[*object] = Some(camera.inverse() * *pose),
                        _ => continue,
                    }
                    changed = true;
                }
                if !changed {
                    break;
                }
            }
        }
        let known = |list: Vec<Option<Pose>>| list.into_iter().map(Option::unwrap_or_default).collect();
        Arrangement { camera_from_scene: known(cameras), scene_from_object: known(places), pairs }
    }

    /// The pose of a source's object in its image.
    pub(crate) fn camera_from_object(&self, source: usize) -> Pose {
        let [image, object] = self.pairs[source];
        self.camera_from_scene[image] * self.scene_from_object[object]
    }

    /// Moves an object in its own frame, the same in all images.
    pub(crate) fn move_object(&mut self, object: usize, motion: &Pose) {
        self.scene_from_object[object] = self.scene_from_object[object] * *motion;
    }

    /// Moves all cameras and objects by one Gauss-Newton step. Returns `false` if the system cannot be solved; then nothing moves.
    pub(crate) fn step(&mut self, wanted: &[Wanted], damping: f64) -> bool {
        let (images, objects) = (self.camera_from_scene.len(), self.scene_from_object.len());
        let size = 6 * (images + objects);
        let mut h = DMatrix::<f64>::zeros(size, size);
        let mut g = DVector::<f64>::zeros(size);
        // Cameras rotate about the centre of the objects in their image, so that rotations and translations are almost decoupled.
        let mut centroids = vec![(Vec3::zeros(), 0.0); images];
        for (wanted, [image, _]) in wanted.iter().zip(&self.pairs) {
            centroids[*image].0 += wanted.centre;
            centroids[*image].1 += 1.0;
        }
        let centroids: Vec<Vec3> = centroids.into_iter().map(|(sum, n)| sum / f64::max(n, 1.0)).collect();
        let mut centres = vec![Vec3::zeros(); objects];
        for (wanted, &[image, object]) in wanted.iter().zip(&self.pairs) {
            centres[object] = self.camera_from_scene[image].inverse().transform_point(&wanted.centre);
        }
        for (wanted, &[image, object]) in wanted.iter().zip(&self.pairs) {
            let (hessian, gradient) = wanted.equations.parts();
            let camera = &self.camera_from_scene[image];
            // A rotation of the camera about this centre also moves the object's centre.
            let mut by_camera = Matrix6::identity();
            let arm = (wanted.centre - centroids[image]).cross_matrix();
            by_camera.fixed_view_mut::<3, 3>(0, 3).copy_from(&-arm);
            let rotation: Matrix3<f64> = camera.rotation_matrix();
            let mut by_object = Matrix6::zeros();
            by_object.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
            by_object.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);
            // The object's centre in the scene is taken from the last image that shows it; it differs between images only by their
            // disagreement.
            let there = camera.transform_point(&centres[object]);
            by_object
                .fixed_view_mut::<3, 3>(0, 3)
                .copy_from(&(-(wanted.centre - there).cross_matrix() * rotation));
            let blocks = [(6 * image, by_camera), (6 * (images + object), by_object)];
            for (row, left) in &blocks {
                let mut part = g.fixed_rows_mut::<6>(*row);
                part += left.transpose() * gradient;
                for (column, right) in &blocks {
                    let mut part = h.fixed_view_mut::<6, 6>(*row, *column);
                    part += left.transpose() * hessian * right;
                }
            }
        }
        for i in 0..size {
            h[(i, i)] += damping * h[(i, i)] + 1e-9;
        }
        let Some(step) = h.cholesky().map(|c| c.solve(&-g)) else { return false };
        if !step.iter().all(|v| v.is_finite()) {
            return false;
        }
        let twist = |at: usize| -> Vector6<f64> { step.fixed_rows::<6>(at).into_owned() };
        let rotated = |pose: &Pose, about: Vec3, twist: Vector6<f64>| {
            let about = Pose::from_translation(about);
            about * Pose::exp(&twist) * about.inverse() * *pose
        };
        for (i, (camera, centroid)) in self.camera_from_scene.iter_mut().zip(centroids).enumerate() {
            *camera = rotated(camera, centroid, twist(6 * i));
        }
        for (o, (place, centre)) in self.scene_from_object.iter_mut().zip(centres).enumerate() {
            *place = rotated(place, centre, twist(6 * (images + o)));
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_step_brings_cameras_and_objects_to_the_optimum() {
        let pairs = vec![[0, 0], [0, 1], [1, 0], [1, 1], [2, 0], [2, 1]];
        let camera = |x: f64, yaw: f64| Pose::exp(&[x, 0.02 * x, 0.8, 0.3, yaw, 0.1 * yaw].into());
        let cameras = [camera(0.1, 0.2), camera(-0.2, -0.5), camera(0.0, 1.0)];
        let objects = [Pose::identity(), Pose::exp(&[0.2, 0.05, -0.1, 0.5, 0.2, -0.4].into())];
        let poses: Vec<Pose> = pairs.iter().map(|[i, o]| cameras[*i] * objects[*o]).collect();
        // Small motions of every camera around its own centre, and of one object.
        let small = |k: f64| Pose::exp(&(Vector6::new(1.0, -0.5, 0.7, 0.8, -0.6, 0.9) * (1e-4 * k)));
        let truth: Vec<Pose> = pairs
            .iter()
            .map(|[i, o]| small(3.0 - 2.0 * *i as f64) * cameras[*i] * objects[*o] * small(2.0 * *o as f64))
            .collect();
        let mut arrangement = Arrangement::new(pairs, &poses, 3, 2);
        let wanted: Vec<Wanted> = poses
            .iter()
            .zip(&truth)
            .map(|(pose, truth)| {
                let centre = pose.translation();
                let turn = (truth.rotation() * pose.rotation().inverse()).scaled_axis();
                let shift = truth.translation() - centre;
                let mut equations = NormalEquations::default();
                for (k, value) in shift.iter().chain(turn.iter()).enumerate() {
                    let mut row = [0.0; 6];
                    row[k] = 1.0;
                    equations.add(&row, -value, 1.0);
                }
                Wanted { equations, centre }
            })
            .collect();
        assert!(arrangement.step(&wanted, 0.0));
        for (k, (pose, truth)) in poses.iter().zip(&truth).enumerate() {
            let now = arrangement.camera_from_object(k);
            let (before, after) = (pose.distance_to(truth), now.distance_to(truth));
            assert!(before > 5e-5 && after < 1e-6, "{k}: {before} {after}");
            assert!(now.rotation_angle_to(truth) < 1e-6, "{k}");
        }
    }
}
