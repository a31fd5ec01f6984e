//! A refiner of poses: the object is rendered at a pose, a network predicts for every cell of the render its position in the image
//! with a confidence, and the pose is updated accordingly, over several iterations (the structure of Lipson et al. 2022, "Coupled
//! iterative refinement", and of GoTrack, Nguyen et al. 2025: correlations, displacements with confidence, PnP). It is trained on
//! synthetic objects only.

use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use sixfold_geometry::{Camera, Pose, Trust, Vec2, Vec3, refine_trusted};
use sixfold_mesh::Mesh;
use sixfold_nn::xfeat::CELL;
use sixfold_render::VisibilityBuffer;

use crate::error::ViewsError;
use crate::features::{Extractor, FeatureMap};
use crate::matching::dot;
use crate::templates::{input_over_grey, render};
use network::{CELL_INPUTS, OUTPUTS, PICTURE_INPUTS, REACH, RefinerNetwork};
use samples::cell_centre;

pub mod network;
pub mod recipe;
mod samples;
pub mod training;

/// The pixel that represents a cell.
const HALF_CELL: usize = CELL / 2;
/// A pose is final if the object's points move by less than this from one iteration to the next, on average, pixels of the crop. Of 0, 0.3,
/// 0.5 and 1 pixels on 76 targets of LM-O's development frames: AR_MSSD .533, .538, .533 and .507 in 80, 75, 68 and 60 s.
const STILL: f64 = 0.3;
/// Renders per forward pass.
const BATCH: usize = 16;
/// Scales unit features and their products to the magnitude of the other inputs.
const FEATURE_SCALE: f32 = 8.0;
const PRODUCT_SCALE: f32 = 3.0;

/// An object rendered at a pose.
pub struct Shown {
    /// The network's input of the render.
    pub input: Vec<f32>,
    /// 1 for pixels that show the object.
    pub mask: Vec<f32>,
    /// Cells whose centre shows the object.
    pub cells: Vec<u16>,
    /// The points visible there, metres in the object's frame.
    pub points: Vec<[f32; 3]>,
}

/// Renders an object; `None` if no cell shows it.
pub fn shown(frame: &mut VisibilityBuffer, mesh: &Mesh, pose: &Pose) -> Option<Shown> {
    let rendered = render(frame, mesh, pose, None);
    let side = rendered.coordinates.size().0;
    let n = side / CELL;
    let mask = rendered.coordinates.as_slice().iter().map(|p| f32::from(!p[0].is_nan())).collect();
    let (mut cells, mut points) = (Vec::new(), Vec::new());
    for cell in 0..n * n {
        let point = rendered.coordinates[(cell % n * CELL + HALF_CELL, cell / n * CELL + HALF_CELL)];
        if !point[0].is_nan() {
            cells.push(cell as u16);
            points.push(point);
        }
    }
    (!cells.is_empty()).then(|| Shown { input: input_over_grey(&rendered), mask, cells, points })
}

/// The network's inputs for a render and a crop.
pub(crate) struct Pair {
    pub(crate) picture: Vec<f32>,
    pub(crate) cells: Vec<f32>,
}

/// `crop` is the crop's input, `map` its features, `seen` those of the render.
pub(crate) fn pair(shown: &Shown, seen: &FeatureMap, crop: &[f32], map: &FeatureMap) -> Pair {
    let picture = [&shown.input[..], crop, &shown.mask].concat();
    let n = map.cells;
    let area = n * n;
    let mut cells = vec![0.0; CELL_INPUTS * area];
    fill_cells(&mut cells, &seen.features, &map.features, n);
    for cell in &shown.cells {
        cells[(CELL_INPUTS - 1) * area + usize::from(*cell)] = 1.0;
    }
    Pair { picture, cells }
}

sixfold_nn::vectorised! {
    /// Writes the features of a render and of a crop with `n` x `n` cells, and their products around each cell, plane by plane.
    fn fill_cells(out: &mut [f32], seen: &[f32], crop: &[f32], n: usize) {
        let area = n * n;
        let channels = seen.len() / area.max(1);
        let reach = REACH as i64;
        for (cell, feature) in seen.chunks_exact(channels.max(1)).enumerate() {
            let here = &crop[cell * channels..][..channels];
            for c in 0..channels {
                out[c * area + cell] = FEATURE_SCALE * feature[c];
                out[(channels + c) * area + cell] = FEATURE_SCALE * here[c];
            }
            let (x, y) = ((cell % n) as i64, (cell / n) as i64);
            let mut plane = 2 * channels;
            for v in y - reach..=y + reach {
                for u in x - reach..=x + reach {
                    if (0..n as i64).contains(&u) && (0..n as i64).contains(&v) {
                        let product = dot(feature, &crop[(v as usize * n + u as usize) * channels..][..channels]);
                        out[plane * area + cell] = PRODUCT_SCALE * product;
                    }
                    plane += 1;
                }
            }
        }
    }
}

/// A crop in which poses are refined.
pub struct Target<'a> {
    /// Its camera.
    pub camera: &'a Camera,
    /// The network's input of it.
    pub input: &'a [f32],
    /// Its features.
    pub map: &'a FeatureMap,
}

/// Positions in the crop of the object's points as rendered at a pose.
#[derive(Debug, Clone)]
pub struct Displaced {
    /// Points of the object, metres in its frame.
    pub points: Vec<Vec3>,
    /// Their pixels in the crop.
    pub pixels: Vec<Vec2>,
    /// Uncertainty of each pixel, pixels.
    pub spreads: Vec<f64>,
    /// Probability that the crop shows each point.
    pub weights: Vec<f64>,
    /// Fraction of the cells that the crop shows at the same position as the render, as predicted by the network: 0 to 1.
    pub score: f64,
}

impl Displaced {
    /// The pose that fits these points, starting from one near it.
    fn pose(&self, camera: &Camera, from: &Pose) -> Option<Pose> {
        let trust: Vec<Trust> = self
            .spreads
            .iter()
            .zip(&self.weights)
            .map(|(spread_px, weight)| Trust { spread_px: *spread_px, weight: *weight })
            .collect();
        refine_trusted(&self.points, &self.pixels, &trust, camera, from).ok()
    }
}

/// A pose after several iterations.
#[derive(Debug, Clone)]
pub struct Refined {
    /// From the object's frame to the crop's.
    pub pose: Pose,
    /// [`Displaced::score`] there, 0 to 1.
    pub score: f64,
    /// The object's points there; `None` if it is not visible.
    pub seen: Option<Displaced>,
}

/// A pose between two iterations.
pub(crate) struct Progress {
    /// The best of the iterations so far.
    pub(crate) best: Refined,
    /// The pose of the next one; `None` if the last one hardly moved it, or it is stopped.
    pub(crate) next: Option<Pose>,
}

impl Progress {
    pub(crate) fn new(pose: Pose) -> Progress {
        Progress { best: Refined { pose, score: 0.0, seen: None }, next: Some(pose) }
    }
}

impl Displaced {
    /// The points that the crop shows with a probability above a half, and their pixels.
    pub(crate) fn sure(self) -> Vec<(Vec3, Vec2)> {
        let pairs = self.points.into_iter().zip(self.pixels).zip(self.weights);
        pairs.filter(|(_, weight)| *weight > 0.5).map(|(pair, _)| pair).collect()
    }

    /// Whether the points move by more than [`STILL`] in the crop from one pose to another, on average.
    fn moves(&self, camera: &Camera, from: &Pose, to: &Pose) -> bool {
        let pixel = |pose: &Pose, point: &Vec3| camera.project(&pose.transform_point(point));
        let moved = self.points.iter().map(|p| match (pixel(from, p), pixel(to, p)) {
            (Some(from), Some(to)) => (to - from).norm(),
            _ => f64::INFINITY,
        });
        moved.sum::<f64>() > STILL * self.points.len() as f64
    }
}

/// The network, ready to run.
#[derive(Debug)]
pub struct Refiner {
    network: RefinerNetwork,
    device: Device,
}

impl Refiner {
    /// A network on the device of its tensors.
    pub fn new(network: RefinerNetwork, device: Device) -> Refiner {
        Refiner { network, device }
    }

    /// Compares the object rendered at each pose with the crop; `None` if it is not visible, or nearer than `nearest` metres.
    ///
    /// # Errors
    /// [`ViewsError::Network`].
    pub fn compare(
        &self,
        extractor: &Extractor,
        mesh: &Mesh,
        crop: &Target<'_>,
        poses: &[Pose],
        nearest: f64,
    ) -> Result<Vec<Option<Displaced>>, ViewsError> {
        let side = crop.camera.width;
        let rendered: Vec<Option<Shown>> = poses
            .par_iter()
            .map_init(
                || VisibilityBuffer::new(crop.camera),
                |frame, pose| (pose.translation().z >= nearest).then(|| shown(frame, mesh, pose)).flatten(),
            )
            .collect();
        let inputs: Vec<&[f32]> = rendered.iter().flatten().map(|s| &s.input[..]).collect();
        let maps = extractor.features(&inputs, side)?;
        let all: Vec<&Shown> = rendered.iter().flatten().collect();
        let pairs: Vec<Pair> =
            all.par_iter().zip(&maps).map(|(shown, seen)| pair(shown, seen, crop.input, crop.map)).collect();
        let mut outputs = Vec::with_capacity(pairs.len());
        let cells = side / CELL;
        for batch in pairs.chunks(BATCH) {
            let values = self.run(batch, side)?;
            outputs.extend(values.chunks_exact(OUTPUTS * cells * cells).map(<[f32]>::to_vec));
        }
        let mut outputs = outputs.into_iter();
        Ok(rendered
            .into_iter()
            .map(|shown| shown.and_then(|s| outputs.next().map(|o| displaced(&s, &o, cells))))
            .collect())
    }

    /// Renders, compares and updates each pose up to `times` times, until it hardly moves; returns the best of all iterations, including the
    /// first.
    ///
    /// # Errors
    /// [`ViewsError::Network`].
    pub fn refine(
        &self,
        extractor: &Extractor,
        mesh: &Mesh,
        crop: &Target<'_>,
        poses: &[Pose],
        nearest: f64,
        times: usize,
    ) -> Result<Vec<Refined>, ViewsError> {
        let mut all: Vec<Progress> = poses.iter().map(|pose| Progress::new(*pose)).collect();
        for _ in 0..=times {
            self.advance(extractor, mesh, crop, &mut all.iter_mut().collect::<Vec<_>>(), nearest)?;
        }
        Ok(all.into_iter().map(|progress| progress.best).collect())
    }

    /// One of the iterations of [`Refiner::refine`], for the poses that still move.
    ///
    /// # Errors
    /// [`ViewsError::Network`].
    pub(crate) fn advance(
        &self,
        extractor: &Extractor,
        mesh: &Mesh,
        crop: &Target<'_>,
        all: &mut [&mut Progress],
        nearest: f64,
    ) -> Result<(), ViewsError> {
        let poses: Vec<Pose> = all.iter().filter_map(|progress| progress.next).collect();
        let mut compared = self.compare(extractor, mesh, crop, &poses, nearest)?.into_iter();
        for progress in all {
            let Some(pose) = progress.next.take() else { continue };
            let Some(compared) = compared.next().flatten() else { continue };
            let moved = compared.pose(crop.camera, &pose);
            progress.next = moved.filter(|moved| compared.moves(crop.camera, &pose, moved));
            if progress.best.seen.is_none() || compared.score >= progress.best.score {
                progress.best = Refined { pose, score: compared.score, seen: Some(compared) };
            }
        }
        Ok(())
    }

    fn run(&self, batch: &[Pair], side: usize) -> Result<Vec<f32>, ViewsError> {
        let cells = side / CELL;
        let pictures = batch.iter().map(|p| &p.picture[..]).collect::<Vec<_>>().concat();
        let of_cells = batch.iter().map(|p| &p.cells[..]).collect::<Vec<_>>().concat();
        let pictures = TensorData::new(pictures, [batch.len(), PICTURE_INPUTS, side, side]);
        let of_cells = TensorData::new(of_cells, [batch.len(), CELL_INPUTS, cells, cells]);
        let out = self.network.forward(
            Tensor::<4>::from_data(pictures, &self.device),
            Tensor::<4>::from_data(of_cells, &self.device),
        );
        out.try_into_vec_as::<f32>().map_err(|e| ViewsError::Network { reason: e.to_string() })
    }
}

fn displaced(shown: &Shown, output: &[f32], cells: usize) -> Displaced {
    let area = cells * cells;
    let mut out = Displaced { points: vec![], pixels: vec![], spreads: vec![], weights: vec![], score: 0.0 };
    for (cell, point) in shown.cells.iter().zip(&shown.points) {
        let cell = usize::from(*cell);
        let value = |k: usize| f64::from(output[k * area + cell]);
        let flow = Vec2::new(value(0), value(1)) * CELL as f64;
        out.points.push(Vec3::from(point.map(f64::from)));
        out.pixels.push(cell_centre(cell, cells) + flow);
        out.spreads.push(value(2).clamp(training::SPREADS[0], training::SPREADS[1]).exp() * CELL as f64);
        out.weights.push(sigmoid(value(3)));
        out.score += sigmoid(value(4));
    }
    out.score /= shown.cells.len() as f64;
    out
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::crop::Crop;
    use crate::estimate::tests::cuboid;
    use crate::network::input;
    use crate::refiner::samples::{Kind, RENDERS, make_sample};
    use crate::templates::wide_camera;
    use sixfold_geometry::Rect;
    use sixfold_geometry::nalgebra::UnitQuaternion;
    use sixfold_geometry::random::stream;
    use sixfold_mesh::Mesh;
    use sixfold_synth::augment::{Backgrounds, Patch};
    use sixfold_synth::distractors::random_solid;

    fn shipped() -> (Extractor, Refiner) {
        let device = Device::default();
        let network = RefinerNetwork::shipped(&device).unwrap();
        (Extractor::shipped().unwrap(), Refiner::new(network, device))
    }

    /// An object in two colours without symmetries, and a crop that shows it.
    fn scene() -> (Mesh, Crop, Pose, Patch) {
        let mesh = Mesh::merged(&[
            cuboid([-0.06, -0.03, -0.03], [0.06, 0.03, 0.03], [200, 60, 40]),
            cuboid([0.02, 0.0, 0.03], [0.06, 0.03, 0.09], [40, 90, 190]),
        ])
        .unwrap();
        let truth = Pose::new(UnitQuaternion::from_euler_angles(2.1, 0.5, 0.7), Vec3::new(0.0, 0.0, 0.9));
        let mut frame = VisibilityBuffer::new(&wide_camera());
        let objects = [sixfold_render::SceneObject { mesh: &mesh, camera_from_object: truth }];
        frame.render(&objects, &sixfold_render::RenderOptions::default());
        let bbox: Rect = frame.bounding_box().unwrap();
        let crop = Crop::of_box(&wide_camera(), &bbox, 1.2, 160).unwrap();
        let truth = crop.to_crop(&truth);
        let mut frame = VisibilityBuffer::new(&crop.camera);
        let table = sixfold_geometry::RgbImage::from_fn(160, 160, |x, y| {
            let noise = ((x / 9 * 7 + y / 7 * 13) % 37) as u8;
            [120 + noise, 110 + noise, 100]
        });
        let patch = Patch::from_rgb(&render(&mut frame, &mesh, &truth, Some(&table)).image);
        (mesh, crop, truth, patch)
    }

    #[test]
    fn a_disturbed_pose_moves_back_and_a_wrong_one_scores_less() {
        let (extractor, refiner) = shipped();
        let (mesh, crop, truth, patch) = scene();
        let input = input(&patch.data);
        let map = extractor.features(std::slice::from_ref(&input), 160).unwrap().remove(0);
        let target = Target { camera: &crop.camera, input: &input, map: &map };
        let near = Pose::exp(&[0.004, -0.003, 0.03, 0.1, -0.12, 0.08].into());
        let near = Pose::new(near.rotation() * truth.rotation(), truth.translation() + near.translation());
        let wrong = Pose::new(
            UnitQuaternion::from_euler_angles(0.0, 1.5, 0.9) * truth.rotation(),
            truth.translation(),
        );
        let refined = refiner.refine(&extractor, &mesh, &target, &[near, wrong], 0.05, 4).unwrap();
        let angle = |pose: &Pose| pose.rotation_angle_to(&truth).to_degrees();
        let pixels = |pose: &Pose| {
            let at = |pose: &Pose, p: &Vec3| crop.camera.project(&pose.transform_point(p)).unwrap();
            let off = |p: &Vec3| (at(pose, p) - at(&truth, p)).norm();
            mesh.vertices().iter().map(off).sum::<f64>() / mesh.vertices().len() as f64
        };
        let found = &refined[0].pose;
        assert!(angle(&near) > 9.0 && angle(found) < 5.0, "{}", angle(found));
        assert!(pixels(&near) > 5.0 && pixels(found) < 2.5, "{}", pixels(found));
        assert!(refined[0].score > refined[1].score + 0.2, "{} {}", refined[0].score, refined[1].score);
        // What is returned with it was seen at this pose.
        let seen = refiner.compare(&extractor, &mesh, &target, &[*found], 0.05).unwrap().remove(0).unwrap();
        let kept = refined[0].seen.clone().unwrap();
        assert_eq!(seen.pixels.len(), kept.pixels.len());
        assert!((seen.score - refined[0].score).abs() < 1e-5, "{} {}", seen.score, refined[0].score);
        let off = seen.pixels.iter().zip(&kept.pixels).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
        assert!(off < 1e-3, "{off}");
        // The first pose that hardly moves is final, however many iterations are allowed.
        let refine = |pose: Pose, times: usize| {
            refiner.refine(&extractor, &mesh, &target, &[pose], 0.05, times).unwrap().remove(0).pose
        };
        let mut still = refine(near, 8);
        for _ in 0..8 {
            still = refine(still, 1);
        }
        let seen = refiner.compare(&extractor, &mesh, &target, &[still], 0.05).unwrap().remove(0).unwrap();
        let next = seen.pose(&crop.camera, &still).unwrap();
        assert!(next != still && !seen.moves(&crop.camera, &still, &next));
        assert_eq!(refine(still, 8), still);
    }

    #[test]
    fn poses_move_if_their_points_do() {
        let camera = Camera::new(100.0, 100.0, 79.5, 79.5, 160, 160).unwrap();
        let at = |x: f64, z: f64| Pose::from_translation(Vec3::new(x, 0.0, z));
        let points = vec![Vec3::zeros(), Vec3::new(0.1, 0.0, 0.0)];
        let seen = Displaced { points, pixels: vec![], spreads: vec![], weights: vec![], score: 0.0 };
        let moves = |to: Pose| seen.moves(&camera, &at(0.0, 1.0), &to);
        assert!(!moves(at(0.0, 1.0)) && !moves(at(0.9 * STILL / 100.0, 1.0)));
        assert!(moves(at(1.1 * STILL / 100.0, 1.0)) && moves(at(0.0, -1.0)));
        // Farther away only the second point moves: by 10 pixels less 10 / 1.2.
        assert!(moves(at(0.0, 1.2)) && !moves(at(0.0, 1.02)));
    }

    #[test]
    fn a_pose_that_shows_nothing_stays_and_scores_nothing() {
        let (extractor, refiner) = shipped();
        let (mesh, crop, truth, patch) = scene();
        let input = input(&patch.data);
        let map = extractor.features(std::slice::from_ref(&input), 160).unwrap().remove(0);
        let target = Target { camera: &crop.camera, input: &input, map: &map };
        let beside = truth.with_translation(truth.translation() + Vec3::new(5.0, 0.0, 0.0));
        let too_near = truth.with_translation(Vec3::new(0.0, 0.0, 0.01));
        let refined = refiner.refine(&extractor, &mesh, &target, &[beside, too_near], 0.05, 2).unwrap();
        for (refined, pose) in refined.iter().zip([beside, too_near]) {
            assert!(refined.pose == pose && refined.score == 0.0 && refined.seen.is_none());
        }
    }

    #[test]
    fn the_true_displacements_lead_to_the_true_pose() {
        let textures = Backgrounds::procedural();
        let sample = make_sample(&textures, Kind::Close, 160, 3, 1);
        assert_eq!(sample.renders.len(), RENDERS);
        assert_eq!(sample.photograph, make_sample(&textures, Kind::Close, 160, 3, 1).photograph);
        // A solid at a perturbed pose: the training targets agree with the projection.
        let mut random = stream(1, 0);
        let mesh = random_solid(&textures, &[], &mut random).scaled(0.1);
        let truth = Pose::from_translation(Vec3::new(0.0, 0.0, 1.0));
        let camera = Camera::new(900.0, 900.0, 79.5, 79.5, 160, 160).unwrap();
        let near = Pose::exp(&[0.001, 0.002, 0.02, 0.05, -0.04, 0.1].into()) * truth;
        let mut frame = VisibilityBuffer::new(&camera);
        let shown = shown(&mut frame, &mesh, &near).unwrap();
        let points: Vec<Vec3> = shown.points.iter().map(|p| Vec3::from(p.map(f64::from))).collect();
        for (cell, point) in shown.cells.iter().zip(&points) {
            let seen = camera.project(&near.transform_point(point)).unwrap();
            assert!((seen - cell_centre(usize::from(*cell), 20)).norm() < 0.1);
        }
        let there = points.iter().map(|p| camera.project(&truth.transform_point(p)).unwrap()).collect();
        let count = points.len();
        let displaced = Displaced {
            points,
            pixels: there,
            spreads: vec![1.0; count],
            weights: vec![1.0; count],
            score: 1.0,
        };
        let found = displaced.pose(&camera, &near).unwrap();
        assert!(found.rotation_angle_to(&truth) < 1e-4 && found.distance_to(&truth) < 1e-4);
    }
}
