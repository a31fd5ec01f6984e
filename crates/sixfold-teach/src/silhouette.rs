//! The object's mask in each photograph, from salience, the uncovered parts of the board, colours, and the consensus of all
//! photographs.
//!
//! Each cue gives log-odds for a pixel of a view. The sum is smoothed along the edges of the photograph (guided filter: He, Sun
//! and Tang 2010), and a voxel belongs to the object if most of the views that show it vote for it.

use rayon::prelude::*;
use sixfold_board::Board;
use sixfold_geometry::{Image, Mask, Plane, RgbImage, Vec3};
use sixfold_nn::salient::SalientNetwork;
use sixfold_nn::weights::WeightsError;

use crate::border::exact;
use crate::grid::Grid;
use crate::view::{View, Volume, bilinear};

/// Largest log-odds of one cue: no single cue gives a probability above 95 %.
const MOST: f32 = 3.0;
/// Fraction of the views showing a voxel that may vote that it is empty.
const DISSENT: f64 = 0.15;
/// Radius of the guided filter, pixels, and its regularisation (squared grey levels from 0 to 1).
const FILTER: (usize, f32) = (5, 1e-3);
/// Holes of fewer pixels than this fraction (one divided by it) of a rough mask are closed.
pub(crate) const SMALLEST_HOLE: usize = 50;
/// Bins per channel of the histograms of colours.
const BINS: usize = 12;

/// A network for salient regions: for each pixel of an image, the probability that it belongs to the object.
pub trait Segmenter: Sync {
    /// Probabilities, 0 to 1, in an image of the same size.
    ///
    /// # Errors
    /// The network's error.
    fn foreground(&self, image: &RgbImage) -> Result<Image<f32>, Box<dyn std::error::Error + Send + Sync>>;
}

/// Salience by U2-Net-p (Qin et al. 2020).
pub struct SalientSegmenter(SalientNetwork);

impl SalientSegmenter {
    /// With the weights that are built into the program.
    ///
    /// # Errors
    /// The weights' error.
    pub fn shipped() -> Result<SalientSegmenter, WeightsError> {
        Ok(SalientSegmenter(SalientNetwork::shipped(&Default::default())?))
    }
}

impl Segmenter for SalientSegmenter {
    fn foreground(&self, image: &RgbImage) -> Result<Image<f32>, Box<dyn std::error::Error + Send + Sync>> {
        Ok(self.0.salience(image)?.relative())
    }
}

/// The cues of one view.
pub(crate) struct Cues {
    /// Log-odds of salience.
    pub salience: Image<f32>,
    /// Log-odds from the board; 0 where the board gives no information.
    pub board: Image<f32>,
    /// What the view would show of the bare board.
    pub bare: Option<Bare>,
}

pub(crate) fn log_odds(p: f32) -> f32 {
    let p = p.clamp(1e-3, 1.0 - 1e-3);
    (p / (1.0 - p)).ln().clamp(-MOST, MOST)
}

impl Cues {
    pub fn new(
        view: &View,
        board: Option<&Board>,
        segmenter: &dyn Segmenter,
    ) -> Result<Cues, Box<dyn std::error::Error + Send + Sync>> {
        if let Some(mask) = &view.mask {
            let certain = Image::from_fn(mask.width(), mask.height(), |x, y| match mask[(x, y)] {
                true if view.is_hidden((x, y)) => 0.0,
                true => MOST,
                false => -MOST,
            });
            let nothing = Image::filled(mask.width(), mask.height(), 0.0);
            return Ok(Cues { salience: certain, board: nothing, bare: None });
        }
        let salience = segmenter.foreground(&view.image)?.map(|p| log_odds(*p));
        let (w, h) = view.image.size();
        let (board, bare) = match board {
            Some(board) => {
                let (odds, bare) = board_cue(view, board);
                (odds, Some(bare))
            }
            None => (Image::filled(w, h, 0.0), None),
        };
        Ok(Cues { salience, board, bare })
    }

    /// The sum of both.
    pub fn sum(&self) -> Image<f32> {
        let both = self.salience.as_slice().iter().zip(self.board.as_slice());
        let sum = both.map(|(a, b)| (0.7 * a + b).clamp(-2.0 * MOST, 2.0 * MOST)).collect();
        let (w, h) = self.salience.size();
        Image::from_vec(w, h, sum).unwrap_or_else(|_| self.salience.clone())
    }
}

/// The grey level of a colour, 0 to 255.
fn grey([r, g, b]: [u8; 3]) -> f32 {
    0.299 * f32::from(r) + 0.587 * f32::from(g) + 0.114 * f32::from(b)
}

/// Number of passes in which the brightness of paper and ink is estimated from the pixels that agree with the board so far.
const PASSES: usize = 3;
/// Half the side of the square in which agreement with the board is averaged, metres: large enough to contain paper and ink
/// everywhere.
const SQUARE: f64 = 0.009;
/// Fractions of agreeing pixels in a square at which the board is certainly bare, at which nothing is known, and at which it is
/// certainly covered.
const AGREEMENT: [f32; 3] = [0.85, 0.6, 0.35];
/// Minimum fraction of paper, or of ink, in a square for it to count.
const RARE: f32 = 0.03;
/// Brightness of the darkest shadow on paper, as a fraction of the way from ink to lit paper.
const DARKEST_SHADOW: f32 = 0.3;
/// Relative difference of the colour channels from those of paper above which a pixel is neither paper nor ink.
const TINT: f32 = 0.25;
/// Standard deviations on the bare board, grey levels: of a pixel, and of the difference between its colour channels. Chosen by hand.
const LEVEL: f32 = 8.0;
const TINTED: f32 = 10.0;
/// Standard deviation at an edge between ink and paper, as a fraction of their difference, from the error of the board's pose: of a pixel
/// whose surroundings count, and of one that counts by itself. Chosen by hand.
const EDGE: f32 = 0.25;
const OWN_EDGE: f32 = 0.15;
/// Likelihood of a shadow on paper, relative to lit paper. Chosen by hand.
const SHADOW: f32 = 0.5;

/// Log-odds from the comparison of each pixel and its surroundings with the bare board, and the bare board.
fn board_cue(view: &View, board: &Board) -> (Image<f32>, Bare) {
    let (width, height) = view.image.size();
    let printed = printed(view, board);
    let known = printed.map(|p| f32::from(u8::from(p.is_some())));
    let mut agrees = known.clone();
    let centre = Vec3::new(0.0, 0.0, 0.0);
    let scale = view.camera.fx / (view.eye - centre).norm();
    let radius = ((SQUARE * scale).round() as usize).max(2);
    let mut around = Image::filled(width, height, 1.0);
    for _ in 0..PASSES {
        let light = Light::on_board(view, &printed, &around, 4 * radius);
        agrees = Image::from_fn(width, height, |x, y| {
            printed[(x, y)].map_or(0.0, |white| light.agreement((x, y), view.image[(x, y)], white))
        });
        // White objects agree with paper and black ones with ink, so the lower of both agreements counts.
        let of = |ink: bool| {
            let chosen = printed.map(|p| f32::from(u8::from(p.is_some_and(|white| (white < 0.5) == ink))));
            let both = combined(&agrees, &chosen, |a, c| a * c);
            combined(&box_mean(&both, radius), &box_mean(&chosen, radius), |sum, total| {
                if total > RARE { sum / total } else { 1.0 }
            })
        };
        around = combined(&of(false), &of(true), f32::min);
    }
    let light = Light::on_board(view, &printed, &around, 4 * radius);
    let bare = Bare::new(view, &printed, &light);
    let odds = Image::from_fn(width, height, |x, y| {
        if known[(x, y)] == 0.0 {
            return 0.0;
        }
        let [bare, unknown, hidden] = AGREEMENT;
        let a = around[(x, y)];
        let of_square = if a > unknown {
            -4.0 * ((a - unknown) / (bare - unknown)).min(1.0)
        } else {
            2.0 * ((unknown - a) / (unknown - hidden)).min(1.0)
        };
        // In a partly covered square the pixel itself decides.
        let of_pixel = if agrees[(x, y)] < 0.5 { 1.5 } else { -1.0 };
        (of_square + of_pixel).clamp(-4.0, MOST)
    });
    (odds, bare)
}

/// The bare board as a view would show it.
pub(crate) struct Bare {
    /// How likely each pixel shows the bare board, relative to the most likely colour, 0 to 1, and the colour of the bare board; `None`
    /// outside the board.
    pixels: Vec<Option<(f32, [u8; 3])>>,
}

impl Bare {
    fn new(view: &View, printed: &Image<Option<f32>>, light: &Light) -> Bare {
        let (w, h) = view.image.size();
        let pixel = |i: usize| {
            let (at, white) = ((i % w, i / w), printed.as_slice()[i]?);
            Some((light.likelihood(at, view.image[at], white), light.expected(at, white)))
        };
        Bare { pixels: (0..w * h).map(pixel).collect() }
    }

    /// Likelihoods and colours of all pixels.
    #[cfg(test)]
    pub fn of(pixels: Vec<Option<(f32, [u8; 3])>>) -> Bare {
        Bare { pixels }
    }

    /// How likely a pixel shows the bare board, relative to the most likely colour, 0 to 1; `None` outside the board.
    pub fn likelihood(&self, i: usize) -> Option<f32> {
        self.pixels[i].map(|(likelihood, _)| likelihood)
    }

    /// The colour of the bare board at a pixel; `None` outside it.
    pub fn expected(&self, i: usize) -> Option<[u8; 3]> {
        self.pixels[i].map(|(_, color)| color)
    }
}

/// The brightness of paper and ink around each pixel.
struct Light {
    paper: Image<f32>,
    ink: Image<f32>,
    /// Ratio of red and of blue to green on paper.
    tint: [f32; 2],
    contrast: Image<f32>,
}

impl Light {
    fn on_board(view: &View, printed: &Image<Option<f32>>, believed: &Image<f32>, radius: usize) -> Light {
        let (width, height) = view.image.size();
        let weight = |x: usize, y: usize, ink: bool| match printed[(x, y)] {
            Some(white) if (ink && white < 0.05) || (!ink && white > 0.95) => believed[(x, y)].powi(4) + 1e-4,
            _ => 0.0,
        };
        let weights = Image::from_fn(width, height, |x, y| weight(x, y, false));
        let weighted = Image::from_fn(width, height, |x, y| weights[(x, y)] * grey(view.image[(x, y)]));
        let mean =
            |r: usize| combined(&box_mean(&weighted, r), &box_mean(&weights, r), |s, w| s / w.max(1e-9));
        let enough = box_mean(&weights, radius);
        let (near, far) = (mean(radius), mean(4 * radius));
        let paper =
            Image::from_fn(
                width,
                height,
                |x, y| if enough[(x, y)] > 0.02 { near[(x, y)] } else { far[(x, y)] },
            );
        // Occluders of ink are seldom as dark as ink; the ratio of ink to paper is the same everywhere on the sheet.
        let mut ratios = vec![];
        for y in 0..height {
            for x in 0..width {
                if weight(x, y, true) > 0.0 {
                    ratios.push(grey(view.image[(x, y)]) / paper[(x, y)].max(1.0));
                }
            }
        }
        ratios.sort_by(f32::total_cmp);
        let ratio = ratios.get(ratios.len() / 4).copied().unwrap_or(0.2).clamp(0.02, 0.6);
        let ink = paper.map(|p| ratio * p);
        let mut sums = [0.0f64; 3];
        for y in 0..height {
            for x in 0..width {
                let w = f64::from(weight(x, y, false));
                (0..3).for_each(|c| sums[c] += w * f64::from(view.image[(x, y)][c]));
            }
        }
        let tint = [sums[0], sums[2]].map(|s| (s / sums[1].max(1e-9)) as f32);
        let at = |x: usize, y: usize| printed[(x.min(width - 1), y.min(height - 1))].unwrap_or(1.0);
        let contrast = Image::from_fn(width, height, |x, y| {
            let across = (at(x + 1, y) - at(x.saturating_sub(1), y)).abs();
            across.max((at(x, y + 1) - at(x, y.saturating_sub(1))).abs())
        });
        Light { paper, ink, tint, contrast }
    }

    /// The grey level of a pixel of the bare board.
    fn level(&self, at: (usize, usize), white: f32) -> f32 {
        white * self.paper[at] + (1.0 - white) * self.ink[at]
    }

    /// The colour of a pixel of the bare board.
    fn expected(&self, at: (usize, usize), white: f32) -> [u8; 3] {
        let [red, blue] = self.tint;
        let green = self.level(at, white) / (0.299 * red + 0.587 + 0.114 * blue);
        [red * green, green, blue * green].map(|c| c.round() as u8)
    }

    /// Whether a grey level may be that of a shadow on paper.
    fn is_shadow(&self, at: (usize, usize), seen: f32, white: f32) -> bool {
        let (paper, ink) = (self.paper[at], self.ink[at]);
        white > 0.5 && seen < self.level(at, white) && seen > ink + DARKEST_SHADOW * white * (paper - ink)
    }

    /// The larger difference of red and of blue from what they are on paper and ink, grey levels.
    fn tinted(&self, color: [u8; 3]) -> f32 {
        let [r, g, b] = color.map(f32::from);
        (r - self.tint[0] * g).abs().max((b - self.tint[1] * g).abs())
    }

    /// The likelihood of a colour where the board is bare, relative to the most likely one.
    fn likelihood(&self, at: (usize, usize), color: [u8; 3], white: f32) -> f32 {
        let seen = grey(color);
        let deviation = LEVEL + OWN_EDGE * self.contrast[at] * (self.paper[at] - self.ink[at]).abs();
        let bell = |deviations: f32| (-0.5 * deviations * deviations).exp();
        let of_level = bell((seen - self.level(at, white)) / deviation);
        let of_level = if self.is_shadow(at, seen, white) { of_level.max(SHADOW) } else { of_level };
        of_level * bell(self.tinted(color) / TINTED)
    }

    /// 1 if a pixel agrees with the print, 0 if it does not.
    fn agreement(&self, at: (usize, usize), color: [u8; 3], white: f32) -> f32 {
        let (paper, ink) = (self.paper[at], self.ink[at]);
        let seen = grey(color);
        if self.tinted(color) > TINT * paper.max(1.0) {
            return 0.0;
        }
        // Noise, and an error of the board's pose by a fraction of a pixel at edges between ink and paper.
        let deviation = 12.0 + EDGE * self.contrast[at] * (paper - ink).abs();
        if ((seen - self.level(at, white)) / deviation).abs() < 2.0 {
            return 1.0;
        }
        // A shadow makes paper darker.
        if self.is_shadow(at, seen, white) { 0.7 } else { 0.0 }
    }
}

/// How white the board is at each pixel, 0 to 1; `None` at pixels outside the board.
fn printed(view: &View, board: &Board) -> Image<Option<f32>> {
    let (width, height) = view.image.size();
    let world_from_camera = view.camera_from_world.inverse();
    let at = |x: f64, y: f64| {
        let direction = world_from_camera
            .transform_direction(&view.camera.unproject(&sixfold_geometry::Vec2::new(x, y), 1.0));
        let distance = -view.eye.z / direction.z;
        if !(distance > 0.0) {
            return None;
        }
        let hit: Vec3 = view.eye + direction * distance;
        board.is_white(hit.x, hit.y)
    };
    Image::from_fn(width, height, |x, y| {
        let mut sum = 0.0;
        for i in 0..9 {
            let offset = |k: usize| (k as f64 - 1.0) / 3.0;
            let white = at(x as f64 + offset(i % 3), y as f64 + offset(i / 3))?;
            sum += f32::from(u8::from(white));
        }
        Some(sum / 9.0)
    })
}

/// The mean over the square around each pixel, clipped to the image, by running sums.
pub(crate) fn box_mean(image: &Image<f32>, radius: usize) -> Image<f32> {
    let (width, height) = image.size();
    let mut rows = image.clone();
    let mut sums = vec![0.0f64; width + 1];
    for row in rows.as_mut_slice().chunks_mut(width) {
        for (i, value) in row.iter().enumerate() {
            sums[i + 1] = sums[i] + f64::from(*value);
        }
        for (i, value) in row.iter_mut().enumerate() {
            let (from, to) = (i.saturating_sub(radius), (i + radius + 1).min(width));
            *value = ((sums[to] - sums[from]) / (to - from) as f64) as f32;
        }
    }
    // Vertically, for all columns at once.
    let mut out = image.clone();
    let mut sums = vec![0.0f64; width];
    let line = |y: usize| &rows.as_slice()[y * width..(y + 1) * width];
    (0..radius.min(height)).for_each(|y| sums.iter_mut().zip(line(y)).for_each(|(s, v)| *s += f64::from(*v)));
    for (y, row) in out.as_mut_slice().chunks_mut(width).enumerate() {
        if y + radius < height {
            sums.iter_mut().zip(line(y + radius)).for_each(|(s, v)| *s += f64::from(*v));
        }
        if y > radius {
            sums.iter_mut().zip(line(y - radius - 1)).for_each(|(s, v)| *s -= f64::from(*v));
        }
        let count = ((y + radius + 1).min(height) - y.saturating_sub(radius)) as f64;
        row.iter_mut().zip(&sums).for_each(|(value, sum)| *value = (sum / count) as f32);
    }
    out
}

fn combined(a: &Image<f32>, b: &Image<f32>, f: impl Fn(f32, f32) -> f32) -> Image<f32> {
    let (w, h) = a.size();
    let values = a.as_slice().iter().zip(b.as_slice()).map(|(a, b)| f(*a, *b)).collect();
    Image::from_vec(w, h, values).unwrap_or_else(|_| a.clone())
}

/// Probabilities smoothed within, not across, the edges of a grey image.
fn guided(p: &Image<f32>, image: &RgbImage) -> Image<f32> {
    let (radius, eps) = FILTER;
    let guide = image.map(|c| grey(*c) / 255.0);
    let mean = |image: &Image<f32>| box_mean(image, radius);
    let (mean_i, mean_p) = (mean(&guide), mean(p));
    let corr_ip = mean(&combined(&guide, p, |i, p| i * p));
    let corr_ii = mean(&combined(&guide, &guide, |i, j| i * j));
    let cov = combined(&corr_ip, &combined(&mean_i, &mean_p, |i, p| i * p), |a, b| a - b);
    let var = combined(&corr_ii, &combined(&mean_i, &mean_i, |i, j| i * j), |a, b| a - b);
    let a = combined(&cov, &var, |c, v| c / (v + eps));
    let b = combined(&mean_p, &combined(&a, &mean_i, |a, i| a * i), |p, ai| p - ai);
    let (mean_a, mean_b) = (mean(&a), mean(&b));
    combined(&combined(&mean_a, &guide, |a, i| a * i), &mean_b, |ai, b| (ai + b).clamp(0.0, 1.0))
}

/// A field from the consensus of the views, from log-odds: below zero where a voxel belongs to the object.
pub(crate) fn consensus(
    views: &[(View, Image<f32>)],
    volume: &Volume,
    cells: usize,
    floor: Option<Plane>,
) -> Grid {
    let grid = Grid::new(volume, cells, |point| {
        if floor.is_some_and(|floor| floor.distance(point) < 0.0) {
            return 1.0;
        }
        let (mut sum, mut shown, mut empty) = (0.0, 0, 0);
        for (view, odds) in views {
            let Some((pixel, _)) = view.project(point) else { continue };
            let value = bilinear(odds, pixel.x, pixel.y).clamp(-MOST, MOST);
            sum += value;
            shown += 1;
            empty += usize::from(value < -0.5);
        }
        let most = (DISSENT * shown as f64).floor() as usize;
        if shown < 2 || empty > most { 1.0 } else { -sum / shown as f32 }
    });
    grid.smoothed(0.7)
}

/// Histograms of the colours of the object and of its surroundings.
struct Colors {
    object: Vec<f32>,
    beside: Vec<f32>,
}

/// The bin of a colour in a histogram with so many bins per channel.
pub(crate) fn bin(color: [u8; 3], bins: usize) -> usize {
    let [r, g, b] = color.map(|c| usize::from(c) * bins / 256);
    (r * bins + g) * bins + b
}

impl Colors {
    fn new(image: &RgbImage, odds: &Image<f32>, shape: &Mask, grown: &Mask) -> Colors {
        let mut colors = Colors { object: vec![0.05; BINS.pow(3)], beside: vec![0.05; BINS.pow(3)] };
        for (i, color) in image.as_slice().iter().enumerate() {
            let odds = odds.as_slice()[i];
            if shape.as_slice()[i] && odds > 0.0 {
                colors.object[bin(*color, BINS)] += 1.0;
            } else if !grown.as_slice()[i] || odds < -1.0 {
                colors.beside[bin(*color, BINS)] += 1.0;
            }
        }
        for histogram in [&mut colors.object, &mut colors.beside] {
            let total: f32 = histogram.iter().sum();
            histogram.iter_mut().for_each(|n| *n /= total);
        }
        colors
    }

    fn odds(&self, color: [u8; 3]) -> f32 {
        let bin = bin(color, BINS);
        (self.object[bin] / self.beside[bin]).ln().clamp(-MOST, MOST)
    }
}

/// The mask of a view from its cues and from the rough shape that all views agree on.
pub(crate) fn mask(view: &View, cues: &Cues, shape: &Grid) -> Mask {
    if let Some(mask) = &view.mask {
        return mask.clone();
    }
    let covered = covered(view, shape);
    // The possible error of the rough shape: two voxels.
    let margin =
        (2.5 * shape.step * view.camera.fx / (view.eye - shape_centre(shape)).norm()).ceil() as usize;
    let grown = covered.grown(margin.max(2));
    let odds = cues.sum();
    let colors = Colors::new(&view.image, &odds, &covered, &grown);
    let (w, h) = view.image.size();
    let p = Image::from_fn(w, h, |x, y| {
        if !grown[(x, y)] {
            return 0.0;
        }
        let inside = if covered[(x, y)] { 1.5 } else { -0.5 };
        let sum = 0.8 * odds[(x, y)] + 0.5 * colors.odds(view.image[(x, y)]) + inside;
        1.0 / (1.0 + (-sum).exp())
    });
    let smooth = guided(&p, &view.image);
    let mask = Image::from_fn(w, h, |x, y| grown[(x, y)] && smooth[(x, y)] > 0.5);
    without_specks(&mask, SMALLEST_HOLE)
}

pub(crate) fn shape_centre(shape: &Grid) -> Vec3 {
    let last = shape.point(shape.size.map(|n| n - 1));
    (shape.low + last) * 0.5
}

/// The pixels of a view that a shape covers.
pub(crate) fn covered(view: &View, shape: &Grid) -> Mask {
    let (w, h) = view.image.size();
    let Some(mesh) = crate::surface::surface(shape) else { return Image::filled(w, h, false) };
    let depth = sixfold_render::render_depth(&mesh, &view.camera_from_world, &view.camera);
    depth.map(|d| *d > 0.0)
}

/// The largest part of a mask and others of at least a fifth of it, with holes of fewer pixels than the largest part divided by
/// `smallest_hole` filled.
pub(crate) fn without_specks(mask: &Mask, smallest_hole: usize) -> Mask {
    let inside = parts(mask, true);
    let largest = inside.first().map_or(0, Vec::len);
    let (w, h) = mask.size();
    let mut out = Image::filled(w, h, false);
    for part in inside.iter().filter(|p| 5 * p.len() >= largest) {
        part.iter().for_each(|i| out.as_mut_slice()[*i] = true);
    }
    let small = largest / smallest_hole;
    for hole in parts(&out, false).iter().filter(|hole| hole.len() <= small) {
        hole.iter().for_each(|i| out.as_mut_slice()[*i] = true);
    }
    out
}

/// A mask with everything that it encloses.
pub(crate) fn without_holes(mask: &Mask) -> Mask {
    let (w, h) = mask.size();
    let mut filled = mask.clone();
    let at_border = |i: &usize| [0, w - 1].contains(&(i % w)) || [0, h - 1].contains(&(i / w));
    for hole in parts(mask, false).iter().filter(|hole| !hole.iter().any(at_border)) {
        hole.iter().for_each(|i| filled.as_mut_slice()[*i] = true);
    }
    filled
}

/// Connected pixels of a value, largest part first.
fn parts(mask: &Mask, of: bool) -> Vec<Vec<usize>> {
    let (w, h) = mask.size();
    let mut seen = vec![false; w * h];
    let mut parts = vec![];
    for start in 0..w * h {
        if seen[start] || mask.as_slice()[start] != of {
            continue;
        }
        seen[start] = true;
        let mut part = vec![start];
        let mut next = 0;
        while next < part.len() {
            let (x, y) = (part[next] % w, part[next] / w);
            let around = [
                (x > 0).then(|| part[next] - 1),
                (x + 1 < w).then(|| part[next] + 1),
                (y > 0).then(|| part[next] - w),
                (y + 1 < h).then(|| part[next] + w),
            ];
            for i in around.into_iter().flatten() {
                if !seen[i] && mask.as_slice()[i] == of {
                    seen[i] = true;
                    part.push(i);
                }
            }
            next += 1;
        }
        parts.push(part);
    }
    parts.sort_by_key(|p| std::cmp::Reverse(p.len()));
    parts
}

/// Masks of all views.
pub(crate) fn masks(views: &[(View, Cues)], shape: &Grid, floor: Option<Plane>) -> Vec<Mask> {
    let rough: Vec<Mask> = views.par_iter().map(|(view, cues)| mask(view, cues, shape)).collect();
    exact(views, &rough, shape, floor)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mean_is_that_of_the_pixels_in_the_square() {
        let image = Image::from_fn(9, 7, |x, y| (x * x + 3 * y) as f32);
        for radius in [1, 3, 20] {
            let found = box_mean(&image, radius);
            for y in 0..7usize {
                for x in 0..9usize {
                    let (mut sum, mut count) = (0.0, 0.0);
                    for v in y.saturating_sub(radius)..(y + radius + 1).min(7) {
                        for u in x.saturating_sub(radius)..(x + radius + 1).min(9) {
                            sum += image[(u, v)];
                            count += 1.0;
                        }
                    }
                    assert!((found[(x, y)] - sum / count).abs() < 1e-3);
                }
            }
        }
    }

    #[test]
    fn specks_go_and_small_holes_close() {
        let disc = |x: usize, y: usize, u: f64, v: f64, r: f64| (x as f64 - u).hypot(y as f64 - v) < r;
        let mask = Image::from_fn(60, 60, |x, y| {
            (disc(x, y, 30.0, 30.0, 20.0) && !disc(x, y, 25.0, 25.0, 2.0)) || disc(x, y, 55.0, 5.0, 3.0)
        });
        let clean = without_specks(&mask, 50);
        assert!(clean[(25, 25)] && !clean[(55, 5)] && clean[(30, 45)] && !clean[(2, 2)]);
    }
}
