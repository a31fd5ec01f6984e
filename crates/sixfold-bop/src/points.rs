//! The points of an object model, laid out for the pose errors: structure of arrays in k-d tree order.
//!
//! One tree serves two purposes. A leaf's bounding box bounds the distance of everything in it, which finds
//! nearest neighbours (ADI); and a node's bounding ball bounds how far a motion can move anything in it,
//! which finds the vertex that moves furthest (MSSD) without visiting most vertices. Both are exact.

use sixfold_geometry::{Mat3, Vec3};

/// Points in a leaf of the tree, which a search for the nearest neighbour tests one by one.
const LEAF_SIZE: usize = 24;
/// Testing this many points is cheaper than computing the bounds of their parts.
const WHOLE_SIZE: usize = 128;

/// A node of the tree: a range of nearby points, with a box and a ball around them.
#[derive(Debug, Clone)]
pub(crate) struct Node {
    low: [f64; 3],
    high: [f64; 3],
    pub center: Vec3,
    pub radius: f64,
    pub start: usize,
    pub end: usize,
    /// Index of the left child; the right child follows it. Zero for a leaf.
    children: usize,
}

/// An upper bound on the spectral norm of `a` (the largest factor by which it lengthens a vector): the Schatten norm
/// of order 8. For the difference of two rotations it is at most 9 % larger than the spectral norm.
pub(crate) fn stretch(a: &Mat3) -> f64 {
    let squared = a.transpose() * a;
    let fourth = squared * squared;
    fourth.norm_squared().sqrt().sqrt().sqrt()
}

/// The points of an object model with what the pose errors need to be fast.
#[derive(Debug, Clone)]
pub struct ModelPoints {
    pub(crate) x: Vec<f64>,
    pub(crate) y: Vec<f64>,
    pub(crate) z: Vec<f64>,
    nodes: Vec<Node>,
}

impl ModelPoints {
    /// Prepares points in metres in the object's frame; `None` when there is no point or one is not finite.
    pub fn new(points: &[Vec3]) -> Option<Self> {
        if points.is_empty() || !points.iter().all(|p| p.iter().all(|c| c.is_finite())) {
            return None;
        }
        let mut sorted = points.to_vec();
        let mut nodes = Vec::with_capacity(2 * points.len() / LEAF_SIZE + 1);
        nodes.push(bounds(&sorted, 0, points.len()));
        let mut todo = vec![0];
        while let Some(index) = todo.pop() {
            let (start, end) = (nodes[index].start, nodes[index].end);
            if end - start <= LEAF_SIZE {
                continue;
            }
            let extent = |axis: usize| nodes[index].high[axis] - nodes[index].low[axis];
            let axis = (0..3).fold(0, |best, a| if extent(a) > extent(best) { a } else { best });
            let half = (end - start) / 2;
            sorted[start..end].select_nth_unstable_by(half, |a, b| a[axis].total_cmp(&b[axis]));
            let children = nodes.len();
            nodes[index].children = children;
            nodes.push(bounds(&sorted, start, start + half));
            nodes.push(bounds(&sorted, start + half, end));
            todo.extend([children, children + 1]);
        }
        Some(ModelPoints {
            x: sorted.iter().map(|p| p.x).collect(),
            y: sorted.iter().map(|p| p.y).collect(),
            z: sorted.iter().map(|p| p.z).collect(),
            nodes,
        })
    }

    /// Number of points; never zero.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.x.len()
    }

    /// Point number `i` in the prepared order.
    pub(crate) fn point(&self, i: usize) -> Vec3 {
        Vec3::new(self.x[i], self.y[i], self.z[i])
    }

    /// The maximum over all points of a number per point, or any number above `give_up` once the maximum is known to
    /// be above it.
    ///
    /// `bound(node)` is an upper bound on the square root of that number for the points of the node, `largest(node)`
    /// the maximum of the number in a small node. Nodes that cannot exceed the best point so far are skipped.
    pub(crate) fn largest(
        &self,
        give_up: f64,
        bound: impl Fn(&Node) -> f64,
        largest: impl Fn(&Node) -> f64,
    ) -> f64 {
        // A balanced tree over at most 2^32 points has fewer levels than this.
        let mut stack = [(f64::INFINITY, 0usize); 64];
        let mut depth = 1;
        let (mut best, mut needed) = (0.0f64, f64::NEG_INFINITY);
        while depth > 0 && best <= give_up {
            depth -= 1;
            let (limit, index) = stack[depth];
            // The margin keeps rounding in the bound from skipping a point.
            if limit * (1.0 + 1e-9) < needed {
                continue;
            }
            let node = &self.nodes[index];
            if node.end - node.start <= WHOLE_SIZE {
                best = best.max(largest(node));
                needed = best.sqrt();
                continue;
            }
            let left = (bound(&self.nodes[node.children]), node.children);
            let right = (bound(&self.nodes[node.children + 1]), node.children + 1);
            let (small, large) = if left.0 <= right.0 { (left, right) } else { (right, left) };
            stack[depth] = small;
            stack[depth + 1] = large;
            depth += 2;
        }
        best
    }

    /// The largest `|a p + b|^2` over all points, or any number above `give_up` once the maximum is known to be above
    /// it.
    pub(crate) fn largest_squared(&self, a: &Mat3, b: &Vec3, give_up: f64) -> f64 {
        let stretch = stretch(a);
        let in_leaf = |leaf: &Node| {
            let points = leaf.start..leaf.end;
            points.map(|i| (a * self.point(i) + b).norm_squared()).fold(0.0, f64::max)
        };
        self.largest(give_up, |node| (a * node.center + b).norm() + stretch * node.radius, in_leaf)
    }

    /// The mean of `|a p + b|` over all points.
    pub(crate) fn mean_norm(&self, a: &Mat3, b: &Vec3) -> f64 {
        // Eight fixed partial sums: the compiler may use vector registers, the result is always the same.
        const LANES: usize = 8;
        // With a = q r, q orthogonal and r upper triangular, |a p + b| = |r p + q^T b|: a third fewer
        // multiplications.
        let (q, r) = a.qr().unpack();
        let c = q.transpose() * b;
        let mut sums = [0.0f64; LANES];
        let term = |x: f64, y: f64, z: f64| {
            let dx = r.m11 * x + r.m12 * y + (r.m13 * z + c.x);
            let dy = r.m22 * y + (r.m23 * z + c.y);
            let dz = r.m33 * z + c.z;
            (dx * dx + dy * dy + dz * dz).sqrt()
        };
        let (xs, x_rest) = self.x.as_chunks::<LANES>();
        let (ys, y_rest) = self.y.as_chunks::<LANES>();
        let (zs, z_rest) = self.z.as_chunks::<LANES>();
        for ((x, y), z) in xs.iter().zip(ys).zip(zs) {
            for lane in 0..LANES {
                sums[lane] += term(x[lane], y[lane], z[lane]);
            }
        }
        for (lane, ((&x, &y), &z)) in x_rest.iter().zip(y_rest).zip(z_rest).enumerate() {
            sums[lane] += term(x, y, z);
        }
        sums.iter().sum::<f64>() / self.len() as f64
    }

    /// The mean distance from every point of `queries`, moved to `rotation p + translation`, to the nearest of these
    /// points, exactly.
    pub(crate) fn mean_nearest(&self, queries: &ModelPoints, rotation: &Mat3, translation: &Vec3) -> f64 {
        let mut total = 0.0;
        let mut last = 0;
        for i in 0..queries.len() {
            let query = rotation * queries.point(i) + translation;
            // Two first guesses that are close in practice: the point itself and the nearest neighbour of the
            // previous point.
            let same = i.min(self.len() - 1);
            let own = (self.point(same) - query).norm_squared();
            let before = (self.point(last) - query).norm_squared();
            let mut best = if own < before { (own, same) } else { (before, last) };
            self.nearest(&query, &mut best);
            last = best.1;
            total += best.0.sqrt();
        }
        total / queries.len() as f64
    }

    fn nearest(&self, query: &Vec3, best: &mut (f64, usize)) {
        // A balanced tree over at most 2^32 points has fewer levels than this.
        let mut stack = [(0.0f64, 0usize); 64];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (distance, index) = stack[depth];
            if distance >= best.0 {
                continue;
            }
            let node = &self.nodes[index];
            if node.children == 0 {
                for i in node.start..node.end {
                    let (dx, dy, dz) = (self.x[i] - query.x, self.y[i] - query.y, self.z[i] - query.z);
                    let squared = dx * dx + dy * dy + dz * dz;
                    if squared < best.0 {
                        *best = (squared, i);
                    }
                }
                continue;
            }
            let left = (self.box_distance(node.children, query), node.children);
            let right = (self.box_distance(node.children + 1, query), node.children + 1);
            let (near, far) = if left.0 <= right.0 { (left, right) } else { (right, left) };
            stack[depth] = far;
            stack[depth + 1] = near;
            depth += 2;
        }
    }

    fn box_distance(&self, index: usize, query: &Vec3) -> f64 {
        let node = &self.nodes[index];
        let mut squared = 0.0;
        for axis in 0..3 {
            let outside = (node.low[axis] - query[axis]).max(query[axis] - node.high[axis]).max(0.0);
            squared += outside * outside;
        }
        squared
    }
}

fn bounds(points: &[Vec3], start: usize, end: usize) -> Node {
    let mut low = [f64::INFINITY; 3];
    let mut high = [f64::NEG_INFINITY; 3];
    for p in &points[start..end] {
        for axis in 0..3 {
            low[axis] = low[axis].min(p[axis]);
            high[axis] = high[axis].max(p[axis]);
        }
    }
    let center = 0.5 * (Vec3::from(low) + Vec3::from(high));
    let radius = points[start..end].iter().map(|p| (p - center).norm()).fold(0.0, f64::max);
    Node { low, high, center, radius, start, end, children: 0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use sixfold_geometry::Pose;
    use sixfold_geometry::nalgebra::Vector6;

    fn points() -> impl Strategy<Value = Vec<Vec3>> {
        prop::collection::vec(prop::array::uniform3(-0.1..0.1f64).prop_map(Vec3::from), 1..300)
    }

    fn pose() -> impl Strategy<Value = Pose> {
        prop::array::uniform6(-0.5..0.5f64).prop_map(|t| Pose::exp(&Vector6::from(t)))
    }

    proptest! {
        #[test]
        fn the_tree_agrees_with_brute_force(points in points(), by in pose()) {
            let model = ModelPoints::new(&points).unwrap();
            let brute: f64 = points.iter().map(|p| {
                let q = by.transform_point(p);
                points.iter().map(|o| (o - q).norm()).fold(f64::INFINITY, f64::min)
            }).sum::<f64>() / points.len() as f64;
            prop_assert!((model.mean_nearest(&model, &by.rotation_matrix(), &by.translation()) - brute).abs() < 1e-12);
        }

        #[test]
        fn passing_over_leaves_loses_nothing(points in points(), a in pose(), b in pose()) {
            let model = ModelPoints::new(&points).unwrap();
            let (m, t) = (a.rotation_matrix() - b.rotation_matrix(), a.translation() - b.translation());
            let brute = points.iter().map(|p| (m * p + t).norm_squared()).fold(0.0, f64::max);
            prop_assert!((model.largest_squared(&m, &t, f64::INFINITY) - brute).abs() < 1e-12);
            let mean = points.iter().map(|p| (m * p + t).norm()).sum::<f64>() / points.len() as f64;
            prop_assert!((model.mean_norm(&m, &t) - mean).abs() < 1e-12);
        }
    }

    #[test]
    fn many_equal_points_are_no_trouble() {
        let model = ModelPoints::new(&vec![Vec3::new(1.0, 2.0, 3.0); 1000]).unwrap();
        let by = Pose::from_translation(Vec3::new(0.0, 0.0, 0.5));
        assert_eq!(model.mean_nearest(&model, &by.rotation_matrix(), &by.translation()), 0.5);
        assert!(ModelPoints::new(&[]).is_none());
        assert!(ModelPoints::new(&[Vec3::new(f64::NAN, 0.0, 0.0)]).is_none());
    }
}
