//! Which pixels of the scene belong to an object, given the template aligned with it.

use sixfold_align::DepthRegion;
use sixfold_geometry::{Mask, Pose, Vec2, Vec3};

use crate::template::{SIDE, Template};

/// Pixels of an image (numbers `y * width + x`), ascending.
pub type Pixels = Vec<u32>;

/// Half the side of the cube around a template's reference point in which its mask is searched, as a multiple of the patch's side:
/// a little more than half its diagonal. Chosen by hand; not swept.
const REACH: f64 = 0.75;

/// The pixels whose depth agrees with the template within `tolerance` metres, every `stride`-th of every `stride`-th row.
pub(crate) fn template_mask(
    scene: &DepthRegion,
    template: &Template,
    size: f64,
    camera_from_view: &Pose,
    tolerance: f64,
    stride: usize,
) -> Pixels {
    let camera = scene.camera();
    let patch = template.camera(size);
    let view_from_camera = camera_from_view.inverse();
    let reach = REACH * size;
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for k in 0..8 {
        let corner = Vec3::from_fn(|i, _| if k >> i & 1 == 0 { -reach } else { reach });
        let Some(p) = camera.project(&camera_from_view.transform_point(&corner)) else { continue };
        (low, high) = ([low[0].min(p.x), low[1].min(p.y)], [high[0].max(p.x), high[1].max(p.y)]);
    }
    let first = |v: f64| (v.floor().max(0.0) as usize).next_multiple_of(stride);
    let last = |v: f64, size: usize| (v.ceil().max(0.0) as usize).min(size);
    let mut pixels = vec![];
    for y in (first(low[1])..last(high[1], camera.height)).step_by(stride) {
        for x in (first(low[0])..last(high[0], camera.width)).step_by(stride) {
            let z = f64::from(scene.depth()[(x, y)]);
            if z <= 0.0 {
                continue;
            }
            let p = view_from_camera.transform_point(&camera.unproject(&Vec2::new(x as f64, y as f64), z));
            let Some(pixel) = patch.project(&(p + Vec3::z() * template.distance)) else { continue };
            let (u, v) = (pixel.x.round(), pixel.y.round());
            if u < 0.0 || v < 0.0 || u >= SIDE as f64 || v >= SIDE as f64 {
                continue;
            }
            if template
                .relative_depth(u as usize, v as usize)
                .is_some_and(|expected| (p.z - expected).abs() < tolerance)
            {
                pixels.push((y * camera.width + x) as u32);
            }
        }
    }
    pixels
}

/// Number of pixels that two sets have in common.
pub fn common(a: &[u32], b: &[u32]) -> usize {
    let (mut i, mut j, mut count) = (0, 0, 0);
    while i < a.len() && j < b.len() {
        match a[i].cmp(&b[j]) {
            std::cmp::Ordering::Less => i += 1,
            std::cmp::Ordering::Greater => j += 1,
            std::cmp::Ordering::Equal => (i, j, count) = (i + 1, j + 1, count + 1),
        }
    }
    count
}

/// The set as an image.
pub fn to_image(pixels: &[u32], width: usize, height: usize) -> Mask {
    let mut mask = Mask::filled(width, height, false);
    for &p in pixels {
        if let Some(pixel) = mask.as_mut_slice().get_mut(p as usize) {
            *pixel = true;
        }
    }
    mask
}
