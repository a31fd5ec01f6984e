//! The exact diameter of a point set by branch and bound over a tree of boxes.
//!
//! A double sweep gives a lower bound; two boxes whose farthest corners are no farther apart than the best
//! pair found cannot hold a better one. No convex hull, so flat, doubled or degenerate point sets need no
//! special care.

use sixfold_geometry::Vec3;

use crate::Mesh;

const LEAF: usize = 8;

impl Mesh {
    /// The largest distance between two vertices, in metres: exact.
    pub fn diameter(&self) -> f64 {
        diameter(self.vertices())
    }
}

/// The largest distance between two points; zero for fewer than two.
pub(crate) fn diameter(points: &[Vec3]) -> f64 {
    let Some(first) = points.first() else { return 0.0 };
    // A lower bound by walking to the farthest point a few times.
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
    let mut nodes = Vec::with_capacity(2 * kept.len() / LEAF + 1);
    let count = kept.len();
    build(&mut kept, 0, count, &mut nodes);
    search(&nodes, &kept, 0, 0, &mut best);
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
    start: usize,
    end: usize,
    /// The right child; the left one follows its parent. Zero for a leaf.
    right: usize,
}

fn build(points: &mut [Vec3], start: usize, end: usize, nodes: &mut Vec<Node>) {
    let here = nodes.len();
    let bounds = Bounds::of(&points[start..end]);
    nodes.push(Node { bounds, start, end, right: 0 });
    if end - start <= LEAF {
        return;
    }
    let axis = (bounds.high - bounds.low).imax();
    let middle = start + (end - start) / 2;
    points[start..end].select_nth_unstable_by(middle - start, |a, b| a[axis].total_cmp(&b[axis]));
    build(points, start, middle, nodes);
    nodes[here].right = nodes.len();
    build(points, middle, end, nodes);
}

/// Improves `best`, a squared distance, with pairs of one point in `a` and one in `b`.
fn search(nodes: &[Node], points: &[Vec3], a: usize, b: usize, best: &mut f64) {
    let (node_a, node_b) = (&nodes[a], &nodes[b]);
    if node_a.bounds.span_squared(&node_b.bounds) <= *best {
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
            let mut pairs: Vec<(f64, usize, usize)> = Vec::with_capacity(4);
            for i in [a0, a1] {
                for j in [b0, b1] {
                    // A pair of children of one node comes twice.
                    let pair = if a == b { (i.min(j), i.max(j)) } else { (i, j) };
                    if !pairs.iter().any(|&(_, i, j)| (i, j) == pair) {
                        let span = nodes[pair.0].bounds.span_squared(&nodes[pair.1].bounds);
                        pairs.push((span, pair.0, pair.1));
                    }
                }
            }
            // The most promising pair first.
            pairs.sort_by(|x, y| y.0.total_cmp(&x.0));
            for (_, i, j) in pairs {
                search(nodes, points, i, j, best);
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
