//! Compares a rendering with a colour image: its outline with edges, its colours with the colours there.

use sixfold_geometry::{Camera, Image, Pose, Rect, RgbImage};
use sixfold_render::{Light, Material, RenderOptions, SceneObject, VisibilityBuffer, shade};
use sixfold_synth::augment::Patch;

use super::Shape;
use crate::outline::projected_box;
use crate::prepared::PreparedDepth;

/// Agreement of a pose with a colour image.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct ColorEvidence {
    /// Fraction of the outline on edges with the same direction, 0 to 1.
    pub edges: f64,
    /// The same at a distance from the outline, inside and outside the object: the level that clutter and texture reach without an
    /// outline.
    pub background_edges: f64,
    /// Correlation of the rendered colours with those of the image over all channels, -1 to 1; 0 if either hardly varies.
    pub correlation: f64,
    /// Distance of the mean colours without brightness (chromaticity, 0 to about 1); `None` for a mesh without colours.
    pub tint: Option<f64>,
}

/// Colour gradients of an image, computed once for all poses.
#[derive(Debug)]
pub struct ColorGradients(Image<[f32; 2]>);

/// Standard deviation of the blur before colours are compared, pixels: suppresses edges from noise. Chosen by hand; not swept.
const BLUR: f32 = 1.0;
/// Change from pixel to pixel (0 to 1) that counts as half an edge; chosen by hand, not swept.
const EDGE: f32 = 0.03;
/// Largest distance of an edge from the outline, pixels; chosen by hand, not swept.
const REACH: i32 = 2;
/// Distances from the outline at which background edges are measured, pixels; chosen by hand, not swept.
const BESIDE: [i32; 4] = [-11, -7, 7, 11];
/// Smallest standard deviation of colours (0 to 1) for which their correlation is computed; chosen by hand, not swept.
const MIN_VARIATION: f64 = 0.02;
/// Fewest pixels that are compared; chosen by hand, not swept.
const MIN_PIXELS: usize = 30;
/// Margin of the rendering around the projected bounding box, pixels.
const MARGIN: f64 = 2.0;

impl ColorGradients {
    /// The gradients of an image.
    pub fn new(image: &RgbImage) -> ColorGradients {
        let mut patch = Patch::from_rgb(image);
        patch.blur(BLUR);
        let (width, height) = image.size();
        let area = width * height;
        ColorGradients(Image::from_fn(width, height, |x, y| {
            let i = y * width + x;
            let (left, right) = (i - usize::from(x > 0), i + usize::from(x + 1 < width));
            let above = if y > 0 { i - width } else { i };
            let below = if y + 1 < height { i + width } else { i };
            let change = |c: usize| {
                let plane = &patch.data[c * area..(c + 1) * area];
                [0.5 * (plane[right] - plane[left]), 0.5 * (plane[below] - plane[above])]
            };
            let size = |g: &[f32; 2]| g[0] * g[0] + g[1] * g[1];
            (0..3).map(change).max_by(|a, b| size(a).total_cmp(&size(b))).unwrap_or_default()
        }))
    }

    /// Strength of the edge perpendicular to `normal` within `reach` of a position, 0 to 1; `None` outside the image.
    fn edge(&self, x: f64, y: f64, normal: [f64; 2], reach: i32) -> Option<f64> {
        let at = |step: i32| {
            let (x, y) = (x + f64::from(step) * normal[0], y + f64::from(step) * normal[1]);
            let (x, y) = (x.round(), y.round());
            if x < 0.0 || y < 0.0 {
                return None;
            }
            let [gx, gy] = *self.0.get(x as usize, y as usize)?;
            let change = gx * normal[0] as f32 + gy * normal[1] as f32;
            Some(f64::from(change * change / (change * change + EDGE * EDGE)))
        };
        (-reach..=reach).map(at).try_fold(0.0f64, |best, e| e.map(|e| best.max(e)))
    }
}

/// The image with which a pose is compared.
pub(super) struct ColorImage<'a> {
    pub camera: &'a Camera,
    pub image: &'a RgbImage,
    pub gradients: &'a ColorGradients,
    pub depth: Option<&'a PreparedDepth>,
}

/// Agreement with the image, and the pixels that the object covers; `None` if it covers too few.
pub(super) fn evidence_of(
    seen: &ColorImage<'_>,
    shape: &Shape<'_>,
    pose: &Pose,
) -> Option<(ColorEvidence, Vec<u32>)> {
    let camera = seen.camera;
    let bbox = projected_box(shape.mesh, camera, pose)?;
    let whole = Rect { x: 0.0, y: 0.0, width: camera.width as f64, height: camera.height as f64 };
    let (x0, y0) = ((bbox.x - MARGIN).floor(), (bbox.y - MARGIN).floor());
    let (x1, y1) = ((bbox.x + bbox.width + MARGIN).ceil(), (bbox.y + bbox.height + MARGIN).ceil());
    let part = Rect { x: x0, y: y0, width: x1 - x0, height: y1 - y0 }.intersect(&whole)?;
    let crop = camera.crop(&part);
    let mut frame = VisibilityBuffer::new(&crop);
    let objects = [SceneObject { mesh: shape.colored, camera_from_object: *pose }];
    frame.render(&objects, &RenderOptions::default());
    let (x0, y0) = (part.x as usize, part.y as usize);
    let (width, height) = (frame.width(), frame.height());
    let inverse = frame.inverse_depth();
    // Pixels where the depth image shows an occluder are hidden.
    let hidden = |x: usize, y: usize| {
        let Some(depth) = seen.depth else { return false };
        let measured = f64::from(depth.depth()[(x + x0, y + y0)]);
        measured > 0.0 && measured < 1.0 / f64::from(inverse[y * width + x]) - shape.threshold
    };
    let mut covered = vec![];
    let mut pairs: Vec<(usize, usize)> = vec![];
    let (mut edges, mut background_edges, mut outline, mut beside) = (0.0, 0.0, 0usize, 0usize);
    for y in 0..height {
        for x in 0..width {
            if inverse[y * width + x] <= 0.0 {
                continue;
            }
            covered.push(((y + y0) * camera.width + x + x0) as u32);
            if hidden(x, y) {
                continue;
            }
            pairs.push((x, y));
            let empty = |dx: isize, dy: isize| {
                let (x, y) = (x as isize + dx, y as isize + dy);
                let inside = x >= 0 && y >= 0 && (x as usize) < width && (y as usize) < height;
                inside && inverse[y as usize * width + x as usize] <= 0.0
            };
            let Some(normal) = outward(&empty) else { continue };
            let (px, py) = ((x + x0) as f64, (y + y0) as f64);
            if let Some(edge) = seen.gradients.edge(px, py, normal, REACH) {
                edges += edge;
                outline += 1;
            }
            for off in BESIDE {
                let (px, py) = (px + f64::from(off) * normal[0], py + f64::from(off) * normal[1]);
                if let Some(edge) = seen.gradients.edge(px, py, normal, REACH) {
                    background_edges += edge;
                    beside += 1;
                }
            }
        }
    }
    if pairs.len() < MIN_PIXELS {
        return None;
    }
    let rendered = shade(&frame, &objects, &Light::default_set(), &Material::default(), None);
    let colors = |image: &RgbImage, dx: usize, dy: usize| -> Vec<[f64; 3]> {
        pairs.iter().map(|&(x, y)| image[(x + dx, y + dy)].map(|c| f64::from(c) / 255.0)).collect()
    };
    let (rendered_colors, image_colors) = (colors(&rendered, 0, 0), colors(seen.image, x0, y0));
    let has_colors = shape.colored.colors().is_some() || shape.colored.texture().is_some();
    let evidence = ColorEvidence {
        edges: edges / outline.max(1) as f64,
        background_edges: background_edges / beside.max(1) as f64,
        correlation: correlation(&rendered_colors, &image_colors),
        tint: has_colors.then(|| tint(&rendered_colors, &image_colors)),
    };
    Some((evidence, covered))
}

/// The outward direction at a border pixel of the object; `empty` returns whether a neighbour is background. `None` inside the
/// object.
fn outward(empty: &dyn Fn(isize, isize) -> bool) -> Option<[f64; 2]> {
    if !(empty(-1, 0) || empty(1, 0) || empty(0, -1) || empty(0, 1)) {
        return None;
    }
    let (mut x, mut y) = (0.0, 0.0);
    for dy in -2..=2isize {
        for dx in -2..=2isize {
            if empty(dx, dy) {
                x += dx as f64;
                y += dy as f64;
            }
        }
    }
    let length = f64::hypot(x, y);
    (length > 0.5).then(|| [x / length, y / length])
}

/// The mean of some colours.
fn mean(colors: &[[f64; 3]]) -> [f64; 3] {
    let count = colors.len().max(1) as f64;
    std::array::from_fn(|c| colors.iter().map(|color| color[c]).sum::<f64>() / count)
}

/// Pearson's correlation over pixels and channels, each channel relative to its own mean.
fn correlation(a: &[[f64; 3]], b: &[[f64; 3]]) -> f64 {
    let (mean_a, mean_b) = (mean(a), mean(b));
    let (mut product, mut square_a, mut square_b) = (0.0, 0.0, 0.0);
    for (a, b) in a.iter().zip(b) {
        for c in 0..3 {
            let (a, b) = (a[c] - mean_a[c], b[c] - mean_b[c]);
            product += a * b;
            square_a += a * a;
            square_b += b * b;
        }
    }
    let minimum = MIN_VARIATION * MIN_VARIATION * 3.0 * a.len() as f64;
    if square_a < minimum || square_b < minimum { 0.0 } else { product / (square_a * square_b).sqrt() }
}

/// Distance of the mean colours' chromaticities.
fn tint(a: &[[f64; 3]], b: &[[f64; 3]]) -> f64 {
    let chromaticity = |colors: &[[f64; 3]]| {
        let mean = mean(colors);
        let sum = mean.iter().sum::<f64>().max(1e-3);
        mean.map(|c| c / sum)
    };
    let (a, b) = (chromaticity(a), chromaticity(b));
    (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt()
}
