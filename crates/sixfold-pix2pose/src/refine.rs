//! Aligns the mesh's outline with the object's border in the image.
//!
//! Coordinates determine a pose accurately across the image but poorly along the view axis: one per cent of scale is ten
//! millimetres at a metre. The outline determines it better, at the image's full resolution. The network predicts where the object
//! is visible; colour histograms of that part and of its surroundings, computed from this crop alone, refine this. Along the
//! normals of the rendered outline the most likely border is found, with a preference for edges of the image, and Gauss-Newton
//! moves the pose there (region-based tracking: Prisacariu and Reid 2012, with the sparse lines of Stoiber et al. 2020), with the
//! network's correspondences as a second term. Lines whose inner side does not show the object are left out, because it is occluded
//! there.
//!
//! This goes beyond the dissertation, in which poses from colour end with PnP, and needs no colours of the mesh.

use crate::estimate::{Found, ThresholdHypothesis, View};
use crate::samples::second_stage::GREY;
use sixfold_align::outline::{Alignment, AlignmentOptions, Outline, log_odds, sample};
use sixfold_geometry::{Camera, OptionError, Pose, RgbImage, Vec2};
use sixfold_mesh::Mesh;
use sixfold_synth::augment::{Patch, Window};

/// Options of the alignment.
#[derive(Debug, Clone, PartialEq)]
pub struct OutlineRefinementOptions {
    /// Search distances for the border from the outline, crop pixels, from coarse to fine.
    pub reaches: Vec<f64>,
    /// Maximum number of steps at each reach.
    pub iterations: usize,
    /// Shortest side of the crop in pixels; smaller ones are enlarged.
    pub smallest: usize,
    /// Longest side of the crop in pixels.
    pub largest: usize,
    /// Weight of the correspondences as a whole, in independent measurements.
    pub correspondences: f64,
    /// Weight of the correspondences' shape: the part that remains after removing a common shift and scale. The correspondences
    /// determine the rotation, the outline the position.
    pub shape: f64,
    /// Weight of a line, in independent measurements.
    pub line: f64,
    /// The weight of a line decreases with the distance of its border from the outline, in units of this many standard deviations
    /// of all lines (Tukey's biweight); 0 for equal weights.
    pub robust: f64,
    /// Weight of the first pass in the object's visibility; the rest is that of the second. Their errors are largely independent.
    pub first_pass: f32,
    /// Weight of colour relative to the network in the object probability.
    pub color: f32,
    /// Bonus to the log likelihood of a border where colours change sharply; 0 uses only the odds.
    pub edges: f64,
}

impl Default for OutlineRefinementOptions {
    fn default() -> Self {
        Self {
            reaches: vec![8.0, 5.0, 3.0],
            iterations: 5,
            smallest: 128,
            largest: 200,
            correspondences: 5.0,
            shape: 30.0,
            line: 0.3,
            robust: 1.0,
            first_pass: 0.5,
            color: 2.0,
            edges: 8.0,
        }
    }
}

/// Smallest side of a crop in which an outline can be searched, pixels.
const MIN_CROP: usize = 16;

impl OutlineRefinementOptions {
    /// The options of [`Alignment`].
    fn alignment(&self) -> AlignmentOptions {
        AlignmentOptions {
            reaches: self.reaches.clone(),
            iterations: self.iterations,
            correspondences: self.correspondences,
            shape: self.shape,
            line: self.line,
            robust: self.robust,
        }
    }

    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        for reach in &self.reaches {
            OptionError::unless_positive("refine.reaches", *reach, "pixels above 0")?;
        }
        OptionError::unless_some("refine.iterations", self.iterations)?;
        OptionError::unless_within("refine.smallest", self.smallest, MIN_CROP.., "16 pixels or more")?;
        OptionError::unless_within("refine.largest", self.largest, MIN_CROP.., "16 pixels or more")?;
        for (option, weight) in [
            ("refine.correspondences", self.correspondences),
            ("refine.shape", self.shape),
            ("refine.line", self.line),
            ("refine.robust", self.robust),
            ("refine.color", f64::from(self.color)),
            ("refine.edges", self.edges),
        ] {
            OptionError::unless_weight(option, weight)?;
        }
        OptionError::unless_within("refine.first_pass", self.first_pass, 0.0..=1.0, "0 to 1")
    }
}

/// A pose after alignment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Refined {
    /// The pose; the initial one if too little of the outline was found.
    pub camera_from_object: Pose,
    /// Number of lines on which the border was found at the end.
    pub lines: usize,
    /// Mean distance from outline to border on these lines, crop pixels.
    pub distance: f64,
    /// Whether the pose was changed.
    pub improved: bool,
}

/// Aligns the best hypothesis of a result of [`crate::estimate::estimate`] in the same image.
pub fn refine(
    image: &RgbImage,
    camera: &Camera,
    mesh: &Mesh,
    found: &Found,
    options: &OutlineRefinementOptions,
) -> Refined {
    let Some(ThresholdHypothesis { camera_from_object, .. }) = found.hypotheses.first() else {
        return Refined { camera_from_object: Pose::identity(), lines: 0, distance: 0.0, improved: false };
    };
    let unchanged =
        Refined { camera_from_object: *camera_from_object, lines: 0, distance: 0.0, improved: false };
    if mesh.faces().is_empty() {
        return unchanged;
    }
    let r = &found.open_view.window;
    let window = Window { centre: Vec2::new(r.x + 0.5 * r.width, r.y + 0.5 * r.height), side: r.width };
    let side = (window.side.round() as usize).clamp(options.smallest, options.largest.max(options.smallest));
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
    let alignment = options.alignment();
    let mut aligner = Alignment {
        camera,
        outline: Outline::new(mesh, &crop, log_odds(&patch, &network, options.color))
            .with_edges(&patch, options.edges),
        crop,
        centre: (low + high) * 0.5,
        correspondences: found
            .object_points
            .iter()
            .copied()
            .zip(found.image_points.iter().copied())
            .collect(),
        options: &alignment,
    };
    aligner.run(camera_from_object).map_or(unchanged, |aligned| Refined {
        camera_from_object: aligned.camera_from_object,
        lines: aligned.lines,
        distance: aligned.distance,
        improved: true,
    })
}

/// Probability that the object is visible at a position, given as fractions in 0..1 of a view's sides.
fn seen(view: &View, u: f64, v: f64) -> f32 {
    let side = view.prediction.side;
    sample(&view.prediction.visible, side, u * side as f64 - 0.5, v * side as f64 - 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Prediction;
    use sixfold_geometry::nalgebra::UnitQuaternion;
    use sixfold_geometry::{Rect, Vec3};
    use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

    /// A box with a tower on one corner: no rotation maps it onto itself.
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

    /// Errors in metres before and after alignment of a part at 0.8 m, with a fraction of its columns covered.
    fn errors(covered: f64) -> [f64; 2] {
        let mesh = part();
        let camera = Camera::new(570.0, 570.0, 159.5, 119.5, 320, 240).unwrap();
        let truth = Pose::new(UnitQuaternion::from_euler_angles(2.2, 0.5, 0.3), Vec3::new(0.01, 0.0, 0.8));
        let mut frame = VisibilityBuffer::new(&camera);
        frame.render(&[SceneObject { mesh: &mesh, camera_from_object: truth }], &RenderOptions::default());
        let silhouette = frame.mask(0);
        let columns: Vec<usize> = (0..320).filter(|x| (0..240).any(|y| silhouette[(*x, y)])).collect();
        let edge = columns[(covered * (columns.len() - 1) as f64) as usize];
        let seen = |x: usize, y: usize| silhouette[(x, y)] && (covered == 0.0 || x > edge);
        // A red part on a grey table, with a blue occluder in front of its left side.
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
            hypotheses: vec![ThresholdHypothesis {
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
        let refined = refine(&image, &camera, &mesh, &found, &OutlineRefinementOptions::default());
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
    fn occluders_do_not_bias_the_pose() {
        let [before, after] = errors(0.3);
        assert!(before > 0.03 && after < 0.012, "{before} {after}");
    }
}
