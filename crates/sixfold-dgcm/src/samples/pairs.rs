//! Pairs of views and their augmentation (dissertation, section 6.2.2, table 6.1).
//!
//! Positive: two views of the same kind of object that share more than half of their visible vertices. The target is, for every
//! pixel of the first, the VD-NOC of the same point of the object in the second. Negative: views of different families, or of one
//! family that share less.

use rand::{Rng, RngExt};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use sixfold_experience::Extent;
use sixfold_geometry::Vec3;
use sixfold_geometry::random::stream;
use sixfold_nn::layers::normal;
use sixfold_synth::shapes::Family;

use super::pool::{Pool, SeenPixel, View};
use crate::networks::VIEW;

/// How pairs are sampled and augmented.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PairOptions {
    /// Two views whose fraction of common visible vertices is above this are a positive pair.
    pub shared: f64,
    /// Fraction of negative pairs from the same family.
    pub same_family: f64,
    /// Largest fraction of the object's bounding box that is hidden by a block (table 6.1).
    pub occlusion: f64,
    /// Standard deviation of the noise on normals and VD-NOC (table 6.1).
    pub noise: f32,
    /// Targets are clipped to this absolute value: points that the second view does not show may be outside its extent.
    pub limit: f64,
}

impl Default for PairOptions {
    fn default() -> Self {
        PairOptions { shared: 0.5, same_family: 0.3, occlusion: 0.25, noise: 0.01, limit: 1.5 }
    }
}

/// Two views as the network's input: planes of `side * side` numbers.
#[derive(Debug, Clone)]
pub struct Pair {
    /// Whether the views show similar geometry.
    pub positive: bool,
    /// Families of the first and of the second view.
    pub families: (Family, Family),
    /// Normals and VD-NOC of the first view, the input: six planes.
    pub input: Vec<f32>,
    /// Normals and VD-NOC of the second view, the experience: six planes.
    pub experience: Vec<f32>,
    /// VD-NOC of the second view alone.
    pub vd_noc: Vec<f32>,
    /// VD-NOC of the first view's pixels in the second view's frame; zeros for a negative pair.
    pub target: Vec<f32>,
    /// One where the first view shows the object.
    pub mask: Vec<f32>,
}

impl Pool {
    /// The pair with this number, the same for the same seed.
    pub fn pair(&self, positive: bool, options: &PairOptions, seed: u64, number: u64) -> Pair {
        let mut random = stream(seed, number);
        let (first, second) = self.draw(positive, options, &mut random);
        let side = self.options().crop.side;
        let pixels = side * side;
        let mut pair = Pair {
            positive,
            families: (first.family, second.family),
            input: vec![0.0; VIEW * pixels],
            experience: vec![0.0; VIEW * pixels],
            vd_noc: vec![0.0; 3 * pixels],
            target: vec![0.0; 3 * pixels],
            mask: vec![0.0; pixels],
        };
        let trim = self.options().crop.trim;
        let first = Shown::of(first, block(first, side, options, &mut random), trim);
        let counterpart = second;
        let second = Shown::of(second, block(second, side, options, &mut random), trim);
        first.draw(&mut pair.input, options.noise, &mut random);
        second.draw(&mut pair.experience, options.noise, &mut random);
        pair.vd_noc.copy_from_slice(&pair.experience[3 * pixels..]);
        for p in &first.pixels {
            let i = usize::from(p.index);
            pair.mask[i] = 1.0;
            if positive {
                let place = second.normalise(&counterpart.counterpart(p));
                for k in 0..3 {
                    pair.target[k * pixels + i] = place[k].clamp(-options.limit, options.limit) as f32;
                }
            }
        }
        pair
    }

    /// Two views of a pair.
    fn draw(&self, positive: bool, options: &PairOptions, random: &mut impl Rng) -> (&View, &View) {
        const TRIES: usize = 60;
        let views = self.views();
        let mut any = |of: usize| random.random_range(0..of);
        for _ in 0..TRIES {
            let first = any(views.len());
            let group = self.group(first);
            if positive {
                // Tries several second views until one shares enough; otherwise another first view.
                for _ in 0..TRIES {
                    let second = group[any(group.len())];
                    if second != first && views[first].shared(&views[second]) > options.shared {
                        return (&views[first], &views[second]);
                    }
                }
            } else {
                let same = (any(1000) as f64) < 1000.0 * options.same_family;
                let second = if same { group[any(group.len())] } else { any(views.len()) };
                let other = views[first].family != views[second].family;
                if other || views[first].shared(&views[second]) <= options.shared {
                    return (&views[first], &views[second]);
                }
            }
        }
        // A pool with views of only one kind has no negative pairs; a view paired with itself is a positive pair.
        let first = any(views.len());
        (&views[first], &views[if positive { first } else { any(views.len()) }])
    }
}

/// What is left of a view behind a block. Its VD-NOC are those of the visible part, as in a crop of a partly hidden object.
struct Shown<'a> {
    pixels: Vec<&'a SeenPixel>,
    /// The extent of the visible part, in VD-NOC of the whole view, whose z axis points the other way.
    extent: Extent,
}

impl<'a> Shown<'a> {
    fn of(view: &'a View, hidden: impl Fn(usize) -> bool, trim: f64) -> Shown<'a> {
        let pixels: Vec<&SeenPixel> = view.pixels.iter().filter(|p| !hidden(usize::from(p.index))).collect();
        let points: Vec<Vec3> = pixels.iter().map(|p| flipped(&vd_noc(p))).collect();
        let whole = Extent { centre: Vec3::zeros(), half: Vec3::repeat(1.0) };
        Shown { pixels, extent: Extent::of(&points, trim).unwrap_or(whole) }
    }

    /// VD-NOC of the visible part from that of the whole view.
    fn normalise(&self, of_whole: &Vec3) -> Vec3 {
        self.extent.normalise(&flipped(of_whole))
    }

    /// Writes normals and VD-NOC with noise into six planes.
    fn draw(&self, planes: &mut [f32], noise: f32, random: &mut ChaCha8Rng) {
        let size = planes.len() / VIEW;
        for p in &self.pixels {
            let own = self.normalise(&vd_noc(p));
            for k in 0..3 {
                let i = k * size + usize::from(p.index);
                planes[i] = f32::from(p.normal[k]) / 127.0 + noise * normal(random);
                planes[i + 3 * size] = own[k].clamp(-1.0, 1.0) as f32 + noise * normal(random);
            }
        }
    }
}

fn vd_noc(pixel: &SeenPixel) -> Vec3 {
    Vec3::from_fn(|k, _| f64::from(pixel.vd_noc[k]) / 127.0)
}

/// [`Extent`] converts points of the camera's frame, whose z axis points away from it.
fn flipped(p: &Vec3) -> Vec3 {
    Vec3::new(p.x, p.y, -p.z)
}

/// Which pixels a block hides: it enters from one side of the object's bounding box and covers a fraction of it.
fn block(
    view: &View,
    side: usize,
    options: &PairOptions,
    random: &mut ChaCha8Rng,
) -> impl Fn(usize) -> bool + use<> {
    let (mut x0, mut y0, mut x1, mut y1) = (side, side, 0, 0);
    for p in &view.pixels {
        let (x, y) = (usize::from(p.index) % side, usize::from(p.index) / side);
        (x0, y0, x1, y1) = (x0.min(x), y0.min(y), x1.max(x + 1), y1.max(y + 1));
    }
    let fraction = options.occlusion * random.random::<f64>();
    let from = random.random_range(0..4);
    let depth = |low: usize, high: usize| (fraction * high.saturating_sub(low) as f64).round() as usize;
    let (dx, dy) = (depth(x0, x1), depth(y0, y1));
    move |index| {
        let (x, y) = (index % side, index / side);
        match from {
            0 => x < x0 + dx,
            1 => x + dx >= x1,
            2 => y < y0 + dy,
            _ => y + dy >= y1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::samples::GraspPoolOptions;
    use rand::SeedableRng;

    fn pool() -> Pool {
        Pool::new(&GraspPoolOptions { views: 96, ..GraspPoolOptions::default() }, &()).unwrap()
    }

    #[test]
    fn targets_are_the_vd_noc_of_the_same_place() {
        let pool = pool();
        let options = PairOptions { noise: 0.0, occlusion: 0.0, ..PairOptions::default() };
        let pixels = 96 * 96;
        for number in 0..12 {
            let pair = pool.pair(true, &options, 5, number);
            let inside: Vec<usize> = (0..pixels).filter(|&i| pair.mask[i] > 0.0).collect();
            assert!(inside.len() > 150);
            // For most targets a pixel of the second view has a nearby VD-NOC, because most points are visible there too.
            let second: Vec<usize> =
                (0..pixels).filter(|&i| (0..3).any(|k| pair.vd_noc[k * pixels + i] != 0.0)).collect();
            let near = inside
                .iter()
                .step_by(7)
                .filter(|&&i| {
                    second.iter().any(|&j| {
                        (0..3)
                            .all(|k| (pair.target[k * pixels + i] - pair.vd_noc[k * pixels + j]).abs() < 0.15)
                    })
                })
                .count();
            let asked = inside.len().div_ceil(7);
            assert!(near * 2 > asked, "pair {number}: {near} of {asked}");
            let outside = (0..pixels).filter(|&i| pair.mask[i] == 0.0);
            assert!(outside.into_iter().all(|i| pair.target[i] == 0.0 && pair.input[i] == 0.0));
        }
    }

    #[test]
    fn what_a_block_leaves_of_a_view_is_normalised_by_itself() {
        let pool = pool();
        let options = PairOptions { noise: 0.0, occlusion: 0.9, ..PairOptions::default() };
        let pixels = 96 * 96;
        for number in 0..12 {
            let pair = pool.pair(true, &options, 5, number);
            for planes in [&pair.input, &pair.experience] {
                for k in 3..6 {
                    let plane = &planes[k * pixels..(k + 1) * pixels];
                    let (low, high) = plane.iter().fold((0f32, 0f32), |(a, b), v| (a.min(*v), b.max(*v)));
                    assert!(low < -0.99 && high > 0.99, "pair {number}, plane {k}: {low} to {high}");
                }
            }
            assert_eq!(pair.vd_noc, pair.experience[3 * pixels..]);
        }
    }

    #[test]
    fn pairs_keep_to_their_kind_and_to_their_seed() {
        let pool = pool();
        let options = PairOptions::default();
        let (mut same, mut random) = (0, ChaCha8Rng::seed_from_u64(1));
        for _ in 0..50 {
            let (a, b) = pool.draw(true, &options, &mut random);
            assert!(a.family == b.family && a.rest == b.rest && a.shared(b) > 0.5);
            let (a, b) = pool.draw(false, &options, &mut random);
            assert!(a.family != b.family || a.shared(b) <= 0.5);
            same += usize::from(a.family == b.family);
        }
        assert!(same < 35, "{same}");
        let (a, b) = (pool.pair(true, &options, 1, 2), pool.pair(true, &options, 1, 2));
        assert_eq!((a.input, a.target), (b.input, b.target));
        let view = &pool.views()[0];
        assert_eq!(view.shared(view), 1.0);
    }
}
