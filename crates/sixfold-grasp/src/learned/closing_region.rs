//! Input of GPD's network for a candidate (Ten Pas et al. 2017, section 5): the closing region of the hand, projected along each of
//! its three axes; for each the mean height of the points, their mean normal, and the mean height of the unobserved volume.
//!
//! Three differences from the paper: 32x32 pixels instead of 60x60, a region of the size of this gripper's, and points of the
//! object alone.

use sixfold_geometry::{Pose, Vec2, Vec3};

use crate::{Grasp, GraspView, Gripper};

/// Pixels along each side.
pub const SIDE: usize = 32;
/// For each axis: height, three channels of the normal, height of the unobserved volume.
pub const CHANNELS: usize = 15;
/// Channels of one axis.
const OF_AXIS: usize = CHANNELS / 3;
/// Voxels along each side that are tested for visibility.
const VOXELS: usize = 16;
/// The region extends this far beyond the tips, metres.
const BEFORE_TIPS: f64 = 0.01;
/// Voxels more than this behind a measured surface are unobserved, metres.
const BEHIND: f64 = 0.01;

/// Coordinates of the images of each axis: the axis itself, the one that points right, the one that points down.
const AXES: [[usize; 3]; 3] = [[2, 0, 1], [1, 0, 2], [0, 1, 2]];

/// Images of the region between the pads: 15 channels of 32x32 pixels, one after the other, row by row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ClosingRegion {
    pixels: Vec<u8>,
}

impl ClosingRegion {
    /// The images of a grasp on the object of a view.
    pub fn new(view: &GraspView, gripper: &Gripper, grasp: &Grasp) -> ClosingRegion {
        let region = Extent::of(gripper, grasp.opening);
        let gripper_from_camera = grasp.camera_from_gripper.inverse();
        let mut sums = vec![0.0f32; (CHANNELS + 2 * 3) * SIDE * SIDE];
        let (values, counts) = sums.split_at_mut(CHANNELS * SIDE * SIDE);
        let cloud = &view.object;
        for (i, p) in cloud.points.iter().enumerate() {
            let Some(at) = region.normalised(&gripper_from_camera.transform_point(p)) else { continue };
            let normal = cloud.normals.get(i).map(|n| gripper_from_camera.transform_direction(n).abs());
            let normal = normal.unwrap_or_else(Vec3::zeros);
            for (k, axes) in AXES.iter().enumerate() {
                let half = |axis: usize| 0.5 * view.step / region.size[axis];
                let [columns, rows] = [axes[1], axes[2]].map(|a| pixels_around(at[a], half(a)));
                for (x, y) in rows.flat_map(|y| columns.clone().map(move |x| (x, y))) {
                    let pixel = y * SIDE + x;
                    counts[2 * k * SIDE * SIDE + pixel] += 1.0;
                    let value = [at[axes[0]], normal.x, normal.y, normal.z];
                    for (c, v) in value.into_iter().enumerate() {
                        values[(OF_AXIS * k + c) * SIDE * SIDE + pixel] += v as f32;
                    }
                }
            }
        }
        add_unobserved(view, &region, &grasp.camera_from_gripper, values, counts);
        ClosingRegion { pixels: bytes(values, counts) }
    }

    /// The images, 0 where there is nothing, up to 255.
    pub fn pixels(&self) -> &[u8] {
        &self.pixels
    }

    /// The images of the scene mirrored along the closing direction, across it, or both: these grasps are equally good.
    pub fn mirrored(&self, closing: bool, across: bool) -> ClosingRegion {
        let flip = [closing, across, false];
        let mut pixels = vec![0; self.pixels.len()];
        for channel in 0..CHANNELS {
            let [axis, column, row] = AXES[channel / OF_AXIS];
            let is_height = matches!(channel % OF_AXIS, 0 | 4);
            for (x, y) in (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (x, y))) {
                let from_x = if flip[column] { SIDE - 1 - x } else { x };
                let from_y = if flip[row] { SIDE - 1 - y } else { y };
                let value = self.pixels[(channel * SIDE + from_y) * SIDE + from_x];
                let flipped = is_height && flip[axis] && value > 0;
                pixels[(channel * SIDE + y) * SIDE + x] =
                    if flipped { (256 - u16::from(value)) as u8 } else { value };
            }
        }
        ClosingRegion { pixels }
    }
}

/// The bounding box of the closing region, in the gripper's frame.
struct Extent {
    low: Vec3,
    size: Vec3,
    /// Position of the pads along x.
    half_opening: f64,
}

impl Extent {
    fn of(gripper: &Gripper, opening: f64) -> Extent {
        let (half, width) = (0.5 * gripper.max_opening, gripper.finger_width);
        Extent {
            low: Vec3::new(-half, -width, -gripper.finger_length),
            size: Vec3::new(2.0 * half, 2.0 * width, gripper.finger_length + BEFORE_TIPS),
            half_opening: 0.5 * opening,
        }
    }

    /// A point of the gripper's frame scaled to 0 to 1 along each axis, the last from the tips to the palm; `None` outside.
    fn normalised(&self, p: &Vec3) -> Option<Vec3> {
        let q = (p - self.low).component_div(&self.size);
        let inside = (0..3).all(|k| (0.0..1.0).contains(&q[k])) && p.x.abs() < self.half_opening;
        inside.then(|| Vec3::new(q.x, q.y, 1.0 - q.z))
    }

    /// The centre of a voxel, in the gripper's frame.
    fn voxel(&self, index: [usize; 3]) -> Vec3 {
        let fraction = Vec3::from_fn(|k, _| (index[k] as f64 + 0.5) / VOXELS as f64);
        self.low + self.size.component_mul(&fraction)
    }
}

/// Pixels that a point covers: as wide as the cloud's spacing, at least its own pixel.
fn pixels_around(at: f64, half: f64) -> std::ops::RangeInclusive<usize> {
    let side = SIDE as f64;
    let own = (at * side) as usize;
    let first = ((at - half) * side - 0.5).ceil().max(0.0) as usize;
    let last = ((at + half) * side - 0.5).floor().clamp(0.0, side - 1.0) as usize;
    first.min(own)..=last.max(own).min(SIDE - 1)
}

/// Adds the heights of voxels behind a measured surface.
fn add_unobserved(
    view: &GraspView,
    region: &Extent,
    camera_from_gripper: &Pose,
    values: &mut [f32],
    counts: &mut [f32],
) {
    let (width, height) = view.depth.size();
    let unobserved = |p: &Vec3| {
        let pixel: Option<Vec2> = view.camera.project(p);
        pixel.is_some_and(|pixel| {
            let (u, v) = (pixel.x.round(), pixel.y.round());
            let inside = u >= 0.0 && v >= 0.0 && u < width as f64 && v < height as f64;
            let depth = if inside { f64::from(view.depth[(u as usize, v as usize)]) } else { 0.0 };
            depth > 0.0 && p.z > depth + BEHIND
        })
    };
    const OF: usize = SIDE / VOXELS;
    for number in 0..VOXELS.pow(3) {
        let index = [number % VOXELS, number / VOXELS % VOXELS, number / VOXELS / VOXELS];
        let centre = region.voxel(index);
        let Some(at) = region.normalised(&centre) else { continue };
        if !unobserved(&camera_from_gripper.transform_point(&centre)) {
            continue;
        }
        for (k, axes) in AXES.iter().enumerate() {
            let [column, row] = [axes[1], axes[2]].map(|a| (at[a] * VOXELS as f64) as usize * OF);
            for (x, y) in (row..row + OF).flat_map(|y| (column..column + OF).map(move |x| (x, y))) {
                let pixel = y * SIDE + x;
                counts[(2 * k + 1) * SIDE * SIDE + pixel] += 1.0;
                values[(OF_AXIS * k + 4) * SIDE * SIDE + pixel] += at[axes[0]] as f32;
            }
        }
    }
}

/// Means as bytes: heights start at 1, because 0 means empty.
fn bytes(values: &[f32], counts: &[f32]) -> Vec<u8> {
    let area = SIDE * SIDE;
    let byte = |i: usize| {
        let (channel, pixel) = (i / area, i % area);
        let (axis, kind) = (channel / OF_AXIS, channel % OF_AXIS);
        let count = counts[(2 * axis + usize::from(kind == 4)) * area + pixel];
        if count == 0.0 {
            return 0;
        }
        let mean = (values[i] / count).clamp(0.0, 1.0);
        match kind {
            0 | 4 => 1 + (254.0 * mean).round() as u8,
            _ => (255.0 * mean).round() as u8,
        }
    };
    (0..values.len()).map(byte).collect()
}

#[cfg(test)]
mod tests {
    use sixfold_geometry::{DepthImage, PointCloud};

    use super::*;
    use crate::{AntipodalQuality, gripper_pose};

    /// A wall at x = 1 cm in the frame of a hand that approaches from above, from its tips to halfway to the palm, and its images.
    fn images(x: f64) -> (ClosingRegion, Gripper) {
        let gripper = Gripper::built_in("jaws-85").unwrap();
        let mut object = PointCloud::default();
        for i in -7..=7 {
            for k in 0..=7 {
                object.points.push(Vec3::new(x, 0.003 * f64::from(i), 0.5 - 0.003 * f64::from(k)));
                object.normals.push(Vec3::x());
            }
        }
        let mut view = GraspView::from_above(object, 0.6, 0.003);
        // Measured 2 cm behind the tips, towards the palm, in the left half of the image only.
        view.depth = DepthImage::from_fn(64, 64, |u, _| if u < 32 { 0.48 } else { 0.0 });
        let pose = gripper_pose(&Vec3::new(0.0, 0.0, 0.5), &Vec3::z(), &Vec3::x()).unwrap();
        let quality = AntipodalQuality { alignment: 0.0, support: 0.0, centring: 0.5, observed: 1.0 };
        let grasp = Grasp { camera_from_gripper: pose, opening: 0.085, width: 0.01, quality };
        (ClosingRegion::new(&view, &gripper, &grasp), gripper)
    }

    #[test]
    fn the_images_along_each_axis_contain_the_points() {
        let (region, gripper) = images(0.01);
        let at = |channel: usize, x: usize, y: usize| region.pixels()[(channel * SIDE + y) * SIDE + x];
        // Along the approach: at one column, over all rows of the pads' width; normals along x.
        let column = ((0.5 + 0.01 / gripper.max_opening) * SIDE as f64) as usize;
        assert!(at(0, column, 16) > 0 && at(0, SIDE - 1 - column, 16) == 0);
        assert_eq!((at(1, column, 16), at(2, column, 16), at(3, column, 16)), (255, 0, 0));
        // Across the fingers: the lower rows are towards the palm, where nothing is beyond the wall.
        let tips = (BEFORE_TIPS / (gripper.finger_length + BEFORE_TIPS) * SIDE as f64) as usize;
        assert!(at(5, column, tips + 2) > 0 && at(5, column, SIDE - 1) == 0);
        // Along the closing direction: as far as the column.
        let expected = 1.0 + 254.0 * (0.5 + 0.01 / gripper.max_opening);
        assert!((f64::from(at(10, 16, tips + 2)) - expected).abs() <= 1.0);
        // Voxels behind the measured half are unobserved.
        assert!(at(4, 14, 16) > 0 && at(4, SIDE - 1, 16) == 0, "{} {}", at(4, 14, 16), at(4, SIDE - 1, 16));
    }

    #[test]
    fn a_mirrored_scene_has_mirrored_images() {
        let (left, right) = (images(-0.0101).0, images(0.0101).0);
        let mirrored = left.mirrored(true, false);
        let area = SIDE * SIDE;
        for channel in [0, 1, 2, 3, 5, 6, 7, 8, 10, 11, 12, 13] {
            let range = channel * area..(channel + 1) * area;
            assert_eq!(mirrored.pixels[range.clone()], right.pixels[range], "channel {channel}");
        }
        assert_ne!(left, mirrored);
        assert_eq!(mirrored.mirrored(true, false), left);
        assert_eq!(left.mirrored(true, true).mirrored(false, true), mirrored);
    }
}
