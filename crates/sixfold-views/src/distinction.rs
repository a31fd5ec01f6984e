//! Which of two poses an image shows, if it agrees with both about equally: decided by the pixels in which the object looks different at
//! them. With renders `a` and `b` and the image `i`, each normalised in brightness and contrast around every pixel, it is the logarithm of the ratio of
//! the likelihoods under Gaussian noise, `sum((i - b)^2 - (i - a)^2)`, relative to `sum((a - b)^2)`: 1 if the image is `a`, -1 if it is `b`.

use sixfold_align::outline::projected_box;
use sixfold_geometry::{Camera, Pose, Rect, RgbImage};
use sixfold_mesh::Mesh;
use sixfold_render::VisibilityBuffer;
use sixfold_synth::augment::{Coverage, Patch};

use crate::crop::Crop;
use crate::templates::render;

// All numbers chosen by hand, not swept.

/// Side of the crop, pixels.
const SIDE: usize = 256;
/// Ratio of the crop's side to that of the box around both poses.
const MARGIN: f64 = 1.1;
/// Blur of image and renders: what is finer is not aligned, pixels.
const SIGMA: f32 = 1.0;
/// Standard deviation of the window in which brightness and contrast are normalised, pixels.
const WINDOW: f32 = 8.0;
/// Contrasts below this are not amplified, of 1.
const MIN_CONTRAST: f32 = 0.04;
/// Smallest mean of the squared difference of both renders over the pixels that both show.
const LEAST_DIFFERENCE: f32 = 0.01;

/// Whether the image shows the object at the first of two poses (up to 1) or at the second (down to -1); 0 if it cannot be told.
pub(crate) fn distinction(mesh: &Mesh, image: &RgbImage, camera: &Camera, poses: [&Pose; 2]) -> f64 {
    let boxes = poses.map(|pose| projected_box(mesh, camera, pose));
    let [Some(first), Some(second)] = boxes else { return 0.0 };
    let Some(crop) = Crop::of_box(camera, &around(&first, &second), MARGIN, SIDE) else { return 0.0 };
    let mut frame = VisibilityBuffer::new(&crop.camera);
    let [(a, shown_a), (b, shown_b)] = poses.map(|pose| {
        let rendered = render(&mut frame, mesh, &crop.to_crop(pose), None);
        let shown = |x, y| f32::from(u8::from(!rendered.coordinates[(x, y)][0].is_nan()));
        (Patch::from_rgb(&rendered.image), Coverage::from_fn(SIDE, SIDE, shown))
    });
    let both = Coverage::from_fn(SIDE, SIDE, |x, y| shown_a.data[y * SIDE + x] * shown_b.data[y * SIDE + x]);
    let seen = crop.cut(image, camera, [0.5; 3]);
    let [seen, a, b] = [seen, a, b].map(|patch| normalised(patch, &both));
    let (mut towards, mut difference) = (0.0f32, 0.0f32);
    for ((i, a), b) in seen.data.iter().zip(&a.data).zip(&b.data) {
        towards += (2.0 * i - a - b) * (a - b);
        difference += (a - b) * (a - b);
    }
    let least = LEAST_DIFFERENCE * 3.0 * both.data.iter().sum::<f32>();
    if difference > least { f64::from(towards / difference).clamp(-1.0, 1.0) } else { 0.0 }
}

/// The smallest box that contains two.
fn around(a: &Rect, b: &Rect) -> Rect {
    let (x, y) = (a.x.min(b.x), a.y.min(b.y));
    let (right, bottom) = ((a.x + a.width).max(b.x + b.width), (a.y + a.height).max(b.y + b.height));
    Rect { x, y, width: right - x, height: bottom - y }
}

/// Brightness and contrast around every pixel removed; 0 where the mask is.
fn normalised(mut patch: Patch, mask: &Coverage) -> Patch {
    patch.blur(SIGMA);
    let mut weights = mask.clone();
    weights.blur(WINDOW);
    let smooth = |values: Vec<f32>| {
        let mut smooth = Coverage { width: mask.width, height: mask.height, data: values };
        smooth.blur(WINDOW);
        smooth.data
    };
    for plane in patch.planes_mut() {
        let masked = |power: i32| plane.iter().zip(&mask.data).map(|(v, m)| m * v.powi(power)).collect();
        let (means, squares) = (smooth(masked(1)), smooth(masked(2)));
        for (k, value) in plane.iter_mut().enumerate() {
            let weight = weights.data[k].max(1e-6);
            let mean = means[k] / weight;
            let contrast = (squares[k] / weight - mean * mean).max(0.0).sqrt();
            *value = mask.data[k] * (*value - mean) / contrast.max(MIN_CONTRAST);
        }
    }
    patch
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::Vec3;
    use sixfold_geometry::nalgebra::UnitQuaternion;

    use super::*;
    use crate::printed::tests::{photograph, printed_box_with};

    #[test]
    fn the_image_tells_two_poses_apart_by_what_differs() {
        // The same print on two faces, but not on the sides.
        let mesh = printed_box_with(|axis, side| axis == 0 || side < 0.0);
        let camera = Camera::new(900.0, 900.0, 319.5, 239.5, 640, 480).unwrap();
        let truth =
            Pose::exp(&[0.0, 0.0, 0.0, 0.35, 0.75, 0.3].into()).with_translation(Vec3::new(0.02, 0.01, 0.5));
        let half = UnitQuaternion::from_axis_angle(&Vec3::x_axis(), std::f64::consts::PI);
        let rotated = truth * Pose::new(half, Vec3::zeros());
        let image = photograph(&mesh, &truth, &camera);
        let between = |a: &Pose, b: &Pose| distinction(&mesh, &image, &camera, [a, b]);
        assert!(between(&truth, &rotated) > 0.5, "{}", between(&truth, &rotated));
        assert!((between(&truth, &rotated) + between(&rotated, &truth)).abs() < 1e-6);
        // Nothing differs, or nothing is in the image.
        assert_eq!(between(&truth, &truth), 0.0);
        let behind = truth.with_translation(-truth.translation());
        assert_eq!(between(&truth, &behind), 0.0);
        // An image that shows neither says little.
        let grey = RgbImage::filled(640, 480, [120; 3]);
        let nothing = distinction(&mesh, &grey, &camera, [&truth, &rotated]);
        assert!(nothing.abs() < 0.1, "{nothing}");
    }
}
