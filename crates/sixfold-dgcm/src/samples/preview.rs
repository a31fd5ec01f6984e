//! Training pairs as an image (dissertation, figure 6.4).

use sixfold_geometry::RgbImage;

use super::{Pair, PairOptions, Pool};

/// Positive and negative pairs in the image.
const PAIRS: u64 = 6;
/// Images of a pair: normals of the input and of the experience, VD-NOC of the experience and of the input, target.
const COLUMNS: usize = 5;
/// Empty pixels between positive and negative pairs.
const GAP: usize = 8;

impl Pool {
    /// Pairs as the training gets them, one in each row: on the left positive ones, on the right negative ones. The columns of a
    /// pair: normals of the input and of the experience; VD-NOC of the experience, of the input, and the target, which is the
    /// VD-NOC of the input in the frame of the experience (black for a negative pair). Directions and coordinates from -1 to 1
    /// are red, green and blue; the background is black.
    pub fn preview(&self, options: &PairOptions, seed: u64) -> RgbImage {
        let side = self.options().crop.side;
        // Numbers that no training reaches.
        let pairs: Vec<[Pair; 2]> = (0..PAIRS)
            .map(|k| [true, false].map(|positive| self.pair(positive, options, seed, u64::MAX - k)))
            .collect();
        let half = COLUMNS * side;
        RgbImage::from_fn(2 * half + GAP, side * pairs.len(), |x, y| {
            let (kind, x) = match x.checked_sub(half + GAP) {
                Some(x) => (1, x),
                None => (0, x),
            };
            if x >= half {
                return [255; 3];
            }
            column(&pairs[y / side][kind], x / side, side * side, (y % side) * side + x % side)
        })
    }
}

/// The colour of a pixel in a column of a pair whose images have so many pixels.
fn column(pair: &Pair, column: usize, pixels: usize, pixel: usize) -> [u8; 3] {
    let (planes, first) = match column {
        0 => (&pair.input, 0),
        1 => (&pair.experience, 0),
        2 => (&pair.vd_noc, 0),
        3 => (&pair.input, 3),
        _ => (&pair.target, 0),
    };
    let values: [f32; 3] = std::array::from_fn(|k| planes[(first + k) * pixels + pixel]);
    // The background, and what a block hides.
    if values == [0.0; 3] { [0; 3] } else { values.map(|v| (127.5 * (v.clamp(-1.0, 1.0) + 1.0)) as u8) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::samples::GraspPoolOptions;

    #[test]
    fn positive_pairs_are_on_the_left_with_their_targets_and_negative_ones_have_none() {
        let pool = Pool::new(&GraspPoolOptions { views: 96, ..GraspPoolOptions::default() }, &()).unwrap();
        let options = PairOptions::default();
        let image = pool.preview(&options, 3);
        let side = 96;
        assert_eq!(image.size(), (2 * COLUMNS * side + GAP, PAIRS as usize * side));
        let shown = |left: usize, column: usize| {
            let from = left + column * side;
            (0..side * side).filter(|i| image[(from + i % side, i / side)] != [0; 3]).count()
        };
        let (left, right) = (0, COLUMNS * side + GAP);
        // All pixels of the object have a target in a positive pair.
        assert!(shown(left, 0) > 150);
        assert_eq!((shown(left, 3), shown(left, 4)), (shown(left, 0), shown(left, 0)));
        assert_eq!(shown(left, 1), shown(left, 2));
        assert!(shown(right, 0) > 150 && shown(right, 1) > 150);
        assert_eq!(shown(right, 4), 0);
        assert!((0..GAP).all(|x| image[(COLUMNS * side + x, 0)] == [255; 3]));
        // A pixel's normal: x is red.
        let pair = pool.pair(true, &options, 3, u64::MAX);
        let i = (0..side * side).find(|&i| pair.mask[i] > 0.0).unwrap();
        let red = (127.5 * (pair.input[i].clamp(-1.0, 1.0) + 1.0)) as u8;
        assert_eq!(image[(i % side, i / side)][0], red);
    }
}
