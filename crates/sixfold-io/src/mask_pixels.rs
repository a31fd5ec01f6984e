//! The pixels of an image file that belong to a mask: those that are not zero. Ambiguous files are refused.
//!
//! An alpha channel that is opaque everywhere is ignored. Otherwise it is the mask, as for a cut-out object, unless the colours
//! contradict it: then it is unclear which of both was meant.

use image::DynamicImage;

/// One flag per pixel, row by row.
///
/// # Errors
/// A message with the ambiguity, the expectation and advice.
pub(crate) fn inside(image: &DynamicImage) -> Result<Vec<bool>, String> {
    match image {
        DynamicImage::ImageLuma8(p) => Ok(p.as_raw().iter().map(|&v| v > 0).collect()),
        DynamicImage::ImageLuma16(p) => Ok(p.as_raw().iter().map(|&v| v > 0).collect()),
        DynamicImage::ImageLumaA8(p) => with_alpha::<u8, 2>(p.as_raw(), u8::MAX),
        DynamicImage::ImageLumaA16(p) => with_alpha::<u16, 2>(p.as_raw(), u16::MAX),
        DynamicImage::ImageRgb8(p) => colored(p.as_raw().as_chunks::<3>().0.iter().copied()),
        DynamicImage::ImageRgb16(p) => colored(p.as_raw().as_chunks::<3>().0.iter().copied()),
        DynamicImage::ImageRgba8(p) => with_alpha::<u8, 4>(p.as_raw(), u8::MAX),
        DynamicImage::ImageRgba16(p) => with_alpha::<u16, 4>(p.as_raw(), u16::MAX),
        other => Err(format!(
            "{:?} is not a mask format, expected grey, palette or RGB, with alpha or without",
            other.color()
        )),
    }
}

/// The grey value of pixels that may or may not show the object.
pub(crate) const HIDDEN: u8 = 128;

/// The [`HIDDEN`] pixels of a grey image of 8 bits; `None` if there are none.
pub(crate) fn hidden(image: &DynamicImage) -> Option<Vec<bool>> {
    let DynamicImage::ImageLuma8(pixels) = image else { return None };
    let hidden: Vec<bool> = pixels.as_raw().iter().map(|v| *v == HIDDEN).collect();
    hidden.contains(&true).then_some(hidden)
}

/// The type of pixel values.
trait Value: Copy + Default + PartialEq {}
impl Value for u8 {}
impl Value for u16 {}

/// Grey, or one colour besides black: several colours would be several objects, or a photograph.
fn colored<T: Value>(pixels: impl Iterator<Item = [T; 3]> + Clone) -> Result<Vec<bool>, String> {
    let black = [T::default(); 3];
    if pixels.clone().any(|[r, g, b]| r != g || g != b) {
        let mut others = pixels.clone().filter(|p| *p != black);
        let first = others.next().unwrap_or(black);
        if others.any(|p| p != first) {
            return Err("found several colours besides black, expected one: are these the labels of several objects, or a \
                        photograph? Give an image that is black (0) outside the one object"
                .to_owned());
        }
    }
    Ok(pixels.map(|p| p != black).collect())
}

/// Pixels of `N` values of which the last is alpha.
fn with_alpha<T: Value, const N: usize>(values: &[T], full: T) -> Result<Vec<bool>, String> {
    let pixels = values.as_chunks::<N>().0;
    let seen = |p: &[T; N]| p[N - 1] != T::default();
    let color = |p: &[T; N]| -> [T; 3] { std::array::from_fn(|k| if N == 4 { p[k] } else { p[0] }) };
    if pixels.iter().all(|p| p[N - 1] == full) {
        return colored(pixels.iter().map(color));
    }
    let black = [T::default(); 3];
    let by_alpha: Vec<bool> = pixels.iter().map(seen).collect();
    let all_black = pixels.iter().filter(|p| seen(p)).all(|p| color(p) == black);
    let none_black = pixels.iter().filter(|p| seen(p)).all(|p| color(p) != black);
    let any_seen = by_alpha.contains(&true);
    if any_seen && (all_black || none_black) {
        return Ok(by_alpha);
    }
    Err(if any_seen {
        "found black and other colours where alpha is not zero: is the mask in the colours or in alpha? Save it without alpha"
    } else {
        "found alpha 0 everywhere, expected a mask that shows something; save it without alpha"
    }
    .to_owned())
}
