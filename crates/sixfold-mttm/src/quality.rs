//! How good a network is on regions it was not trained on.

use burn::tensor::activation::sigmoid;
use burn::tensor::{Tensor, TensorData};
use serde::{Deserialize, Serialize};
use sixfold_geometry::stats::upper_median;

use crate::loss::squared_distance;
use crate::network::{MAP, Network, masked};
use crate::patch::PLANES;
use crate::samples::{Augmentation, Batch, PairBatchOptions, Pool};
use sixfold_nn::device;

/// Accuracy of a network on regions with templates of about the right pose. Medians and fractions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// Number of regions.
    pub regions: usize,
    /// Fraction of the regions whose own template is nearer than 39 templates of other objects and poses.
    pub nearest: f64,
    /// Fraction of the masks with an intersection over union above one half.
    pub masks: f64,
    /// Median angle between template and object, and the remaining angle after the predicted rotation, radians.
    pub rotation: [f64; 2],
    /// Median distance from the template's reference point to the region's centre, and to the predicted position, as fractions of
    /// the patch.
    pub offset: [f64; 2],
    /// Fraction of pairs classified correctly: own template, template of another object or pose.
    pub matching: f64,
}

impl Quality {
    /// Names and values, for display.
    pub fn scores(&self) -> [(&'static str, f64); 7] {
        [
            ("own template the nearest of 40", self.nearest),
            ("masks with an intersection over union above 0.5", self.masks),
            ("median rotation from the template, degrees", self.rotation[0].to_degrees()),
            ("the same after the predicted rotation, degrees", self.rotation[1].to_degrees()),
            ("median distance of the reference point, fraction of the patch", self.offset[0]),
            ("the same after the predicted offset", self.offset[1]),
            ("pairs classified correctly", self.matching),
        ]
    }
}

/// Measures a network on a pool, in batches of 40 regions, each once on average.
pub fn quality(network: &Network, pool: &Pool) -> Quality {
    let device = device::chosen();
    let augmentation = Augmentation { hidden: 0.0, lost: 0.0, ..Augmentation::default() };
    let options = PairBatchOptions { anchors: 40, without_object: 0, other_objects: 0.0, augmentation };
    let steps = (pool.with_object().len() / options.anchors).max(1);
    let (mut nearest, mut masks, mut matching) = (0usize, 0usize, 0usize);
    let mut rotation = [vec![], vec![]];
    let mut offset = [vec![], vec![]];
    for step in 0..steps {
        let batch = Batch::of_step(pool, &options, 0x9a, step as u64);
        let (count, side) = (options.anchors, network.side());
        let patches = |values: Vec<f32>| {
            Tensor::<4>::from_data(TensorData::new(values, [count, PLANES, side, side]), &device)
        };
        let cells =
            |values: Vec<f32>| Tensor::<4>::from_data(TensorData::new(values, [count, 1, MAP, MAP]), &device);
        let truth = batch.region_masks;
        let regions = network.maps(patches(batch.regions));
        let positives = masked(network.maps(patches(batch.positives)), cells(batch.positive_masks));
        let (a, b) = (network.descriptor(regions.clone()), network.descriptor(positives.clone()));
        for i in 0..count {
            let row = a.clone().narrow(0, i, 1).repeat_dim(0, count);
            let distances = numbers(squared_distance(&row, &b));
            let best = (0..count).min_by(|x, y| distances[*x].total_cmp(&distances[*y])).unwrap_or(i);
            nearest += usize::from(best == i);
        }
        let said = network.compare(regions.clone(), positives.clone());
        let next = Tensor::cat(vec![positives.clone().narrow(0, 1, count - 1), positives.narrow(0, 0, 1)], 0);
        let wrong = network.compare(regions, next);
        let (right, wrong) = (numbers(said.matching), numbers(wrong.matching));
        matching += right.iter().filter(|v| **v > 0.0).count() + wrong.iter().filter(|v| **v <= 0.0).count();
        let mask = numbers(sigmoid(said.mask));
        let (q, p) = (numbers(said.rotation), numbers(said.offset));
        for i in 0..count {
            let (mut common, mut either) = (0, 0);
            for k in i * MAP * MAP..(i + 1) * MAP * MAP {
                let (a, b) = (mask[k] > 0.5, truth[k] > 0.5);
                common += usize::from(a && b);
                either += usize::from(a || b);
            }
            masks += usize::from(2 * common > either);
            let angle = |q: &[f32], r: &[f32]| {
                let dot: f32 = q.iter().zip(r).map(|(a, b)| a * b).sum();
                let norm = q.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-6);
                2.0 * f64::from((dot / norm).abs().min(1.0)).acos()
            };
            let r = &batch.rotations[4 * i..4 * i + 4];
            rotation[0].push(angle(&[1.0, 0.0, 0.0, 0.0], r));
            rotation[1].push(angle(&q[4 * i..4 * i + 4], r));
            let distance = |a: &[f32], b: &[f32]| {
                f64::from(a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f32>().sqrt())
            };
            let o = &batch.offsets[3 * i..3 * i + 3];
            offset[0].push(distance(&[0.0; 3], o));
            offset[1].push(distance(&p[3 * i..3 * i + 3], o));
        }
    }
    let regions = steps * options.anchors;
    let fraction = |n: usize| n as f64 / regions as f64;
    Quality {
        regions,
        nearest: fraction(nearest),
        masks: fraction(masks),
        rotation: rotation.map(median),
        offset: offset.map(median),
        matching: 0.5 * fraction(matching),
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    upper_median(&mut values).unwrap_or(f64::NAN)
}

fn numbers<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec().unwrap_or_else(|error| unreachable!("f32 output: {error:?}"))
}
