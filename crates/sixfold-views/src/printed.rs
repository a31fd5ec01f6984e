//! What is printed on an object: SIFT keypoints of its views, found again in an image without knowing where to look.
//!
//! A match of two keypoints has a position, a size and an orientation in both images, so it alone predicts a pose. Matches of any
//! views whose predictions agree vote for each other (a Hough transform without bins; Lowe 2004, section 7.3); PnP on those that
//! voted for a pose makes it precise.

use std::f64::consts::TAU;
use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use sixfold_geometry::nalgebra::{DMatrix, UnitQuaternion};
use sixfold_geometry::{Camera, PnpOptions, Pose, Rect, RgbImage, Vec2, Vec3, pnp_ransac};
use sixfold_mesh::Mesh;
use sixfold_render::VisibilityBuffer;

use crate::colour::has_colours;
use crate::estimate::Hypothesis;
use crate::sift::{Keypoint, LENGTH, keypoints};
use crate::templates::{Rendered, directions, rotation_from, side_view, wide_camera};

/// Number of views.
const VIEWS: usize = 42;
/// Side of a view, pixels.
const SIDE: usize = 400;
/// Ratio of a view's side to the longer side of the object's box.
const FACTOR: f64 = 1.1;
/// Distance of a view's camera, diameters.
const DISTANCE: f64 = 4.0;
/// Maximum number of keypoints of a view, those with the highest contrast.
const PER_VIEW: usize = 300;
/// A keypoint of a view is on the object with everything within this many sizes.
const SUPPORT: f64 = 4.0;
/// Maximum number of keypoints of an image, those with the highest contrast.
const PER_IMAGE: usize = 8000;
/// Smallest product of two descriptors that match.
const MIN_PRODUCT: f32 = 0.80;
/// Largest ratio of the squared distances to the most similar descriptor of the image and to the second one.
const RATIO: f32 = 0.85;
/// Keypoints of an image closer than this are at one place and do not compete, pixels.
const ONE_PLACE: f64 = 2.0;
/// Maximum number of matches that vote, the most similar ones.
const VOTERS: usize = 3000;
/// A match votes for a pose that projects its point within this fraction of the projected diameter.
const NEAR: f64 = 0.12;
/// Largest angle between the rotations that two matches predict, radians.
const ANGLE: f64 = 0.8;
/// Largest difference of the logarithms of the predicted distances.
const STRETCH: f64 = 0.5;
/// Smallest number of keypoints of an image that agree with a pose.
const FEWEST: usize = 7;
/// Maximum number of poses that are made precise.
const PRECISE: usize = 16;
/// Inlier threshold relative to the projected diameter, and its range in pixels.
const THRESHOLD: (f64, [f64; 2]) = (0.015, [2.0, 6.0]);

/// A keypoint of a view, in single precision as in the file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ViewKeypoint {
    /// As [`Keypoint::size`].
    pub size: f32,
    /// As [`Keypoint::orientation`].
    pub orientation: f32,
    /// Its point on the object, metres.
    pub point: [f32; 3],
}

/// Keypoints of one view.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct View {
    /// Focal length of the view's camera, pixels.
    pub focal: f64,
    /// From the object's frame to the view's.
    pub view_from_object: Pose,
    /// The keypoints.
    pub keypoints: Vec<ViewKeypoint>,
    /// Their descriptors as columns.
    pub descriptors: DMatrix<f32>,
}

/// The keypoints of an object's views.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Printed {
    /// The views; none of an object without colours.
    pub views: Vec<View>,
    /// The object's diameter, metres.
    pub diameter: f64,
}

/// A number of a descriptor as a byte; products of descriptors change by less than 0.01.
pub(crate) fn to_byte(value: f32) -> u8 {
    (value * BYTES).round() as u8
}

/// The number of a byte.
pub(crate) fn from_byte(byte: u8) -> f32 {
    f32::from(byte) / BYTES
}

/// Bytes per unit: hardly any number is above 0.5.
const BYTES: f32 = 512.0;

/// The keypoints of an image.
pub(crate) struct ImageKeypoints {
    keypoints: Vec<Keypoint>,
    descriptors: DMatrix<f32>,
}

/// The keypoints of an image, computed once for all objects searched in it.
#[derive(Default)]
pub(crate) struct KeptKeypoints(Mutex<Option<Arc<ImageKeypoints>>>);

impl KeptKeypoints {
    pub(crate) fn of_image(&self, image: &RgbImage) -> Arc<ImageKeypoints> {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        Arc::clone(kept.get_or_insert_with(|| Arc::new(ImageKeypoints::new(keypoints(image, PER_IMAGE)))))
    }
}

impl ImageKeypoints {
    fn new(keypoints: Vec<Keypoint>) -> ImageKeypoints {
        let descriptors = columns(keypoints.iter());
        ImageKeypoints { keypoints, descriptors }
    }

    /// Those within a box.
    pub(crate) fn within(&self, bbox: &Rect) -> ImageKeypoints {
        let inside = |p: &Vec2| {
            (bbox.x..bbox.x + bbox.width).contains(&p.x) && (bbox.y..bbox.y + bbox.height).contains(&p.y)
        };
        ImageKeypoints::new(self.keypoints.iter().filter(|k| inside(&k.position)).cloned().collect())
    }
}

fn columns<'a>(keypoints: impl ExactSizeIterator<Item = &'a Keypoint>) -> DMatrix<f32> {
    let count = keypoints.len();
    let numbers = keypoints.flat_map(|k| k.descriptor.iter().copied());
    DMatrix::from_iterator(LENGTH, count, numbers)
}

/// A keypoint of a view and one of an image.
struct Match {
    point: Vec3,
    pixel: Vec2,
    /// Number of the image's keypoint.
    keypoint: usize,
    product: f32,
    /// The pose that it predicts.
    pose: Pose,
}

impl Printed {
    /// The keypoints of an object rendered from all sides; none for a mesh without colours.
    pub(crate) fn of_mesh(mesh: &Mesh, diameter: f64) -> Printed {
        if !has_colours(mesh) {
            return Printed { views: vec![], diameter };
        }
        let wide = wide_camera();
        let sides = directions(VIEWS);
        let view = |frames: &mut (VisibilityBuffer, VisibilityBuffer), direction: &Vec3| {
            let rotation = rotation_from(direction, 0.0);
            let (view_from_object, rendered) =
                side_view(frames, mesh, &rotation, DISTANCE * diameter, FACTOR, SIDE)?;
            let found: Vec<(Keypoint, Vec3)> = keypoints(&rendered.image, 4 * PER_VIEW)
                .into_iter()
                .filter_map(|k| on_object(&rendered, &k).map(|point| (k, point)))
                .take(PER_VIEW)
                .collect();
            // Rounded as in the file, so that stored and new views give the same poses.
            let descriptors = columns(found.iter().map(|(k, _)| k)).map(|v| from_byte(to_byte(v)));
            let kept = |(k, point): &(Keypoint, Vec3)| ViewKeypoint {
                size: k.size as f32,
                orientation: k.orientation as f32,
                point: (*point).map(|v| v as f32).into(),
            };
            let keypoints = found.iter().map(kept).collect();
            Some(View { focal: frames.1.camera().fx, view_from_object, keypoints, descriptors })
        };
        let views = sides
            .par_iter()
            .map_init(|| (VisibilityBuffer::new(&wide), VisibilityBuffer::new(&wide)), view)
            .flatten()
            .collect();
        Printed { views, diameter }
    }

    /// Mutual nearest neighbours between each view and an image of `camera`, the most similar ones first.
    pub(crate) fn matches(&self, image: &ImageKeypoints, camera: &Camera) -> PrintMatches {
        let mut list: Vec<Match> =
            self.views.par_iter().flat_map_iter(|view| view.matches(image, camera)).collect();
        list.sort_by(|a, b| b.product.total_cmp(&a.product));
        list.truncate(VOTERS);
        PrintMatches { list, camera: *camera, diameter: self.diameter }
    }
}

/// The matches of an object's keypoints in an image.
pub(crate) struct PrintMatches {
    list: Vec<Match>,
    camera: Camera,
    diameter: f64,
}

impl PrintMatches {
    /// Poses with which several keypoints of the image agree, those with most first.
    pub(crate) fn poses(&self) -> Vec<Hypothesis> {
        let votes = |pose: &Pose| distinct(self.voters(pose, self.near(pose)));
        let mut rated: Vec<(usize, &Match)> = self.list.par_iter().map(|m| (votes(&m.pose), m)).collect();
        rated.retain(|(votes, _)| *votes >= FEWEST);
        // A stable sort: ties keep the order of the matches.
        rated.sort_by_key(|(votes, _)| std::cmp::Reverse(*votes));
        let mut seeds: Vec<Pose> = Vec::new();
        for (_, m) in rated {
            if seeds.len() < PRECISE && seeds.iter().all(|seed| self.apart(seed, &m.pose)) {
                seeds.push(m.pose);
            }
        }
        let mut found: Vec<Hypothesis> = seeds.par_iter().filter_map(|seed| self.precise(seed)).collect();
        found.sort_by_key(|pose| std::cmp::Reverse(pose.inliers));
        let mut kept: Vec<Hypothesis> = Vec::new();
        for pose in found {
            if kept.iter().all(|k| self.apart(&k.camera_from_object, &pose.camera_from_object)) {
                kept.push(pose);
            }
        }
        kept
    }

    /// Number of the image's keypoints that agree with a pose.
    pub(crate) fn agreeing(&self, pose: &Pose) -> usize {
        distinct(self.voters(pose, self.threshold(pose)))
    }

    /// Whether two poses are so far apart that one does not become the other.
    fn apart(&self, a: &Pose, b: &Pose) -> bool {
        let step = (a.translation() - b.translation()).xy().norm();
        a.rotation_angle_to(b) > 0.25 * ANGLE || step > 0.25 * self.diameter
    }

    /// PnP on the matches that vote for a pose.
    fn precise(&self, seed: &Pose) -> Option<Hypothesis> {
        let voters: Vec<&Match> = self.voters(seed, self.near(seed)).collect();
        let points: Vec<Vec3> = voters.iter().map(|m| m.point).collect();
        let pixels: Vec<Vec2> = voters.iter().map(|m| m.pixel).collect();
        let threshold_px = self.threshold(seed);
        let options =
            PnpOptions { threshold_px, max_iterations: 1000, min_iterations: 100, ..PnpOptions::default() };
        let report = pnp_ransac(&points, &pixels, &self.camera, &options).ok()?;
        let inliers = voters.iter().zip(&report.inliers).filter(|(_, inlier)| **inlier);
        let agree = distinct(inliers.map(|(m, _)| *m));
        let pose = report.camera_from_object;
        let near = seed.rotation_angle_to(&pose) < ANGLE;
        (agree >= FEWEST && near).then_some(Hypothesis {
            camera_from_object: pose,
            similarity: 0.0,
            inliers: agree,
            drawn: 0.0,
        })
    }

    /// The matches that agree with a pose, with an error of at most `near` pixels.
    fn voters<'a>(&'a self, pose: &'a Pose, near: f64) -> impl Iterator<Item = &'a Match> {
        self.list.iter().filter(move |m| m.votes(pose, &self.camera, near))
    }

    /// The diameter at a pose, pixels.
    fn projected(&self, pose: &Pose) -> f64 {
        self.camera.fx * self.diameter / pose.translation().z.max(1e-6)
    }

    fn near(&self, pose: &Pose) -> f64 {
        NEAR * self.projected(pose)
    }

    fn threshold(&self, pose: &Pose) -> f64 {
        let (fraction, [low, high]) = THRESHOLD;
        (fraction * self.projected(pose)).clamp(low, high)
    }
}

/// Number of different keypoints of the image.
fn distinct<'a>(matches: impl Iterator<Item = &'a Match>) -> usize {
    let mut keypoints: Vec<usize> = matches.map(|m| m.keypoint).collect();
    keypoints.sort_unstable();
    keypoints.dedup();
    keypoints.len()
}

impl View {
    fn matches(&self, image: &ImageKeypoints, camera: &Camera) -> Vec<Match> {
        if self.keypoints.is_empty() || image.keypoints.is_empty() {
            return vec![];
        }
        // Column i holds the products of this view's keypoint i with all of the image's.
        let products = image.descriptors.transpose() * &self.descriptors;
        let mut back = vec![(f32::NEG_INFINITY, 0usize); image.keypoints.len()];
        for (i, column) in products.column_iter().enumerate() {
            for (best, product) in back.iter_mut().zip(column.iter()) {
                if *product > best.0 {
                    *best = (*product, i);
                }
            }
        }
        let mut found = Vec::new();
        for (i, column) in products.column_iter().enumerate() {
            let column = column.as_slice();
            let best = (0..column.len()).fold(0, |best, j| if column[j] > column[best] { j } else { best });
            let product = column[best];
            if product < MIN_PRODUCT || back[best].1 != i {
                continue;
            }
            let place = image.keypoints[best].position;
            let rival = |j: &usize| (image.keypoints[*j].position - place).norm() > ONE_PLACE;
            let limit = 1.0 - (1.0 - product) / RATIO;
            let ambiguous = (0..column.len()).filter(|j| column[*j] > limit).any(|j| j != best && rival(&j));
            if !ambiguous && let Some(pose) = self.predicted(i, &image.keypoints[best], camera) {
                let point = Vec3::from(self.keypoints[i].point.map(f64::from));
                found.push(Match { point, pixel: place, keypoint: best, product, pose });
            }
        }
        found
    }

    /// The pose at which the object shows the view's keypoint `i` as a keypoint of the image.
    fn predicted(&self, i: usize, seen: &Keypoint, camera: &Camera) -> Option<Pose> {
        let own = self.keypoints[i];
        let point = Vec3::from(own.point.map(f64::from));
        let in_view = self.view_from_object.transform_point(&point);
        let focal = (camera.fx * camera.fy).sqrt();
        let z = in_view.z * focal / self.focal * f64::from(own.size) / seen.size;
        let ray = camera.unproject(&seen.position, 1.0);
        let roll =
            UnitQuaternion::from_axis_angle(&Vec3::z_axis(), seen.orientation - f64::from(own.orientation));
        // Both rays to the optical axis, then the rotation about it.
        let to_axis = UnitQuaternion::rotation_between(&in_view, &Vec3::z())?;
        let from_axis = UnitQuaternion::rotation_between(&Vec3::z(), &ray)?;
        let rotation = from_axis * roll * to_axis * self.view_from_object.rotation();
        Some(Pose::new(rotation, ray * z - rotation * point))
    }
}

impl Match {
    /// Whether a pose agrees with the match, roughly: with the position of its point and the pose that it predicts.
    fn votes(&self, pose: &Pose, camera: &Camera, near: f64) -> bool {
        let seen = camera.project(&pose.transform_point(&self.point));
        let stretch = (self.pose.translation().z / pose.translation().z).ln().abs();
        seen.is_some_and(|p| (p - self.pixel).norm() < near)
            && stretch < STRETCH
            && self.pose.rotation_angle_to(pose) < ANGLE
    }
}

/// The point of a render at a keypoint, if all that the keypoint describes is on the object.
fn on_object(rendered: &Rendered, keypoint: &Keypoint) -> Option<Vec3> {
    let at = |p: Vec2| {
        let (x, y) = (p.x.round(), p.y.round());
        let inside = x >= 0.0 && y >= 0.0;
        let point = inside.then(|| rendered.coordinates.get(x as usize, y as usize)).flatten()?;
        (!point[0].is_nan()).then(|| Vec3::from(point.map(f64::from)))
    };
    let around = (0..8).all(|k| {
        let (sin, cos) = (f64::from(k) / 8.0 * TAU).sin_cos();
        at(keypoint.position + SUPPORT * keypoint.size * Vec2::new(cos, sin)).is_some()
    });
    if around { at(keypoint.position) } else { None }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use sixfold_render::{Light, Material, RenderOptions, SceneObject, shade};

    /// A box of 100 x 60 x 40 mm with random patches of colour on its sides.
    pub(crate) fn printed_box() -> Mesh {
        printed_box_with(|_, _| true)
    }

    /// The box; `drawn` tells for each axis and side whether new colours are drawn. Otherwise it repeats those of the side before,
    /// rotated by 180 degrees about the box's first axis.
    pub(crate) fn printed_box_with(drawn: impl Fn(usize, f64) -> bool) -> Mesh {
        let half = Vec3::new(0.05, 0.03, 0.02);
        let (mut vertices, mut faces, mut colors) = (vec![], vec![], vec![]);
        let mut print: Vec<[u8; 3]> = vec![];
        let mut state = 12_345u32;
        let mut random = move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        };
        for axis in 0..3 {
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            for side in [-1.0, 1.0] {
                let n = 18;
                if drawn(axis, side) {
                    print = (0..n * n).map(|_| [random(), random(), random()]).collect();
                } else {
                    // The half turn keeps the first axis and reverses both others.
                    let flip = |k: usize| {
                        if u == 0 { (n - 1 - k / n) * n + k % n } else { k / n * n + n - 1 - k % n }
                    };
                    print = (0..n * n).map(|k| print[flip(k)]).collect();
                }
                for (k, color) in print.iter().enumerate() {
                    let first = vertices.len() as u32;
                    for (i, j) in [(0, 0), (1, 0), (1, 1), (0, 1)] {
                        let at = |cell: usize| 2.0 * cell as f64 / n as f64 - 1.0;
                        let mut p = Vec3::zeros();
                        p[axis] = side * half[axis];
                        p[u] = at(k % n + i) * half[u];
                        p[v] = at(k / n + j) * half[v];
                        vertices.push(p);
                        colors.push(*color);
                    }
                    let [a, b] = if side > 0.0 { [1, 2] } else { [2, 1] };
                    faces.push([first, first + a, first + b]);
                    let [a, b] = if side > 0.0 { [2, 3] } else { [3, 2] };
                    faces.push([first, first + a, first + b]);
                }
            }
        }
        Mesh::new(vertices, faces).unwrap().with_colors(colors).unwrap()
    }

    /// An image of the box in front of grey.
    pub(crate) fn photograph(mesh: &Mesh, pose: &Pose, camera: &Camera) -> RgbImage {
        let mut frame = VisibilityBuffer::new(camera);
        let objects = [SceneObject { mesh, camera_from_object: *pose }];
        frame.render(&objects, &RenderOptions::default());
        let lights = [Light::Ambient { color: [0.8; 3] }];
        let background = RgbImage::filled(camera.width, camera.height, [120; 3]);
        shade(&frame, &objects, &lights, &Material::default(), Some(&background))
    }

    #[test]
    fn a_printed_object_is_found_anywhere_without_a_region() {
        let mesh = printed_box();
        let printed = Printed::of_mesh(&mesh, mesh.diameter());
        assert_eq!(printed.views.len(), VIEWS);
        let camera = Camera::new(700.0, 700.0, 319.5, 239.5, 640, 480).unwrap();
        // Rotated upside down, near a corner of the image, seen from a direction between those of the views.
        let truth =
            Pose::exp(&[0.0, 0.0, 0.0, 0.9, -0.7, 2.6].into()).with_translation(Vec3::new(0.12, -0.08, 0.5));
        let seen = ImageKeypoints::new(keypoints(&photograph(&mesh, &truth, &camera), PER_IMAGE));
        let matches = printed.matches(&seen, &camera);
        let found = matches.poses();
        let best = found.first().expect("a pose");
        let pose = best.camera_from_object;
        assert!(pose.distance_to(&truth) < 0.01 && pose.rotation_angle_to(&truth) < 0.05, "{pose:?}");
        assert!(best.inliers > 2 * FEWEST, "{}", best.inliers);
        // Keypoints agree with the right pose, and not with one that is rotated by 90 degrees or beside it.
        let rotated = truth * Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, 1.57].into());
        let beside = truth.with_translation(truth.translation() + Vec3::new(0.04, 0.0, 0.0));
        let [right, rotated, beside] = [truth, rotated, beside].map(|pose| matches.agreeing(&pose));
        assert!(right > 2 * FEWEST && rotated == 0 && beside == 0, "{right} {rotated} {beside}");
        // Only what is in a box is used.
        let elsewhere = seen.within(&Rect { x: 0.0, y: 300.0, width: 200.0, height: 180.0 });
        assert!(printed.matches(&elsewhere, &camera).poses().is_empty());
    }

    #[test]
    fn a_match_predicts_the_pose_whatever_the_rotation_in_the_image() {
        let mesh = printed_box();
        let printed = Printed::of_mesh(&mesh, mesh.diameter());
        let camera = Camera::new(700.0, 700.0, 319.5, 239.5, 640, 480).unwrap();
        for roll in [0.0, 1.5, 4.0] {
            let tilted = Pose::exp(&[0.0, 0.0, 0.0, 0.9, -0.7, 0.0].into());
            let rolled = Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, roll].into()) * tilted;
            let truth = rolled.with_translation(Vec3::new(0.03, -0.02, 0.5));
            let seen = ImageKeypoints::new(keypoints(&photograph(&mesh, &truth, &camera), PER_IMAGE));
            let matches = printed.matches(&seen, &camera).list;
            // Those whose keypoint shows the same point of the object.
            let right: Vec<&Match> = matches
                .iter()
                .filter(|m| {
                    let at = camera.project(&truth.transform_point(&m.point));
                    at.is_some_and(|p| (p - m.pixel).norm() < 3.0)
                })
                .collect();
            let near = |m: &&&Match| {
                m.pose.rotation_angle_to(&truth) < ANGLE
                    && m.pose.distance_to(&truth) < 0.2 * truth.translation().z
            };
            let predicted = right.iter().filter(near).count();
            assert!(right.len() >= 20, "{roll}: {}", right.len());
            // Views from far beside predict their own direction; with a wrong rotation no match predicts the pose.
            assert!(predicted * 10 >= right.len(), "{roll}: {predicted} of {}", right.len());
        }
    }

    #[test]
    fn an_object_without_colours_has_no_print_and_an_empty_image_no_poses() {
        let mesh = printed_box();
        let grey = Mesh::new(mesh.vertices().to_vec(), mesh.faces().to_vec()).unwrap();
        assert!(Printed::of_mesh(&grey, 0.12).views.is_empty());
        let camera = Camera::new(700.0, 700.0, 319.5, 239.5, 640, 480).unwrap();
        let empty = ImageKeypoints::new(keypoints(&RgbImage::filled(640, 480, [90; 3]), PER_IMAGE));
        let matches = Printed::of_mesh(&mesh, mesh.diameter()).matches(&empty, &camera);
        assert!(matches.poses().is_empty());
        assert_eq!(matches.agreeing(&Pose::identity()), 0);
    }

    #[test]
    fn descriptors_are_kept_in_bytes() {
        assert!((0..=255).all(|byte| to_byte(from_byte(byte)) == byte));
        assert_eq!((to_byte(0.0), to_byte(0.9)), (0, 255));
    }
}
