//! The losses of the training (dissertation, equations 5.3 to 5.6).

use burn::tensor::activation::log_sigmoid;
use burn::tensor::{Tensor, TensorData};

/// Margin for templates of other objects (equation 5.4).
pub(crate) const GAMMA: f64 = 10.0;

/// The squared distances of rows: `batch x length` twice to `batch x 1`.
pub(crate) fn squared_distance(a: &Tensor<2>, b: &Tensor<2>) -> Tensor<2> {
    (a.clone() - b.clone()).square().sum_dim(1)
}

/// Equation 5.3, for each row of descriptors of regions, their positive and their negative templates, with the dynamic margins of
/// equation 5.4 (`batch x 1`); `counts` (`batch x 1`) is 1 in rows that have a negative template.
pub(crate) fn triplet_loss(
    region: &Tensor<2>,
    positive: &Tensor<2>,
    negative: &Tensor<2>,
    margin: Tensor<2>,
    counts: Tensor<2>,
) -> Tensor<1> {
    let (near, far) = (squared_distance(region, positive), squared_distance(region, negative));
    let loss = (far / (near + margin) * -1.0 + 1.0).clamp_min(0.0);
    (loss * counts.clone()).sum() / (counts.sum() + 1e-6)
}

/// Equation 5.3 with the positive templates of all other objects in the batch as negative ones, which uses the same images for more
/// comparisons. `different` (`batch x batch`) holds 1 where the objects differ.
pub(crate) fn cross_loss(region: &Tensor<2>, positive: &Tensor<2>, different: Tensor<2>) -> Tensor<1> {
    let near = squared_distance(region, positive);
    let product = region.clone().matmul(positive.clone().transpose());
    let of_region = region.clone().square().sum_dim(1);
    let of_template = positive.clone().square().sum_dim(1).transpose();
    let far = (of_region + of_template - product * 2.0).clamp_min(0.0);
    let loss = (far / (near + GAMMA) * -1.0 + 1.0).clamp_min(0.0);
    (loss * different.clone()).sum() / (different.sum() + 1e-6)
}

/// Equation 5.5, the mean over the batch.
pub(crate) fn pair_loss(region: &Tensor<2>, positive: &Tensor<2>) -> Tensor<1> {
    squared_distance(region, positive).mean()
}

/// Binary cross-entropy of logits, the mean; `truth` from 0 to 1.
pub(crate) fn mask_loss<const D: usize>(logits: Tensor<D>, truth: Tensor<D>) -> Tensor<1> {
    let yes = log_sigmoid(logits.clone()) * truth.clone();
    let no = log_sigmoid(logits * -1.0) * (truth * -1.0 + 1.0);
    (yes + no).mean() * -1.0
}

/// The Euclidean distance of rows, the mean: L_pose_reg for quaternions, and the same for places.
pub(crate) fn distance_loss(found: Tensor<2>, truth: Tensor<2>) -> Tensor<1> {
    // The derivative of the root at zero is infinite.
    (squared_distance(&found, &truth) + 1e-8).sqrt().mean()
}

/// A column of numbers as a tensor, `batch x 1`.
pub(crate) fn column(values: Vec<f32>, device: &burn::tensor::Device) -> Tensor<2> {
    let count = values.len();
    Tensor::from_data(TensorData::new(values, [count, 1]), device)
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    fn rows(values: Vec<f32>) -> Tensor<2> {
        let count = values.len() / 2;
        Tensor::from_data(TensorData::new(values, [count, 2]), &Device::flex())
    }

    fn number(t: Tensor<1>) -> f32 {
        t.into_data().try_to_vec::<f32>().unwrap()[0]
    }

    #[test]
    fn equation_5_3_by_hand() {
        let device = Device::flex();
        let region = rows(vec![0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let positive = rows(vec![1.0, 1.0, 1.0, 1.0, 0.0, 0.0]);
        let negative = rows(vec![0.0, 2.0, 5.0, 0.0, 0.0, 0.0]);
        // 1 - 4 / (2 + 6) = 0.5; 25 is further than 2 + 10; the third does not count.
        let margins = column(vec![6.0, 10.0, 1.0], &device);
        let loss = triplet_loss(&region, &positive, &negative, margins, column(vec![1.0, 1.0, 0.0], &device));
        assert!((number(loss) - 0.25).abs() < 1e-4);
        assert!((number(pair_loss(&region, &positive)) - 4.0 / 3.0).abs() < 1e-5);
    }

    #[test]
    fn other_objects_templates_are_negative_ones() {
        let region = rows(vec![0.0, 0.0, 3.0, 0.0]);
        let positive = rows(vec![0.0, 1.0, 3.0, 3.0]);
        let different = rows(vec![0.0, 1.0, 1.0, 0.0]);
        // First region, second template: 18 > 1 + 10. Second region, first template: 1 - 10 / (9 + 10).
        let loss = number(cross_loss(&region, &positive, different));
        assert!((loss - 0.5 * (1.0 - 10.0 / 19.0)).abs() < 1e-4, "{loss}");
    }

    #[test]
    fn masks_and_rotations_by_hand() {
        let loss = number(mask_loss(rows(vec![0.0, 2.0]), rows(vec![1.0, 0.0])));
        let expected = (2f32.ln() + (1.0 + 2f32.exp()).ln()) / 2.0;
        assert!((loss - expected).abs() < 1e-5);
        let off = number(distance_loss(rows(vec![3.0, 4.0, 1.0, 1.0]), rows(vec![0.0, 0.0, 1.0, 1.0])));
        assert!((off - 2.5).abs() < 1e-3, "{off}");
    }
}
