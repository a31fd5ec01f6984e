//! Selection of photographs (dissertation, section 4.3.3): by the additional surface that they show, by the distance of their
//! poses, and for one new view.
//!
//! The dissertation counts vertices. Here points spread evenly over the surface are used instead: the vertices of a scan are dense
//! where its shape is complicated, independent of the visible area.

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use sixfold_data::RoughObject;
use sixfold_geometry::{Pose, Vec3};

use crate::error::NolError;
use crate::source::SourceView;

/// An image is left out if its mask covers a smaller fraction of the object's outline.
const MIN_MASK: f64 = 0.1;
/// Number of its [`POINTS`] that a further image of an object must add.
const MIN_GAIN: f64 = 15.0;
/// Points of the surface by which images are chosen.
const POINTS: usize = 3000;
/// Side of the crops in which these points are looked up, pixels.
const SIDE: usize = 96;

/// Of two images whose cameras are closer than this (metres, and radians) only one is used (section 4.3.3).
const APART: [f64; 2] = [0.3, std::f64::consts::FRAC_PI_4];

/// Keeps the images that add most of the object's surface, at most `most` of them; returns a note for each that cannot be used.
///
/// # Errors
/// [`NolError::Image`] for an image that does not show the object.
pub fn choose_images(object: &mut RoughObject, most: usize) -> Result<Vec<String>, NolError> {
    let surface = object.mesh.sample_surface(POINTS, 0);
    let (mut shown, mut notes) = (vec![], vec![]);
    for image in &object.images {
        let view = SourceView::new(&image.posed, &object.mesh, SIDE)?;
        let covered = view.visible_fraction();
        if covered < MIN_MASK {
            let name = image.posed.name().to_owned();
            let wrong = NolError::Mask { name, percent: 100.0 * covered, minimum: 100.0 * MIN_MASK };
            notes.push(format!("{wrong}; left out"));
            shown.push(vec![]);
            continue;
        }
        shown.push(shown_points(&view, &surface.points, &surface.normals));
    }
    let points = surface.points.len();
    shown.iter_mut().for_each(|s| s.resize(points, 0.0));
    let minimum = if object.images.len() > most { 0.0 } else { MIN_GAIN * 0.01 };
    let chosen = choose_by_surface(&shown, None, most, minimum);
    let mut number = 0;
    object.images.retain(|_| {
        number += 1;
        chosen.contains(&(number - 1))
    });
    if object.images.is_empty() {
        notes.push(format!("object {}: its photographs and masks show nothing of its surface", object.id));
    }
    Ok(notes)
}

/// As [`choose_images`], by the distance of the poses: `choose_by_pose` with the dissertation's values, for images without
/// occlusion.
pub fn choose_images_by_pose(object: &mut RoughObject, most: usize, seed: u64) {
    let poses: Vec<Pose> = object.images.iter().map(|i| *i.posed.camera_from_object()).collect();
    let chosen = choose_by_pose(&poses, APART, most, seed);
    let mut number = 0;
    object.images.retain(|_| {
        number += 1;
        chosen.contains(&(number - 1))
    });
}

/// How well one photograph shows every point of the surface: the cosine of the angle between normal and line of sight times the
/// fraction of its mask there; 0 where the point is not visible.
pub(crate) fn shown_points(source: &SourceView, points: &[Vec3], normals: &[Vec3]) -> Vec<f32> {
    let side = source.side();
    points
        .iter()
        .zip(normals)
        .map(|(point, normal)| {
            source.see(point, normal).map_or(0.0, |([x, y], cosine)| {
                let (x, y) = ((x.round() as usize).min(side - 1), (y.round() as usize).min(side - 1));
                cosine * source.visible.data[y * side + x]
            })
        })
        .collect()
}

/// Greedy selection of photographs by the sum over points of `tanh(1.5 s)`, where `s` is the sum of `shown` of the selected
/// photographs at a point (the author's code; the dissertation counts points not seen before). Stops after `most`, or when the best
/// photograph adds less than `min_gain` points.
///
/// `shown` has [`shown_points`] of every photograph; `only` selects the points that count, all if `None`.
pub(crate) fn choose_by_surface(
    shown: &[Vec<f32>],
    only: Option<&[bool]>,
    most: usize,
    min_gain: f64,
) -> Vec<usize> {
    let points = shown.first().map_or(0, Vec::len);
    let counts = |i: usize| only.is_none_or(|only| only[i]);
    let mut sums = vec![0.0f32; points];
    let mut chosen: Vec<usize> = vec![];
    while chosen.len() < most {
        let gain = |k: usize| -> f64 {
            let pairs = shown[k].iter().zip(&sums).enumerate();
            pairs
                .filter(|(i, (new, _))| **new > 0.0 && counts(*i))
                .map(|(_, (new, sum))| f64::from((1.5 * (sum + new)).tanh() - (1.5 * sum).tanh()))
                .sum()
        };
        let left = (0..shown.len()).filter(|k| !chosen.contains(k));
        // Ties go to the first, so that the result does not depend on the order of the computation.
        let best = left.map(|k| (k, gain(k))).fold(None, |best: Option<(usize, f64)>, next| match best {
            Some(best) if best.1 >= next.1 => Some(best),
            _ => Some(next),
        });
        let Some((k, gain)) = best else { break };
        if gain < min_gain || gain <= 0.0 {
            break;
        }
        sums.iter_mut().zip(&shown[k]).for_each(|(sum, new)| *sum += new);
        chosen.push(k);
    }
    chosen
}

/// Chooses photographs at random such that no two have poses nearer than `apart` (metres between cameras in the object's frame and
/// radians between their directions; a photograph is left out only if both are smaller). The dissertation's values are 0.3 m and 45
/// degrees.
pub(crate) fn choose_by_pose(
    camera_from_object: &[Pose],
    apart: [f64; 2],
    most: usize,
    seed: u64,
) -> Vec<usize> {
    let mut order: Vec<usize> = (0..camera_from_object.len()).collect();
    order.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
    let mut chosen: Vec<usize> = vec![];
    for k in order {
        if chosen.len() == most {
            break;
        }
        let pose = &camera_from_object[k];
        let near = |other: &usize| {
            let other = &camera_from_object[*other];
            let between = pose.inverse().translation() - other.inverse().translation();
            between.norm() < apart[0] && pose.rotation_angle_to(other) < apart[1]
        };
        if !chosen.iter().any(near) {
            chosen.push(k);
        }
    }
    chosen
}

/// Fraction of the surface (evenly spread points) that no photograph shows, 0 to 1.
pub fn unseen_fraction(shown: &[Vec<f32>]) -> f64 {
    let points = shown.first().map_or(0, Vec::len);
    if points == 0 {
        return 1.0;
    }
    let unseen = (0..points).filter(|i| shown.iter().all(|s| s[*i] <= 0.0)).count();
    unseen as f64 / points as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use sixfold_geometry::nalgebra::UnitQuaternion;

    #[test]
    fn the_photograph_that_adds_missing_surface_comes_next() {
        let shown = vec![vec![1.0, 1.0, 1.0, 0.0], vec![1.0, 1.0, 0.0, 0.0], vec![0.0, 0.0, 0.0, 0.8]];
        assert_eq!(choose_by_surface(&shown, None, 2, 0.0), vec![0, 2]);
        assert_eq!(choose_by_surface(&shown, Some(&[true, true, false, false]), 1, 0.0), vec![0]);
        assert_eq!(choose_by_surface(&shown, Some(&[false, false, false, true]), 3, 0.0), vec![2]);
        // A gain of less than half a point does not justify another photograph.
        assert_eq!(choose_by_surface(&shown, None, 3, 0.5), vec![0, 2]);
        assert_eq!(unseen_fraction(&shown), 0.0);
        assert_eq!(unseen_fraction(&shown[..2]), 0.25);
        assert_eq!(unseen_fraction(&[]), 1.0);
        assert!(choose_by_surface(&[], None, 3, 0.0).is_empty());
    }

    proptest! {
        #[test]
        fn chosen_poses_are_apart(seed in 0u64..50, count in 1usize..30) {
            let poses: Vec<Pose> = (0..count)
                .map(|k| {
                    let turn = UnitQuaternion::from_euler_angles(0.1 * k as f64, 0.7 * (k % 5) as f64, 0.0);
                    Pose::new(turn, Vec3::new(0.0, 0.0, 0.6 + 0.05 * (k % 7) as f64))
                })
                .collect();
            let chosen = choose_by_pose(&poses, [0.3, 0.8], 16, seed);
            prop_assert!(!chosen.is_empty());
            for (i, a) in chosen.iter().enumerate() {
                for b in &chosen[..i] {
                    let cameras = poses[*a].inverse().translation() - poses[*b].inverse().translation();
                    prop_assert!(cameras.norm() >= 0.3 || poses[*a].rotation_angle_to(&poses[*b]) >= 0.8);
                }
            }
        }
    }
}
