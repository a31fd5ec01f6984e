//! Output of an object's symmetries: a table, JSON, an image.

use std::f64::consts::TAU;

use serde::Serialize;
use sixfold_geometry::{Image, Pose, RgbImage};
use sixfold_mesh::{FoundSymmetry, Mesh};
use sixfold_plot::{Canvas, INK};
use sixfold_render::portrait;

/// Height of the line of text over each image, pixels.
const CAPTION: usize = 26;
/// Image pixels per font pixel.
const TEXT: f64 = 4.0 / 3.0;
/// Images in a row.
const COLUMNS: usize = 4;
/// Rotation with which a continuous symmetry is shown, as a fraction of a full turn.
const SHOWN_ROTATION: f64 = 0.3;

/// A symmetry as JSON has it; lengths in metres.
#[derive(Debug, Serialize)]
pub struct ListedSymmetry {
    axis: [f64; 3],
    point: [f64; 3],
    /// The symmetry holds for multiples of a full turn divided by this number; null: for all rotations.
    order: Option<u32>,
    deviation_p95: f64,
    deviation_max: f64,
    color_difference_mean: Option<f64>,
    color_difference_p95: Option<f64>,
    by_shape: &'static str,
    by_shape_and_color: &'static str,
    /// The rotations of a discrete symmetry.
    poses: Vec<[[f64; 4]; 4]>,
}

impl ListedSymmetry {
    /// The JSON form of a symmetry that was found.
    pub fn of(s: &FoundSymmetry) -> ListedSymmetry {
        ListedSymmetry {
            axis: s.axis.into(),
            point: s.point.into(),
            order: s.order,
            deviation_p95: s.deviation.p95,
            deviation_max: s.deviation.max,
            color_difference_mean: s.color.map(|c| c.mean),
            color_difference_p95: s.color.map(|c| c.p95),
            by_shape: s.by_shape.name(),
            by_shape_and_color: s.by_shape_and_color.name(),
            poses: s.poses().iter().map(Pose::rows).collect(),
        }
    }
}

/// A number with `digits` digits, without a negative zero.
fn rounded(number: f64, digits: usize) -> String {
    let text = format!("{number:.digits$}");
    let is_zero = text.bytes().all(|b| b"-0.".contains(&b));
    if is_zero { text.trim_start_matches('-').to_owned() } else { text }
}

/// A symmetry in words, with its evidence.
pub fn described(s: &FoundSymmetry) -> String {
    format!("{} ({})", order_and_axis(s), evidence(s))
}

fn order_and_axis(s: &FoundSymmetry) -> String {
    let [x, y, z] = <[f64; 3]>::from(s.axis).map(|c| rounded(c, 3));
    let about = format!("about ({x}, {y}, {z})");
    match s.order {
        None => format!("any rotation {about}"),
        Some(order) => format!("order {order} {about}"),
    }
}

fn evidence(s: &FoundSymmetry) -> String {
    let color = s.color.map_or(String::new(), |c| format!(", colours differ by {:.2}", c.p95));
    format!("95 % of the surface within {:.2} mm of itself{color}", 1e3 * s.deviation.p95)
}

/// Prints a table: a line for each symmetry.
pub fn table(name: &str, diameter: f64, found: &[FoundSymmetry]) {
    println!("{name}: diameter {:.1} mm, symmetries: {}", 1e3 * diameter, found.len());
    if found.is_empty() {
        return;
    }
    println!(
        "{:>5}  {:^22}  {:^21}  {:>14}  {:>14}  {:>7}  {:<8}  by shape and colour",
        "order", "axis", "point, mm", "95 %, mm (%)", "max, mm (%)", "colours", "by shape"
    );
    for s in found {
        let numbers = |v: [f64; 3], digits: usize, width: usize| {
            v.map(|c| format!("{:>width$}", rounded(c, digits))).join(" ")
        };
        let length = |l: f64| format!("{:.2} ({:.1})", 1e3 * l, 100.0 * l / s.diameter);
        println!(
            "{:>5}  {}  {}  {:>14}  {:>14}  {:>7}  {:<8}  {}",
            s.order.map_or("any".to_owned(), |n| n.to_string()),
            numbers(s.axis.into(), 3, 6),
            numbers((s.point * 1e3).into(), 1, 6),
            length(s.deviation.p95),
            length(s.deviation.max),
            s.color.map_or("-".to_owned(), |c| format!("{:.2}", c.p95)),
            s.by_shape.name(),
            s.by_shape_and_color.name(),
        );
    }
}

/// An image of the object, unchanged and rotated by each symmetry.
pub fn picture(mesh: &Mesh, found: &[FoundSymmetry]) -> RgbImage {
    let mut images = vec![("as it is".to_owned(), portrait(mesh))];
    for s in found {
        let first = s.poses().first().copied();
        let turn = first.or_else(|| s.continuous().map(|c| c.rotation(SHOWN_ROTATION * TAU)));
        let rotated = mesh.transformed(&turn.unwrap_or_else(Pose::identity));
        let degrees = 360.0 * s.order.map_or(SHOWN_ROTATION, |n| 1.0 / f64::from(n));
        let [x, y, z] = <[f64; 3]>::from(s.axis).map(|c| rounded(c, 2));
        let colors = s.color.map_or(String::new(), |_| format!(", colours {}", s.by_shape_and_color.name()));
        let caption = format!("{degrees:.0} degrees about {x} {y} {z}: shape {}{colors}", s.by_shape.name());
        images.push((caption, portrait(&rotated)));
    }
    let side = images[0].1.width();
    let columns = images.len().min(COLUMNS);
    let rows = images.len().div_ceil(columns);
    let mut canvas = Canvas::new(columns * side, rows * (side + CAPTION));
    let corner = |i: usize| (i % columns * side, i / columns * (side + CAPTION));
    for (i, (caption, _)) in images.iter().enumerate() {
        let (left, top) = corner(i);
        canvas.text(left as f64 + 8.0, top as f64 + 8.0, TEXT, caption, INK);
    }
    let sheet = canvas.finish();
    Image::from_fn(sheet.width(), sheet.height(), |x, y| {
        let i = y / (side + CAPTION) * columns + x / side;
        match (images.get(i), (y % (side + CAPTION)).checked_sub(CAPTION)) {
            (Some((_, image)), Some(row)) => image[(x % side, row)],
            _ => sheet[(x, y)],
        }
    })
}
