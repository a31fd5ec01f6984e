//! Which parts of an image may show an object: features of EfficientNet-Lite0 (Tan and Le 2019), as trained on ImageNet, of the
//! object's views and of the image. Unlike the features that correspondences are found with, they describe what kind of thing and
//! material a part shows.

use burn::tensor::{Device, Tensor, TensorData};
use sixfold_nn::device;
use sixfold_nn::lite0::{Lite0, imagenet_encoder};

use sixfold_align::outline::projected_box;
use sixfold_geometry::{Camera, Pose, RgbImage};
use sixfold_mesh::Mesh;
use sixfold_render::VisibilityBuffer;

use crate::crop::Crop;
use crate::error::ViewsError;
use crate::features::unit_features;
use crate::matching::mean_best;
use crate::templates::{CROP_FACTOR, over_grey, render};

/// Side of a cell, pixels.
pub(crate) const CELL: usize = 16;
/// Numbers of a feature.
pub(crate) const CHANNELS: usize = 112;
/// Stages of the network that are computed; the last one's features are used.
const STAGES: usize = 5;
/// Largest distance of a feature from its position in the view, cells.
const REACH: usize = 1;
/// Crops per forward pass.
const BATCH: usize = 8;
/// Side of the crop in which a pose is compared with an image, pixels.
const SIDE: usize = 160;

/// Tells whether an image shows an object at a pose, by features of a network trained on ImageNet.
#[derive(Debug)]
pub struct Recogniser {
    network: Lite0,
    device: Device,
}

/// Features of a square crop, row by row, each of length 1.
#[derive(Debug, Clone)]
pub(crate) struct Recognised {
    /// Cells along each side.
    pub cells: usize,
    /// [`CHANNELS`] numbers per cell.
    pub features: Vec<f32>,
}

/// Features of an object's view, each of length 1.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Appearance {
    /// Cells that show mostly the object, or the one that shows most of it.
    pub cells: Vec<u16>,
    /// Their features.
    pub features: Vec<f32>,
}

impl Recogniser {
    /// With the shipped network.
    ///
    /// # Errors
    /// [`ViewsError::Weights`].
    pub fn shipped() -> Result<Recogniser, ViewsError> {
        let device = device::chosen();
        Ok(Recogniser { network: imagenet_encoder(&device)?, device })
    }

    /// Features of colour crops of `side` x `side` pixels, three planes from 0 to 1 each.
    pub(crate) fn features(&self, crops: &[&[f32]], side: usize) -> Result<Vec<Recognised>, ViewsError> {
        let cells = side / CELL;
        let mut out = Vec::with_capacity(crops.len());
        for batch in crops.chunks(BATCH) {
            // The network was trained on `(value - 127) / 128` of 8-bit values.
            let mut data: Vec<f32> = Vec::with_capacity(batch.len() * 3 * side * side);
            batch.iter().for_each(|c| data.extend(c.iter().map(|v| (v * 255.0 - 127.0) / 128.0)));
            let data = TensorData::new(data, [batch.len(), 3, side, side]);
            let mut maps = self.network.forward_stages(Tensor::<4>::from_data(data, &self.device), STAGES);
            let Some(last) = maps.pop() else { break };
            let seen =
                last.try_into_vec_as::<f32>().map_err(|e| ViewsError::Network { reason: e.to_string() })?;
            out.extend(
                seen.chunks_exact(CHANNELS * cells * cells)
                    .map(|planes| Recognised { cells, features: unit_features(planes, cells * cells) }),
            );
        }
        Ok(out)
    }
}

impl Recogniser {
    /// How similar a colour image is to the object rendered at a pose, -1 to 1: the mean over the features of the render of the best
    /// product with a feature of the image near the same position. On LM-O's development frames 95 % of the right poses have more
    /// than 0.42, and 90 % of the wrong ones less than 0.43. `None` if the pose shows nothing of the object.
    ///
    /// # Errors
    /// [`ViewsError::Network`] if the network's output cannot be read.
    pub fn similarity(
        &self,
        mesh: &Mesh,
        image: &RgbImage,
        camera: &Camera,
        camera_from_object: &Pose,
    ) -> Result<Option<f64>, ViewsError> {
        let compared = self.compare(mesh, image, camera, camera_from_object)?;
        Ok(compared.map(|(view, seen)| f64::from(view.similarity(&seen))))
    }

    /// The features of the object rendered at a pose, and those of the image there; `None` if the pose shows nothing of the object.
    pub(crate) fn compare(
        &self,
        mesh: &Mesh,
        image: &RgbImage,
        camera: &Camera,
        camera_from_object: &Pose,
    ) -> Result<Option<(Appearance, Recognised)>, ViewsError> {
        let crop = projected_box(mesh, camera, camera_from_object)
            .and_then(|bbox| Crop::of_box(camera, &bbox, CROP_FACTOR, SIDE));
        let Some(crop) = crop else { return Ok(None) };
        let mut frame = VisibilityBuffer::new(&crop.camera);
        let rendered = render(&mut frame, mesh, &crop.to_crop(camera_from_object), None);
        let seen = crop.cut(image, camera, [0.5; 3]).data;
        let mut features = self.features(&[&over_grey(&rendered), &seen], SIDE)?;
        let (Some(seen), Some(view)) = (features.pop(), features.pop()) else { return Ok(None) };
        let view = Appearance::new(&view, |i| rendered.shows(i));
        Ok((!view.cells.is_empty()).then_some((view, seen)))
    }
}

impl Appearance {
    /// The features of a view on the cells of which more than half the pixels are `shown`; for a thin object without such cells on the one of
    /// which most are.
    pub(crate) fn new(map: &Recognised, shown: impl Fn(usize) -> bool) -> Appearance {
        let side = map.cells * CELL;
        let covered = |cell: usize| {
            let (x, y) = (cell % map.cells * CELL, cell / map.cells * CELL);
            let pixels = (y..y + CELL).flat_map(|v| (x..x + CELL).map(move |u| v * side + u));
            pixels.filter(|i| shown(*i)).count()
        };
        let covered: Vec<usize> = (0..map.cells * map.cells).map(covered).collect();
        let most = covered.iter().copied().max().unwrap_or(0);
        let enough = (CELL * CELL / 2 + 1).min(most.max(1));
        let cells: Vec<usize> = (0..covered.len()).filter(|cell| covered[*cell] >= enough).collect();
        let features = cells.iter().flat_map(|c| map.features[c * CHANNELS..][..CHANNELS].iter().copied());
        Appearance { features: features.collect(), cells: cells.iter().map(|c| *c as u16).collect() }
    }

    /// Mean over the view's features of the best product with a feature of the crop near the same position; 0 for a view without
    /// features.
    pub(crate) fn similarity(&self, crop: &Recognised) -> f32 {
        mean_best(&self.cells, &self.features, &crop.features, crop.cells, REACH, 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A map of 4 x 4 cells in which every cell has a different feature.
    fn map() -> Recognised {
        let mut features = vec![0.0; 16 * CHANNELS];
        (0..16).for_each(|cell| features[cell * CHANNELS + 5 * cell] = 1.0);
        Recognised { cells: 4, features }
    }

    #[test]
    fn only_cells_that_show_mostly_the_object_count() {
        // The object covers the image up to column 40: two cells, and half of the third.
        let side = 4 * CELL;
        let columns = |edge: usize| Appearance::new(&map(), move |i| i % side < edge);
        assert_eq!(columns(40).cells, [0, 1, 4, 5, 8, 9, 12, 13]);
        assert_eq!(columns(41).cells, [0, 1, 2, 4, 5, 6, 8, 9, 10, 12, 13, 14]);
        let view = columns(16);
        assert_eq!(view.features.len(), view.cells.len() * CHANNELS);
        assert_eq!(view.features[CHANNELS + 20], 1.0, "the second feature is that of cell 4");
        // A thin object, and none.
        let thin = Appearance::new(&map(), |i| i == 0 || i / side == 20 && (20..24).contains(&(i % side)));
        assert_eq!(thin.cells, [5]);
        assert_eq!(columns(0), Appearance::default());
    }

    #[test]
    fn a_view_is_recognised_one_cell_beside_its_position() {
        let at = |cells: [u16; 2], of: [usize; 2]| Appearance {
            cells: cells.to_vec(),
            features: of.iter().flat_map(|c| map().features[c * CHANNELS..][..CHANNELS].to_vec()).collect(),
        };
        assert_eq!(at([5, 10], [5, 10]).similarity(&map()), 1.0);
        assert_eq!(at([5, 10], [0, 15]).similarity(&map()), 1.0);
        assert_eq!(at([5, 10], [7, 10]).similarity(&map()), 0.5);
        assert_eq!(Appearance::default().similarity(&map()), 0.0);
    }

    #[test]
    fn features_do_not_depend_on_the_other_crops_of_a_batch() {
        let side = 2 * CELL;
        let crop = |seed: usize| -> Vec<f32> {
            (0..3 * side * side).map(|i| ((i * (7 + seed) + i / side * 13) % 61) as f32 / 60.0).collect()
        };
        let recogniser = Recogniser::shipped().unwrap();
        let crops: Vec<Vec<f32>> = (0..BATCH + 2).map(crop).collect();
        let all: Vec<&[f32]> = crops.iter().map(Vec::as_slice).collect();
        let together = recogniser.features(&all, side).unwrap();
        assert_eq!(together.len(), BATCH + 2);
        for (crop, together) in all.iter().zip(&together) {
            let alone = recogniser.features(&[crop], side).unwrap().remove(0);
            let difference = alone.features.iter().zip(&together.features).map(|(a, b)| (a - b).abs());
            assert!(difference.fold(0.0, f32::max) < 1e-5);
            let length = together.features[..CHANNELS].iter().map(|v| v * v).sum::<f32>();
            assert!((length - 1.0).abs() < 1e-5, "{length}");
        }
        let other = together[0].features.iter().zip(&together[1].features).map(|(a, b)| (a - b).abs());
        assert!(other.fold(0.0, f32::max) > 0.01);
    }
}
