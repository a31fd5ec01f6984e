//! The measurements of one photograph for the pose of its object: colours against those of the others, the outline, the given pose.

use sixfold_align::outline::{Line, MIN_LINES, Outline, add_lines, motion, tukey};
use sixfold_geometry::{NormalEquations, Pose, Vec3};
use sixfold_render::VisibilityBuffer;
use sixfold_synth::augment::Coverage;

use super::appearance::Light;
use super::arrangement::Wanted;
use super::options::{PoseRefinementOptions, SourceReport};
use crate::maps::Maps;
use crate::source::SourceView;

/// One photograph of one object during the refinement of its pose.
pub(super) struct Working<'a> {
    pub view: SourceView,
    pub given: Pose,
    /// The current pose; the view's geometry is updated with every step.
    pub pose: Pose,
    /// Where colours may be compared, 0 or 1.
    pub allowed: Vec<f32>,
    pub outline: Option<Outline<'a>>,
    pub light: Light,
    pub frame: VisibilityBuffer,
    pub lines: usize,
}

/// Inputs of one step for one photograph.
pub(super) struct Terms<'a> {
    pub maps: &'a Maps,
    pub points: &'a [Vec3],
    pub normals: &'a [Vec3],
    /// Colours of the other photographs.
    pub target: &'a [f32],
    pub known: &'a [f32],
    pub centre: &'a Vec3,
    pub reach: f64,
}

/// Shift of the object's centre and rotation vector from a given pose to the current one, in the camera's frame.
fn since(given: &Pose, pose: &Pose, centre: &Vec3) -> [f64; 6] {
    let shift = pose.transform_point(centre) - given.transform_point(centre);
    let turn = (pose.rotation() * given.rotation().inverse()).scaled_axis();
    [shift.x, shift.y, shift.z, turn.x, turn.y, turn.z]
}

/// Distance of two poses: root mean square of the shift of the centre and the rotation vector, six numbers in units of the standard
/// deviations of rough poses.
pub(super) fn off(from: &Pose, pose: &Pose, centre: &Vec3, rough: [f64; 2]) -> f64 {
    size(&since(from, pose, centre), rough)
}

fn size(offset: &[f64; 6], rough: [f64; 2]) -> f64 {
    let square: f64 = offset.iter().enumerate().map(|(k, v)| (v / rough[k / 3]).powi(2)).sum();
    (square / 6.0).sqrt()
}

/// Adds the prior around the given pose, with a weight that decreases with the distance from it. Angles are small, so shift and
/// rotation are treated separately.
fn add_given(equations: &mut NormalEquations, offset: &[f64; 6], rough: [f64; 2]) {
    let trust = 1.0 / (1.0 + size(offset, rough).powi(2) / 6.0);
    for (k, offset) in offset.iter().enumerate() {
        let mut row = [0.0; 6];
        row[k] = 1.0;
        let deviation = rough[k / 3];
        equations.add(&row, *offset, trust / (deviation * deviation));
    }
}

/// The correction that a given pose of this roughness alone requests.
pub(super) fn wanted_by(given: &Pose, pose: &Pose, centre: &Vec3, rough: [f64; 2]) -> Wanted {
    let mut equations = NormalEquations::default();
    add_given(&mut equations, &since(given, pose, centre), rough);
    Wanted { equations, centre: pose.transform_point(centre) }
}

impl Working<'_> {
    /// Colours are compared inside the silhouette only, far enough from its border that the blur mixes in no pixels outside it.
    pub(crate) fn allow(&mut self, blur: f32) {
        let side = self.view.side();
        let mut inside = Coverage::from_fn(side, side, |x, y| {
            let i = y * side + x;
            f32::from(u8::from(self.view.depth()[i] > 0.0)) * self.view.visible.data[i]
        });
        inside.blur(blur);
        self.allowed.clear();
        self.allowed.extend(inside.data.iter().map(|v| f32::from(u8::from(*v > 0.9))));
    }

    /// The colours to be compared.
    pub(crate) fn maps(&self, blur: f32, options: &PoseRefinementOptions) -> Maps {
        if options.wide <= 0.0 {
            return Maps::of_patch(&self.view.patch, blur);
        }
        let inside: Vec<f32> = self
            .view
            .depth()
            .iter()
            .zip(&self.view.visible.data)
            .map(|(z, visible)| if *z > 0.0 { *visible } else { 0.0 })
            .collect();
        Maps::of_detail(&self.view.patch, &inside, blur, options.wide * blur)
    }

    /// The measurements for the pose (colours, outline and given pose) as normal equations of a twist about the object's centre.
    pub(crate) fn measure(&mut self, terms: &Terms<'_>, options: &PoseRefinementOptions) -> Wanted {
        let pose = self.pose;
        let centre = pose.transform_point(terms.centre);
        let mut equations = NormalEquations::default();
        if options.colors > 0.0 {
            self.add_colors(&mut equations, terms, &centre, options);
        }
        let lines: Vec<Line> =
            self.outline.as_mut().map(|outline| outline.lines(terms.reach, &pose)).unwrap_or_default();
        self.lines = lines.len();
        if lines.len() >= MIN_LINES {
            add_lines(&mut equations, &lines, &self.view.camera, &centre, terms.reach, options.line, 1.0);
        }
        add_given(&mut equations, &since(&self.given, &pose, terms.centre), options.rough);
        Wanted { equations, centre }
    }

    /// The same without the colours.
    pub(crate) fn measure_anchors(
        &mut self,
        centre: &Vec3,
        reach: f64,
        options: &PoseRefinementOptions,
    ) -> Wanted {
        let pose = self.pose;
        let mut wanted = wanted_by(&self.given, &pose, centre, options.rough);
        let lines = self.outline.as_mut().map(|outline| outline.lines(reach, &pose)).unwrap_or_default();
        if lines.len() >= MIN_LINES {
            let camera = &self.view.camera;
            add_lines(&mut wanted.equations, &lines, camera, &wanted.centre, reach, options.line, 1.0);
        }
        wanted
    }

    fn add_colors(
        &self,
        equations: &mut NormalEquations,
        terms: &Terms<'_>,
        centre: &Vec3,
        options: &PoseRefinementOptions,
    ) {
        struct Row {
            jacobian: [f64; 6],
            residual: f64,
            weight: f64,
        }
        let side = self.view.side();
        let pose = self.view.camera_from_object();
        let mut rows: Vec<Row> = Vec::with_capacity(terms.points.len());
        let (mut value, mut dx, mut dy) = ([0.0f32; 3], [0.0f32; 3], [0.0f32; 3]);
        for (i, (point, normal)) in terms.points.iter().zip(terms.normals).enumerate() {
            if terms.known[i] <= 0.0 {
                continue;
            }
            let Some(([x, y], cosine)) = self.view.see(point, normal) else { continue };
            let at = (y.round() as usize).min(side - 1) * side + (x.round() as usize).min(side - 1);
            let weight = f64::from(cosine * self.allowed[at]) * f64::from(terms.known[i].min(1.0));
            if weight <= 0.0 {
                continue;
            }
            terms.maps.sample_with_gradient(x, y, &mut value, &mut dx, &mut dy);
            let in_camera = pose.transform_point(point);
            let [along_x, along_y] = motion(&self.view.camera, &in_camera, centre);
            for c in 0..3 {
                let gain = f64::from(self.light.gain[c]);
                let residual = gain * f64::from(value[c]) + f64::from(self.light.offset[c])
                    - f64::from(terms.target[3 * i + c]);
                let (gx, gy) = (gain * f64::from(dx[c]), gain * f64::from(dy[c]));
                rows.push(Row {
                    jacobian: std::array::from_fn(|k| gx * along_x[k] + gy * along_y[k]),
                    residual,
                    weight,
                });
            }
        }
        if rows.len() < 60 {
            return;
        }
        let mut sizes: Vec<f64> = rows.iter().map(|r| r.residual.abs()).collect();
        let half = sizes.len() / 2;
        let noise = (1.4826 * *sizes.select_nth_unstable_by(half, f64::total_cmp).1).max(0.01);
        let total: f64 = rows.iter().map(|r| r.weight).sum();
        let scale = options.colors / total / (noise * noise);
        for row in &rows {
            equations.add(&row.jacobian, row.residual, row.weight * tukey(row.residual / noise) * scale);
        }
    }

    pub(crate) fn report(
        &self,
        centre: &Vec3,
        difference: [f64; 2],
        options: &PoseRefinementOptions,
    ) -> SourceReport {
        let pose = &self.pose;
        let offset = since(&self.given, pose, centre);
        let far = |range: std::ops::Range<usize>, deviation: f64| {
            offset[range].iter().map(|v| v * v).sum::<f64>().sqrt() / deviation
        };
        let (shift, turn) = (far(0..3, options.rough[0]), far(3..6, options.rough[1]));
        let dropped = if shift > options.max_moved || turn > options.max_moved {
            Some(format!(
                "the pose that fits is {:.0} mm and {:.1} degrees from the given one",
                shift * options.rough[0] * 1e3,
                (turn * options.rough[1]).to_degrees()
            ))
        } else {
            None
        };
        SourceReport {
            camera_from_object: if dropped.is_some() { self.given } else { *pose },
            moved: shift * options.rough[0],
            rotated: turn * options.rough[1],
            difference,
            lines: self.lines,
            dropped,
        }
    }
}

/// Prior probability of object pixels from the current pose and the mask: certain inside and outside, uncertain near the border.
pub(super) fn prior(view: &SourceView) -> Vec<f32> {
    let side = view.side();
    let mut inside = Coverage::from_fn(side, side, |x, y| {
        let i = y * side + x;
        f32::from(u8::from(view.depth()[i] > 0.0 && view.visible.data[i] > 0.5))
    });
    inside.blur(0.03 * side as f32);
    inside.data
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_given_pose_draws_the_present_one_back() {
        let given = Pose::exp(&[0.02, -0.03, 0.7, 0.4, -0.9, 0.3].into());
        let centre = Vec3::new(0.03, 0.01, -0.02);
        let about = Pose::from_translation(given.transform_point(&centre));
        let moved = |twist: [f64; 6], pose: Pose, about: Pose| {
            about * Pose::exp(&twist.into()) * about.inverse() * pose
        };
        let pose = moved([0.004, -0.002, 0.006, 0.02, 0.03, -0.01], given, about);
        let before = since(&given, &pose, &centre);
        assert!((before[3] - 0.02).abs() < 1e-9 && (before[5] + 0.01).abs() < 1e-9, "{before:?}");
        let options = PoseRefinementOptions::default();
        let mut equations = NormalEquations::default();
        add_given(&mut equations, &before, options.rough);
        let step = equations.solve(0.0).unwrap();
        let about = Pose::from_translation(pose.transform_point(&centre));
        let back = moved(step.into(), pose, about);
        let after = since(&given, &back, &centre);
        assert!(after.iter().all(|v| v.abs() < 2e-4), "{before:?} {after:?}");
        // The weight of the given pose decreases with the distance.
        let weight = |scale: f64| {
            let mut equations = NormalEquations::default();
            add_given(&mut equations, &before.map(|v| v * scale), options.rough);
            equations.parts().0[(0, 0)]
        };
        assert!(weight(10.0) < 0.9 * weight(1.0) && weight(1.0) < weight(0.0));
    }
}
