//! The convex hull of a mesh's vertices by quickhull (Barber, Dobkin and Huhdanpaa 1996).
//!
//! The vertices are moved to the nearest points of a grid that is far finer than the tolerance. On the grid, the side of a face on
//! which a point lies is decided in integers, without error. The assumptions of the paper's proofs therefore hold in the program
//! too: the faces visible from a point are one connected patch and its horizon is one closed loop, however small and flat the faces
//! are. With rounding errors, hulls of smooth dense shapes would have holes and folds.

use std::collections::HashSet;

use sixfold_geometry::{Vec3, sphere_directions};

use crate::mesh::{Mesh, MeshError};

/// Points nearer to a face than this fraction of the extent count as on it. With a much larger value, points left out beside thin
/// shapes would be further than that outside of later, narrow faces.
const TOLERANCE: f64 = 1e-9;

/// Steps of the grid over the extent: a volume of three edges, 6 * 2^(3 * 40), is less than 2^127.
const STEPS: f64 = (1u64 << 40) as f64;

/// [`TOLERANCE`] in steps. It has to be well above the rounding errors of [`Face::height`], a few thousandths of a step.
const FLAT: f64 = TOLERANCE * STEPS;

/// Maximum number of times that the hull is computed again to remove corners in the interior of edges; once is nearly always
/// enough.
const REPETITIONS: usize = 8;

/// Number of directions whose furthest points are added first. These include the corners of boxes and similar shapes, so that few
/// points inside a flat side ever become corners, and most interior points are dropped at once.
const DIRECTIONS: usize = 64;

impl Mesh {
    /// The smallest convex body around the vertices, by quickhull (Barber, Dobkin and Huhdanpaa 1996), without colours.
    /// Its vertices are some of the mesh's, in metres; its faces are triangles that face outwards, and each edge belongs to two of
    /// them. Vertices less than a billionth of the extent (the longest side of the bounding box) outside of a face count as on it.
    /// The faces of the mesh are ignored.
    ///
    /// # Errors
    /// [`MeshError`] for a mesh whose vertices lie in a plane, on a line or in a point: its hull has no faces.
    pub fn convex_hull(&self) -> Result<Mesh, MeshError> {
        let points = on_grid(self);
        let all: Vec<u32> = (0..points.len() as u32).collect();
        let corners: Vec<u32> = sphere_directions(DIRECTIONS)
            .iter()
            .filter_map(|d| furthest(&points, &all, |p| p.dot(d)))
            .map(|(i, _)| i)
            .collect();
        let mut hull = Hull::of(&points, &corners, &all).ok_or(MeshError::Empty)?;
        for _ in 0..REPETITIONS {
            let Some(corners) = hull.corners_without_those_on_edges() else { break };
            let Some(again) = Hull::of(&points, &corners, &all) else { break };
            hull = again;
        }
        let mut numbers = vec![u32::MAX; points.len()];
        let mut vertices = vec![];
        let faces = hull.faces.iter().filter(|f| f.alive).map(|f| {
            f.corners.map(|i| {
                let number = &mut numbers[i as usize];
                if *number == u32::MAX {
                    *number = vertices.len() as u32;
                    vertices.push(self.vertices()[i as usize]);
                }
                *number
            })
        });
        let faces = faces.collect();
        Mesh::new(vertices, faces)
    }
}

/// A vertex in steps of the grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Point([i64; 3]);

impl Point {
    fn minus(self, other: Point) -> [i64; 3] {
        std::array::from_fn(|k| self.0[k] - other.0[k])
    }

    /// Without rounding: no more than 41 bits.
    fn offset_from(self, other: Point) -> Vec3 {
        Vec3::from(self.minus(other).map(|c| c as f64))
    }

    fn dot(self, direction: &Vec3) -> f64 {
        Vec3::from(self.0.map(|c| c as f64)).dot(direction)
    }
}

/// The vertices on the grid; all at one point for a mesh without extent.
fn on_grid(mesh: &Mesh) -> Vec<Point> {
    // Halved, so that the extent stays finite for coordinates near the largest number.
    let (low, high) = mesh.bounding_box();
    let (low, high) = (low * 0.5, high * 0.5);
    let extent = (high - low).amax();
    let step = |c: f64| if extent > 0.0 { (c / extent * STEPS).round() as i64 } else { 0 };
    mesh.vertices().iter().map(|v| Point((v * 0.5 - low).map(step).into())).collect()
}

/// The point with the largest value (the first of equal ones), and the value.
fn furthest(points: &[Point], among: &[u32], value: impl Fn(Point) -> f64) -> Option<(u32, f64)> {
    among
        .iter()
        .map(|&i| (i, value(points[i as usize])))
        .reduce(|best, new| if new.1 > best.1 { new } else { best })
}

/// Four points far from each other, ordered so that the fourth lies behind the face of the first three; `None` if all points lie in
/// a plane.
fn tetrahedron(points: &[Point], among: &[u32]) -> Option<[u32; 4]> {
    let best =
        |value: &dyn Fn(Point) -> f64| furthest(points, among, value).filter(|b| b.1 > FLAT).map(|b| b.0);
    let origin = points[*among.first()? as usize];
    let a = best(&|p| p.offset_from(origin).norm())?;
    let at = points[a as usize];
    let b = best(&|p| p.offset_from(at).norm())?;
    let along = points[b as usize].offset_from(at).normalize();
    let c = best(&|p| p.offset_from(at).cross(&along).norm())?;
    let face = Face::new(points, [a, b, c], [0; 3]);
    let d = best(&|p| face.height(p).abs() / face.length)?;
    Some(if face.height(points[d as usize]) > 0.0 { [a, c, b, d] } else { [a, b, c, d] })
}

/// A triangle of the hull.
struct Face {
    /// Counter-clockwise seen from outside.
    corners: [u32; 3],
    /// The faces across the edges from corner `k` to corner `k + 1`.
    neighbours: [u32; 3],
    /// A corner.
    at: Point,
    /// Outwards, of length `length`: the cross product of two edges, each number rounded once.
    normal: Vec3,
    length: f64,
    /// Points outside of this face by more than the tolerance that are not in the list of an earlier face.
    outside: Vec<u32>,
    /// Whether it still belongs to the hull.
    alive: bool,
}

impl Face {
    fn new(points: &[Point], corners: [u32; 3], neighbours: [u32; 3]) -> Face {
        let normal = Vec3::from(exact_normal(points, corners).map(|c| c as f64));
        let at = points[corners[0] as usize];
        Face { corners, neighbours, at, normal, length: normal.norm(), outside: vec![], alive: true }
    }

    /// The corner that lies on the longest edge, up to the tolerance.
    fn corner_on_edge(&self, points: &[Point]) -> Option<u32> {
        let [a, b, c] = self.corners;
        let opposite = [(a, b, c), (b, c, a), (c, a, b)];
        let length = |from: u32, to: u32| points[to as usize].offset_from(points[from as usize]).norm();
        let edges = opposite.map(|(corner, from, to)| (corner, length(from, to)));
        let (corner, longest) = edges.into_iter().reduce(|most, e| if e.1 > most.1 { e } else { most })?;
        (self.length <= FLAT * longest).then_some(corner)
    }

    /// How far a point lies outside, times [`Face::length`].
    fn height(&self, point: Point) -> f64 {
        self.normal.dot(&point.offset_from(self.at))
    }

    /// Whether a point lies outside by more than the tolerance.
    fn is_far_from(&self, point: Point) -> bool {
        self.height(point) > FLAT * self.length
    }

    /// Whether a point lies outside, decided without rounding errors.
    fn is_seen_by(&self, points: &[Point], point: Point) -> bool {
        let d = point.offset_from(self.at);
        let height = self.normal.dot(&d);
        // Each product has four roundings, each of 2^-53 at most.
        let error = 1e-15 * self.normal.abs().dot(&d.abs());
        if height.abs() > error {
            return height > 0.0;
        }
        let (normal, d) = (exact_normal(points, self.corners), point.minus(self.at));
        (0..3).map(|k| normal[k] * i128::from(d[k])).sum::<i128>() > 0
    }
}

fn exact_normal(points: &[Point], corners: [u32; 3]) -> [i128; 3] {
    let [a, b, c] = corners.map(|i| points[i as usize]);
    let (u, v) = (b.minus(a).map(i128::from), c.minus(a).map(i128::from));
    [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
}

/// A closed convex surface that grows point by point.
struct Hull<'a> {
    points: &'a [Point],
    /// All faces, including removed ones, which are no longer alive: a face keeps its number.
    faces: Vec<Face>,
    /// For every point of the horizon, the horizon edge that begins there; as long as `points`.
    begins: Vec<u32>,
}

impl<'a> Hull<'a> {
    /// The hull of `all`; the points of `first` are added first. `None` if all points lie in a plane.
    fn of(points: &'a [Point], first: &[u32], all: &[u32]) -> Option<Hull<'a>> {
        let corners = tetrahedron(points, first).or_else(|| tetrahedron(points, all))?;
        let mut hull = Hull::new(points, corners);
        hull.add(first);
        hull.add(all);
        Some(hull)
    }

    /// The corners without those that lie on an edge between two others, up to the tolerance; `None` if there are no such corners.
    ///
    /// The grid moves points on a line in a side by up to half a step, so a point in the middle of the line may be added first: it
    /// is as far outside as the others. The next point is then visible from only one of the two faces beside the line, and a face
    /// of three collinear points is inserted between them. On the grid this face is valid, but its normal is meaningless for the
    /// mesh. If the ends of the line are added first, the middle point is not far from any face.
    fn corners_without_those_on_edges(&self) -> Option<Vec<u32>> {
        let alive = || self.faces.iter().filter(|f| f.alive);
        let on_edges: HashSet<u32> = alive().filter_map(|f| f.corner_on_edge(self.points)).collect();
        if on_edges.is_empty() {
            return None;
        }
        let mut corners: Vec<u32> =
            alive().flat_map(|f| f.corners).filter(|i| !on_edges.contains(i)).collect();
        corners.sort_unstable();
        corners.dedup();
        Some(corners)
    }

    /// The tetrahedron whose fourth point lies behind the face of the first three.
    fn new(points: &'a [Point], [a, b, c, d]: [u32; 4]) -> Hull<'a> {
        let faces =
            [([a, b, c], [3, 2, 1]), ([a, c, d], [0, 2, 3]), ([c, b, d], [0, 3, 1]), ([b, a, d], [0, 1, 2])];
        let faces = faces.map(|(corners, neighbours)| Face::new(points, corners, neighbours)).into();
        Hull { points, faces, begins: vec![0; points.len()] }
    }

    /// Adds points until none lies outside.
    fn add(&mut self, among: &[u32]) {
        for &i in among {
            let point = self.points[i as usize];
            if let Some(face) = self.faces.iter_mut().find(|f| f.alive && f.is_far_from(point)) {
                face.outside.push(i);
            }
        }
        // New faces come at the end.
        let mut at = 0;
        while at < self.faces.len() {
            let face = &self.faces[at];
            if let Some((apex, _)) = furthest(self.points, &face.outside, |p| face.height(p)) {
                self.insert(apex, at as u32);
            }
            at += 1;
        }
    }

    /// Replaces the faces that are visible from a point, of which `first` is one, by a cone from their border to the point.
    fn insert(&mut self, apex: u32, first: u32) {
        let point = self.points[apex as usize];
        self.faces[first as usize].alive = false;
        let (mut patch, mut horizon) = (vec![first], vec![]);
        let mut next = 0;
        while next < patch.len() {
            let Face { corners, neighbours, .. } = self.faces[patch[next] as usize];
            next += 1;
            for k in 0..3 {
                let across = &mut self.faces[neighbours[k] as usize];
                if !across.alive {
                    // It is in the patch already.
                } else if across.is_seen_by(self.points, point) {
                    across.alive = false;
                    patch.push(neighbours[k]);
                } else {
                    self.begins[corners[k] as usize] = horizon.len() as u32;
                    horizon.push((corners[k], corners[(k + 1) % 3], neighbours[k]));
                }
            }
        }
        let (start, count) = (self.faces.len() as u32, horizon.len() as u32);
        let mut edge = 0;
        for k in 0..count {
            let (a, b, below) = horizon[edge as usize];
            let around = [below, start + (k + 1) % count, start + (k + count - 1) % count];
            self.faces.push(Face::new(self.points, [a, b, apex], around));
            let below = &mut self.faces[below as usize];
            for (corner, neighbour) in below.corners.iter().zip(&mut below.neighbours) {
                if *corner == b {
                    *neighbour = start + k;
                }
            }
            edge = self.begins[b as usize];
            debug_assert_eq!(edge == 0, k + 1 == count, "the horizon is not one loop");
        }
        for face in patch {
            for i in std::mem::take(&mut self.faces[face as usize].outside) {
                let point = self.points[i as usize];
                let cone = &mut self.faces[start as usize..];
                if let Some(face) = cone.iter_mut().find(|f| f.is_far_from(point)) {
                    face.outside.push(i);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sixfold_geometry::Pose;

    use super::*;

    fn volume(mesh: &Mesh) -> f64 {
        let corner = |f: &[u32; 3], k: usize| mesh.vertices()[f[k] as usize];
        mesh.faces().iter().map(|f| corner(f, 0).dot(&corner(f, 1).cross(&corner(f, 2))) / 6.0).sum()
    }

    /// The hull of points, after checking that it is one: a closed surface whose vertices are some of the points, with no point
    /// further outside of a face than twice the tolerance, which makes it convex at every edge too.
    fn hull_of(points: &[Vec3]) -> Mesh {
        let mesh = Mesh::new(points.to_vec(), vec![]).unwrap();
        let hull = mesh.convex_hull().unwrap();
        let edges: HashSet<(u32, u32)> =
            hull.faces().iter().flat_map(|f| [(f[0], f[1]), (f[1], f[2]), (f[2], f[0])]).collect();
        assert_eq!(edges.len(), 3 * hull.faces().len(), "an edge belongs to two faces the same way round");
        assert!(edges.iter().all(|(a, b)| edges.contains(&(*b, *a))), "the hull is not closed");
        assert_eq!(hull.vertices().len() + hull.faces().len(), edges.len() / 2 + 2, "not a sphere");
        let bits = |v: &Vec3| [v.x, v.y, v.z].map(f64::to_bits);
        let given: HashSet<_> = points.iter().map(bits).collect();
        assert!(hull.vertices().iter().all(|v| given.contains(&bits(v))), "a vertex that is not the mesh's");
        assert_eq!(hull.faces().as_flattened().iter().collect::<HashSet<_>>().len(), hull.vertices().len());
        let (low, high) = mesh.bounding_box();
        let extent = (high - low).amax();
        let unit = |v: &Vec3| (v - low) / extent;
        let inside: Vec<Vec3> = points.iter().map(unit).collect();
        for f in hull.faces() {
            let [a, b, c] = f.map(|i| unit(&hull.vertices()[i as usize]));
            let normal = (b - a).cross(&(c - a)).normalize();
            let out = inside.iter().map(|p| normal.dot(&(p - a))).fold(0.0, f64::max);
            assert!(out < 2.0 * TOLERANCE, "a point lies {out} of the extent outside of {a} {b} {c}");
        }
        assert_eq!(mesh.convex_hull().unwrap(), hull, "another hull the second time");
        hull
    }

    fn grid(steps: [usize; 3], size: [f64; 3]) -> Vec<Vec3> {
        let at = |k: usize, i: usize| size[k] * (i as f64 / steps[k] as f64 - 0.5);
        let mut points = vec![];
        for x in 0..=steps[0] {
            for y in 0..=steps[1] {
                points.extend((0..=steps[2]).map(|z| Vec3::new(at(0, x), at(1, y), at(2, z))));
            }
        }
        points
    }

    /// `bumpy_mesh(rings, sectors)` of the Python package's tests (`python/tests/scenes.py`): smooth and dense.
    fn bumpy(rings: usize, sectors: usize) -> Vec<Vec3> {
        let pi = std::f64::consts::PI;
        let mut points = vec![];
        for i in 0..rings {
            let t = 0.02 + (pi - 0.04) * i as f64 / (rings - 1) as f64;
            for j in 0..sectors {
                let p = 2.0 * pi * j as f64 / sectors as f64;
                let radius = 1.0
                    + 0.2 * (2.0 * p + 0.5).sin() * t.sin().powi(2)
                    + 0.15 * (3.0 * t).cos()
                    + 0.1 * p.sin() * (2.0 * t).sin();
                let direction = Vec3::new(t.sin() * p.cos(), t.sin() * p.sin(), t.cos());
                points.push(direction.component_mul(&Vec3::new(0.06, 0.045, 0.05)) * radius);
            }
        }
        points
    }

    #[test]
    fn a_smooth_dense_shape_has_the_hull_that_qhull_gives() {
        // `scipy.spatial.ConvexHull(bumpy_mesh(40, 80).vertices)` of SciPy 1.17.1 (Qhull): `len(.vertices)`,
        // `len(.simplices)`, `.area` and `.volume`.
        let hull = hull_of(&bumpy(40, 80));
        assert_eq!((hull.vertices().len(), hull.faces().len()), (1886, 3768));
        assert!((hull.surface_area() - 0.037584695780263175).abs() < 1e-12, "{}", hull.surface_area());
        assert!((volume(&hull) - 0.0006160262324594861).abs() < 1e-14, "{}", volume(&hull));
    }

    #[test]
    fn twenty_thousand_vertices() {
        // As above; `hull_of` would compare all points with all faces.
        let hull = Mesh::new(bumpy(100, 200), vec![]).unwrap().convex_hull().unwrap();
        assert_eq!((hull.vertices().len(), hull.faces().len()), (11289, 22574));
        assert!((hull.surface_area() - 0.03764631700320858).abs() < 1e-12, "{}", hull.surface_area());
        assert!((volume(&hull) - 0.0006178202667848074).abs() < 1e-14, "{}", volume(&hull));
    }

    #[test]
    fn a_cube_with_points_inside_and_on_its_sides_is_a_cube() {
        let cube = grid([12; 3], [0.1; 3]);
        for (twist, moved) in [([0.0; 3], 0.0), ([0.3, -0.5, 0.2], 0.0), ([1.0, 2.0, -0.4], 0.7)] {
            let pose = Pose::exp(&[moved, -moved, moved, twist[0], twist[1], twist[2]].into());
            let points: Vec<Vec3> = cube.iter().map(|p| pose.transform_point(p)).collect();
            for points in [points.iter().rev().copied().collect(), points] {
                let hull = hull_of(&points);
                assert_eq!((hull.vertices().len(), hull.faces().len()), (8, 12));
                assert!((volume(&hull) - 0.001).abs() < 1e-12, "{}", volume(&hull));
            }
        }
    }

    #[test]
    fn a_sphere_keeps_its_points_and_a_dent_is_filled() {
        let mut points = sphere_directions(500);
        for p in &mut points {
            *p *= if p.z > 0.8 { 0.03 } else { 0.05 };
        }
        let hull = hull_of(&points);
        let around = points.iter().filter(|p| p.norm() > 0.04).count();
        assert_eq!(hull.vertices().len(), around);
        let whole = 4.0 / 3.0 * std::f64::consts::PI * 0.05f64.powi(3);
        assert!(volume(&hull) > 0.85 * whole && volume(&hull) < whole, "{}", volume(&hull) / whole);
    }

    #[test]
    fn a_thin_plate_is_a_plate() {
        let pose = Pose::exp(&[0.1, 0.2, 0.3, 0.7, -0.2, 0.4].into());
        for thickness in [1e-3, 1e-5, 1e-7] {
            let plate = grid([30, 20, 1], [0.3, 0.2, thickness]);
            let rotated: Vec<Vec3> = plate.iter().map(|p| pose.transform_point(p)).collect();
            for points in [plate, rotated] {
                let hull = hull_of(&points);
                let expected = 0.3 * 0.2 * thickness;
                assert!((volume(&hull) - expected).abs() < 1e-2 * expected, "{} {expected}", volume(&hull));
                assert!(hull.vertices().len() < 20, "{}", hull.vertices().len());
            }
        }
        // A lens, flat but round: its centre is the furthest point in hardly any direction.
        let mut lens = sphere_directions(2000);
        lens.iter_mut().for_each(|p| p.z *= 1e-5);
        assert!(hull_of(&lens).vertices().len() > 1500);
    }

    #[test]
    fn duplicates_count_once() {
        let sphere = sphere_directions(300);
        let mut points = sphere.clone();
        points.extend(sphere.iter().rev());
        points.extend(sphere.iter().map(|p| p + Vec3::repeat(1e-14)));
        let hull = hull_of(&points);
        assert_eq!((hull.vertices().len(), hull.faces().len()), (300, 596));
    }

    #[test]
    fn meshes_without_a_volume_have_no_hull() {
        let pose = Pose::exp(&[0.1, 0.2, 0.3, 0.7, -0.2, 0.4].into());
        let sheet: Vec<Vec3> = grid([9, 7, 1], [0.3, 0.2, 0.0]);
        let rotated = sheet.iter().map(|p| pose.transform_point(p)).collect();
        let line = (0..50).map(|i| Vec3::new(0.1, -0.2, 0.3) * f64::from(i)).collect();
        let point = vec![Vec3::new(1.0, 2.0, 3.0); 20];
        let few = vec![Vec3::zeros(), Vec3::x(), Vec3::y()];
        for points in [sheet, rotated, line, point, few, vec![Vec3::x()]] {
            let hull = Mesh::new(points, vec![]).unwrap().convex_hull();
            assert_eq!(hull, Err(MeshError::Empty));
        }
    }

    #[test]
    fn any_size_that_numbers_have() {
        let sphere = sphere_directions(200);
        for size in [1e-300, 1e-20, 1e20, 1e300, 8e307] {
            let points: Vec<Vec3> = sphere.iter().map(|p| p * size).collect();
            assert_eq!(hull_of(&points).vertices().len(), 200);
        }
        let largest = Mesh::new(sphere.iter().map(|p| p * f64::MAX).collect(), vec![]).unwrap();
        assert_eq!(largest.convex_hull().unwrap().faces().len(), 396);
    }

    #[test]
    fn three_points_on_a_line_of_a_side() {
        let points = [[3, 3, 0], [1, 1, 3], [2, 1, 3], [1, 2, 2], [3, 3, 2], [3, 1, 3]];
        let corners = [[0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 3]];
        let twist = [0.0, 0.0, 0.0, -1.4599672017995113, -2.697340946748811, 1.6183936080282013];
        let pose = Pose::exp(&twist.into());
        let straight: Vec<Vec3> =
            points.iter().chain(&corners).map(|p| Vec3::from(p.map(f64::from))).collect();
        let rotated: Vec<Vec3> = straight.iter().map(|p| pose.transform_point(p)).collect();
        let volumes = [straight, rotated].map(|points| volume(&hull_of(&points)));
        assert!((volumes[0] - volumes[1]).abs() < 1e-6, "{volumes:?}");
    }

    proptest! {
        #[test]
        fn random_points_have_a_hull(
            points in prop::collection::vec(prop::array::uniform3(-1.0..1.0f64), 8..80),
            squeezed in prop::array::uniform3(-6..1i32),
        ) {
            let scale = Vec3::from(squeezed.map(|s| 10f64.powi(s)));
            let points: Vec<Vec3> = points.iter().map(|p| Vec3::from(*p).component_mul(&scale)).collect();
            hull_of(&points);
        }

        #[test]
        fn points_of_which_many_lie_in_planes_and_on_lines_have_a_hull(
            points in prop::collection::vec(prop::array::uniform3(0..4i32), 0..80),
            twist in prop::array::uniform6(-3.0..3.0f64),
        ) {
            // Its corners, so that there is a volume.
            let corners = [[0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 3]];
            let points = points.iter().chain(&corners).map(|p| Vec3::from(p.map(f64::from)));
            let straight: Vec<Vec3> = points.collect();
            let pose = Pose::exp(&twist.into());
            let rotated: Vec<Vec3> = straight.iter().map(|p| pose.transform_point(p)).collect();
            let volumes = [straight, rotated].map(|points| volume(&hull_of(&points)));
            prop_assert!((volumes[0] - volumes[1]).abs() < 1e-6, "{volumes:?}");
        }
    }
}
