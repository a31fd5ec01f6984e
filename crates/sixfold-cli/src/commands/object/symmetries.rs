//! `sixfold object symmetries` and `sixfold object add --find-symmetries`: rotations that map an object onto itself, with evidence.

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use serde::Serialize;
use sixfold_geometry::{Image, Pose, RgbImage};
use sixfold_io::write_rgb;
use sixfold_mesh::{
    FoundSymmetry, Mesh, ModelInfo, SymmetryOptions, Unit, Verdict, find_symmetries, sure_symmetries,
};
use sixfold_plot::{Canvas, INK};
use sixfold_shell::output::{JsonArguments, pose_rows, report};
use sixfold_shell::{Outcome, objects, ranges};

use super::arguments::AddArguments;
use sixfold_render::portrait;

/// Height of the line of text over each image, pixels.
const CAPTION: usize = 26;
/// Image pixels of a glyph's pixel.
const TEXT: f64 = 4.0 / 3.0;
/// Images in a row.
const COLUMNS: usize = 4;
/// The fraction of a full turn by which the image of a continuous symmetry is rotated.
const SOME_TURN: f64 = 0.3;

/// `sixfold object symmetries`.
#[derive(Debug, Args)]
pub(crate) struct SymmetriesArguments {
    /// Mesh file or name of a stored object
    #[arg(value_name = "MESH_OR_NAME")]
    pub object: String,
    /// Unit of the mesh file: m, cm, mm, in
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// Noise of the mesh's surface, standard deviation in millimetres: 1 for a mesh from photographs or depth images
    #[arg(long, value_name = "MM", default_value_t = 0.0, value_parser = ranges::surface_noise)]
    pub noise: f64,
    /// Image to write: the object beside itself, rotated by each symmetry
    #[arg(long, value_name = "FILE.png")]
    pub out: Option<PathBuf>,
}

/// What is held against itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Evidence {
    /// The shape alone: for methods that see depth only
    Shape,
    /// Shape and, where the mesh has them, colours
    Colors,
}

/// A symmetry as JSON has it; lengths in metres.
#[derive(Debug, Serialize)]
pub(crate) struct Listed {
    axis: [f64; 3],
    point: [f64; 3],
    /// Rotations by multiples of a full turn over this; null: all rotations.
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

impl Listed {
    fn of(s: &FoundSymmetry) -> Listed {
        Listed {
            axis: s.axis.into(),
            point: s.point.into(),
            order: s.order,
            deviation_p95: s.deviation.p95,
            deviation_max: s.deviation.max,
            color_difference_mean: s.color.map(|c| c.mean),
            color_difference_p95: s.color.map(|c| c.p95),
            by_shape: s.by_shape.name(),
            by_shape_and_color: s.by_shape_and_color.name(),
            poses: s.poses().iter().map(pose_rows).collect(),
        }
    }
}

pub(crate) fn run(a: &SymmetriesArguments, store: &Path, json: &JsonArguments) -> Result<Outcome> {
    let object = objects::find(&a.object, a.unit, store)?;
    let found = find(&object.mesh, a.noise)?;
    if let Some(file) = &a.out {
        write_rgb(file, &picture(&object.mesh, &found))?;
    }
    let listed: Vec<Listed> = found.iter().map(Listed::of).collect();
    report(json, &listed, || table(&object.name, object.info.diameter, &found))?;
    Ok(if found.is_empty() { Outcome::NothingFound } else { Outcome::Found })
}

fn find(mesh: &Mesh, noise: f64) -> Result<Vec<FoundSymmetry>> {
    find_symmetries(mesh, &SymmetryOptions { noise: noise * 1e-3, ..SymmetryOptions::default() })
        .with_context(|| format!("--noise: found {noise} mm"))
}

/// Gives `info` the sure symmetries of a mesh, where `add --find-symmetries` asks for them; what it stores and what not, in words.
pub(crate) fn add_to(info: &mut ModelInfo, mesh: &Mesh, a: &AddArguments) -> Result<Vec<String>> {
    let Some(evidence) = a.find_symmetries else { return Ok(vec![]) };
    if info.is_symmetric() {
        bail!(
            "--find-symmetries: found symmetries of the object in --models-info already; leave out one of the two"
        );
    }
    let by_color = evidence == Evidence::Colors;
    let found = find(mesh, a.noise)?;
    (info.symmetries_discrete, info.symmetries_continuous) = sure_symmetries(&found, by_color);
    let line = |s: &FoundSymmetry| {
        let what = format!("{} ({})", in_words(s), evidence_in_words(s));
        match s.verdict(by_color) {
            Verdict::Sure => format!("stored: {what}"),
            Verdict::Likely => format!("likely, not stored: {what}"),
            Verdict::None => format!("not stored, colours differ: {what}"),
        }
    };
    let none = || vec!["no symmetry found".to_owned()];
    Ok(if found.is_empty() { none() } else { found.iter().map(line).collect() })
}

/// A number with some digits, without the sign of a zero.
fn rounded(number: f64, digits: usize) -> String {
    let text = format!("{number:.digits$}");
    let is_zero = text.bytes().all(|b| b"-0.".contains(&b));
    if is_zero { text.trim_start_matches('-').to_owned() } else { text }
}

fn in_words(s: &FoundSymmetry) -> String {
    let [x, y, z] = <[f64; 3]>::from(s.axis).map(|c| rounded(c, 3));
    let about = format!("about ({x}, {y}, {z})");
    match s.order {
        None => format!("any rotation {about}"),
        Some(order) => format!("order {order} {about}"),
    }
}

fn evidence_in_words(s: &FoundSymmetry) -> String {
    let color = s.color.map_or(String::new(), |c| format!(", colours differ by {:.2}", c.p95));
    format!("95 % of the surface within {:.2} mm of itself{color}", 1e3 * s.deviation.p95)
}

fn table(name: &str, diameter: f64, found: &[FoundSymmetry]) {
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

/// The object, and rotated by each symmetry.
fn picture(mesh: &Mesh, found: &[FoundSymmetry]) -> RgbImage {
    let mut images = vec![("as it is".to_owned(), portrait(mesh))];
    for s in found {
        let first = s.poses().first().copied();
        let turn = first.or_else(|| s.continuous().map(|c| c.rotation(SOME_TURN * TAU)));
        let rotated = mesh.transformed(&turn.unwrap_or_else(Pose::identity));
        let degrees = 360.0 * s.order.map_or(SOME_TURN, |n| 1.0 / f64::from(n));
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
