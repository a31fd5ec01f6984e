//! Colours of crops and templates, cell by cell: ratios of the channels, which shading hardly changes. The features see mostly
//! texture; on smooth objects it is colour that distinguishes one from the other.

use sixfold_mesh::Mesh;
use sixfold_nn::xfeat::CELL;

/// Logarithms of red and of blue divided by green.
pub(crate) type Chroma = [f32; 2];

/// Added to each channel (0 to 1) before they are divided: dark pixels have no clear colour.
const DARK: f32 = 0.04;
/// Standard deviation of the logarithms between a render and a photograph of the same surface. On 85 targets of every ninth
/// LM-O development frame the right place is among the first four of an image's proposals 40, 42, 42 times with 0.18, 0.3, 0.5
/// at the best of eight weights each.
const SIGMA: f32 = 0.4;
/// An image whose pixels all have chromas below this is grey.
const GREY: f32 = 0.02;

/// Whether a mesh has colours of its own.
pub(crate) fn has_colours(mesh: &Mesh) -> bool {
    mesh.colors().is_some() || mesh.texture().is_some()
}

/// The chroma of every cell of a square crop (three planes, 0 to 1): that of the mean colour of its pixels that `shown` keeps,
/// zero without any.
pub(crate) fn chromas(planes: &[f32], side: usize, shown: impl Fn(usize) -> bool) -> Vec<Chroma> {
    let (cells, area) = (side / CELL, side * side);
    let of_cell = |cell: usize| {
        // A feature belongs to the first pixel of its cell.
        let around = |at: usize| (at * CELL).saturating_sub(CELL / 2)..(at * CELL + CELL / 2).min(side);
        let (mut sum, mut count) = ([0.0f32; 3], 0.0f32);
        for y in around(cell / cells) {
            for i in around(cell % cells).map(|x| y * side + x).filter(|i| shown(*i)) {
                (0..3).for_each(|c| sum[c] += planes[c * area + i]);
                count += 1.0;
            }
        }
        let [red, green, blue] = sum.map(|sum| sum / count.max(1.0) + DARK);
        [(red / green).ln(), (blue / green).ln()]
    };
    (0..cells * cells).map(of_cell).collect()
}

/// Whether all cells are grey: the image has no colours to compare.
pub(crate) fn grey(chromas: &[Chroma]) -> bool {
    chromas.as_flattened().iter().all(|v| v.abs() < GREY)
}

/// Similarity of two chromas, 0 to 1.
pub(crate) fn alike(a: Chroma, b: Chroma) -> f32 {
    let square = (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2);
    (-square / (2.0 * SIGMA * SIGMA)).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shading_does_not_change_a_colour() {
        let side = 2 * CELL;
        let of = |colour: [f32; 3]| {
            let planes: Vec<f32> = colour.iter().flat_map(|v| vec![*v; side * side]).collect();
            chromas(&planes, side, |_| true)
        };
        let (lit, shaded, other) = (of([0.8, 0.4, 0.2]), of([0.4, 0.2, 0.1]), of([0.2, 0.4, 0.8]));
        assert_eq!(lit.len(), 4);
        assert!(alike(lit[3], shaded[3]) > 0.7, "{}", alike(lit[3], shaded[3]));
        assert!(alike(lit[3], other[3]) < 0.01, "{}", alike(lit[3], other[3]));
        assert!(!grey(&lit) && grey(&of([0.5; 3])) && grey(&of([0.0; 3])));
        assert_eq!(alike(lit[0], lit[3]), 1.0);
    }

    #[test]
    fn only_shown_pixels_count() {
        let side = 2 * CELL;
        let mut planes = vec![0.5f32; 3 * side * side];
        // The left half of the image is red.
        let red = |i: usize| i % side < side / 2;
        (0..side * side).filter(|i| red(*i)).for_each(|i| planes[i] = 1.0);
        let (all, half) = (chromas(&planes, side, |_| true), chromas(&planes, side, red));
        // The second cell is around the border.
        assert!(half[1][0] > all[1][0] && all[1][0] > 0.0, "{half:?} {all:?}");
        assert_eq!(half[0], all[0]);
        assert_eq!(chromas(&planes, side, |_| false), vec![[0.0; 2]; 4]);
    }
}
