//! The transfer function of sRGB (IEC 61966-2-1:1999): stored values to linear light and back, both 0 to 1.

use std::sync::LazyLock;

/// Linear light of a stored value.
pub fn to_linear(stored: f32) -> f32 {
    if stored <= 0.040_45 { stored / 12.92 } else { ((stored + 0.055) / 1.055).powf(2.4) }
}

/// The stored value of linear light; light outside 0 to 1 is taken as the nearest in it.
pub fn from_linear(linear: f32) -> f32 {
    let linear = linear.clamp(0.0, 1.0);
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// The stored byte of linear light. By a table: a picture has this for every channel of every pixel.
pub fn to_byte(linear: f32) -> u8 {
    static TABLE: LazyLock<Table> = LazyLock::new(Table::new);
    TABLE.byte(linear)
}

/// Number of equal ranges of linear light; none contains more than two bytes.
const RANGES: usize = 4096;

struct Table {
    /// The smallest linear value that gives each byte; no value reaches the last entry.
    smallest: [f32; 257],
    /// The byte at the beginning of each range.
    first: [u8; RANGES + 1],
}

impl Table {
    fn new() -> Table {
        let mut smallest = [f32::INFINITY; 257];
        for (byte, smallest) in smallest.iter_mut().take(256).enumerate() {
            // The numbers from 0 to 1 are in the order of their bits.
            let (mut low, mut high) = (0, 1f32.to_bits());
            while low < high {
                let middle = (low + high) / 2;
                if usize::from(computed_byte(f32::from_bits(middle))) < byte {
                    low = middle + 1;
                } else {
                    high = middle;
                }
            }
            *smallest = f32::from_bits(low);
        }
        let first = std::array::from_fn(|range| computed_byte(range as f32 / RANGES as f32));
        Table { smallest, first }
    }

    fn byte(&self, linear: f32) -> u8 {
        let linear = linear.clamp(0.0, 1.0);
        // NaN is 0 here, as it is for a computed byte.
        let first = self.first[(linear * RANGES as f32) as usize];
        first + u8::from(linear >= self.smallest[usize::from(first) + 1])
    }
}

fn computed_byte(linear: f32) -> u8 {
    (from_linear(linear) * 255.0).round() as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_come_back_and_half_of_the_light_is_stored_as_188() {
        for value in 0..=255u8 {
            let stored = f32::from(value) / 255.0;
            assert!((from_linear(to_linear(stored)) - stored).abs() < 1e-6);
            assert_eq!(to_byte(to_linear(stored)), value);
        }
        assert_eq!(to_byte(0.5), 188);
        assert_eq!((to_byte(-0.1), to_byte(1.5), to_byte(f32::NAN)), (0, 255, 0));
        assert_eq!(from_linear(-1.0), 0.0);
        assert!((from_linear(2.0) - 1.0).abs() < 1e-6);
    }

    #[test]
    fn bytes_of_the_table_are_those_of_the_formula() {
        let table = Table::new();
        // Every light whose byte could be wrong by rounding, and an even spread.
        let close = table.smallest[1..256].iter().flat_map(|smallest| {
            let bits = smallest.to_bits();
            (bits - 3..bits + 3).map(f32::from_bits)
        });
        let even = (0..=100_000).map(|i| i as f32 / 100_000.0);
        for linear in close.chain(even) {
            assert_eq!(table.byte(linear), computed_byte(linear), "{linear}");
        }
    }
}
