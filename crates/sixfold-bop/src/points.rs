//! The points of an object model, laid out for the pose errors: structure of arrays in k-d tree order.
//!
//! One tree serves two purposes. A leaf's bounding box bounds the distance of everything in it, which finds
//! nearest neighbours (ADI); and a leaf's bounding ball bounds how far a rigid motion can move anything in it,
//! which finds the vertex that moves furthest (MSSD) without visiting most vertices. Both are exact.

use sixfold_geometry::{Mat3, Pose, Vec3};

const LEAF_SIZE: usize = 32;

#[derive(Debug, Clone)]
struct Node {
    low: [f64; 3],
    high: [f64; 3],
    start: usize,
    end: usize,
    /// Index of the left child; the right child follows it. Zero for a leaf.
    children: usize,
}

#[derive(Debug, Clone)]
struct Leaf {
    center: Vec3,
    radius: f64,
    start: usize,
    end: usize,
}

/// The points of an object model with what the pose errors need to be fast.
#[derive(Debug, Clone)]
pub struct ModelPoints {
    pub(crate) x: Vec<f64>,
    pub(crate) y: Vec<f64>,
    pub(crate) z: Vec<f64>,
    nodes: Vec<Node>,
    leaves: Vec<Leaf>,
}

impl ModelPoints {
    /// Prepares points in metres in the object's frame; `None` when there is no point or one is not finite.
    pub fn new(points: &[Vec3]) -> Option<Self> {
        if points.is_empty() || !points.iter().all(|p| p.iter().all(|c| c.is_finite())) {
            return None;
        }
        let mut sorted = points.to_vec();
        let mut nodes = Vec::with_capacity(2 * points.len() / LEAF_SIZE + 1);
        let mut leaves = Vec::new();
        nodes.push(bounds(&sorted, 0, points.len()));
        let mut todo = vec![0];
        while let Some(index) = todo.pop() {
            let (start, end) = (nodes[index].start, nodes[index].end);
            if end - start <= LEAF_SIZE {
                continue;
            }
            let extent = |axis: usize| nodes[index].high[axis] - nodes[index].low[axis];
            let axis = (0..3).fold(0, |best, a| if extent(a) > extent(best) { a } else { best });
            let middle = (end - start) / 2;
            sorted[start..end].select_nth_unstable_by(middle, |a, b| a[axis].total_cmp(&b[axis]));
            let children = nodes.len();
            nodes[index].children = children;
            nodes.push(bounds(&sorted, start, start + middle));
            nodes.push(bounds(&sorted, start + middle, end));
            todo.extend([children, children + 1]);
        }
        for node in nodes.iter().filter(|n| n.children == 0) {
            let center = 0.5 * (Vec3::from(node.low) + Vec3::from(node.high));
            let radius = sorted[node.start..node.end].iter().map(|p| (p - center).norm()).fold(0.0, f64::max);
            leaves.push(Leaf { center, radius, start: node.start, end: node.end });
        }
        Some(ModelPoints {
            x: sorted.iter().map(|p| p.x).collect(),
            y: sorted.iter().map(|p| p.y).collect(),
            z: sorted.iter().map(|p| p.z).collect(),
            nodes,
            leaves,
        })
    }

    /// How many points there are; never zero.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.x.len()
    }

    /// Point number `i` in the prepared order.
    pub(crate) fn point(&self, i: usize) -> Vec3 {
        Vec3::new(self.x[i], self.y[i], self.z[i])
    }

    /// The largest `|a p + b|^2` over all points, or any number above `give_up` once it is known to be above.
    ///
    /// `|a p + b|` in a ball of radius `r` about `c` is at most `|a c + b| + |a| r` with the spectral norm of `a`
    /// (here bounded by `sqrt(|a|_1 |a|_inf)`): leaves that cannot beat the best vertex so far are passed over.
    pub(crate) fn largest_squared(&self, a: &Mat3, b: &Vec3, give_up: f64) -> f64 {
        let column = (0..3).map(|j| a.column(j).abs().sum()).fold(0.0, f64::max);
        let row = (0..3).map(|i| a.row(i).abs().sum()).fold(0.0, f64::max);
        let stretch = (column * row).sqrt();
        let at_center = |leaf: &Leaf| (a * leaf.center + b).norm();
        let bound = |leaf: &Leaf| at_center(leaf) + stretch * leaf.radius;
        let mut first = 0;
        let mut highest = f64::NEG_INFINITY;
        for (i, leaf) in self.leaves.iter().enumerate() {
            let here = bound(leaf);
            if here > highest {
                (first, highest) = (i, here);
            }
        }
        let mut best = self.largest_in_leaf(&self.leaves[first], a, b);
        for (i, leaf) in self.leaves.iter().enumerate() {
            if best > give_up {
                return best;
            }
            // The margin keeps rounding in the bound from hiding a vertex.
            let limit = bound(leaf) * (1.0 + 1e-12);
            if i != first && limit * limit > best {
                best = best.max(self.largest_in_leaf(leaf, a, b));
            }
        }
        best
    }

    fn largest_in_leaf(&self, leaf: &Leaf, a: &Mat3, b: &Vec3) -> f64 {
        let mut best = 0.0f64;
        for i in leaf.start..leaf.end {
            let (x, y, z) = (self.x[i], self.y[i], self.z[i]);
            let dx = a.m11 * x + a.m12 * y + a.m13 * z + b.x;
            let dy = a.m21 * x + a.m22 * y + a.m23 * z + b.y;
            let dz = a.m31 * x + a.m32 * y + a.m33 * z + b.z;
            best = best.max(dx * dx + dy * dy + dz * dz);
        }
        best
    }

    /// The mean of `|a p + b|` over all points.
    pub(crate) fn mean_norm(&self, a: &Mat3, b: &Vec3) -> f64 {
        // Four fixed partial sums: the compiler may use vector registers, the result is always the same.
        let mut sums = [0.0f64; 4];
        let term = |x: f64, y: f64, z: f64| {
            let dx = a.m11 * x + a.m12 * y + a.m13 * z + b.x;
            let dy = a.m21 * x + a.m22 * y + a.m23 * z + b.y;
            let dz = a.m31 * x + a.m32 * y + a.m33 * z + b.z;
            (dx * dx + dy * dy + dz * dz).sqrt()
        };
        let (xs, x_rest) = self.x.as_chunks::<4>();
        let (ys, y_rest) = self.y.as_chunks::<4>();
        let (zs, z_rest) = self.z.as_chunks::<4>();
        for ((x, y), z) in xs.iter().zip(ys).zip(zs) {
            for lane in 0..4 {
                sums[lane] += term(x[lane], y[lane], z[lane]);
            }
        }
        for (lane, ((&x, &y), &z)) in x_rest.iter().zip(y_rest).zip(z_rest).enumerate() {
            sums[lane] += term(x, y, z);
        }
        ((sums[0] + sums[1]) + (sums[2] + sums[3])) / self.len() as f64
    }

    /// The mean distance from every point moved by `move_query` to its nearest point, exactly.
    pub(crate) fn mean_nearest_after(&self, move_query: &Pose) -> f64 {
        let mut total = 0.0;
        let mut last = 0;
        let (rotation, translation) = (move_query.rotation_matrix(), move_query.translation());
        for i in 0..self.len() {
            let query = rotation * self.point(i) + translation;
            // Two guesses that are close in practice: the point itself and the neighbour of the point before.
            let own = (self.point(i) - query).norm_squared();
            let before = (self.point(last) - query).norm_squared();
            let mut best = if own < before { (own, i) } else { (before, last) };
            self.nearest(&query, &mut best);
            last = best.1;
            total += best.0.sqrt();
        }
        total / self.len() as f64
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
    Node { low, high, start, end, children: 0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use sixfold_geometry::nalgebra::Vector6;

    fn points() -> impl Strategy<Value = Vec<Vec3>> {
        prop::collection::vec(prop::array::uniform3(-0.1..0.1f64).prop_map(Vec3::from), 1..300)
    }

    fn pose() -> impl Strategy<Value = Pose> {
        prop::array::uniform6(-0.5..0.5f64).prop_map(|t| Pose::exp(&Vector6::from(t)))
    }

    proptest! {
        #[test]
        fn the_tree_finds_what_brute_force_finds(points in points(), by in pose()) {
            let model = ModelPoints::new(&points).unwrap();
            let brute: f64 = points.iter().map(|p| {
                let q = by.transform_point(p);
                points.iter().map(|o| (o - q).norm()).fold(f64::INFINITY, f64::min)
            }).sum::<f64>() / points.len() as f64;
            prop_assert!((model.mean_nearest_after(&by) - brute).abs() < 1e-12);
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
        assert_eq!(model.mean_nearest_after(&by), 0.5);
        assert!(ModelPoints::new(&[]).is_none());
        assert!(ModelPoints::new(&[Vec3::new(f64::NAN, 0.0, 0.0)]).is_none());
    }
}
