//! From an experience on the handle of one mug to the handle of another, with the network that ships.

use std::path::Path;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sixfold_dgcm::model::DgcmModel;
use sixfold_dgcm::outcome::OutcomeModel;
use sixfold_dgcm::transfer::{
    AlignmentHypothesis, Kind, Memory, ProposeOptions, grasps_as_published, propose, rank_on_part,
};
use sixfold_experience::{Crop, Experience, ExperienceStore, SqliteStore};
use sixfold_geometry::nalgebra::{UnitQuaternion, Vector3};
use sixfold_geometry::{Camera, Mask, Mat3, Pose, Vec3};
use sixfold_grasp::learned::ScoredGrasp;
use sixfold_grasp::{
    AntipodalOptions, AntipodalQuality, ClusterOptions, Grasp, GraspFitter, GraspView, Gripper, ViewOptions,
    antipodal_grasps, centre_between_pads, gripper_pose,
};
use sixfold_mesh::Mesh;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};
use sixfold_synth::shapes::{Family, Member, member};

/// A synthetic mug on a table, 0.7 m from a camera that looks down by 40 degrees.
struct Seen {
    mug: Member,
    view: GraspView,
    camera_from_object: Pose,
}

fn seen(seed: u64, yaw: f64) -> Seen {
    let mug = member(Family::Mug, &mut ChaCha8Rng::seed_from_u64(seed)).unwrap();
    let corner = |x: f64, y: f64| Vec3::new(0.5 * x, 0.5 * y, 0.0);
    let corners = vec![corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
    let table = Mesh::new(corners, vec![[0, 1, 2], [0, 2, 3]]).unwrap();
    let camera = Camera::new(575.0, 575.0, 319.5, 239.5, 640, 480).unwrap();
    let (sin, cos) = (-40f64.to_radians()).sin_cos();
    let z = Vec3::new(0.0, cos, sin);
    let axes = Mat3::from_columns(&[Vec3::x(), z.cross(&Vec3::x()), z]);
    let camera_from_world = Pose::from_parts(&axes, -z * 0.7).unwrap().inverse();
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
    let camera_from_object = camera_from_world * Pose::new(turn, Vec3::zeros());
    let drawn = |objects: &[SceneObject<'_>]| {
        let mut frame = VisibilityBuffer::new(&camera);
        frame.render(objects, &RenderOptions::default());
        frame.depth()
    };
    let object = || SceneObject { mesh: &mug.mesh, camera_from_object };
    let alone = drawn(&[object()]);
    let depth = drawn(&[object(), SceneObject { mesh: &table, camera_from_object: camera_from_world }]);
    let mask = Mask::from_fn(640, 480, |x, y| alone[(x, y)] > 0.0);
    let view = GraspView::new(&depth, &camera, &mask, &ViewOptions::default()).unwrap();
    Seen { mug, view, camera_from_object }
}

impl Seen {
    /// The part in the centre between the pads of a grasp.
    fn part_of(&self, grasp: &Grasp) -> &'static str {
        let centre = centre_between_pads(&grasp.camera_from_gripper);
        self.mug.part_at(&self.camera_from_object.inverse().transform_point(&centre))
    }

    /// A grasp of the handle from outside.
    fn handle_grasp(&self) -> Grasp {
        let handle: Vec<Vec3> =
            self.mug.mesh.vertices().iter().copied().filter(|p| self.mug.part_at(p) == "handle").collect();
        let out = handle.iter().map(|p| p.x).fold(f64::MIN, f64::max);
        let height = handle.iter().map(|p| p.z).sum::<f64>() / handle.len() as f64;
        let c = self.camera_from_object;
        let pose = gripper_pose(
            &c.transform_point(&Vec3::new(out - 0.012, 0.0, height)),
            &c.transform_direction(&-Vec3::x()),
            &c.transform_direction(&Vec3::y()),
        )
        .unwrap();
        let quality = AntipodalQuality { alignment: 1.0, support: 1.0, centring: 1.0, observed: 1.0 };
        Grasp { camera_from_gripper: pose, opening: 0.04, width: 0.01, quality }
    }
}

#[test]
fn as_published_the_network_alone_transfers_to_a_fixed_distance() {
    let weights = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../weights/dgcm.safetensors");
    let model = DgcmModel::load(&weights).unwrap();
    let gripper = Gripper::built_in("jaws-140").unwrap();
    let folder = tempfile::tempdir().unwrap();
    let (taught, now) = (seen(40, 0.2), seen(40, 0.3));
    let planner = AntipodalOptions::default();
    let wide = antipodal_grasps(&taught.view, &gripper, &planner).unwrap();
    let crop = Crop::of_view(&taught.view, model.crop_options()).unwrap();
    let mut store = SqliteStore::create(&folder.path().join("e.db")).unwrap();
    for grasp in wide.iter().take(4) {
        let experience = Experience::new(&model, crop.clone(), grasp, &gripper, "mug", None, 0, "a test");
        store.add(&experience).unwrap();
    }
    let mut memory = Memory::new(Box::new(store), &model).unwrap();
    let fitter = GraspFitter::new(&now.view, &gripper, &planner).unwrap();
    let options = ProposeOptions::published();
    let found = propose(&fitter, &model, &mut memory, &options).unwrap();
    assert!(!found.proposals.is_empty() && found.grasp_centres.is_empty());
    for p in &found.proposals {
        assert_eq!((p.hypothesis, p.moved), (AlignmentHypothesis::Scaled, 0.0));
        let reach = fitter.reach(&p.grasp.camera_from_gripper, gripper.max_opening).unwrap();
        assert!((reach + 0.03).abs() < 1e-6, "{reach}");
        assert!((p.score - (-p.from.distance).exp()).abs() < 1e-12);
    }
    // The mug moved by a tenth of a radian, and the grasps with it: the same approach direction, on the same axis.
    let moved = now.camera_from_object * taught.camera_from_object.inverse();
    let errors: Vec<(f64, f64)> = found
        .proposals
        .iter()
        .map(|p| {
            let wanted = &wide[usize::try_from(p.from.experience).unwrap() - 1];
            let (approach, target) =
                (moved.transform_direction(&wanted.approach()), moved * wanted.camera_from_gripper);
            let off = p.grasp.camera_from_gripper.translation() - target.translation();
            let aside = off - approach * off.dot(&approach);
            (p.grasp.approach().angle(&approach).to_degrees(), aside.norm())
        })
        .collect();
    println!("{errors:.3?}");
    // The four nearest are the experiences themselves; behind them come their copies, rotated in the image plane.
    assert!(errors.len() >= 4, "{errors:.3?}");
    assert!(errors[..4].iter().all(|(degrees, aside)| *degrees < 15.0 && *aside < 0.01), "{errors:.3?}");
    // Ours adds other hypotheses to the same experiences.
    let ours = propose(&fitter, &model, &mut memory, &ProposeOptions::default()).unwrap();
    assert!(ours.proposals.iter().any(|p| p.hypothesis != AlignmentHypothesis::Scaled));
    let published =
        grasps_as_published(&now.view, &gripper, &planner, &model, &mut memory, None, None).unwrap();
    assert!(published.ranked.iter().all(|r| r.kind == Kind::Experience));
    let scored = |grasp: Grasp| ScoredGrasp { grasp, score: grasp.quality.total() };
    let planned: Vec<ScoredGrasp> =
        antipodal_grasps(&now.view, &gripper, &planner).unwrap().into_iter().map(scored).collect();
    let planned = Some(planned.as_slice());
    let combined =
        grasps_as_published(&now.view, &gripper, &planner, &model, &mut memory, None, planned).unwrap();
    assert!(combined.ranked.iter().all(|r| r.kind == Kind::Geometry));
    for r in &combined.ranked {
        let near = |p: &&sixfold_dgcm::transfer::Proposal| {
            let (distance, angle) = r.grasp.difference(&p.grasp);
            distance <= 0.05 && angle <= 15f64.to_radians()
        };
        let near: Vec<f64> = combined.found.proposals.iter().filter(near).map(|p| p.score).collect();
        let mean = near.iter().sum::<f64>() / near.len().max(1) as f64;
        assert!((r.experience - mean).abs() < 1e-12 && (r.score - 0.5 * (r.geometry + mean)).abs() < 1e-12);
    }
}

#[test]
fn an_experience_on_a_handle_leads_to_the_handle_of_another_mug() {
    let weights = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../weights/dgcm.safetensors");
    let model = DgcmModel::load(&weights).unwrap();
    let gripper = Gripper::built_in("jaws-85").unwrap();
    let folder = tempfile::tempdir().unwrap();
    let clusters = ClusterOptions::default();
    let (mut first, mut transferred) = (0, 0);
    for (k, (there, here)) in [(0.2, -1.2), (-2.8, -0.4), (-1.4, 0.1), (-0.5, -2.7)].into_iter().enumerate() {
        let taught = seen(40 + k as u64, there);
        let crop = Crop::of_view(&taught.view, model.crop_options()).unwrap();
        assert!(crop.table.is_some(), "the table is seen");
        let grasp = taught.handle_grasp();
        assert_eq!(taught.part_of(&grasp), "handle");
        let experience = Experience::new(&model, crop, &grasp, &gripper, "mug", Some("handle"), 0, "a test");
        let mut store = SqliteStore::create(&folder.path().join(format!("{k}.db"))).unwrap();
        store.add(&experience).unwrap();
        let mut memory = Memory::new(Box::new(store), &model).unwrap();
        let now = seen(50 + k as u64, here);
        let planner = AntipodalOptions::default();
        let fitter = GraspFitter::new(&now.view, &gripper, &planner).unwrap();
        let options = ProposeOptions { part: Some("handle".to_owned()), ..ProposeOptions::default() };
        let found = propose(&fitter, &model, &mut memory, &options).unwrap();
        // What was held is looked for on the handle, nearly alone.
        let object_from_camera = now.camera_from_object.inverse();
        let on_handle =
            |i: usize| now.mug.part_at(&object_from_camera.transform_point(&found.crop.point(i))) == "handle";
        let all: f64 = found.crop.pixels().map(|i| found.held_before[i]).sum();
        let right: f64 = found.crop.pixels().filter(|&i| on_handle(i)).map(|i| found.held_before[i]).sum();
        assert!(all > 5.0 && right > 0.6 * all, "{there} to {here}: {right} of {all}");
        // The transferred grasp closes along the way around the mug, as the taught one does.
        if let Some(p) = found.proposals.iter().find(|p| p.hypothesis == AlignmentHypothesis::Upright) {
            transferred += 1;
            let wanted = now.handle_grasp();
            let rotated_by = p.grasp.camera_from_gripper.rotation_angle_to(&wanted.camera_from_gripper);
            let half = Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, std::f64::consts::PI].into());
            let other = (p.grasp.camera_from_gripper * half).rotation_angle_to(&wanted.camera_from_gripper);
            assert!(rotated_by.min(other) < 0.7, "{there} to {here}: {rotated_by} {other}");
        }
        let geometry = antipodal_grasps(&now.view, &gripper, &planner).unwrap();
        let ranked = rank_on_part(&geometry, &found, &clusters, &fitter, &OutcomeModel::default());
        first += usize::from(ranked.first().is_some_and(|r| now.part_of(&r.grasp) == "handle"));
    }
    assert!(transferred >= 3, "a grasp is transferred by shape to {transferred} of 4 mugs");
    assert!(first >= 3, "the first grasp is on the handle of {first} of 4 mugs");
}
