//! Images of poses: the object's silhouette, tinted surface, axes, name and confidence over the image. Uncertain poses have a
//! thin, dashed outline and a dark label.

use std::collections::BTreeMap;

use sixfold_bop::{Detection, Rle};
use sixfold_estimator::PoseEstimate;
use sixfold_geometry::{Camera, DepthImage, Image, Mask, Pose, RgbImage, Vec3};
use sixfold_mesh::Mesh;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

use crate::labels::{Corners, Label, draw_labels};

/// Colours that most people, including colour-blind ones, can distinguish (Okabe and Ito 2008).
const COLORS: [[u8; 3]; 8] = [
    [230, 159, 0],
    [86, 180, 233],
    [0, 158, 115],
    [240, 228, 66],
    [213, 94, 0],
    [204, 121, 167],
    [0, 114, 178],
    [160, 110, 60],
];

/// The colour of object number `index`.
pub fn color(index: usize) -> [u8; 3] {
    COLORS[index % COLORS.len()]
}

/// Depth as an image, near light and far dark; black where nothing was measured.
pub fn depth_picture(depth: &DepthImage) -> RgbImage {
    let mut valid: Vec<f32> = depth.as_slice().iter().copied().filter(|&z| z > 0.0).collect();
    valid.sort_by(f32::total_cmp);
    let at = |fraction: f64| {
        valid.get((fraction * (valid.len().max(1) - 1) as f64) as usize).copied().unwrap_or(1.0)
    };
    let (near, far) = (at(0.02), at(0.98));
    depth.map(|&z| {
        if z <= 0.0 {
            return [0; 3];
        }
        let t = ((z - near) / (far - near).max(1e-6)).clamp(0.0, 1.0);
        [(230.0 - 190.0 * t) as u8; 3]
    })
}

/// Two depth images as one image, left and right in the same shades.
pub fn side_by_side(left: &DepthImage, right: &DepthImage) -> RgbImage {
    let gap = 4;
    let start = left.width() + gap;
    let (width, height) = (start + right.width(), left.height().max(right.height()));
    let both = DepthImage::from_fn(width, height, |x, y| match x.checked_sub(start) {
        Some(x) => right.get(x, y).copied().unwrap_or(0.0),
        None => left.get(x, y).copied().unwrap_or(0.0),
    });
    let mut picture = depth_picture(&both);
    for y in 0..height {
        for x in left.width()..start {
            picture[(x, y)] = [255; 3];
        }
    }
    picture
}

/// Below this confidence an estimate is drawn as uncertain.
const SURE: f64 = 0.5;
/// Pixels of a dash with its gap.
const DASH: f64 = 12.0;
/// Width of an outline, pixels: of certain and of uncertain poses.
const OUTLINE: [usize; 2] = [2, 1];
/// Opacity of the surface's colour over the image: of certain and of uncertain poses.
const TINT: [f32; 2] = [0.45, 0.2];

/// The number that overlays show for an estimate, 0 to 1: its probability, or its confidence where the method computes no
/// probability.
pub fn certainty(estimate: &PoseEstimate) -> f64 {
    estimate.probability.unwrap_or(estimate.confidence)
}

/// The shape of an object in an image.
#[derive(Debug, Clone, Copy)]
pub enum Shape<'a> {
    /// A mesh in metres at a pose camera_from_object.
    Mesh(&'a Mesh, Pose),
    /// Pixels (numbers `y * width + x`) of an object that has no mesh.
    Pixels(&'a [u32]),
}

/// One pose to be drawn.
#[derive(Debug, Clone)]
pub struct Drawn<'a> {
    /// Its shape in the image.
    pub shape: Shape<'a>,
    /// Colour of its surface, silhouette and label.
    pub color: [u8; 3],
    /// Its name on the label.
    pub name: String,
    /// The number of its label, 0 to 1 ([`certainty`]).
    pub certainty: f64,
}

impl<'a> Drawn<'a> {
    /// A pose of a dataset's object.
    pub fn of_dataset(obj_id: u32, mesh: &'a Mesh, camera_from_object: Pose, certainty: f64) -> Drawn<'a> {
        Drawn {
            shape: Shape::Mesh(mesh, camera_from_object),
            color: color(obj_id as usize),
            name: object_name(obj_id),
            certainty,
        }
    }

    fn is_sure(&self) -> bool {
        self.certainty >= SURE
    }

    fn label(&self, of: Corners) -> Label {
        Label { text: caption(&self.name, self.certainty), of, color: self.color, is_sure: self.is_sure() }
    }
}

/// The name on labels for an object that has only a number.
fn object_name(obj_id: u32) -> String {
    format!("obj {obj_id}")
}

/// Name and number as a label shows them.
pub fn caption(name: &str, certainty: f64) -> String {
    format!("{name} {certainty:.2}")
}

/// Draws poses over an image of the camera's size: surface, silhouette, axes, and a label with name and certainty that covers no
/// other label.
pub fn draw(image: &RgbImage, camera: &Camera, poses: &[Drawn<'_>]) -> RgbImage {
    let mut out = image.clone();
    let mut frame = VisibilityBuffer::new(camera);
    // Far objects first, so that near ones are drawn over them; masks before all others.
    let depth = |d: &Drawn<'_>| match d.shape {
        Shape::Mesh(_, pose) => pose.translation().z,
        Shape::Pixels(_) => f64::INFINITY,
    };
    let mut order: Vec<&Drawn<'_>> = poses.iter().collect();
    order.sort_by(|a, b| depth(b).total_cmp(&depth(a)));
    let mut labels = vec![];
    for pose in order {
        let mask = match pose.shape {
            Shape::Mesh(mesh, camera_from_object) => {
                let objects = [SceneObject { mesh, camera_from_object }];
                frame.render(&objects, &RenderOptions::default());
                let normals = frame.normals(&objects);
                let mask = frame.mask(0);
                surface(&mut out, &mask, pose, |x, y| 0.45 + 0.55 * normals[(x, y)][2].abs());
                axes(&mut out, camera, mesh, &camera_from_object);
                mask
            }
            Shape::Pixels(pixels) => {
                let mut mask = Mask::filled(out.width(), out.height(), false);
                for &p in pixels {
                    if let Some(pixel) = mask.as_mut_slice().get_mut(p as usize) {
                        *pixel = true;
                    }
                }
                surface(&mut out, &mask, pose, |_, _| 1.0);
                mask
            }
        };
        // An object outside the image has no label.
        labels.extend(corners(&mask).map(|of| (pose.certainty, pose.label(of))));
    }
    // The most certain labels are placed first.
    labels.sort_by(|a, b| b.0.total_cmp(&a.0));
    let labels: Vec<Label> = labels.into_iter().map(|l| l.1).collect();
    draw_labels(&mut out, &labels);
    out
}

/// The smallest box that holds a mask; none for an empty one.
fn corners(mask: &Mask) -> Option<Corners> {
    let (width, mut low, mut high) = (mask.width(), [usize::MAX; 2], [0; 2]);
    for (i, _) in mask.as_slice().iter().enumerate().filter(|(_, inside)| **inside) {
        let (x, y) = (i % width, i / width);
        (low, high) = ([low[0].min(x), low[1].min(y)], [high[0].max(x), high[1].max(y)]);
    }
    (low[0] <= high[0]).then(|| [low[0] as f64, low[1] as f64, (high[0] + 1) as f64, (high[1] + 1) as f64])
}

/// Tints the pixels of a mask and draws its outline: solid for certain poses, thin and dashed for uncertain ones.
fn surface(image: &mut RgbImage, mask: &Mask, pose: &Drawn<'_>, shade: impl Fn(usize, usize) -> f32) {
    let Some([left, top, right, bottom]) = corners(mask) else { return };
    let sure = usize::from(!pose.is_sure());
    let (width, tint) = (OUTLINE[sure] as isize, TINT[sure]);
    let inside =
        |x: isize, y: isize| x >= 0 && y >= 0 && mask.get(x as usize, y as usize).copied().unwrap_or(false);
    // Dashes are angular sectors about the box's centre, sized to give about the wanted length along the outline.
    let centre = [0.5 * (left + right), 0.5 * (top + bottom)];
    let dashes = (2.0 * (right - left + bottom - top) / DASH).round().max(4.0);
    let is_gap = |x: usize, y: usize| {
        let angle = (y as f64 - centre[1]).atan2(x as f64 - centre[0]) / std::f64::consts::TAU;
        !pose.is_sure() && (dashes * angle).rem_euclid(1.0) < 0.5
    };
    for (x, y) in (top as usize..bottom as usize)
        .flat_map(|y| (left as usize..right as usize).map(move |x| (x, y)))
        .filter(|at| mask[*at])
    {
        let (ix, iy) = (x as isize, y as isize);
        let border = (1..=width).any(|r| {
            !inside(ix - r, iy) || !inside(ix + r, iy) || !inside(ix, iy - r) || !inside(ix, iy + r)
        });
        let shade = shade(x, y);
        for (channel, color) in image[(x, y)].iter_mut().zip(pose.color) {
            let c = f32::from(color);
            let mixed = if border && !is_gap(x, y) {
                c
            } else {
                (1.0 - tint) * f32::from(*channel) + tint * c * shade
            };
            *channel = mixed.clamp(0.0, 255.0) as u8;
        }
    }
}

/// The axes of an object's frame from the centre of its box: x red, y green, z blue.
fn axes(image: &mut RgbImage, camera: &Camera, mesh: &Mesh, camera_from_object: &Pose) {
    let (low, high) = mesh.bounding_box();
    let length = (high - low).amax() * 0.5;
    let origin = camera_from_object.transform_point(&((low + high) * 0.5));
    for (axis, color) in [(Vec3::x(), [255, 40, 40]), (Vec3::y(), [40, 220, 40]), (Vec3::z(), [60, 90, 255])]
    {
        let tip = origin + camera_from_object.transform_direction(&axis) * length;
        if let (Some(a), Some(b)) = (camera.project(&origin), camera.project(&tip)) {
            line(image, [a.x, a.y], [b.x, b.y], color);
        }
    }
}

/// A line of two pixels' width.
/// A line between two pixels, clipped to the image.
pub fn line(image: &mut RgbImage, a: [f64; 2], b: [f64; 2], color: [u8; 3]) {
    let steps = (b[0] - a[0]).abs().max((b[1] - a[1]).abs()).ceil().clamp(1.0, 4000.0);
    for i in 0..=steps as usize {
        let t = i as f64 / steps;
        let (x, y) = (a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1]));
        for (dx, dy) in [(0, 0), (1, 0), (0, 1)] {
            let (px, py) = (x.round() as i64 + dx, y.round() as i64 + dy);
            if px >= 0 && py >= 0 && (px as usize) < image.width() && (py as usize) < image.height() {
                image[(px as usize, py as usize)] = color;
            }
        }
    }
}

/// The corners of a box with its outline, dashed where it is uncertain.
fn rectangle(image: &mut RgbImage, [left, top, right, bottom]: Corners, color: [u8; 3], is_sure: bool) {
    let corners = [[left, top], [right, top], [right, bottom], [left, bottom]];
    for i in 0..4 {
        let (a, b) = (corners[i], corners[(i + 1) % 4]);
        if is_sure {
            line(image, a, b, color);
            continue;
        }
        let dashes = ((b[0] - a[0]).hypot(b[1] - a[1]) / DASH).ceil().clamp(1.0, 1000.0);
        let at = |t: f64| [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];
        for dash in 0..dashes as usize {
            line(image, at(dash as f64 / dashes), at((dash as f64 + 0.5) / dashes), color);
        }
    }
}

/// A small text on a coloured background with its lower left corner at a point, moved to stay within the image.
pub fn label(image: &mut RgbImage, [x, y]: [f64; 2], text: &str, color: [u8; 3]) {
    let centre = x + 0.5 * (6 * text.chars().count() + 2) as f64;
    let label = Label { text: text.into(), of: [centre, y, centre, y], color, is_sure: true };
    draw_labels(image, &[label]);
}

/// Detections over an image, boxes and tinted masks with the object's name (or number) and score, the best on top.
pub fn detections_over(image: &RgbImage, found: &[Detection], names: &BTreeMap<u32, String>) -> RgbImage {
    let name = |id: u32| names.get(&id).cloned().unwrap_or_else(|| object_name(id));
    let mut out = image.clone();
    for d in found.iter().rev() {
        let color = color(d.category_id as usize);
        if let Some(mask) = d.segmentation.as_ref().map(Rle::decode) {
            for (pixel, inside) in out.as_mut_slice().iter_mut().zip(mask.as_slice()) {
                if *inside {
                    for (channel, tint) in pixel.iter_mut().zip(color) {
                        *channel = ((u16::from(*channel) + u16::from(tint)) / 2) as u8;
                    }
                }
            }
        }
        if let Some(b) = d.bbox {
            rectangle(&mut out, [b.x, b.y, b.x + b.width, b.y + b.height], color, d.score >= SURE);
        }
    }
    let mut order: Vec<&Detection> = found.iter().collect();
    order.sort_by(|a, b| b.score.total_cmp(&a.score));
    let labels: Vec<Label> = order
        .into_iter()
        .filter_map(|d| {
            let b = d.bbox?;
            Some(Label {
                text: caption(&name(d.category_id), d.score),
                of: [b.x, b.y, b.x + b.width, b.y + b.height],
                color: color(d.category_id as usize),
                is_sure: d.score >= SURE,
            })
        })
        .collect();
    draw_labels(&mut out, &labels);
    out
}

/// Unit normals as the usual image: x, y, z from -1..1 to red, green, blue; black where unknown.
pub fn normal_picture(normals: &Image<[f32; 3]>) -> RgbImage {
    normals.map(
        |n| {
            if *n == [0.0; 3] { [0; 3] } else { [n[0], n[1], -n[2]].map(|c| (127.5 * (c + 1.0)) as u8) }
        },
    )
}

/// Normalised object coordinates as an image: -1..1 to 0..255 per axis; black where there is no object.
pub fn coordinate_picture(coordinates: &Image<[f32; 3]>) -> RgbImage {
    coordinates
        .map(|c| if c[0].is_nan() { [0; 3] } else { c.map(|v| (127.5 * (v + 1.0)).clamp(0.0, 255.0) as u8) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::Rect;

    const COLOR: [u8; 3] = [230, 159, 0];

    fn camera() -> Camera {
        Camera::new(300.0, 300.0, 79.5, 59.5, 160, 120).unwrap()
    }

    /// A square of 10 cm that faces the camera.
    fn square() -> Mesh {
        let corners = [[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]];
        let vertices = corners.map(|[x, y]| Vec3::new(x, y, 0.0)).to_vec();
        Mesh::new(vertices, vec![[0, 2, 1], [0, 3, 2]]).unwrap()
    }

    fn drawn(mesh: &Mesh, x: f64, certainty: f64) -> Drawn<'_> {
        let pose = Pose::from_translation(Vec3::new(x, 0.0, 0.6));
        Drawn { shape: Shape::Mesh(mesh, pose), color: COLOR, name: "mug".into(), certainty }
    }

    fn count(image: &RgbImage, color: [u8; 3]) -> usize {
        image.as_slice().iter().filter(|p| **p == color).count()
    }

    /// The column left of the square's centre, from above its edge to below: on the outline only.
    fn left_edge(image: &RgbImage) -> Vec<bool> {
        (36..84).map(|y| image[(55, y)] == COLOR).collect()
    }

    #[test]
    fn an_uncertain_pose_has_a_dashed_outline_and_a_fainter_surface() {
        let mesh = square();
        let image = RgbImage::filled(160, 120, [0; 3]);
        let sure = draw(&image, &camera(), &[drawn(&mesh, 0.0, 0.51)]);
        let uncertain = draw(&image, &camera(), &[drawn(&mesh, 0.0, 0.49)]);
        assert!(left_edge(&sure).iter().all(|set| *set));
        let (set, gaps): (Vec<bool>, Vec<bool>) = left_edge(&uncertain).into_iter().partition(|set| *set);
        assert!(set.len() > 10 && gaps.len() > 10, "{} {}", set.len(), gaps.len());
        let inside = |image: &RgbImage| image[(64, 70)][0];
        assert!(inside(&uncertain) > 20 && inside(&uncertain) < inside(&sure), "{}", inside(&uncertain));
    }

    #[test]
    fn every_pose_has_its_own_label() {
        let mesh = square();
        let image = RgbImage::filled(160, 120, [0; 3]);
        let one = draw(&image, &camera(), &[drawn(&mesh, 0.0, 0.9)]);
        // Eight characters with a border, above the square: the letters are black on the label's background.
        let ground = (30..38).flat_map(|y| (55..104).map(move |x| (x, y))).filter(|at| one[*at] == COLOR);
        assert!(ground.count() > 150);
        let two = [drawn(&mesh, 0.0, 0.9), drawn(&mesh, 0.002, 0.8)];
        let both = draw(&image, &camera(), &two);
        assert!(count(&both, COLOR) > count(&one, COLOR) + 200);
        // Outside the image there is no label.
        assert_eq!(draw(&image, &camera(), &[drawn(&mesh, 5.0, 0.9)]), image);
    }

    #[test]
    fn a_mask_represents_an_object_without_a_mesh() {
        let pixels: Vec<u32> = (50..70).flat_map(|y| (60..90).map(move |x| y * 160 + x)).collect();
        let image = RgbImage::filled(160, 120, [0; 3]);
        let shape = Shape::Pixels(&pixels);
        let out =
            draw(&image, &camera(), &[Drawn { shape, color: COLOR, name: "mug".into(), certainty: 0.7 }]);
        assert_eq!(out[(60, 55)], COLOR);
        assert_eq!(out[(70, 60)], COLOR.map(|c| (0.45 * f32::from(c)) as u8));
        assert_eq!(caption("mug", 0.7), "mug 0.70");
    }

    #[test]
    fn detections_carry_their_score_and_uncertain_ones_are_dashed() {
        let detection = |score| Detection {
            scene_id: 0,
            image_id: 0,
            category_id: 0,
            score,
            bbox: Some(Rect { x: 40.0, y: 40.0, width: 60.0, height: 60.0 }),
            segmentation: None,
            time: None,
        };
        let (image, none) = (RgbImage::filled(160, 120, [0; 3]), BTreeMap::new());
        let side = |score| {
            let out = detections_over(&image, &[detection(score)], &none);
            (45..95).filter(|y| out[(40, *y)] == color(0)).count()
        };
        assert_eq!(side(0.6), 50);
        assert!((15..40).contains(&side(0.4)), "{}", side(0.4));
        let both = detections_over(&image, &[detection(0.6), detection(0.4)], &none);
        let one = detections_over(&image, &[detection(0.6)], &none);
        // The second label of the same box is placed beside the first one.
        assert!(count(&both, [0; 3]) + 400 < count(&one, [0; 3]));
    }
}
