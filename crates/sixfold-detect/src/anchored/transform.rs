//! An image as the networks want it: values as the encoder wants them, the shorter side at one length, padded with zeros.

use sixfold_geometry::RgbImage;

use super::config::AnchoredConfig;
use crate::network::EncoderKind;

/// torchvision's, of the values of a channel in 0..1.
const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];
/// Rows and columns are padded to multiples of this, the coarsest stride of the encoders.
const ALIGNMENT: usize = 32;

/// A channel's mean and deviation that an encoder was trained with: of EfficientNet-Lite0, `(255 v - 127) / 128`.
fn statistics(encoder: EncoderKind, channel: usize) -> (f32, f32) {
    match encoder {
        EncoderKind::Lite0 => (127.0 / 255.0, 128.0 / 255.0),
        EncoderKind::ResNet50 => (MEAN[channel % 3], DEVIATION[channel % 3]),
    }
}

/// An image of three planes with values in 0..1, in place.
pub(super) fn normalise(rgb: &mut [f32], encoder: EncoderKind) {
    let pixels = rgb.len() / 3;
    for (channel, plane) in rgb.chunks_exact_mut(pixels.max(1)).enumerate() {
        let (mean, deviation) = statistics(encoder, channel);
        plane.iter_mut().for_each(|v| *v = (*v - mean) / deviation);
    }
}

/// An image at the network's scale. Sizes are rows and columns.
#[derive(Debug, Clone)]
pub(super) struct Input {
    /// 3 x rows x columns.
    pub values: Vec<f32>,
    /// With padding.
    pub padded: [usize; 2],
    /// What shows the image.
    pub filled: [usize; 2],
    /// The image itself.
    pub image: [usize; 2],
}

/// Rows and columns of the resized image.
fn resized(image: [usize; 2], config: &AnchoredConfig) -> [usize; 2] {
    let [shorter, longer] = [image[0].min(image[1]), image[0].max(image[1])];
    let scale = (config.min_side as f64 / shorter as f64).min(config.max_side as f64 / longer as f64);
    image.map(|side| ((side as f64 * scale).floor() as usize).max(1))
}

/// Pixel before, pixel after and fraction of the latter, of each pixel of a side resized from `from` to `to`: bilinear, corners not
/// aligned.
pub(super) fn taps(from: usize, to: usize) -> Vec<(usize, usize, f32)> {
    let scale = from as f32 / to as f32;
    (0..to)
        .map(|i| {
            let place = (scale * (i as f32 + 0.5) - 0.5).max(0.0);
            let low = (place as usize).min(from - 1);
            (low, (low + 1).min(from - 1), (place - low as f32).clamp(0.0, 1.0))
        })
        .collect()
}

/// A plane of `columns` columns resized to the taps of rows and columns.
pub(super) fn interpolate(
    plane: &[f32],
    columns: usize,
    rows_to: &[(usize, usize, f32)],
    columns_to: &[(usize, usize, f32)],
    mut put: impl FnMut(usize, usize, f32),
) {
    for (y, (top, bottom, down)) in rows_to.iter().enumerate() {
        let (top, bottom) = (&plane[top * columns..][..columns], &plane[bottom * columns..][..columns]);
        for (x, (left, right, across)) in columns_to.iter().enumerate() {
            let upper = (1.0 - across) * top[*left] + across * top[*right];
            let lower = (1.0 - across) * bottom[*left] + across * bottom[*right];
            put(x, y, (1.0 - down) * upper + down * lower);
        }
    }
}

impl Input {
    /// `None` for an image without pixels.
    pub(super) fn new(image: &RgbImage, config: &AnchoredConfig) -> Option<Input> {
        let (columns, rows) = image.size();
        if columns == 0 || rows == 0 {
            return None;
        }
        let filled = resized([rows, columns], config);
        let padded = filled.map(|side| side.next_multiple_of(ALIGNMENT));
        let pixels = padded[0] * padded[1];
        let mut values = vec![0.0; 3 * pixels];
        let (rows_to, columns_to) = (taps(rows, filled[0]), taps(columns, filled[1]));
        for (channel, target) in values.chunks_exact_mut(pixels).enumerate() {
            let (mean, deviation) = statistics(config.encoder, channel);
            let value = |rgb: &[u8; 3]| (f32::from(rgb[channel]) / 255.0 - mean) / deviation;
            let plane: Vec<f32> = image.as_slice().iter().map(value).collect();
            interpolate(&plane, columns, &rows_to, &columns_to, |x, y, v| target[y * padded[1] + x] = v);
        }
        Some(Input { values, padded, filled, image: [rows, columns] })
    }

    /// A box of the resized image in the image itself.
    pub(super) fn to_image(&self, c: super::boxes::Corners) -> super::boxes::Corners {
        let [down, right] = [0, 1].map(|i| self.image[i] as f32 / self.filled[i] as f32);
        [c[0] * right, c[1] * down, c[2] * right, c[3] * down]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::anchored::AnchoredKind;

    #[test]
    fn the_shorter_side_decides_unless_the_longer_one_is_too_long() {
        let config = AnchoredConfig::new(AnchoredKind::RetinaNet, 3);
        assert_eq!(resized([480, 640], &config), [800, 1066]);
        assert_eq!(resized([300, 900], &config), [444, 1333]);
        assert_eq!(resized([1, 90_000], &config), [1, 1333]);
    }

    #[test]
    fn an_image_is_enlarged_between_its_pixels_and_padded_with_zeros() {
        let config =
            AnchoredConfig { min_side: 4, max_side: 99, ..AnchoredConfig::new(AnchoredKind::FasterRcnn, 2) };
        let image = RgbImage::from_fn(3, 2, |x, _| [if x == 2 { 255 } else { 0 }; 3]);
        let input = Input::new(&image, &config).unwrap();
        assert_eq!((input.filled, input.padded, input.image), ([4, 6], [32, 32], [2, 3]));
        let row: Vec<f32> = input.values[..7].iter().map(|v| v * 0.229 + 0.485).collect();
        // The last is padding: zero after normalisation, the mean before.
        let expected = [0.0, 0.0, 0.0, 0.25, 0.75, 1.0, 0.485];
        assert!(row.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{row:?}");
        assert_eq!(input.to_image([6.0, 4.0, 3.0, 2.0]), [3.0, 2.0, 1.5, 1.0]);
        assert!(Input::new(&RgbImage::filled(0, 0, [0; 3]), &config).is_none());
        let lite0 = AnchoredConfig { encoder: EncoderKind::Lite0, ..config };
        let values = Input::new(&image, &lite0).unwrap().values;
        let expected = [-127.0, -127.0, -127.0, -63.25, 64.25, 128.0, 0.0].map(|v| v / 128.0);
        assert!(values.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{:?}", &values[..7]);
        let mut rgb = vec![1.0, 0.0, 0.2];
        normalise(&mut rgb, EncoderKind::Lite0);
        let expected = [128.0, -127.0, 51.0 - 127.0].map(|v| v / 128.0);
        assert!(rgb.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{rgb:?}");
    }
}
