//! U2-Net-p (Qin, Zhang, Huang, Dehghan, Zaiane and Jagersand 2020, "U2-Net: Going deeper with nested U-structure for salient object
//! detection"): which pixels of a photograph belong to what stands out in it, with weights that its authors trained.
//!
//! Batch normalisation is folded into the convolutions. Images are resized to 320x320 pixels by a triangle filter as wide as the
//! scale asks for (Pillow's `BILINEAR`), the map back by the same.

mod network;
mod resize;

use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};
use sixfold_geometry::{Image, Mask, Rect, RgbImage};

pub use network::{Layers, MULTIPLE};
use resize::resized;

use crate::weights::{WeightsError, load_weights, load_weights_from_bytes};

/// Name of the network in weight files.
pub const ARCHITECTURE: &str = "u2netp";
/// Side in pixels of the images that the network was trained on and sees here.
pub const SIDE: usize = 320;
/// Mean of red, green and blue that the network expects, in parts of the largest value of the image.
pub const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
/// Their standard deviation.
pub const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];

/// The weights that this crate carries (2.3 MB, Apache-2.0; their card lies beside them).
const WEIGHTS: &[u8] = include_bytes!("../../weights/u2netp.safetensors");

/// Why nothing salient could be looked for in an image.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SalientError {
    /// The image has no pixels.
    #[error("image: expected at least one pixel, found {width}x{height}")]
    EmptyImage {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// No pixel of the image has its centre in the rectangle.
    #[error(
        "rectangle: expected pixels of the image of {width}x{height}, found x {} y {} width {} height {}; give a rectangle within \
         the image",
        rect.x, rect.y, rect.width, rect.height
    )]
    OutsideImage {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// What was asked for.
        rect: Rect,
    },
}

/// How salient the pixels of an image are.
#[derive(Debug, Clone, PartialEq)]
pub struct Salience {
    /// The network's answer for each pixel, 0 to 1, of the image's size. For a rectangle of the image, 0 around it.
    pub probability: Image<f32>,
    /// The smallest answer at the network's resolution.
    pub lowest: f32,
    /// The largest. Where it is far below 1 nothing stands out, and [`Salience::relative`] shows noise.
    pub highest: f32,
}

impl Salience {
    /// The answers stretched so that the smallest is 0 and the largest 1, as the network's authors do. All 0 where they are equal.
    pub fn relative(&self) -> Image<f32> {
        let range = self.highest - self.lowest;
        if range > 0.0 {
            self.probability.map(|p| ((p - self.lowest) / range).clamp(0.0, 1.0))
        } else {
            self.probability.map(|_| 0.0)
        }
    }

    /// Pixels whose [`Salience::relative`] value is above a threshold, 0.5 for what is more likely salient than not.
    pub fn mask(&self, threshold: f32) -> Mask {
        self.relative().map(|v| *v > threshold)
    }
}

/// The network with its weights.
#[derive(Debug, Clone)]
pub struct SalientNetwork {
    layers: Layers,
    device: Device,
}

impl SalientNetwork {
    /// The network with its authors' weights, from within the program.
    ///
    /// # Errors
    /// [`WeightsError`] if the program carries other weights than its own version's.
    pub fn shipped(device: &Device) -> Result<SalientNetwork, WeightsError> {
        let name = Path::new("u2netp.safetensors");
        let layers = load_weights_from_bytes(Layers::empty(device), name, WEIGHTS, ARCHITECTURE)?.0;
        Ok(SalientNetwork { layers, device: device.clone() })
    }

    /// The network with the weights of a file that `checks/convert_u2netp.py` made.
    ///
    /// # Errors
    /// [`WeightsError`]: an unreadable or broken file, another network's, and the first tensor that does not fit.
    pub fn load(path: &Path, device: &Device) -> Result<SalientNetwork, WeightsError> {
        let layers = load_weights(Layers::empty(device), path, ARCHITECTURE)?.0;
        Ok(SalientNetwork { layers, device: device.clone() })
    }

    /// The layers, for batches of [prepared](SalientNetwork::prepared) images.
    pub fn layers(&self) -> &Layers {
        &self.layers
    }

    /// What the layers see of an image, `1 x 3 x 320 x 320`: resized, divided by its largest value, normalised.
    ///
    /// # Errors
    /// [`SalientError::EmptyImage`].
    pub fn prepared(&self, image: &RgbImage) -> Result<Tensor<4>, SalientError> {
        let (width, height) = image.size();
        if width == 0 || height == 0 {
            return Err(SalientError::EmptyImage { width, height });
        }
        let planes: Vec<Image<f32>> = (0..3)
            .map(|channel| resized(&image.map(|pixel| f32::from(pixel[channel])), [SIDE, SIDE]))
            .collect();
        let largest = planes.iter().flat_map(Image::as_slice).copied().fold(0.0, f32::max);
        // A black image stays black.
        let scale = if largest > 0.0 { 1.0 / largest } else { 1.0 };
        let values: Vec<f32> = planes
            .iter()
            .zip(MEAN.into_iter().zip(DEVIATION))
            .flat_map(|(plane, (mean, deviation))| {
                plane.as_slice().iter().map(move |v| (v * scale - mean) / deviation)
            })
            .collect();
        Ok(Tensor::from_data(TensorData::new(values, [1, 3, SIDE, SIDE]), &self.device))
    }

    /// How salient each pixel of an image is.
    ///
    /// # Errors
    /// [`SalientError::EmptyImage`].
    pub fn salience(&self, image: &RgbImage) -> Result<Salience, SalientError> {
        let (width, height) = image.size();
        let map = self.layers.forward(self.prepared(image)?).into_data();
        let map: Vec<f32> = map.iter::<f32>().collect();
        let (lowest, highest) =
            map.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)));
        let small = Image::from_fn(SIDE, SIDE, |x, y| map[y * SIDE + x]);
        Ok(Salience { probability: resized(&small, [width, height]), lowest, highest })
    }

    /// How salient each pixel whose centre lies in a rectangle is, seen without what is around it; the map has the image's size.
    ///
    /// # Errors
    /// [`SalientError::OutsideImage`] where the rectangle holds no pixel's centre.
    pub fn salience_in(&self, image: &RgbImage, rect: Rect) -> Result<Salience, SalientError> {
        let (width, height) = image.size();
        // A pixel's centre lies half a pixel from its edges; NaN gives an empty range.
        let range = |start: f64, length: f64, side: usize| {
            let first = (start - 0.5).ceil().max(0.0) as usize;
            let last = (start + length - 0.5).ceil().clamp(0.0, side as f64) as usize;
            first..last
        };
        let (columns, rows) = (range(rect.x, rect.width, width), range(rect.y, rect.height, height));
        if columns.is_empty() || rows.is_empty() {
            return Err(SalientError::OutsideImage { width, height, rect });
        }
        let crop =
            RgbImage::from_fn(columns.len(), rows.len(), |x, y| image[(columns.start + x, rows.start + y)]);
        let seen = self.salience(&crop)?;
        let mut probability = Image::filled(width, height, 0.0);
        for y in 0..rows.len() {
            let start = (rows.start + y) * width + columns.start;
            probability.as_mut_slice()[start..start + columns.len()].copy_from_slice(seen.probability.row(y));
        }
        Ok(Salience { probability, ..seen })
    }
}

#[cfg(test)]
mod tests;
