//! Objects on a table with simulated depth: found by their templates, hidden in part, not there, and known from one view only.

use sixfold_align::{DepthOptions, DepthRegion, VerificationOptions, verification_mesh};
use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::{Camera, DepthImage, Mask, Pose, Vec3};
use sixfold_mesh::Mesh;
use sixfold_mttm::align::camera_from_view;
use sixfold_mttm::judge::{Surface, judge};
use sixfold_mttm::learned::Learned;
use sixfold_mttm::mask::to_image;
use sixfold_mttm::mask_check::check_mask;
use sixfold_mttm::matching::{Entry, MatchOptions, Matcher};
use sixfold_mttm::model::MttmModel;
use sixfold_mttm::network::MAP;
use sixfold_mttm::patch::Patch;
use sixfold_mttm::roi::{Roi, UNKNOWN};
use sixfold_mttm::{
    DepthView, KnownObject, MaskSource, MttmEstimate, MttmOptions, ObjectTemplates, Search, Template,
    TemplateError, TemplateOptions, estimate,
};
use sixfold_render::{DepthSensor, RenderOptions, SceneObject, VisibilityBuffer, simulate_depth};

fn camera() -> Camera {
    Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap()
}

fn cuboid(low: [f64; 3], high: [f64; 3]) -> Mesh {
    let vertices = (0..8)
        .map(|i| Vec3::from_fn(|axis, _| if i >> axis & 1 == 0 { low[axis] } else { high[axis] }))
        .collect();
    let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let faces = sides.iter().flat_map(|s| [[s[0], s[1], s[2]], [s[0], s[2], s[3]]]).collect();
    Mesh::new(vertices, faces).unwrap()
}

/// A step with a tower, 12 x 8 x 11 cm, no symmetry.
fn part() -> Mesh {
    Mesh::merged(&[
        cuboid([-0.06, -0.04, 0.0], [0.06, 0.04, 0.03]),
        cuboid([-0.06, -0.04, 0.03], [-0.02, 0.01, 0.11]),
        cuboid([0.02, -0.04, 0.03], [0.06, 0.04, 0.055]),
    ])
    .unwrap()
}

/// The camera looks down at a table 0.8 m away by 45 degrees.
fn on_table(x: f64, y: f64, yaw: f64) -> Pose {
    let table = UnitQuaternion::from_axis_angle(&Vec3::x_axis(), 135f64.to_radians());
    let turn = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), yaw);
    Pose::new(table, Vec3::new(0.0, 0.0, 0.8)) * Pose::new(turn, Vec3::new(x, y, 0.0))
}

/// Depth of objects on the table, as a sensor with shadow and noise sees it, and the visible part of the first.
fn render_scene(objects: &[(&Mesh, Pose)], seed: u64) -> (DepthImage, Mask) {
    let table = cuboid([-0.7, -0.7, -0.02], [0.7, 0.7, 0.0]);
    let objects: Vec<SceneObject<'_>> = objects
        .iter()
        .copied()
        .chain([(&table, on_table(0.0, 0.0, 0.0))])
        .map(|(mesh, camera_from_object)| SceneObject { mesh, camera_from_object })
        .collect();
    let mut frame = VisibilityBuffer::new(&camera());
    frame.render(&objects, &RenderOptions::default());
    let depth = simulate_depth(&frame.depth(), &frame.normals(&objects), &DepthSensor::xtion(), seed);
    (depth, frame.mask(0))
}

fn prepared(depth: &DepthImage) -> DepthRegion {
    DepthRegion::from_depth(depth, &camera(), None, &DepthOptions::default()).unwrap()
}

fn known(with_mesh: bool) -> KnownObject {
    let mesh = part();
    let templates = ObjectTemplates::from_mesh(&mesh, &TemplateOptions::default()).unwrap();
    let model = with_mesh.then(|| verification_mesh(&mesh).unwrap());
    KnownObject::new(templates, model)
}

/// An object as points find it, and as the network does.
fn both_ways(object: KnownObject) -> [KnownObject; 2] {
    let model = std::sync::Arc::new(MttmModel::shipped().unwrap());
    [object.clone(), object.with_network(model)]
}

fn off(found: &MttmEstimate, truth: &Pose) -> (f64, f64) {
    let pose = &found.camera_from_object;
    (1000.0 * pose.distance_to(truth), pose.rotation_angle_to(truth).to_degrees())
}

fn iou(found: &MttmEstimate, visible: &Mask, depth: &DepthImage) -> f64 {
    let mask = to_image(&found.mask, 640, 480);
    let (mut common, mut either) = (0, 0);
    for ((m, v), z) in mask.as_slice().iter().zip(visible.as_slice()).zip(depth.as_slice()) {
        let v = *v && *z > 0.0;
        common += usize::from(*m && v);
        either += usize::from(*m || v);
    }
    f64::from(common as u32) / f64::from(either.max(1) as u32)
}

#[test]
fn found_from_all_sides_with_its_mask() {
    let (alone, with_mesh) = (both_ways(known(false)), both_ways(known(true)));
    let options = MttmOptions::default();
    for (i, (x, y, yaw)) in [(0.0, 0.0, 0.3), (0.15, 0.1, 2.0), (-0.18, -0.08, -2.4)].into_iter().enumerate()
    {
        let truth = on_table(x, y, yaw);
        let (depth, visible) = render_scene(&[(&part(), truth)], i as u64);
        let scene = prepared(&depth);
        let all = [
            (&alone[0], 6.0, 5.0),
            (&alone[1], 6.0, 5.0),
            (&with_mesh[0], 4.0, 3.0),
            (&with_mesh[1], 4.0, 3.0),
        ];
        for (object, millimetres, degrees) in all {
            let (found, stages) = estimate(&scene, object, &options);
            let best = found.first().unwrap_or_else(|| panic!("nothing found at {x} {y} {yaw}"));
            let (t, r) = off(best, &truth);
            assert!(t < millimetres && r < degrees, "{x} {y} {yaw}: {t:.1} mm, {r:.1} degrees");
            let overlap = iou(best, &visible, &depth);
            assert!(overlap > 0.75, "{x} {y} {yaw}: {overlap}");
            assert!(stages.sampled > 20 && stages.regions > 0, "{stages:?}");
        }
    }
}

/// No alignment repairs a match here: its turn in the image has to be the scene's, not the opposite one.
#[test]
fn the_best_match_has_the_rotation_of_the_image() {
    let mesh = part();
    let templates = ObjectTemplates::from_mesh(&mesh, &TemplateOptions::default()).unwrap();
    let matcher = Matcher::new(&templates, &MatchOptions::default());
    for (number, turn) in [(40, 0.6), (150, -0.6), (220, 0.35)] {
        let rotated = UnitQuaternion::from_axis_angle(&Vec3::z_axis(), turn);
        let roi = Roi { centre: Vec3::new(0.0, 0.0, 0.8) };
        let truth = Pose::new(rotated, roi.centre) * templates.templates[number].view_from_object;
        let mut frame = VisibilityBuffer::new(&camera());
        frame.render(&[SceneObject { mesh: &mesh, camera_from_object: truth }], &RenderOptions::default());
        let cells = roi.cells(&prepared(&frame.depth()), templates.size, |_| true);
        let entry = matcher.entries()[matcher.ranked(&[cells])[0].0.entry];
        let view = templates.templates[entry.template].view_from_object;
        let found = camera_from_view(&roi.camera_from_roi(), entry.turn) * view;
        let off = found.rotation_angle_to(&truth);
        assert!(off < 0.45, "template {number}, turn {turn}: off by {off}, found {entry:?}");
    }
}

/// Before any alignment: the network's word on a region beside the object's centre, paired with the nearest of its templates.
#[test]
fn the_network_predicts_offset_rotation_and_matching() {
    let mesh = part();
    let object = ObjectTemplates::from_mesh(&mesh, &TemplateOptions::default()).unwrap();
    let entries = Matcher::new(&object, &MatchOptions::default()).entries().to_vec();
    let model = std::sync::Arc::new(MttmModel::shipped().unwrap());
    let learned = Learned::new(model.clone(), &object, &entries);
    let (mut places, mut turns, mut sure, mut masks) = (vec![], vec![], vec![], vec![]);
    for k in 0..36 {
        let angle = f64::from(k) * 0.9;
        let truth = on_table(0.1 * angle.cos(), 0.05 * angle.sin(), 2.3 * angle);
        let (depth, visible) = render_scene(&[(&mesh, truth)], k as u64);
        let scene = prepared(&depth);
        let centre = truth.transform_point(&object.templates[0].view_from_object.inverse().translation());
        let beside = Vec3::new(angle.sin(), angle.cos(), 0.3).normalize() * (0.12 * object.diameter);
        let roi = Roi { centre: centre + beside };
        let camera_from_roi = roi.camera_from_roi();
        let pose_of = |e: &Entry| {
            camera_from_view(&camera_from_roi, e.turn) * object.templates[e.template].view_from_object
        };
        let angle_of = |e: &Entry| pose_of(e).rotation_angle_to(&truth);
        let mut order: Vec<usize> = (0..entries.len()).collect();
        order.sort_by(|a, b| angle_of(&entries[*a]).total_cmp(&angle_of(&entries[*b])));
        let region = model.encode(&[&Patch::of_scene(&scene, &roi, learned.size(), model.side(), |_| true)]);
        // About 20 degrees off, as the templates of the training are at most.
        let (right, wrong) = (entries[order[45]], entries[*order.last().unwrap()]);
        let output = model.compare(&region.select(&[0, 0]), &learned.templates(&[right, wrong]));
        let pose = learned.camera_from_view(&camera_from_roi, right.turn, &output[0]).unwrap()
            * object.templates[right.template].view_from_object;
        let found_centre = pose.transform_point(&truth.inverse().transform_point(&centre));
        places.push((found_centre - centre).norm() / beside.norm());
        turns.push(pose.rotation_angle_to(&truth) / angle_of(&right));
        sure.push(output[0].matching - output[1].matching);
        // Cells of the region that look at the object, and those that the mask head takes for it.
        let cells = roi.cells_on_grid(&scene, learned.size(), MAP, |p| visible.as_slice()[p]);
        let pairs: Vec<(bool, bool)> =
            cells.iter().zip(&output[0].mask).map(|(c, m)| (*c != UNKNOWN, *m > 0.5)).collect();
        let count = |of: fn(&(bool, bool)) -> bool| pairs.iter().filter(|p| of(p)).count() as f64;
        masks.push(count(|p| p.0 && p.1) / count(|p| p.0 || p.1));
    }
    let median = |values: &[f64]| {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        sorted[sorted.len() / 2]
    };
    println!("{places:.2?} {turns:.2?} {sure:.2?} {masks:.2?}");
    // Fractions of what is off without the prediction.
    assert!(median(&places) < 0.6, "{places:.2?}");
    // The rotation is better in most regions: by chance alone it would be in 18 of 36, and in 27 or more once in 500 times.
    assert!(turns.iter().filter(|t| **t < 1.0).count() >= 27, "{turns:.2?}");
    assert!(turns.iter().sum::<f64>() / 36.0 < 0.87, "{turns:.2?}");
    assert!(median(&masks) > 0.75, "{masks:.2?}");
    assert!(sure.iter().filter(|s| **s > 0.3).count() >= 24, "{sure:.2?}");
}

/// The published form, with the network that ships: masks come before any alignment, and poses from them.
#[test]
fn as_published_masks_come_first_and_poses_from_them() {
    let object = both_ways(known(true))[1].clone();
    let options = MttmOptions::published();
    assert_eq!((options.hypotheses, options.verified, options.masked), (5, 15, 50));
    let (mut overlaps, mut right) = (vec![], 0);
    for (i, (x, y, yaw)) in
        [(0.0, 0.0, 0.3), (0.15, 0.1, 2.0), (-0.18, -0.08, -2.4), (0.05, -0.1, 1.2)].into_iter().enumerate()
    {
        let truth = on_table(x, y, yaw);
        let (depth, visible) = render_scene(&[(&part(), truth)], i as u64);
        let scene = prepared(&depth);
        let (found, stages) = estimate(&scene, &object, &options);
        assert!(stages.sampled > 20 && stages.regions > 0, "{stages:?}");
        // Ranked by S_D S_B S_N alone (section 5.2.5).
        assert!(found.iter().all(|e| e.confidence == e.score.total), "{:?}", found.first().map(|e| e.score));
        let Some(best) = found.first() else { continue };
        overlaps.push(iou(best, &visible, &depth));
        let (t, r) = off(best, &truth);
        right += usize::from(t < 6.0 && r < 5.0);
        // Nothing is moved by alignment: the mask is the network's wherever the pose ends up.
        let unaligned = MttmOptions { align: false, ..options };
        let (again, _) = estimate(&scene, &object, &unaligned);
        if let Some(again) = again.iter().find(|e| e.template == best.template) {
            assert_eq!(again.mask, best.mask);
        }
    }
    println!("{overlaps:.2?} {right}");
    // Measured: 0.60, 0.49, 0.82, 0.87, and four poses of four.
    assert!(overlaps.iter().filter(|o| **o > 0.5).count() >= 3, "{overlaps:.2?}");
    assert!(right >= 3, "{right} of 4");
}

/// With the network that ships, and another object beside it.
#[test]
fn the_network_alone_gives_masks_that_no_alignment_changes() {
    let object = both_ways(known(true))[1].clone();
    let options = MttmOptions { masks: MaskSource::Network, min_score: 0.0, ..MttmOptions::default() };
    let alone = MttmOptions { align: false, ..options };
    let post = cuboid([-0.03, -0.03, 0.0], [0.03, 0.03, 0.09]);
    let (mut overlaps, mut right) = (vec![], 0);
    for (i, (x, y, yaw)) in
        [(0.0, 0.0, 0.3), (0.15, 0.1, 2.0), (-0.18, -0.08, -2.4), (0.05, -0.1, 1.2)].into_iter().enumerate()
    {
        let truth = on_table(x, y, yaw);
        let (depth, visible) =
            render_scene(&[(&part(), truth), (&post, on_table(-x + 0.02, 0.15, 0.4))], i as u64);
        let scene = prepared(&depth);
        // Without a mesh nothing but the network ranks them.
        let (by_network, stages) = estimate(&scene, &object.clone().without_mesh(), &alone);
        assert!(stages.regions > 0);
        overlaps.push(iou(&by_network[0], &visible, &depth));
        assert!((0.0..=1.0).contains(&by_network[0].confidence));
        let (found, _) = estimate(&scene, &object, &options);
        let (t, r) = off(&found[0], &truth);
        right += usize::from(t < 6.0 && r < 5.0);
        if let Some(same) = found.iter().find(|f| f.template == by_network[0].template) {
            assert_eq!(same.mask, by_network[0].mask);
        }
    }
    println!("{overlaps:.2?} {right}");
    // Measured: 0.65, 0.93, 0.90, 0.83; without matching again the third is 0.
    assert!(overlaps.iter().all(|o| *o > 0.5), "{overlaps:.2?}");
    assert!(right >= 3, "{right} of 4");
}

#[test]
fn a_template_that_reaches_into_the_table_is_no_match() {
    let block = cuboid([-0.05, -0.05, 0.0], [0.05, 0.05, 0.1]);
    let object = ObjectTemplates::from_mesh(&block, &TemplateOptions::default()).unwrap();
    // Its top lies askew in the table's plane, one edge above it and the rest below.
    let askew = UnitQuaternion::from_axis_angle(&Vec3::y_axis(), 0.35);
    let sunk = on_table(0.0, 0.0, 0.0)
        * Pose::new(askew, Vec3::zeros())
        * Pose::new(UnitQuaternion::identity(), Vec3::new(0.04, 0.0, -0.1));
    let options = VerificationOptions::default();
    let best = |depth: &DepthImage, pose: &Pose, options: &VerificationOptions| {
        let scene = prepared(depth);
        let seen = object.templates.iter().min_by(|a, b| {
            let angle = |t: &Template| {
                let view = *pose * t.view_from_object.inverse();
                let ray = UnitQuaternion::rotation_between(&Vec3::z(), &view.translation()).unwrap();
                (ray.inverse() * view.rotation()).transform_vector(&Vec3::z()).angle(&Vec3::z())
            };
            angle(a).total_cmp(&angle(b))
        });
        let template = seen.unwrap();
        let surface = Surface::new(template, object.size, 160);
        judge(&scene, &surface, &(*pose * template.view_from_object.inverse()), 0.01, options)
    };
    let empty = render_scene(&[], 1).0;
    let (ours, printed) = (
        best(&empty, &sunk, &options),
        best(&empty, &sunk, &VerificationOptions { occluders_have_edges: false, ..options }),
    );
    assert!(ours.occluded > 50 && ours.inliers > 50, "{ours:?}");
    assert!(ours.pierced * 10 > ours.occluded * 7 && printed.pierced == 0, "{ours:?} {printed:?}");
    assert!(ours.depth < 0.85 * printed.depth, "{ours:?} {printed:?}");
    let stands = on_table(0.0, 0.0, 0.0);
    let board = cuboid([0.0, -0.2, 0.15], [0.2, 0.2, 0.16]);
    let hidden = best(&render_scene(&[(&block, stands), (&board, stands)], 1).0, &stands, &options);
    assert!(hidden.occluded > 50 && hidden.pierced * 10 < hidden.occluded, "{hidden:?}");
}

/// The dissertation's failure: the centroid of what is seen is not that of the object. Here half of the object is hidden behind
/// a box in front of it.
#[test]
fn a_hidden_half_does_not_shift_the_pose() {
    let truth = on_table(0.0, 0.0, 0.3);
    let screen = cuboid([-0.05, -0.01, 0.0], [0.05, 0.01, 0.2]);
    // Nearer to the camera and to the right of the object's centre.
    let before = on_table(0.06, -0.085, 0.0);
    let (depth, visible) = render_scene(&[(&part(), truth), (&screen, before)], 5);
    let (_, whole) = render_scene(&[(&part(), truth)], 5);
    let count = |m: &Mask| m.as_slice().iter().filter(|v| **v).count() as f64;
    let fraction = count(&visible) / count(&whole);
    assert!((0.3..0.8).contains(&fraction), "the screen hides {fraction}");
    // The screen itself resembles parts of the object: it may be named as well, but the object must be among the first.
    let options = MttmOptions { max_instances: 3, ..MttmOptions::default() };
    for object in both_ways(known(true)) {
        let (found, _) = estimate(&prepared(&depth), &object, &options);
        let all: Vec<(f64, f64)> = found.iter().map(|e| off(e, &truth)).collect();
        let best = all.iter().position(|(t, r)| *t < 5.0 && *r < 4.0);
        let best = best.unwrap_or_else(|| panic!("mm and degrees off: {all:?}, {fraction:.2} seen"));
        // The centroid of the visible part lies centimetres from that of the whole.
        assert!(iou(&found[best], &visible, &depth) > 0.6);
    }
}

#[test]
fn absent_objects_are_not_found_with_high_confidence() {
    let box_alone = cuboid([-0.1, -0.07, 0.0], [0.1, 0.07, 0.09]);
    let sure = |found: &[MttmEstimate]| found.first().map_or(0.0, |e| e.confidence);
    for object in both_ways(known(true)) {
        let (depth, _) = render_scene(&[(&box_alone, on_table(0.0, 0.0, 0.5))], 3);
        let (wrong, _) = estimate(&prepared(&depth), &object, &MttmOptions::default());
        let truth = on_table(0.1, 0.0, 1.0);
        let (depth, _) = render_scene(&[(&part(), truth)], 3);
        let (right, _) = estimate(&prepared(&depth), &object, &MttmOptions::default());
        assert!(sure(&right) > sure(&wrong) + 0.15, "{} {}", sure(&right), sure(&wrong));
        // An empty table: nothing at all.
        let (depth, _) = render_scene(&[], 3);
        let (nothing, stages) = estimate(&prepared(&depth), &object.without_mesh(), &MttmOptions::default());
        assert!(nothing.is_empty() || sure(&nothing) < 0.3, "{}", sure(&nothing));
        assert!(stages.sampled < 400, "{}", stages.sampled);
    }
}

#[test]
fn one_masked_view_is_enough_to_find_it_elsewhere() {
    let first = on_table(-0.1, 0.05, 0.4);
    let (depth, mask) = render_scene(&[(&part(), first)], 8);
    let camera = camera();
    let view = DepthView { depth: &depth, camera: &camera, mask: &mask, camera_from_object: Some(first) };
    let templates = ObjectTemplates::from_depth(&[view], &TemplateOptions::default()).unwrap();
    let truth = on_table(0.12, -0.06, 0.6);
    let other = cuboid([-0.04, -0.04, 0.0], [0.04, 0.04, 0.12]);
    let (depth, visible) = render_scene(&[(&part(), truth), (&other, on_table(-0.12, 0.0, 0.2))], 9);
    for object in both_ways(KnownObject::new(templates, None)) {
        let (found, _) = estimate(&prepared(&depth), &object, &MttmOptions::default());
        let best = found.first().expect("found");
        let (t, r) = off(best, &truth);
        assert!(t < 12.0 && r < 8.0, "{t:.1} mm, {r:.1} degrees");
        assert!(iou(best, &visible, &depth) > 0.5);
    }
}

#[test]
fn a_large_mask_gives_the_size_of_the_right_one() {
    // A box behind the part, so that a large mask takes in more than the table.
    let (part, other) = (part(), cuboid([-0.05, -0.05, 0.0], [0.05, 0.05, 0.2]));
    let objects = [(&part, on_table(-0.1, 0.05, 0.4)), (&other, on_table(-0.08, 0.2, 0.1))];
    let (depth, mask) = render_scene(&objects, 8);
    let camera = camera();
    let size = |depth: &DepthImage, mask: &Mask| {
        let view = DepthView { depth, camera: &camera, mask, camera_from_object: None };
        ObjectTemplates::from_depth(&[view], &TemplateOptions::default()).unwrap().diameter
    };
    // As a camera without noise sees it.
    let mut frame = VisibilityBuffer::new(&camera);
    let [part, other] = objects.map(|(mesh, camera_from_object)| SceneObject { mesh, camera_from_object });
    frame.render(&[part, other], &RenderOptions::default());
    let truth = size(&frame.depth(), &mask);
    let right = check_mask(&depth, &camera, &mask).unwrap();
    assert!(
        (size(&depth, &right.mask) / truth - 1.0).abs() < 0.03,
        "{:.3}",
        size(&depth, &right.mask) / truth
    );
    for pixels in [2, 4, 6] {
        let large = mask.grown(pixels);
        let checked = check_mask(&depth, &camera, &large).unwrap();
        let (before, after) = (size(&depth, &large) / truth, size(&depth, &checked.mask) / truth);
        assert!((after - 1.0).abs() < 0.03 && before > 1.3, "{pixels}: {before:.3}, checked {after:.3}");
        assert!(checked.on_plane > 0.05 && checked.beyond_edges > 0.005, "{pixels}");
    }
    let huge = check_mask(&depth, &camera, &mask.grown(20));
    assert!(matches!(huge, Err(TemplateError::MaskTooLarge { .. })));
}

#[test]
fn same_result_at_any_number_of_threads() {
    let (depth, _) = render_scene(&[(&part(), on_table(0.02, 0.03, 1.1))], 2);
    let scene = prepared(&depth);
    for object in both_ways(known(true)) {
        let with = |threads: usize, masks| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let options = MttmOptions { masks, ..MttmOptions::default() };
            pool.install(|| estimate(&scene, &object, &options).0)
        };
        let alone = with(1, MaskSource::Aligned);
        assert_eq!(alone, with(3, MaskSource::Aligned));
        assert_eq!(with(1, MaskSource::Network), with(3, MaskSource::Network));
        // Nor does it matter what else is searched in the scene.
        let search = Search::new(&scene);
        let first = search.estimate(&object, &MttmOptions::default()).0;
        assert_eq!(first, alone);
        assert_eq!(search.estimate(&object, &MttmOptions::default()).0, alone);
    }
}

#[test]
fn two_of_a_kind_are_two() {
    let poses = [on_table(-0.12, 0.0, 0.4), on_table(0.13, 0.02, 2.2)];
    let (depth, _) = render_scene(&[(&part(), poses[0]), (&part(), poses[1])], 6);
    let options = MttmOptions { max_instances: 2, ..MttmOptions::default() };
    for object in both_ways(known(true)) {
        let (mut found, _) = estimate(&prepared(&depth), &object, &options);
        assert_eq!(found.len(), 2);
        found.sort_by(|a, b| {
            a.camera_from_object.translation().x.total_cmp(&b.camera_from_object.translation().x)
        });
        for (e, truth) in found.iter().zip(&poses) {
            let (t, r) = off(e, truth);
            assert!(t < 5.0 && r < 4.0, "{t:.1} mm, {r:.1} degrees");
        }
    }
}
