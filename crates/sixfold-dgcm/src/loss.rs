//! The losses of DGCM-Net (dissertation, equations 6.2 to 6.4).

use burn::tensor::Tensor;

/// Negative pairs are pushed apart up to this distance (equation 6.2).
pub(crate) const MARGIN: f64 = 10.0;
/// Weight of pixels on the object (equation 6.3).
const OBJECT_WEIGHT: f64 = 3.0;

/// The contrastive loss of equation 6.2 for features (`pairs x 256`) whose first `positives` rows are positive pairs, and
/// the mean distances of positive and of negative pairs.
pub(crate) fn metric_loss(
    input: &Tensor<2>,
    experience: &Tensor<2>,
    positives: usize,
) -> (Tensor<1>, Tensor<1>, Tensor<1>) {
    let pairs = input.dims()[0];
    let squared = (input.clone() - experience.clone()).square().sum_dim(1);
    // The derivative of the root at zero is infinite.
    let distance = (squared.clone() + 1e-9).sqrt();
    let near = squared.narrow(0, 0, positives).sum();
    let mut sum = near;
    let negatives = pairs - positives;
    if negatives > 0 {
        let far = distance.clone().narrow(0, positives, negatives);
        sum = sum + (far * -1.0 + MARGIN).clamp_min(0.0).square().sum();
    }
    let mean = |start: usize, count: usize| {
        let start = start.min(pairs - 1);
        distance.clone().narrow(0, start, count.clamp(1, pairs - start)).mean()
    };
    (sum / pairs as f64, mean(0, positives), mean(positives, negatives))
}

/// Equation 6.2 for all pairs of a first and a second view of the batch that show different families: which uses the same images
/// for more comparisons. `different` (`pairs x pairs`) holds 1 for such pairs.
pub(crate) fn cross_loss(input: &Tensor<2>, experience: &Tensor<2>, different: Tensor<2>) -> Tensor<1> {
    let of_input = input.clone().square().sum_dim(1);
    let of_experience = experience.clone().square().sum_dim(1).transpose();
    let product = input.clone().matmul(experience.clone().transpose());
    let squared = (of_input + of_experience - product * 2.0).clamp_min(0.0);
    let missing = ((squared + 1e-6).sqrt() * -1.0 + MARGIN).clamp_min(0.0).square();
    (missing * different.clone()).sum() / (different.sum() + 1e-6)
}

/// The masked L1 loss of equation 6.3 for coordinates (`batch x 3 x side x side`) where `mask` (`batch x 1 x side x side`)
/// is 1 on the object, and the mean absolute error of one coordinate there.
pub(crate) fn coordinate_loss(
    output: Tensor<4>,
    target: Tensor<4>,
    mask: Tensor<4>,
) -> (Tensor<1>, Tensor<1>) {
    let [batch, _, height, width] = output.dims();
    // Sum over the three coordinates: `batch x 1 x side x side`.
    let error = (output - target).abs().sum_dim(1);
    let on_object = (error.clone() * mask.clone()).sum();
    let outside = error.sum() - on_object.clone();
    let pixels = (batch * height * width) as f64;
    let mean = on_object.clone() / (mask.sum() * 3.0 + 1e-6);
    ((on_object * OBJECT_WEIGHT + outside) / pixels, mean)
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};

    fn number(t: Tensor<1>) -> f32 {
        t.into_data().try_to_vec::<f32>().unwrap()[0]
    }

    #[test]
    fn equation_6_2_by_hand() {
        let device = Device::flex();
        let rows = |v: Vec<f32>| Tensor::<2>::from_data(TensorData::new(v, [3, 2]), &device);
        let a = rows(vec![0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let b = rows(vec![3.0, 4.0, 0.0, 6.0, 20.0, 0.0]);
        // Positive at distance 5: 25. Negative at 6: 16. Negative at 20: 0.
        let (loss, near, far) = metric_loss(&a, &b, 1);
        assert!((number(loss) - 41.0 / 3.0).abs() < 1e-4);
        assert!((number(near) - 5.0).abs() < 1e-4 && (number(far) - 13.0).abs() < 1e-4);
    }

    #[test]
    fn cross_pairs_count_where_families_differ() {
        let device = Device::flex();
        let rows = |v: Vec<f32>| Tensor::<2>::from_data(TensorData::new(v, [2, 2]), &device);
        let a = rows(vec![0.0, 0.0, 3.0, 0.0]);
        let b = rows(vec![0.0, 0.0, 3.0, 4.0]);
        // Of the four distances 0, 5, 3, 4 the second and the third count: (10 - 5)^2 and (10 - 3)^2.
        let loss = number(cross_loss(&a, &b, rows(vec![0.0, 1.0, 1.0, 0.0])));
        assert!((loss - 37.0).abs() < 1e-2, "{loss}");
    }

    #[test]
    fn equation_6_3_by_hand() {
        let device = Device::flex();
        let image = |v: Vec<f32>, c: usize| Tensor::<4>::from_data(TensorData::new(v, [1, c, 1, 2]), &device);
        // Errors of 0.1, 0.2, 0.3 on the object's pixel, and one of 1.0 outside it.
        let output = image(vec![0.1, 1.0, 0.2, 0.0, 0.3, 0.0], 3);
        let target = image(vec![0.0; 6], 3);
        let (loss, error) = coordinate_loss(output, target, image(vec![1.0, 0.0], 1));
        assert!((number(loss) - (3.0 * 0.6 + 1.0) / 2.0).abs() < 1e-5);
        assert!((number(error) - 0.2).abs() < 1e-5);
    }
}
