//! The exact diameter of a point set by branch and bound over a tree of boxes.
//!
//! A double sweep gives a lower bound. Two boxes whose farthest corners are no farther apart than the best pair found cannot hold a
//! better pair, and neither can two balls (the tighter bound on round objects). No convex hull is computed, so flat, duplicated or
//! degenerate point sets are no special cases.

use std::cmp::Ordering;

use sixfold_geometry::Vec3;

use crate::Mesh;

const LEAF: usize = 8;
/// Keeps a bound above the true value in spite of rounding.
const ROUND_UP: f64 = 1.0 + 1e-12;
/// Number of pairs of boxes that are compared for the exact diameter; after that, pairs that are longer by less than [`CLOSE`] are
/// skipped. Only contrived shapes reach it: all points of one part nearly equally far from all points of another.
const WORK: u32 = 30_000_000;
/// Ratio of squared distances.
const CLOSE: f64 = 1.0 + 1e-6;

impl Mesh {
    /// The largest distance between two vertices, in metres: exact (to a millionth for shapes that take too long).
    pub fn diameter(&self) -> f64 {
        diameter(self.vertices())
    }
}

/// The largest distance between two points; zero for fewer than two.
pub(crate) fn diameter(points: &[Vec3]) -> f64 {
    let Some(first) = points.first() else { return 0.0 };
    // A lower bound: move to the farthest point a few times.
    let mut best = 0.0;
    let mut from = *first;
    for _ in 0..8 {
        let (distance, to) = farthest(&from, points);
        if distance <= best {
            break;
        }
        best = distance;
        from = to;
    }
    let all = Bounds::of(points);
    let mut kept: Vec<Vec3> = points.iter().filter(|p| all.reach_squared(p) > best).copied().collect();
    if kept.is_empty() {
        return best.sqrt();
    }
    // Remove duplicates: thousands of points at each of two places would give all their pairs.
    let order = |a: &Vec3, b: &Vec3| (0..3).fold(Ordering::Equal, |o, k| o.then(a[k].total_cmp(&b[k])));
    kept.sort_unstable_by(order);
    kept.dedup();
    let mut nodes = Vec::with_capacity(2 * kept.len() / LEAF + 1);
    let count = kept.len();
    build(&mut kept, 0, count, &mut nodes);
    let mut work = WORK;
    search(&nodes, &kept, 0, 0, &mut best, &mut work);
    best.sqrt()
}

fn farthest(from: &Vec3, points: &[Vec3]) -> (f64, Vec3) {
    points.iter().fold((-1.0, *from), |(best, at), p| {
        let d = (p - from).norm_squared();
        if d > best { (d, *p) } else { (best, at) }
    })
}

#[derive(Debug, Clone, Copy)]
struct Bounds {
    low: Vec3,
    high: Vec3,
}

impl Bounds {
    fn of(points: &[Vec3]) -> Self {
        let (low, high) =
            points.iter().fold((points[0], points[0]), |(low, high), p| (low.inf(p), high.sup(p)));
        Bounds { low, high }
    }

    /// The squared distance from `p` to the farthest corner.
    fn reach_squared(&self, p: &Vec3) -> f64 {
        (p - self.low).abs().sup(&(self.high - p).abs()).norm_squared()
    }

    /// The squared distance of the farthest corners of two boxes.
    fn span_squared(&self, other: &Bounds) -> f64 {
        (self.high - other.low).abs().sup(&(other.high - self.low).abs()).norm_squared()
    }
}

struct Node {
    bounds: Bounds,
    /// The centre of the box.
    centre: Vec3,
    /// The distance of the farthest point from the centre, rounded up.
    radius: f64,
    start: usize,
    end: usize,
    /// The right child; the left one follows its parent. Zero for a leaf.
    right: usize,
}

fn build(points: &mut [Vec3], start: usize, end: usize, nodes: &mut Vec<Node>) {
    let here = nodes.len();
    let bounds = Bounds::of(&points[start..end]);
    let centre = bounds.low + (bounds.high - bounds.low) * 0.5;
    let radius = points[start..end].iter().map(|p| (p - centre).norm_squared()).fold(0.0, f64::max).sqrt();
    nodes.push(Node { bounds, centre, radius: radius * ROUND_UP, start, end, right: 0 });
    if end - start <= LEAF {
        return;
    }
    let axis = (bounds.high - bounds.low).imax();
    let half = start + (end - start) / 2;
    points[start..end].select_nth_unstable_by(half - start, |a, b| a[axis].total_cmp(&b[axis]));
    build(points, start, half, nodes);
    nodes[here].right = nodes.len();
    build(points, half, end, nodes);
}

impl Node {
    /// An upper bound of the squared distance of a point in this node and one in the other.
    fn bound(&self, other: &Node) -> f64 {
        let by_balls = ((self.centre - other.centre).norm() + self.radius + other.radius) * ROUND_UP;
        self.bounds.span_squared(&other.bounds).min(by_balls * by_balls)
    }
}

/// Improves `best`, a squared distance, with pairs of one point in `a` and one in `b`.
fn search(nodes: &[Node], points: &[Vec3], a: usize, b: usize, best: &mut f64, work: &mut u32) {
    let (node_a, node_b) = (&nodes[a], &nodes[b]);
    *work = work.saturating_sub(1);
    let enough = if *work > 0 { *best } else { *best * CLOSE };
    if node_a.bound(node_b) <= enough {
        return;
    }
    match (node_a.right, node_b.right) {
        (0, 0) => {
            for p in &points[node_a.start..node_a.end] {
                for q in &points[node_b.start..node_b.end] {
                    *best = best.max((p - q).norm_squared());
                }
            }
        }
        _ => {
            let children = |index: usize| match nodes[index].right {
                0 => [index, index],
                right => [index + 1, right],
            };
            let [a0, a1] = children(a);
            let [b0, b1] = children(b);
            let mut pairs =
                [(a0, b0), (a0, b1), (a1, b0), (a1, b1)].map(|(i, j)| (nodes[i].bound(&nodes[j]), i, j));
            // Two children of the same node, and a leaf in place of two children, give the same pair twice.
            if a == b {
                pairs[2].0 = f64::NEG_INFINITY;
            }
            if a0 == a1 {
                (pairs[2].0, pairs[3].0) = (f64::NEG_INFINITY, f64::NEG_INFINITY);
            }
            if b0 == b1 {
                (pairs[1].0, pairs[3].0) = (f64::NEG_INFINITY, f64::NEG_INFINITY);
            }
            // The most promising pair first.
            pairs.sort_unstable_by(|x, y| y.0.total_cmp(&x.0));
            for (bound, i, j) in pairs {
                if bound > *best {
                    search(nodes, points, i, j, best, work);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn by_all_pairs(points: &[Vec3]) -> f64 {
        points
            .iter()
            .flat_map(|p| points.iter().map(move |q| (p - q).norm_squared()))
            .fold(0.0, f64::max)
            .sqrt()
    }

    proptest! {
        #[test]
        fn equals_all_pairs(raw in prop::collection::vec(prop::array::uniform3(-1.0..1.0f64), 1..120),
                            flatten in prop::array::uniform3(0.0..1.0f64)) {
            let points: Vec<Vec3> =
                raw.iter().map(|p| Vec3::from(*p).component_mul(&Vec3::from(flatten))).collect();
            prop_assert_eq!(diameter(&points), by_all_pairs(&points));
        }

        #[test]
        fn equals_all_pairs_on_a_sphere(raw in prop::collection::vec(prop::array::uniform3(-1.0..1.0f64), 2..200)) {
            let points: Vec<Vec3> =
                raw.iter().filter_map(|p| Vec3::from(*p).try_normalize(1e-3)).collect();
            prop_assert_eq!(diameter(&points), by_all_pairs(&points));
        }
    }

    #[test]
    fn degenerate_sets() {
        assert_eq!(diameter(&[]), 0.0);
        assert_eq!(diameter(&[Vec3::x()]), 0.0);
        assert_eq!(diameter(&vec![Vec3::x(); 100]), 0.0);
        let line: Vec<Vec3> = (0..1000).map(|i| Vec3::new(i as f64, 0.0, 0.0)).collect();
        assert_eq!(diameter(&line), 999.0);
    }
}
