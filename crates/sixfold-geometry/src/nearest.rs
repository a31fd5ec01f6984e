//! Nearest neighbours in three dimensions: a k-d tree over a cloud (crate kiddo).

use kiddo::{ImmutableKdTree, SquaredEuclidean};

use crate::Vec3;

/// A k-d tree over points in metres.
#[derive(Debug)]
pub struct KdTree {
    tree: Option<ImmutableKdTree<f64, 3>>,
    /// Index in the caller's list per point in the tree; empty when they are the same.
    original: Vec<usize>,
}

/// A neighbour: its index in the list the tree was built from, and how far it is.
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
        let finite = |p: &&Vec3| p.iter().all(|c| c.is_finite());
        let entries: Vec<[f64; 3]> = points.iter().filter(finite).map(|p| [p.x, p.y, p.z]).collect();
        let original = if entries.len() == points.len() {
            vec![]
        } else {
            (0..points.len()).filter(|&i| finite(&&points[i])).collect()
        };
        let tree = if entries.is_empty() { None } else { ImmutableKdTree::new_from_slice(&entries).ok() };
        KdTree { tree, original }
    }

    /// The nearest point, `None` when the tree is empty or `p` is not finite.
    pub fn nearest(&self, p: &Vec3) -> Option<Neighbour> {
        if !p.iter().all(|c| c.is_finite()) {
            return None;
        }
        let tree = self.tree.as_ref()?;
        let hit = tree.query(&[p.x, p.y, p.z]).nearest_one::<SquaredEuclidean<f64>>().execute();
        Some(Neighbour { index: self.original_index(hit.item), distance: hit.distance.sqrt() })
    }

    /// All points within `radius` metres, in the order of their indices.
    pub fn within(&self, p: &Vec3, radius: f64) -> Vec<Neighbour> {
        let Some(tree) = self.tree.as_ref().filter(|_| p.iter().all(|c| c.is_finite())) else {
            return vec![];
        };
        let hits = tree
            .query(&[p.x, p.y, p.z])
            .within::<SquaredEuclidean<f64>>(radius * radius)
            .unsorted()
            .execute();
        let mut found: Vec<_> = hits
            .iter()
            .map(|h| Neighbour { index: self.original_index(h.item), distance: h.distance.sqrt() })
            .collect();
        found.sort_unstable_by_key(|n| n.index);
        found
    }

    fn original_index(&self, item: u32) -> usize {
        self.original.get(item as usize).copied().unwrap_or(item as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

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
        }
    }

    #[test]
    fn points_that_are_not_finite_are_left_out_and_indices_kept() {
        let tree = KdTree::new(&[Vec3::from_element(f64::NAN), Vec3::x(), Vec3::y()]);
        assert_eq!(tree.nearest(&Vec3::new(0.9, 0.1, 0.0)).unwrap().index, 1);
        assert!(KdTree::new(&[]).nearest(&Vec3::x()).is_none());
        // Thousands of equal points are no trouble.
        let same = KdTree::new(&vec![Vec3::x(); 5000]);
        assert_eq!(same.nearest(&Vec3::zeros()).unwrap().distance, 1.0);
    }
}
