//! The limit on image sizes, which every reader of images checks before it decodes anything.

use std::sync::atomic::{AtomicU64, Ordering};

/// Default limit of pixels per image: 100 megapixels, more than depth and industrial cameras have.
pub const DEFAULT_MAX_PIXELS: u64 = 100_000_000;

static MAX_PIXELS: AtomicU64 = AtomicU64::new(DEFAULT_MAX_PIXELS);

/// Sets the limit of this process for images without their own limit ([`crate::ImageFile::with_limit`]) and for the sizes that
/// camera files state, as for a program's option. At least 1.
pub fn set_max_pixels(pixels: u64) {
    MAX_PIXELS.store(pixels.max(1), Ordering::Relaxed);
}

/// The current limit.
pub fn max_pixels() -> u64 {
    MAX_PIXELS.load(Ordering::Relaxed)
}

/// Checks a size that a header or a camera file states.
///
/// # Errors
/// The size that is too large, and how to raise the limit.
pub fn check_pixels(width: usize, height: usize, limit: u64) -> Result<(), String> {
    let pixels = (width as u64).saturating_mul(height as u64);
    if pixels <= limit {
        return Ok(());
    }
    Err(format!(
        "{width}x{height} are {:.1} megapixels, expected at most {:.1}; if the image is meant to be that large, raise the limit \
         (--max-pixels, set_max_pixels)",
        pixels as f64 / 1e6,
        limit as f64 / 1e6
    ))
}
