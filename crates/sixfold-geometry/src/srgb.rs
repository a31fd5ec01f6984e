//! The transfer function of sRGB (IEC 61966-2-1:1999): stored values to linear light and back, both 0 to 1.

/// Linear light of a stored value.
pub fn to_linear(stored: f32) -> f32 {
    if stored <= 0.040_45 { stored / 12.92 } else { ((stored + 0.055) / 1.055).powf(2.4) }
}

/// The stored value of linear light; light outside 0 to 1 is taken as the nearest in it.
pub fn from_linear(linear: f32) -> f32 {
    let linear = linear.clamp(0.0, 1.0);
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// The stored byte of linear light.
pub fn to_byte(linear: f32) -> u8 {
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
        assert_eq!(from_linear(-1.0), 0.0);
        assert!((from_linear(2.0) - 1.0).abs() < 1e-6);
    }
}
