//! Camera and poses of photographs without a board: local features (XFeat, Potje et al. 2024) matched between all photographs,
//! structure from motion, and the scale from one known length or from measured depth.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sixfold_geometry::{
    Camera, DepthImage, Image, Pose, Progress, RgbImage, Vec2, Vec3,
    stats::{median, upper_median},
};
use sixfold_nn::keypoints::{KeypointFinder, KeypointOptions, Keypoints};
use sixfold_sfm::{Features, Reconstruction, SfmError, SfmOptions, matched, reconstruct, triangulated};

use crate::error::TeachError;
use crate::located::common_size;
use crate::upright::upright;
use crate::view::{bilinear_rgb, reduced};

/// Longer side at which features are searched, pixels. Chosen by hand; not swept.
const SIDE: usize = 1280;
/// Maximum number of features of a photograph. With 4096, matching takes four times as long, and poses are no better: 0.57 mm in
/// place of 0.51 mm on simulated photographs (`examples/poses_without_board.rs`).
const FEATURES: usize = 2048;
/// Rotations of a photograph for which its features are described again, degrees: descriptors tolerate about 30 degrees, and
/// between the sides of an object the ground rotates in the image.
const ROTATIONS: [f64; 4] = [-90.0, -45.0, 45.0, 90.0];
/// Smallest product of two descriptors that match, as in the authors' `match`.
const MIN_PRODUCT: f32 = 0.82;
/// Focal length if unknown, as a fraction of the image's longer side: between a phone (0.72) and a webcam (1.1).
const FOCAL_LENGTH: f64 = 0.9;
/// Largest distance of a marked point from its position according to the other photographs, as a fraction of the image's longer
/// side. Chosen by hand.
const MARKED: f64 = 0.012;
/// Smallest angle between two rays to a marked point, degrees. Chosen by hand.
const MARKED_ANGLE: f64 = 5.0;
/// The names of the two marked points in messages.
const WHICH: [&str; 2] = ["first", "second"];
/// Minimum number of depths for a scale.
const FEWEST_DEPTHS: usize = 30;
/// Depths around a depth that is used for the scale differ by less than this fraction, which excludes borders.
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
    let smaller = (scale > 1.0).then(|| reduced(image, size, ratio.x, &at));
    let image = smaller.as_ref().unwrap_or(image);
    let Keypoints { positions, descriptors, .. } =
        finder.find(image, &options).map_err(TeachError::Features)?;
    let described = |degrees: &f64| {
        let (image, moved) = rotated(image, degrees.to_radians(), &positions);
        finder.described(&image, &moved).map_err(TeachError::Features)
    };
    let rotated = ROTATIONS.iter().map(described).collect::<Result<_, _>>()?;
    Ok(Features { points: positions.iter().map(|p| at(p.x, p.y)).collect(), descriptors, rotated })
}

/// An image rotated about its centre, grey outside the original, and the rotated positions of points.
fn rotated(image: &RgbImage, angle: f64, points: &[Vec2]) -> (RgbImage, Vec<Vec2>) {
    let (w, h) = (image.width() as f64, image.height() as f64);
    let (sin, cos) = angle.sin_cos();
    let sides = [w * cos.abs() + h * sin.abs(), w * sin.abs() + h * cos.abs()].map(|s| (s - 1e-6).ceil());
    let centre = Vec2::new(0.5 * (w - 1.0), 0.5 * (h - 1.0));
    let to = Vec2::new(0.5 * (sides[0] - 1.0), 0.5 * (sides[1] - 1.0));
    let (width, height) = (sides[0] as usize, sides[1] as usize);
    let pixel = |x: usize, y: usize| {
        let d = Vec2::new(x as f64, y as f64) - to;
        let p = centre + Vec2::new(cos * d.x + sin * d.y, cos * d.y - sin * d.x);
        let inside = p.x > -0.5 && p.y > -0.5 && p.x < w - 0.5 && p.y < h - 0.5;
        if inside { bilinear_rgb(image, p.x, p.y).map(|c| c.round() as u8) } else { [128; 3] }
    };
    let pixels: Vec<[u8; 3]> =
        (0..height).into_par_iter().flat_map_iter(|y| (0..width).map(move |x| pixel(x, y))).collect();
    let rotated = Image::from_vec(width, height, pixels).unwrap_or_else(|_| image.clone());
    let place = |p: &Vec2| {
        let d = p - centre;
        to + Vec2::new(cos * d.x - sin * d.y, sin * d.x + cos * d.y)
    };
    (rotated, points.iter().map(place).collect())
}

/// A photograph with its features.
#[derive(Debug, Clone)]
pub struct SeenFeatures {
    /// The photograph's name in messages.
    pub name: String,
    /// Its width and height, pixels.
    pub size: (usize, usize),
    /// Its features.
    pub features: Features,
    /// The focal length from its file, pixels.
    pub focal_length: Option<f64>,
}

/// A known length between two points that a person marked.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KnownLength {
    /// The length, metres.
    pub metres: f64,
    /// Number of a photograph and the raw pixels of the two points in it; `None` for a point that it does not show.
    pub ends: Vec<(usize, [Option<[f64; 2]>; 2])>,
}

impl KnownLength {
    /// Checks that the points lie within the photographs, which are given by name, width and height, and that two or more of them
    /// show each point.
    ///
    /// # Errors
    /// [`TeachError::Ends`]; [`TeachError::NoPhotograph`].
    pub fn check(&self, photographs: &[(&str, (usize, usize))]) -> Result<(), TeachError> {
        for (i, ends) in &self.ends {
            let Some((name, size)) = photographs.get(*i) else {
                return Err(TeachError::NoPhotograph { index: *i, photographs: photographs.len() });
            };
            let (w, h) = (size.0 as f64, size.1 as f64);
            let inside = |[x, y]: &[f64; 2]| (-0.5..=w - 0.5).contains(x) && (-0.5..=h - 0.5).contains(y);
            if let Some([x, y]) = ends.iter().flatten().find(|p| !inside(p)) {
                let what = format!("{name}: found {x:.0},{y:.0}, the photograph has {w}x{h} pixels");
                return Err(TeachError::Ends { what });
            }
        }
        for end in 0..2 {
            let found = self.ends.iter().filter(|(_, ends)| ends[end].is_some()).count();
            if found < 2 {
                let what =
                    format!("the {} point is marked in {found} photographs, expected at least 2", WHICH[end]);
                return Err(TeachError::Ends { what });
            }
        }
        Ok(())
    }
}

/// Registered photographs, in metres: z up; the origin is below the point at which the cameras look.
#[derive(Debug, Clone)]
pub struct PutTogether {
    /// The camera of all photographs.
    pub camera: Camera,
    /// For each photograph the camera's pose, or why it has none.
    pub camera_from_world: Vec<Result<Pose, String>>,
    /// Height of the plane on which the object stands, metres; `None` if the points show no plane.
    pub floor: Option<f64>,
    /// Root mean square reprojection error of the features, pixels.
    pub rms: f64,
}

/// Measured depth of a photograph, metres, from the same pixels; `None` where there is none.
pub type DepthOf<'a> = &'a dyn Fn(usize) -> Result<Option<DepthImage>, TeachError>;

/// Finds the camera, if it is not known, and its pose in each photograph, from features. The scale comes from the length or,
/// without one, from measured depth. Progress counts pairs of photographs twice (for matching and for reconstruction), then
/// photographs.
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
    // Check this before the slow steps.
    match length {
        Some(length) => check_ends(seen, length)?,
        None => check_depth(seen.len(), depth)?,
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

/// The reconstruction of the photographs, in its own unit.
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
    let matches = matched(&features, MIN_PRODUCT, &|done: usize, _: usize| progress.report(done, total))
        .ok_or(TeachError::Stopped)?;
    let longest = size.0.max(size.1) as f64;
    let mut focal_lengths: Vec<f64> =
        seen.iter().filter(|s| s.size == size).filter_map(|s| s.focal_length).collect();
    let focal_length = upper_median(&mut focal_lengths);
    let options = SfmOptions {
        // Features are as accurate as the pixels of the image in which they were searched.
        threshold_px: SfmOptions::default().threshold_px * (longest / SIDE as f64).max(1.0),
        refine_camera: camera.is_none(),
        focal_length_from_camera: focal_length.is_some(),
        ..SfmOptions::default()
    };
    let guess = camera.copied().unwrap_or_else(|| guessed(size, focal_length));
    let pixels: Vec<Vec<Vec2>> = features.into_iter().map(|f| f.points).collect();
    reconstruct(&pixels, &matches, &guess, &options, &|done: usize, _: usize| {
        progress.report(pairs + done, total)
    })
    .map_err(|error| named(error, seen, size))
}

/// A guessed camera of known image size; the focal length (pixels) may be known too.
fn guessed((width, height): (usize, usize), focal_length: Option<f64>) -> Camera {
    let f = focal_length.unwrap_or(FOCAL_LENGTH * width.max(height) as f64);
    let (cx, cy) = (0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
    Camera { fx: f, fy: f, cx, cy, width, height, distortion: None }
}

/// The error with the photographs' names.
fn named(error: SfmError, seen: &[SeenFeatures], size: (usize, usize)) -> TeachError {
    match error {
        SfmError::Stopped => TeachError::Stopped,
        SfmError::TooFew { found, minimum, left_out } => {
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
            TeachError::NotTogether { found, minimum, reasons }
        }
        other => TeachError::Sfm(other),
    }
}

fn check_ends(seen: &[SeenFeatures], length: &KnownLength) -> Result<(), TeachError> {
    let photographs: Vec<(&str, (usize, usize))> = seen.iter().map(|s| (s.name.as_str(), s.size)).collect();
    length.check(&photographs)
}

fn check_depth(count: usize, depth: DepthOf<'_>) -> Result<(), TeachError> {
    for i in 0..count {
        if depth(i)?.is_some() {
            return Ok(());
        }
    }
    Err(TeachError::NoScale)
}

/// The unit of the reconstruction in metres, from the length between two marked points.
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
    let which = WHICH[end];
    let wrong = |what: String| TeachError::Ends { what };
    let pinhole = scene.camera.without_distortion();
    let (mut rays, mut shown) = (vec![], vec![]);
    for (i, ends) in &length.ends {
        let (Some(pixel), Ok(pose)) = (ends[end], &scene.camera_from_world[*i]) else { continue };
        let Some(straight) = scene.camera.undistort_point(&Vec2::from(pixel)) else { continue };
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

/// The unit of the reconstruction in metres, from measured depth: the median ratio over all features with a known point.
fn metres_of_depth(
    scene: &Reconstruction,
    seen: &[SeenFeatures],
    depth: DepthOf<'_>,
) -> Result<f64, TeachError> {
    let mut ratios = vec![];
    for (i, pose) in scene.camera_from_world.iter().enumerate() {
        let Ok(pose) = pose else { continue };
        let Some(image) = depth(i)? else { continue };
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
        _ => Err(TeachError::FewDepths { found: count, minimum: FEWEST_DEPTHS }),
    }
}

/// The depth at a pixel; `None` if the pixel or one of its neighbours has no depth or is at a border.
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

#[cfg(test)]
mod tests {
    use sixfold_sfm::ScenePoint;

    use super::*;
    use crate::simulation::looking_at;

    const SIDES: usize = 3;

    fn camera() -> Camera {
        Camera { fx: 500.0, fy: 500.0, cx: 319.5, cy: 239.5, width: 640, height: 480, distortion: None }
    }

    /// Sixty points of a patch half a metre away in a reconstruction whose unit is 0.5 m, seen also from two other sides.
    fn scene() -> (Reconstruction, Vec<SeenFeatures>) {
        let poses: Vec<Pose> =
            (0..SIDES).map(|i| looking_at(&Vec3::zeros(), 20.0 * i as f64, 40.0, 1.0, 0.0)).collect();
        let points: Vec<Vec3> = (0..60)
            .map(|i| Vec3::new(0.2 * (1.7 * f64::from(i)).sin(), 0.2 * (2.9 * f64::from(i)).cos(), 0.0))
            .collect();
        let pixels =
            |pose: &Pose| points.iter().filter_map(|p| camera().project(&pose.transform_point(p))).collect();
        let seen = poses.iter().map(|pose| SeenFeatures {
            name: "a.jpg".to_owned(),
            size: (640, 480),
            features: Features { points: pixels(pose), ..Features::default() },
            focal_length: None,
        });
        let shown = |i: usize| (0..SIDES).map(|k| (k, i as u32)).collect();
        let seen = seen.collect();
        let points =
            points.iter().enumerate().map(|(i, p)| ScenePoint { position: *p, seen: shown(i) }).collect();
        let camera_from_world = poses.into_iter().map(Ok).collect();
        (Reconstruction { camera: camera(), camera_from_world, points, rms_px: 0.5 }, seen)
    }

    fn marked_in(scene: &Reconstruction, ends: [Vec3; 2], photographs: &[usize]) -> KnownLength {
        let pixel = |i: usize, p: &Vec3| {
            camera()
                .project(&scene.camera_from_world[i].as_ref().unwrap().transform_point(p))
                .map(<[f64; 2]>::from)
        };
        let ends = photographs.iter().map(|i| (*i, [pixel(*i, &ends[0]), pixel(*i, &ends[1])])).collect();
        KnownLength { metres: 0.1, ends }
    }

    #[test]
    fn a_length_between_marks_gives_the_scale() {
        let (mut scene, seen) = scene();
        let ends = [Vec3::new(0.1, 0.0, 0.0), Vec3::new(-0.1, 0.0, 0.0)];
        let length = marked_in(&scene, ends, &[0, 2]);
        assert!((metres_of_length(&scene, &seen, &length).unwrap() - 0.5).abs() < 1e-9);
        let refused = |scene: &Reconstruction, length: &KnownLength, part: &str| {
            let error =
                check_ends(&seen, length).and_then(|()| metres_of_length(scene, &seen, length)).unwrap_err();
            assert!(error.to_string().starts_with("--ends: ") && error.to_string().contains(part), "{error}");
        };
        let mut moved = length.clone();
        moved.ends[1].1[0] = moved.ends[1].1[0].map(|[x, y]| [x + 60.0, y + 40.0]);
        refused(&scene, &moved, "a.jpg: the first point is marked");
        refused(&scene, &marked_in(&scene, ends, &[1]), "first point is marked in 1 photographs");
        refused(&scene, &marked_in(&scene, ends, &[1, 1]), "less than 5 degrees apart");
        refused(&scene, &marked_in(&scene, [ends[0]; 2], &[0, 1]), "same one");
        let mut beyond = length.clone();
        beyond.ends[0].1[1] = Some([700.0, 20.0]);
        refused(&scene, &beyond, "a.jpg: found 700,20, the photograph has 640x480 pixels");
        scene.camera_from_world[2] = Err(sixfold_sfm::LeftOut::FewInliers { found: 3, of: 40 });
        refused(&scene, &length, "whose pose is known, expected at least 2; a.jpg: 3 of 40 features");
    }

    #[test]
    fn depth_gives_the_scale_except_at_borders_and_holes() {
        let (scene, seen) = scene();
        // Depth of the patch at half the unit; every third pixel column is a hole, and a third of the image another surface.
        let depth_of = |i: usize| {
            let pose = scene.camera_from_world[i].as_ref().unwrap();
            let normal = pose.transform_direction(&Vec3::z());
            let offset = normal.dot(&pose.translation());
            DepthImage::from_fn(640, 480, |x, y| {
                let ray = camera().unproject(&Vec2::new(x as f64, y as f64), 1.0);
                let depth = 0.5 * offset / normal.dot(&ray);
                if y < 200 {
                    9.0
                } else if x % 7 == 0 {
                    0.0
                } else {
                    depth as f32
                }
            })
        };
        let found = metres_of_depth(&scene, &seen, &|i| Ok((i != 1).then(|| depth_of(i)))).unwrap();
        assert!((found - 0.5).abs() < 0.005, "{found}");
        let bare = |i: usize| Ok((i == 0).then(|| DepthImage::filled(640, 480, 0.0)));
        assert!(matches!(metres_of_depth(&scene, &seen, &bare), Err(TeachError::FewDepths { found: 0, .. })));
    }
}
