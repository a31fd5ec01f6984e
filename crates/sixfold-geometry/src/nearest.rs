//! Nearest neighbours in three dimensions: a k-d tree over a cloud.
//!
//! Bentley 1975 ("Multidimensional binary search trees used for associative searching"), with points in buckets at the
//! leaves and cuts at the median of the longest side (Friedman, Bentley and Finkel 1977), and with the distance to a
//! cell kept per axis on the way down (Arya and Mount 1993). The tree is complete, so children and buckets are found
//! by arithmetic.
//!
//! Searches are exact to the last bit: the distance to a cell is added up in the same order as that to a point, and
//! rounding is monotone, so no cell that contains a nearer point is skipped.

use std::ops::Range;

use crate::Vec3;

/// Maximum number of points in a bucket. A smaller bucket makes the tree deeper; a larger one makes searches test more
/// points in vain.
const BUCKET: usize = 32;

/// A k-d tree over points in metres.
#[derive(Debug, Clone)]
pub struct KdTree {
    /// The inner nodes of a complete binary tree: the children of `i` are `2 i + 1` and `2 i + 2`.
    nodes: Vec<Node>,
    /// Levels of inner nodes; there are `2^depth` buckets.
    depth: u32,
    /// The points in the order of the buckets, per axis.
    points: [Vec<f64>; 3],
    /// Their indices in the caller's list.
    original: Vec<usize>,
    /// The smallest box around all points.
    bounds: Bounds,
}

/// An axis-aligned box: its lowest and its highest coordinates.
#[derive(Debug, Clone, Copy)]
struct Bounds {
    low: [f64; 3],
    high: [f64; 3],
}

/// A point and its index in the caller's list.
type Entry = ([f64; 3], usize);

/// An inner node: the split of a cell in two.
#[derive(Debug, Clone, Copy)]
struct Node {
    axis: usize,
    /// No point of the first child has a larger coordinate, none of the second a smaller one.
    cut: f64,
    /// The lowest index among the points of the first and of the second child; it decides between equal distances.
    lowest: [usize; 2],
}

/// A neighbour: its index in the list the tree was built from, and its distance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Neighbour {
    /// Index of the point.
    pub index: usize,
    /// Distance in metres.
    pub distance: f64,
}

impl KdTree {
    /// A tree over the points; those with a coordinate that is not finite are left out.
    pub fn new(points: &[Vec3]) -> KdTree {
        let mut entries: Vec<Entry> =
            points.iter().enumerate().filter_map(|(i, p)| Some((finite(p)?, i))).collect();
        let depth = entries.len().div_ceil(BUCKET).next_power_of_two().trailing_zeros();
        let mut bounds = Bounds { low: [f64::INFINITY; 3], high: [f64::NEG_INFINITY; 3] };
        for (p, _) in &entries {
            bounds.low = std::array::from_fn(|axis| bounds.low[axis].min(p[axis]));
            bounds.high = std::array::from_fn(|axis| bounds.high[axis].max(p[axis]));
        }
        let mut tree = KdTree {
            nodes: vec![Node { axis: 0, cut: 0.0, lowest: [0; 2] }; (1 << depth) - 1],
            depth,
            points: [vec![], vec![], vec![]],
            original: vec![0; entries.len()],
            bounds,
        };
        tree.build(0, 0..1 << depth, bounds, &mut entries);
        tree.points = std::array::from_fn(|axis| entries.iter().map(|(p, _)| p[axis]).collect());
        tree.original = entries.into_iter().map(|(_, index)| index).collect();
        tree
    }

    /// Sorts `entries`, which lie in the cell `bounds`, into `buckets` and fills the nodes above them; returns the lowest
    /// index among the entries.
    fn build(&mut self, node: usize, buckets: Range<usize>, bounds: Bounds, entries: &mut [Entry]) -> usize {
        if buckets.len() == 1 {
            return entries.iter().map(|e| e.1).min().unwrap_or(usize::MAX);
        }
        let side = |axis: usize| bounds.high[axis] - bounds.low[axis];
        let axis = (1..3).fold(0, |longest, axis| if side(axis) > side(longest) { axis } else { longest });
        let half = buckets.start + buckets.len() / 2;
        let first = self.start(half) - self.start(buckets.start);
        // Equal coordinates are sorted by index, so that equal points form a tree over their indices, which is quick to
        // search.
        let order = |a: &Entry, b: &Entry| a.0[axis].total_cmp(&b.0[axis]).then(a.1.cmp(&b.1));
        let cut = entries.select_nth_unstable_by(first, order).1.0[axis];
        let (left, right) = entries.split_at_mut(first);
        let (mut below, mut above) = (bounds, bounds);
        below.high[axis] = cut;
        above.low[axis] = cut;
        let lowest = [
            self.build(2 * node + 1, buckets.start..half, below, left),
            self.build(2 * node + 2, half..buckets.end, above, right),
        ];
        self.nodes[node] = Node { axis, cut, lowest };
        lowest[0].min(lowest[1])
    }

    /// Position of a bucket's first point: the points are spread evenly.
    fn start(&self, bucket: usize) -> usize {
        (bucket * self.original.len()) >> self.depth
    }

    /// The nearest point (the one with the lowest index among equally near ones); `None` when the tree is empty or `p` is
    /// not finite.
    pub fn nearest(&self, p: &Vec3) -> Option<Neighbour> {
        let p = finite(p).filter(|_| !self.original.is_empty())?;
        let mut search = Nearest { squared: f64::INFINITY, index: usize::MAX };
        self.search(&p, &mut search, 0, self.bounds.off(&p));
        Some(Neighbour { index: search.index, distance: search.squared.sqrt() })
    }

    /// The `count` nearest points (all, if there are fewer), the nearest first; among equally near points, those with the
    /// lowest indices. The time grows with `count` times the logarithm of the number of points, even if many of them are
    /// equal.
    pub fn nearest_several(&self, p: &Vec3, count: usize) -> Vec<Neighbour> {
        let Some(p) = finite(p).filter(|_| count > 0 && !self.original.is_empty()) else {
            return vec![];
        };
        let mut search = Several { count, found: Vec::with_capacity(count.min(self.original.len()) + 1) };
        self.search(&p, &mut search, 0, self.bounds.off(&p));
        search.found
    }

    /// All points within `radius` metres, in the order of their indices.
    pub fn within(&self, p: &Vec3, radius: f64) -> Vec<Neighbour> {
        let Some(p) = finite(p) else {
            return vec![];
        };
        let mut search = Within { squared: radius * radius, found: vec![] };
        self.search(&p, &mut search, 0, self.bounds.off(&p));
        search.found.sort_unstable_by_key(|n| n.index);
        search.found
    }

    /// Passes `search` the points of the cells under `node` that it can reach, the nearer child first. `off` is the
    /// distance from `p` to the cell along each axis, 0 where `p` is within its bounds.
    fn search(&self, p: &[f64; 3], search: &mut impl Search, node: usize, off: [f64; 3]) {
        let Some(inner) = self.nodes.get(node) else {
            let bucket = node - self.nodes.len();
            let range = self.start(bucket)..self.start(bucket + 1);
            let [x, y, z] = [0, 1, 2].map(|axis| &self.points[axis][range.clone()]);
            let mut squared = [0.0; BUCKET];
            for (((s, x), y), z) in squared.iter_mut().zip(x).zip(y).zip(z) {
                *s = squared_length(&[x - p[0], y - p[1], z - p[2]]);
            }
            for (&squared, &index) in squared.iter().zip(&self.original[range]) {
                search.point(squared, index);
            }
            return;
        };
        let difference = p[inner.axis] - inner.cut;
        // Of two equally distant cells, the one with the lowest index is searched first, so that of many equal points only
        // a few are visited.
        let near = if difference.abs() == off[inner.axis].abs() {
            usize::from(inner.lowest[1] < inner.lowest[0])
        } else {
            usize::from(!(difference < 0.0))
        };
        self.search(p, search, 2 * node + 1 + near, off);
        let mut beyond = off;
        beyond[inner.axis] = difference;
        if search.reaches(squared_length(&beyond), inner.lowest[1 - near]) {
            self.search(p, search, 2 * node + 2 - near, beyond);
        }
    }
}

impl Bounds {
    /// How far `p` is from the box along each axis, 0 where it is within its bounds.
    fn off(&self, p: &[f64; 3]) -> [f64; 3] {
        std::array::from_fn(|axis| (self.low[axis] - p[axis]).max(p[axis] - self.high[axis]).max(0.0))
    }
}

/// A kind of search: the cells that it visits and what it does with their points. Distances are squared.
trait Search {
    /// Whether to visit a cell at this distance whose lowest index is this.
    fn reaches(&self, squared: f64, lowest: usize) -> bool;
    /// Takes a point.
    fn point(&mut self, squared: f64, index: usize);
}

struct Nearest {
    squared: f64,
    index: usize,
}

impl Search for Nearest {
    fn reaches(&self, squared: f64, lowest: usize) -> bool {
        squared < self.squared || (squared == self.squared && lowest < self.index)
    }

    fn point(&mut self, squared: f64, index: usize) {
        if self.reaches(squared, index) {
            *self = Nearest { squared, index };
        }
    }
}

struct Several {
    count: usize,
    /// In order.
    found: Vec<Neighbour>,
}

impl Search for Several {
    fn reaches(&self, squared: f64, lowest: usize) -> bool {
        match self.found.last() {
            Some(last) if self.found.len() == self.count => {
                let distance = squared.sqrt();
                distance < last.distance || (distance == last.distance && lowest < last.index)
            }
            _ => true,
        }
    }

    fn point(&mut self, squared: f64, index: usize) {
        if self.reaches(squared, index) {
            let distance = squared.sqrt();
            let before = |n: &Neighbour| n.distance < distance || (n.distance == distance && n.index < index);
            self.found.insert(self.found.partition_point(before), Neighbour { index, distance });
            self.found.truncate(self.count);
        }
    }
}

struct Within {
    squared: f64,
    found: Vec<Neighbour>,
}

impl Search for Within {
    fn reaches(&self, squared: f64, _lowest: usize) -> bool {
        squared <= self.squared
    }

    fn point(&mut self, squared: f64, index: usize) {
        if squared <= self.squared {
            self.found.push(Neighbour { index, distance: squared.sqrt() });
        }
    }
}

fn finite(p: &Vec3) -> Option<[f64; 3]> {
    p.iter().all(|c| c.is_finite()).then_some([p.x, p.y, p.z])
}

/// All comparisons of distances depend on this one order of additions.
fn squared_length(v: &[f64; 3]) -> f64 {
    v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The nearest of all points by full search; the first of equally near ones.
    fn full_search(points: &[Vec3], p: &Vec3) -> Neighbour {
        let squared = |q: &Vec3| squared_length(&[q.x - p.x, q.y - p.y, q.z - p.z]);
        // Squared distances are compared, as in the tree: different squares may have the same rounded root.
        let index = (0..points.len())
            .reduce(|best, i| if squared(&points[i]) < squared(&points[best]) { i } else { best });
        let index = index.unwrap();
        Neighbour { index, distance: squared(&points[index]).sqrt() }
    }

    proptest! {
        #[test]
        fn the_nearest_is_that_of_a_full_search(
            points in prop::collection::vec(prop::array::uniform3(-1.0..1.0f64), 1..200),
            query in prop::array::uniform3(-1.5..1.5f64), radius in 0.01..1.0f64
        ) {
            let points: Vec<Vec3> = points.into_iter().map(Vec3::from).collect();
            let query = Vec3::from(query);
            let tree = KdTree::new(&points);
            let best = points.iter().map(|p| (p - query).norm()).fold(f64::INFINITY, f64::min);
            prop_assert!((tree.nearest(&query).unwrap().distance - best).abs() < 1e-12);
            let inside = points.iter().filter(|p| (*p - query).norm() <= radius).count();
            prop_assert_eq!(tree.within(&query, radius).len(), inside);
            let mut all = tree.within(&query, 100.0);
            all.sort_by(|a, b| a.distance.total_cmp(&b.distance).then(a.index.cmp(&b.index)));
            all.truncate(12);
            prop_assert_eq!(tree.nearest_several(&query, 12), all);
        }

        /// On a lattice most distances are equal: index and distance are still those of a full search, to the last bit.
        #[test]
        fn of_equally_near_points_the_lowest_index_wins(
            points in prop::collection::vec(prop::array::uniform3(-3..=3i8), 1..400),
            query in prop::array::uniform3(-8..=8i8), radius in 0..6u8
        ) {
            let points: Vec<Vec3> = points.iter().map(|p| Vec3::from(p.map(|c| 0.1 * f64::from(c)))).collect();
            let query = Vec3::from(query.map(|c| 0.05 * f64::from(c)));
            let tree = KdTree::new(&points);
            prop_assert_eq!(tree.nearest(&query), Some(full_search(&points, &query)));
            let radius = 0.1 * f64::from(radius);
            let near = |q: &Vec3| squared_length(&[q.x - query.x, q.y - query.y, q.z - query.z]) <= radius * radius;
            let inside: Vec<usize> = (0..points.len()).filter(|&i| near(&points[i])).collect();
            prop_assert_eq!(tree.within(&query, radius).iter().map(|n| n.index).collect::<Vec<_>>(), inside);
            let mut all = tree.within(&query, 100.0);
            all.sort_by(|a, b| a.distance.total_cmp(&b.distance).then(a.index.cmp(&b.index)));
            all.truncate(8);
            prop_assert_eq!(tree.nearest_several(&query, 8), all);
        }
    }

    #[test]
    fn points_that_are_not_finite_are_left_out_and_indices_kept() {
        let tree = KdTree::new(&[Vec3::from_element(f64::NAN), Vec3::x(), Vec3::y()]);
        assert_eq!(tree.nearest(&Vec3::new(0.9, 0.1, 0.0)).unwrap().index, 1);
        assert!(KdTree::new(&[]).nearest(&Vec3::x()).is_none());
        assert!(KdTree::new(&[]).within(&Vec3::x(), 1.0).is_empty());
    }

    #[test]
    fn forty_thousand_equal_points_are_searched_at_once() {
        // 40,000 searches for each of these took half a minute.
        let same = KdTree::new(&vec![Vec3::x(); 40_000]);
        let start = std::time::Instant::now();
        for k in 0..40_000 {
            let p = Vec3::new(f64::from(k % 3), f64::from(k % 5), 0.0);
            assert_eq!(same.nearest(&p).map(|n| n.index), Some(0));
            assert_eq!(same.nearest_several(&p, 12).len(), 12);
        }
        assert!(start.elapsed().as_secs_f64() < 10.0, "{:?}", start.elapsed());
        assert_eq!(same.nearest(&Vec3::zeros()), Some(Neighbour { index: 0, distance: 1.0 }));
        let lowest: Vec<usize> = same.nearest_several(&Vec3::x(), 12).iter().map(|n| n.index).collect();
        assert_eq!(lowest, (0..12).collect::<Vec<_>>());
        // Squared distances that overflow are handled too.
        let far = KdTree::new(&[Vec3::x() * 1e300, Vec3::y() * 1e300]);
        assert_eq!(far.nearest(&Vec3::zeros()), Some(Neighbour { index: 0, distance: f64::INFINITY }));
    }
}
