//! Symmetries of solids with known symmetries: unchanged, in any pose, with noise, with holes, and with colours that break them.

use std::f64::consts::{PI, TAU};

use nalgebra::UnitQuaternion;
use proptest::prelude::*;
use sixfold_geometry::random::{Random, normal, stream, uniform};
use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::{FoundSymmetry, Mesh, SymmetryOptions, Verdict, find_symmetries, sure_symmetries};

/// A symmetry that has to be found; of the half turns perpendicular to a continuous axis, any one.
#[derive(Debug, Clone, Copy)]
enum Truth {
    Any(Vec3),
    Order(u32, Vec3),
    HalfTurnAcross(Vec3),
}

const NO_COLOR: [u8; 3] = [200, 200, 200];
const RED: [u8; 3] = [200, 20, 20];

/// A solid between two polygons (x, y) at two heights, `top` times as large at the upper height; counter-clockwise.
fn prism(polygon: &[(f64, f64)], height: f64, top: f64) -> Mesh {
    let n = polygon.len() as u32;
    let ring = |z: f64, scale: f64| polygon.iter().map(move |(x, y)| Vec3::new(x * scale, y * scale, z));
    let mut vertices: Vec<Vec3> = ring(-height / 2.0, 1.0).chain(ring(height / 2.0, top)).collect();
    vertices.extend([Vec3::new(0.0, 0.0, -height / 2.0), Vec3::new(0.0, 0.0, height / 2.0)]);
    let faces = (0..n).flat_map(|i| {
        let j = (i + 1) % n;
        [[i, j, n + j], [i, n + j, n + i], [2 * n, j, i], [2 * n + 1, n + i, n + j]]
    });
    Mesh::new(vertices, faces.collect()).unwrap()
}

fn regular(n: u32, radius: f64) -> Vec<(f64, f64)> {
    let corner = |i: u32| (TAU * f64::from(i) / f64::from(n)).sin_cos();
    (0..n).map(|i| (radius * corner(i).1, radius * corner(i).0)).collect()
}

/// A box, its sides in metres.
fn cuboid(x: f64, y: f64, z: f64) -> Mesh {
    let (x, y) = (x / 2.0, y / 2.0);
    prism(&[(-x, -y), (x, -y), (x, y), (-x, y)], z, 1.0)
}

/// A body of revolution about z from points (radius, height).
fn lathed(profile: &[(f64, f64)], sides: u32) -> Mesh {
    let ring = |(r, z): &(f64, f64)| {
        let (r, z) = (*r, *z);
        regular(sides, r).into_iter().map(move |(x, y)| Vec3::new(x, y, z))
    };
    let vertices: Vec<Vec3> = profile.iter().flat_map(ring).collect();
    let faces = (0..profile.len() as u32 - 1).flat_map(|row| {
        (0..sides).flat_map(move |i| {
            let (a, b) = (row * sides + i, row * sides + (i + 1) % sides);
            [[a, b, b + sides], [a, b + sides, a + sides]]
        })
    });
    Mesh::new(vertices, faces.collect()).unwrap()
}

fn cylinder() -> Mesh {
    lathed(&[(0.0, -0.05), (0.035, -0.05), (0.035, 0.05), (0.0, 0.05)], 48)
}

fn bottle() -> Mesh {
    lathed(&[(0.0, 0.0), (0.035, 0.0), (0.035, 0.1), (0.012, 0.13), (0.012, 0.16), (0.0, 0.16)], 48)
}

/// A cup with a wall.
fn cup() -> Mesh {
    let (r, wall, height) = (0.04, 0.004, 0.1);
    lathed(&[(0.0, 0.0), (r, 0.0), (r, height), (r - wall, height), (r - wall, wall), (0.0, wall)], 48)
}

/// A cup with a handle of this reach, on the side of x.
fn mug(reach: f64) -> Mesh {
    let bar = |x: f64, z: f64, length: f64, rise: f64| {
        let at = Pose::from_translation(Vec3::new(0.04 + x, 0.0, z));
        cuboid(length, 0.01, rise).transformed(&at)
    };
    let half = reach / 2.0;
    let handle = [bar(half, 0.08, reach, 0.01), bar(half, 0.02, reach, 0.01), bar(reach, 0.05, 0.01, 0.07)];
    Mesh::merged(&[&[cup()], handle.as_slice()].concat()).unwrap()
}

/// An L of two arms.
fn angle(first: f64, second: f64) -> Mesh {
    let w = 0.03;
    let parts = [cuboid(first, w, 0.04), cuboid(w, second, 0.04)];
    let shifts = [Vec3::new(first / 2.0, w / 2.0, 0.0), Vec3::new(w / 2.0, second / 2.0, 0.0)];
    let moved = |(part, shift): (&Mesh, &Vec3)| part.transformed(&Pose::from_translation(*shift));
    Mesh::merged(&parts.iter().zip(&shifts).map(moved).collect::<Vec<_>>()).unwrap()
}

fn tetrahedron() -> Mesh {
    let corners = [(1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0)];
    let vertices = corners.map(|(x, y, z)| Vec3::new(x, y, z) * 0.04).to_vec();
    Mesh::new(vertices, vec![[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]).unwrap()
}

fn ball() -> Mesh {
    let profile: Vec<(f64, f64)> = (0..=24)
        .map(|i| (PI * f64::from(i) / 24.0).sin_cos())
        .map(|(sin, cos)| (0.05 * sin, -0.05 * cos))
        .collect();
    lathed(&profile, 48)
}

/// The faces split until no side is longer than `length`; every corner has its own vertex.
fn cut(mesh: &Mesh, length: f64) -> Mesh {
    let mut open: Vec<[Vec3; 3]> = (0..mesh.faces().len()).map(|f| mesh.triangle(f)).collect();
    let mut vertices: Vec<Vec3> = vec![];
    let mut places = std::collections::HashMap::new();
    let mut faces = vec![];
    while let Some(t) = open.pop() {
        let side = |i: usize| (t[(i + 1) % 3] - t[i]).norm();
        let longest = (0..3).max_by(|a, b| side(*a).total_cmp(&side(*b))).unwrap();
        if side(longest) > length {
            let [a, b, c] = [0, 1, 2].map(|k| t[(longest + k) % 3]);
            let midpoint = (a + b) * 0.5;
            open.extend([[a, midpoint, c], [midpoint, b, c]]);
            continue;
        }
        faces.push(t.map(|p| {
            let key = [p.x, p.y, p.z].map(|c| (c * 1e7).round() as i64);
            *places.entry(key).or_insert_with(|| {
                vertices.push(p);
                vertices.len() as u32 - 1
            })
        }));
    }
    Mesh::new(vertices, faces).unwrap()
}

/// The mesh with noise of a standard deviation on every vertex, metres.
fn noisy(mesh: &Mesh, deviation: f64, seed: u64) -> Mesh {
    let random = &mut stream(seed, 1);
    let fine = cut(mesh, 0.006);
    let moved = |v: &Vec3| v + Vec3::from_fn(|_, _| f64::from(normal(random)) * deviation);
    let vertices: Vec<Vec3> = fine.vertices().iter().map(moved).collect();
    Mesh::new(vertices, fine.faces().to_vec()).unwrap()
}

/// The mesh with vertex colours; every face has its own vertices, so colours change exactly at the edges of faces.
fn painted(mesh: &Mesh, color: impl Fn(&Vec3) -> [u8; 3]) -> Mesh {
    let triangles: Vec<[Vec3; 3]> = (0..mesh.faces().len()).map(|f| mesh.triangle(f)).collect();
    let colors = triangles.iter().flat_map(|t| [color(&((t[0] + t[1] + t[2]) / 3.0)); 3]).collect();
    let faces = (0..triangles.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
    Mesh::new(triangles.concat(), faces).unwrap().with_colors(colors).unwrap()
}

fn any_pose(random: &mut Random) -> Pose {
    let mut vector = |scale: f32| Vec3::from_fn(|_, _| f64::from(uniform(random, [-scale, scale])));
    let rotation = UnitQuaternion::from_scaled_axis(vector(2.5));
    Pose::new(rotation, vector(0.3))
}

fn found(mesh: &Mesh, noise: f64) -> Vec<FoundSymmetry> {
    find_symmetries(mesh, &SymmetryOptions { noise, ..SymmetryOptions::default() }).unwrap()
}

fn sure(found: &[FoundSymmetry]) -> Vec<FoundSymmetry> {
    found.iter().filter(|s| s.by_shape == Verdict::Sure).copied().collect()
}

/// The angle between two lines, degrees.
fn degrees(a: &Vec3, b: &Vec3) -> f64 {
    a.cross(b).norm().atan2(a.dot(b).abs()).to_degrees()
}

/// Tolerance between found and right symmetries.
#[derive(Debug, Clone, Copy)]
struct Tolerance {
    degrees: f64,
    metres: f64,
}

const EXACT: Tolerance = Tolerance { degrees: 0.3, metres: 0.0003 };

/// Compares the sure symmetries of a mesh with the right ones, about a centre through which all axes run; returns the largest
/// errors, degrees and metres.
fn compare(
    name: &str,
    sure: &[FoundSymmetry],
    truth: &[Truth],
    centre: &Vec3,
    allowed: Tolerance,
) -> (f64, f64) {
    let short = |s: &FoundSymmetry| (s.order, s.axis.map(|c| (1e3 * c).round()).data.0[0], s.deviation);
    let listed: Vec<_> = sure.iter().map(short).collect();
    assert_eq!(sure.len(), truth.len(), "{name}: expected {truth:?}, found {listed:#?}");
    let mut worst = (0.0f64, 0.0f64);
    for t in truth {
        let of_truth = |s: &&FoundSymmetry| match t {
            Truth::Any(axis) => s.order.is_none().then(|| degrees(&s.axis, axis)),
            Truth::Order(n, axis) => (s.order == Some(*n)).then(|| degrees(&s.axis, axis)),
            Truth::HalfTurnAcross(axis) => (s.order == Some(2)).then(|| 90.0 - degrees(&s.axis, axis)),
        };
        let errors = sure.iter().filter_map(|s| Some((of_truth(&s)?, s)));
        let (error, s) = errors
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .unwrap_or_else(|| panic!("{name}: {t:?} is missing in {listed:#?}"));
        let off = (s.point - centre).cross(&s.axis).norm();
        assert!(error <= allowed.degrees, "{name}: {t:?} is {error} degrees off: {s:?}");
        assert!(off <= allowed.metres, "{name}: {t:?} is {off} m off: {s:?}");
        worst = (worst.0.max(error), worst.1.max(off));
    }
    worst
}

fn moved(truth: &[Truth], pose: &Pose) -> Vec<Truth> {
    let turn = |axis: &Vec3| pose.transform_direction(axis);
    let moved = |t: &Truth| match t {
        Truth::Any(axis) => Truth::Any(turn(axis)),
        Truth::Order(n, axis) => Truth::Order(*n, turn(axis)),
        Truth::HalfTurnAcross(axis) => Truth::HalfTurnAcross(turn(axis)),
    };
    truth.iter().map(moved).collect()
}

/// Half turns about `n` axes perpendicular to z, the first at `start` radians.
fn across(n: u32, start: f64) -> impl Iterator<Item = Truth> {
    (0..n).map(move |i| {
        let (sin, cos) = (start + PI * f64::from(i) / f64::from(n)).sin_cos();
        Truth::Order(2, Vec3::new(cos, sin, 0.0))
    })
}

fn prism_truth(n: u32) -> Vec<Truth> {
    std::iter::once(Truth::Order(n, Vec3::z())).chain(across(n, 0.0)).collect()
}

/// The diagonals of a cube, and of its sides.
fn diagonals() -> (Vec<Vec3>, Vec<Vec3>) {
    let signs = [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)];
    let space = signs.map(|(a, b)| Vec3::new(1.0, a, b).normalize()).to_vec();
    let plane = |s: f64| [Vec3::new(1.0, s, 0.0), Vec3::new(1.0, 0.0, s), Vec3::new(0.0, 1.0, s)];
    (space, [plane(1.0), plane(-1.0)].concat().iter().map(Vec3::normalize).collect())
}

/// Solids about the origin with their true symmetries.
fn solids() -> Vec<(&'static str, Mesh, Vec<Truth>)> {
    let z = Vec3::z();
    let axes = [Vec3::x(), Vec3::y(), z];
    let (space, plane) = diagonals();
    let of = |n: u32, axes: &[Vec3]| axes.iter().map(|a| Truth::Order(n, *a)).collect::<Vec<_>>();
    let parallelogram = [(-0.05, -0.02), (0.03, -0.02), (0.05, 0.02), (-0.03, 0.02)];
    vec![
        ("box", cuboid(0.06, 0.08, 0.11), of(2, &axes)),
        ("square prism", cuboid(0.06, 0.06, 0.11), [of(4, &[z]), across(4, 0.0).collect()].concat()),
        ("cube", cuboid(0.07, 0.07, 0.07), [of(4, &axes), of(3, &space), of(2, &plane)].concat()),
        ("triangular prism", prism(&regular(3, 0.04), 0.1, 1.0), prism_truth(3)),
        ("pentagonal prism", prism(&regular(5, 0.04), 0.06, 1.0), prism_truth(5)),
        ("hexagonal prism", prism(&regular(6, 0.04), 0.09, 1.0), prism_truth(6)),
        ("pyramid", prism(&regular(4, 0.04), 0.06, 0.2), of(4, &[z])),
        ("skewed prism", prism(&parallelogram, 0.06, 1.0), of(2, &[z])),
        ("tetrahedron", tetrahedron(), [of(3, &space), of(2, &axes)].concat()),
        ("cylinder", cylinder(), vec![Truth::Any(z), Truth::HalfTurnAcross(z)]),
        ("cone", lathed(&[(0.0, -0.03), (0.04, -0.03), (0.0, 0.07)], 48), vec![Truth::Any(z)]),
        ("bottle", bottle(), vec![Truth::Any(z)]),
        ("cup", cup(), vec![Truth::Any(z)]),
        ("ball", ball(), vec![]),
        ("mug", mug(0.03), vec![]),
        ("mug with a small handle", mug(0.015), vec![]),
        ("angle", angle(0.1, 0.07), vec![]),
        ("angle of equal arms", angle(0.08, 0.08), of(2, &[Vec3::new(1.0, 1.0, 0.0).normalize()])),
    ]
}

#[test]
fn known_solids_under_any_pose() {
    for (name, mesh, truth) in solids().into_iter().filter(|(name, ..)| *name != "ball") {
        for number in 0..2 {
            let pose = if number == 0 {
                Pose::identity()
            } else {
                any_pose(&mut stream(7, mesh.vertices().len() as u64))
            };
            let start = std::time::Instant::now();
            let all = found(&mesh.transformed(&pose), 0.0);
            let time = start.elapsed();
            // A solid of this list that is not symmetric is not nearly symmetric either.
            if truth.is_empty() {
                assert!(all.is_empty(), "{name}: {all:#?}");
            }
            let found = sure(&all);
            let (angle, way) = compare(name, &found, &moved(&truth, &pose), &pose.translation(), EXACT);
            eprintln!("{name}: {} found, {angle:.3} degrees, {:.4} mm, {time:?}", found.len(), 1e3 * way);
        }
    }
}

/// A prism with twelve sides is nearly round but keeps its order of twelve; an oval cup is nearly round too and keeps its half
/// turn.
#[test]
fn nearly_round() {
    let all = found(&prism(&regular(12, 0.04), 0.07, 0.8), 0.0);
    compare("twelve sides", &sure(&all), &[Truth::Order(12, Vec3::z())], &Vec3::zeros(), EXACT);
    assert!(all.iter().any(|s| s.order.is_none() && s.by_shape == Verdict::Likely), "{all:#?}");
    let round = bottle();
    let oval = round.vertices().iter().map(|v| Vec3::new(v.x * 1.08, v.y, v.z)).collect();
    let all = found(&Mesh::new(oval, round.faces().to_vec()).unwrap(), 0.0);
    compare("oval bottle", &sure(&all), &[Truth::Order(2, Vec3::z())], &Vec3::zeros(), EXACT);
    assert!(all.iter().any(|s| s.order.is_none() && s.by_shape == Verdict::Likely), "{all:#?}");
}

#[test]
fn a_ball_has_three_axes() {
    let pose = any_pose(&mut stream(3, 0));
    let found = found(&ball().transformed(&pose), 0.0);
    assert_eq!(found.len(), 3, "{found:#?}");
    assert!(found.iter().all(|s| s.order.is_none() && s.by_shape == Verdict::Sure));
    for (a, b) in [(0, 1), (0, 2), (1, 2)] {
        assert!(degrees(&found[a].axis, &found[b].axis) > 85.0);
    }
    assert!(found.iter().all(|s| (s.point - pose.translation()).norm() < 5e-4));
}

#[test]
fn noise_of_a_millimetre() {
    let allowed = Tolerance { degrees: 2.0, metres: 0.001 };
    let names = ["box", "square prism", "cylinder", "bottle", "mug", "angle", "hexagonal prism"];
    for (name, mesh, truth) in solids().into_iter().filter(|(name, ..)| names.contains(name)) {
        let pose = any_pose(&mut stream(11, truth.len() as u64));
        let found = sure(&found(&noisy(&mesh, 0.001, 5).transformed(&pose), 0.001));
        let (angle, way) = compare(name, &found, &moved(&truth, &pose), &pose.translation(), allowed);
        eprintln!("{name} with noise: {} found, {angle:.2} degrees, {:.2} mm", found.len(), 1e3 * way);
    }
}

/// Like a mesh from photographs: no bottom, noise, large triangles on one side and small ones on the other.
#[test]
fn without_a_bottom_and_unevenly_cut() {
    let allowed = Tolerance { degrees: 2.0, metres: 0.001 };
    let open = lathed(&[(0.035, 0.0), (0.035, 0.1), (0.012, 0.13), (0.012, 0.16), (0.0, 0.16)], 48);
    let half = |right: bool| {
        let faces = open.faces().iter().enumerate();
        let kept = faces.filter(|(f, _)| (open.triangle(*f)[0].x >= 0.0) == right).map(|(_, face)| *face);
        Mesh::new(open.vertices().to_vec(), kept.collect()).unwrap()
    };
    let random = &mut stream(2, 2);
    let mut rough = |mesh: Mesh| {
        let mut shift = |v: &Vec3| v + Vec3::from_fn(|_, _| f64::from(normal(random)) * 0.001);
        let vertices: Vec<Vec3> = mesh.vertices().iter().map(&mut shift).collect();
        Mesh::new(vertices, mesh.faces().to_vec()).unwrap()
    };
    let mesh = rough(Mesh::merged(&[cut(&half(true), 0.003), cut(&half(false), 0.02)]).unwrap());
    let found = sure(&found(&mesh, 0.001));
    compare("open bottle", &found, &[Truth::Any(Vec3::z())], &Vec3::zeros(), allowed);
}

/// A mesh without faces has the symmetries of its points.
#[test]
fn points_without_faces() {
    let points = cut(&cuboid(0.06, 0.08, 0.11), 0.004).vertices().to_vec();
    let mesh = Mesh::new(points, vec![]).unwrap();
    let found = sure(&found(&mesh, 0.001));
    let truth = [Vec3::x(), Vec3::y(), Vec3::z()].map(|axis| Truth::Order(2, axis));
    compare("points", &found, &truth, &Vec3::zeros(), Tolerance { degrees: 1.0, metres: 0.001 });
    assert!(found.iter().all(|s| s.color.is_none()));
}

#[test]
fn the_sure_symmetries_are_a_group() {
    let pose = any_pose(&mut stream(19, 0));
    for (name, size) in [("tetrahedron", 12), ("cube", 24), ("hexagonal prism", 12), ("box", 4)] {
        let mesh = solids().into_iter().find(|s| s.0 == name).unwrap().1.transformed(&pose);
        let (discrete, continuous) = sure_symmetries(&found(&mesh, 0.0), false);
        assert!(continuous.is_empty());
        assert_eq!(discrete.len() + 1, size, "{name}");
        let all: Vec<Pose> = std::iter::once(Pose::identity()).chain(discrete).collect();
        for (a, b) in all.iter().flat_map(|a| all.iter().map(move |b| (a, b))) {
            let product = *a * *b;
            let nearest = all.iter().map(|c| product.rotation_angle_to(c)).fold(f64::INFINITY, f64::min);
            assert!(nearest.to_degrees() < 0.5, "{name}: a product is {} degrees off", nearest.to_degrees());
        }
    }
}

#[test]
fn colours_break_symmetries() {
    // One red side: only the half turn about its normal is left.
    let solid = cut(&cuboid(0.06, 0.08, 0.11), 0.01);
    let boxed = painted(&solid, |p| if p.z > 0.0549 { RED } else { NO_COLOR });
    let all = found(&boxed, 0.0);
    assert_eq!(sure(&all).len(), 3);
    let with_color: Vec<&FoundSymmetry> =
        all.iter().filter(|s| s.by_shape_and_color == Verdict::Sure).collect();
    assert_eq!(with_color.len(), 1, "{all:#?}");
    assert!(degrees(&with_color[0].axis, &Vec3::z()) < 0.5);
    assert_eq!(all.iter().filter(|s| s.by_shape_and_color == Verdict::None).count(), 2);
    assert_eq!(sure_symmetries(&all, true).0.len(), 1);
    assert_eq!(sure_symmetries(&all, false).0.len(), 3);

    // A single colour: the same as by shape.
    let plain = painted(&solid, |_| RED);
    assert!(found(&plain, 0.0).iter().all(|s| s.by_shape_and_color == Verdict::Sure && s.color.is_some()));
}

#[test]
fn a_label_leaves_the_rotations_that_it_has() {
    let can = cut(&cylinder(), 0.006);
    // Two red labels on opposite sides of the can, each over a sixth of a turn.
    let labels = |count: f64| {
        painted(&can, |p| {
            let turn = p.y.atan2(p.x) / TAU * count;
            if p.xy().norm() > 0.034 && (turn - turn.round()).abs() < count / 12.0 { RED } else { NO_COLOR }
        })
    };
    let all = found(&labels(2.0), 0.0);
    let any = all.iter().find(|s| s.order.is_none()).unwrap();
    assert!(any.by_shape == Verdict::Sure && any.by_shape_and_color == Verdict::None, "{any:?}");
    let half = |s: &&FoundSymmetry| s.order == Some(2) && s.by_shape_and_color == Verdict::Sure;
    let kept: Vec<&FoundSymmetry> = all.iter().filter(half).collect();
    // About the can's axis, and perpendicular to it through the labels or between them.
    assert!(kept.iter().any(|s| degrees(&s.axis, &Vec3::z()) < 0.5), "{all:#?}");
    let flip = kept.iter().find(|s| degrees(&s.axis, &Vec3::z()) > 89.0).unwrap();
    let through = degrees(&flip.axis, &Vec3::x()).min(degrees(&flip.axis, &Vec3::y()));
    assert!(through < 6.0, "{through}");

    // One label: no symmetry about the axis, one half turn perpendicular to it.
    let all = found(&labels(1.0), 0.0);
    let with_color: Vec<&FoundSymmetry> =
        all.iter().filter(|s| s.by_shape_and_color == Verdict::Sure).collect();
    assert_eq!(with_color.len(), 1, "{all:#?}");
    assert!(degrees(&with_color[0].axis, &Vec3::x()) < 6.0);
}

#[test]
fn the_same_mesh_gives_the_same() {
    let mesh = noisy(&cuboid(0.06, 0.06, 0.11), 0.0005, 1);
    assert_eq!(found(&mesh, 0.0005), found(&mesh, 0.0005));
}

#[test]
fn options_out_of_range_are_refused() {
    let refused = |options: SymmetryOptions| find_symmetries(&ball(), &options).unwrap_err().to_string();
    let noise = refused(SymmetryOptions { noise: f64::NAN, ..SymmetryOptions::default() });
    assert_eq!(noise, "option noise: found NaN, expected 0 to 0.02 m");
    // For a ball of 10 cm.
    let noise = refused(SymmetryOptions { noise: 0.003, ..SymmetryOptions::default() });
    assert_eq!(noise, "option noise: found 0.003, expected at most a fiftieth of the object's diameter");
    assert!(refused(SymmetryOptions { samples: 3, ..SymmetryOptions::default() }).contains("samples"));
}

#[test]
fn meshes_without_a_shape() {
    let point = Mesh::new(vec![Vec3::x()], vec![]).unwrap();
    assert!(found(&point, 0.0).is_empty());
    // A square sheet and a line of points are flat and straight, but still symmetric.
    let sheet = Mesh::new(
        vec![Vec3::zeros(), Vec3::x() * 0.1, Vec3::new(0.1, 0.1, 0.0), Vec3::y() * 0.1],
        vec![[0, 1, 2], [0, 2, 3]],
    );
    // Only points near the border determine the rotation within its plane.
    let allowed = Tolerance { degrees: 1.0, metres: 0.001 };
    let found_in_sheet = sure(&found(&sheet.unwrap(), 0.0));
    let truth: Vec<Truth> = std::iter::once(Truth::Order(4, Vec3::z())).chain(across(4, 0.0)).collect();
    compare("sheet", &found_in_sheet, &truth, &Vec3::new(0.05, 0.05, 0.0), allowed);
    let line = Mesh::new((0..200).map(|i| Vec3::x() * (f64::from(i) * 5e-4)).collect(), vec![]).unwrap();
    assert!(found(&line, 0.0).iter().any(|s| s.order.is_none() && degrees(&s.axis, &Vec3::x()) < 0.5));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(10))]

    /// The symmetries of a moved mesh are the moved symmetries.
    #[test]
    fn symmetries_move_with_the_mesh(seed in 0u64..1_000_000, which in 0usize..18) {
        let (name, mesh, truth) = solids().swap_remove(which);
        prop_assume!(name != "ball");
        let pose = any_pose(&mut stream(seed, 0));
        let found = sure(&found(&mesh.transformed(&pose), 0.0));
        compare(name, &found, &moved(&truth, &pose), &pose.translation(), EXACT);
    }
}
