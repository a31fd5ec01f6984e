//! Which boxes stand for which objects in training (Ren et al. 2015, section 3.1.2), as torchvision's `Matcher`, its sampler of as many
//! boxes with and without object, and its codes of boxes.

use rand::RngExt;
use sixfold_geometry::random::Random;

use super::boxes::{Corners, overlap};

/// What a box stands for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Match {
    /// The object with this number.
    Object(usize),
    /// No object.
    Background,
    /// Neither: it is not learnt.
    Between,
}

/// From which overlap on a box stands for an object, and below which for none.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Limits {
    pub object: f32,
    pub background: f32,
    /// The boxes that overlap an object most stand for it however little that is.
    pub best: bool,
}

/// Of every box the object that it overlaps most.
pub(super) fn matches(objects: &[Corners], boxes: &[Corners], limits: Limits) -> Vec<Match> {
    let mut best_of_object = vec![0.0f32; objects.len()];
    let of_box = |corners: &Corners| {
        let (mut best, mut number) = (-1.0, 0);
        for (i, object) in objects.iter().enumerate() {
            let overlap = overlap(object, corners);
            best_of_object[i] = best_of_object[i].max(overlap);
            if overlap > best {
                (best, number) = (overlap, i);
            }
        }
        (best, number)
    };
    let best: Vec<(f32, usize)> = boxes.iter().map(of_box).collect();
    boxes
        .iter()
        .zip(best)
        .map(|(corners, (best, number))| {
            let is_best = |(object, most): (&Corners, &f32)| *most > 0.0 && overlap(object, corners) == *most;
            if best >= limits.object || (limits.best && objects.iter().zip(&best_of_object).any(is_best)) {
                Match::Object(number)
            } else if best >= limits.background {
                Match::Between
            } else {
                Match::Background
            }
        })
        .collect()
}

/// At most `count` boxes at random, of which at most `fraction` stand for objects: their numbers, objects first.
pub(super) fn balanced(matches: &[Match], count: usize, fraction: f64, random: &mut Random) -> Vec<usize> {
    let of = |wanted: fn(&Match) -> bool| (0..matches.len()).filter(|i| wanted(&matches[*i])).collect();
    let mut some = |mut all: Vec<usize>, most: usize| {
        let most = most.min(all.len());
        for i in 0..most {
            let other = random.random_range(i..all.len());
            all.swap(i, other);
        }
        all.truncate(most);
        all.sort_unstable();
        all
    };
    let mut chosen = some(of(|m| matches!(m, Match::Object(_))), (count as f64 * fraction) as usize);
    let others = some(of(|m| *m == Match::Background), count - chosen.len());
    chosen.extend(others);
    chosen
}

/// The code of a box relative to another, times `weights`: the inverse of [`super::boxes::decode`].
pub(super) fn encode(corners: &Corners, of: &Corners, weights: [f32; 4]) -> [f32; 4] {
    let size = |c: &Corners| [c[2] - c[0], c[3] - c[1]];
    let ([w, h], [of_w, of_h]) = (size(corners), size(of));
    let centre = |c: &Corners, [w, h]: [f32; 2]| [c[0] + 0.5 * w, c[1] + 0.5 * h];
    let ([x, y], [of_x, of_y]) = (centre(corners, [w, h]), centre(of, [of_w, of_h]));
    [
        weights[0] * (x - of_x) / of_w,
        weights[1] * (y - of_y) / of_h,
        weights[2] * (w / of_w).ln(),
        weights[3] * (h / of_h).ln(),
    ]
}

#[cfg(test)]
mod tests {
    use super::super::boxes::decode;
    use super::*;
    use sixfold_geometry::random::stream;

    const LIMITS: Limits = Limits { object: 0.7, background: 0.3, best: true };

    #[test]
    fn boxes_are_matched_by_their_overlap() {
        let objects = [[0.0, 0.0, 10.0, 10.0], [100.0, 0.0, 110.0, 40.0]];
        let boxes = [
            [0.0, 0.0, 10.0, 9.0],
            [0.0, 0.0, 10.0, 5.0],
            [50.0, 50.0, 60.0, 60.0],
            // The best of the second object, and as good a one.
            [100.0, 0.0, 110.0, 10.0],
            [100.0, 30.0, 110.0, 40.0],
            [100.0, 0.0, 110.0, 5.0],
        ];
        use Match::{Background, Between, Object};
        let found = matches(&objects, &boxes, LIMITS);
        assert_eq!(found, [Object(0), Between, Background, Object(1), Object(1), Background]);
        let found = matches(&objects, &boxes, Limits { best: false, ..LIMITS });
        assert_eq!(found, [Object(0), Between, Background, Background, Background, Background]);
        assert!(matches(&[], &boxes, LIMITS).iter().all(|m| *m == Background));
    }

    #[test]
    fn samples_are_balanced_as_far_as_there_are_any_and_follow_from_the_seed() {
        let mut all = vec![Match::Background; 90];
        all.extend([Match::Between; 5]);
        all.extend((0..5).map(Match::Object));
        let some =
            |seed: u64, count: usize, fraction: f64| balanced(&all, count, fraction, &mut stream(seed, 0));
        let few = some(1, 8, 0.5);
        assert_eq!((few.len(), few.iter().filter(|i| **i >= 95).count()), (8, 4));
        let many = some(1, 40, 0.5);
        assert_eq!((many.len(), many.iter().filter(|i| **i >= 95).count()), (40, 5));
        assert!(many.iter().all(|i| !(90..95).contains(i)));
        assert_eq!(some(1, 40, 0.5), many);
        assert_ne!(some(2, 40, 0.5), many);
        assert_eq!(some(1, 999, 0.5).len(), 95);
    }

    #[test]
    fn a_code_is_that_of_its_box() {
        let (corners, of) = ([3.0, 4.0, 28.0, 16.0], [10.0, 1.0, 30.0, 21.0]);
        let weights = [10.0, 10.0, 5.0, 5.0];
        let back = decode(encode(&corners, &of, weights), &of, weights);
        assert!(back.iter().zip(corners).all(|(a, b)| (a - b).abs() < 1e-4), "{back:?}");
    }
}
