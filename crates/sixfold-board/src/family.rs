//! The tag family 36h11: 587 codes of 6 x 6 cells, any two differing in at least 11 cells in any rotation (Olson 2011).

use std::sync::OnceLock;

/// Cells along a side of a code.
pub(crate) const CELLS: usize = 6;
/// Cells along a side of a tag's black square: the code and one border cell on each side.
pub(crate) const SIDE: usize = CELLS + 2;
/// Maximum number of wrong cells that are corrected. With 5 (the unambiguous maximum) clutter is sometimes detected as a tag.
const REPAIRED: u32 = 2;

/// Cells of a code, row by row from the top left; `true` is white.
pub(crate) type Cells = [[bool; CELLS]; CELLS];

pub(crate) fn codes() -> &'static [u64] {
    static CODES: OnceLock<Vec<u64>> = OnceLock::new();
    CODES.get_or_init(|| {
        let lines = include_str!("tag36h11.txt").lines().filter(|line| !line.starts_with('#'));
        lines.filter_map(|line| u64::from_str_radix(line, 16).ok()).collect()
    })
}

/// The cells of a tag. `id` has to be below 587.
pub(crate) fn cells(id: usize) -> Cells {
    let code = codes()[id];
    std::array::from_fn(|row| std::array::from_fn(|column| code >> (35 - CELLS * row - column) & 1 == 1))
}

fn code_of(cells: &Cells) -> u64 {
    cells.iter().flatten().fold(0, |code, &white| code << 1 | u64::from(white))
}

/// The tag with these cells, and the number of corners by which it is rotated: the tag's top left corner is the read square's
/// corner of that number, clockwise.
pub(crate) fn decode(read: &Cells) -> Option<(usize, usize)> {
    let mut cells = *read;
    let mut best: Option<(u32, usize, usize)> = None;
    for rotation in 0..4 {
        let code = code_of(&cells);
        for (id, other) in codes().iter().enumerate() {
            let wrong = (code ^ other).count_ones();
            if wrong <= REPAIRED && best.is_none_or(|(minimum, ..)| wrong < minimum) {
                best = Some((wrong, id, rotation));
            }
        }
        let before = cells;
        cells = std::array::from_fn(|row| std::array::from_fn(|column| before[column][CELLS - 1 - row]));
    }
    best.map(|(_, id, rotation)| (id, rotation))
}

/// The mirrored cells.
pub(crate) fn mirrored(cells: &Cells) -> Cells {
    cells.map(|mut row| {
        row.reverse();
        row
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_far_apart() {
        let codes = codes();
        assert_eq!(codes.len(), 587);
        for id in 0..codes.len() {
            let mut rotated = cells(id);
            for rotation in 0..4 {
                let code = code_of(&rotated);
                for (other, second) in codes.iter().enumerate() {
                    if (other, rotation) != (id, 0) {
                        assert!((code ^ second).count_ones() >= 11, "{id} rotated by {rotation} and {other}");
                    }
                }
                let before = rotated;
                rotated = std::array::from_fn(|r| std::array::from_fn(|c| before[c][CELLS - 1 - r]));
            }
        }
    }

    #[test]
    fn a_rotated_tag_with_two_wrong_cells_is_repaired_and_one_with_three_is_not() {
        let upright = cells(17);
        // The tag's top left corner is at the top right of the read cells.
        let mut read: Cells = std::array::from_fn(|r| std::array::from_fn(|c| upright[CELLS - 1 - c][r]));
        assert_eq!(decode(&read), Some((17, 1)));
        read[0][0] ^= true;
        read[3][4] ^= true;
        assert_eq!(decode(&read), Some((17, 1)));
        read[5][1] ^= true;
        assert_eq!(decode(&read), None);
        assert_eq!(decode(&mirrored(&upright)), None);
    }
}
