//! Images of poses: the object's silhouette, tinted surface and axes over the image.

use sixfold_bop::{Detection, Rle};
use sixfold_geometry::{Camera, DepthImage, Image, Pose, RgbImage, Vec3};
use sixfold_mesh::Mesh;
use sixfold_plot::text_dots;
use sixfold_render::{RenderOptions, SceneObject, VisibilityBuffer};

/// Colours that differ on screens and for most eyes (Okabe and Ito 2008).
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
    let at =
        |share: f64| valid.get((share * (valid.len().max(1) - 1) as f64) as usize).copied().unwrap_or(1.0);
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

/// Tints pixels (numbers `y * width + x`).
pub fn tint(image: &mut RgbImage, pixels: &[u32], color: [u8; 3]) {
    for &p in pixels {
        if let Some(pixel) = image.as_mut_slice().get_mut(p as usize) {
            *pixel = std::array::from_fn(|k| (0.5 * f32::from(pixel[k]) + 0.5 * f32::from(color[k])) as u8);
        }
    }
}

/// One pose to be drawn.
pub struct Drawn<'a> {
    /// Metres.
    pub mesh: &'a Mesh,
    /// Where it is.
    pub camera_from_object: Pose,
    /// Of its surface and silhouette.
    pub color: [u8; 3],
}

/// Draws poses over an image of the camera's size.
pub fn draw(image: &RgbImage, camera: &Camera, poses: &[Drawn<'_>]) -> RgbImage {
    let mut out = image.clone();
    let mut frame = VisibilityBuffer::new(camera);
    // Far ones first, so that what is in front is drawn last.
    let mut order: Vec<&Drawn<'_>> = poses.iter().collect();
    order.sort_by(|a, b| {
        b.camera_from_object.translation().z.total_cmp(&a.camera_from_object.translation().z)
    });
    for pose in order {
        let objects = [SceneObject { mesh: pose.mesh, camera_from_object: pose.camera_from_object }];
        frame.render(&objects, &RenderOptions::default());
        let normals = frame.normals(&objects);
        let mask = frame.mask(0);
        let inside = |x: isize, y: isize| {
            x >= 0 && y >= 0 && mask.get(x as usize, y as usize).copied().unwrap_or(false)
        };
        for y in 0..out.height() {
            for x in 0..out.width() {
                if !mask[(x, y)] {
                    continue;
                }
                let (ix, iy) = (x as isize, y as isize);
                let border = (1..=2).any(|r| {
                    !inside(ix - r, iy) || !inside(ix + r, iy) || !inside(ix, iy - r) || !inside(ix, iy + r)
                });
                let shade = 0.45 + 0.55 * normals[(x, y)][2].abs();
                let pixel = &mut out[(x, y)];
                for (channel, color) in pixel.iter_mut().zip(pose.color) {
                    let c = f32::from(color);
                    let mixed = if border { c } else { 0.55 * f32::from(*channel) + 0.45 * c * shade };
                    *channel = mixed.clamp(0.0, 255.0) as u8;
                }
            }
        }
        let (low, high) = pose.mesh.bounding_box();
        let length = (high - low).amax() * 0.5;
        let origin = pose.camera_from_object.transform_point(&((low + high) * 0.5));
        for (axis, color) in
            [(Vec3::x(), [255, 40, 40]), (Vec3::y(), [40, 220, 40]), (Vec3::z(), [60, 90, 255])]
        {
            let tip = origin + pose.camera_from_object.transform_direction(&axis) * length;
            if let (Some(a), Some(b)) = (camera.project(&origin), camera.project(&tip)) {
                line(&mut out, [a.x, a.y], [b.x, b.y], color);
            }
        }
    }
    out
}

fn line(image: &mut RgbImage, a: [f64; 2], b: [f64; 2], color: [u8; 3]) {
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

/// A box of two pixels' width: left, top, right, bottom.
pub fn rectangle(image: &mut RgbImage, [left, top, right, bottom]: [f64; 4], color: [u8; 3]) {
    let corners = [[left, top], [right, top], [right, bottom], [left, bottom]];
    for i in 0..4 {
        line(image, corners[i], corners[(i + 1) % 4], color);
    }
}

/// A small text on a coloured ground whose lower left corner is at a point, kept within the image.
pub fn label(image: &mut RgbImage, [x, y]: [f64; 2], text: &str, color: [u8; 3]) {
    let (width, height) = (6 * text.chars().count() + 1, 10);
    let (columns, rows) = image.size();
    let left = (x.max(0.0) as usize).min(columns.saturating_sub(width));
    let top = ((y.max(0.0) as usize).saturating_sub(height)).min(rows.saturating_sub(height));
    let mut set = |x: usize, y: usize, color: [u8; 3]| {
        if x < columns && y < rows {
            image[(x, y)] = color;
        }
    };
    for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
        set(left + x, top + y, color);
    }
    for (x, y) in text_dots(text) {
        set(left + 1 + x, top + 1 + y, [0; 3]);
    }
}

/// Detections over an image, boxes and tinted masks, the best on top.
pub fn detections_over(image: &RgbImage, found: &[Detection]) -> RgbImage {
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
            rectangle(&mut out, [b.x, b.y, b.x + b.width, b.y + b.height], color);
        }
    }
    for d in found.iter().rev() {
        if let Some(b) = d.bbox {
            let text = format!("{} {:.2}", d.category_id, d.score);
            label(&mut out, [b.x, b.y], &text, color(d.category_id as usize));
        }
    }
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

/// Normalised object coordinates as an image: -1..1 to 0..255 per axis; black where nothing is seen.
pub fn coordinate_picture(coordinates: &Image<[f32; 3]>) -> RgbImage {
    coordinates
        .map(|c| if c[0].is_nan() { [0; 3] } else { c.map(|v| (127.5 * (v + 1.0)).clamp(0.0, 255.0) as u8) })
}
