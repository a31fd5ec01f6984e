//! The hand-crafted descriptor: compares all templates of an object with a region of the scene, exhaustively.
//!
//! A template is some points of its surface, each in a cell of the region, with depth and normal. A cell agrees when its depth is
//! near the template's and its normal has about the same direction. It contradicts when the scene is further away (one would see
//! through the object). It does not count when the scene is in front (hidden) or nothing was measured. In contrast to a distance
//! between descriptors of whole regions, the surroundings have no influence and occluders have little. Sixteen regions are compared
//! at a time, with one number of each in a SIMD vector.

use rayon::prelude::*;
use sixfold_geometry::{OptionError, Vec3};

use crate::roi::{Cell, GRID, UNKNOWN};
use crate::template::{ObjectTemplates, SIDE, Template};

/// Regions compared at a time: the single-precision numbers of a vector of 512 bits.
pub const LANES: usize = 16;
/// Points of a template that are compared; chosen by hand, not swept.
const POINTS: usize = 64;

/// How agreement is counted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MatchOptions {
    /// Depths agree within this fraction of the diameter.
    pub depth: f64,
    /// Smallest and largest tolerance, metres.
    pub limits: (f64, f64),
    /// Weight of hidden or unmeasured points, relative to visible ones, so that a template of which little is visible scores lower.
    pub hidden: f32,
}

/// [`MatchOptions::depth`]; chosen by hand, not swept.
const DEPTH: f64 = 0.14;
/// [`MatchOptions::limits`]; chosen by hand, not swept.
const LIMITS: (f64, f64) = (0.012, 0.03);
/// [`MatchOptions::hidden`]; chosen by hand, not swept.
const HIDDEN: f32 = 0.25;
/// An entry is left out when fewer than one in this many of its [`POINTS`] are within the region; chosen by hand, not swept.
const KEPT: usize = 4;
/// Weight of a cell's depth, and of the squared cosine between the normals ([`BY_NORMALS`]): normals at edges are unreliable.
/// Chosen by hand; not swept.
const DEPTH_ALONE: f32 = 0.2;
/// See [`DEPTH_ALONE`]; the two sum to 1.
const BY_NORMALS: f32 = 0.8;

impl Default for MatchOptions {
    fn default() -> Self {
        MatchOptions { depth: DEPTH, limits: LIMITS, hidden: HIDDEN }
    }
}

impl MatchOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_positive("matching.depth", self.depth, "a fraction of the diameter above 0")?;
        let (low, high) = self.limits;
        let ordered = low > 0.0 && low <= high && high.is_finite();
        if !ordered {
            let expected = "metres above 0, the smaller first";
            return Err(OptionError::new("matching.limits", format!("{low}, {high}"), expected));
        }
        OptionError::unless_within("matching.hidden", self.hidden, 0.0..=1.0, "0 to 1")
    }
}

/// A view at an in-plane rotation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Entry {
    /// Number of the template.
    pub template: usize,
    /// In-plane rotation, radians: ROI from view.
    pub turn: f64,
}

/// A match: its score (0 to 1) and its entry.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// Agreement.
    pub score: f32,
    /// Number of the entry in [`Matcher::entries`].
    pub entry: usize,
}

#[derive(Debug, Clone, Copy)]
struct Point {
    cell: u32,
    depth: f32,
    normal: [f32; 3],
}

/// Templates prepared for the comparison.
#[derive(Debug, Clone)]
pub struct Matcher {
    entries: Vec<Entry>,
    /// Entries of the first matching: every other in-plane rotation.
    coarse: Vec<usize>,
    /// Points of all entries, one entry after another, and where each entry's points begin.
    points: Vec<Point>,
    starts: Vec<usize>,
    tolerance: f32,
    hidden: f32,
}

/// Interleaved regions: for every cell, each of its four numbers for all regions.
type Block = Vec<[[f32; LANES]; 4]>;

impl Matcher {
    /// Prepares the templates, each at all of its in-plane rotations.
    pub fn new(object: &ObjectTemplates, options: &MatchOptions) -> Matcher {
        let turns = object.turns();
        let per_template: Vec<Vec<(Entry, Vec<Point>)>> = object
            .templates
            .par_iter()
            .enumerate()
            .map(|(number, template)| {
                let chosen = chosen_points(template, object.size);
                turns
                    .iter()
                    .map(|&turn| (Entry { template: number, turn }, rotated(&chosen, turn)))
                    .filter(|(_, points)| points.len() >= POINTS / KEPT)
                    .collect()
            })
            .collect();
        let tolerance = (options.depth * object.diameter).clamp(options.limits.0, options.limits.1) as f32;
        let mut matcher = Matcher {
            entries: vec![],
            coarse: vec![],
            points: vec![],
            starts: vec![0],
            tolerance,
            hidden: options.hidden,
        };
        let every_other: Vec<f64> = turns.iter().copied().step_by(2).collect();
        for (entry, mut points) in per_template.into_iter().flatten() {
            if every_other.contains(&entry.turn) {
                matcher.coarse.push(matcher.entries.len());
            }
            matcher.entries.push(entry);
            matcher.points.append(&mut points);
            matcher.starts.push(matcher.points.len());
        }
        matcher
    }

    /// The views with their in-plane rotations.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// The depth tolerance, metres.
    pub fn tolerance(&self) -> f64 {
        f64::from(self.tolerance)
    }

    /// The best entry for every region, given by their cells: every view at every other in-plane rotation; the alignment and the
    /// second matching correct the remaining 15 degrees.
    pub fn best<'a>(&self, count: usize, cells: impl Fn(usize) -> Vec<Cell> + Sync + 'a) -> Vec<Match> {
        let blocks: Vec<Vec<Match>> = (0..count.div_ceil(LANES))
            .into_par_iter()
            .map(|b| {
                let range = b * LANES..((b + 1) * LANES).min(count);
                let block = side_by_side(range.clone().map(&cells));
                let mut best = [Match { score: 0.0, entry: 0 }; LANES];
                for &entry in &self.coarse {
                    let scores = self.compare(&block, entry);
                    for (best, score) in best.iter_mut().zip(scores) {
                        if score > best.score {
                            *best = Match { score, entry };
                        }
                    }
                }
                best[..range.len()].to_vec()
            })
            .collect();
        blocks.concat()
    }

    /// All entries against a few regions (at most [`LANES`]) that show the same part of the scene from slightly shifted centres:
    /// each entry's best score over the regions and the number of that region, best first.
    pub fn ranked(&self, regions: &[Vec<Cell>]) -> Vec<(Match, usize)> {
        let block = side_by_side(regions.iter().take(LANES).cloned());
        let mut ranked: Vec<(Match, usize)> = (0..self.entries.len())
            .map(|entry| {
                let scores = self.compare(&block, entry);
                let best = (0..regions.len().min(LANES))
                    .max_by(|&a, &b| scores[a].total_cmp(&scores[b]).then(b.cmp(&a)))
                    .unwrap_or(0);
                (Match { score: scores[best], entry }, best)
            })
            .collect();
        ranked.sort_by(|a, b| b.0.score.total_cmp(&a.0.score).then(a.0.entry.cmp(&b.0.entry)));
        ranked
    }

    /// Agreement of an entry with the regions of a block.
    fn compare(&self, block: &Block, entry: usize) -> [f32; LANES] {
        let points = &self.points[self.starts[entry]..self.starts[entry + 1]];
        let (tolerance, inverse) = (self.tolerance, 1.0 / self.tolerance);
        let (mut good, mut behind, mut hidden) = ([0f32; LANES], [0f32; LANES], [0f32; LANES]);
        for p in points {
            let [depth, nx, ny, nz] = &block[p.cell as usize];
            for l in 0..LANES {
                let off = depth[l] - p.depth;
                let cosine = nx[l] * p.normal[0] + ny[l] * p.normal[1] + nz[l] * p.normal[2];
                let near = 1.0 - off.abs() * inverse;
                let near = if near > 0.0 { near } else { 0.0 };
                let facing = if cosine > 0.0 { cosine } else { 0.0 };
                good[l] += near * (DEPTH_ALONE + BY_NORMALS * facing * facing);
                behind[l] += if off > tolerance { 1.0 } else { 0.0 };
                hidden[l] += if off < -tolerance { 1.0 } else { 0.0 };
            }
        }
        let all = points.len() as f32;
        std::array::from_fn(|l| good[l] / (all - (1.0 - self.hidden) * hidden[l]) * (1.0 - behind[l] / all))
    }
}

fn side_by_side(regions: impl Iterator<Item = Vec<Cell>>) -> Block {
    let mut block: Block = vec![UNKNOWN.map(|v| [v; LANES]); GRID * GRID];
    for (lane, cells) in regions.enumerate() {
        for (place, cell) in block.iter_mut().zip(cells) {
            for (numbers, value) in place.iter_mut().zip(cell) {
                numbers[lane] = value;
            }
        }
    }
    block
}

/// A point of a template with its position in the patch (pixels from the centre).
struct Chosen {
    place: [f64; 2],
    depth: f64,
    normal: Vec3,
}

/// Points spread evenly over the visible surface of a template.
fn chosen_points(template: &Template, size: f64) -> Vec<Chosen> {
    let (cloud, pixels) = template.cloud(size);
    let centre = (SIDE as f64 - 1.0) / 2.0;
    // Every n-th pixel of a row, rows alternately shifted, spaced to give about the wanted number.
    let spacing = (cloud.len() as f64 / POINTS as f64).sqrt().max(1.0);
    let mut taken = std::collections::BTreeSet::new();
    let mut chosen = vec![];
    for (i, &[x, y]) in pixels.iter().enumerate() {
        let row = (y as f64 / spacing) as usize;
        let column = (x as f64 / spacing + if row.is_multiple_of(2) { 0.0 } else { 0.5 }) as usize;
        if taken.insert((row, column)) {
            chosen.push(Chosen {
                place: [x as f64 - centre, y as f64 - centre],
                depth: cloud.points[i].z,
                normal: cloud.normals[i],
            });
        }
    }
    chosen
}

fn rotated(chosen: &[Chosen], turn: f64) -> Vec<Point> {
    let (sin, cos) = turn.sin_cos();
    let scale = GRID as f64 / SIDE as f64;
    chosen
        .iter()
        .filter_map(|c| {
            let [x, y] = c.place;
            let (u, v) = (cos * x - sin * y, sin * x + cos * y);
            let column = (u * scale + 0.5 * GRID as f64).floor();
            let row = (v * scale + 0.5 * GRID as f64).floor();
            let inside = |k: f64| (0.0..GRID as f64).contains(&k);
            let n = c.normal;
            (inside(column) && inside(row)).then(|| Point {
                cell: (row as usize * GRID + column as usize) as u32,
                depth: c.depth as f32,
                normal: [(cos * n.x - sin * n.y) as f32, (sin * n.x + cos * n.y) as f32, n.z as f32],
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::template::{Source, TemplateOptions};
    use sixfold_geometry::Pose;

    /// A roof whose ridge runs across the patch, seen from above: only a rotation by half a turn looks the same.
    fn roof() -> ObjectTemplates {
        let depth = (0..SIDE * SIDE)
            .map(|i| {
                let (x, y) = ((i % SIDE) as f64 - 31.5, (i / SIDE) as f64 - 31.5);
                if x.abs() < 24.0 && y.abs() < 16.0 { Template::stored(0.0015 * y.abs()) } else { 0 }
            })
            .collect();
        let template = Template { view_from_object: Pose::identity(), distance: 0.8, depth };
        ObjectTemplates {
            diameter: 0.12,
            size: 0.14,
            options: TemplateOptions::default(),
            source: Source::Mesh,
            made_from: 0,
            templates: vec![template],
        }
    }

    /// The roof's cells rotated by an angle.
    fn cells(turn: f64) -> Vec<Cell> {
        let mut cells = vec![[0.2, 0.0, 0.0, -1.0]; GRID * GRID];
        for p in rotated(&all_points(), turn) {
            let n = p.normal;
            cells[p.cell as usize] = [p.depth, n[0], n[1], n[2]];
        }
        cells
    }

    /// Every pixel of the roof.
    fn all_points() -> Vec<Chosen> {
        let object = roof();
        let (cloud, pixels) = object.templates[0].cloud(object.size);
        let place = |p: &[usize; 2]| [p[0] as f64 - 31.5, p[1] as f64 - 31.5];
        (0..pixels.len())
            .map(|i| Chosen { place: place(&pixels[i]), depth: cloud.points[i].z, normal: cloud.normals[i] })
            .collect()
    }

    #[test]
    fn options_out_of_range_are_named() {
        let options = MatchOptions::default();
        assert_eq!(options.check(), Ok(()));
        let named = |options: MatchOptions| options.check().unwrap_err().option;
        assert_eq!(named(MatchOptions { depth: f64::NAN, ..options }), "matching.depth");
        assert_eq!(named(MatchOptions { limits: (0.03, 0.012), ..options }), "matching.limits");
        assert_eq!(named(MatchOptions { limits: (f64::NAN, 0.012), ..options }), "matching.limits");
        assert_eq!(named(MatchOptions { hidden: -0.1, ..options }), "matching.hidden");
    }

    #[test]
    fn the_right_rotation_matches_best() {
        let object = roof();
        let matcher = Matcher::new(&object, &MatchOptions::default());
        assert_eq!(matcher.entries().len(), 7);
        for (number, turn) in object.turns().into_iter().enumerate() {
            let ranked = matcher.ranked(&[cells(turn)]);
            assert_eq!(ranked[0].0.entry, number, "{ranked:?}");
            assert!(ranked[0].0.score > 0.8, "{ranked:?}");
        }
    }

    #[test]
    fn hidden_cells_count_little_and_cells_seen_through_contradict() {
        let object = roof();
        let matcher = Matcher::new(&object, &MatchOptions::default());
        let seen = cells(0.0);
        let half = |with: Cell| -> Vec<Cell> {
            seen.iter().enumerate().map(|(i, c)| if i % GRID < GRID / 2 { with } else { *c }).collect()
        };
        let score = |cells: Vec<Cell>| {
            let ranked = matcher.ranked(&[cells]);
            ranked.iter().find(|r| r.0.entry == 3).map_or(0.0, |r| r.0.score)
        };
        let whole = score(seen.clone());
        let (hidden, unknown) = (score(half([-0.1, 0.0, 0.0, -1.0])), score(half(UNKNOWN)));
        let through = score(half([0.1, 0.0, 0.0, -1.0]));
        assert_eq!(hidden, unknown);
        assert!(hidden > 0.7 * whole && hidden < whole, "{hidden} {whole}");
        assert!(through < 0.4 * whole, "{through} {whole}");
    }

    #[test]
    fn one_region_or_many_at_once_is_the_same() {
        let matcher = Matcher::new(&roof(), &MatchOptions::default());
        let regions: Vec<Vec<Cell>> = (0..40).map(|k| cells(f64::from(k) * 0.02 - 0.4)).collect();
        let together = matcher.best(regions.len(), |i| regions[i].clone());
        for (region, matched) in regions.iter().zip(&together) {
            assert_eq!(matcher.best(1, |_| region.clone())[0], *matched);
        }
    }
}
