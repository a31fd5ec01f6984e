//! The coordinate losses of a symmetric object against its rotation (dissertation, section 3.2.3, figure 3.3).

use sixfold_geometry::Pose;
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_render::{BoundingBoxScale, portrait_camera, portrait_pose};

use crate::loss::{LossOptions, OutputKind, Targets, loss};
use crate::object::SymmetryMap;
use crate::samples::symmetry::canonical;
use crate::samples::targets::targets;

/// Side of the rendered coordinate images, pixels.
const SIDE: usize = 128;

/// Losses against the rotation of an object about an axis of its symmetry. The target is the coordinate image of the pose
/// without rotation, the prediction that of the rotated pose.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct LossCurve {
    /// Angles of rotation from 0 to 360 degrees.
    pub degrees: Vec<f64>,
    /// Loss of equation 3.1.
    pub l1: Vec<f64>,
    /// The same if symmetric poses are represented by the one whose camera views a fixed side of the object.
    pub view_limits: Vec<f64>,
    /// Loss of equation 3.2: the smallest over all symmetries.
    pub transformer: Vec<f64>,
}

/// The losses at rotations in `steps` equal steps about the axis of the object's first discrete symmetry; `None` if it has no
/// discrete symmetry that is a rotation, or a continuous one too.
pub fn loss_curve(mesh: &Mesh, info: &ModelInfo, steps: usize) -> Option<LossCurve> {
    let symmetry = info.symmetries_discrete.iter().find(|s| s.rotation().angle() > 1e-3)?;
    if !info.symmetries_continuous.is_empty() {
        return None;
    }
    let per_radian = symmetry.log() / symmetry.rotation().angle();
    let scale = BoundingBoxScale::of_corners(&info.min, &(info.min + info.size));
    let camera = portrait_camera(SIDE, SIDE);
    let first = portrait_pose(mesh, &camera);
    let whole = SymmetryMap::pool(info, &scale);
    let options = LossOptions { whole_mask: true, ..LossOptions::of(OutputKind::Paper) };
    let pixels = SIDE * SIDE;
    // What a perfect network would predict, and the mask; the channel of the expected error does not enter the loss.
    let drawn = |pose: &Pose, limits: bool| {
        let (mut raw, object) = targets(mesh, &scale, &camera, &canonical(pose, info, limits));
        raw.resize(4 * pixels, 0.0);
        (raw, object.data)
    };
    let truth = [false, true].map(|limits| drawn(&first, limits));
    let value = |raw: &[f32], (target, object): &(Vec<f32>, Vec<f32>), pool: &[SymmetryMap]| {
        let targets = Targets { coordinates: &target[..3 * pixels], object, visible: object };
        loss(raw, &targets, pixels, pool, OutputKind::Paper, &options, 1.0).coordinates
    };
    let mut curve = LossCurve { degrees: vec![], l1: vec![], view_limits: vec![], transformer: vec![] };
    for step in 0..=steps {
        let angle = std::f64::consts::TAU * step as f64 / steps.max(1) as f64;
        let pose = first * Pose::exp(&(per_radian * angle));
        let (plain, limited) = (drawn(&pose, false).0, drawn(&pose, true).0);
        curve.degrees.push(angle.to_degrees());
        curve.l1.push(value(&plain, &truth[0], &whole[..1]));
        curve.view_limits.push(value(&limited, &truth[1], &whole[..1]));
        curve.transformer.push(value(&plain, &truth[0], &whole));
    }
    Some(curve)
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::Vec3;

    /// A box of unequal sides beside the origin, and its half turn about the vertical axis through its centre.
    fn box_with_half_turn() -> (Mesh, ModelInfo) {
        let corners: Vec<Vec3> = (0..8)
            .map(|i| {
                Vec3::new(
                    0.05 + 0.1 * f64::from(i & 1),
                    0.06 * f64::from(i >> 1 & 1),
                    0.08 * f64::from(i >> 2),
                )
            })
            .collect();
        let faces = vec![
            [0, 1, 2],
            [1, 3, 2],
            [4, 6, 5],
            [5, 6, 7],
            [0, 4, 1],
            [1, 4, 5],
            [2, 3, 6],
            [3, 7, 6],
            [0, 2, 4],
            [2, 6, 4],
            [1, 5, 3],
            [3, 5, 7],
        ];
        let mesh = Mesh::new(corners, faces).unwrap();
        let turn = Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, std::f64::consts::PI].into());
        let centre = Pose::from_translation(Vec3::new(0.1, 0.03, 0.0));
        let info = ModelInfo {
            symmetries_discrete: vec![centre * turn * centre.inverse()],
            ..ModelInfo::of_mesh(&mesh)
        };
        (mesh, info)
    }

    #[test]
    fn only_the_transformer_loss_is_small_at_a_half_turn_and_has_no_jump() {
        let (mesh, info) = box_with_half_turn();
        let curve = loss_curve(&mesh, &info, 90).unwrap();
        assert_eq!((curve.degrees.len(), curve.degrees[45]), (91, 180.0));
        let largest = |values: &[f64]| values.iter().copied().fold(0.0, f64::max);
        let jump =
            |values: &[f64]| largest(&values.windows(2).map(|w| (w[1] - w[0]).abs()).collect::<Vec<_>>());
        for values in [&curve.l1, &curve.view_limits, &curve.transformer] {
            assert!(values[0] < 1e-6 && values[90] < 0.02 && largest(values) > 0.1, "{values:?}");
        }
        // L1 is largest near the half turn, where the object looks the same; the other two are zero there.
        assert!(curve.l1[45] > 0.8 * largest(&curve.l1), "{:?}", curve.l1);
        assert!(curve.transformer[45] < 0.02 && curve.view_limits[45] < 0.02, "{curve:?}");
        // View limits have a jump where two sides meet.
        assert!(jump(&curve.view_limits) > 3.0 * jump(&curve.transformer), "{curve:?}");
    }

    #[test]
    fn objects_without_a_discrete_symmetry_have_no_curve() {
        let (mesh, info) = box_with_half_turn();
        let none = ModelInfo { symmetries_discrete: vec![], ..info };
        assert_eq!(loss_curve(&mesh, &none, 8), None);
    }
}
