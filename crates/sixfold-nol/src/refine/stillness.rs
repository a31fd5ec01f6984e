//! Which objects stood still between which photographs, from rough poses alone.
//!
//! Objects that stood still have the same motion relative to the camera from one image to another: the motion of one predicts that
//! of the others. In every pair of images the largest set of objects that predict each other is assumed to have stood still, and
//! the error of every object is measured against the mean motion of this set. The images of an object are then grouped by the mean
//! of these errors (average linkage, Sokal and Michener 1958; the rest is ours).

use std::collections::BTreeMap;

use sixfold_geometry::nalgebra::UnitQuaternion;
use sixfold_geometry::{Pose, Vec3};

/// The places of objects: one for every object, and another one each time it was moved.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Places {
    /// The place of every source.
    pub of_source: Vec<usize>,
    /// Number of places.
    pub count: usize,
}

/// Mean of six squared errors, in units of their expected values, up to which a pose counts as predicted: true for 99 of 100
/// correct predictions.
const PREDICTED: f64 = 2.8;
/// The same, as the mean over all pairs of images of two groups, up to which an object stood at the same place in both.
const ALIKE: f64 = 2.0;

/// A source of an object in each of two images.
type Both = (usize, usize, usize);

impl Places {
    /// The places of sources, given as image and object with their poses; `centres` are the objects' centres in their own frames.
    pub(crate) fn new(pairs: &[[usize; 2]], given: &[Pose], centres: &[Vec3], rough: [f64; 2]) -> Places {
        let mut images: BTreeMap<usize, BTreeMap<usize, usize>> = BTreeMap::new();
        for (source, [image, object]) in pairs.iter().enumerate() {
            images.entry(*image).or_default().insert(*object, source);
        }
        let images: Vec<_> = images.into_values().collect();
        let judge = MotionTest { given, centres, rough };
        // The error of every object for each pair of its sources.
        let mut errors: Vec<BTreeMap<(usize, usize), f64>> = vec![BTreeMap::new(); centres.len()];
        for (number, one) in images.iter().enumerate() {
            for other in &images[number + 1..] {
                let both: Vec<Both> =
                    one.iter().filter_map(|(object, k)| Some((*object, *k, *other.get(object)?))).collect();
                let Some((motion, count)) = judge.common_motion(&both) else { continue };
                for (object, k, l) in both {
                    errors[object].insert((k, l), judge.error(&motion, count, (object, k, l)));
                }
            }
        }
        let mut of_source = vec![0; pairs.len()];
        let mut count = 0;
        for (object, errors) in errors.iter().enumerate() {
            let mine = (0..pairs.len()).filter(|source| pairs[*source][1] == object).collect();
            for group in groups(mine, errors) {
                group.into_iter().for_each(|source| of_source[source] = count);
                count += 1;
            }
        }
        Places { of_source, count }
    }
}

struct MotionTest<'a> {
    given: &'a [Pose],
    centres: &'a [Vec3],
    rough: [f64; 2],
}

/// A motion relative to the camera, about a point in the first image that it moves to a point in the second.
struct Motion {
    rotation: UnitQuaternion<f64>,
    from: Vec3,
    to: Vec3,
}

impl MotionTest<'_> {
    fn centre(&self, object: usize, source: usize) -> Vec3 {
        self.given[source].transform_point(&self.centres[object])
    }

    /// The mean motion of objects from the second image to the first.
    fn mean(&self, of: &[Both]) -> Motion {
        let count = of.len() as f64;
        let turn = |(_, k, l): &Both| self.given[*k].rotation() * self.given[*l].rotation().inverse();
        let mut rotation = of.first().map(turn).unwrap_or_default();
        for _ in 0..3 {
            let off: Vec3 =
                of.iter().map(|both| (turn(both) * rotation.inverse()).scaled_axis()).sum::<Vec3>() / count;
            rotation = UnitQuaternion::from_scaled_axis(off) * rotation;
        }
        let from = of.iter().map(|(object, _, l)| self.centre(*object, *l)).sum::<Vec3>() / count;
        let to = of.iter().map(|(object, k, _)| self.centre(*object, *k)).sum::<Vec3>() / count;
        Motion { rotation, from, to }
    }

    /// Mean of six squared errors of an object's pose predicted by the mean motion of `count` objects, in units of that explained
    /// by rough poses.
    fn error(&self, motion: &Motion, count: usize, (object, k, l): Both) -> f64 {
        let arm = self.centre(object, l) - motion.from;
        let shift = motion.to + motion.rotation * arm - self.centre(object, k);
        let turn =
            (motion.rotation * self.given[l].rotation() * self.given[k].rotation().inverse()).scaled_axis();
        let [place, angle] = self.rough.map(|deviation| 2.0 * deviation * deviation);
        let more = 1.0 + 1.0 / count as f64;
        let expected = [place * more + angle / count as f64 * arm.norm_squared() * 2.0 / 3.0, angle * more];
        (shift.norm_squared() / expected[0] + turn.norm_squared() / expected[1]) / 6.0
    }

    /// The motion of the largest set of objects that predict each other, and its size.
    fn common_motion(&self, both: &[Both]) -> Option<(Motion, usize)> {
        let agree = |motion: &Motion, count: usize| -> Vec<Both> {
            both.iter().filter(|b| self.error(motion, count, **b) < PREDICTED).copied().collect()
        };
        let sets = both.iter().map(|one| agree(&self.mean(&[*one]), 1));
        let mut best = sets.reduce(|best, set| if set.len() > best.len() { set } else { best })?;
        // The mean motion predicts better than that of one object.
        for _ in 0..3 {
            let better = agree(&self.mean(&best), best.len());
            if better.len() < 2 || better == best {
                break;
            }
            best = better;
        }
        // Two of many sometimes agree by chance.
        let minimum = if both.len() < 5 { 2 } else { 3.max(both.len() * 2 / 5) };
        (best.len() >= minimum).then(|| (self.mean(&best), best.len()))
    }
}

/// Groups sources by average linkage, until the mean error between all groups is too large; sources that were never compared are
/// not merged.
fn groups(sources: Vec<usize>, errors: &BTreeMap<(usize, usize), f64>) -> Vec<Vec<usize>> {
    let mut groups: Vec<Vec<usize>> = sources.into_iter().map(|source| vec![source]).collect();
    let between = |a: &[usize], b: &[usize]| {
        let of = |k: usize, l: usize| errors.get(&(k.min(l), k.max(l)));
        let known: Vec<f64> =
            a.iter().flat_map(|k| b.iter().filter_map(move |l| of(*k, *l))).copied().collect();
        (!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64)
    };
    loop {
        let mut nearest: Option<(f64, usize, usize)> = None;
        for a in 0..groups.len() {
            for b in a + 1..groups.len() {
                if let Some(error) = between(&groups[a], &groups[b])
                    && error < nearest.map_or(ALIKE, |n| n.0)
                {
                    nearest = Some((error, a, b));
                }
            }
        }
        let Some((_, a, b)) = nearest else { return groups };
        let joined = groups.remove(b);
        groups[a].extend(joined);
    }
}

/// Disjoint sets of numbers (union-find).
pub(super) struct Joined(Vec<usize>);

impl Joined {
    /// A set for each number below `count`.
    pub(crate) fn new(count: usize) -> Joined {
        Joined((0..count).collect())
    }

    /// The representative of a number's set.
    pub(crate) fn root(&mut self, mut at: usize) -> usize {
        while self.0[at] != at {
            self.0[at] = self.0[self.0[at]];
            at = self.0[at];
        }
        at
    }

    /// Merges two sets.
    pub(crate) fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b)] = a.min(b);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::refine::PoseRefinementOptions;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use sixfold_geometry::nalgebra::Vector6;

    #[test]
    fn objects_that_were_moved_get_a_place_for_every_time() {
        let mut random = ChaCha8Rng::seed_from_u64(4);
        let mut draw = |reach: f64| reach * (2.0 * random.random::<f64>() - 1.0);
        let mut some = |shift: f64, turn: f64| {
            Pose::exp(&Vector6::new(
                draw(shift),
                draw(shift),
                draw(shift),
                draw(turn),
                draw(turn),
                draw(turn),
            ))
        };
        // Four objects in six images. The second is moved after the third image; the fourth is elsewhere in every image.
        let cameras: Vec<Pose> =
            (0..6).map(|_| Pose::from_translation(Vec3::new(0.0, 0.0, 0.9)) * some(0.1, 0.8)).collect();
        let stood: Vec<Pose> = (0..4).map(|_| some(0.2, 1.0)).collect();
        let later = some(0.2, 1.0);
        let (mut pairs, mut given) = (vec![], vec![]);
        for (image, camera) in cameras.iter().enumerate() {
            for (object, stood) in stood.iter().enumerate() {
                let place = match object {
                    1 if image > 2 => later,
                    3 => some(0.2, 1.0),
                    _ => *stood,
                };
                pairs.push([image, object]);
                let pose = *camera * place;
                let error = some(0.01, 0.05);
                given.push(Pose::new(
                    error.rotation() * pose.rotation(),
                    pose.translation() + error.translation(),
                ));
            }
        }
        let places = Places::new(&pairs, &given, &[Vec3::zeros(); 4], PoseRefinementOptions::default().rough);
        let of = |image: usize, object: usize| places.of_source[4 * image + object];
        for image in 1..6 {
            assert_eq!((of(image, 0), of(image, 2)), (of(0, 0), of(0, 2)), "{places:?}");
            assert_eq!(of(image, 1), if image > 2 { of(3, 1) } else { of(0, 1) }, "{places:?}");
        }
        // Two of the first, two of the second, six of the fourth.
        assert_eq!(places.count, 2 + 2 + 6, "{places:?}");
    }

    #[test]
    fn a_single_object_gives_no_evidence() {
        let pairs = [[0, 0], [1, 0], [2, 0]];
        let places = Places::new(
            &pairs,
            &[Pose::identity(); 3],
            &[Vec3::zeros()],
            PoseRefinementOptions::default().rough,
        );
        assert_eq!(places.count, 3);
    }
}
