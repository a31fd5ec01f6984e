use super::*;
use proptest::prelude::*;
use sixfold_geometry::Vec2;

fn camera() -> Camera {
    Camera::new(100.0, 100.0, 31.5, 23.5, 64, 48).unwrap()
}

fn mesh(vertices: &[[f64; 3]], faces: &[[u32; 3]]) -> Mesh {
    Mesh::new(vertices.iter().map(|v| Vec3::from(*v)).collect(), faces.to_vec()).unwrap()
}

fn render(meshes: &[&Mesh], options: &RenderOptions) -> VisibilityBuffer {
    let mut frame = VisibilityBuffer::new(&camera());
    let objects: Vec<_> =
        meshes.iter().map(|mesh| SceneObject { mesh, camera_from_object: Pose::identity() }).collect();
    frame.render(&objects, options);
    frame
}

/// A sphere of latitude bands, radius 5 cm, half a metre away.
fn sphere() -> Mesh {
    let (rows, columns) = (24u32, 48u32);
    let mut vertices = vec![];
    for i in 0..=rows {
        let theta = std::f64::consts::PI * f64::from(i) / f64::from(rows);
        for j in 0..columns {
            let phi = std::f64::consts::TAU * f64::from(j) / f64::from(columns);
            let n = Vec3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos());
            vertices.push(n * 0.05 + Vec3::new(0.01, -0.005, 0.5));
        }
    }
    let mut faces = vec![];
    for i in 0..rows {
        for j in 0..columns {
            let k = (j + 1) % columns;
            let (a, b, c, d) =
                (i * columns + j, i * columns + k, (i + 1) * columns + j, (i + 1) * columns + k);
            faces.push([a, c, b]);
            faces.push([b, c, d]);
        }
    }
    Mesh::new(vertices, faces).unwrap()
}

/// The nearest hit of the pixel's ray by Moeller and Trumbore, with a margin that identifies hits near an
/// edge.
fn ray_cast(mesh: &Mesh, x: f64, y: f64) -> (Option<f64>, f64) {
    let direction = camera().unproject(&Vec2::new(x, y), 1.0);
    let mut best: Option<f64> = None;
    let mut margin = f64::INFINITY;
    for f in mesh.faces() {
        let [a, b, c] = f.map(|i| mesh.vertices()[i as usize]);
        let (e1, e2) = (b - a, c - a);
        let p = direction.cross(&e2);
        let det = e1.dot(&p);
        if det.abs() < 1e-12 {
            continue;
        }
        let s = -a;
        let u = s.dot(&p) / det;
        let q = s.cross(&e1);
        let v = direction.dot(&q) / det;
        let t = e2.dot(&q) / det;
        let inside = u.min(v).min(1.0 - u - v);
        margin = margin.min(inside.abs());
        if inside >= 0.0 && t > 0.0 && best.is_none_or(|z| t < z) {
            best = Some(t);
        }
    }
    (best, margin)
}

#[test]
fn depth_is_that_of_a_ray_caster() {
    let mesh = sphere();
    let frame = render(&[&mesh], &RenderOptions::default());
    let depth = frame.depth();
    let mut compared = 0;
    for y in 0..48 {
        for x in 0..64 {
            let (hit, margin) = ray_cast(&mesh, x as f64, y as f64);
            if margin < 1e-3 {
                continue;
            }
            let z = f64::from(depth[(x, y)]);
            assert!((hit.unwrap_or(0.0) - z).abs() < 1e-6, "({x}, {y}): {hit:?} against {z}");
            compared += usize::from(hit.is_some());
        }
    }
    assert!(compared > 200, "only {compared} pixels compared");
}

#[test]
fn a_shared_edge_is_covered_exactly_once() {
    // A square of two triangles whose common edge and outline pass exactly through pixel centres.
    let z = 1.0;
    let at = |x: f64, y: f64| [(x - 31.5) / 100.0 * z, (y - 23.5) / 100.0 * z, z];
    let corners = [at(10.0, 10.0), at(20.0, 10.0), at(20.0, 20.0), at(10.0, 20.0)];
    let one = mesh(&corners, &[[0, 1, 2]]);
    let other = mesh(&corners, &[[0, 2, 3]]);
    let count =
        |m: &Mesh| render(&[m], &RenderOptions::default()).mask(0).as_slice().iter().filter(|&&b| b).count();
    let both = mesh(&corners, &[[0, 1, 2], [0, 2, 3]]);
    assert_eq!(count(&one) + count(&other), count(&both));
    // Top-left rule: rows and columns 10..20, the right and bottom edge belong to the neighbours.
    assert_eq!(count(&both), 100);
    let frame = render(&[&both], &RenderOptions::default());
    let mask = frame.mask(0);
    assert!(mask[(10, 10)] && mask[(19, 19)] && !mask[(20, 10)] && !mask[(10, 20)]);
}

#[test]
fn the_nearer_object_hides_the_other() {
    let square =
        |z: f64, s: f64| mesh(&[[-s, -s, z], [s, -s, z], [s, s, z], [-s, s, z]], &[[0, 1, 2], [0, 2, 3]]);
    let (near, far) = (square(0.5, 0.05), square(1.0, 0.3));
    let frame = render(&[&far, &near], &RenderOptions::default());
    let full = render(&[&far], &RenderOptions::default()).mask(0);
    let (visible, front) = (frame.mask(0), frame.mask(1));
    let count = |m: &Mask| m.as_slice().iter().filter(|&&b| b).count();
    assert_eq!(count(&visible) + count(&front), count(&full));
    assert_eq!(frame.depth()[(31, 23)], 0.5);
    assert_eq!(frame.instances()[(31, 23)], Some(1));
    assert_eq!(frame.bounding_box(), Some(Rect { x: 2.0, y: 0.0, width: 60.0, height: 48.0 }));
}

#[test]
fn the_near_plane_cuts_a_triangle_that_passes_the_camera() {
    // A floor 10 cm below the camera, from one metre behind it to ten metres ahead.
    let floor = mesh(
        &[[-50.0, 0.1, -1.0], [50.0, 0.1, -1.0], [50.0, 0.1, 10.0], [-50.0, 0.1, 10.0]],
        &[[0, 1, 2], [0, 2, 3]],
    );
    let depth = render(&[&floor], &RenderOptions::default()).depth();
    for y in 25..48 {
        let expected = 0.1 * 100.0 / (y as f64 - 23.5);
        for x in [0, 31, 63] {
            let z = f64::from(depth[(x, y)]);
            if expected < 9.9 {
                assert!((z - expected).abs() < 1e-5 * expected, "row {y}: {z} against {expected}");
            }
        }
    }
    assert_eq!(depth[(31, 20)], 0.0);
    let behind = mesh(&[[-1.0, 0.0, -1.0], [1.0, 0.0, -1.0], [0.0, 1.0, -2.0]], &[[0, 1, 2]]);
    assert!(render(&[&behind], &RenderOptions::default()).bounding_box().is_none());
}

#[test]
fn one_thread_and_many_give_the_same_bytes() {
    let mesh = sphere();
    let serial = render(&[&mesh], &RenderOptions::default());
    let parallel = render(&[&mesh], &RenderOptions { parallel: true, ..Default::default() });
    assert_eq!(serial.inverse_depth, parallel.inverse_depth);
    assert_eq!(serial.triangle, parallel.triangle);
    assert!(serial.triangle.iter().any(|&t| t != NOTHING));
}

#[test]
fn a_used_frame_gives_what_a_new_one_gives() {
    let mesh = sphere();
    let mut used = VisibilityBuffer::new(&camera());
    let near =
        SceneObject { mesh: &mesh, camera_from_object: Pose::from_translation(Vec3::new(0.0, 0.0, -0.3)) };
    used.render(&[near], &RenderOptions::default());
    let here = SceneObject { mesh: &mesh, camera_from_object: Pose::identity() };
    used.render(&[here], &RenderOptions::default());
    assert_eq!(used.depth(), render(&[&mesh], &RenderOptions::default()).depth());
}

#[test]
fn culling_drops_the_far_side_only() {
    let mesh = sphere();
    let all = render(&[&mesh], &RenderOptions::default()).depth();
    let front = render(&[&mesh], &RenderOptions { culling: Culling::Back, ..Default::default() }).depth();
    assert_eq!(all, front);
    let inside_out =
        Mesh::new(mesh.vertices().to_vec(), mesh.faces().iter().map(|f| [f[0], f[2], f[1]]).collect())
            .unwrap();
    let back =
        render(&[&inside_out], &RenderOptions { culling: Culling::Back, ..Default::default() }).depth();
    assert!(back[(33, 22)] > all[(33, 22)] + 0.05);
}

#[test]
fn coordinates_normals_and_barycentrics_agree_with_depth() {
    let mesh = sphere();
    let pose = Pose::exp(&[0.01, 0.02, 0.03, 0.2, -0.1, 0.05].into());
    let objects = [SceneObject { mesh: &mesh, camera_from_object: pose }];
    let mut frame = VisibilityBuffer::new(&camera());
    frame.render(&objects, &RenderOptions::default());
    let coordinates = frame.object_coordinates(&objects);
    let normals = frame.normals(&objects);
    let surfaces = frame.surfaces(&objects);
    let mut checked = 0;
    for y in 0..48 {
        for x in 0..64 {
            let Some(s) = surfaces[(x, y)] else {
                assert!(coordinates[(x, y)][0].is_nan());
                assert_eq!(normals[(x, y)], [0.0; 3]);
                continue;
            };
            let p = Vec3::from(coordinates[(x, y)].map(f64::from));
            let f = mesh.faces()[s.face as usize];
            let from_weights: Vec3 =
                (0..3).map(|k| mesh.vertices()[f[k] as usize] * f64::from(s.barycentric[k])).sum();
            assert!((p - from_weights).norm() < 2e-5, "({x}, {y})");
            let pixel = camera().project(&pose.transform_point(&p)).unwrap();
            assert!((pixel - Vec2::new(x as f64, y as f64)).norm() < 1e-3);
            let outward = pose.transform_direction(&(p - Vec3::new(0.01, -0.005, 0.5)).normalize());
            assert!(outward.dot(&Vec3::from(normals[(x, y)].map(f64::from))) > 0.98);
            checked += 1;
        }
    }
    assert!(checked > 200);
}

proptest! {
    #[test]
    fn a_random_fan_covers_its_polygon_without_gaps_or_overlaps(
        cx in 5.0..58.0f64, cy in 5.0..42.0f64, radius in 2.0..30.0f64, corners in 3usize..12, phase in 0.0..6.0f64
    ) {
        // Each triangle is rendered alone: their pixels add up to those of all together.
        let at = |x: f64, y: f64| [(x - 31.5) / 100.0, (y - 23.5) / 100.0, 1.0];
        let mut vertices = vec![at(cx, cy)];
        for k in 0..corners {
            let a = phase + std::f64::consts::TAU * k as f64 / corners as f64;
            vertices.push(at(cx + radius * a.cos(), cy + radius * a.sin()));
        }
        let faces: Vec<[u32; 3]> =
            (0..corners as u32).map(|k| [0, 1 + k, 1 + (k + 1) % corners as u32]).collect();
        let count = |faces: &[[u32; 3]]| {
            render(&[&mesh(&vertices, faces)], &RenderOptions::default()).mask(0).as_slice().iter().filter(|&&b| b).count()
        };
        let alone: usize = faces.iter().map(|f| count(&[*f])).sum();
        prop_assert_eq!(alone, count(&faces));
    }

    #[test]
    fn wild_poses_never_panic(t in prop::array::uniform6(-3.0..3.0f64), scale in -6i32..6) {
        let mesh = sphere();
        let mut frame = VisibilityBuffer::new(&camera());
        let twist = nalgebra::Vector6::from(t) * 10f64.powi(scale);
        let objects = [SceneObject { mesh: &mesh, camera_from_object: Pose::exp(&twist) }];
        frame.render(&objects, &RenderOptions::default());
        for z in frame.depth().as_slice() {
            prop_assert!(z.is_finite() && *z >= 0.0);
        }
    }
}

#[test]
fn a_used_canvas_gives_what_a_new_image_gives() {
    let mesh = sphere();
    let mut frame = VisibilityBuffer::new(&camera());
    let mut depth = Canvas::new(1, 1, 0.0);
    let mut points = Canvas::new(1, 1, [f32::NAN; 3]);
    for t in [[0.0; 3], [0.05, -0.03, -0.2], [0.01, 0.01, 0.5], [50.0, 0.0, 0.0], [-0.1, 0.05, -0.1]] {
        let object = SceneObject { mesh: &mesh, camera_from_object: Pose::from_translation(t.into()) };
        frame.render(&[object], &RenderOptions::default());
        frame.depth_into(&mut depth);
        frame.object_coordinates_into(&[object], &mut points);
        assert!(depth.image() == &frame.depth());
        let bits = |p: &[f32; 3]| p.map(f32::to_bits);
        let fresh = frame.object_coordinates(&[object]);
        assert!(points.image().as_slice().iter().map(bits).eq(fresh.as_slice().iter().map(bits)));
    }
}

#[test]
fn faces_of_extreme_size_have_weights_and_finite_normals() {
    let camera = camera();
    let mut seen = 0;
    for size in [1e-300, 1e-160, 1e-80, 1e20, 1e76, 1e80, 1e154, 1e160, 1e300, 1e308] {
        for z in [0.5, 1e6, 1e30, size] {
            for corners in [
                [[-size, -size, z], [size, -size, z], [0.0, size, z]],
                [[-size, 0.0, z], [size, -1.0, z], [0.3, size, 1.5 * z]],
                [[0.0, 0.0, z], [size, size, z], [-1.0, size, size]],
            ] {
                let mesh = mesh(&corners, &[[0, 1, 2]]);
                let mesh = mesh.with_colors(vec![[255, 0, 0], [0, 255, 0], [0, 0, 255]]).unwrap();
                let objects = [SceneObject { mesh: &mesh, camera_from_object: Pose::identity() }];
                let mut frame = VisibilityBuffer::new(&camera);
                frame.render(&objects, &RenderOptions::default());
                for surface in frame.surfaces(&objects).as_slice().iter().flatten() {
                    let weights = surface.barycentric;
                    assert!(weights.iter().all(|w| (0.0..=1.0).contains(w)), "{corners:?}: {weights:?}");
                    assert!((weights.iter().sum::<f32>() - 1.0).abs() < 1e-5, "{corners:?}: {weights:?}");
                    seen += 1;
                }
                let normals = frame.normals(&objects);
                assert!(normals.as_slice().as_flattened().iter().all(|c| c.is_finite()), "{corners:?}");
                let lights = crate::Light::default_set();
                crate::shade(&frame, &objects, &lights, &crate::Material::default(), None);
            }
        }
    }
    assert!(seen > 10_000, "{seen}");
}
