//! The exact border of the object in each photograph: the minimum cut (Boykov and Jolly 2001; Rother, Kolmogorov and Blake 2004) between
//! the colours of the object and those around it, along edges of the photograph that the print of the board does not explain.
//!
//! The log-odds of a pixel are `ln (p(object) + e) / (p(background) + e)`, where both likelihoods are relative to a typical colour: a
//! white pixel of a white object on white paper says nothing. On the board the background is the bare board as this view would show it,
//! elsewhere the colours outside the rough mask. Salience, the rough mask and the shape of all masks are added. A border between two
//! pixels costs `a + b exp(-d^2 / (2 mean d^2))`; `d` is the smaller of the differences of their colours and of what these differ from
//! the bare board.

use rayon::prelude::*;
use sixfold_geometry::{Image, Mask, Plane, RgbImage};

use crate::cut::Cut;
use crate::distance::signed_distance;
use crate::grid::Grid;
use crate::hull::{Outlined, two_largest};
use crate::silhouette::{Bare, Cues, bin, covered, shape_centre, without_specks};
use crate::view::View;

// All numbers chosen by hand on simulated captures of three mugs, two of which are among those of the reported numbers.

/// Bins per channel of the histograms of colours.
const BINS: usize = 24;
/// Fraction of the most frequent colour's density from which a colour counts as typical.
const TYPICAL: f32 = 0.1;
/// Likelihood, relative to a typical colour, below which differences do not count.
const RARE: f32 = 0.03;
/// Weight of the log-odds of salience on the board, where the print gives better information, and elsewhere.
const SALIENCE: [f32; 2] = [0.1, 0.3];
/// Log-odds of a pixel whose ray meets nothing that the other photographs allow.
const IMPOSSIBLE: f32 = -4.0;
/// Log-odds of a pixel outside the region in which the border is searched.
const OUTSIDE: f32 = -100.0;
/// How far from the rough mask the border is searched, pixels.
const MARGIN: usize = 14;
/// A pixel at least this far from the border of the rough mask certainly belongs to one side, pixels.
const CERTAIN: f32 = 3.0;
/// A pixel with a smaller likelihood than this does not look like the bare board.
const NOT_BARE: f32 = 0.3;
/// Minimum number of pixels for a histogram.
const FEW: usize = 50;
/// Cost of a border anywhere, and in addition where there is no edge.
const BORDER: [f32; 2] = [0.3, 4.0];
/// Smallest mean squared difference of neighbours, squared grey levels: noise.
const NOISE: f32 = 9.0;
/// Holes of fewer pixels than this fraction (one divided by it) of the mask are closed.
const SMALLEST_HOLE: usize = 200;
/// Error of a projected shape, voxels.
const TOLERANCE: f64 = 1.0;
/// How many times the views are cut again.
const ROUNDS: usize = 2;
/// Steps of the cut's costs in a unit.
const UNIT: f32 = 1000.0;

/// What is known beside colours.
struct Prior {
    /// Log-odds from the rough mask, and the distance from its border at which they are reached, pixels.
    rough: f32,
    reach: f32,
    /// Log-odds of a pixel that looks exactly like the bare board, in addition to those from its colour.
    bare: f32,
    /// Weight of the log-odds that the surroundings of a pixel hide the board.
    hidden: f32,
}

/// From the rough masks.
const FIRST: Prior = Prior { rough: 1.0, reach: 6.0, bare: -1.0, hidden: 0.5 };
/// From the shape that the first masks confirm, which is exact up to its voxels.
const AGAIN: Prior = Prior { rough: 1.5, reach: 4.0, bare: -1.5, hidden: 0.0 };

/// The masks with exact borders, from rough ones; masks that were given stay as they are. First each view is cut by itself, then
/// again with the shape that at least two of the masks confirm. `shape` gives the voxels of that shape.
pub(crate) fn exact(views: &[(View, Cues)], rough: &[Mask], shape: &Grid, floor: Option<Plane>) -> Vec<Mask> {
    let all = |cut: &(dyn Fn(usize, &View, &Cues) -> Mask + Sync)| -> Vec<Mask> {
        let one = |i: usize| {
            let (view, cues) = &views[i];
            view.mask.clone().unwrap_or_else(|| cut(i, view, cues))
        };
        (0..views.len()).into_par_iter().map(one).collect()
    };
    let mut masks = all(&|i, view, cues| cut(view, cues, &rough[i], &rough[i], None));
    for _ in 0..ROUNDS {
        let outlined: Vec<Outlined<'_>> =
            views.iter().zip(&masks).map(|((view, _), mask)| Outlined::new(view, mask)).collect();
        let confirmed = confirmed(&outlined, shape, floor);
        masks = all(&|i, view, cues| {
            let silhouette = covered(view, &confirmed);
            let scale = view.camera.fx / (view.eye - shape_centre(shape)).norm();
            let possible = silhouette.grown((TOLERANCE * shape.step * scale).ceil() as usize);
            cut(view, cues, &silhouette, &masks[i], Some(&possible))
        });
    }
    masks
}

/// The shape outside which at least two masks show that there is nothing, on the voxels of another.
fn confirmed(views: &[Outlined<'_>], like: &Grid, floor: Option<Plane>) -> Grid {
    let mut grid = like.clone();
    grid.values.par_iter_mut().enumerate().for_each(|(i, value)| {
        let point = like.point(like.place(i));
        let [_, second] =
            two_largest(views.iter().filter_map(|view| view.outside(&point)).map(|[_, any]| any));
        let distance = if second.is_finite() { second } else { like.step as f32 };
        *value = floor.map_or(distance, |floor| distance.max(-floor.distance(&point) as f32));
    });
    grid
}

/// The mask of one view from a rough one. The object's colours are those inside the rough mask and another one, `known`. `possible` are
/// the pixels where the other photographs allow the object.
fn cut(view: &View, cues: &Cues, rough: &Mask, known: &Mask, possible: Option<&Mask>) -> Mask {
    let (w, h) = view.image.size();
    if !rough.as_slice().contains(&true) {
        return rough.clone();
    }
    let distance = signed_distance(rough);
    let (distance, colors) = (distance.as_slice(), view.image.as_slice());
    let bare = |i: usize| cues.bare.as_ref().and_then(|bare| bare.likelihood(i));
    let of = |pixels: &[usize]| Palette::of(pixels.iter().map(|i| colors[*i]));
    let known = signed_distance(known);
    let known = known.as_slice();
    let inside: Vec<usize> = (0..w * h).filter(|i| distance[*i].max(known[*i]) < -CERTAIN).collect();
    let own: Vec<usize> =
        inside.iter().copied().filter(|i| bare(*i).is_none_or(|likelihood| likelihood < NOT_BARE)).collect();
    let object = of(if own.len() < FEW { &inside } else { &own });
    let around: Vec<usize> = (0..w * h).filter(|i| distance[*i] > CERTAIN && bare(*i).is_none()).collect();
    let around = of(&around);
    let searched = rough.grown(MARGIN);
    let prior = if possible.is_none() { &FIRST } else { &AGAIN };
    let odds = |i: usize| {
        if !searched.as_slice()[i] {
            return OUTSIDE;
        }
        let on_board = bare(i);
        let background = on_board.unwrap_or_else(|| around.likelihood(colors[i]));
        let of_color = ((object.likelihood(colors[i]) + RARE) / (background + RARE)).ln();
        let of_salience = SALIENCE[usize::from(on_board.is_none())] * cues.salience.as_slice()[i];
        let of_rough = prior.rough * (-distance[i] / prior.reach).clamp(-1.0, 1.0);
        let of_board = on_board.map_or(0.0, |likelihood| {
            prior.bare * likelihood + prior.hidden * cues.board.as_slice()[i].max(0.0)
        });
        let of_others = possible.filter(|possible| !possible.as_slice()[i]).map_or(0.0, |_| IMPOSSIBLE);
        of_color + of_salience + of_rough + of_board + of_others
    };
    let mut graph = Cut::new((w, h), (0..w * h).map(|i| (UNIT * odds(i)) as i32).collect());
    let edges = Edges::new(&view.image, cues.bare.as_ref());
    for i in (0..w * h).filter(|i| searched.as_slice()[*i]) {
        for k in [0, 2, 4, 6] {
            if let Some(j) = graph.neighbour(i, k) {
                graph.separate(i, k, (UNIT * edges.cost(i, j, k >= 4)) as i32);
            }
        }
    }
    let mask = Image::from_vec(w, h, graph.solve()).unwrap_or_else(|_| rough.clone());
    without_specks(&mask, SMALLEST_HOLE)
}

/// How typical colours are: 1 for a frequent one.
struct Palette(Vec<f32>);

impl Palette {
    fn of(colors: impl Iterator<Item = [u8; 3]>) -> Palette {
        let mut counts = vec![0.0f32; BINS.pow(3)];
        colors.for_each(|color| counts[bin(color, BINS)] += 1.0);
        let smooth = smoothed(counts);
        let most = smooth.iter().copied().fold(1e-6, f32::max);
        Palette(smooth.into_iter().map(|count| (count / (TYPICAL * most)).min(1.0)).collect())
    }

    fn likelihood(&self, color: [u8; 3]) -> f32 {
        self.0[bin(color, BINS)]
    }
}

/// Each bin with half of each of its neighbours, along each axis.
fn smoothed(mut counts: Vec<f32>) -> Vec<f32> {
    for stride in [1, BINS, BINS * BINS] {
        let before = counts.clone();
        for (i, count) in counts.iter_mut().enumerate() {
            let at = i / stride % BINS;
            let below = if at > 0 { before[i - stride] } else { 0.0 };
            let above = if at + 1 < BINS { before[i + stride] } else { 0.0 };
            *count += 0.5 * (below + above);
        }
    }
    counts
}

/// Costs of a border between neighbours.
struct Edges {
    colors: Vec<[f32; 3]>,
    /// The differences from the bare board, where there is one.
    unexplained: Option<Vec<Option<[f32; 3]>>>,
    /// `1 / (2 mean d^2)` of the differences `d` between neighbours.
    sharpness: f32,
}

impl Edges {
    fn new(image: &RgbImage, bare: Option<&Bare>) -> Edges {
        let colors: Vec<[f32; 3]> = image.as_slice().iter().map(|c| c.map(f32::from)).collect();
        let rest = |bare: &Bare, i: usize| {
            let expected = bare.expected(i)?;
            Some(std::array::from_fn(|c| colors[i][c] - f32::from(expected[c])))
        };
        let unexplained = bare.map(|bare| (0..colors.len()).map(|i| rest(bare, i)).collect());
        let mut edges = Edges { colors, unexplained, sharpness: 0.0 };
        let w = image.width();
        let pairs = edges.colors.len().saturating_sub(w + 1);
        let sum: f64 =
            (0..pairs).map(|i| f64::from(edges.difference(i, i + 1) + edges.difference(i, i + w))).sum();
        let mean = (sum / (2 * pairs.max(1)) as f64) as f32;
        edges.sharpness = 1.0 / (2.0 * mean.max(NOISE));
        edges
    }

    /// The squared difference of two pixels, as far as the print does not explain it.
    fn difference(&self, i: usize, j: usize) -> f32 {
        let square = |a: [f32; 3], b: [f32; 3]| (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f32>();
        let whole = square(self.colors[i], self.colors[j]);
        let rest = self.unexplained.as_ref().and_then(|rest| Some(square(rest[i]?, rest[j]?)));
        rest.map_or(whole, |rest| whole.min(rest))
    }

    fn cost(&self, i: usize, j: usize, diagonal: bool) -> f32 {
        let cost = BORDER[0] + BORDER[1] * (-self.sharpness * self.difference(i, j)).exp();
        if diagonal { cost * std::f32::consts::FRAC_1_SQRT_2 } else { cost }
    }
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::{Camera, Pose, Vec3};

    use super::*;

    const SIDE: usize = 40;

    fn view(color: impl Fn(usize, usize) -> [u8; 3]) -> View {
        let camera =
            Camera { fx: 40.0, fy: 40.0, cx: 20.0, cy: 20.0, width: SIDE, height: SIDE, distortion: None };
        let camera_from_world = Pose::from_translation(Vec3::new(0.0, 0.0, 0.5));
        let eye = camera_from_world.inverse().translation();
        let image = Image::from_fn(SIDE, SIDE, color);
        View { image, camera, camera_from_world, eye, depth: None, mask: None, hidden: None }
    }

    fn cues(bare: Option<Bare>) -> Cues {
        let nothing = Image::filled(SIDE, SIDE, 0.0);
        Cues { salience: nothing.clone(), board: nothing, bare }
    }

    fn square(from: usize, to: usize) -> Mask {
        Image::from_fn(SIDE, SIDE, |x, y| (from..to).contains(&x) && (from..to).contains(&y))
    }

    #[test]
    fn a_border_follows_colours() {
        let truth = square(10, 30);
        let view = view(|x, y| if truth[(x, y)] { [200, 40, 40] } else { [60, 70, 60] });
        // The rough mask is three pixels too large on all sides.
        let rough = square(7, 33);
        assert_eq!(cut(&view, &cues(None), &rough, &rough, None), truth);
    }

    #[test]
    fn what_the_other_photographs_exclude_is_left_out() {
        let (view, rough) = (view(|_, _| [60, 70, 60]), square(5, 35));
        let cues = Cues { salience: Image::filled(SIDE, SIDE, 3.0), ..cues(None) };
        let right = |possible: &Mask| {
            let found = cut(&view, &cues, &rough, &rough, Some(possible));
            (0..SIDE * SIDE).filter(|i| i % SIDE >= 20 && found.as_slice()[*i]).count()
        };
        assert!(right(&rough) > 400);
        assert_eq!(right(&Image::from_fn(SIDE, SIDE, |x, _| x < 20)), 0);
    }

    #[test]
    fn an_edge_of_the_print_is_no_edge_where_the_board_is_bare() {
        // Ink on the left, paper on the right; an object of one colour on the lower half hides both.
        let printed = |x: usize| if x < 20 { [20; 3] } else { [220; 3] };
        let view = view(|x, y| if y < 20 { printed(x) } else { [90, 90, 200] });
        let bare = |i: usize| Some((f32::from(u8::from(i < 20 * SIDE)), printed(i % SIDE)));
        let bare = Bare::of((0..SIDE * SIDE).map(bare).collect());
        let edges = Edges::new(&view.image, Some(&bare));
        let at = |x: usize, y: usize| y * SIDE + x;
        assert_eq!(edges.difference(at(19, 5), at(20, 5)), 0.0, "ink and paper of the print");
        assert_eq!(edges.difference(at(19, 30), at(20, 30)), 0.0, "the object, in front of the same edge");
        assert!(
            edges.difference(at(5, 19), at(5, 20)) > 1e4 && edges.difference(at(30, 19), at(30, 20)) > 1e4
        );
        let without = Edges::new(&view.image, None);
        assert!(without.difference(at(19, 5), at(20, 5)) > 1e4);
    }
}
