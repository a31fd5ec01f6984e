//! Photographs of a painted block made by the tests themselves.

use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sixfold_data::PosedImage;
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::{Camera, Pose, RgbImage, Vec3, sphere_directions};
use sixfold_mesh::Mesh;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

use super::*;

pub(crate) fn block() -> Mesh {
    let corner = |i: usize| {
        Vec3::from_fn(|axis, _| [0.06, 0.04, 0.05][axis] * if i >> axis & 1 == 0 { -1.0 } else { 1.0 })
    };
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let faces = quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect();
    Mesh::new((0..8).map(corner).collect(), faces).unwrap()
}

/// Paint at a place of the surface.
fn paint(p: &[f32; 3]) -> [u8; 3] {
    let wave =
        |f: f32, k: usize, shift: f32| ((p[k] * f + shift).sin() * (p[(k + 1) % 3] * f * 0.7).cos()) * 60.0;
    [
        (150.0 + wave(160.0, 0, 0.3)) as u8,
        (120.0 + wave(130.0, 1, 1.1)) as u8,
        (110.0 + wave(190.0, 2, 2.0)) as u8,
    ]
}

/// Photographs with exact poses, and the same with disturbed ones.
pub(crate) fn photographs(count: usize, reach: [f64; 2], seed: u64) -> (Mesh, Vec<Pose>, Vec<PosedImage>) {
    let mesh = block();
    let camera = Camera::new(570.0, 570.0, 159.5, 119.5, 320, 240).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut poses = vec![];
    let mut list = vec![];
    for direction in sphere_directions(count) {
        let z = -direction;
        let x = z.cross(&Vec3::new(0.3, 0.2, 0.9)).normalize();
        let rotation =
            sixfold_geometry::Mat3::from_rows(&[x.transpose(), z.cross(&x).transpose(), z.transpose()]);
        let mut draw = |reach: f64| reach * (2.0 * random.random::<f64>() - 1.0);
        let truth = Pose::from_parts(&rotation, Vec3::new(draw(0.05), draw(0.03), 0.7 + draw(0.1))).unwrap();
        let mut frame = VisibilityBuffer::new(&camera);
        let objects = [SceneObject { mesh: &mesh, camera_from_object: truth }];
        frame.render(&objects, &RenderOptions::default());
        let seen = frame.object_coordinates(&objects);
        let image = RgbImage::from_fn(320, 240, |x, y| {
            let p = seen[(x, y)];
            if p[0].is_nan() { [(40 + x % 23) as u8, (60 + y % 31) as u8, 70] } else { paint(&p) }
        });
        let shift = Vec3::new(draw(reach[0]), draw(reach[0]), draw(reach[0]));
        let turn = UnitQuaternion::from_euler_angles(draw(reach[1]), draw(reach[1]), draw(reach[1]));
        let rough = Pose::new(turn * truth.rotation(), truth.translation() + shift);
        poses.push(truth);
        list.push(PosedImage::new(format!("{}", list.len()), 1, Arc::new(image), camera, rough).unwrap());
    }
    (mesh, poses, list)
}

/// Median errors, metres and radians.
fn errors(poses: &[Pose], truth: &[Pose]) -> [f64; 2] {
    let median = |f: &dyn Fn(&Pose, &Pose) -> f64| {
        let mut v: Vec<f64> = poses.iter().zip(truth).map(|(a, b)| f(a, b)).collect();
        v.sort_by(f64::total_cmp);
        v[v.len() / 2]
    };
    [median(&|a, b| a.distance_to(b)), median(&|a, b| a.rotation_angle_to(b))]
}

#[test]
fn rough_poses_of_a_painted_block_become_exact() {
    let (mesh, truth, photographs) = photographs(14, [0.01, 0.05], 3);
    let given: Vec<Pose> = photographs.iter().map(|p| *p.camera_from_object()).collect();
    // As it is by default; with the outline, which is sharp here; with all of the paint, which is even here, and the error
    // that all poses share.
    let default = PoseRefinementOptions::default();
    let outline = PoseRefinementOptions { line: 0.3, ..default.clone() };
    let paint = PoseRefinementOptions { wide: 0.0, shared: 2, colors: 40.0, ..default.clone() };
    for (options, most) in [(default, [0.0035, 0.015]), (outline, [0.002, 0.006]), (paint, [0.0015, 0.009])] {
        let refined = refine_poses(&photographs, &mesh, &options, &()).unwrap();
        let after: Vec<Pose> = refined.sources.iter().map(|s| s.camera_from_object).collect();
        let (before, after) = (errors(&given, &truth), errors(&after, &truth));
        assert!(after[0] < most[0] && after[1] < most[1], "{options:?}: {before:?} {after:?}");
    }
}

#[test]
fn a_photograph_with_a_wrong_pose_is_dropped() {
    let (mesh, _, mut photographs) = photographs(12, [0.004, 0.02], 5);
    let wrong = photographs[4].camera_from_object();
    let moved = wrong.with_translation(wrong.translation() + Vec3::new(0.07, 0.03, 0.0));
    photographs[4] = photographs[4].with_pose(moved).unwrap();
    let refined = refine_poses(&photographs, &mesh, &PoseRefinementOptions::default(), &()).unwrap();
    for (k, source) in refined.sources.iter().enumerate() {
        assert_eq!(source.dropped.is_some(), k == 4, "{k}: {source:?}");
    }
    assert_eq!(refined.sources[4].camera_from_object, moved);
}

/// Ten photographs of two blocks, the second standing `between` from the first in a photograph: the mesh, true poses of the
/// first and then of the second, and both kinds of photographs with disturbed poses.
fn two_blocks(between: impl Fn(usize) -> Pose) -> (Mesh, Vec<Pose>, Vec<PosedImage>, Vec<PosedImage>) {
    let (mesh, mut truth, first) = photographs(10, [0.008, 0.04], 9);
    let mut random = ChaCha8Rng::seed_from_u64(2);
    let mut draw = |reach: f64| reach * (2.0 * random.random::<f64>() - 1.0);
    let more: Vec<Pose> = truth.iter().enumerate().map(|(image, truth)| *truth * between(image)).collect();
    let second = first
        .iter()
        .zip(&more)
        .map(|(p, pose)| {
            let shift = Vec3::new(draw(0.008), draw(0.008), draw(0.008));
            let turn = UnitQuaternion::from_euler_angles(draw(0.04), draw(0.04), draw(0.04));
            p.with_pose(Pose::new(turn * pose.rotation(), pose.translation() + shift)).unwrap()
        })
        .collect();
    truth.extend(more);
    (mesh, truth, first, second)
}

/// The sources of two objects, each in every image.
fn sources<'a>(first: &'a [PosedImage], second: &'a [PosedImage]) -> Vec<PosedSource<'a>> {
    let of = |object: usize, list: &'a [PosedImage]| {
        list.iter().enumerate().map(move |(image, photograph)| PosedSource { object, image, photograph })
    };
    of(0, first).chain(of(1, second)).collect()
}

fn between(turn: f64, away: f64) -> Pose {
    Pose::new(UnitQuaternion::from_euler_angles(0.3, 0.0, turn), Vec3::new(away, 0.05, 0.0))
}

#[test]
fn objects_that_stood_still_share_their_cameras() {
    let (mesh, truth, first, second) = two_blocks(|_| between(1.0, 0.15));
    let sources = sources(&first, &second);
    // The second block is painted nowhere: what is left is the common arrangement.
    let options = PoseRefinementOptions { colors: 0.0, line: 0.0, ..PoseRefinementOptions::default() };
    let refined = refine_scene(&sources, &[mesh.clone(), mesh], &options, &()).unwrap();
    assert!(refined.still && refined.disagreement.unwrap() < 2.0, "{:?}", refined.disagreement);
    assert_eq!(refined.places, 2);
    let given: Vec<Pose> = sources.iter().map(|s| *s.photograph.camera_from_object()).collect();
    let after: Vec<Pose> = refined.sources.iter().map(|s| s.camera_from_object).collect();
    let (before, after) = (errors(&given, &truth), errors(&after, &truth));
    assert!(after[0] < 0.85 * before[0] && after[1] < 0.85 * before[1], "{before:?} {after:?}");
    // Moved between photographs, nothing is shared: the given poses stay.
    let options = PoseRefinementOptions { scene: SceneKind::Moving, ..options };
    let moving = refine_scene(&sources, &[block(), block()], &options, &()).unwrap();
    assert!(moving.sources.iter().zip(&given).all(|(s, g)| s.camera_from_object.distance_to(g) < 1e-6));
}

#[test]
fn objects_that_were_moved_once_share_their_cameras_before_and_after() {
    let (mesh, truth, first, second) =
        two_blocks(|image| if image < 5 { between(1.0, 0.15) } else { between(-0.4, -0.1) });
    let sources = sources(&first, &second);
    let options = PoseRefinementOptions { colors: 0.0, line: 0.0, ..PoseRefinementOptions::default() };
    let refined = refine_scene(&sources, &[mesh.clone(), mesh], &options, &()).unwrap();
    // Who moved, nobody can say: both objects have a place before and one after.
    assert!(!refined.still && refined.disagreement.unwrap() > 2.0, "{:?}", refined.disagreement);
    assert_eq!(refined.places, 4);
    let given: Vec<Pose> = sources.iter().map(|s| *s.photograph.camera_from_object()).collect();
    let after: Vec<Pose> = refined.sources.iter().map(|s| s.camera_from_object).collect();
    let (before, after) = (errors(&given, &truth), errors(&after, &truth));
    assert!(after[0] < 0.95 * before[0] && after[1] < 0.9 * before[1], "{before:?} {after:?}");
}

#[test]
fn the_published_rule_lowers_its_own_error_and_that_of_places() {
    let (mesh, truth, photographs) = photographs(10, [0.004, 0.02], 5);
    let given: Vec<Pose> = photographs.iter().map(|p| *p.camera_from_object()).collect();
    let found =
        published_rule_poses(&photographs, &mesh, None, 128, 6, &PublishedRuleOptions::default()).unwrap();
    // A rule that does nothing leaves its error; one that steps uphill never accepts a step.
    let fell = found.iter().filter(|(_, [first, last])| *last < 0.99 * first).count();
    let moved = found.iter().zip(&given).filter(|((pose, _), g)| pose.rotation_angle_to(g) > 1e-4).count();
    assert!(found.iter().all(|(_, [first, last])| last <= first));
    let after: Vec<Pose> = found.iter().map(|f| f.0).collect();
    let (before, after) = (errors(&given, &truth), errors(&after, &truth));
    println!("{before:.5?} {after:.5?} {fell} {moved} {:?}", found.iter().map(|f| f.1).collect::<Vec<_>>());
    assert!(fell >= 5 && moved >= 5, "{fell} {moved} {found:?}");
    // Places come nearer, rotations stay about as they are: its step is one for metres and radians.
    assert!(after[0] < 0.7 * before[0] && after[1] < 1.05 * before[1], "{before:?} {after:?}");
}
