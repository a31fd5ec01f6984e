//! Camera and poses of photographs without a board: local features (XFeat, Potje et al. 2024) matched between all photographs, structure
//! from motion, and metres from one known length or from measured depth.

use sixfold_geometry::{Camera, DepthImage, Pose, Progress, RgbImage, Vec2, Vec3, stats::median};
use sixfold_nn::keypoints::{KeypointFinder, KeypointOptions, Keypoints};
use sixfold_sfm::{Features, Reconstruction, SfmError, SfmOptions, matched, reconstruct, triangulated};

use crate::error::TeachError;
use crate::located::common_size;
use crate::upright::upright;
use crate::view::reduced;

/// Longer side at which features are searched, pixels. Chosen by hand; not swept.
const SIDE: usize = 1280;
/// Most features of a photograph: the default of the authors' program.
const FEATURES: usize = 4096;
/// Smallest product of two descriptors that match, as in the authors' `match`.
const LEAST_PRODUCT: f32 = 0.82;
/// Focal length where nothing says so, as a fraction of the image's longer side: between a telephone (0.72) and a webcam (1.1).
const FOCAL_LENGTH: f64 = 0.9;
/// A marked point may be this far from where the other photographs say, as a fraction of the image's longer side. Chosen by hand.
const MARKED: f64 = 0.012;
/// Smallest angle between two rays to a marked point, degrees. Chosen by hand.
const MARKED_ANGLE: f64 = 5.0;
/// Fewest depths that say a scale.
const FEWEST_DEPTHS: usize = 30;
/// Depths around one that says a scale differ by less than this fraction: none at a border.
const SMOOTH: f32 = 0.03;

/// Features of a photograph, in its pixels.
///
/// # Errors
/// [`TeachError::Features`] for an image that is too small.
pub fn features_of(finder: &KeypointFinder, image: &RgbImage) -> Result<Features, TeachError> {
    let (width, height) = image.size();
    let scale = (width.max(height) as f64 / SIDE as f64).max(1.0);
    let shorter = |length: usize| ((length as f64 / scale).round() as usize).max(1);
    let size = (shorter(width), shorter(height));
    let ratio = Vec2::new(width as f64 / size.0 as f64, height as f64 / size.1 as f64);
    let at = |x: f64, y: f64| Vec2::new((x + 0.5) * ratio.x - 0.5, (y + 0.5) * ratio.y - 0.5);
    let options = KeypointOptions { most: FEATURES, ..KeypointOptions::default() };
    let find = |image: &RgbImage| finder.find(image, &options).map_err(TeachError::Features);
    let found = if scale > 1.0 { find(&reduced(image, size, ratio.x, &at))? } else { find(image)? };
    let Keypoints { positions, descriptors, .. } = found;
    Ok(Features { points: positions.iter().map(|p| at(p.x, p.y)).collect(), descriptors })
}

/// What a photograph shows.
#[derive(Debug, Clone)]
pub struct SeenFeatures {
    /// What messages call the photograph.
    pub name: String,
    /// Its width and height, pixels.
    pub size: (usize, usize),
    /// Its features.
    pub features: Features,
}

/// A known length: that between two points which somebody marked.
#[derive(Debug, Clone, PartialEq)]
pub struct KnownLength {
    /// The length, metres.
    pub metres: f64,
    /// Number of a photograph, and where it shows the two points, raw pixels; `None` where it does not show one.
    pub ends: Vec<(usize, [Option<Vec2>; 2])>,
}

/// Photographs put together, in metres: z up; the origin is below the point at which the cameras look.
#[derive(Debug, Clone)]
pub struct PutTogether {
    /// The camera of all photographs.
    pub camera: Camera,
    /// For each photograph the camera's pose, or why it has none.
    pub camera_from_world: Vec<Result<Pose, String>>,
    /// Height of the plane on which the object stands, metres; `None` where points show none.
    pub floor: Option<f64>,
    /// Root of the mean squared distance of features from where the points are, pixels.
    pub rms: f64,
}

/// Measured depth of a photograph, metres, from the same pixels; `None` where there is none.
pub type DepthOf<'a> = &'a dyn Fn(usize) -> Result<Option<DepthImage>, TeachError>;

/// Finds the camera, if it is not known, and its pose in each photograph, from features. The length says how long a metre is, else
/// measured depth. Progress counts pairs of photographs twice (matched, put together), then photographs.
///
/// # Errors
/// [`TeachError::NotTogether`], [`TeachError::Sfm`], [`TeachError::NoScale`], [`TeachError::Ends`], [`TeachError::CameraSize`],
/// [`TeachError::Stopped`].
pub fn put_together(
    seen: &[SeenFeatures],
    camera: Option<&Camera>,
    length: Option<&KnownLength>,
    depth: DepthOf<'_>,
    progress: &dyn Progress,
) -> Result<PutTogether, TeachError> {
    let sizes = seen.iter().map(|s| s.size);
    let size = common_size(sizes).ok_or(TeachError::NoPhotographs)?;
    if let Some(camera) = camera
        && (camera.width, camera.height) != size
    {
        let (width, height) = size;
        let (camera_width, camera_height) = (camera.width, camera.height);
        return Err(TeachError::CameraSize { width, height, camera_width, camera_height });
    }
    if let Some(length) = length {
        check_ends(seen, length)?;
    }
    let scene = scene_of(seen, size, camera, progress)?;
    let metres = match length {
        Some(length) => metres_of_length(&scene, seen, length)?,
        None => metres_of_depth(&scene, seen, depth)?,
    };
    let poses: Vec<Pose> = scene.camera_from_world.iter().flatten().copied().collect();
    let points: Vec<Vec3> = scene.points.iter().map(|p| p.position).collect();
    let upright = upright(&points, &poses);
    let scene_from_world = upright.world_from_scene.inverse();
    let in_metres = |pose: &Pose| {
        let pose = pose * &scene_from_world;
        pose.with_translation(pose.translation() * metres)
    };
    let name = |i: usize| seen[i].name.clone();
    let of = |(s, pose): (&SeenFeatures, &Result<Pose, sixfold_sfm::LeftOut>)| match pose {
        _ if s.size != size => Err(other_size(s.size, size)),
        Ok(pose) => Ok(in_metres(pose)),
        Err(reason) => Err(reason.reason(&name)),
    };
    Ok(PutTogether {
        camera: scene.camera,
        camera_from_world: seen.iter().zip(&scene.camera_from_world).map(of).collect(),
        floor: upright.on_table.then_some(0.0),
        rms: scene.rms_px,
    })
}

fn other_size((w, h): (usize, usize), (width, height): (usize, usize)) -> String {
    format!(
        "{w}x{h} pixels, most photographs have {width}x{height}: expected whole images of one camera, as it stores them"
    )
}

/// The photographs put together, in the unit of the reconstruction.
fn scene_of(
    seen: &[SeenFeatures],
    size: (usize, usize),
    camera: Option<&Camera>,
    progress: &dyn Progress,
) -> Result<Reconstruction, TeachError> {
    let usable = |s: &SeenFeatures| if s.size == size { s.features.clone() } else { Features::default() };
    let features: Vec<Features> = seen.iter().map(usable).collect();
    let pairs = seen.len() * seen.len().saturating_sub(1) / 2;
    let total = 2 * pairs + seen.len();
    let matches = matched(&features, LEAST_PRODUCT, &|done: usize, _: usize| progress.report(done, total))
        .ok_or(TeachError::Stopped)?;
    let longest = size.0.max(size.1) as f64;
    let options = SfmOptions {
        // Features are as exact as the pixels in which they were searched.
        threshold_px: SfmOptions::default().threshold_px * (longest / SIDE as f64).max(1.0),
        refine_camera: camera.is_none(),
        ..SfmOptions::default()
    };
    let guess = camera.copied().unwrap_or_else(|| guessed(size));
    let pixels: Vec<Vec<Vec2>> = features.into_iter().map(|f| f.points).collect();
    reconstruct(&pixels, &matches, &guess, &options, &|done: usize, _: usize| {
        progress.report(pairs + done, total)
    })
    .map_err(|error| named(error, seen, size))
}

/// A camera of which the size alone is known.
fn guessed((width, height): (usize, usize)) -> Camera {
    let f = FOCAL_LENGTH * width.max(height) as f64;
    let (cx, cy) = (0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
    Camera { fx: f, fy: f, cx, cy, width, height, distortion: None }
}

/// The error with the photographs' names.
fn named(error: SfmError, seen: &[SeenFeatures], size: (usize, usize)) -> TeachError {
    match error {
        SfmError::Stopped => TeachError::Stopped,
        SfmError::TooFew { found, least, left_out } => {
            let name = |i: usize| seen[i].name.clone();
            let of = |(s, reason): (&SeenFeatures, Option<sixfold_sfm::LeftOut>)| {
                let reason = if s.size == size { reason?.reason(&name) } else { other_size(s.size, size) };
                Some(format!("; {}: {reason}", s.name))
            };
            let all: Vec<String> = seen.iter().zip(left_out).filter_map(of).collect();
            let mut reasons = all.iter().take(5).cloned().collect::<String>();
            if all.len() > 5 {
                reasons.push_str(&format!("; and {} more", all.len() - 5));
            }
            TeachError::NotTogether { found, least, reasons }
        }
        other => TeachError::Sfm(other),
    }
}

fn check_ends(seen: &[SeenFeatures], length: &KnownLength) -> Result<(), TeachError> {
    for (i, ends) in &length.ends {
        let Some(s) = seen.get(*i) else {
            return Err(TeachError::NoPhotograph { index: *i, photographs: seen.len() });
        };
        let (w, h) = (s.size.0 as f64, s.size.1 as f64);
        let inside = |p: &Vec2| p.x >= -0.5 && p.y >= -0.5 && p.x <= w - 0.5 && p.y <= h - 0.5;
        if let Some(p) = ends.iter().flatten().find(|p| !inside(p)) {
            let what = format!("{}: found {:.0},{:.0}, the photograph has {w}x{h} pixels", s.name, p.x, p.y);
            return Err(TeachError::Ends { what });
        }
    }
    Ok(())
}

/// How long the unit of the reconstruction is, from the length between two marked points.
fn metres_of_length(
    scene: &Reconstruction,
    seen: &[SeenFeatures],
    length: &KnownLength,
) -> Result<f64, TeachError> {
    let ends = [marked(scene, seen, length, 0)?, marked(scene, seen, length, 1)?];
    let metres = length.metres / (ends[0] - ends[1]).norm();
    if metres.is_finite() {
        Ok(metres)
    } else {
        Err(TeachError::Ends { what: "both points are the same one".to_owned() })
    }
}

/// A marked point in the reconstruction.
fn marked(
    scene: &Reconstruction,
    seen: &[SeenFeatures],
    length: &KnownLength,
    end: usize,
) -> Result<Vec3, TeachError> {
    let which = ["first", "second"][end];
    let wrong = |what: String| TeachError::Ends { what };
    let pinhole = scene.camera.without_distortion();
    let (mut rays, mut shown) = (vec![], vec![]);
    for (i, ends) in &length.ends {
        let (Some(pixel), Ok(pose)) = (ends[end], &scene.camera_from_world[*i]) else { continue };
        let Some(straight) = scene.camera.undistort_point(&pixel) else { continue };
        rays.push((*pose, pinhole.unproject(&straight, 1.0).xy()));
        shown.push((*i, straight));
    }
    if rays.len() < 2 {
        let left_out = length.ends.iter().filter_map(|(i, ends)| {
            let reason = ends[end].and(scene.camera_from_world[*i].as_ref().err())?;
            Some(format!("; {}: {}", seen[*i].name, reason.reason(&|k| seen[k].name.clone())))
        });
        return Err(wrong(format!(
            "the {which} point is marked in {} photographs whose pose is known, expected at least 2{}",
            rays.len(),
            left_out.collect::<String>()
        )));
    }
    let point = triangulated(&rays).filter(|point| {
        let towards: Vec<Vec3> =
            rays.iter().map(|(pose, _)| (point - pose.inverse().translation()).normalize()).collect();
        let angle = |a: &Vec3, b: &Vec3| a.cross(b).norm().atan2(a.dot(b)).to_degrees();
        towards.iter().any(|a| towards.iter().any(|b| angle(a, b) >= MARKED_ANGLE))
    });
    let Some(point) = point else {
        return Err(wrong(format!(
            "the photographs in which the {which} point is marked are less than {MARKED_ANGLE} degrees apart: mark it in one from \
             another side"
        )));
    };
    let limit = MARKED * pinhole.width.max(pinhole.height) as f64;
    for ((i, straight), (pose, _)) in shown.iter().zip(&rays) {
        let error =
            pinhole.project(&pose.transform_point(&point)).map_or(f64::INFINITY, |p| (p - straight).norm());
        if error > limit {
            return Err(wrong(format!(
                "{}: the {which} point is marked {error:.0} pixels from where the marks in the other photographs put it, expected at \
                 most {limit:.0}: mark the same point",
                seen[*i].name
            )));
        }
    }
    Ok(point)
}

/// How long the unit of the reconstruction is, from measured depth: the median ratio at all features whose point is known.
fn metres_of_depth(
    scene: &Reconstruction,
    seen: &[SeenFeatures],
    depth: DepthOf<'_>,
) -> Result<f64, TeachError> {
    let mut ratios = vec![];
    let mut any = false;
    for (i, pose) in scene.camera_from_world.iter().enumerate() {
        let Ok(pose) = pose else { continue };
        let Some(image) = depth(i)? else { continue };
        any = true;
        for point in &scene.points {
            let Some((_, feature)) = point.seen.iter().find(|(photograph, _)| *photograph == i) else {
                continue;
            };
            let pixel = seen[i].features.points[*feature as usize];
            let z = pose.transform_point(&point.position).z;
            if let Some(measured) = smooth_depth(&image, &pixel) {
                ratios.push(f64::from(measured) / z);
            }
        }
    }
    let count = ratios.len();
    match median(&mut ratios) {
        Some(metres) if count >= FEWEST_DEPTHS && metres > 0.0 => Ok(metres),
        _ if any => Err(TeachError::FewDepths { found: count, least: FEWEST_DEPTHS }),
        _ => Err(TeachError::NoScale),
    }
}

/// The depth at a pixel, unless it or one beside it is not measured or at a border.
fn smooth_depth(depth: &DepthImage, pixel: &Vec2) -> Option<f32> {
    let (x, y) = (pixel.x.round() as isize, pixel.y.round() as isize);
    let centre = *depth.get(usize::try_from(x).ok()?, usize::try_from(y).ok()?)?;
    for (i, j) in [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)] {
        let beside = *depth.get(usize::try_from(x + i).ok()?, usize::try_from(y + j).ok()?)?;
        if !(beside > 0.0 && (beside - centre).abs() < SMOOTH * centre) {
            return None;
        }
    }
    Some(centre)
}
