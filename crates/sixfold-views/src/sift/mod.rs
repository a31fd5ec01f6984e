//! SIFT keypoints (Lowe 2004, "Distinctive Image Features from Scale-Invariant Keypoints"): blobs of an image with position, size,
//! orientation and a descriptor that none of these changes. They recognise what is printed on an object, at any size and rotation.

mod descriptor;
mod extrema;
mod pyramid;

use rayon::prelude::*;
use sixfold_geometry::{RgbImage, Vec2};

use descriptor::{descriptor, orientations};
use extrema::extrema;
use pyramid::{Plane, octaves};

pub(crate) use descriptor::LENGTH;

/// A larger image is not doubled before keypoints are searched.
const DOUBLED: usize = 1 << 20;

/// A keypoint.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Keypoint {
    /// Position, pixels.
    pub position: Vec2,
    /// Blur at which it is most distinct, pixels.
    pub size: f64,
    /// Direction of its gradients, radians; from x towards y.
    pub orientation: f64,
    /// Difference of Gaussians.
    pub contrast: f32,
    /// Of length 1.
    pub descriptor: Box<[f32; LENGTH]>,
}

/// The keypoints of an image with the highest contrasts, at most `most`, by decreasing contrast.
pub(crate) fn keypoints(image: &RgbImage, most: usize) -> Vec<Keypoint> {
    let (width, height) = image.size();
    if width.min(height) < 2 {
        return vec![];
    }
    let grey =
        |p: &[u8; 3]| (0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2])) / 255.0;
    let plane = Plane { width, height, data: image.as_slice().par_iter().map(grey).collect() };
    let octaves = octaves(plane, width * height <= DOUBLED);
    let mut found: Vec<(usize, extrema::Extremum)> = octaves
        .iter()
        .enumerate()
        .flat_map(|(i, octave)| extrema(octave).into_iter().map(move |e| (i, e)))
        .collect();
    // A stable sort: ties keep the order of the pixels.
    found.sort_by(|a, b| b.1.contrast.total_cmp(&a.1.contrast));
    found.truncate(most);
    let described = |(i, at): &(usize, extrema::Extremum)| -> Vec<Keypoint> {
        let octave = &octaves[*i];
        let level = &octave.levels[at.level];
        let keypoint = |orientation: f32| Keypoint {
            position: Vec2::new(f64::from(at.x * octave.scale), f64::from(at.y * octave.scale)),
            size: f64::from(at.sigma * octave.scale),
            orientation: f64::from(orientation),
            contrast: at.contrast,
            descriptor: Box::new(descriptor(level, at, orientation)),
        };
        orientations(level, at).into_iter().map(keypoint).collect()
    };
    found.par_iter().flat_map_iter(described).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::{FRAC_PI_2, TAU};

    /// A smooth random texture.
    fn texture(width: usize, height: usize) -> RgbImage {
        RgbImage::from_fn(width, height, |x, y| {
            let (x, y) = (x as f64, y as f64);
            let mut sum = 0.0;
            for k in 1..24 {
                let k = f64::from(k);
                let (fx, fy) = ((k * 1.7).sin() * 0.35, (k * 2.3).cos() * 0.35);
                sum += (fx * x + fy * y + k * k).sin();
            }
            [(128.0 + 22.0 * sum).clamp(0.0, 255.0) as u8; 3]
        })
    }

    fn product(a: &Keypoint, b: &Keypoint) -> f32 {
        a.descriptor.iter().zip(b.descriptor.iter()).map(|(a, b)| a * b).sum()
    }

    /// The keypoint of `among` whose descriptor is most similar.
    fn best<'a>(of: &Keypoint, among: &'a [Keypoint]) -> &'a Keypoint {
        among.iter().max_by(|a, b| product(of, a).total_cmp(&product(of, b))).unwrap()
    }

    #[test]
    fn keypoints_of_a_rotated_image_are_the_same_ones_rotated() {
        let image = texture(160, 120);
        // Rotated by 90 degrees: x of the rotated image is y of this one, from the other side.
        let rotated = RgbImage::from_fn(120, 160, |x, y| *image.get(y, 119 - x).unwrap());
        let (a, b) = (keypoints(&image, 60), keypoints(&rotated, 120));
        assert!(a.len() >= 40, "{}", a.len());
        let right = a.iter().filter(|k| {
            let found = best(k, &b);
            let there = Vec2::new(119.0 - k.position.y, k.position.x);
            let angle = (found.orientation - k.orientation - FRAC_PI_2).rem_euclid(TAU);
            (found.position - there).norm() < 1.0 && angle.min(TAU - angle) < 0.1
        });
        let right = right.count();
        assert!(right * 10 >= a.len() * 9, "{right} of {}", a.len());
        assert!(a.iter().all(|k| (product(k, k) - 1.0).abs() < 1e-5));
    }

    #[test]
    fn keypoints_of_a_smaller_image_have_smaller_sizes() {
        let image = texture(240, 240);
        let small = RgbImage::from_fn(120, 120, |x, y| {
            let at = |dx: usize, dy: usize| u32::from(image.get(2 * x + dx, 2 * y + dy).unwrap()[0]);
            [((at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1)) / 4) as u8; 3]
        });
        let (a, b) = (keypoints(&small, 40), keypoints(&image, 400));
        let right = a.iter().filter(|k| {
            let found = best(k, &b);
            let there = k.position * 2.0 + Vec2::repeat(0.5);
            (found.position - there).norm() < 3.0 && (found.size / k.size / 2.0).ln().abs() < 0.35
        });
        let right = right.count();
        assert!(right * 10 >= a.len() * 7, "{right} of {}", a.len());
    }

    #[test]
    fn images_without_texture_have_no_keypoints() {
        for (width, height) in [(0, 0), (1, 9), (3, 3), (40, 30)] {
            assert!(keypoints(&RgbImage::filled(width, height, [90; 3]), 10).is_empty());
        }
    }
}
