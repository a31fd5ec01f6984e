//! Who is asked, when no further one is, and how poses of several methods are judged together.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use sixfold_align::{DepthOptions, PreparedDepth};
use sixfold_auto::AutoEstimator;
use sixfold_estimator::{
    EstimatorError, Need, Needs, Object, PoseEstimate, PoseEstimator, PreparedObject, Query,
};
use sixfold_geometry::nalgebra::Vector6;
use sixfold_geometry::{Camera, Image, Pose, RgbImage, Vec3};
use sixfold_mesh::{Mesh, ModelInfo};
use sixfold_render::{Light, Material, RenderOptions, SceneObject, VisibilityBuffer, shade};

/// A method that finds what it is told, and counts how often it is asked.
struct FixedPoses {
    name: &'static str,
    needs: Needs,
    poses: Vec<Pose>,
    asked: AtomicUsize,
    cannot: bool,
}

struct Nothing;

impl PreparedObject for Nothing {
    fn name(&self) -> &str {
        "wedge"
    }

    fn mesh(&self) -> Option<&Mesh> {
        None
    }
}

impl PoseEstimator for FixedPoses {
    fn name(&self) -> &'static str {
        self.name
    }

    fn needs(&self) -> Needs {
        self.needs
    }

    fn prepare(&self, object: &Object) -> Result<Box<dyn PreparedObject>, EstimatorError> {
        if self.cannot {
            let (object, what, method) = (object.name.clone(), "weights", self.name);
            return Err(EstimatorError::Lacks { object, what, method, advice: "train some" });
        }
        Ok(Box::new(Nothing))
    }

    fn estimate(&self, _: &dyn PreparedObject, _: &Query<'_>) -> Result<Vec<PoseEstimate>, EstimatorError> {
        self.asked.fetch_add(1, Ordering::Relaxed);
        Ok(self.poses.iter().map(|pose| PoseEstimate::new(*pose, 0.5)).collect())
    }
}

fn fixed_poses(name: &'static str, poses: &[Pose]) -> Arc<FixedPoses> {
    let needs = Needs { depth: Need::Required, object: Need::Required, ..Needs::default() };
    Arc::new(FixedPoses { name, needs, poses: poses.to_vec(), asked: AtomicUsize::new(0), cannot: false })
}

fn by_color(name: &'static str, poses: &[Pose]) -> Arc<FixedPoses> {
    let needs = Needs { rgb: Need::Required, object: Need::Required, ..Needs::default() };
    Arc::new(FixedPoses { name, needs, poses: poses.to_vec(), asked: AtomicUsize::new(0), cannot: false })
}

fn asked(method: &FixedPoses) -> usize {
    method.asked.load(Ordering::Relaxed)
}

/// A box of 12 x 8 x 6 cm with a corner cut off, so that no two of its poses look alike.
fn wedge() -> Mesh {
    solid(0.4)
}

/// The top's side at x > 0 is `cut` as wide as the other.
fn solid(cut: f64) -> Mesh {
    let vertices: Vec<Vec3> = (0..8)
        .map(|k| {
            let side = |axis: usize, half: f64| if k >> axis & 1 == 0 { -half } else { half };
            let narrow = if k & 1 == 1 && k & 4 == 4 { cut } else { 1.0 };
            Vec3::new(side(0, 0.06), narrow * side(1, 0.04), side(2, 0.03))
        })
        .collect();
    let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let faces = sides.iter().flat_map(|s| [[s[0], s[1], s[2]], [s[0], s[2], s[3]]]).collect();
    Mesh::new(vertices, faces).unwrap()
}

fn camera() -> Camera {
    Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap()
}

fn truth() -> Pose {
    let turn = Pose::exp(&Vector6::new(0.0, 0.0, 0.0, 2.4, 0.5, 0.3));
    Pose::new(turn.rotation(), Vec3::new(0.02, 0.01, 0.6))
}

/// The object before a wall, in depth and in colour.
fn images(mesh: &Mesh) -> (Arc<PreparedDepth>, RgbImage) {
    let camera = camera();
    let mut frame = VisibilityBuffer::new(&camera);
    let objects = [SceneObject { mesh, camera_from_object: truth() }];
    frame.render(&objects, &RenderOptions::default());
    let depth = frame.depth().map(|z| if *z > 0.0 { *z } else { 1.2 });
    let grey: RgbImage = Image::filled(640, 480, [70; 3]);
    let rgb = shade(&frame, &objects, &Light::default_set(), &Material::default(), Some(&grey));
    (PreparedDepth::new(&depth, &camera, &DepthOptions::default()).unwrap(), rgb)
}

fn found(
    members: &[Arc<FixedPoses>],
    change: impl FnOnce(&mut AutoEstimator),
    query: &Query<'_>,
    mesh: Mesh,
) -> Vec<PoseEstimate> {
    let members = members.iter().map(|m| m.clone() as Arc<dyn PoseEstimator>).collect();
    let mut auto = AutoEstimator::new(members).unwrap();
    change(&mut auto);
    let info = ModelInfo::of_mesh(&mesh);
    let object = auto.prepare(&Object::of_mesh("wedge", mesh, info)).unwrap();
    auto.estimate(object.as_ref(), query).unwrap()
}

/// Beside the truth by so many metres.
fn beside(x: f64) -> Pose {
    truth().with_translation(truth().translation() + Vec3::new(x, 0.0, 0.0))
}

#[test]
fn whoever_is_sure_is_the_last_to_be_asked() {
    let (depth, _) = images(&wedge());
    let camera = camera();
    let query = Query { depth: Some(&depth), ..Query::new(&camera) };
    let (first, second) = (fixed_poses("first", &[truth()]), fixed_poses("second", &[beside(0.02)]));
    let poses = found(&[first.clone(), second.clone()], |_| (), &query, wedge());
    assert_eq!((asked(&first), asked(&second)), (1, 0));
    assert!(poses[0].probability.unwrap() > 0.9, "{:?}", poses[0].probability);
    assert_eq!(poses[0].confidence, poses[0].probability.unwrap());
    assert_eq!(poses[0].details["method"], "first");
    // Pixels that agree are its mask.
    assert_eq!(poses[0].mask.as_ref().unwrap().len(), poses[0].verification.unwrap().inliers);

    // Asked although the first is sure, and asked because it is not.
    found(&[first.clone(), second.clone()], |auto| auto.ask_all = true, &query, wedge());
    assert_eq!((asked(&first), asked(&second)), (2, 1));
    let wrong = fixed_poses("wrong", &[beside(0.3)]);
    let poses = found(&[wrong.clone(), first.clone()], |_| (), &query, wedge());
    assert_eq!((asked(&wrong), asked(&first)), (1, 3));
    assert_eq!(poses[0].details["method"], "first");
    // Not within no time.
    let poses =
        found(&[wrong.clone(), first.clone()], |auto| auto.budget = Some(Duration::ZERO), &query, wedge());
    assert_eq!((asked(&wrong), asked(&first)), (2, 3));
    assert!(poses.iter().all(|p| p.probability.unwrap() < 0.5), "{poses:?}");
}

#[test]
fn the_right_pose_wins_whoever_found_it_and_wrong_ones_are_not_reported() {
    let (depth, rgb) = images(&wedge());
    let camera = camera();
    let query = Query { depth: Some(&depth), rgb: Some(&rgb), min_confidence: 0.5, ..Query::new(&camera) };
    let wrong = fixed_poses("wrong", &[beside(0.05), beside(-0.2)]);
    let colour = by_color("colour", &[truth().with_translation(truth().translation() * 1.05)]);
    // Five per cent too far, as colour has it: depth brings it back.
    let poses = found(&[wrong.clone(), colour], |_| (), &query, wedge());
    assert_eq!(poses[0].details["method"], "colour");
    assert!(poses[0].camera_from_object.distance_to(&truth()) < 0.003, "{poses:?}");
    assert!(found(&[wrong], |_| (), &query, wedge()).is_empty());
}

#[test]
fn methods_that_agree_are_one_pose() {
    let (depth, _) = images(&wedge());
    let camera = camera();
    let query = Query { depth: Some(&depth), max_instances: 3, ..Query::new(&camera) };
    let members = [fixed_poses("a", &[truth()]), fixed_poses("b", &[beside(0.001), beside(0.3)])];
    let poses = found(&members, |auto| auto.ask_all = true, &query, wedge());
    assert_eq!(poses[0].details["found_by"], serde_json::json!(["a", "b"]));
    assert!(poses[1..].iter().all(|p| p.probability < poses[0].probability));
}

#[test]
fn two_poses_that_look_alike_are_both_said() {
    // Without the cut the box looks the same after half a turn, and nothing says that it is symmetric.
    let (depth, _) = images(&solid(1.0));
    let camera = camera();
    let query = Query { depth: Some(&depth), ..Query::new(&camera) };
    let half = Pose::exp(&Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, std::f64::consts::PI));
    let rotated = Pose::new(truth().rotation() * half.rotation(), truth().translation());
    let poses = found(&[fixed_poses("a", &[truth(), rotated])], |_| (), &query, solid(1.0));
    let alternatives = poses[0].weighted_alternatives();
    assert_eq!(alternatives.len(), 1, "{alternatives:?}");
    assert!((alternatives[0].weight - 0.5).abs() < 0.1, "{alternatives:?}");
    // Only one of both is right.
    let sum = poses[0].confidence + poses[0].alternatives[0].confidence;
    assert!(sum > 0.3 && sum < 1.0 && poses[0].confidence < 0.5, "{poses:?}");
    assert_eq!(poses[0].probability_with_alternatives(), Some(sum));
    // The threshold applies to both together.
    let at_least = |min_confidence: f64| {
        let query = Query { min_confidence, ..query.passed_on(1, 0.0) };
        found(&[fixed_poses("a", &[truth(), rotated])], |_| (), &query, solid(1.0)).len()
    };
    assert!(poses[0].confidence < 0.9 * sum, "{poses:?}");
    assert_eq!([0.95 * sum, 1.05 * sum].map(at_least), [1, 0]);
}

#[test]
fn members_that_cannot_run_are_left_out_and_reported() {
    let (depth, _) = images(&wedge());
    let camera = camera();
    let query = Query { depth: Some(&depth), ..Query::new(&camera) };
    let lacking =
        Arc::new(FixedPoses { cannot: true, ..Arc::into_inner(fixed_poses("untrained", &[])).unwrap() });
    let colour = by_color("colour", &[truth()]);
    let poses =
        found(&[lacking.clone(), colour.clone(), fixed_poses("a", &[truth()])], |_| (), &query, wedge());
    assert_eq!((asked(&lacking), asked(&colour)), (0, 0));
    assert!(
        poses[0].notes[0].contains("--method untrained was not asked: object wedge: has no weights"),
        "{:?}",
        poses[0].notes
    );

    // Nobody is left.
    let auto = AutoEstimator::new(vec![colour as Arc<dyn PoseEstimator>]).unwrap();
    let info = ModelInfo::of_mesh(&wedge());
    let object = auto.prepare(&Object::of_mesh("wedge", wedge(), info)).unwrap();
    let error = auto.estimate(object.as_ref(), &query).unwrap_err().to_string();
    assert!(error.contains("--method auto") && error.contains("--rgb"), "{error}");
    // Without a mesh nothing can be judged: a method that knows the object answers alone, and if none does, a mesh is lacking.
    let bare = Object { mesh: None, ..Object::of_model(None) };
    let none_able = AutoEstimator::new(vec![lacking as Arc<dyn PoseEstimator>]).unwrap();
    assert!(matches!(none_able.prepare(&bare), Err(EstimatorError::Lacks { method: "auto", .. })));
    let one = AutoEstimator::new(vec![fixed_poses("a", &[truth()]) as Arc<dyn PoseEstimator>]).unwrap();
    let poses = one.estimate(one.prepare(&bare).unwrap().as_ref(), &query).unwrap();
    assert_eq!(poses.len(), 1);
    assert_eq!((poses[0].probability, &poses[0].details["method"]), (None, &"a".into()));
    assert!(poses[0].notes[0].contains("--method a answered alone"), "{:?}", poses[0].notes);
}
