//! Rotations that are hardly visible in an object's shape but visible in its colours: a printed box, a can with a label. A method
//! on depth finds one of them at random; with a colour image the pool chooses the one whose colours agree.

use std::f64::consts::TAU;

use rayon::prelude::*;
use sixfold_align::evidence::{EvidenceCollector, Scene, Shape};
use sixfold_align::{Evidence, VerificationOptions};
use sixfold_geometry::Pose;
use sixfold_mesh::{ContinuousSymmetry, Mesh, SymmetryOptions, find_symmetries};

use crate::hypotheses::{moved_to_depth, ranking};

/// Noise of the mesh's surface as a fraction of its diameter: rotations that depth cannot distinguish need not be exact symmetries,
/// and a mesh made from photographs is rough. 0.005 missed rotations of such meshes (two of eight objects of `sixfold reproduce
/// teach`); the maximum of [`find_symmetries`] is 0.02.
const NOISE: f64 = 0.018;
/// A rotation that differs from a known symmetry by less than this is that symmetry, radians; chosen by hand, not swept.
const KNOWN: f64 = 0.1;
/// Largest number of discrete rotations tried.
const MOST: usize = 24;
/// Steps of a full turn about a continuous axis; chosen by hand, not swept.
const STEPS: usize = 16;
/// Times that the step is halved around the best rotation.
const HALVINGS: usize = 4;
/// Smallest improvement of the agreement of colours; chosen by hand, not swept.
const BETTER: f64 = 0.03;
/// The agreement with depth may decrease by up to this fraction, if that of colours improves by [`WORSE_DEPTH`] times the decrease:
/// a mesh made from photographs is closed where no photograph shows it, and fits upside down as well. Chosen by hand on two of the
/// twelve objects of `sixfold reproduce teach`; not swept.
const DEPTH_LOSS: f64 = 0.5;
/// See [`DEPTH_LOSS`].
const WORSE_DEPTH: f64 = 0.5;

/// The rotations of an object, in its frame.
#[derive(Debug, Default)]
pub(crate) struct LookAlikes {
    /// The identity first.
    discrete: Vec<Pose>,
    axes: Vec<ContinuousSymmetry>,
}

impl LookAlikes {
    /// The look-alikes of a mesh that are not among its known symmetries. None for a mesh without colours.
    pub(crate) fn of(mesh: &Mesh, diameter: f64, symmetries: &[Pose]) -> LookAlikes {
        if mesh.colors().is_none() && mesh.texture().is_none() {
            return LookAlikes::default();
        }
        let options = SymmetryOptions { noise: NOISE * diameter, ..SymmetryOptions::default() };
        // An object of zero size, or of several metres, has none.
        let found = find_symmetries(mesh, &options).unwrap_or_default();
        let is_new = |pose: &Pose| symmetries.iter().all(|known| known.rotation_angle_to(pose) > KNOWN);
        let mut discrete = vec![Pose::identity()];
        for pose in found.iter().flat_map(|s| s.poses()).filter(is_new) {
            if discrete.iter().all(|d| d.rotation_angle_to(&pose) > KNOWN) {
                discrete.push(pose);
            }
        }
        discrete.truncate(MOST);
        let axes: Vec<ContinuousSymmetry> = found
            .iter()
            .filter_map(|s| s.continuous())
            // Tests a quarter turn and another angle: a known symmetry of order 4 does not include all rotations.
            .filter(|axis| is_new(&axis.rotation(0.25 * TAU)) || is_new(&axis.rotation(0.15 * TAU)))
            .collect();
        LookAlikes { discrete, axes }
    }

    /// The pose among its look-alikes whose colours agree best with the image, if it is not `pose` itself.
    pub(crate) fn best(
        &self,
        scene: &Scene<'_>,
        shape: &Shape<'_>,
        diameter: f64,
        (pose, evidence): (&Pose, &Evidence),
    ) -> Option<(Pose, Evidence)> {
        if self.discrete.len() <= 1 && self.axes.is_empty() {
            return None;
        }
        let options = VerificationOptions::default();
        let judge = |pose: Pose| {
            let evidence = EvidenceCollector::default().collect(scene, shape, &pose, &options);
            (agreement(&evidence), pose, evidence)
        };
        let mut best = (agreement(evidence)?, *pose, evidence.clone());
        let needed = best.0 + BETTER;
        let tried: Vec<(Option<f64>, Pose, Evidence)> = self
            .discrete
            .par_iter()
            .flat_map_iter(|discrete| self.around(discrete))
            .map(|rotation| judge(*pose * rotation))
            .collect();
        let better = |a: &(f64, Pose, Evidence), b: &(Option<f64>, Pose, Evidence)| {
            b.0.is_some_and(|agreement| agreement > a.0)
        };
        let mut take = |candidate: (Option<f64>, Pose, Evidence)| {
            if better(&best, &candidate)
                && let (Some(agreement), pose, evidence) = candidate
            {
                best = (agreement, pose, evidence);
            }
            best.1
        };
        for candidate in tried {
            take(candidate);
        }
        for axis in &self.axes {
            let mut step = TAU / STEPS as f64;
            for _ in 0..HALVINGS {
                step *= 0.5;
                let from = take((None, *pose, evidence.clone()));
                for angle in [-step, step] {
                    take(judge(from * axis.rotation(angle)));
                }
            }
        }
        if best.0 < needed {
            return None;
        }
        // A look-alike is only approximately symmetric: its pose is aligned with depth.
        if let Some(moved) = moved_to_depth(scene, shape, diameter, &best.1) {
            let (agreement, moved, after) = judge(moved);
            if agreement.is_some_and(|agreement| agreement >= needed) && ranking(&after) > ranking(&best.2) {
                best = (best.0, moved, after);
            }
        }
        let loss = 1.0 - ranking(&best.2) / ranking(evidence).max(f64::MIN_POSITIVE);
        let is_worth_it = loss <= DEPTH_LOSS && best.0 >= needed + WORSE_DEPTH * loss.max(0.0);
        is_worth_it.then_some((best.1, best.2))
    }

    /// A discrete rotation, alone and combined with all steps about every axis.
    fn around(&self, discrete: &Pose) -> Vec<Pose> {
        let steps = (1..STEPS).map(|k| TAU * k as f64 / STEPS as f64);
        let rotations = self.axes.iter().flat_map(|axis| steps.clone().map(|angle| axis.rotation(angle)));
        std::iter::once(*discrete).chain(rotations.map(|rotation| *discrete * rotation)).collect()
    }
}

/// How well the colours of a pose agree with the image.
fn agreement(evidence: &Evidence) -> Option<f64> {
    let color = evidence.color.as_ref()?;
    Some(color.correlation - color.tint.unwrap_or(0.0))
}

#[cfg(test)]
mod tests {
    use sixfold_align::{ColorGradients, DepthOptions, PreparedDepth};
    use sixfold_geometry::{Camera, Image, RgbImage, Vec3};
    use sixfold_render::{Light, Material, RenderOptions, SceneObject, VisibilityBuffer, shade};

    use super::*;

    const CAMERA: Camera =
        Camera { fx: 500.0, fy: 500.0, cx: 160.0, cy: 120.0, width: 320, height: 240, distortion: None };

    /// A surface of many small faces between rings of points: `point(u, v)`, u all around and v from bottom to top.
    fn lathe(point: impl Fn(f64, f64) -> Vec3, color: impl Fn(f64, f64) -> [u8; 3]) -> Mesh {
        const AROUND: u32 = 72;
        const UP: u32 = 12;
        let (mut vertices, mut colors, mut faces) = (vec![], vec![], vec![]);
        for j in 0..=UP {
            for i in 0..AROUND {
                let (u, v) = (f64::from(i) / f64::from(AROUND), f64::from(j) / f64::from(UP));
                vertices.push(point(u, v));
                colors.push(color(u, v));
            }
        }
        for j in 0..UP {
            for i in 0..AROUND {
                let [a, b] = [j * AROUND + i, j * AROUND + (i + 1) % AROUND];
                faces.extend([[a, b, b + AROUND], [a, b + AROUND, a + AROUND]]);
            }
        }
        Mesh::new(vertices, faces).unwrap().with_colors(colors).unwrap()
    }

    /// A label: one colour on one side of the can, others elsewhere.
    fn can() -> Mesh {
        let point = |u: f64, v: f64| {
            let angle = TAU * u;
            Vec3::new(0.035 * angle.cos(), 0.035 * angle.sin(), 0.11 * (v - 0.5))
        };
        let level = |x: f64| (128.0 + 100.0 * x) as u8;
        let color = |u: f64, v: f64| {
            let angle = TAU * u;
            [level(angle.cos()), level((2.0 * angle).sin()), level((angle + 5.0 * v).sin())]
        };
        lathe(point, color)
    }

    /// The best look-alike of the true pose rotated by an angle about the can's axis.
    fn best(mesh: &Mesh, angle: f64) -> Option<Pose> {
        let truth = truth();
        let objects = [SceneObject { mesh, camera_from_object: truth }];
        let mut frame = VisibilityBuffer::new(&CAMERA);
        frame.render(&objects, &RenderOptions::default());
        let depth = frame.depth().map(|z| if *z > 0.0 { *z } else { 0.9 });
        let grey: RgbImage = Image::filled(320, 240, [120; 3]);
        let rgb = shade(&frame, &objects, &Light::default_set(), &Material::default(), Some(&grey));
        let options = DepthOptions { remove_plane: false, ..DepthOptions::default() };
        let prepared = PreparedDepth::new(&depth, &CAMERA, &options).unwrap();
        let gradients = ColorGradients::new(&rgb);
        let scene = Scene { camera: &CAMERA, depth: Some(&prepared), color: Some((&rgb, &gradients)) };
        let shape = Shape { mesh, colored: mesh, threshold: 0.008 };
        let known = LookAlikes::of(mesh, mesh.diameter(), &[Pose::identity()]);
        let axis = ContinuousSymmetry { axis: Vec3::z(), offset: Vec3::zeros() };
        let given = truth * axis.rotation(angle);
        let evidence =
            EvidenceCollector::default().collect(&scene, &shape, &given, &VerificationOptions::default());
        known.best(&scene, &shape, mesh.diameter(), (&given, &evidence)).map(|(pose, _)| pose)
    }

    fn truth() -> Pose {
        let twist = sixfold_geometry::nalgebra::Vector6::new(0.0, 0.0, 0.0, 1.1, 0.2, 0.1);
        Pose::new(Pose::exp(&twist).rotation(), Vec3::new(0.01, 0.0, 0.5))
    }

    #[test]
    fn the_label_of_a_can_determines_its_rotation() {
        for degrees in [40.0f64, 100.0, 180.0, 290.0] {
            let pose = best(&can(), degrees.to_radians()).expect("another rotation agrees better");
            let off = pose.rotation_angle_to(&truth()).to_degrees();
            assert!(off < 4.0, "given {degrees} degrees off, found {off}");
        }
    }

    #[test]
    fn a_pose_whose_colours_agree_stays() {
        assert!(best(&can(), 0.0).is_none());
    }

    #[test]
    fn a_mesh_without_colours_or_with_known_symmetries_has_no_look_alikes() {
        let can = can();
        let plain = Mesh::new(can.vertices().to_vec(), can.faces().to_vec()).unwrap();
        assert!(LookAlikes::of(&plain, plain.diameter(), &[Pose::identity()]).discrete.is_empty());
        assert!(!LookAlikes::of(&can, can.diameter(), &[Pose::identity()]).axes.is_empty());
        let mut info = sixfold_mesh::ModelInfo::of_mesh(&can);
        info.rotates_freely_about(Vec3::z());
        let known = LookAlikes::of(&can, can.diameter(), &info.symmetry_poses(0.05));
        assert!(known.axes.is_empty(), "{known:?}");
    }
}
