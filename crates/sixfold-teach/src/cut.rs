//! The minimum cut of an image into object and background (Boykov and Jolly 2001), by augmenting paths between two search trees that
//! are kept from one augmentation to the next (Boykov and Kolmogorov 2004).

use std::collections::VecDeque;

/// Steps along x and y to the neighbours of a pixel; `k ^ 1` is the opposite of `k`.
pub(crate) const STEPS: [(isize, isize); 8] =
    [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Tree {
    /// Grows from pixels that are more likely object than background.
    Object,
    /// The opposite.
    Background,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Parent {
    /// In no tree.
    Free,
    /// The root of a tree: its own odds are not used up.
    Root,
    /// The neighbour at this step.
    Step(u8),
    /// Its former parent can send nothing more.
    Lost,
}

/// A graph with a node for each pixel. All costs are integers, so that the result does not depend on rounding.
pub(crate) struct Cut {
    width: usize,
    height: usize,
    /// What is left of a pixel's odds.
    odds: Vec<i32>,
    /// What is left of the capacity to each neighbour.
    capacity: Vec<[i32; 8]>,
    tree: Vec<Tree>,
    parent: Vec<Parent>,
    active: VecDeque<u32>,
    is_active: Vec<bool>,
}

impl Cut {
    /// `odds` above 0 are the costs of assigning a pixel to the background, below 0 to the object.
    pub fn new((width, height): (usize, usize), odds: Vec<i32>) -> Cut {
        let n = odds.len();
        Cut {
            width,
            height,
            odds,
            capacity: vec![[0; 8]; n],
            tree: vec![Tree::Background; n],
            parent: vec![Parent::Free; n],
            active: VecDeque::new(),
            is_active: vec![false; n],
        }
    }

    /// The neighbour of a pixel at a step; `None` outside the image.
    pub fn neighbour(&self, i: usize, k: usize) -> Option<usize> {
        let x = (i % self.width).checked_add_signed(STEPS[k].0).filter(|x| *x < self.width)?;
        let y = (i / self.width).checked_add_signed(STEPS[k].1).filter(|y| *y < self.height)?;
        Some(y * self.width + x)
    }

    /// Sets the cost of assigning a pixel and its neighbour at a step differently; not below 0.
    pub fn separate(&mut self, i: usize, k: usize, cost: i32) {
        if let Some(j) = self.neighbour(i, k) {
            (self.capacity[i][k], self.capacity[j][k ^ 1]) = (cost, cost);
        }
    }

    /// Whether each pixel belongs to the object, at the smallest total cost.
    pub fn solve(mut self) -> Vec<bool> {
        for i in (0..self.odds.len()).filter(|i| self.odds[*i] != 0).collect::<Vec<_>>() {
            self.tree[i] = if self.odds[i] > 0 { Tree::Object } else { Tree::Background };
            self.parent[i] = Parent::Root;
            self.activate(i);
        }
        while let Some(i) = self.active.front().map(|i| *i as usize) {
            if let Some((from, k, to)) = self.meeting(i) {
                self.augment(from, k, to);
            } else {
                self.active.pop_front();
                self.is_active[i] = false;
            }
        }
        let is_object = |i: usize| self.parent[i] != Parent::Free && self.tree[i] == Tree::Object;
        (0..self.odds.len()).map(is_object).collect()
    }

    fn activate(&mut self, i: usize) {
        if !self.is_active[i] {
            self.is_active[i] = true;
            self.active.push_back(i as u32);
        }
    }

    /// What a tree can still send between a node and its child `j` at step `k`: flow runs from object to background.
    fn left(&self, tree: Tree, i: usize, k: usize, j: usize) -> i32 {
        match tree {
            Tree::Object => self.capacity[i][k],
            Tree::Background => self.capacity[j][k ^ 1],
        }
    }

    /// Adds the free neighbours of a node to its tree, until one belongs to the other tree: the edge between both, from object to
    /// background.
    fn meeting(&mut self, i: usize) -> Option<(usize, usize, usize)> {
        if self.parent[i] == Parent::Free {
            return None;
        }
        let tree = self.tree[i];
        for k in 0..STEPS.len() {
            let Some(j) = self.neighbour(i, k) else { continue };
            if self.left(tree, i, k, j) == 0 {
                continue;
            }
            if self.parent[j] == Parent::Free {
                self.tree[j] = tree;
                self.parent[j] = Parent::Step((k ^ 1) as u8);
                self.activate(j);
            } else if self.tree[j] != tree {
                return Some(if tree == Tree::Object { (i, k, j) } else { (j, k ^ 1, i) });
            }
        }
        None
    }

    /// The nodes from `i` to the root of its tree, each with the step to its parent, and the root.
    fn path(&self, mut i: usize) -> (Vec<(usize, usize)>, usize) {
        let mut path = vec![];
        while let Parent::Step(k) = self.parent[i] {
            let k = usize::from(k);
            let Some(j) = self.neighbour(i, k) else { break };
            path.push((i, k));
            i = j;
        }
        (path, i)
    }

    /// Sends as much as possible along the path through an edge from object to background.
    fn augment(&mut self, from: usize, k: usize, to: usize) {
        let (source, first) = self.path(from);
        let (sink, last) = self.path(to);
        // Edges in the direction of the flow.
        let upwards = |(i, k): &(usize, usize)| (self.neighbour(*i, *k).unwrap_or(*i), *k ^ 1);
        let mut edges: Vec<(usize, usize)> = source.iter().map(upwards).collect();
        edges.push((from, k));
        edges.extend(sink.iter().copied());
        let of_edges = edges.iter().map(|(i, k)| self.capacity[*i][*k]);
        let sent = of_edges.fold(self.odds[first].min(-self.odds[last]), i32::min);
        for (i, k) in edges {
            self.capacity[i][k] -= sent;
            if let Some(j) = self.neighbour(i, k) {
                self.capacity[j][k ^ 1] += sent;
            }
        }
        self.odds[first] -= sent;
        self.odds[last] += sent;
        let mut lost = vec![];
        for (path, root) in [(source, first), (sink, last)] {
            for (i, k) in path {
                let Some(j) = self.neighbour(i, k) else { continue };
                if self.left(self.tree[i], j, k ^ 1, i) == 0 {
                    lost.push(i);
                }
            }
            if self.odds[root] == 0 {
                lost.push(root);
            }
        }
        lost.iter().for_each(|i| self.parent[*i] = Parent::Lost);
        self.adopt(lost);
    }

    /// Finds new parents for nodes that lost theirs, or frees them.
    fn adopt(&mut self, mut lost: Vec<usize>) {
        while let Some(i) = lost.pop() {
            let tree = self.tree[i];
            let can_adopt = |k: &usize| {
                let Some(j) = self.neighbour(i, *k) else { return false };
                self.tree[j] == tree && self.left(tree, j, *k ^ 1, i) > 0 && self.is_rooted(j)
            };
            if let Some(k) = (0..STEPS.len()).find(can_adopt) {
                self.parent[i] = Parent::Step(k as u8);
                continue;
            }
            for k in 0..STEPS.len() {
                let Some(j) = self.neighbour(i, k) else { continue };
                if self.parent[j] == Parent::Free || self.tree[j] != tree {
                    continue;
                }
                if self.left(tree, j, k ^ 1, i) > 0 {
                    self.activate(j);
                }
                if self.parent[j] == Parent::Step((k ^ 1) as u8) {
                    self.parent[j] = Parent::Lost;
                    lost.push(j);
                }
            }
            self.parent[i] = Parent::Free;
        }
    }

    /// Whether the path from a node leads to a root.
    fn is_rooted(&self, mut i: usize) -> bool {
        while let Parent::Step(k) = self.parent[i] {
            let Some(j) = self.neighbour(i, usize::from(k)) else { return false };
            i = j;
        }
        self.parent[i] == Parent::Root
    }
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::random::{stream, uniform};

    use super::*;

    /// A random problem: odds, and costs between neighbours.
    fn problem(seed: u64, size: (usize, usize), most: i32) -> (Vec<i32>, Vec<(usize, usize, i32)>) {
        let mut random = stream(seed, 0);
        let mut between = |low: i32| uniform(&mut random, [low as f32, most as f32]).round() as i32;
        let odds: Vec<i32> = (0..size.0 * size.1).map(|_| between(-most)).collect();
        let cut = Cut::new(size, odds.clone());
        let mut costs = vec![];
        for i in 0..odds.len() {
            for k in [0, 2, 4, 6] {
                if cut.neighbour(i, k).is_some() {
                    costs.push((i, k, between(0)));
                }
            }
        }
        (odds, costs)
    }

    fn solved(size: (usize, usize), odds: &[i32], costs: &[(usize, usize, i32)]) -> Vec<bool> {
        let mut cut = Cut::new(size, odds.to_vec());
        costs.iter().for_each(|(i, k, cost)| cut.separate(*i, *k, *cost));
        cut.solve()
    }

    fn total(size: (usize, usize), odds: &[i32], costs: &[(usize, usize, i32)], object: &[bool]) -> i32 {
        let graph = Cut::new(size, odds.to_vec());
        let of_pixels: i32 = odds
            .iter()
            .zip(object)
            .map(|(odds, is_object)| if *is_object { (-odds).max(0) } else { (*odds).max(0) })
            .sum();
        let apart = |(i, k, cost): &(usize, usize, i32)| {
            let j = graph.neighbour(*i, *k).unwrap();
            if object[*i] == object[j] { 0 } else { *cost }
        };
        of_pixels + costs.iter().map(apart).sum::<i32>()
    }

    #[test]
    fn no_other_assignment_costs_less() {
        let size = (4, 3);
        for seed in 0..300 {
            let (odds, costs) = problem(seed, size, if seed % 2 == 0 { 3 } else { 1000 });
            let found = total(size, &odds, &costs, &solved(size, &odds, &costs));
            let assignment = |bits: u32| (0..12).map(|i| bits >> i & 1 == 1).collect::<Vec<bool>>();
            let least = (0..1 << 12).map(|bits| total(size, &odds, &costs, &assignment(bits))).min();
            assert_eq!(Some(found), least, "seed {seed}");
        }
    }

    #[test]
    fn no_change_of_one_row_or_column_of_a_large_image_costs_less() {
        let size = (60, 50);
        let (odds, costs) = problem(5, size, 50);
        let best = solved(size, &odds, &costs);
        let least = total(size, &odds, &costs, &best);
        assert!(best.contains(&true) && best.contains(&false));
        for i in 0..odds.len() {
            for (dx, dy) in [(1, 1), (7, 1), (1, 9), (6, 6)] {
                for value in [false, true] {
                    let mut changed = best.clone();
                    for (x, y) in (0..dx).flat_map(|x| (0..dy).map(move |y| (i % 60 + x, i / 60 + y))) {
                        if x < 60 && y < 50 {
                            changed[y * 60 + x] = value;
                        }
                    }
                    if i % 17 == 0 {
                        assert!(total(size, &odds, &costs, &changed) >= least);
                    }
                }
            }
        }
    }
}
