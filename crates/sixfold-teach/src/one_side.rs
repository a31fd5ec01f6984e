//! An object that depth images show from one side only.
//!
//! The table, the object's mask and its symmetry are found in one depth image. What the image does not show is assumed: most objects
//! on tables are symmetric about a vertical plane, so what is empty beside or in front of the object is empty in its mirror image
//! too. Mirror planes are those of [`complete_by_mirrors`] (Bohg et al. 2011, "Mind the gap", ICRA).

use rayon::prelude::*;
use sixfold_geometry::nalgebra::{Rotation3, UnitQuaternion};
use sixfold_geometry::{
    Camera, DepthImage, Image, Mask, Mat3, Plane, Pose, Vec2, Vec3, inpaint_depth, undistort_depth,
};
use sixfold_grasp::{
    CompletionOptions, GraspView, ViewError, ViewOptions, complete_by_mirrors, find_objects, find_table,
};

use crate::error::TeachError;
use crate::given::{not_hidden, salient_fraction};
use crate::grid::Grid;
use crate::shape::{APART, Capture, Segmentation, ShapeOptions};
use crate::silhouette::Segmenter;
use crate::view::{PosedPhotograph, View, Volume, nearest_pixel};

/// Space around the seen and assumed points, metres.
const MARGIN: f64 = 0.01;
/// Matter this thick behind a measured surface is believed even where the mirror image is empty (the handle of a mug), metres.
/// Chosen by hand; not swept.
const SHELL: f64 = 0.008;
/// How far the object may extend beyond the seen and assumed points in a horizontal direction, metres.
const BEYOND: f64 = 0.002;
/// Depth this far behind a neighbour's (8-neighbourhood) is a mixture of object and background, metres. Chosen by hand; not swept.
const JUMP: f64 = 0.008;
/// Rounds by which the trusted depth is extended to the mask's border and into holes; a round is a pixel.
const EXTENDED: usize = 16;
/// Minimum mean probability of the salient region in the object's mask, and its maximum in every other one.
const SALIENT: f64 = 0.5;

/// What one depth image tells about an object, in the world's frame.
pub(crate) struct OneSide<'a> {
    /// The box around the seen and assumed points.
    pub volume: Volume,
    /// The table, its normal upwards.
    pub floor: Option<Plane>,
    /// At most two, vertical.
    mirrors: Vec<Plane>,
    /// Horizontal directions with the smallest and largest coordinate of the object along them.
    extents: Vec<(Vec3, [f64; 2])>,
    photograph: &'a PosedPhotograph,
    /// Depth of the object, metres, without lens distortion, holes and mixed pixels; 0 around it.
    surface: DepthImage,
}

impl<'a> OneSide<'a> {
    /// `None` if the photographs are from several sides or without depth. `masks` are in the photographs' pixels without lens
    /// distortion.
    pub fn of(capture: &'a Capture, masks: &[Option<Mask>]) -> Result<Option<OneSide<'a>>, TeachError> {
        let shown = |(p, mask): (&'a PosedPhotograph, &Option<Mask>)| {
            p.depth.as_ref()?;
            Some((p, not_hidden(p, mask.as_ref()?)))
        };
        let given = masks.iter().filter(|mask| mask.is_some()).count();
        let used: Vec<(&PosedPhotograph, Mask)> =
            capture.photographs.iter().zip(masks).filter_map(shown).collect();
        if used.len() < given || from_several_sides(&used)? {
            return Ok(None);
        }
        let mut best: Option<(usize, &PosedPhotograph, &Mask, DepthImage)> = None;
        for (photograph, mask) in &used {
            let depth = straight_depth(photograph)?;
            let pixels =
                mask.as_slice().iter().zip(depth.as_slice()).filter(|(m, z)| **m && **z > 0.0).count();
            if best.as_ref().is_none_or(|best| pixels > best.0) {
                best = Some((pixels, photograph, mask, depth));
            }
        }
        best.map(|(_, photograph, mask, depth)| OneSide::new(capture, photograph, mask, depth)).transpose()
    }

    fn new(
        capture: &Capture,
        photograph: &'a PosedPhotograph,
        mask: &Mask,
        depth: DepthImage,
    ) -> Result<OneSide<'a>, TeachError> {
        let camera = photograph.camera.without_distortion();
        let rough = GraspView::new(&depth, &camera, mask, &ViewOptions::default())?;
        let surface = cleaned(&rough, mask);
        let depth = Image::from_fn(camera.width, camera.height, |x, y| {
            if mask[(x, y)] { surface[(x, y)] } else { depth[(x, y)] }
        });
        let mut view = GraspView::new(&depth, &camera, mask, &ViewOptions::default())?;
        let camera_from_world = &photograph.camera_from_world;
        let world_from_camera = camera_from_world.inverse();
        if let Some(floor) = &capture.floor {
            view.table = Some(moved(floor, camera_from_world));
        }
        let completed = complete_by_mirrors(&view, &CompletionOptions::default());
        let points: Vec<Vec3> =
            completed.cloud.points.iter().map(|p| world_from_camera.transform_point(p)).collect();
        let floor = view.table.map(|table| moved(&table, &world_from_camera));
        // Something may occlude the lower part: the object reaches down to the table.
        let feet = floor.iter().flat_map(|floor| points.iter().map(|p| p - floor.normal * floor.distance(p)));
        let all = || points.iter().copied().chain(feet.clone());
        let low = all().fold(Vec3::repeat(f64::INFINITY), |low, p| low.inf(&p));
        let high = all().fold(Vec3::repeat(f64::NEG_INFINITY), |high, p| high.sup(&p));
        let mirrors: Vec<Plane> =
            completed.planes.iter().map(|plane| moved(plane, &world_from_camera)).collect();
        let extents = floor.map_or_else(Vec::new, |floor| {
            let towards = floor.normal.cross(&(world_from_camera.translation() - 0.5 * (low + high)));
            let first = mirrors.first().map_or(towards, |plane| plane.normal).normalize();
            [first, floor.normal.cross(&first)].map(|direction| extent(&points, direction)).to_vec()
        });
        let volume = Volume { low, high }.grown(MARGIN);
        Ok(OneSide { volume, floor, mirrors, extents, photograph, surface })
    }

    /// The signed distance to the object, from that to what the images allow: hidden points whose mirror images are empty are empty.
    pub fn completed(&self, allowed: &Grid) -> Grid {
        let mut done = allowed.clone();
        let beyond = allowed.step * allowed.size.into_iter().max().unwrap_or(1) as f64;
        done.values.par_iter_mut().enumerate().for_each(|(index, value)| {
            let point = allowed.point(allowed.place(index));
            let outside = self.extents.iter().map(|(direction, [low, high])| {
                let along = direction.dot(&point);
                (low - along).max(along - high)
            });
            *value = outside.fold(*value, |value, outside| value.max(outside as f32));
            let hidden = self.behind(&point) - SHELL;
            if hidden <= f64::from(*value) {
                return;
            }
            let mirrored = self.mirrored(&point);
            let empty = mirrored.iter().map(|p| allowed.at(p).map_or(beyond, f64::from));
            let empty = empty.fold(f64::NEG_INFINITY, f64::max);
            *value = value.max(empty.min(hidden) as f32);
        });
        done
    }

    /// The mirror images of a point.
    fn mirrored(&self, point: &Vec3) -> Vec<Vec3> {
        let mut all: Vec<Vec3> = self.mirrors.iter().map(|plane| plane.mirrored(point)).collect();
        if let [first, second] = &self.mirrors[..] {
            all.push(second.mirrored(&first.mirrored(point)));
        }
        all
    }

    /// How far a point is behind the measured surface, metres; infinite where nothing was measured.
    fn behind(&self, point: &Vec3) -> f64 {
        let p = self.photograph.camera_from_world.transform_point(point);
        self.surface_at(&p).map_or(f64::INFINITY, |z| p.z - f64::from(z))
    }

    /// The cleaned depth on the ray of a point in the photograph's camera.
    fn surface_at(&self, p: &Vec3) -> Option<f32> {
        let pixel = self.photograph.camera.without_distortion().project(p)?;
        let pixel = nearest_pixel(&pixel, self.surface.width(), self.surface.height())?;
        Some(self.surface[pixel]).filter(|z| *z > 0.0)
    }

    /// The cleaned depth in the pixels of a view from the same place.
    fn depth_in(&self, view: &View) -> DepthImage {
        Image::from_fn(view.camera.width, view.camera.height, |x, y| {
            let ray = view.camera.unproject(&Vec2::new(x as f64, y as f64), 1.0);
            self.surface_at(&ray).unwrap_or(0.0)
        })
    }

    /// Replaces the depth of views of the photograph whose depth was cleaned.
    pub fn replace(&self, views: &[View], depths: &mut [DepthImage]) {
        for (view, depth) in views.iter().zip(depths) {
            if view.camera_from_world == self.photograph.camera_from_world {
                *depth = self.depth_in(view);
            }
        }
    }
}

/// The object's depth without pixels at its border and mixed ones, extended to the mask's border and into holes.
fn cleaned(view: &GraspView, mask: &Mask) -> DepthImage {
    let (width, height) = mask.size();
    let around = |x: usize, y: usize| {
        let near = |p: usize, length: usize| p.saturating_sub(1)..(p + 2).min(length);
        near(y, height).flat_map(move |v| near(x, width).map(move |u| (u, v)))
    };
    let inner = Mask::from_fn(width, height, |x, y| around(x, y).all(|p| mask[p]));
    let trusted = Image::from_fn(width, height, |x, y| {
        let here = view.depth[(x, y)];
        let nearest =
            around(x, y).filter(|p| view.mask[*p]).map(|p| view.depth[p]).fold(f32::INFINITY, f32::min);
        let all = inner[(x, y)] && view.mask[(x, y)] && around(x, y).all(|p| inner[p]);
        if all && f64::from(here - nearest) < JUMP { here } else { 0.0 }
    });
    let extended = inpaint_depth(&trusted, EXTENDED);
    Image::from_fn(width, height, |x, y| if mask[(x, y)] { extended[(x, y)] } else { 0.0 })
}

/// A direction with the range of points along it.
fn extent(points: &[Vec3], direction: Vec3) -> (Vec3, [f64; 2]) {
    let along = points.iter().map(|p| direction.dot(p));
    let [low, high] =
        along.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], x| [low.min(x), high.max(x)]);
    (direction, [low - BEYOND, high + BEYOND])
}

/// The plane in another frame.
fn moved(plane: &Plane, pose: &Pose) -> Plane {
    let normal = pose.transform_direction(&plane.normal);
    Plane { normal, offset: plane.offset + normal.dot(&pose.translation()) }
}

/// Whether the object is seen from directions at least [`APART`] degrees apart; also if no depth says where it is.
fn from_several_sides(used: &[(&PosedPhotograph, Mask)]) -> Result<bool, TeachError> {
    let mut centre = None;
    for (p, mask) in used {
        centre = centre_of(p, mask)?;
        if centre.is_some() {
            break;
        }
    }
    let Some(centre) = centre else { return Ok(true) };
    let towards: Vec<Vec3> = used
        .iter()
        .map(|(p, _)| (p.camera_from_world.inverse().translation() - centre).normalize())
        .collect();
    let smallest = APART.to_radians().cos();
    Ok(towards.iter().any(|a| towards.iter().any(|b| a.dot(b) <= smallest)))
}

/// The mean of the measured points in a mask.
fn centre_of(photograph: &PosedPhotograph, mask: &Mask) -> Result<Option<Vec3>, TeachError> {
    let (depth, camera) = (straight_depth(photograph)?, photograph.camera.without_distortion());
    let (mut sum, mut count) = (Vec3::zeros(), 0.0);
    for (y, x) in (0..mask.height()).flat_map(|y| (0..mask.width()).map(move |x| (y, x))) {
        if mask[(x, y)] && depth[(x, y)] > 0.0 {
            sum += camera.unproject(&Vec2::new(x as f64, y as f64), f64::from(depth[(x, y)]));
            count += 1.0;
        }
    }
    Ok((count > 0.0).then(|| photograph.camera_from_world.inverse().transform_point(&(sum / count))))
}

/// A photograph's depth in pixels without lens distortion; empty if it has none.
fn straight_depth(photograph: &PosedPhotograph) -> Result<DepthImage, TeachError> {
    let camera = &photograph.camera;
    match &photograph.depth {
        Some(depth) => Ok(undistort_depth(depth, camera).map_err(ViewError::Camera)?),
        None => Ok(Image::filled(camera.width, camera.height, 0.0)),
    }
}

/// The object in depth images from one side: in the given masks or, in a single image, the object on the table. `None` if there are
/// several images without masks, images from several sides, or images without depth.
pub(crate) fn segmented(
    capture: &Capture,
    segmenter: &dyn Segmenter,
    options: &ShapeOptions,
) -> Result<Option<Segmentation>, TeachError> {
    if capture.photographs.iter().any(|p| p.depth.is_none()) {
        return Ok(None);
    }
    let given: Option<Vec<Option<Mask>>> =
        capture.photographs.iter().map(|p| p.mask.as_deref().cloned().map(Some)).collect();
    let masks = match (given, &capture.photographs[..]) {
        (Some(given), _) => given,
        (None, [photograph]) => vec![Some(object_on_table(photograph, segmenter, options)?)],
        (None, _) => return Ok(None),
    };
    let Some(side) = OneSide::of(capture, &masks)? else { return Ok(None) };
    Ok(Some(Segmentation { volume: side.volume, masks, left_out: vec![] }))
}

/// The mask of the only object on a table or, among several, of the salient one.
fn object_on_table(
    photograph: &PosedPhotograph,
    segmenter: &dyn Segmenter,
    options: &ShapeOptions,
) -> Result<Mask, TeachError> {
    let depth = straight_depth(photograph)?;
    let found = find_objects(&depth, &photograph.camera.without_distortion(), &ViewOptions::default())?;
    let salient = salient_fraction(photograph, segmenter, options, &found).map_err(TeachError::Masks)?;
    let best = (0..found.len()).max_by(|a, b| salient[*a].total_cmp(&salient[*b]).then(b.cmp(a)));
    let Some(best) = best else {
        return Err(TeachError::NoObject {
            hint: "; nothing stands on the table that depth shows".to_owned(),
        });
    };
    let second = (0..found.len()).filter(|i| *i != best).map(|i| salient[i]).fold(0.0, f64::max);
    if found.len() > 1 && (salient[best] < SALIENT || second > SALIENT) {
        let size = |mask: &Mask| mask.as_slice().iter().filter(|m| **m).count() as f64;
        let mut sizes: Vec<f64> = found.iter().map(size).collect();
        sizes.sort_by(|a, b| b.total_cmp(a));
        let percent = 100.0 * sizes[1] / sizes[0];
        return Err(TeachError::SeveralObjects { found: found.len(), percent });
    }
    Ok(found[best].clone())
}

/// The pose of a camera above the table that its depth image shows: the world's z is up, and the table is at zero. `None` if the image
/// shows no table.
pub(crate) fn camera_above_table(depth: &DepthImage, camera: &Camera) -> Option<Pose> {
    let straight = undistort_depth(depth, camera).ok()?;
    let table = find_table(&straight, &camera.without_distortion(), &ViewOptions::default())?;
    let up = table.normal;
    let ahead = Vec3::z() - up * up.z;
    let forward = ahead.try_normalize(1e-6).unwrap_or_else(|| Vec3::x().cross(&up).normalize());
    let right = forward.cross(&up);
    let rows = Mat3::from_rows(&[right.transpose(), forward.transpose(), up.transpose()]);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rows));
    Some(Pose::new(rotation, Vec3::new(0.0, 0.0, -table.offset)).inverse())
}
