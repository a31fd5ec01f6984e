//! Masks and visibility of ground truth by rendering: what `mask`, `mask_visib` and `scene_gt_info.json` hold.
//!
//! As BOP computes them: the whole silhouette is counted also outside the image; with a depth image a pixel is visible
//! unless something is measured more than `delta` in front of it (missing depth counts as visible). Without depth, the
//! objects hide one another and nothing else does.

use sixfold_geometry::{Camera, DepthImage, Image, Mask, Pose, Rect};
use sixfold_mesh::Mesh;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

use crate::scene_files::GroundTruthInfo;

/// Tolerance of the visibility test in metres: a surface counts as visible up to this far behind the measured depth. 15 mm,
/// the delta of BOP's VSD (Hodan et al., "BOP: Benchmark for 6D Object Pose Estimation", ECCV 2018) and of its `mask_visib`
/// (`scripts/calc_gt_masks.py` of the BOP toolkit).
pub const VISIBILITY_DELTA: f64 = 0.015;

/// How far outside the image a silhouette is followed, in image sizes to each side.
const MARGIN: usize = 1;

/// Masks and visibility of one object in one image.
#[derive(Debug, Clone, PartialEq)]
pub struct ObjectVisibility {
    /// Its silhouette inside the image, hidden parts included.
    pub mask: Mask,
    /// The visible part.
    pub mask_visible: Mask,
    /// Counts, boxes and the visible fraction.
    pub info: GroundTruthInfo,
}

/// Renders every object and computes which part of it is visible.
///
/// `test_depth` is the sensor's depth image in metres, of the camera's size; `delta` the tolerance of the visibility
/// test in metres ([`VISIBILITY_DELTA`] in BOP). A depth image of another size is ignored, so check the size first.
pub fn ground_truth_visibility(
    objects: &[(&Mesh, Pose)],
    camera: &Camera,
    test_depth: Option<&DepthImage>,
    delta: f64,
) -> Vec<ObjectVisibility> {
    let (width, height) = (camera.width, camera.height);
    let test_depth = test_depth.filter(|d| d.size() == (width, height));
    let (left, top) = (MARGIN * width, MARGIN * height);
    let large_camera = camera.crop(&Rect {
        x: -(left as f64),
        y: -(top as f64),
        width: ((2 * MARGIN + 1) * width) as f64,
        height: ((2 * MARGIN + 1) * height) as f64,
    });
    let scene: Vec<SceneObject<'_>> =
        objects.iter().map(|&(mesh, camera_from_object)| SceneObject { mesh, camera_from_object }).collect();
    let mut frame = VisibilityBuffer::new(camera);
    let instances = test_depth.is_none().then(|| {
        frame.render(&scene, &RenderOptions::default());
        frame.instances()
    });
    let mut large = VisibilityBuffer::new(&large_camera);
    scene
        .iter()
        .enumerate()
        .map(|(number, object)| {
            large.render(std::slice::from_ref(object), &RenderOptions::default());
            let whole = large.mask(0);
            frame.render(std::slice::from_ref(object), &RenderOptions::default());
            let depth = frame.depth();
            let mask = depth.map(|z| *z > 0.0);
            let measured = |x: usize, y: usize| {
                test_depth.map(|d| d[(x, y)]).filter(|z| z.is_finite() && *z > 0.0).map(f64::from)
            };
            let visible = |x: usize, y: usize| match (&instances, measured(x, y)) {
                (Some(instances), _) => instances[(x, y)] == Some(number as u32),
                (None, None) => true,
                (None, Some(test)) => {
                    let column = (x as f64 - camera.cx) / camera.fx;
                    let row = (y as f64 - camera.cy) / camera.fy;
                    let ray = (1.0 + column * column + row * row).sqrt();
                    (f64::from(depth[(x, y)]) - test) * ray <= delta
                }
            };
            let mask_visible = Image::from_fn(width, height, |x, y| mask[(x, y)] && visible(x, y));
            let count = |m: &Mask| m.as_slice().iter().filter(|p| **p).count() as u64;
            let (all, seen) = (count(&whole), count(&mask_visible));
            let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
            let valid = pixels.filter(|&(x, y)| mask[(x, y)] && measured(x, y).is_some()).count() as u64;
            let info = GroundTruthInfo {
                // BOP writes no box for what cannot be seen at all.
                bbox_obj: bounding_box(&whole, left, top).filter(|_| seen > 0),
                bbox_visib: bounding_box(&mask_visible, 0, 0),
                px_count_all: Some(all),
                px_count_valid: test_depth.map(|_| valid),
                px_count_visib: Some(seen),
                visib_fract: if all > 0 { seen as f64 / all as f64 } else { 0.0 },
            };
            ObjectVisibility { mask, mask_visible, info }
        })
        .collect()
}

impl GroundTruthInfo {
    /// The entry of an object whose silhouette lies within the image, with depth at every pixel.
    pub fn of_masks(whole: &Mask, visible: &Mask) -> Self {
        let count = |mask: &Mask| mask.as_slice().iter().filter(|v| **v).count() as u64;
        let (all, seen) = (count(whole), count(visible));
        GroundTruthInfo {
            bbox_obj: bounding_box(whole, 0, 0),
            bbox_visib: bounding_box(visible, 0, 0),
            px_count_all: Some(all),
            px_count_valid: Some(all),
            px_count_visib: Some(seen),
            visib_fract: if all > 0 { (seen as f64 / all as f64).min(1.0) } else { 0.0 },
        }
    }
}

/// First pixel, and last minus first pixel, as BOP writes boxes into `scene_gt_info.json`.
pub(crate) fn bounding_box(mask: &Mask, left: usize, top: usize) -> Option<Rect> {
    let (mut low, mut high) = ([usize::MAX; 2], [0; 2]);
    for y in 0..mask.height() {
        for (x, _) in mask.row(y).iter().enumerate().filter(|(_, p)| **p) {
            low = [low[0].min(x), low[1].min(y)];
            high = [high[0].max(x), high[1].max(y)];
        }
    }
    (low[0] != usize::MAX).then(|| Rect {
        x: low[0] as f64 - left as f64,
        y: low[1] as f64 - top as f64,
        width: (high[0] - low[0]) as f64,
        height: (high[1] - low[1]) as f64,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::Vec3;

    /// A square of 0.2 m about the origin, facing the camera.
    fn square() -> Mesh {
        let corner = |x: f64, y: f64| Vec3::new(x, y, 0.0);
        let corners = vec![corner(-0.1, -0.1), corner(0.1, -0.1), corner(0.1, 0.1), corner(-0.1, 0.1)];
        Mesh::new(corners, vec![[0, 1, 2], [0, 2, 3]]).unwrap()
    }

    fn camera() -> Camera {
        // Pixel centres at half-integer offsets from the axis: 0.2 m at 1 m cover exactly 20 x 20 pixels.
        Camera::new(100.0, 100.0, 49.5, 39.5, 100, 80).unwrap()
    }

    fn at(x: f64, z: f64) -> Pose {
        Pose::from_translation(Vec3::new(x, 0.0, z))
    }

    #[test]
    fn a_free_square_is_fully_visible() {
        let mesh = square();
        let found = &ground_truth_visibility(&[(&mesh, at(0.0, 1.0))], &camera(), None, VISIBILITY_DELTA)[0];
        assert_eq!((found.info.px_count_all, found.info.px_count_visib), (Some(400), Some(400)));
        assert_eq!(found.info.visib_fract, 1.0);
        let expected = Rect { x: 40.0, y: 30.0, width: 19.0, height: 19.0 };
        assert_eq!((found.info.bbox_obj, found.info.bbox_visib), (Some(expected), Some(expected)));
        assert_eq!(found.mask, found.mask_visible);
    }

    #[test]
    fn half_outside_the_image_is_half_visible() {
        let mesh = square();
        let found = &ground_truth_visibility(&[(&mesh, at(0.5, 1.0))], &camera(), None, VISIBILITY_DELTA)[0];
        assert_eq!(found.info.px_count_all, Some(400));
        assert_eq!(found.info.visib_fract, 0.5);
        assert_eq!(found.info.bbox_obj.unwrap(), Rect { x: 90.0, y: 30.0, width: 19.0, height: 19.0 });
        assert_eq!(found.info.bbox_visib.unwrap(), Rect { x: 90.0, y: 30.0, width: 9.0, height: 19.0 });
    }

    #[test]
    fn objects_hide_one_another_without_depth_and_the_sensor_decides_with_it() {
        let mesh = square();
        let near =
            Mesh::new(square().vertices().iter().map(|v| v * 0.5).collect(), square().faces().to_vec());
        // The small square at half the distance covers the right half: shifted by 0.05 m at 0.5 m.
        let objects = [(&mesh, at(0.0, 1.0)), (&near.unwrap(), at(0.05, 0.5))];
        let found = ground_truth_visibility(&objects, &camera(), None, VISIBILITY_DELTA);
        assert_eq!(found[0].info.visib_fract, 0.5);
        assert_eq!(found[1].info.visib_fract, 1.0);

        // The measured depth is 20 mm in front of the object in the upper rows, 10 mm in front in the lower rows, and
        // missing in one row.
        let depth = Image::from_fn(100, 80, |_, y| {
            if y < 35 {
                0.98
            } else if y == 49 {
                0.0
            } else {
                0.99f32
            }
        });
        let found = &ground_truth_visibility(&objects[..1], &camera(), Some(&depth), VISIBILITY_DELTA)[0];
        assert_eq!(found.info.px_count_visib, Some(300));
        assert_eq!(found.info.px_count_valid, Some(380));
        assert_eq!(found.info.bbox_visib.unwrap(), Rect { x: 40.0, y: 35.0, width: 19.0, height: 14.0 });
    }

    #[test]
    fn points_behind_the_camera_have_no_box() {
        let mesh = square();
        let found = &ground_truth_visibility(&[(&mesh, at(0.0, -1.0))], &camera(), None, VISIBILITY_DELTA)[0];
        assert_eq!((found.info.bbox_obj, found.info.visib_fract), (None, 0.0));
    }

    #[test]
    fn boxes_are_as_bop_writes_them() {
        let mask = Mask::from_fn(10, 8, |x, y| (2..5).contains(&x) && (3..4).contains(&y));
        let found = bounding_box(&mask, 0, 0).unwrap();
        assert_eq!([found.x, found.y, found.width, found.height], [2.0, 3.0, 2.0, 0.0]);
        assert!(bounding_box(&Mask::filled(3, 3, false), 0, 0).is_none());
    }
}
