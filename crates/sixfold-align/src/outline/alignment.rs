//! Gauss-Newton over the lines across an outline and, as a second term, correspondences: the latter determine the rotation well and
//! the distance poorly, the outline vice versa.

use sixfold_geometry::{Camera, Mat3, NormalEquations, Pose, Vec2, Vec3};

use super::lines::{MIN_LINES, Outline, add_lines, motion, tukey};

/// The iterations at a reach stop when a step moves the outline by less than this, crop pixels: a fortieth of a pixel.
const CONVERGED: f64 = 0.025;
/// Search distance for the border at the end if no reach is given, crop pixels.
const LAST_REACH: f64 = 3.0;

/// Options of the alignment of an outline.
#[derive(Debug, Clone, PartialEq)]
pub struct AlignmentOptions {
    /// Search distances for the border from the outline, crop pixels, from coarse to fine.
    pub reaches: Vec<f64>,
    /// Maximum number of steps at each reach.
    pub iterations: usize,
    /// Weight of the correspondences as a whole, in independent measurements.
    pub correspondences: f64,
    /// Weight of the correspondences' shape: the part that remains after removing a common shift and scale.
    pub shape: f64,
    /// Weight of a line, in independent measurements.
    pub line: f64,
    /// The weight of a line decreases with the distance of its border from the outline, in units of this many standard deviations
    /// of all lines (Tukey's biweight); 0 for equal weights.
    pub robust: f64,
}

/// A pose after alignment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignedOutline {
    /// The pose.
    pub camera_from_object: Pose,
    /// Number of lines on which the border was found at the end.
    pub lines: usize,
    /// Mean distance from outline to border on these lines, crop pixels.
    pub distance: f64,
}

/// An object's outline in one crop, with correspondences as a second source.
pub struct Alignment<'a> {
    /// The camera of the correspondences' pixels.
    pub camera: &'a Camera,
    /// The outline.
    pub outline: Outline<'a>,
    /// The crop's camera; it has the position and orientation of [`camera`](Self::camera).
    pub crop: Camera,
    /// The object's centre, about which it is rotated.
    pub centre: Vec3,
    /// Points of the object and their pixels in [`camera`](Self::camera).
    pub correspondences: Vec<(Vec3, Vec2)>,
    /// Options.
    pub options: &'a AlignmentOptions,
}

impl Alignment<'_> {
    /// Moves a pose until outline and border agree; `None` if too little of the border is found.
    pub fn run(&mut self, start: &Pose) -> Option<AlignedOutline> {
        let mut pose = *start;
        for reach in &self.options.reaches {
            for _ in 0..self.options.iterations {
                let Some((next, moved)) = self.step(*reach, &pose) else { break };
                pose = next;
                if moved < CONVERGED {
                    break;
                }
            }
        }
        let last = self.options.reaches.last().copied().unwrap_or(LAST_REACH);
        let lines = self.outline.lines(last, &pose);
        if lines.len() < MIN_LINES || !pose.translation().iter().all(|t| t.is_finite()) {
            return None;
        }
        let distance = lines.iter().map(|l| l.offset.abs()).sum::<f64>() / lines.len() as f64;
        Some(AlignedOutline { camera_from_object: pose, lines: lines.len(), distance })
    }

    /// The next pose, and the distance by which the outline moved, crop pixels.
    fn step(&mut self, reach: f64, pose: &Pose) -> Option<(Pose, f64)> {
        let lines = self.outline.lines(reach, pose);
        if lines.len() < MIN_LINES {
            return None;
        }
        let centre = pose.transform_point(&self.centre);
        let mut equations = NormalEquations::default();
        add_lines(&mut equations, &lines, &self.crop, &centre, reach, self.options.line, self.options.robust);
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
        let half = sizes.len() / 2;
        let noise = (*sizes.select_nth_unstable_by(half, f64::total_cmp).1).max(0.3);
        let full = self.options.correspondences / errors.len() as f64 / (noise * noise);
        let shape = self.options.shape / errors.len() as f64 / (noise * noise);
        // Rows of every pair: x and y, each with its Jacobian, error, weight and its derivative by the common shift and scale.
        let mut rows: Vec<([f64; 6], f64, f64, [f64; 3])> = Vec::with_capacity(2 * errors.len());
        let centroid =
            errors.iter().filter_map(|(p, _)| self.camera.project(p)).sum::<Vec2>() / errors.len() as f64;
        for (point, error) in &errors {
            let weight = tukey(error.norm() / noise);
            let Some(pixel) = self.camera.project(point) else { continue };
            let arm = pixel - centroid;
            let [first, second] = motion(self.camera, point, centre);
            rows.push((first, error.x, weight, [1.0, 0.0, arm.x]));
            rows.push((second, error.y, weight, [0.0, 1.0, arm.y]));
        }
        // Least-squares fit of Jacobians and errors by shift and scale, which is then subtracted.
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
