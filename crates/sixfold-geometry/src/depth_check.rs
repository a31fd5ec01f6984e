//! Checks that a depth image can show a tabletop scene in metres.

use crate::DepthImage;
use thiserror::Error;

/// Why a depth image cannot be used.
#[derive(Debug, Error, Clone, PartialEq)]
pub enum DepthImageError {
    /// No pixel has depth.
    #[error(
        "the depth image has no valid pixel (all {pixels} are zero or not finite): check the file and its depth scale"
    )]
    NoDepth {
        /// Pixels in the image.
        pixels: usize,
    },
    /// All depth is outside the range of tabletop scenes.
    #[error(
        "the depth lies between {nearest:.4} m and {farthest:.4} m, outside 0.05 m to 20 m: is the depth scale wrong by a factor of 1000?"
    )]
    Scale {
        /// Smallest valid depth in metres.
        nearest: f32,
        /// Largest valid depth in metres.
        farthest: f32,
    },
}

/// The image (metres) with 0 where depth is negative or not finite.
///
/// # Errors
/// [`DepthImageError`] when no depth is left, or all of it is nearer than 0.05 m or further than 20 m.
pub fn usable_depth(depth: &DepthImage) -> Result<DepthImage, DepthImageError> {
    let depth = depth.map(|&z| if z > 0.0 && z.is_finite() { z } else { 0.0 });
    let valid = depth.as_slice().iter().copied().filter(|&z| z > 0.0);
    let (nearest, farthest) = valid.fold((f32::INFINITY, 0f32), |(a, b), z| (a.min(z), b.max(z)));
    if farthest == 0.0 {
        return Err(DepthImageError::NoDepth { pixels: depth.as_slice().len() });
    }
    if farthest < 0.05 || nearest > 20.0 {
        return Err(DepthImageError::Scale { nearest, farthest });
    }
    Ok(depth)
}
