//! Value noise: random numbers on a grid, interpolated.

use rand::RngExt;
use sixfold_geometry::random::Random;

/// Smooth noise in 0..1: random numbers on a grid of `cells` by `cells`, interpolated with a smooth step.
pub(super) fn value_noise(width: usize, height: usize, cells: usize, random: &mut Random) -> Vec<f32> {
    let mut out = vec![0.0; width * height];
    add_noise(&mut out, width, height, cells, 1.0, random);
    out
}

/// Adds such noise, multiplied by `weight`.
pub(super) fn add_noise(
    out: &mut [f32],
    width: usize,
    height: usize,
    cells: usize,
    weight: f32,
    random: &mut Random,
) {
    let cells = cells.max(1);
    let side = cells + 2;
    let grid: Vec<f32> = (0..side * side).map(|_| random.random::<f32>() * weight).collect();
    let step = |i: usize, size: usize, shift: f32| {
        let p = (i as f32 + 0.5) / size as f32 * cells as f32 + shift;
        let f = p.fract();
        ((p as usize).min(side - 2), f * f * (3.0 - 2.0 * f))
    };
    let (shift_x, shift_y) = (random.random::<f32>(), random.random::<f32>());
    let columns: Vec<(usize, f32)> = (0..width).map(|x| step(x, width, shift_x)).collect();
    let mut line = vec![0.0f32; side];
    for (y, row) in out.chunks_exact_mut(width.max(1)).enumerate() {
        let (j, fy) = step(y, height, shift_y);
        for (k, v) in line.iter_mut().enumerate() {
            let (a, b) = (grid[j * side + k], grid[(j + 1) * side + k]);
            *v = a + (b - a) * fy;
        }
        for (o, &(i, fx)) in row.iter_mut().zip(&columns) {
            *o += line[i] + (line[i + 1] - line[i]) * fx;
        }
    }
}
