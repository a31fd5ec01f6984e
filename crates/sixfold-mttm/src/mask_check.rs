//! Checks masks against depth: a mask that is slightly too large includes the table around an object and whatever is behind its
//! edges, and templates made from it would include them too.
//!
//! Two kinds of pixels are left out: first those on the plane around the mask, from its border inwards. Then surfaces that a depth
//! edge separates from the largest one and that continue outside the mask without an edge: they belong to something else. Another
//! part of the same object (a handle, a step behind a tower) ends where the mask ends.

use std::collections::VecDeque;

use sixfold_geometry::{
    Camera, DepthImage, Mask, Plane, PlaneOptions, PointCloud, Vec2, Vec3, dominant_plane, stats::median,
};

use crate::error::TemplateError;

/// If more than this fraction of a mask would be left out, it is an error: which surface is the object's is then a guess. Chosen by
/// hand; not swept.
pub(crate) const MAX_LEFT_OUT: f64 = 1.0 / 3.0;
/// From this fraction on there is a warning. It is not zero because the lowest millimetres of an object that stands on the plane
/// are left out of correct masks too. Chosen by hand; not swept.
pub const WORTH_A_WARNING: f64 = 0.03;

/// A jump between neighbours of more than this many metres plus this fraction of the nearer depth is a depth edge, as in the
/// preparation of scenes.
const EDGE: (f64, f64) = (0.005, 0.015);
/// Width of the ring around the mask in which the plane is searched, as a fraction of the mask's longer side, and its minimum in
/// pixels; chosen by hand, not swept.
const RING: (f64, usize) = (0.25, 8);
/// The plane must contain at least this fraction of the ring; chosen by hand, not swept.
const PLANE: PlaneOptions = PlaneOptions {
    threshold: 0.01,
    iterations: 200,
    min_fraction: 0.35,
    max_angle: std::f64::consts::FRAC_PI_6,
};
/// A pixel is on the plane within this multiple of the median distance of the ring's points, about three standard deviations of
/// noise.
const DEVIATIONS: f64 = 4.5;
/// Bounds of that distance, metres; chosen by hand, not swept.
const ON_PLANE: (f64, f64) = (0.0015, 0.008);

/// Thin remains within this many pixels of what was left out are left out too; chosen by hand, not swept.
const FRINGE: usize = 2;

/// A mask reduced to the object, and what was left out, as fractions of the mask's pixels with depth.
#[derive(Debug, Clone, PartialEq)]
pub struct CheckedMask {
    /// What is left of the mask.
    pub mask: Mask,
    /// On the plane around the object.
    pub on_plane: f64,
    /// Beyond a depth edge, on surfaces that continue outside the mask.
    pub beyond_edges: f64,
}

impl CheckedMask {
    /// The fraction left out.
    pub fn left_out(&self) -> f64 {
        self.on_plane + self.beyond_edges
    }
}

/// Removes the pixels of a mask that, by their depth, do not show the object. Depth in metres, without lens distortion.
///
/// # Errors
/// [`TemplateError::MaskSize`], [`TemplateError::Camera`], and [`TemplateError::MaskTooLarge`] if more than `MAX_LEFT_OUT` would be
/// left out.
pub fn check_mask(depth: &DepthImage, camera: &Camera, mask: &Mask) -> Result<CheckedMask, TemplateError> {
    camera.check_lens()?;
    camera.check_image(depth.width(), depth.height())?;
    if mask.size() != depth.size() {
        return Err(TemplateError::MaskSize {
            found_width: mask.width(),
            found_height: mask.height(),
            width: depth.width(),
            height: depth.height(),
        });
    }
    let measured = |x: usize, y: usize| depth[(x, y)] > 0.0 && depth[(x, y)].is_finite();
    let count = |mask: &Mask| {
        let pixels = (0..mask.height()).flat_map(|y| (0..mask.width()).map(move |x| (x, y)));
        pixels.filter(|&(x, y)| mask[(x, y)] && measured(x, y)).count()
    };
    let all = count(mask);
    if all == 0 {
        return Ok(CheckedMask { mask: mask.clone(), on_plane: 0.0, beyond_edges: 0.0 });
    }
    let off_plane = without_plane(depth, camera, mask);
    let connected = without_fringe(depth, mask, &without_background(depth, &off_plane));
    let fraction = |pixels: usize| pixels as f64 / all as f64;
    let (above, left) = (count(&off_plane), count(&connected));
    let checked = CheckedMask {
        mask: connected,
        on_plane: fraction(all - above),
        beyond_edges: fraction(above - left),
    };
    if checked.left_out() > MAX_LEFT_OUT {
        return Err(TemplateError::MaskTooLarge {
            on_plane: checked.on_plane,
            beyond_edges: checked.beyond_edges,
            maximum: MAX_LEFT_OUT,
        });
    }
    Ok(checked)
}

/// The four neighbours of a pixel that are in the image.
fn neighbours([x, y]: [usize; 2], (width, height): (usize, usize)) -> impl Iterator<Item = [usize; 2]> {
    let beside = [
        (x > 0).then(|| [x - 1, y]),
        (x + 1 < width).then(|| [x + 1, y]),
        (y > 0).then(|| [x, y - 1]),
        (y + 1 < height).then(|| [x, y + 1]),
    ];
    beside.into_iter().flatten()
}

/// Whether two measured depths belong to one surface.
fn joined(a: f32, b: f32) -> bool {
    let (a, b) = (f64::from(a), f64::from(b));
    a > 0.0 && b > 0.0 && (a - b).abs() <= EDGE.0 + EDGE.1 * a.min(b)
}

/// The dominant plane of the ring around the mask, and the largest distance of a point on it.
fn plane_around(depth: &DepthImage, camera: &Camera, mask: &Mask) -> Option<(Plane, f64)> {
    let [_, _, width, height] = mask.bounding_box()?;
    let side = width.max(height) as f64;
    let ring = mask.grown(((RING.0 * side) as usize).max(RING.1));
    let mut cloud = PointCloud::default();
    for y in 0..depth.height() {
        for x in 0..depth.width() {
            let z = f64::from(depth[(x, y)]);
            if ring[(x, y)] && !mask[(x, y)] && z > 0.0 && z.is_finite() {
                cloud.points.push(camera.unproject(&Vec2::new(x as f64, y as f64), z));
            }
        }
    }
    let plane = dominant_plane(&cloud, &PLANE, 0)?;
    let distance = |p: &Vec3| plane.distance(p).abs();
    let mut off: Vec<f64> = cloud.points.iter().map(distance).filter(|d| *d < PLANE.threshold).collect();
    let tolerance = DEVIATIONS * median(&mut off)?;
    Some((plane, tolerance.clamp(ON_PLANE.0, ON_PLANE.1)))
}

/// The mask without the pixels on the plane around it, from its border inwards.
fn without_plane(depth: &DepthImage, camera: &Camera, mask: &Mask) -> Mask {
    let Some((plane, tolerance)) = plane_around(depth, camera, mask) else { return mask.clone() };
    let size = depth.size();
    let on_plane = |[x, y]: [usize; 2]| {
        let z = f64::from(depth[(x, y)]);
        let point = || camera.unproject(&Vec2::new(x as f64, y as f64), z);
        z > 0.0 && z.is_finite() && plane.distance(&point()).abs() <= tolerance
    };
    let mut kept = mask.clone();
    let mut queue = VecDeque::new();
    for y in 0..size.1 {
        for x in 0..size.0 {
            let at_border = || neighbours([x, y], size).any(|[u, v]| !mask[(u, v)]);
            if mask[(x, y)] && at_border() && on_plane([x, y]) {
                kept[(x, y)] = false;
                queue.push_back([x, y]);
            }
        }
    }
    while let Some(pixel) = queue.pop_front() {
        for [x, y] in neighbours(pixel, size) {
            if kept[(x, y)] && on_plane([x, y]) {
                kept[(x, y)] = false;
                queue.push_back([x, y]);
            }
        }
    }
    kept
}

/// A connected part of a mask.
#[derive(Default)]
struct Part {
    pixels: Vec<[usize; 2]>,
    /// Neighbours with depth outside the mask, and on the plane.
    outside: usize,
    /// Those of them on the same surface.
    going_on: usize,
}

/// The mask without surfaces that continue outside it, except for the largest one.
fn without_background(depth: &DepthImage, kept: &Mask) -> Mask {
    let size = depth.size();
    let mut left = kept.clone();
    let mut parts: Vec<Part> = vec![];
    for y in 0..size.1 {
        for x in 0..size.0 {
            if left[(x, y)] && depth[(x, y)] > 0.0 {
                parts.push(part_from([x, y], depth, kept, &mut left));
            }
        }
    }
    let largest = parts.iter().map(|p| p.pixels.len()).max().unwrap_or(0);
    let mut result = kept.clone();
    for part in parts.iter().filter(|p| p.pixels.len() < largest && 2 * p.going_on > p.outside) {
        part.pixels.iter().for_each(|&[x, y]| result[(x, y)] = false);
    }
    result
}

/// `kept`, a part of `mask`, without parts that are thinner than three pixels and next to what was left out: noise and pixels
/// between two surfaces.
fn without_fringe(depth: &DepthImage, mask: &Mask, kept: &Mask) -> Mask {
    let (width, height) = mask.size();
    let outer = Mask::from_fn(width, height, |x, y| !kept[(x, y)] || depth[(x, y)] <= 0.0);
    let inner = outer.grown(1).map(|outside| !outside);
    let opened = inner.grown(1);
    let left_out = Mask::from_fn(width, height, |x, y| mask[(x, y)] && !kept[(x, y)]);
    let beside = left_out.grown(FRINGE);
    Mask::from_fn(width, height, |x, y| kept[(x, y)] && (opened[(x, y)] || !beside[(x, y)]))
}

/// The surface that contains a pixel within `left`; its pixels are removed from `left`.
fn part_from(start: [usize; 2], depth: &DepthImage, kept: &Mask, left: &mut Mask) -> Part {
    let mut part = Part::default();
    let mut queue = VecDeque::from([start]);
    left[(start[0], start[1])] = false;
    while let Some(pixel) = queue.pop_front() {
        let z = depth[(pixel[0], pixel[1])];
        for [x, y] in neighbours(pixel, depth.size()) {
            let same = joined(z, depth[(x, y)]);
            if !kept[(x, y)] && depth[(x, y)] > 0.0 {
                part.outside += 1;
                part.going_on += usize::from(same);
            }
            if left[(x, y)] && same {
                left[(x, y)] = false;
                queue.push_back([x, y]);
            }
        }
        part.pixels.push(pixel);
    }
    part
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (160, 120);

    fn camera() -> Camera {
        Camera::new(150.0, 150.0, 79.5, 59.5, SIZE.0, SIZE.1).unwrap()
    }

    /// A box's front at 0.8 m, its bottom edge touching a tilted floor, in front of that floor and a bumpy background.
    fn scene(bumpy: bool) -> (DepthImage, Mask) {
        let object = |x: usize, y: usize| (60..100).contains(&x) && (40..80).contains(&y);
        let depth = DepthImage::from_fn(SIZE.0, SIZE.1, |x, y| {
            let ray = camera().unproject(&Vec2::new(x as f64, y as f64), 1.0);
            let wave = 0.1 * ((x as f64 / 15.0).sin() * (y as f64 / 15.0).cos());
            match (object(x, y), bumpy) {
                (true, _) => 0.8,
                (false, true) => (1.3 + wave) as f32,
                // The floor through the box's bottom edge (y = 0.11 m at z = 0.8), seen at 45 degrees.
                (false, false) => (0.911 / (1.0 + ray.y)) as f32,
            }
        });
        (depth, Mask::from_fn(SIZE.0, SIZE.1, object))
    }

    fn pixels(mask: &Mask) -> usize {
        mask.as_slice().iter().filter(|m| **m).count()
    }

    #[test]
    fn a_right_mask_stays() {
        for bumpy in [false, true] {
            let (depth, mask) = scene(bumpy);
            let checked = check_mask(&depth, &camera(), &mask).unwrap();
            assert!(checked.left_out() < WORTH_A_WARNING, "{bumpy} {}", checked.left_out());
        }
    }

    #[test]
    fn surroundings_in_a_large_mask_are_left_out() {
        for bumpy in [false, true] {
            let (depth, mask) = scene(bumpy);
            let large = mask.grown(3);
            let checked = check_mask(&depth, &camera(), &large).unwrap();
            assert!(pixels(&checked.mask).abs_diff(pixels(&mask)) < pixels(&mask) / 30, "{bumpy}");
            let added = 1.0 - pixels(&mask) as f64 / pixels(&large) as f64;
            assert!((checked.left_out() - added).abs() < 0.03, "{bumpy} {} {added}", checked.left_out());
            assert_eq!(bumpy, checked.beyond_edges > checked.on_plane);
        }
    }

    #[test]
    fn another_part_of_the_object_stays() {
        // A second surface 20 cm behind the first that ends with the mask.
        let (mut depth, mut mask) = scene(true);
        for y in 50..70 {
            for x in 100..115 {
                (depth[(x, y)], mask[(x, y)]) = (1.0, true);
            }
        }
        let checked = check_mask(&depth, &camera(), &mask).unwrap();
        assert_eq!(checked.mask, mask);
    }

    #[test]
    fn a_mask_of_much_else_is_refused() {
        let (depth, mask) = scene(false);
        let error = check_mask(&depth, &camera(), &mask.grown(15)).unwrap_err();
        assert!(matches!(error, TemplateError::MaskTooLarge { on_plane, .. } if on_plane > 0.4), "{error}");
        let none = Mask::filled(SIZE.0, SIZE.1, false);
        assert_eq!(check_mask(&depth, &camera(), &none).unwrap().left_out(), 0.0);
        let small = Mask::filled(8, 8, true);
        assert!(matches!(check_mask(&depth, &camera(), &small), Err(TemplateError::MaskSize { .. })));
    }
}
