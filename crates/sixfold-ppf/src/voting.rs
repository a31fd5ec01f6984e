//! Voting for poses: for every scene reference point the votes determine the corresponding model point and the rotation about its
//! normal (Drost et al. 2010, section 3.4).
//!
//! With the improvements of Hinterstoisser et al. (2016) and Vidal et al. (2018): a feature near the border of its bin also votes
//! from the neighbouring bins, and a feature votes only once per reference point and rotation, so that large flat regions do not
//! dominate.

use std::f32::consts::PI;

use nalgebra::{Matrix3, Rotation3, UnitQuaternion};
use rayon::prelude::*;
use sixfold_geometry::{OptionError, PointCloud, Pose};

use crate::V3;
use crate::model::{BLOCK, FeatureTable, ObjectModel, fast_acos, local_frame, turn_about_normal};

/// A pose with its votes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hypothesis {
    /// The pose.
    pub camera_from_object: Pose,
    /// Votes, not comparable between objects.
    pub votes: f32,
}

/// How votes are cast and counted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VotingOptions {
    /// Every n-th scene point is a reference point (Drost et al. 2010: 5).
    pub reference_stride: usize,
    /// Maximum number of reference points; the stride grows to respect it.
    pub max_references: usize,
    /// Fraction of a bin at each border from which the neighbouring bin votes too; 0 for none.
    pub bin_margin: f32,
    /// Maximum number of peaks per reference point.
    pub peaks_per_reference: usize,
    /// Minimum votes of a peak, as a fraction of the reference point's best.
    pub peak_fraction: f32,
}

/// Every n-th scene point is a reference point (Drost et al. 2010: every fifth).
const REFERENCE_STRIDE: usize = 5;
/// Maximum number of reference points; chosen by hand for the run time of the voting, not swept.
const MAX_REFERENCES: usize = 2500;
/// Fraction of a bin at each border from which the neighbouring bin votes too. The idea is that of Hinterstoisser et al. (2016) and
/// Vidal et al. (2018); the number was chosen by hand, not swept.
const BIN_MARGIN: f32 = 0.25;
/// Maximum number of peaks per reference point; chosen by hand, not swept.
const PEAKS_PER_REFERENCE: usize = 4;
/// Minimum votes of a peak, as a fraction of the reference point's best; chosen by hand, not swept.
const PEAK_FRACTION: f32 = 0.7;
/// Neighbouring scene points whose normals differ by more than this angle are not merged when the scene is downsampled, degrees (as
/// in the model: [`crate::model`]). Chosen by hand; not swept.
pub(crate) const THINNING_ANGLE: f64 = 30.0;
/// Squared distance below which two points count as equal and have no feature, square metres: a hundredth of a millimetre.
const SAME_POINT: f32 = 1e-10;
/// Reference points per parallel task; does not affect the result.
const CHUNK: usize = 32;

impl Default for VotingOptions {
    fn default() -> Self {
        VotingOptions {
            reference_stride: REFERENCE_STRIDE,
            max_references: MAX_REFERENCES,
            bin_margin: BIN_MARGIN,
            peaks_per_reference: PEAKS_PER_REFERENCE,
            peak_fraction: PEAK_FRACTION,
        }
    }
}

impl VotingOptions {
    /// Checks every field.
    ///
    /// # Errors
    /// [`OptionError`] with the first field that is out of its range.
    pub fn check(&self) -> Result<(), OptionError> {
        OptionError::unless_some("voting.reference_stride", self.reference_stride)?;
        OptionError::unless_some("voting.max_references", self.max_references)?;
        OptionError::unless_within("voting.bin_margin", self.bin_margin, 0.0..=0.5, "0 to 0.5")?;
        OptionError::unless_some("voting.peaks_per_reference", self.peaks_per_reference)?;
        OptionError::unless_within("voting.peak_fraction", self.peak_fraction, 0.0..=1.0, "0 to 1")
    }
}

/// Steps of the rotation about the normal, 11.25 degrees each: Hinterstoisser et al. (2016) and Vidal et al. (2018) record the
/// votes already cast in the 32 bits of a word, one for each step, and so does this implementation.
const TURNS: usize = 32;

/// The scene cloud at the model's sampling step, sorted into cells of the model's diameter so that all partners of a point are in
/// 27 cells.
///
/// Cells grow if there would be more than [`MAX_CELLS`], as with points that a wrong unit puts kilometres apart; the partners found
/// are the same.
struct Grid {
    points: Vec<V3>,
    normals: Vec<V3>,
    low: V3,
    cell: f32,
    size: [usize; 3],
    starts: Vec<u32>,
    order: Vec<u32>,
}

/// Maximum number of cells of a [`Grid`]: 32 MB. A room with an object of 4 cm needs half of them.
const MAX_CELLS: f64 = (1u64 << 22) as f64;

impl Grid {
    fn new(cloud: &PointCloud, mut cell: f32) -> Option<Grid> {
        let points: Vec<V3> = cloud.points.iter().map(|p| p.cast()).collect();
        let normals = cloud.normals.iter().map(|n| n.cast()).collect();
        let first = *points.first()?;
        let (low, high) = points.iter().fold((first, first), |(a, b), p| (a.inf(p), b.sup(p)));
        if !(cell > 0.0) {
            return None;
        }
        let cells =
            |cell: f32| (0..3).map(|k| f64::from((high[k] - low[k]) / cell).floor() + 1.0).product::<f64>();
        while cells(cell) > MAX_CELLS {
            cell *= 2.0;
        }
        // For points that are not finite, or a cell without a size.
        if !cells(cell).is_finite() {
            return None;
        }
        let size: [usize; 3] = std::array::from_fn(|k| ((high[k] - low[k]) / cell) as usize + 1);
        let index = |p: &V3| {
            let c: [usize; 3] = std::array::from_fn(|k| (((p[k] - low[k]) / cell) as usize).min(size[k] - 1));
            (c[2] * size[1] + c[1]) * size[0] + c[0]
        };
        let mut starts = vec![0u32; size.iter().product::<usize>() + 1];
        for p in &points {
            starts[index(p) + 1] += 1;
        }
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let mut next = starts.clone();
        let mut order = vec![0; points.len()];
        for (i, p) in points.iter().enumerate() {
            let at = &mut next[index(p)];
            order[*at as usize] = i as u32;
            *at += 1;
        }
        Some(Grid { points, normals, low, cell, size, starts, order })
    }

    fn for_neighbours(&self, p: &V3, mut f: impl FnMut(usize)) {
        let centre: [isize; 3] = std::array::from_fn(|k| ((p[k] - self.low[k]) / self.cell) as isize);
        let range = |k: usize| {
            let low = (centre[k] - 1).max(0) as usize;
            let high = ((centre[k] + 1).max(0) as usize).min(self.size[k] - 1);
            low..=high
        };
        for z in range(2) {
            for y in range(1) {
                for x in range(0) {
                    let cell = (z * self.size[1] + y) * self.size[0] + x;
                    for &i in &self.order[self.starts[cell] as usize..self.starts[cell + 1] as usize] {
                        f(i as usize);
                    }
                }
            }
        }
    }
}

/// Poses for which the model's features vote in a scene cloud (points and normals in the camera frame), in the order of the
/// reference points; the result does not depend on the number of threads.
pub fn vote(model: &ObjectModel, cloud: &PointCloud, options: &VotingOptions) -> Vec<Hypothesis> {
    let step = model.diameter * model.options.sampling_step;
    let thinned = cloud.voxel_downsample(step, THINNING_ANGLE.to_radians());
    let Some(grid) = Grid::new(&thinned, model.diameter as f32) else { return vec![] };
    let minimum = grid.points.len().div_ceil(options.max_references.max(1));
    let stride = options.reference_stride.max(1).max(minimum);
    let references: Vec<usize> = (0..grid.points.len()).step_by(stride).collect();
    let model_points: Vec<V3> = model.samples.points.iter().map(|p| p.cast()).collect();
    let model_frames: Vec<[V3; 3]> = model.samples.normals.iter().map(|n| local_frame(&n.cast())).collect();
    references
        .par_chunks(CHUNK)
        .map(|chunk| {
            let mut counter = Counter::new(&model.table);
            let mut found = Vec::new();
            for &r in chunk {
                counter.collect(&grid, r, model.diameter as f32, &model.table, options.bin_margin);
                for peak in counter.peaks(model.samples.len(), &model.table, options) {
                    found.push(Hypothesis {
                        camera_from_object: pose_of(
                            &grid.points[r],
                            &local_frame(&grid.normals[r]),
                            &model_points[peak.reference],
                            &model_frames[peak.reference],
                            peak.angle,
                        ),
                        votes: peak.votes as f32,
                    });
                }
            }
            found
        })
        .collect::<Vec<_>>()
        .concat()
}

/// A row of the feature table that votes at one rotation.
struct RowVote {
    /// Index of the row's first block in [`FeatureTable::starts`].
    first: u32,
    /// Rotation of the scene pair about the normal, in 256ths.
    turn: u8,
}

/// A maximum of the votes of one reference point.
struct Peak {
    votes: u32,
    /// The model point.
    reference: usize,
    /// Rotation about the normal, radians.
    angle: f32,
}

/// The votes of one reference point.
struct Counter {
    /// Votes per model point of a block and rotation.
    votes: Box<[u16; BLOCK * TURNS]>,
    /// Per feature row, the rotations that have voted, one bit each; all bits for a row without entries.
    voted: Vec<u32>,
    touched: Vec<u32>,
    row_votes: Vec<RowVote>,
}

impl Counter {
    fn new(table: &FeatureTable) -> Counter {
        Counter {
            votes: Box::new([0; BLOCK * TURNS]),
            voted: table.silent.clone(),
            touched: vec![],
            row_votes: vec![],
        }
    }

    /// Collects the rows that vote for scene point `r`, with their rotations.
    fn collect(&mut self, grid: &Grid, r: usize, diameter: f32, table: &FeatureTable, margin: f32) {
        self.row_votes.clear();
        for row in self.touched.drain(..) {
            self.voted[row as usize] = 0;
        }
        let (p, n) = (grid.points[r], grid.normals[r]);
        let frame = local_frame(&n);
        let per_angle = table.angle_steps as f32 / PI;
        let per_metre = 1.0 / table.distance_step;
        let Counter { voted, touched, row_votes, .. } = self;
        grid.for_neighbours(&p, |i| {
            let d = grid.points[i] - p;
            let squared = d.norm_squared();
            if i == r || squared > diameter * diameter || squared < SAME_POINT {
                return;
            }
            let m = &grid.normals[i];
            let length = squared.sqrt();
            let u = d / length;
            let feature = [
                length * per_metre,
                fast_acos(n.dot(&u)) * per_angle,
                fast_acos(m.dot(&u)) * per_angle,
                fast_acos(n.dot(m)) * per_angle,
            ];
            let limits = [table.distance_steps, table.angle_steps, table.angle_steps, table.angle_steps];
            let turn = turn_about_normal(&frame, &d);
            // Up to two bins per dimension.
            let mut bins = [[0usize; 2]; 4];
            let mut counts = [1usize; 4];
            for k in 0..4 {
                let whole = (feature[k] as usize).min(limits[k] - 1);
                bins[k][0] = whole;
                let rest = feature[k] - whole as f32;
                if rest < margin && whole > 0 {
                    bins[k][1] = whole - 1;
                    counts[k] = 2;
                } else if rest > 1.0 - margin && whole + 1 < limits[k] {
                    bins[k][1] = whole + 1;
                    counts[k] = 2;
                }
            }
            let bit = 1u32 << (u32::from(turn) * TURNS as u32 / 256);
            for a in 0..counts[0] {
                for b in 0..counts[1] {
                    for c in 0..counts[2] {
                        for e in 0..counts[3] {
                            let row = table.row(bins[0][a], [bins[1][b], bins[2][c], bins[3][e]]);
                            if voted[row] & bit != 0 {
                                continue;
                            }
                            if voted[row] == 0 {
                                touched.push(row as u32);
                            }
                            voted[row] |= bit;
                            row_votes.push(RowVote { first: (row * table.blocks) as u32, turn });
                        }
                    }
                }
            }
        });
        // In the order of the table, for the cache.
        row_votes.sort_unstable_by_key(|vote| vote.first);
    }

    /// Counts the votes for the model points of one block. They fit 16 bits: an entry votes at most twice for a slot, and a model point
    /// has fewer entries than [`MAX_SAMPLES`](crate::model::MAX_SAMPLES).
    fn count(&mut self, block: usize, table: &FeatureTable) {
        self.votes.fill(0);
        for vote in &self.row_votes {
            let at = vote.first as usize + block;
            for &entry in &table.entries[table.starts[at] as usize..table.starts[at + 1] as usize] {
                let [angle, reference] = entry.to_le_bytes();
                // Scene rotation minus model rotation, in 256ths, to one of 32 bins.
                let difference = vote.turn.wrapping_sub(angle);
                self.votes[usize::from(reference) * TURNS + usize::from(difference >> 3)] += 1;
            }
        }
    }

    /// The best model points and rotations, by decreasing votes. The votes of a rotation are smoothed with its two neighbours.
    fn peaks(&mut self, samples: usize, table: &FeatureTable, options: &VotingOptions) -> Vec<Peak> {
        let mut best: Vec<Peak> = Vec::with_capacity(options.peaks_per_reference + 1);
        let mut most = 0u32;
        for block in 0..samples.div_ceil(BLOCK) {
            self.count(block, table);
            for (k, turns) in self.votes.chunks_exact(TURNS).enumerate() {
                // The best rotation of each model point.
                let (turn, votes) = (0..TURNS)
                    .map(|t| {
                        let votes = 2 * u32::from(turns[t])
                            + u32::from(turns[(t + 1) % TURNS])
                            + u32::from(turns[(t + TURNS - 1) % TURNS]);
                        (t, votes)
                    })
                    .max_by_key(|&(t, votes)| (votes, std::cmp::Reverse(t)))
                    .unwrap_or((0, 0));
                if votes == 0 || (votes as f32) < options.peak_fraction * most as f32 {
                    continue;
                }
                most = most.max(votes);
                let at = best.partition_point(|b| b.votes >= votes);
                if at < options.peaks_per_reference {
                    let left = f32::from(turns[(turn + TURNS - 1) % TURNS]);
                    let right = f32::from(turns[(turn + 1) % TURNS]);
                    let shift = (right - left) / votes as f32;
                    let angle = (turn as f32 + 0.5 + shift) / TURNS as f32 * 2.0 * PI;
                    best.insert(at, Peak { votes, reference: block * BLOCK + k, angle });
                    best.truncate(options.peaks_per_reference);
                }
            }
        }
        best.retain(|peak| peak.votes as f32 >= options.peak_fraction * most as f32);
        best
    }
}

/// The pose that aligns the model's point and frame with the scene's, rotated about the common normal (Drost et al. 2010, equation
/// 3).
fn pose_of(p: &V3, scene: &[V3; 3], q: &V3, model: &[V3; 3], turn: f32) -> Pose {
    let rows = |f: &[V3; 3]| Matrix3::from_rows(&[f[0].transpose(), f[1].transpose(), f[2].transpose()]);
    let about_x = Rotation3::from_axis_angle(&nalgebra::Vector3::x_axis(), turn);
    let rotation = (rows(scene).transpose() * about_x.matrix() * rows(model)).cast::<f64>();
    let mut quaternion = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    quaternion.renormalize();
    let translation = p.cast::<f64>() - quaternion * q.cast::<f64>();
    Pose::new(quaternion, translation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Description, ModelOptions};
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use sixfold_geometry::Vec3;
    use sixfold_mesh::Mesh;

    /// Scattered points with random normals: every feature is rare, and no reflection or rotation looks the same.
    fn scattered(count: usize) -> ObjectModel {
        let mut random = ChaCha8Rng::seed_from_u64(4);
        let mut draw = || Vec3::from_fn(|_, _| random.random_range(-1.0..1.0));
        let points: Vec<Vec3> = (0..count).map(|_| draw() * 0.05).collect();
        let normals: Vec<Vec3> = (0..count).map(|_| draw().normalize()).collect();
        let mesh = Mesh::new(points.clone(), vec![]).unwrap();
        let description = Description {
            diameter: mesh.diameter(),
            mesh,
            options: ModelOptions::default(),
            centre: Vec3::zeros(),
            visible_from: vec![u64::MAX; points.len()],
            samples: PointCloud { points, normals },
        };
        ObjectModel::assemble(description, &[])
    }

    /// Regression test: with a focal length of half a pixel the points are 12 km apart, and a grid of cells of 10 cm took 7.5 GB.
    #[test]
    fn points_kilometres_apart_take_a_bounded_grid_with_the_same_neighbours() {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let mut points: Vec<Vec3> =
            (0..300).map(|_| Vec3::from_fn(|_, _| random.random_range(0.0..0.5))).collect();
        let near = points.len();
        points.extend([
            Vec3::new(12_000.0, 9000.0, 5.0),
            Vec3::new(-1e9, 0.0, 1.0),
            Vec3::new(0.0, 1e12, 1.0),
        ]);
        let cloud =
            |points: &[Vec3]| PointCloud { points: points.to_vec(), normals: vec![Vec3::z(); points.len()] };
        let small = Grid::new(&cloud(&points[..near]), 0.1).unwrap();
        assert_eq!((small.cell, small.size), (0.1, [5, 5, 5]));
        for far in near + 1..=points.len() {
            let grid = Grid::new(&cloud(&points[..far]), 0.1).unwrap();
            assert!(grid.starts.len() <= MAX_CELLS as usize + 1, "{}", grid.starts.len());
            let partners = |grid: &Grid, p: &V3| {
                let mut found = vec![];
                grid.for_neighbours(p, |i| {
                    if (grid.points[i] - p).norm() <= 0.1 {
                        found.push(i);
                    }
                });
                found.sort_unstable();
                found
            };
            assert!((0..near).all(|i| partners(&grid, &grid.points[i]) == partners(&small, &grid.points[i])));
        }
        assert!(Grid::new(&cloud(&[Vec3::zeros(), Vec3::x() * 1e300]), 0.1).is_none());
        assert!(Grid::new(&cloud(&points), 0.0).is_none());
    }

    #[test]
    fn rows_without_entries_in_any_block_are_silent() {
        let table = scattered(600).table;
        let entries = |row: usize| &table.starts[row * table.blocks..=(row + 1) * table.blocks];
        let empty: Vec<bool> =
            (0..table.silent.len()).map(|row| entries(row)[0] == entries(row)[table.blocks]).collect();
        let silent: Vec<bool> = table.silent.iter().map(|&s| s == u32::MAX).collect();
        assert!(empty.contains(&true) && empty.contains(&false) && silent == empty);
        assert!(table.silent.iter().all(|&s| s == 0 || s == u32::MAX));
    }

    #[test]
    fn scattered_points_vote_for_the_pose_they_were_moved_by() {
        // One block of model points, and three.
        let models = [80, 600].map(scattered);
        assert_eq!(models.each_ref().map(|m| m.table.blocks), [1, 3]);
        let twists = [[0.1, -0.2, 0.8, 0.5, -1.0, 0.3], [0.0, 0.1, 1.2, -2.0, 0.4, 1.1]];
        for (model, twist) in models.iter().flat_map(|model| twists.map(|twist| (model, twist))) {
            let truth = Pose::exp(&twist.into());
            let cloud = model.samples.transformed(&truth);
            let options = VotingOptions { reference_stride: 1, ..VotingOptions::default() };
            let votes = vote(model, &cloud, &options);
            // Every point is a reference point here, and the best vote of most of them is the true pose.
            let best = votes.iter().map(|h| h.votes).fold(0.0, f32::max);
            let strong: Vec<_> = votes.iter().filter(|h| h.votes > 0.5 * best).collect();
            let right = strong
                .iter()
                .filter(|h| {
                    h.camera_from_object.rotation_angle_to(&truth) < 0.15
                        && h.camera_from_object.distance_to(&truth) < 0.015
                })
                .count();
            assert!(strong.len() >= 20 && right * 10 > strong.len() * 9, "{right} of {}", strong.len());
        }
    }
}
