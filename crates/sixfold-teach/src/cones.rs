//! The volume of an object from masks: the intersection of the cones through them, by votes on a coarse grid. For photographs
//! without a board, which would give the volume.

use sixfold_geometry::{Camera, Image, Mask, Mat3, Pose, Vec2, Vec3};

use crate::distance::signed_distance;
use crate::grid::Grid;
use crate::view::{Volume, bilinear};

/// Voxels along the longest side. Chosen by hand; not swept.
const CELLS: usize = 48;
/// Fraction of the photographs showing a voxel that may vote that it is empty. Chosen by hand; not swept.
const DISSENT: f64 = 0.15;
/// Tolerance for errors of a mask's border and of a pose, pixels. Chosen by hand; not swept.
const MARGIN: f32 = 2.0;
/// Size of the first box relative to the size of the masks: a mask may show only a part of the object. Chosen by hand; not swept.
const FIRST: f64 = 2.0;
/// Maximum number of times that the box is made larger or smaller. Chosen by hand; not swept.
const ROUNDS: usize = 6;
/// Two rays that enclose a smaller angle do not determine an intersection, radians. Chosen by hand; not swept.
const PARALLEL: f64 = 0.05;

/// A photograph's mask with camera and pose.
#[derive(Debug, Clone, Copy)]
pub struct Cone<'a> {
    /// The camera of the mask's pixels; its lens distortion is ignored.
    pub camera: &'a Camera,
    /// Takes points of the world to the camera's frame.
    pub camera_from_world: &'a Pose,
    /// The pixels that show the object, without lens distortion.
    pub mask: &'a Mask,
    /// The pixels where something may occlude the object, without lens distortion.
    pub unknown: Option<&'a Mask>,
}

/// A cone prepared for votes.
struct Ready<'a> {
    camera: Camera,
    pose: &'a Pose,
    mask: &'a Mask,
    /// Signed distance to the border of the region that is not certainly empty, pixels.
    possible: Image<f32>,
    eye: Vec3,
    /// Towards the centre of the mask's box.
    direction: Vec3,
    /// Half the diagonal of the box, as a fraction of the distance.
    half: f64,
}

impl<'a> Ready<'a> {
    fn new(cone: &Cone<'a>) -> Option<Ready<'a>> {
        let [x, y, width, height] = cone.mask.bounding_box()?;
        let camera = cone.camera.without_distortion();
        let box_centre = Vec2::new(x as f64 + 0.5 * width as f64 - 0.5, y as f64 + 0.5 * height as f64 - 0.5);
        let world_from_camera = cone.camera_from_world.inverse();
        let direction =
            world_from_camera.transform_direction(&camera.unproject(&box_centre, 1.0)).normalize();
        let half = 0.5 * (width as f64).hypot(height as f64) / camera.fx;
        let possible = match cone.unknown {
            Some(unknown) if unknown.size() == cone.mask.size() => {
                let (w, h) = cone.mask.size();
                signed_distance(&Image::from_fn(w, h, |x, y| cone.mask[(x, y)] || unknown[(x, y)]))
            }
            _ => signed_distance(cone.mask),
        };
        let eye = world_from_camera.translation();
        Some(Ready { camera, pose: cone.camera_from_world, mask: cone.mask, possible, eye, direction, half })
    }

    /// Whether a ball is certainly empty, and whether its centre projects into the mask; `None` if it is not in the image.
    fn vote(&self, point: &Vec3, radius: f64) -> Option<(bool, bool)> {
        let p = self.pose.transform_point(point);
        let pixel = self.camera.project(&p)?;
        let (w, h) = self.mask.size();
        if !(pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x <= w as f64 - 1.0 && pixel.y <= h as f64 - 1.0) {
            return None;
        }
        let margin = (radius * self.camera.fx / p.z) as f32 + MARGIN;
        let empty = bilinear(&self.possible, pixel.x, pixel.y) > margin;
        Some((empty, self.mask[(pixel.x.round() as usize, pixel.y.round() as usize)]))
    }
}

/// The box around the intersection of the masks' cones, with a margin; `None` if the intersection is empty or all photographs are
/// from one direction. Photographs with an empty mask are ignored.
pub fn volume_of_masks(cones: &[Cone<'_>]) -> Option<Volume> {
    let ready: Vec<Ready<'_>> = cones.iter().filter_map(Ready::new).collect();
    let centre = meeting_point(&ready)?;
    let mut halves: Vec<f64> = ready.iter().map(|r| r.half * (centre - r.eye).norm()).collect();
    halves.sort_by(f64::total_cmp);
    let half = Vec3::repeat(FIRST * halves[(halves.len() * 3 / 4).min(halves.len() - 1)]);
    let mut volume = Volume { low: centre - half, high: centre + half };
    for _ in 0..ROUNDS {
        let (found, step) = left(&ready, &volume)?;
        let at_border = (0..3).any(|k| {
            found.low[k] < volume.low[k] + 1.5 * step || found.high[k] > volume.high[k] - 1.5 * step
        });
        let grown = found.grown(2.0 * step);
        if at_border {
            volume = grown.scaled(1.5);
        } else if grown.size().max() < 0.8 * volume.size().max() {
            volume = grown;
        } else {
            return Some(grown);
        }
    }
    Some(volume)
}

/// The part of a box that remains after the votes, and the size of a voxel.
fn left(ready: &[Ready<'_>], volume: &Volume) -> Option<(Volume, f64)> {
    let radius = 0.5 * 3f64.sqrt() * volume.size().max() / CELLS as f64;
    let grid = Grid::new(volume, CELLS, |point| {
        let (mut shown, mut empty, mut seen) = (0, 0, 0);
        for (is_empty, is_seen) in ready.iter().filter_map(|r| r.vote(point, radius)) {
            shown += 1;
            empty += usize::from(is_empty);
            seen += usize::from(is_seen);
        }
        let most = (DISSENT * shown as f64).floor() as usize;
        if shown < 2 || empty > most || seen == 0 { 1.0 } else { -1.0 }
    });
    let parts = grid.components();
    Some((grid.volume_of(parts.first()?), grid.step))
}

/// The point nearest to the rays through the masks' centres: least squares, reweighted by the inverse of the distances.
fn meeting_point(ready: &[Ready<'_>]) -> Option<Vec3> {
    let apart = |a: &Ready<'_>, b: &Ready<'_>| a.direction.cross(&b.direction).norm() > PARALLEL;
    if !ready.iter().any(|a| ready.iter().any(|b| apart(a, b))) {
        return None;
    }
    let mut weights = vec![1.0; ready.len()];
    let mut point = Vec3::zeros();
    for _ in 0..10 {
        let (mut left, mut right) = (Mat3::zeros(), Vec3::zeros());
        for (r, weight) in ready.iter().zip(&weights) {
            let across = (Mat3::identity() - r.direction * r.direction.transpose()) * *weight;
            left += across;
            right += across * r.eye;
        }
        point = left.lu().solve(&right)?;
        for (r, weight) in ready.iter().zip(&mut weights) {
            let towards = point - r.eye;
            *weight = 1.0 / (towards.cross(&r.direction).norm() / towards.norm() + 1e-3);
        }
    }
    // It has to be in front of the cameras.
    let before = ready.iter().filter(|r| (point - r.eye).dot(&r.direction) > 0.0).count();
    (point.iter().all(|v| v.is_finite()) && 2 * before > ready.len()).then_some(point)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::looking_at;

    const RADIUS: f64 = 0.05;

    fn camera() -> Camera {
        Camera { fx: 300.0, fy: 300.0, cx: 159.5, cy: 119.5, width: 320, height: 240, distortion: None }
    }

    /// A ball's mask.
    fn ball(centre: &Vec3, pose: &Pose) -> Mask {
        let c = pose.transform_point(centre);
        Image::from_fn(320, 240, |x, y| {
            let ray = camera().unproject(&Vec2::new(x as f64, y as f64), 1.0).normalize();
            c.cross(&ray).norm() < RADIUS
        })
    }

    fn volume(poses: &[Pose], masks: &[Mask], unknown: &[Option<Mask>]) -> Option<Volume> {
        let camera = camera();
        let cones: Vec<Cone<'_>> = poses
            .iter()
            .zip(masks)
            .zip(unknown)
            .map(|((camera_from_world, mask), unknown)| Cone {
                camera: &camera,
                camera_from_world,
                mask,
                unknown: unknown.as_ref(),
            })
            .collect();
        volume_of_masks(&cones)
    }

    #[test]
    fn the_box_holds_the_object_and_little_else_also_with_a_wrong_mask_and_hidden_parts() {
        let centre = Vec3::new(0.3, -0.2, 0.1);
        let poses: Vec<Pose> = (0..10)
            .map(|i| {
                looking_at(
                    &(centre + Vec3::new(0.02, 0.0, 0.01)),
                    36.0 * i as f64,
                    25.0 + 4.0 * i as f64,
                    0.6,
                    3.0,
                )
            })
            .collect();
        let mut masks: Vec<Mask> = poses.iter().map(|p| ball(&centre, p)).collect();
        let mut unknown: Vec<Option<Mask>> = vec![None; 10];
        // One mask is at the wrong place; another shows only the right half, with an occluder in front of the left.
        masks[3] = Image::from_fn(320, 240, |x, y| x < 30 && y < 30);
        let [x, _, width, _] = masks[6].bounding_box().unwrap();
        let hidden = x + width / 2;
        masks[6] = Image::from_fn(320, 240, |x, y| masks[6][(x, y)] && x >= hidden);
        unknown[6] = Some(Image::from_fn(320, 240, |x, _| x < hidden));
        let found = volume(&poses, &masks, &unknown).unwrap();
        let (low, high) = (centre - Vec3::repeat(RADIUS), centre + Vec3::repeat(RADIUS));
        for k in 0..3 {
            assert!(found.low[k] < low[k] && found.high[k] > high[k], "{found:?} does not hold the ball");
        }
        assert!(found.size().max() < 3.2 * RADIUS, "{found:?}");
    }

    #[test]
    fn one_direction_or_disjoint_masks_give_none() {
        let pose = looking_at(&Vec3::zeros(), 10.0, 30.0, 0.5, 0.0);
        let mask = ball(&Vec3::zeros(), &pose);
        assert!(volume(&[pose, pose], &[mask.clone(), mask.clone()], &[None, None]).is_none());
        assert!(volume(&[], &[], &[]).is_none());
        let other = looking_at(&Vec3::zeros(), 100.0, 30.0, 0.5, 0.0);
        let empty = Image::filled(320, 240, false);
        assert!(volume(&[pose, other], &[mask.clone(), empty], &[None, None]).is_none());
        let apart = Image::from_fn(320, 240, |_, y| y < 4);
        assert!(volume(&[pose, other], &[mask, apart], &[None, None]).is_none());
    }
}
