//! A scalar field on a grid of voxels.

use rayon::prelude::*;
use sixfold_geometry::Vec3;

use crate::view::Volume;

/// A number at each corner of a grid of equal cubes; x varies fastest.
#[derive(Debug, Clone)]
pub(crate) struct Grid {
    pub low: Vec3,
    /// Distance of neighbours, metres.
    pub step: f64,
    pub size: [usize; 3],
    pub values: Vec<f32>,
}

impl Grid {
    /// A grid over a volume with about `cells` cells along its longest side, filled by a function of the point.
    pub fn new(volume: &Volume, cells: usize, f: impl Fn(&Vec3) -> f32 + Sync) -> Grid {
        let step = volume.size().max() / cells as f64;
        let size = std::array::from_fn(|k| (volume.size()[k] / step).ceil() as usize + 1);
        let mut grid = Grid { low: volume.low, step, size, values: vec![] };
        let (width, area) = (size[0], size[0] * size[1]);
        let mut values = vec![0.0; area * size[2]];
        let at = &grid;
        values.par_chunks_mut(width).enumerate().for_each(|(row, out)| {
            let (y, z) = (row % size[1], row / size[1]);
            for (x, value) in out.iter_mut().enumerate() {
                *value = f(&at.point([x, y, z]));
            }
        });
        grid.values = values;
        grid
    }

    pub fn point(&self, [x, y, z]: [usize; 3]) -> Vec3 {
        self.low + Vec3::new(x as f64, y as f64, z as f64) * self.step
    }

    /// The value at a point between voxels; `None` outside the grid.
    pub fn at(&self, point: &Vec3) -> Option<f32> {
        let place = (point - self.low) / self.step;
        let mut corner = [0; 3];
        for k in 0..3 {
            if !(place[k] >= 0.0 && place[k] <= (self.size[k] - 1) as f64) {
                return None;
            }
            corner[k] = (place[k] as usize).min(self.size[k].saturating_sub(2));
        }
        let mut sum = 0.0;
        for i in 0..8 {
            let side = |k: usize| (i >> k) & 1;
            let weight = |k: usize| {
                let fraction = (place[k] - corner[k] as f64) as f32;
                if side(k) == 1 { fraction } else { 1.0 - fraction }
            };
            let weight = weight(0) * weight(1) * weight(2);
            if weight > 0.0 {
                sum += weight * self.values[self.index(std::array::from_fn(|k| corner[k] + side(k)))];
            }
        }
        Some(sum)
    }

    pub fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        x + self.size[0] * (y + self.size[1] * z)
    }

    pub fn place(&self, index: usize) -> [usize; 3] {
        let [w, h, _] = self.size;
        [index % w, index / w % h, index / (w * h)]
    }

    /// The six neighbours of a voxel.
    pub fn neighbours(&self, index: usize) -> impl Iterator<Item = usize> + use<> {
        let (place, size) = (self.place(index), self.size);
        let strides = [1, size[0], size[0] * size[1]];
        (0..3).flat_map(move |k| {
            let down = (place[k] > 0).then(|| index - strides[k]);
            let up = (place[k] + 1 < size[k]).then(|| index + strides[k]);
            [down, up].into_iter().flatten()
        })
    }

    /// The direction in which the values grow most at a voxel; its length is that of the differences.
    pub fn gradient(&self, index: usize) -> Vec3 {
        let (place, size) = (self.place(index), self.size);
        let strides = [1, size[0], size[0] * size[1]];
        Vec3::from_fn(|k, _| {
            let down = if place[k] > 0 { index - strides[k] } else { index };
            let up = if place[k] + 1 < size[k] { index + strides[k] } else { index };
            f64::from(self.values[up] - self.values[down])
        })
    }

    /// The connected components (through faces) of values below zero, each as a list of voxels, largest first.
    pub fn components(&self) -> Vec<Vec<usize>> {
        let mut seen = vec![false; self.values.len()];
        let mut components = vec![];
        for start in 0..self.values.len() {
            if seen[start] || self.values[start] >= 0.0 {
                continue;
            }
            seen[start] = true;
            let mut component = vec![start];
            let mut next = 0;
            while next < component.len() {
                for neighbour in self.neighbours(component[next]) {
                    if !seen[neighbour] && self.values[neighbour] < 0.0 {
                        seen[neighbour] = true;
                        component.push(neighbour);
                    }
                }
                next += 1;
            }
            components.push(component);
        }
        components.sort_by_key(|c| std::cmp::Reverse(c.len()));
        components
    }

    /// The smallest box around some voxels.
    pub fn volume_of(&self, voxels: &[usize]) -> Volume {
        let (mut low, mut high) = ([usize::MAX; 3], [0; 3]);
        for voxel in voxels {
            let place = self.place(*voxel);
            for k in 0..3 {
                low[k] = low[k].min(place[k]);
                high[k] = high[k].max(place[k]);
            }
        }
        Volume { low: self.point(low), high: self.point(high) }
    }

    /// Smoothed by a Gaussian of `deviation` voxels.
    #[must_use]
    pub fn smoothed(&self, deviation: f64) -> Grid {
        let reach = (3.0 * deviation).ceil() as isize;
        let kernel: Vec<f32> =
            (-reach..=reach).map(|i| (-0.5 * (i as f64 / deviation).powi(2)).exp() as f32).collect();
        let total: f32 = kernel.iter().sum();
        let mut values = self.values.clone();
        let strides = [1, self.size[0], self.size[0] * self.size[1]];
        for (k, stride) in strides.into_iter().enumerate() {
            let source = values.clone();
            values.par_iter_mut().enumerate().for_each(|(index, value)| {
                let here = self.place(index)[k] as isize;
                let last = self.size[k] as isize - 1;
                let mut sum = 0.0;
                for (weight, offset) in kernel.iter().zip(-reach..=reach) {
                    let there = (here + offset).clamp(0, last) - here;
                    let at = index.wrapping_add_signed(there * stride as isize);
                    sum += weight * source[at];
                }
                *value = sum / total;
            });
        }
        Grid { values, ..self.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ball(radius: f64) -> Grid {
        let volume = Volume { low: Vec3::repeat(-1.0), high: Vec3::repeat(1.0) };
        Grid::new(&volume, 20, |p| (p.norm() - radius) as f32)
    }

    #[test]
    fn parts_are_found_by_size() {
        let volume = Volume { low: Vec3::repeat(-1.0), high: Vec3::repeat(1.0) };
        let away = Vec3::repeat(0.7);
        let grid = Grid::new(&volume, 20, |p| ((p.norm() - 0.5).min((p - away).norm() - 0.22)) as f32);
        let parts = grid.components();
        assert_eq!(parts.len(), 2);
        assert!(parts[0].len() > 4 * parts[1].len());
        let small = grid.volume_of(&parts[1]);
        assert!((small.centre() - away).norm() < 0.06, "{small:?}");
    }

    #[test]
    fn smoothing_keeps_a_plane_and_dampens_a_peak() {
        let mut grid = ball(0.5);
        let central = grid.index([10, 10, 10]);
        grid.values[central] = 5.0;
        let smooth = grid.smoothed(1.0);
        assert!(smooth.values[central] < 1.0);
        let plane =
            Grid { values: (0..grid.values.len()).map(|i| grid.place(i)[0] as f32).collect(), ..grid };
        let at = plane.index([9, 4, 4]);
        assert!((plane.smoothed(1.0).values[at] - 9.0).abs() < 1e-4);
    }
}
