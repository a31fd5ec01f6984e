//! Images of a calibration: the photographs with the tags found in them, and the residuals.

use crate::overlay::{label, line};
use sixfold_geometry::{Camera, Image, Pose, RgbImage, Vec3};
use sixfold_plot::{COLORS, Canvas, FAINT, INK};

use super::Calibrated;
use super::photographs::{Photograph, THUMBNAIL};

const GOOD: [u8; 3] = [60, 220, 90];
const BAD: [u8; 3] = [255, 90, 60];
/// Length of the axes, metres.
const AXIS: f64 = 0.06;
/// Width of the image of residuals, pixels.
const WIDTH: f64 = 960.0;
/// Factor by which residuals are enlarged, in pixels of the photograph.
const ENLARGED: f64 = 100.0;

/// All photographs with the tags in them and the board's axes: x red, y green, z blue.
pub(super) fn photographs(all: &[Photograph], found: &Calibrated, poses: &[Option<Pose>]) -> RgbImage {
    let columns = all.len().clamp(1, 4);
    let height = all.iter().map(|p| p.thumbnail.height()).max().unwrap_or(1);
    let rows = all.len().div_ceil(columns);
    let mut sheet = Image::filled(columns * THUMBNAIL, rows * height, [30; 3]);
    for (i, (photograph, pose)) in all.iter().zip(poses).enumerate() {
        let listed = &found.photographs[i];
        let used = listed.left_out.is_none();
        let mut image = photograph.thumbnail.clone();
        let scale = image.width() as f64 / photograph.size.0.max(1) as f64;
        for tag in &photograph.tags {
            for k in 0..4 {
                let (a, b) = (tag.corners[k] * scale, tag.corners[(k + 1) % 4] * scale);
                line(&mut image, [a.x, a.y], [b.x, b.y], if used { GOOD } else { BAD });
            }
        }
        if let (true, Some(pose)) = (used, pose) {
            axes(&mut image, &found.camera, pose, scale);
        }
        let name = photograph.file.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let text = match &listed.rms_px {
            Some(rms) => format!("{name} {rms:.2} px"),
            None => format!("{name} left out"),
        };
        label(&mut image, [8.0, 20.0], &text, if used { GOOD } else { BAD });
        let (left, top) = (i % columns * THUMBNAIL, i / columns * height);
        for y in 0..image.height() {
            for (x, pixel) in image.row(y).iter().enumerate() {
                sheet[(left + x, top + y)] = *pixel;
            }
        }
    }
    sheet
}

fn axes(image: &mut RgbImage, camera: &Camera, camera_from_board: &Pose, scale: f64) {
    let seen = |p: &Vec3| {
        camera.project(&camera_from_board.transform_point(p)).map(|p| camera.distort_point(&p) * scale)
    };
    let Some(origin) = seen(&Vec3::zeros()) else { return };
    for (axis, color) in [(Vec3::x(), [255, 60, 60]), (Vec3::y(), [60, 255, 60]), (Vec3::z(), [80, 130, 255])]
    {
        if let Some(end) = seen(&(axis * AXIS)) {
            // Three lines side by side: a single one would be hard to see among the tags.
            for d in [-1.0, 0.0, 1.0] {
                line(image, [origin.x + d, origin.y], [end.x + d, end.y], color);
                line(image, [origin.x, origin.y + d], [end.x, end.y + d], color);
            }
        }
    }
}

/// The enlarged residuals of all corners at their positions in the photographs, one colour per photograph.
pub(super) fn residuals(found: &Calibrated) -> RgbImage {
    let scale = WIDTH / found.camera.width as f64;
    let (top, height) = (28.0, found.camera.height as f64 * scale);
    let mut canvas = Canvas::new(WIDTH as usize, (top + height).ceil() as usize);
    let text = format!("rms {:.3} pixels; lines are residuals, {ENLARGED} times as long", found.rms_px);
    canvas.text(8.0, 8.0, 1.5, &text, INK);
    canvas.line((0.0, top), (WIDTH, top), 1.0, FAINT);
    for (i, photograph) in found.photographs.iter().enumerate() {
        let color = COLORS[i % COLORS.len()];
        for corner in &photograph.corners {
            let at = (corner.pixel[0] * scale, top + corner.pixel[1] * scale);
            let end =
                (at.0 + ENLARGED * scale * corner.residual[0], at.1 + ENLARGED * scale * corner.residual[1]);
            canvas.line(at, end, 1.0, color);
            canvas.line(at, at, 3.0, color);
        }
    }
    canvas.finish()
}
