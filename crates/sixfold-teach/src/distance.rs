//! Distances to the border of a mask, and to a set of voxels (Felzenszwalb and Huttenlocher 2012).

use rayon::prelude::*;
use sixfold_geometry::{Image, Mask};

/// Signed distance of each pixel to the border of a mask, pixels: below zero inside, above zero outside.
pub(crate) fn signed_distance(mask: &Mask) -> Image<f32> {
    let (width, height) = mask.size();
    let signed = signed_distances([width, height, 1], mask.as_slice());
    Image::from_fn(width, height, |x, y| signed[y * width + x])
}

/// The same for the cells of a grid, in cells.
pub(crate) fn signed_distances(size: [usize; 3], is_inside: &[bool]) -> Vec<f32> {
    let to = |of: bool| squared_distances(size, |i| is_inside[i] == of);
    let (outside, inside) = (to(true), to(false));
    // The border is between two cells, half a cell from each.
    let signed = |i: usize| if is_inside[i] { 0.5 - inside[i].sqrt() } else { outside[i].sqrt() - 0.5 };
    (0..is_inside.len()).map(signed).collect()
}

/// The squared distance of each cell of a grid to the nearest cell of a set, in cells; x varies fastest. The squared diagonal of the grid
/// if the set is empty; an axis of one cell has no length.
pub(crate) fn squared_distances([w, h, d]: [usize; 3], of: impl Fn(usize) -> bool) -> Vec<f32> {
    let area = w * h;
    let far = [w, h, d].into_iter().filter(|n| *n > 1).map(|n| n * n).sum::<usize>() as f32;
    let mut squares: Vec<f32> = (0..area * d).map(|i| if of(i) { 0.0 } else { far }).collect();
    if area == 0 {
        return squares;
    }
    squares.par_chunks_mut(area).for_each(|layer| {
        layer.chunks_mut(w).for_each(|row| row.copy_from_slice(&along_line(row)));
        for x in 0..w {
            let line: Vec<f32> = (0..h).map(|y| layer[x + w * y]).collect();
            along_line(&line).into_iter().enumerate().for_each(|(y, value)| layer[x + w * y] = value);
        }
    });
    if d > 1 {
        let along_z = |c: usize| along_line(&(0..d).map(|z| squares[c + z * area]).collect::<Vec<f32>>());
        let columns: Vec<Vec<f32>> = (0..area).into_par_iter().map(along_z).collect();
        squares.iter_mut().enumerate().for_each(|(i, v)| *v = columns[i % area][i / area]);
    }
    squares.iter_mut().for_each(|v| *v = v.min(far));
    squares
}

/// The lower envelope of the parabolas at all cells of a line.
fn along_line(values: &[f32]) -> Vec<f32> {
    let n = values.len();
    let (mut roots, mut bounds) = (vec![0usize; n], vec![0.0f32; n + 1]);
    let mut last = 0;
    (bounds[0], bounds[1]) = (f32::NEG_INFINITY, f32::INFINITY);
    let square = |i: usize| (i * i) as f32;
    for q in 1..n {
        loop {
            let r = roots[last];
            let s = ((values[q] + square(q)) - (values[r] + square(r))) / (2.0 * (q - r) as f32);
            if s > bounds[last] || last == 0 {
                if s > bounds[last] {
                    last += 1;
                }
                roots[last] = q;
                bounds[last] = if last == 0 { f32::NEG_INFINITY } else { s };
                bounds[last + 1] = f32::INFINITY;
                break;
            }
            last -= 1;
        }
    }
    let mut at = 0;
    (0..n)
        .map(|q| {
            while bounds[at + 1] < q as f32 {
                at += 1;
            }
            (q as f32 - roots[at] as f32).powi(2) + values[roots[at]]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_are_those_of_a_search_over_all_pixels() {
        let mask =
            Image::from_fn(23, 17, |x, y| (x * 7 + y * 5) % 11 < 4 || (x > 5 && x < 12 && y > 3 && y < 14));
        let found = signed_distance(&mask);
        for y in 0..17 {
            for x in 0..23 {
                let mut nearest = f32::INFINITY;
                for v in 0..17 {
                    for u in 0..23 {
                        if mask[(u, v)] != mask[(x, y)] {
                            nearest = nearest
                                .min(((u as f32 - x as f32).powi(2) + (v as f32 - y as f32).powi(2)).sqrt());
                        }
                    }
                }
                let expected = if mask[(x, y)] { 0.5 - nearest } else { nearest - 0.5 };
                assert!((found[(x, y)] - expected).abs() < 1e-3, "{x} {y}: {} {expected}", found[(x, y)]);
            }
        }
        let empty = signed_distance(&Image::filled(5, 4, false));
        assert!(empty.as_slice().iter().all(|d| *d > 5.0));
    }

    #[test]
    fn distances_to_voxels_are_those_of_a_search_over_all() {
        let size @ [w, h, _] = [7, 5, 6];
        let place = |i: usize| [i % w, i / w % h, i / (w * h)];
        let of = |i: usize| i % 37 == 5;
        let found = squared_distances(size, of);
        for (i, square) in found.iter().enumerate() {
            let apart = |j: usize| {
                let pairs = place(i).into_iter().zip(place(j));
                pairs.map(|(a, b)| a.abs_diff(b).pow(2)).sum::<usize>()
            };
            assert_eq!(Some(*square as usize), (0..found.len()).filter(|j| of(*j)).map(apart).min(), "{i}");
        }
    }
}
