//! numpy's arrays of numbers, decoded from the bytes in files.

/// The type of an array's elements.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ElementType {
    /// As numpy names it: `f`, `i`, `u` or `b`.
    pub kind: u8,
    /// Bytes.
    pub size: usize,
    pub big_endian: bool,
}

/// An array, row by row.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Array {
    pub shape: Vec<usize>,
    pub values: Vec<f64>,
}

impl ElementType {
    /// The type of a name such as `f8` or `<i4`; `None` for anything but integers, booleans and floating-point numbers of 32 and 64
    /// bits.
    pub(super) fn named(name: &str) -> Option<ElementType> {
        let plain = name.trim_start_matches(['<', '>', '|', '=']);
        let kind = plain.bytes().next()?;
        let size = plain.get(1..)?.parse().ok()?;
        let known = matches!((kind, size), (b'f', 4 | 8) | (b'i' | b'u', 1 | 2 | 4 | 8) | (b'b', 1));
        known.then_some(ElementType { kind, size, big_endian: name.starts_with('>') })
    }

    fn number(&self, element: &[u8]) -> f64 {
        let unused = 64 - 8 * self.size;
        let big = element.iter().fold(0u64, |bits, byte| (bits << 8) | u64::from(*byte));
        let bits = if self.big_endian { big } else { big.swap_bytes() >> unused };
        match (self.kind, self.size) {
            (b'f', 8) => f64::from_bits(bits),
            (b'f', _) => f64::from(f32::from_bits(bits as u32)),
            (b'i', _) => (((bits << unused) as i64) >> unused) as f64,
            _ => bits as f64,
        }
    }
}

impl Array {
    /// An array from its bytes, column by column if `fortran`; `None` if their number does not match the shape.
    pub(super) fn of_bytes(shape: &[usize], of: &ElementType, fortran: bool, bytes: &[u8]) -> Option<Array> {
        let count = shape.iter().try_fold(1usize, |count, side| count.checked_mul(*side))?;
        if count.checked_mul(of.size)? != bytes.len() {
            return None;
        }
        let mut values: Vec<f64> = bytes.chunks_exact(of.size).map(|element| of.number(element)).collect();
        if fortran && shape.len() > 1 {
            values = row_by_row(shape, &values);
        }
        Some(Array { shape: shape.to_vec(), values })
    }
}

/// Converts an array stored column by column to row by row.
fn row_by_row(shape: &[usize], values: &[f64]) -> Vec<f64> {
    (0..values.len())
        .map(|mut index| {
            let mut at = 0;
            // The last axis varies fastest in `index`, the first axis in `values`.
            for axis in (0..shape.len()).rev() {
                let before: usize = shape[..axis].iter().product();
                at += (index % shape[axis]) * before;
                index /= shape[axis];
            }
            values[at]
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elements_and_orders_by_hand() {
        let read = |name: &str, fortran, shape: &[usize], bytes: &[u8]| {
            Array::of_bytes(shape, &ElementType::named(name).unwrap(), fortran, bytes).map(|a| a.values)
        };
        assert_eq!(read("<i2", false, &[2], &[0xff, 0xff, 1, 2]), Some(vec![-1.0, 513.0]));
        assert_eq!(read(">u2", false, &[2], &[0xff, 0xff, 1, 2]), Some(vec![65535.0, 258.0]));
        assert_eq!(read("f4", false, &[], &1.5f32.to_le_bytes()), Some(vec![1.5]));
        assert_eq!(read(">f8", false, &[1], &(-2.5f64).to_be_bytes()), Some(vec![-2.5]));
        // Two rows of three: by columns 0 3, 1 4, 2 5.
        assert_eq!(read("u1", true, &[2, 3], &[0, 3, 1, 4, 2, 5]), Some(vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0]));
        assert_eq!(read("u1", false, &[2, 3], &[0; 5]), None);
        assert_eq!(read("f8", false, &[usize::MAX, 2], &[0; 8]), None);
        assert!(["O8", "f2", "S3", "", "f", "\u{e9}8"].iter().all(|name| ElementType::named(name).is_none()));
    }
}
