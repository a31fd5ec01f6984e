//! Aligns the mesh's outline with the object's border in the image.
//!
//! Coordinates fix a pose well across the image and badly along the view axis: one per cent of scale is ten millimetres
//! at a metre. The outline knows better, at the image's full resolution. The network says where the object is visible;
//! colour histograms of that part and of its surroundings, learnt from this one crop, sharpen it. Along the normals of
//! the rendered outline the most likely border is found, and Gauss-Newton moves the pose there (region-based tracking:
//! Prisacariu and Reid 2012, with the sparse lines of Stoiber et al. 2020), with the network's correspondences as a
//! second term. Lines whose inner side is not the object's are left out: something covers it there.
//!
//! It goes beyond the dissertation, whose poses from colour end with PnP, and needs no colours of the mesh.

use crate::estimate::{Found, Hypothesis, View};
use crate::samples::second_stage::GREY;
use sixfold_augment::{Patch, Window};
use sixfold_geometry::{Camera, Mat3, NormalEquations, Pose, RgbImage, Vec2, Vec3};
use sixfold_mesh::{Mesh, simplify};
use sixfold_render::{Frame, RenderOptions, SceneObject};

/// How poses are aligned.
#[derive(Debug, Clone, PartialEq)]
pub struct RefineOptions {
    /// How far from the outline the border is looked for, crop pixels, from coarse to fine.
    pub reaches: Vec<f64>,
    /// Most steps at each reach.
    pub iterations: usize,
    /// Longest side of the crop in pixels.
    pub largest: usize,
    /// Weight of the correspondences as a whole, in independent measurements.
    pub correspondences: f64,
    /// Weight of the correspondences' shape: what is left of them once a shift and a scale common to all are taken out.
    /// They know the rotation, the outline knows the place.
    pub shape: f64,
    /// Weight of a line, in independent measurements.
    pub line: f64,
    /// Lines count less the further their border is from the outline, in units of this many deviations of all lines
    /// (Tukey's biweight); 0 for all lines alike.
    pub robust: f64,
    /// Share of the first pass in where the object is seen; the rest is the second's. They err apart.
    pub first_pass: f32,
    /// Weight of colour against the network in telling object from background.
    pub color: f32,
}

impl Default for RefineOptions {
    fn default() -> Self {
        Self {
            reaches: vec![8.0, 5.0, 3.0],
            iterations: 5,
            largest: 200,
            correspondences: 5.0,
            shape: 30.0,
            line: 0.3,
            robust: 1.0,
            first_pass: 0.5,
            color: 2.0,
        }
    }
}

/// A pose after alignment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refined {
    /// The pose; that from before where too little of the outline was found.
    pub camera_from_object: Pose,
    /// Lines on which the border was found at the end.
    pub lines: usize,
    /// Mean distance from outline to border on them, crop pixels.
    pub distance: f64,
    /// Whether the pose was changed.
    pub improved: bool,
}

/// Faces of a mesh that is drawn for its outline alone.
const OUTLINE_FACES: usize = 4000;

/// The mesh with no more faces than its outline needs, for [`refine`]: scans have tens of thousands, and drawing them takes
/// longer than all the rest.
pub fn outline_mesh(mesh: &Mesh) -> Mesh {
    if mesh.faces().len() > OUTLINE_FACES { simplify(mesh, OUTLINE_FACES) } else { mesh.clone() }
}

/// Aligns the best hypothesis of what [`crate::estimate::estimate`] found in the same image.
pub fn refine(
    image: &RgbImage,
    camera: &Camera,
    mesh: &Mesh,
    found: &Found,
    options: &RefineOptions,
) -> Refined {
    let Some(Hypothesis { camera_from_object, .. }) = found.hypotheses.first() else {
        return Refined { camera_from_object: Pose::identity(), lines: 0, distance: 0.0, improved: false };
    };
    let unchanged =
        Refined { camera_from_object: *camera_from_object, lines: 0, distance: 0.0, improved: false };
    if mesh.faces().is_empty() {
        return unchanged;
    }
    let r = &found.open_view.window;
    let window = Window { centre: Vec2::new(r.x + 0.5 * r.width, r.y + 0.5 * r.height), side: r.width };
    let side = (window.side.round() as usize).clamp(64, options.largest.max(64));
    let crop = window.camera(camera, side);
    let (patch, inside) = Patch::warp(image, &window.map(camera, side, 0.0), side, side, [GREY; 3]);
    let network: Vec<f32> = (0..side * side)
        .map(|i| {
            if inside.data[i] <= 0.5 {
                return 0.5;
            }
            let at = |n: usize| (n as f64 + 0.5) / side as f64;
            let (u, v) = (at(i % side), at(i / side));
            let second = seen(&found.open_view, u, v);
            let f = &found.first_view.window;
            let (u, v) = ((r.x + u * r.width - f.x) / f.width, (r.y + v * r.height - f.y) / f.height);
            if (0.0..=1.0).contains(&u) && (0.0..=1.0).contains(&v) {
                let logit = |p: f32| (p.clamp(0.01, 0.99) / (1.0 - p.clamp(0.01, 0.99))).ln();
                let first = logit(seen(&found.first_view, u, v));
                let both = options.first_pass * first + (1.0 - options.first_pass) * logit(second);
                1.0 / (1.0 + (-both).exp())
            } else {
                second
            }
        })
        .collect();
    let (low, high) = mesh.bounding_box();
    let mut aligner = Aligner {
        mesh,
        camera,
        frame: Frame::new(&crop),
        odds: odds(&patch, &network, options.color),
        side,
        crop,
        centre: (low + high) * 0.5,
        correspondences: found
            .object_points
            .iter()
            .copied()
            .zip(found.image_points.iter().copied())
            .collect(),
        options,
    };
    let mut pose = *camera_from_object;
    for reach in &options.reaches {
        for _ in 0..options.iterations {
            let Some((next, moved)) = aligner.step(*reach, &pose) else { break };
            pose = next;
            // A fortieth of a pixel of the crop.
            if moved < 0.025 {
                break;
            }
        }
    }
    let last = options.reaches.last().copied().unwrap_or(3.0);
    let lines = aligner.lines(last, &pose);
    if lines.len() < LEAST_LINES || !pose.translation().iter().all(|t| t.is_finite()) {
        return unchanged;
    }
    let distance = lines.iter().map(|l| l.offset.abs()).sum::<f64>() / lines.len() as f64;
    Refined { camera_from_object: pose, lines: lines.len(), distance, improved: true }
}

/// Fewer lines do not hold a pose.
const LEAST_LINES: usize = 12;

/// How probably the object is visible at a position in 0..1 of a view's sides.
fn seen(view: &View, u: f64, v: f64) -> f32 {
    let side = view.prediction.side;
    sample(&view.prediction.visible, side, u * side as f64 - 0.5, v * side as f64 - 0.5)
}

/// Value of a square map at pixel `(x, y)`.
fn sample(map: &[f32], side: usize, x: f64, y: f64) -> f32 {
    let last = (side - 1) as f64;
    let (x, y) = (x.clamp(0.0, last), y.clamp(0.0, last));
    let (x0, y0) = (x.floor().min(last - 1.0), y.floor().min(last - 1.0));
    let (fx, fy) = ((x - x0) as f32, (y - y0) as f32);
    let at = |dx: usize, dy: usize| map[(y0 as usize + dy) * side + x0 as usize + dx];
    (1.0 - fy) * ((1.0 - fx) * at(0, 0) + fx * at(1, 0)) + fy * ((1.0 - fx) * at(0, 1) + fx * at(1, 1))
}

/// Bins of the colour histograms along each channel.
const BINS: usize = 16;

/// Log odds of object against background at every pixel: from the network's probability, and from colour histograms of
/// what it takes for the one and the other.
fn odds(patch: &Patch, network: &[f32], color: f32) -> Vec<f32> {
    let area = network.len();
    let bins = BINS * BINS * BINS;
    let mut counts = [vec![0.5f32; bins], vec![0.5f32; bins]];
    let bin = |i: usize| {
        (0..3)
            .fold(0, |bin, c| bin * BINS + ((patch.data[c * area + i] * BINS as f32) as usize).min(BINS - 1))
    };
    for (i, p) in network.iter().enumerate() {
        // What is uncertain says nothing.
        if *p > 0.75 {
            counts[0][bin(i)] += *p;
        } else if *p < 0.25 {
            counts[1][bin(i)] += 1.0 - *p;
        }
    }
    // A little of each bin goes to its neighbours.
    for count in &mut counts {
        for stride in [1, BINS, BINS * BINS] {
            let before = count.clone();
            for (b, value) in count.iter_mut().enumerate() {
                let place = b / stride % BINS;
                let below = if place > 0 { before[b - stride] } else { before[b] };
                let above = if place + 1 < BINS { before[b + stride] } else { before[b] };
                *value = 0.5 * before[b] + 0.25 * (below + above);
            }
        }
        let sum: f32 = count.iter().sum();
        count.iter_mut().for_each(|v| *v /= sum);
    }
    (0..area)
        .map(|i| {
            let p = network[i].clamp(0.01, 0.99);
            let b = bin(i);
            let colors = (counts[0][b] / counts[1][b]).ln().clamp(-3.0, 3.0);
            (p / (1.0 - p)).ln().clamp(-3.0, 3.0) + color * colors
        })
        .collect()
}

/// A line across the outline on which the border was found.
struct Line {
    /// Point of the outline in the camera's frame, metres.
    point: Vec3,
    /// Outward normal in the crop.
    normal: Vec2,
    /// From the outline to the border along the normal, crop pixels.
    offset: f64,
    /// Variance of the offset.
    variance: f64,
}

struct Aligner<'a> {
    mesh: &'a Mesh,
    camera: &'a Camera,
    frame: Frame,
    crop: Camera,
    /// Log odds of the object at every pixel of the crop.
    odds: Vec<f32>,
    side: usize,
    /// The object's centre, about which it is turned.
    centre: Vec3,
    correspondences: Vec<(Vec3, Vec2)>,
    options: &'a RefineOptions,
}

impl Aligner<'_> {
    /// Lines across the rendered outline, with the most likely border on each.
    fn lines(&mut self, reach: f64, pose: &Pose) -> Vec<Line> {
        let objects = [SceneObject { mesh: self.mesh, camera_from_object: *pose }];
        self.frame.render(&objects, &RenderOptions::default());
        let side = self.side;
        let inverse_depth = self.frame.inverse_depth();
        let mut soft = Patch::filled(side, side, [0.0; 3]);
        for (value, z) in soft.data[..side * side].iter_mut().zip(inverse_depth) {
            *value = f32::from(*z > 0.0);
        }
        soft.blur(1.5);
        let soft = &soft.data[..side * side];
        let mut lines = Vec::new();
        let margin = 2;
        for y in margin..side - margin {
            for x in margin..side - margin {
                let i = y * side + x;
                let border = inverse_depth[i] > 0.0
                    && [i - 1, i + 1, i - side, i + side].into_iter().any(|j| inverse_depth[j] <= 0.0);
                if !border {
                    continue;
                }
                let gradient = Vec2::new(
                    f64::from(soft[i + 1] - soft[i - 1]) * 0.5,
                    f64::from(soft[i + side] - soft[i - side]) * 0.5,
                );
                let steep = gradient.norm();
                if steep < 0.05 {
                    continue;
                }
                let normal = -gradient / steep;
                // The outline lies where the blurred silhouette is one half.
                let start = Vec2::new(x as f64, y as f64)
                    + normal * ((f64::from(soft[i]) - 0.5) / steep).clamp(-1.0, 1.5);
                if let Some((offset, variance)) = self.border(&start, &normal, reach) {
                    let depth = 1.0 / f64::from(inverse_depth[i]);
                    lines.push(Line { point: self.crop.unproject(&start, depth), normal, offset, variance });
                }
            }
        }
        lines
    }

    /// Mean and variance of the border's place on a line through `start` along the outward normal.
    fn border(&self, start: &Vec2, normal: &Vec2, reach: f64) -> Option<(f64, f64)> {
        const STEP: f64 = 0.5;
        let count = (2.0 * reach / STEP) as usize + 1;
        let at = |k: usize| k as f64 * STEP - reach;
        let odds: Vec<f32> = (0..count)
            .map(|k| {
                let p = start + normal * at(k);
                sample(&self.odds, self.side, p.x, p.y)
            })
            .collect();
        // Something covers the object here, or there is no border within reach.
        let third = count / 3;
        let mean = |part: &[f32]| part.iter().sum::<f32>() / part.len() as f32;
        if mean(&odds[..third]) < 0.5 || mean(&odds[count - third..]) > -0.5 {
            return None;
        }
        // Log likelihood of a border before sample k: object up to there, background behind.
        let mut likelihood = Vec::with_capacity(count + 1);
        let mut sum = 0.0;
        likelihood.push(0.0);
        for o in &odds {
            sum += f64::from(*o) * STEP;
            likelihood.push(sum);
        }
        let best = likelihood.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let (mut total, mut first, mut second) = (0.0, 0.0, 0.0);
        for (k, l) in likelihood.iter().enumerate() {
            let weight = (l - best).exp();
            let place = at(k) - 0.5 * STEP;
            total += weight;
            first += weight * place;
            second += weight * place * place;
        }
        let mean = first / total;
        Some((mean, (second / total - mean * mean).max(0.1)))
    }

    /// The next pose, and how far the outline moved in crop pixels.
    fn step(&mut self, reach: f64, pose: &Pose) -> Option<(Pose, f64)> {
        let lines = self.lines(reach, pose);
        if lines.len() < LEAST_LINES {
            return None;
        }
        let centre = pose.transform_point(&self.centre);
        let mut equations = NormalEquations::default();
        let mut offsets: Vec<f64> = lines.iter().map(|line| line.offset.abs()).collect();
        let middle = offsets.len() / 2;
        let deviation = 1.4826 * *offsets.select_nth_unstable_by(middle, f64::total_cmp).1;
        let robust = self.options.robust * deviation.max(0.5);
        for line in &lines {
            let rows = motion(&self.crop, &line.point, &centre);
            let jacobian: [f64; 6] =
                std::array::from_fn(|k| line.normal.x * rows[0][k] + line.normal.y * rows[1][k]);
            let mut weight = self.options.line * tukey(2.0 * line.offset / reach) / (line.variance + 0.5);
            if robust > 0.0 {
                weight *= tukey(line.offset / robust);
            }
            equations.add(&jacobian, -line.offset, weight);
        }
        self.add_correspondences(&mut equations, pose, &centre);
        let step = equations.solve(1e-3)?;
        let about = Pose::from_translation(centre);
        let next = about * Pose::exp(&step) * about.inverse() * *pose;
        let t = next.translation();
        if !(t.z > 0.01 && t.iter().all(|v| v.is_finite())) {
            return None;
        }
        let moved = lines.iter().filter_map(|line| {
            let after = about * Pose::exp(&step) * about.inverse();
            let (a, b) =
                (self.crop.project(&line.point)?, self.crop.project(&after.transform_point(&line.point))?);
            Some((a - b).norm())
        });
        let moved = moved.fold(0.0, f64::max);
        Some((next, moved))
    }

    fn add_correspondences(&self, equations: &mut NormalEquations, pose: &Pose, centre: &Vec3) {
        let pairs = self.correspondences.iter();
        let errors: Vec<(Vec3, Vec2)> = pairs
            .filter_map(|(object, image)| {
                let point = pose.transform_point(object);
                Some((point, self.camera.project(&point)? - image))
            })
            .collect();
        if errors.len() < 6 {
            return;
        }
        let mut sizes: Vec<f64> = errors.iter().map(|(_, e)| e.norm()).collect();
        let middle = sizes.len() / 2;
        let noise = (*sizes.select_nth_unstable_by(middle, f64::total_cmp).1).max(0.3);
        let full = self.options.correspondences / errors.len() as f64 / (noise * noise);
        let shape = self.options.shape / errors.len() as f64 / (noise * noise);
        // Rows of every pair: x and y, each with its Jacobian, error, weight and its part in the common shift and scale.
        let mut rows: Vec<([f64; 6], f64, f64, [f64; 3])> = Vec::with_capacity(2 * errors.len());
        let middle =
            errors.iter().filter_map(|(p, _)| self.camera.project(p)).sum::<Vec2>() / errors.len() as f64;
        for (point, error) in &errors {
            let weight = tukey(error.norm() / noise);
            let Some(pixel) = self.camera.project(point) else { continue };
            let arm = pixel - middle;
            let [first, second] = motion(self.camera, point, centre);
            rows.push((first, error.x, weight, [1.0, 0.0, arm.x]));
            rows.push((second, error.y, weight, [0.0, 1.0, arm.y]));
        }
        // Least squares of Jacobians and errors on shift and scale, to be taken out of them.
        let mut gram = Mat3::zeros();
        let mut sums = [Vec3::zeros(); 7];
        for (jacobian, error, weight, common) in &rows {
            let common = Vec3::from(*common);
            gram += common * common.transpose() * *weight;
            for (sum, value) in sums.iter_mut().zip(jacobian.iter().chain([error])) {
                *sum += common * (weight * value);
            }
        }
        let inverse = gram.try_inverse();
        for (jacobian, error, weight, common) in &rows {
            equations.add(jacobian, *error, weight * full);
            if let Some(inverse) = &inverse {
                let common = inverse * Vec3::from(*common);
                let rest: [f64; 7] = std::array::from_fn(|k| {
                    jacobian.get(k).copied().unwrap_or(*error) - common.dot(&sums[k])
                });
                let [a, b, c, d, e, f, residual] = rest;
                equations.add(&[a, b, c, d, e, f], residual, weight * shape);
            }
        }
    }
}

/// Derivative of a point's pixel by a twist `(v, w)` about `centre`, pixels per metre and radian.
fn motion(camera: &Camera, point: &Vec3, centre: &Vec3) -> [[f64; 6]; 2] {
    let (x, y, z) = (point.x, point.y, point.z);
    let rows = [
        Vec3::new(camera.fx / z, 0.0, -camera.fx * x / (z * z)),
        Vec3::new(0.0, camera.fy / z, -camera.fy * y / (z * z)),
    ];
    let arm = point - centre;
    rows.map(|row| {
        // d(w x arm) = row . (w x arm) = w . (arm x row)
        let turn = arm.cross(&row);
        [row.x, row.y, row.z, turn.x, turn.y, turn.z]
    })
}

/// Weight of a residual in units of its noise (Tukey's biweight, tuned to 95 % efficiency).
fn tukey(r: f64) -> f64 {
    let t = r / 4.685;
    if t.abs() >= 1.0 { 0.0 } else { (1.0 - t * t).powi(2) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Prediction;
    use sixfold_geometry::Rect;
    use sixfold_geometry::nalgebra::UnitQuaternion;

    /// A box with a tower on one corner: no turn maps it onto itself.
    fn part() -> Mesh {
        let cuboid = |low: [f64; 3], high: [f64; 3], first: u32| {
            let corner =
                |i: usize| Vec3::from_fn(|axis, _| if i >> axis & 1 == 0 { low[axis] } else { high[axis] });
            let vertices: Vec<Vec3> = (0..8).map(corner).collect();
            let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
            let faces: Vec<[u32; 3]> = quads
                .iter()
                .flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]])
                .map(|f| f.map(|v: u32| v + first))
                .collect();
            (vertices, faces)
        };
        let (mut vertices, mut faces) = cuboid([-0.06, -0.04, -0.02], [0.06, 0.04, 0.02], 0);
        let (more, tower) = cuboid([0.02, 0.0, 0.02], [0.06, 0.04, 0.09], 8);
        vertices.extend(more);
        faces.extend(tower);
        Mesh::new(vertices, faces).unwrap()
    }

    /// Errors in metres before and after alignment of a part at 0.8 m, a share of whose columns is covered.
    fn errors(covered: f64) -> [f64; 2] {
        let mesh = part();
        let camera = Camera::new(570.0, 570.0, 159.5, 119.5, 320, 240).unwrap();
        let truth = Pose::new(UnitQuaternion::from_euler_angles(2.2, 0.5, 0.3), Vec3::new(0.01, 0.0, 0.8));
        let mut frame = Frame::new(&camera);
        frame.render(&[SceneObject { mesh: &mesh, camera_from_object: truth }], &RenderOptions::default());
        let silhouette = frame.mask(0);
        let columns: Vec<usize> = (0..320).filter(|x| (0..240).any(|y| silhouette[(*x, y)])).collect();
        let edge = columns[(covered * (columns.len() - 1) as f64) as usize];
        let seen = |x: usize, y: usize| silhouette[(x, y)] && (covered == 0.0 || x > edge);
        // A red part on a grey table, something blue in front of its left side.
        let image = RgbImage::from_fn(320, 240, |x, y| {
            let noise = ((x * 7 + y * 13) % 17) as u8;
            if seen(x, y) {
                [190 + noise, 50, 40 + noise]
            } else if covered > 0.0 && x <= edge {
                [30, 40 + noise, 170]
            } else {
                [110 + noise, 115, 105 + noise]
            }
        });
        let window = Rect { x: 70.0, y: 30.0, width: 180.0, height: 180.0 };
        let side = 64;
        let visible = (0..side * side)
            .map(|i| {
                let at = |n: usize, from: f64| {
                    (from + (n as f64 + 0.5) / side as f64 * 180.0 - 0.5).round() as usize
                };
                f32::from(seen(at(i % side, window.x), at(i / side, window.y)))
            })
            .collect();
        let start = Pose::new(
            UnitQuaternion::from_euler_angles(0.03, -0.04, 0.03) * truth.rotation(),
            truth.translation() + Vec3::new(0.003, -0.003, 0.035),
        );
        let prediction = Prediction { side, coordinates: vec![], error: vec![], visible };
        let view = View { window, input: image.clone(), prediction };
        let found = Found {
            hypotheses: vec![Hypothesis {
                camera_from_object: start,
                threshold: 0.3,
                inliers: 1,
                score: 1.0,
            }],
            open_view: view.clone(),
            first_view: view.clone(),
            view,
            object_points: vec![],
            image_points: vec![],
        };
        let refined = refine(&image, &camera, &mesh, &found, &RefineOptions::default());
        [start, refined.camera_from_object].map(|pose| {
            let vertices = mesh.vertices();
            let distance = |p: &Vec3| (pose.transform_point(p) - truth.transform_point(p)).norm();
            vertices.iter().map(distance).sum::<f64>() / vertices.len() as f64
        })
    }

    #[test]
    fn an_outline_pulls_a_pose_that_is_too_far_away_back() {
        let [before, after] = errors(0.0);
        assert!(before > 0.03 && after < 0.006, "{before} {after}");
    }

    #[test]
    fn what_covers_the_object_does_not_pull() {
        let [before, after] = errors(0.3);
        assert!(before > 0.03 && after < 0.012, "{before} {after}");
    }
}
