//! Exact search for the nearest point of a surface: a tree of boxes around triangles, split at the median of the longest
//! side.
//!
//! The nearest point of one triangle after Ericson 2005 ("Real-Time Collision Detection", section 5.1.5). A mesh without
//! faces is searched as its vertices.

use sixfold_geometry::Vec3;

use crate::Mesh;
use crate::measure::triangle_area;

/// Maximum number of triangles in a leaf.
const LEAF: usize = 4;

/// A mesh prepared for the search of nearest points.
#[derive(Debug)]
pub(crate) struct Surface {
    nodes: Vec<Node>,
    /// Corners and the caller's index, in the order of the leaves.
    triangles: Vec<([Vec3; 3], u32)>,
}

/// A node of the tree: a box and its content.
#[derive(Debug, Clone, Copy)]
struct Node {
    low: Vec3,
    high: Vec3,
    /// For a leaf, its first triangle; for an inner node, its second child. The first child follows the node.
    next: u32,
    /// Triangles of a leaf, 0 for an inner node.
    count: u32,
}

/// A point of a surface.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SurfacePoint {
    pub point: Vec3,
    /// Distance from the query point, metres.
    pub distance: f64,
    /// The unit normal of its face, zero in a mesh without faces.
    pub normal: Vec3,
}

impl Surface {
    /// Prepares the faces of a mesh that have an area, or its vertices if no face has one.
    pub fn new(mesh: &Mesh) -> Surface {
        let corners = |face: usize| (mesh.triangle(face), face as u32);
        let mut triangles: Vec<_> =
            (0..mesh.faces().len()).map(corners).filter(|(t, _)| triangle_area(t) > 0.0).collect();
        if triangles.is_empty() {
            triangles = mesh.vertices().iter().enumerate().map(|(i, v)| ([*v; 3], i as u32)).collect();
        }
        let mut surface = Surface { nodes: Vec::with_capacity(triangles.len()), triangles: vec![] };
        surface.build(&mut triangles, 0);
        surface.triangles = triangles;
        surface
    }

    fn build(&mut self, triangles: &mut [([Vec3; 3], u32)], first: usize) {
        let (mut low, mut high) = (Vec3::repeat(f64::INFINITY), Vec3::repeat(f64::NEG_INFINITY));
        for corner in triangles.iter().flat_map(|(corners, _)| corners) {
            (low, high) = (low.inf(corner), high.sup(corner));
        }
        let node = self.nodes.len();
        self.nodes.push(Node { low, high, next: first as u32, count: triangles.len() as u32 });
        if triangles.len() <= LEAF {
            return;
        }
        let axis = (high - low).imax();
        let half = triangles.len() / 2;
        let place = |t: &([Vec3; 3], u32)| t.0.iter().map(|c| c[axis]).sum::<f64>();
        triangles.select_nth_unstable_by(half, |a, b| place(a).total_cmp(&place(b)).then(a.1.cmp(&b.1)));
        let (left, right) = triangles.split_at_mut(half);
        self.build(left, first);
        self.nodes[node].next = self.nodes.len() as u32;
        self.nodes[node].count = 0;
        self.build(right, first + half);
    }

    /// The nearest surface point to `p`, metres.
    pub fn nearest(&self, p: &Vec3) -> SurfacePoint {
        let mut best = (f64::INFINITY, *p, 0);
        self.search(p, 0, &mut best);
        let (squared, point, triangle) = best;
        let [a, b, c] = self.triangles[triangle].0;
        let normal = (b - a).cross(&(c - a)).try_normalize(0.0).unwrap_or_default();
        SurfacePoint { point, distance: squared.sqrt(), normal }
    }

    fn search(&self, p: &Vec3, node: usize, best: &mut (f64, Vec3, usize)) {
        let Node { next, count, .. } = self.nodes[node];
        let next = next as usize;
        if count > 0 {
            for (index, (corners, _)) in self.triangles.iter().enumerate().skip(next).take(count as usize) {
                let point = nearest_of_triangle(p, corners);
                let squared = (p - point).norm_squared();
                if squared < best.0 {
                    *best = (squared, point, index);
                }
            }
            return;
        }
        let (mut near, mut far) = ((self.off(p, node + 1), node + 1), (self.off(p, next), next));
        if far.0 < near.0 {
            std::mem::swap(&mut near, &mut far);
        }
        for (off, child) in [near, far] {
            if off < best.0 {
                self.search(p, child, best);
            }
        }
    }

    /// Squared distance to a node's box.
    fn off(&self, p: &Vec3, node: usize) -> f64 {
        let Node { low, high, .. } = &self.nodes[node];
        (p - p.sup(low).inf(high)).norm_squared()
    }
}

fn nearest_of_triangle(p: &Vec3, [a, b, c]: &[Vec3; 3]) -> Vec3 {
    let (ab, ac, ap) = (b - a, c - a, p - a);
    let (d1, d2) = (ab.dot(&ap), ac.dot(&ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return *a;
    }
    let bp = p - b;
    let (d3, d4) = (ab.dot(&bp), ac.dot(&bp));
    if d3 >= 0.0 && d4 <= d3 {
        return *b;
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return a + ab * (d1 / (d1 - d3));
    }
    let cp = p - c;
    let (d5, d6) = (ab.dot(&cp), ac.dot(&cp));
    if d6 >= 0.0 && d5 <= d6 {
        return *c;
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return a + ac * (d2 / (d2 - d6));
    }
    let va = d3 * d6 - d5 * d4;
    if va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        return b + (c - b) * ((d4 - d3) / (d4 - d3 + (d5 - d6)));
    }
    let sum = va + vb + vc;
    a + ab * (vb / sum) + ac * (vc / sum)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sixfold_geometry::random::{Random, stream, uniform};

    use super::*;

    fn point(random: &mut Random) -> Vec3 {
        Vec3::from_fn(|_, _| f64::from(uniform(random, [-1.0, 1.0])))
    }

    proptest! {
        /// No point of any triangle, on a grid of barycentric coordinates, is nearer; and the point is at the reported
        /// distance.
        #[test]
        fn nothing_is_nearer(seed in 0u64..10_000, count in 1usize..40) {
            let random = &mut stream(seed, 0);
            let vertices: Vec<Vec3> = (0..3 * count).map(|_| point(random)).collect();
            let faces = (0..count as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
            let mesh = Mesh::new(vertices, faces).unwrap();
            let p = point(random) * 2.0;
            let found = Surface::new(&mesh).nearest(&p);
            prop_assert!(((p - found.point).norm() - found.distance).abs() < 1e-12);
            let mut minimum = f64::INFINITY;
            for face in 0..count {
                let [a, b, c] = mesh.triangle(face);
                for (i, j) in (0..=20).flat_map(|i| (0..=20 - i).map(move |j| (i, j))) {
                    let (u, v) = (f64::from(i) / 20.0, f64::from(j) / 20.0);
                    minimum = minimum.min((p - (a * (1.0 - u - v) + b * u + c * v)).norm());
                }
            }
            prop_assert!(found.distance <= minimum + 1e-12, "{} {minimum}", found.distance);
            prop_assert!(found.distance >= minimum - 0.15, "{} {minimum}", found.distance);
        }
    }

    #[test]
    fn without_faces_the_nearest_vertex() {
        let mesh = Mesh::new(vec![Vec3::x(), Vec3::y(), Vec3::z()], vec![]).unwrap();
        let found = Surface::new(&mesh).nearest(&Vec3::new(0.1, 0.8, 0.0));
        assert_eq!((found.point, found.normal), (Vec3::y(), Vec3::zeros()));
    }
}
