//! COCO's run-length encoded masks: column by column, alternating runs of zeros and ones, starting with zeros; and
//! their compressed text form.

use sixfold_geometry::{Image, Mask, Rect};
use thiserror::Error;

/// Largest mask side that is accepted.
const LARGEST_SIDE: u64 = 1 << 16;
/// Largest number of mask pixels that is accepted.
const LARGEST_AREA: u64 = 1 << 28;

/// Why a run-length encoded mask is refused.
#[derive(Debug, Error, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum RleError {
    /// The size is zero or too large.
    #[error("size [{height}, {width}], expected height and width from 1 to 65536 and at most 2^28 pixels")]
    Size {
        /// Columns.
        width: u64,
        /// Rows.
        height: u64,
    },
    /// The runs do not fill the mask.
    #[error("the runs add up to {found} pixels, the size gives {expected}")]
    Sum {
        /// Width times height.
        expected: u64,
        /// Sum of the runs.
        found: u64,
    },
    /// The text is not valid in the compressed form.
    #[error("compressed counts: byte {at} is not part of a run length")]
    Text {
        /// Position in the text.
        at: usize,
    },
}

/// A mask as runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rle {
    width: u32,
    height: u32,
    /// Lengths of alternating runs of zeros and ones, zeros first; they fill the mask exactly.
    counts: Vec<u32>,
}

impl Rle {
    /// From runs, column by column, zeros first.
    ///
    /// # Errors
    /// [`RleError`] when the size is zero or too large, or the runs do not add up to it.
    pub fn new(width: u64, height: u64, counts: Vec<u32>) -> Result<Self, RleError> {
        let (width, height) = check_size(width, height)?;
        let expected = u64::from(width) * u64::from(height);
        let found = counts.iter().map(|&c| u64::from(c)).sum();
        if found != expected {
            return Err(RleError::Sum { expected, found });
        }
        Ok(Rle { width, height, counts })
    }

    /// From the compressed text: each run is the difference to the run two before, in groups of five bits, lowest
    /// first, each a character from `0` up; 32 in a group says that more follow, 16 in the last is the sign.
    ///
    /// # Errors
    /// [`RleError`] when the size is zero or too large, the text is damaged, or the runs do not add up to the size.
    pub fn from_compressed(width: u64, height: u64, text: &str) -> Result<Self, RleError> {
        let (w, h) = check_size(width, height)?;
        let pixels = i64::from(w) * i64::from(h);
        let mut counts: Vec<u32> = Vec::new();
        let mut bytes = text.bytes().enumerate();
        while let Some((start, mut byte)) = bytes.next() {
            let (mut value, mut shift, mut at) = (0i64, 0, start);
            loop {
                let group = byte.checked_sub(48).filter(|g| *g < 64 && shift < 40);
                let group = i64::from(group.ok_or(RleError::Text { at })?);
                value |= (group & 0x1f) << shift;
                shift += 5;
                if group & 0x20 == 0 {
                    if group & 0x10 != 0 {
                        value |= -1 << shift;
                    }
                    break;
                }
                (at, byte) = bytes.next().ok_or(RleError::Text { at: text.len() })?;
            }
            if counts.len() > 2 {
                value += i64::from(counts[counts.len() - 2]);
            }
            if !(0..=pixels).contains(&value) {
                return Err(RleError::Text { at: start });
            }
            counts.push(value as u32);
        }
        Rle::new(width, height, counts)
    }

    /// The compressed text.
    pub fn to_compressed(&self) -> String {
        let mut text = String::new();
        for (i, &count) in self.counts.iter().enumerate() {
            let mut value = i64::from(count);
            if i > 2 {
                value -= i64::from(self.counts[i - 2]);
            }
            loop {
                let group = (value & 0x1f) as u8;
                value >>= 5;
                let done = if group & 0x10 != 0 { value == -1 } else { value == 0 };
                text.push((group + if done { 0 } else { 0x20 } + 48) as char);
                if done {
                    break;
                }
            }
        }
        text
    }

    /// Encodes a mask.
    ///
    /// # Errors
    /// [`RleError::Size`] for an empty mask.
    pub fn encode(mask: &Mask) -> Result<Self, RleError> {
        let (width, height) = check_size(mask.width() as u64, mask.height() as u64)?;
        let mut counts = Vec::new();
        let (mut value, mut run) = (false, 0u32);
        for x in 0..mask.width() {
            for y in 0..mask.height() {
                if mask[(x, y)] != value {
                    counts.push(run);
                    (value, run) = (!value, 0);
                }
                run += 1;
            }
        }
        counts.push(run);
        Ok(Rle { width, height, counts })
    }

    /// Decodes to a mask.
    pub fn decode(&self) -> Mask {
        let (width, height) = (self.width as usize, self.height as usize);
        let mut mask = Image::filled(width, height, false);
        let pixels = mask.as_mut_slice();
        let mut at = 0;
        for (i, &count) in self.counts.iter().enumerate() {
            let end = at + count as usize;
            if i % 2 == 1 {
                for p in at..end {
                    pixels[p % height * width + p / height] = true;
                }
            }
            at = end;
        }
        mask
    }

    /// Columns.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// The runs, zeros first.
    pub fn counts(&self) -> &[u32] {
        &self.counts
    }

    /// Pixels in the mask.
    pub fn area(&self) -> u64 {
        self.counts.iter().skip(1).step_by(2).map(|&c| u64::from(c)).sum()
    }

    /// The box around the mask, whole pixels: `[x, y, w, h]`; all zero for an empty mask.
    pub fn bounding_box(&self) -> Rect {
        let h = u64::from(self.height);
        let (mut left, mut top, mut right, mut bottom) = (u64::MAX, u64::MAX, 0, 0);
        let mut at = 0u64;
        for (i, &count) in self.counts.iter().enumerate() {
            let count = u64::from(count);
            if i % 2 == 1 && count > 0 {
                let last = at + count - 1;
                left = left.min(at / h);
                right = right.max(last / h);
                // A run across the end of a column touches the first and the last row.
                let (low, high) = if at / h == last / h { (at % h, last % h) } else { (0, h - 1) };
                top = top.min(low);
                bottom = bottom.max(high);
            }
            at += count;
        }
        if left == u64::MAX {
            return Rect { x: 0.0, y: 0.0, width: 0.0, height: 0.0 };
        }
        let (width, height) = ((right - left + 1) as f64, (bottom - top + 1) as f64);
        Rect { x: left as f64, y: top as f64, width, height }
    }

    /// Pixels in both masks; `None` when the sizes differ.
    pub fn intersection(&self, other: &Rle) -> Option<u64> {
        if (self.width, self.height) != (other.width, other.height) {
            return None;
        }
        let mut common = 0u64;
        let (mut i, mut j) = (0, 0);
        let (mut left_i, mut left_j) = (self.counts.first().copied()?, other.counts.first().copied()?);
        loop {
            let step = left_i.min(left_j);
            if i % 2 == 1 && j % 2 == 1 {
                common += u64::from(step);
            }
            left_i -= step;
            left_j -= step;
            while left_i == 0 {
                i += 1;
                let Some(&next) = self.counts.get(i) else { return Some(common) };
                left_i = next;
            }
            while left_j == 0 {
                j += 1;
                let Some(&next) = other.counts.get(j) else { return Some(common) };
                left_j = next;
            }
        }
    }
}

fn check_size(width: u64, height: u64) -> Result<(u32, u32), RleError> {
    let side = 1..=LARGEST_SIDE;
    if !side.contains(&width) || !side.contains(&height) || width * height > LARGEST_AREA {
        return Err(RleError::Size { width, height });
    }
    Ok((width as u32, height as u32))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_small_mask_by_hand() {
        // Columns: 0 1 | 1 1 | 0 0, so one zero, three ones, two zeros.
        let mask = Image::from_vec(3, 2, vec![false, true, false, true, true, false]).unwrap();
        let rle = Rle::encode(&mask).unwrap();
        assert_eq!(rle.counts(), &[1, 3, 2]);
        assert_eq!(rle.area(), 3);
        assert_eq!(rle.bounding_box(), Rect { x: 0.0, y: 0.0, width: 2.0, height: 2.0 });
        assert_eq!(rle.to_compressed(), "132");
        assert_eq!(rle.decode(), mask);
    }

    #[test]
    fn compressed_text_as_the_reference_library_writes_it() {
        // pycocotools 2.0.11: frPyObjects({"size": [480, 640], "counts": [100, 50, 430, 70, 306550]}, 480, 640).
        let rle = Rle::new(640, 480, vec![100, 50, 430, 70, 306_550]).unwrap();
        assert_eq!(rle.to_compressed(), "T3b1^=d0XnZ9");
        assert_eq!(Rle::from_compressed(640, 480, "T3b1^=d0XnZ9").unwrap(), rle);
    }

    #[test]
    fn damaged_runs_are_refused() {
        assert!(matches!(Rle::new(3, 2, vec![1, 3, 3]), Err(RleError::Sum { expected: 6, found: 7 })));
        assert!(matches!(Rle::new(0, 2, vec![]), Err(RleError::Size { .. })));
        assert!(matches!(Rle::new(1 << 40, 1 << 40, vec![]), Err(RleError::Size { .. })));
        assert!(matches!(Rle::from_compressed(3, 2, "13 "), Err(RleError::Text { at: 2 })));
        assert!(matches!(Rle::from_compressed(3, 2, "13P"), Err(RleError::Text { .. })));
        assert!(matches!(Rle::from_compressed(3, 2, "ooooooooooooooo1"), Err(RleError::Text { .. })));
        assert!(Rle::from_compressed(3, 2, "").is_err());
    }

    fn mask() -> impl Strategy<Value = Mask> {
        (1usize..20, 1usize..20).prop_flat_map(|(w, h)| {
            prop::collection::vec(any::<bool>(), w * h).prop_map(move |v| Image::from_vec(w, h, v).unwrap())
        })
    }

    proptest! {
        #[test]
        fn runs_and_text_round_trip(mask in mask()) {
            let rle = Rle::encode(&mask).unwrap();
            prop_assert_eq!(&rle.decode(), &mask);
            let (w, h) = (mask.width() as u64, mask.height() as u64);
            prop_assert_eq!(Rle::from_compressed(w, h, &rle.to_compressed()).unwrap(), rle);
        }

        #[test]
        fn counting_agrees_with_pixels(a in mask(), flips in prop::collection::vec(any::<bool>(), 400)) {
            let mut b = a.clone();
            for (pixel, flip) in b.as_mut_slice().iter_mut().zip(&flips) {
                *pixel ^= flip;
            }
            let (ra, rb) = (Rle::encode(&a).unwrap(), Rle::encode(&b).unwrap());
            let common = a.as_slice().iter().zip(b.as_slice()).filter(|(a, b)| **a && **b).count() as u64;
            prop_assert_eq!(ra.intersection(&rb), Some(common));
            prop_assert_eq!(ra.area(), a.as_slice().iter().filter(|p| **p).count() as u64);
            let bb = ra.bounding_box();
            let inside = |x: usize, y: usize| (x as f64) >= bb.x && (x as f64) < bb.x + bb.width
                && (y as f64) >= bb.y && (y as f64) < bb.y + bb.height;
            for y in 0..a.height() { for x in 0..a.width() { prop_assert!(!a[(x, y)] || inside(x, y)); } }
        }

        #[test]
        fn random_text_never_panics(
            text in proptest::collection::vec(b' '..=b'~', 0..=60), w in 0u64..40, h in 0u64..40,
        ) {
            let text = String::from_utf8(text).unwrap();
            let _ = Rle::from_compressed(w, h, &text);
        }
    }
}
