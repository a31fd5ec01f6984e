//! Detection of tags in an image: dark regions by a local threshold, quadrangles around them, corners refined at the edges, then
//! codes (following Olson 2011, and Wang and Olson 2016).

use rayon::prelude::*;
use sixfold_geometry::homography::{apply, homography};
use sixfold_geometry::{Image, Mat3, RgbImage, Vec2};

use crate::family::{CELLS, Cells, SIDE, decode, mirrored};
use crate::quad::{Quad, around, brightness, convex_hull, refined};

/// Minimum difference of grey levels around a pixel that is classified as black or white.
const CONTRAST: u8 = 24;
/// Minimum number of pixels of a dark region that can be a tag's border.
const FEWEST_PIXELS: usize = 40;

/// A tag in an image.
#[derive(Debug, Clone, PartialEq)]
pub struct Tag {
    /// Its number in the family 36h11.
    pub id: usize,
    /// Corners of its black square in pixels: top left, top right, bottom right, bottom left of the upright tag.
    pub corners: [Vec2; 4],
    /// Width of its two widest edges, pixels: the distance over which brightness changes from black to white, 1 to 3 in a sharp
    /// image.
    pub edge_width: f64,
}

impl Tag {
    /// Mean length of its sides, pixels.
    pub fn side(&self) -> f64 {
        (0..4).map(|i| (self.corners[(i + 1) % 4] - self.corners[i]).norm()).sum::<f64>() / 4.0
    }
}

/// The tags in an image.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Detections {
    /// The tags, by number, then from left to right. A number may occur several times.
    pub tags: Vec<Tag>,
    /// Number of mirrored tags.
    pub mirrored: usize,
}

/// The tags in an image. Pixel centres at whole numbers; corners are in the stored image, lens distortion included.
pub fn detect_tags(image: &RgbImage) -> Detections {
    let grey =
        image.map(|[r, g, b]| ((77 * u32::from(*r) + 150 * u32::from(*g) + 29 * u32::from(*b)) >> 8) as u8);
    let regions = dark_regions(&grey);
    let read: Vec<_> =
        regions.into_par_iter().filter_map(|mut points| read_tag(&grey, &mut points)).collect();
    let mut found = Detections::default();
    for tag in read {
        match tag {
            Some(tag) => found.tags.push(tag),
            None => found.mirrored += 1,
        }
    }
    found.tags.sort_by(|a, b| a.id.cmp(&b.id).then(a.corners[0].x.total_cmp(&b.corners[0].x)));
    found
}

/// The tag whose border consists of these points: `Some(None)` for a mirrored one.
fn read_tag(grey: &Image<u8>, points: &mut Vec<(i32, i32)>) -> Option<Option<Tag>> {
    let quad = around(&convex_hull(points))?;
    // A cheap test first: most dark regions are not tags.
    read_cells(grey, &quad, 0.2)?;
    let (quad, slope) = refined(grey, &quad)?;
    let (cells, contrast) = read_cells(grey, &quad, 0.4)?;
    match decode(&cells) {
        Some((id, rotation)) => {
            let corners = std::array::from_fn(|i| quad[(i + rotation) % 4]);
            Some(Some(Tag { id, corners, edge_width: contrast / slope }))
        }
        None => decode(&mirrored(&cells)).map(|_| None),
    }
}

/// The cells inside a quadrangle, and the contrast in grey levels. `None` unless its border is dark and its surroundings are
/// bright by at least the fraction `clear` of the contrast.
fn read_cells(grey: &Image<u8>, quad: &Quad, clear: f64) -> Option<(Cells, f64)> {
    let side = SIDE as f64;
    let square = [(0.0, 0.0), (side, 0.0), (side, side), (0.0, side)].map(|(x, y)| Vec2::new(x, y));
    let pairs: Vec<(Vec2, Vec2)> = square.into_iter().zip(*quad).collect();
    let image_from_tag = homography(&pairs)?;
    let mut white = Vec::new();
    let mut black = Vec::new();
    for i in -1..=SIDE as i32 {
        for (u, v) in [(i, -1), (i, SIDE as i32), (-1, i), (SIDE as i32, i)] {
            white.extend(level(grey, &image_from_tag, u, v));
        }
        if (0..SIDE as i32).contains(&i) {
            for (u, v) in [(i, 0), (i, SIDE as i32 - 1), (0, i), (SIDE as i32 - 1, i)] {
                black.extend(level(grey, &image_from_tag, u, v));
            }
        }
    }
    // If the image's border cuts off the tag's surroundings, half of them are enough.
    if white.len() < 2 * SIDE || black.len() < 4 * SIDE {
        return None;
    }
    let (bright, dark) = (Gradient::fitted(&white)?, Gradient::fitted(&black)?);
    let contrast = bright.mean - dark.mean;
    if contrast < 0.5 * f64::from(CONTRAST) {
        return None;
    }
    let misfit = |levels: &[(f64, f64, f64)], of: &Gradient| {
        let sum: f64 = levels.iter().map(|(u, v, level)| (level - of.at(*u, *v)).abs()).sum();
        sum / levels.len() as f64
    };
    if misfit(&black, &dark) > (1.0 - clear) * 0.5 * contrast {
        return None;
    }
    let mut cells: Cells = [[false; CELLS]; CELLS];
    for (row, line) in cells.iter_mut().enumerate() {
        for (column, cell) in line.iter_mut().enumerate() {
            let (u, v, level) = level(grey, &image_from_tag, column as i32 + 1, row as i32 + 1)?;
            *cell = level > 0.5 * (bright.at(u, v) + dark.at(u, v));
        }
    }
    Some((cells, contrast))
}

/// Mean brightness at the centre of a cell, with the cell's centre.
fn level(grey: &Image<u8>, image_from_tag: &Mat3, column: i32, row: i32) -> Option<(f64, f64, f64)> {
    let (u, v) = (f64::from(column) + 0.5, f64::from(row) + 0.5);
    let mut sum = 0.0;
    for (du, dv) in [(0.0, 0.0), (-0.2, -0.2), (0.2, -0.2), (-0.2, 0.2), (0.2, 0.2)] {
        sum += brightness(grey, &apply(image_from_tag, &Vec2::new(u + du, v + dv))?)?;
    }
    Some((u, v, sum / 5.0))
}

/// Brightness that changes linearly over a tag, for light from one side.
struct Gradient {
    mean: f64,
    centre: (f64, f64),
    slope: (f64, f64),
}

impl Gradient {
    fn fitted(levels: &[(f64, f64, f64)]) -> Option<Gradient> {
        let n = levels.len() as f64;
        let sums = levels.iter().fold((0.0, 0.0, 0.0), |s, l| (s.0 + l.0, s.1 + l.1, s.2 + l.2));
        let (mu, mv, mean) = (sums.0 / n, sums.1 / n, sums.2 / n);
        let (mut uu, mut uv, mut vv, mut ul, mut vl) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for (u, v, level) in levels {
            let (u, v, level) = (u - mu, v - mv, level - mean);
            uu += u * u;
            uv += u * v;
            vv += v * v;
            ul += u * level;
            vl += v * level;
        }
        let det = uu * vv - uv * uv;
        let slope = ((ul * vv - vl * uv) / det, (vl * uu - ul * uv) / det);
        (det > 0.0).then_some(Gradient { mean, centre: (mu, mv), slope })
    }

    fn at(&self, u: f64, v: f64) -> f64 {
        self.mean + self.slope.0 * (u - self.centre.0) + self.slope.1 * (v - self.centre.1)
    }
}

/// Pixels that are darker than the mean of the darkest and the brightest pixel around them, where these differ enough.
fn dark_pixels(grey: &Image<u8>) -> Image<bool> {
    let (width, height) = grey.size();
    let tile = (width.min(height) / 160).clamp(4, 32);
    let (columns, rows) = (width.div_ceil(tile), height.div_ceil(tile));
    let mut extremes = Image::filled(columns, rows, (u8::MAX, u8::MIN));
    for y in 0..height {
        for (x, level) in grey.row(y).iter().enumerate() {
            let (low, high) = &mut extremes[(x / tile, y / tile)];
            *low = (*low).min(*level);
            *high = (*high).max(*level);
        }
    }
    let around = Image::from_fn(columns, rows, |i, j| {
        let mut all = (u8::MAX, u8::MIN);
        for y in j.saturating_sub(1)..(j + 2).min(rows) {
            for x in i.saturating_sub(1)..(i + 2).min(columns) {
                let (low, high) = extremes[(x, y)];
                all = (all.0.min(low), all.1.max(high));
            }
        }
        all
    });
    Image::from_fn(width, height, |x, y| {
        let (low, high) = around[(x / tile, y / tile)];
        let mid_grey = low + (high - low) / 2;
        high - low >= CONTRAST && grey[(x, y)] < mid_grey
    })
}

/// Connected dark regions: the outermost pixels of every row and column of each.
fn dark_regions(grey: &Image<u8>) -> Vec<Vec<(i32, i32)>> {
    let mut dark = dark_pixels(grey);
    let (width, height) = dark.size();
    let mut regions = vec![];
    let mut waiting = vec![];
    let mut region: Vec<(i32, i32)> = vec![];
    for y in 0..height {
        for x in 0..width {
            if !dark[(x, y)] {
                continue;
            }
            region.clear();
            dark[(x, y)] = false;
            waiting.push((x, y));
            while let Some((x, y)) = waiting.pop() {
                region.push((x as i32, y as i32));
                let mut visit = |x: usize, y: usize| {
                    if dark[(x, y)] {
                        dark[(x, y)] = false;
                        waiting.push((x, y));
                    }
                };
                if x > 0 {
                    visit(x - 1, y);
                }
                if x + 1 < width {
                    visit(x + 1, y);
                }
                if y > 0 {
                    visit(x, y - 1);
                }
                if y + 1 < height {
                    visit(x, y + 1);
                }
            }
            if region.len() >= FEWEST_PIXELS {
                regions.push(outermost(&mut region));
            }
        }
    }
    regions
}

/// The first and last pixel of every row: only these can be corners of a region's hull.
fn outermost(region: &mut [(i32, i32)]) -> Vec<(i32, i32)> {
    region.sort_unstable_by_key(|(x, y)| (*y, *x));
    let mut ends = vec![];
    for row in region.chunk_by(|a, b| a.1 == b.1) {
        ends.extend(row.first());
        ends.extend(row.last());
    }
    ends
}
