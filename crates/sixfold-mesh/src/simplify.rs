//! Fewer triangles by edge collapse with quadric error metrics (Garland & Heckbert 1997).
//!
//! The plane quadrics are weighted by area; open borders are preserved by planes perpendicular to them (section 6 of the paper).
//! A collapse that would flip a face, or join parts that are not adjacent (the link condition of Dey et al. 1999), is skipped.

use std::cmp::Ordering;
use std::collections::{BinaryHeap, HashMap};

use nalgebra::Matrix3;
use sixfold_geometry::{KdTree, Vec3};

use crate::Mesh;
use crate::measure::position_key;

/// Weight of the plane at an open border relative to a face.
const BORDER_WEIGHT: f64 = 100.0;
/// A vertex with more faces than this is not collapsed once the work limit is reached.
const HUB: usize = 64;
/// The work limit, in visited faces: per face of the mesh, and in total. It is several times what the finest scans need. Without
/// it, the time would grow quadratically where thousands of faces keep meeting in one vertex.
const WORK: (u64, u64) = (200, 20_000_000);
/// If more than this many times the requested faces remain, repeated faces are removed.
const FAR_TOO_MANY: usize = 4;
/// Minimum cosine between a face's normals before and after a collapse.
const MIN_COSINE: f64 = 0.2;

/// The quadric `x^T A x + 2 b^T x + c`: a weighted sum of squared distances to planes.
#[derive(Debug, Clone, Copy)]
struct Quadric {
    a: Matrix3<f64>,
    b: Vec3,
    c: f64,
}

impl Quadric {
    fn zero() -> Self {
        Quadric { a: Matrix3::zeros(), b: Vec3::zeros(), c: 0.0 }
    }

    /// The plane through `point` with unit `normal`.
    fn plane(normal: &Vec3, point: &Vec3, weight: f64) -> Self {
        let d = -normal.dot(point);
        Quadric { a: normal * normal.transpose() * weight, b: normal * (d * weight), c: d * d * weight }
    }

    fn add(&mut self, other: &Quadric) {
        self.a += other.a;
        self.b += other.b;
        self.c += other.c;
    }

    fn error(&self, x: &Vec3) -> f64 {
        (x.dot(&(self.a * x)) + 2.0 * self.b.dot(x) + self.c).max(0.0)
    }
}

/// An edge that may be collapsed. The heap returns the cheapest first, with ties broken by vertex so that the result is
/// reproducible.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Candidate {
    cost: f64,
    vertices: [u32; 2],
    stamps: [u32; 2],
    target: Vec3,
}

impl Eq for Candidate {}

impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> Ordering {
        other.cost.total_cmp(&self.cost).then_with(|| other.vertices.cmp(&self.vertices))
    }
}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

struct Collapser {
    points: Vec<Vec3>,
    faces: Vec<[u32; 3]>,
    alive: Vec<bool>,
    /// The faces of each vertex; up to half of them may have been removed.
    faces_of: Vec<Vec<u32>>,
    /// How many faces in each vertex's list have been removed.
    gone_of: Vec<u32>,
    quadrics: Vec<Quadric>,
    stamps: Vec<u32>,
    heap: BinaryHeap<Candidate>,
    /// How many more faces may be visited before hubs are skipped.
    work: u64,
}

/// A mesh of at most `target_faces` faces that follows the shape of `mesh`. It may keep more when no edge is left that can be
/// collapsed without flipping a face, and returns a copy when there is nothing to do.
///
/// First, vertices at the same place are joined and faces without area removed. Each new vertex has the colour of the nearest
/// old one (with a texture, the texture's colour there). Normals are recomputed if the mesh had them; the texture is not kept.
pub fn simplify(mesh: &Mesh, target_faces: usize) -> Mesh {
    if mesh.faces().len() <= target_faces {
        return mesh.clone();
    }
    // Scale to a unit box, so that the tolerances do not depend on the size.
    let (low, high) = mesh.bounding_box();
    let size = (high - low).amax();
    if !(size > 0.0 && size.is_finite()) {
        return mesh.clone();
    }
    let mut collapser = Collapser::new(mesh, &low, size);
    collapser.run(target_faces);
    let small = collapser.into_mesh(mesh, &low, size);
    if small.faces().len() <= FAR_TOO_MANY * target_faces {
        return small;
    }
    let once = mesh.without_repeated_faces();
    if once.faces().len() < mesh.faces().len() { simplify(&once, target_faces) } else { small }
}

impl Collapser {
    fn new(mesh: &Mesh, low: &Vec3, size: f64) -> Self {
        let mut points = Vec::new();
        let mut index_of = HashMap::with_capacity(mesh.vertices().len());
        let welded: Vec<u32> = mesh
            .vertices()
            .iter()
            .map(|v| {
                *index_of.entry(position_key(v)).or_insert_with(|| {
                    points.push((v - low) / size);
                    (points.len() - 1) as u32
                })
            })
            .collect();
        let faces: Vec<[u32; 3]> = mesh
            .faces()
            .iter()
            .map(|face| face.map(|i| welded[i as usize]))
            .filter(|[a, b, c]| a != b && b != c && c != a)
            .collect();
        let mut collapser = Collapser {
            work: WORK.0 * faces.len() as u64 + WORK.1,
            faces_of: vec![Vec::new(); points.len()],
            gone_of: vec![0; points.len()],
            quadrics: vec![Quadric::zero(); points.len()],
            stamps: vec![0; points.len()],
            alive: vec![true; faces.len()],
            heap: BinaryHeap::new(),
            points,
            faces,
        };
        collapser.add_quadrics();
        collapser
    }

    fn corners(&self, face: [u32; 3]) -> [Vec3; 3] {
        face.map(|i| self.points[i as usize])
    }

    fn add_quadrics(&mut self) {
        // Each edge with the number of its faces and one of them.
        let mut edges: HashMap<[u32; 2], (u32, usize)> = HashMap::with_capacity(self.faces.len() * 2);
        for (index, &face) in self.faces.iter().enumerate() {
            let [a, b, c] = self.corners(face);
            let cross = (b - a).cross(&(c - a));
            let area = 0.5 * cross.norm();
            for k in 0..3 {
                self.faces_of[face[k] as usize].push(index as u32);
                let (i, j) = (face[k], face[(k + 1) % 3]);
                edges.entry([i.min(j), i.max(j)]).or_insert((0, index)).0 += 1;
            }
            if area > 0.0 {
                let quadric = Quadric::plane(&(cross / (2.0 * area)), &a, area);
                face.iter().for_each(|&i| self.quadrics[i as usize].add(&quadric));
            }
        }
        let mut edges: Vec<_> = edges.into_iter().collect();
        edges.sort_unstable();
        for ([i, j], (count, face)) in &edges {
            if *count != 1 {
                continue;
            }
            let [a, b, c] = self.corners(self.faces[*face]);
            let along = self.points[*j as usize] - self.points[*i as usize];
            let upright = along.cross(&(b - a).cross(&(c - a)));
            if let Some(normal) = upright.try_normalize(1e-30) {
                let weight = BORDER_WEIGHT * along.norm_squared();
                let quadric = Quadric::plane(&normal, &self.points[*i as usize], weight);
                self.quadrics[*i as usize].add(&quadric);
                self.quadrics[*j as usize].add(&quadric);
            }
        }
        for ([i, j], _) in edges {
            self.push(i, j);
        }
    }

    fn push(&mut self, i: u32, j: u32) {
        let mut quadric = self.quadrics[i as usize];
        quadric.add(&self.quadrics[j as usize]);
        let (p, q) = (self.points[i as usize], self.points[j as usize]);
        let midpoint = (p + q) * 0.5;
        let length = (p - q).norm();
        let mut best = [p, q, midpoint]
            .into_iter()
            .map(|x| (quadric.error(&x), x))
            .min_by(|x, y| x.0.total_cmp(&y.0))
            .unwrap_or((f64::INFINITY, midpoint));
        // Equation 1 of the paper, where the matrix is far from singular and the point stays near.
        let scale = quadric.a.trace();
        if quadric.a.determinant() > 1e-6 * (scale / 3.0).powi(3)
            && let Some(inverse) = quadric.a.try_inverse()
        {
            let x = -(inverse * quadric.b);
            let error = quadric.error(&x);
            if (x - midpoint).norm() < 2.0 * length && error <= best.0 {
                best = (error, x);
            }
        }
        // In flat regions, collapse short edges first.
        let cost = best.0 + 1e-12 * length * length;
        let stamps = [self.stamps[i as usize], self.stamps[j as usize]];
        self.heap.push(Candidate { cost, vertices: [i, j], stamps, target: best.1 });
    }

    fn run(&mut self, target_faces: usize) {
        let mut count = self.faces.len();
        while count > target_faces {
            let Some(candidate) = self.heap.pop() else { return };
            let [i, j] = candidate.vertices;
            if [self.stamps[i as usize], self.stamps[j as usize]] != candidate.stamps {
                continue;
            }
            let around = self.faces_of[i as usize].len() + self.faces_of[j as usize].len();
            if self.work == 0 && around > HUB {
                continue;
            }
            self.work = self.work.saturating_sub(around as u64);
            if self.may_collapse(i, j, &candidate.target) {
                count -= self.collapse(i, j, candidate.target);
                // The costs of all edges left there are computed again.
                self.work = self.work.saturating_sub(4 * around as u64);
            }
        }
    }

    /// The faces around a vertex.
    fn around(&self, i: u32) -> impl Iterator<Item = u32> + '_ {
        self.faces_of[i as usize].iter().copied().filter(|&f| self.alive[f as usize])
    }

    fn neighbours(&self, i: u32) -> Vec<u32> {
        let mut neighbours: Vec<u32> =
            self.around(i).flat_map(|f| self.faces[f as usize]).filter(|&v| v != i).collect();
        neighbours.sort_unstable();
        neighbours.dedup();
        neighbours
    }

    fn may_collapse(&self, i: u32, j: u32, target: &Vec3) -> bool {
        // The common neighbours of both vertices must be exactly the opposite vertices of the faces at the edge.
        let of_j = self.neighbours(j);
        let common = self.neighbours(i).iter().filter(|v| of_j.binary_search(v).is_ok()).count();
        let shared = self.around(i).filter(|&f| self.faces[f as usize].contains(&j)).count();
        if common != shared || shared == 0 {
            return false;
        }
        for (vertex, other) in [(i, j), (j, i)] {
            for f in self.around(vertex) {
                let face = self.faces[f as usize];
                if face.contains(&other) {
                    continue;
                }
                let normal = |[a, b, c]: [Vec3; 3]| (b - a).cross(&(c - a));
                let before = normal(self.corners(face));
                let after = normal(face.map(|v| if v == vertex { *target } else { self.points[v as usize] }));
                let product = before.norm() * after.norm();
                // A face without area cannot be flipped.
                if before.norm() > 0.0 && before.dot(&after) <= MIN_COSINE * product {
                    return false;
                }
            }
        }
        true
    }

    /// Records that a face of a vertex was removed. The vertex's list is compacted when half of its faces are gone; compacting
    /// for every removal would be slow at a vertex with thousands of faces.
    fn forget_one(&mut self, vertex: u32) {
        let (list, gone) = (&mut self.faces_of[vertex as usize], &mut self.gone_of[vertex as usize]);
        *gone += 1;
        if 2 * *gone as usize > list.len() {
            list.retain(|&f| self.alive[f as usize]);
            *gone = 0;
        }
    }

    /// Moves `i` to `target` and replaces `j` by it; returns how many faces were removed.
    fn collapse(&mut self, i: u32, j: u32, target: Vec3) -> usize {
        let mut gone = 0;
        self.points[i as usize] = target;
        let of_j = self.quadrics[j as usize];
        self.quadrics[i as usize].add(&of_j);
        for f in std::mem::take(&mut self.faces_of[j as usize]) {
            let face = self.faces[f as usize];
            if !self.alive[f as usize] {
                continue;
            }
            if face.contains(&i) {
                gone += 1;
                self.alive[f as usize] = false;
                for v in face {
                    self.forget_one(v);
                }
            } else {
                self.faces[f as usize] = face.map(|v| if v == j { i } else { v });
                self.faces_of[i as usize].push(f);
            }
        }
        self.stamps[i as usize] += 1;
        self.stamps[j as usize] += 1;
        for neighbour in self.neighbours(i) {
            self.push(i.min(neighbour), i.max(neighbour));
        }
        gone
    }

    fn into_mesh(self, mesh: &Mesh, low: &Vec3, size: f64) -> Mesh {
        let mut index_of = vec![u32::MAX; self.points.len()];
        let mut vertices = Vec::new();
        let mut faces = Vec::new();
        for (face, _) in self.faces.iter().zip(&self.alive).filter(|(_, alive)| **alive) {
            faces.push(face.map(|v| {
                let index = &mut index_of[v as usize];
                if *index == u32::MAX {
                    *index = vertices.len() as u32;
                    vertices.push(self.points[v as usize] * size + low);
                }
                *index
            }));
        }
        let colors = vertex_colors(mesh).map(|colors| {
            let old = KdTree::new(mesh.vertices());
            vertices.iter().map(|v| old.nearest(v).map_or([128; 3], |n| colors[n.index])).collect::<Vec<_>>()
        });
        let Ok(mut small) = Mesh::new(vertices, faces) else { return mesh.clone() };
        if mesh.normals().is_some() {
            let normals = small.vertex_normals();
            small = small.with_normals(normals).unwrap_or_else(|_| mesh.clone());
        }
        if let Some(colors) = colors {
            small = small.with_colors(colors).unwrap_or_else(|_| mesh.clone());
        }
        small
    }
}

/// The colour at each vertex: from the texture if there is one, else the vertex colours.
fn vertex_colors(mesh: &Mesh) -> Option<Vec<[u8; 3]>> {
    if let (Some(texture), Some(texcoords)) = (mesh.texture(), mesh.texcoords())
        && texture.width() > 0
        && texture.height() > 0
    {
        let pixel = |x: f32, size: usize| (((x - x.floor()) * size as f32) as usize).min(size - 1);
        let color =
            |[u, v]: &[f32; 2]| texture[(pixel(*u, texture.width()), pixel(1.0 - v, texture.height()))];
        return Some(texcoords.iter().map(color).collect());
    }
    mesh.colors().map(<[_]>::to_vec)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A closed sphere of radius 0.1 with red in the upper half, from a subdivided octahedron-like grid.
    fn sphere(rings: usize) -> Mesh {
        let (rows, columns) = (rings, 2 * rings);
        let mut vertices = vec![Vec3::new(0.0, 0.0, 0.1), Vec3::new(0.0, 0.0, -0.1)];
        for i in 1..rows {
            for j in 0..columns {
                let (t, p) = (
                    std::f64::consts::PI * i as f64 / rows as f64,
                    std::f64::consts::TAU * j as f64 / columns as f64,
                );
                vertices.push(Vec3::new(t.sin() * p.cos(), t.sin() * p.sin(), t.cos()) * 0.1);
            }
        }
        let at = |i: usize, j: usize| (2 + (i - 1) * columns + j % columns) as u32;
        let mut faces = Vec::new();
        for j in 0..columns {
            faces.push([0, at(1, j), at(1, j + 1)]);
            faces.push([1, at(rows - 1, j + 1), at(rows - 1, j)]);
            for i in 1..rows - 1 {
                faces.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
                faces.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
        let colors = vertices.iter().map(|v| if v.z > 0.0 { [255, 0, 0] } else { [0, 0, 255] }).collect();
        Mesh::new(vertices, faces).unwrap().with_colors(colors).unwrap()
    }

    /// Number of edges that do not border exactly two faces.
    fn open_edges(mesh: &Mesh) -> usize {
        let mut edges: HashMap<[u32; 2], u32> = HashMap::new();
        for face in mesh.faces() {
            for k in 0..3 {
                let (i, j) = (face[k], face[(k + 1) % 3]);
                *edges.entry([i.min(j), i.max(j)]).or_default() += 1;
            }
        }
        edges.values().filter(|n| **n != 2).count()
    }

    #[test]
    fn a_sphere_stays_a_closed_sphere() {
        let full = sphere(60);
        assert_eq!(open_edges(&full), 0);
        let small = simplify(&full, 1000);
        assert!((998..=1000).contains(&small.faces().len()), "{}", small.faces().len());
        assert_eq!(open_edges(&small), 0);
        assert!((small.diameter() / full.diameter() - 1.0).abs() < 0.02);
        assert!((small.surface_area() / full.surface_area() - 1.0).abs() < 0.01);
        for face in 0..small.faces().len() {
            let [a, b, c] = small.triangle(face);
            assert!((b - a).cross(&(c - a)).dot(&(a + b + c)) > 0.0, "face {face} looks inwards");
            assert!((a.norm() - 0.1).abs() < 0.002);
        }
        for (v, color) in small.vertices().iter().zip(small.colors().unwrap()) {
            assert!(v.z.abs() < 0.01 || (color[0] == 255) == (v.z > 0.0), "{v} {color:?}");
        }
        assert_eq!(simplify(&full, 1000), small, "not deterministic");
    }

    #[test]
    fn a_flat_square_keeps_its_outline() {
        let n = 20;
        let vertices = (0..=n)
            .flat_map(|y| (0..=n).map(move |x| Vec3::new(x as f64, y as f64, 0.0) / n as f64))
            .collect();
        let at = |x: u32, y: u32| y * (n + 1) + x;
        let faces = (0..n)
            .flat_map(|y| {
                (0..n).flat_map(move |x| {
                    [[at(x, y), at(x + 1, y), at(x + 1, y + 1)], [at(x, y), at(x + 1, y + 1), at(x, y + 1)]]
                })
            })
            .collect();
        let small = simplify(&Mesh::new(vertices, faces).unwrap(), 10);
        assert!(small.faces().len() <= 10);
        assert!((small.surface_area() - 1.0).abs() < 1e-6, "{}", small.surface_area());
        assert!((small.diameter() - 2f64.sqrt()).abs() < 1e-6);
    }

    /// Such meshes once took minutes: faces that all share three corners, or all meet in one vertex.
    #[test]
    fn two_hundred_thousand_faces_at_one_place_or_around_one_vertex_take_seconds() {
        let n = 200_000u32;
        let start = std::time::Instant::now();
        let triangle = vec![Vec3::zeros(), Vec3::x(), Vec3::y(), Vec3::z()];
        let same = Mesh::new(triangle, (0..n).map(|k| [k % 3, (k + 1) % 3, (k + 2) % 3]).collect()).unwrap();
        assert_eq!(simplify(&same, 4000).faces(), [[0, 1, 2]]);
        let around = |k: u32| f64::from(k) / f64::from(n) * std::f64::consts::TAU;
        let mut rim: Vec<Vec3> = (0..n).map(|k| Vec3::new(around(k).cos(), around(k).sin(), 0.0)).collect();
        rim.push(Vec3::z());
        let cone = Mesh::new(rim.clone(), (0..n).map(|k| [k, (k + 1) % n, n]).collect()).unwrap();
        assert_eq!(simplify(&cone, 4000).faces().len(), 4000);
        // The same points in a scattered order: long edges everywhere.
        let urchin = (0..n).map(|k| [k, (k * 7919 + 1) % n, n]).filter(|f| f[0] != f[1]).collect();
        simplify(&Mesh::new(rim, urchin).unwrap(), 4000);
        assert!(start.elapsed().as_secs() < 120, "{:?}", start.elapsed());
    }

    proptest! {
        #[test]
        fn any_soup_is_survived(points in prop::collection::vec(prop::array::uniform3(-1.0..1.0f64), 3..30),
                                raw in prop::collection::vec(prop::array::uniform3(0..30u32), 1..80),
                                target in 0..40usize) {
            let n = points.len() as u32;
            let faces: Vec<_> = raw.iter().map(|f| f.map(|i| i % n)).collect();
            let mesh = Mesh::new(points.into_iter().map(Vec3::from).collect(), faces).unwrap();
            let small = simplify(&mesh, target);
            prop_assert!(small.faces().len() <= mesh.faces().len());
        }

        #[test]
        fn nearest_is_nearest(points in prop::collection::vec(prop::array::uniform3(-1.0..1.0f64), 1..60),
                              query in prop::array::uniform3(-3.0..3.0f64)) {
            let points: Vec<Vec3> = points.into_iter().map(Vec3::from).collect();
            let query = Vec3::from(query);
            let found = KdTree::new(&points).nearest(&query).unwrap().index;
            let minimum = points.iter().map(|p| (p - query).norm_squared()).fold(f64::INFINITY, f64::min);
            prop_assert_eq!((points[found] - query).norm_squared(), minimum);
        }
    }
}
