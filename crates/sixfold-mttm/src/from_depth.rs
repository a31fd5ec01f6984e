//! Templates cut out of real depth images: one masked view is enough to find an object.

use sixfold_geometry::{Camera, DepthImage, Mask, Pose, Vec2, Vec3};

use crate::error::TemplateError;
use crate::roi::ray_rotation;
use crate::store::MAX_TEMPLATES;
use crate::template::{
    ObjectTemplates, SIDE, Source, Template, TemplateOptions, central_pixel, patch_camera,
};

/// Sizes of tabletop objects, metres: other sizes indicate a wrong depth scale or mask. Chosen by hand; not swept.
const SIZES: (f64, f64) = (0.015, 0.6);
/// Fewest pixels with depth in a view; chosen by hand, not swept.
const FEWEST_PIXELS: usize = 200;
/// Points further from the median depth than this multiple of a deviation do not belong to the object, because masks bleed over
/// edges. The deviation is the [`WITHIN`] quantile of all. Chosen by hand; not swept.
const FAR_OFF: f64 = 5.0;
/// See [`FAR_OFF`].
const WITHIN: f64 = 0.8;
/// Lower bound of that deviation, metres, for flat objects that face the camera; chosen by hand, not swept.
const MIN_DEVIATION: f64 = 0.01;
/// Directions in which an extent is measured: about 15 degrees apart over the whole sphere.
const DIRECTIONS: usize = 120;
/// Quantiles of the points along a direction between which its extent is measured: half a per cent at either end may be outliers.
/// Chosen by hand; not swept.
const ENDS: (f64, f64) = (0.005, 0.995);

/// An object in a depth image.
#[derive(Debug, Clone)]
pub struct DepthView<'a> {
    /// Depth in metres, 0 where nothing was measured.
    pub depth: &'a DepthImage,
    /// Its pinhole camera.
    pub camera: &'a Camera,
    /// Pixels of the object.
    pub mask: &'a Mask,
    /// Its pose, if known.
    pub camera_from_object: Option<Pose>,
}

impl DepthView<'_> {
    /// Whether the mask shows enough depth for a template.
    pub fn shows_enough(&self) -> bool {
        !matches!(masked_points(self), Err(TemplateError::TooLittleDepth { .. }))
    }
}

impl ObjectTemplates {
    /// Cuts the templates of an object out of depth images.
    ///
    /// Without poses every template has a frame of its own: parallel to the template's camera, its origin at the centre of the
    /// visible points. Poses found with it are those of this frame.
    ///
    /// # Errors
    /// [`TemplateError`]: an option out of its range, no view, image sizes that differ, too little depth within a mask, an object
    /// too small or large, or poses for some views only.
    pub fn from_depth(
        views: &[DepthView<'_>],
        options: &TemplateOptions,
    ) -> Result<ObjectTemplates, TemplateError> {
        options.check()?;
        let first = views.first().ok_or(TemplateError::NoViews)?;
        if views.len() > MAX_TEMPLATES {
            return Err(TemplateError::TooManyViews { found: views.len(), maximum: MAX_TEMPLATES });
        }
        let posed = first.camera_from_object.is_some();
        let mut extent = 0f64;
        let mut points = vec![];
        for (number, view) in views.iter().enumerate() {
            if view.camera_from_object.is_some() != posed {
                return Err(TemplateError::MixedPoses {
                    view: number + 1,
                    found: if posed { "no" } else { "a" },
                    first: if posed { "has one" } else { "has none" },
                });
            }
            let seen = masked_points(view)?;
            extent = extent.max(largest_extent(&seen));
            points.push(seen);
        }
        if !(SIZES.0..=SIZES.1).contains(&extent) {
            return Err(TemplateError::Size { found: extent, low: SIZES.0, high: SIZES.1 });
        }
        let size = options.margin * extent;
        let templates = views.iter().zip(&points).map(|(view, seen)| cut(view, seen, size)).collect();
        let source = if posed { Source::PosedDepth } else { Source::Depth };
        Ok(ObjectTemplates { diameter: extent, size, options: *options, source, made_from: 0, templates })
    }
}

/// A masked pixel and its point in the camera frame.
type Seen = ([usize; 2], Vec3);

/// The points under the mask, without outliers in depth, because masks bleed over edges.
fn masked_points(view: &DepthView<'_>) -> Result<Vec<Seen>, TemplateError> {
    let (depth, camera, mask) = (view.depth, view.camera, view.mask);
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
    let mut seen: Vec<Seen> = vec![];
    let mut pixels = 0;
    for y in 0..depth.height() {
        for x in 0..depth.width() {
            let z = f64::from(depth[(x, y)]);
            pixels += usize::from(mask[(x, y)]);
            if mask[(x, y)] && z > 0.0 && z.is_finite() {
                seen.push(([x, y], camera.unproject(&Vec2::new(x as f64, y as f64), z)));
            }
        }
    }
    let mut depths: Vec<f64> = seen.iter().map(|s| s.1.z).collect();
    depths.sort_by(f64::total_cmp);
    if let Some(&median) = depths.get(depths.len() / 2) {
        let mut off: Vec<f64> = depths.iter().map(|z| (z - median).abs()).collect();
        off.sort_by(f64::total_cmp);
        let limit = FAR_OFF * off[(WITHIN * off.len() as f64) as usize].max(MIN_DEVIATION);
        seen.retain(|s| (s.1.z - median).abs() <= limit);
    }
    if seen.len() < FEWEST_PIXELS {
        return Err(TemplateError::TooLittleDepth { found: seen.len(), pixels, needed: FEWEST_PIXELS });
    }
    Ok(seen)
}

/// The largest distance between extreme points, metres.
fn largest_extent(seen: &[Seen]) -> f64 {
    let directions = sixfold_geometry::sphere_directions(DIRECTIONS);
    let width = |d: &Vec3| {
        let mut along: Vec<f64> = seen.iter().map(|s| d.dot(&s.1)).collect();
        along.sort_by(f64::total_cmp);
        let at = |fraction: f64| along[(fraction * (along.len() - 1) as f64) as usize];
        at(ENDS.1) - at(ENDS.0)
    };
    directions.iter().map(width).fold(0.0, f64::max)
}

fn cut(view: &DepthView<'_>, seen: &[Seen], size: f64) -> Template {
    let pixels: Vec<[usize; 2]> = seen.iter().map(|s| s.0).collect();
    let central = central_pixel(&pixels).unwrap_or_default();
    let reference = seen.iter().find(|s| s.0 == central).map_or(Vec3::z(), |s| s.1);
    let distance = reference.norm();
    let patch = patch_camera(size, distance);
    let camera_from_patch = ray_rotation(&reference);
    let mut points = vec![0f32; view.depth.width() * view.depth.height()];
    for ([x, y], p) in seen {
        points[y * view.depth.width() + x] = (camera_from_patch.inverse() * p).z as f32;
    }
    // A pixel of the patch takes the depth that its ray meets in the image.
    let depth = (0..SIDE * SIDE)
        .map(|i| {
            let ray = patch.unproject(&Vec2::new((i % SIDE) as f64, (i / SIDE) as f64), distance);
            let Some(pixel) = view.camera.project(&(camera_from_patch * ray)) else { return 0 };
            let (x, y) = (pixel.x.round(), pixel.y.round());
            if x < 0.0 || y < 0.0 || x >= view.depth.width() as f64 || y >= view.depth.height() as f64 {
                return 0;
            }
            let z = f64::from(points[y as usize * view.depth.width() + x as usize]);
            if z > 0.0 { Template::stored(z - distance) } else { 0 }
        })
        .collect();
    let view_from_camera = Pose::new(camera_from_patch.inverse(), -Vec3::z() * distance);
    let centroid = seen.iter().map(|s| s.1).sum::<Vec3>() / seen.len() as f64;
    let view_from_object = match view.camera_from_object {
        Some(pose) => view_from_camera * pose,
        None => view_from_camera * Pose::new(camera_from_patch, centroid),
    };
    Template { view_from_object, distance, depth }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        Camera::new(570.0, 570.0, 319.5, 239.5, 640, 480).unwrap()
    }

    /// A ball of 5 cm radius off the axis, and its mask.
    fn ball() -> (DepthImage, Mask, Vec3) {
        let centre = Vec3::new(0.15, -0.1, 0.8);
        let depth = DepthImage::from_fn(640, 480, |x, y| {
            let ray = camera().unproject(&Vec2::new(x as f64, y as f64), 1.0);
            let (a, b) = (ray.dot(&ray), ray.dot(&centre));
            let root = b * b - a * (centre.dot(&centre) - 0.0025);
            if root > 0.0 { ((b - root.sqrt()) / a) as f32 } else { 1.2 }
        });
        let mask = depth.map(|&z| z < 1.0);
        (depth, mask, centre)
    }

    #[test]
    fn a_view_of_a_ball_is_a_ball() {
        let (depth, mask, centre) = ball();
        let camera = camera();
        let view = DepthView { depth: &depth, camera: &camera, mask: &mask, camera_from_object: None };
        let options = TemplateOptions::default();
        let plain = ObjectTemplates::from_depth(std::slice::from_ref(&view), &options).unwrap();
        assert!((plain.diameter - 0.1).abs() < 0.006, "{}", plain.diameter);
        let posed = DepthView { camera_from_object: Some(Pose::from_translation(centre)), ..view };
        let posed = ObjectTemplates::from_depth(&[posed], &options).unwrap();
        assert_eq!((plain.source, posed.source), (Source::Depth, Source::PosedDepth));
        let t = &posed.templates[0];
        let (cloud, _) = t.cloud(posed.size);
        let object_from_view = t.view_from_object.inverse();
        for p in &cloud.points {
            let off = object_from_view.transform_point(p).norm() - 0.05;
            assert!(off.abs() < 0.002, "{off}");
        }
    }

    #[test]
    fn invalid_views_are_refused() {
        let (depth, mask, _) = ball();
        let camera = camera();
        let view = DepthView { depth: &depth, camera: &camera, mask: &mask, camera_from_object: None };
        let options = TemplateOptions::default();
        let error = |views: &[DepthView<'_>]| ObjectTemplates::from_depth(views, &options).unwrap_err();
        assert_eq!(error(&[]), TemplateError::NoViews);
        let empty = Mask::filled(640, 480, false);
        assert!(matches!(
            error(&[DepthView { mask: &empty, ..view.clone() }]),
            TemplateError::TooLittleDepth { found: 0, pixels: 0, .. }
        ));
        let small = Mask::filled(64, 48, true);
        assert!(matches!(
            error(&[DepthView { mask: &small, ..view.clone() }]),
            TemplateError::MaskSize { .. }
        ));
        let millimetres = depth.map(|&z| 1000.0 * z);
        assert!(matches!(
            error(&[DepthView { depth: &millimetres, ..view.clone() }]),
            TemplateError::Size { found, .. } if found > 10.0
        ));
        let posed = DepthView { camera_from_object: Some(Pose::identity()), ..view.clone() };
        assert!(matches!(error(&[view, posed]), TemplateError::MixedPoses { view: 2, .. }));
    }
}
