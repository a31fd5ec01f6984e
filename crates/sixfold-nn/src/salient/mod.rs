//! U2-Net-p (Qin, Zhang, Huang, Dehghan, Zaiane and Jagersand 2020, "U2-Net: Going deeper with nested U-structure for salient
//! object detection"): which pixels of a photograph belong to salient objects, with its authors' weights.
//!
//! Batch normalisation is folded into the convolutions. Images are resized to 320x320 pixels by a triangle filter whose width
//! depends on the scale (Pillow's `BILINEAR`), and the map is resized back in the same way.

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
/// Side of the network's input images, in training and here, pixels.
pub const SIDE: usize = 320;
/// Mean of red, green and blue that the network expects, as a fraction of the largest value of the image.
pub const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
/// Their standard deviation.
pub const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];

/// The weights shipped with this crate (2.3 MB, Apache-2.0; their card is next to them).
const WEIGHTS: &[u8] = include_bytes!("../../weights/u2netp.safetensors");

/// Why the salience of an image could not be computed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SalientError {
    /// The image has no pixels.
    #[error("image: expected at least one pixel, found {width}x{height}")]
    EmptyImage {
        /// Number of columns.
        width: usize,
        /// Number of rows.
        height: usize,
    },
    /// No pixel of the image has its centre in the rectangle.
    #[error(
        "rectangle: expected pixels of the image of {width}x{height}, found x {} y {} width {} height {}; give a rectangle within \
         the image",
        rect.x, rect.y, rect.width, rect.height
    )]
    OutsideImage {
        /// Number of columns.
        width: usize,
        /// Number of rows.
        height: usize,
        /// The requested rectangle.
        rect: Rect,
    },
}

/// Salience of the pixels of an image.
#[derive(Debug, Clone, PartialEq)]
pub struct Salience {
    /// The network's output for each pixel, 0 to 1, of the image's size. For a rectangle of the image it is 0 outside the
    /// rectangle.
    pub probability: Image<f32>,
    /// The smallest output at the network's resolution.
    pub lowest: f32,
    /// The largest output. If it is far below 1, nothing is salient, and [`Salience::relative`] shows noise.
    pub highest: f32,
}

impl Salience {
    /// The outputs scaled so that the smallest is 0 and the largest 1, as the network's authors do. All 0 if they are equal.
    pub fn relative(&self) -> Image<f32> {
        let range = self.highest - self.lowest;
        if range > 0.0 {
            self.probability.map(|p| ((p - self.lowest) / range).clamp(0.0, 1.0))
        } else {
            self.probability.map(|_| 0.0)
        }
    }

    /// Pixels whose [`Salience::relative`] value is above a threshold, 0.5 for pixels that are more likely salient than not.
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
    /// The network with its authors' weights, which are shipped with the program.
    ///
    /// # Errors
    /// [`WeightsError`] if the shipped weights have another version than the program.
    pub fn shipped(device: &Device) -> Result<SalientNetwork, WeightsError> {
        let name = Path::new("u2netp.safetensors");
        let layers = load_weights_from_bytes(Layers::empty(device), name, WEIGHTS, ARCHITECTURE)?.0;
        Ok(SalientNetwork { layers, device: device.clone() })
    }

    /// The network with the weights of a file from `checks/convert_u2netp.py`.
    ///
    /// # Errors
    /// [`WeightsError`]: for an unreadable or broken file, one of another network, and the first tensor that does not fit.
    pub fn load(path: &Path, device: &Device) -> Result<SalientNetwork, WeightsError> {
        let layers = load_weights(Layers::empty(device), path, ARCHITECTURE)?.0;
        Ok(SalientNetwork { layers, device: device.clone() })
    }

    /// The layers, for batches of [prepared](SalientNetwork::prepared) images.
    pub fn layers(&self) -> &Layers {
        &self.layers
    }

    /// The layers' input for an image, `1 x 3 x 320 x 320`: resized, divided by its largest value, normalised.
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
        // A black image is not scaled.
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

    /// The salience of each pixel of an image.
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

    /// The salience of each pixel whose centre is in a rectangle, computed without its surroundings; the map has the image's size.
    ///
    /// # Errors
    /// [`SalientError::OutsideImage`] if the rectangle contains no pixel's centre.
    pub fn salience_in(&self, image: &RgbImage, rect: Rect) -> Result<Salience, SalientError> {
        let (width, height) = image.size();
        // A pixel's centre is half a pixel from its edges; NaN gives an empty range.
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
