//! `sixfold calibrate`: a camera, and where it was, from photographs of the board.

mod pictures;
mod reading;

use std::path::PathBuf;

use anyhow::{Result, anyhow, bail};
use clap::Args;
use serde::Serialize;
use sixfold_board::{Board, BoardError, CalibrationOptions, Corner, Paper, board_pose, calibrate};
use sixfold_geometry::{Camera, Pose, Vec2};
use sixfold_io::CameraFile;
use sixfold_shell::Outcome;
use sixfold_shell::folder::OutputFolder;
use sixfold_shell::output::{JsonArguments, pose_rows, report};

use self::reading::Photograph;

#[derive(Debug, Args)]
pub(crate) struct CalibrateArguments {
    /// Photographs of the board (PNG, JPEG), or folders of them
    #[arg(required = true, value_name = "PHOTOGRAPHS")]
    pub photographs: Vec<PathBuf>,
    /// Keep this camera and find poses alone
    #[arg(long, value_name = "FILE", conflicts_with_all = ["pinhole", "wide"])]
    pub camera: Option<PathBuf>,
    /// What the ruler on the printed board measures, millimetres (default: 100)
    #[arg(long, value_name = "MM")]
    pub ruler: Option<f64>,
    /// Estimate no lens distortion
    #[arg(long, conflicts_with = "wide")]
    pub pinhole: bool,
    /// Estimate one coefficient of distortion more (k3), for wide lenses
    #[arg(long)]
    pub wide: bool,
    /// Folder for the camera file, the poses and the pictures
    #[arg(long, value_name = "DIR", default_value = "out/calibration")]
    pub out: PathBuf,
    #[command(flatten)]
    pub json: JsonArguments,
}

/// `photographs.json`.
#[derive(Serialize)]
struct Calibrated {
    paper: Paper,
    tag_side: f64,
    camera: Camera,
    /// Standard deviations of fx, fy, cx, cy, k1, k2, p1, p2, k3; absent for a given camera.
    #[serde(skip_serializing_if = "Option::is_none")]
    deviations: Option<[f64; 9]>,
    rms_px: f64,
    photographs: Vec<Listed>,
}

#[derive(Serialize)]
struct Listed {
    file: PathBuf,
    tags: usize,
    #[serde(skip_serializing_if = "Option::is_none")]
    camera_from_board: Option<[[f64; 4]; 4]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    rms_px: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    left_out: Option<String>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    corners: Vec<ListedCorner>,
}

#[derive(Serialize)]
struct ListedCorner {
    tag: usize,
    pixel: [f64; 2],
    residual: [f64; 2],
}

/// The board in a photograph that was used.
struct Used {
    camera_from_board: Pose,
    residuals: Vec<Vec2>,
    rms: f64,
}

/// What all photographs say together.
struct Solved {
    camera: Camera,
    deviations: Option<[f64; 9]>,
    rms: f64,
    views: Vec<Result<Used, String>>,
}

pub(crate) fn run(a: &CalibrateArguments) -> Result<Outcome> {
    let ruler = a.ruler.map(|mm| {
        let board = Board::new(Paper::A4).with_ruler(mm / 1000.0).map(|_| mm / 1000.0);
        board.ok_or_else(|| anyhow!("--ruler: found {mm}, expected 10 to 1000 millimetres"))
    });
    let ruler = ruler.transpose()?;
    let known = a.camera.as_deref().map(CameraFile::read).transpose()?;
    let files = reading::files(&a.photographs)?;
    let mut folder = OutputFolder::take(&a.out)?;
    let mut photographs = reading::read(&files)?;
    let unreadable = photographs.iter().any(|p| p.unreadable);
    let tags: Vec<_> = photographs.iter().flat_map(|p| p.tags.iter().cloned()).collect();
    let Some(board) = Board::of_tags(&tags) else {
        bail!(
            "no photograph shows a board of `sixfold board`; {}",
            reasons(photographs.iter().map(|p| (&p.file, p.left_out.as_deref())))
        );
    };
    let board = ruler.and_then(|ruler| board.with_ruler(ruler)).unwrap_or(board);
    let size = reading::leave_out_other_sizes(&mut photographs)?;
    let corners: Vec<Vec<Corner>> = photographs
        .iter()
        .map(|p| if p.left_out.is_none() { board.corners(&p.tags) } else { vec![] })
        .collect();
    let solved = match &known {
        Some(file) => with_camera(file, size, &corners)?,
        None => without_camera(a, size, &corners).map_err(|error| {
            let why = |p: &Photograph| p.left_out.clone();
            let reasons = reasons_of(&photographs, &corners, why);
            anyhow!("{error}{reasons}")
        })?,
    };
    let mut result = listed(&board, solved, &photographs, &corners);
    let found = result.0.photographs.iter().filter(|p| p.left_out.is_none()).count();
    if found > 0 {
        let (calibrated, views) = &result;
        let camera = serde_json::to_string_pretty(&calibrated.camera)?;
        let all = serde_json::to_string_pretty(calibrated)?;
        folder.write_rgb("photographs.png", &pictures::photographs(&photographs, calibrated, views))?;
        folder.write_rgb("residuals.png", &pictures::residuals(calibrated))?;
        folder.write_text("camera.json", &format!("{camera}\n"))?;
        folder.write_text("photographs.json", &format!("{all}\n"))?;
    }
    for photograph in &mut result.0.photographs {
        photograph.corners.clear();
    }
    report(&a.json, &result.0, || print(&result.0, &a.out, found))?;
    Ok(match (found, unreadable) {
        (0, _) => Outcome::NothingFound,
        (_, true) => Outcome::Incomplete,
        _ => Outcome::Found,
    })
}

/// Poses by a camera that is known.
fn with_camera(file: &CameraFile, size: (usize, usize), corners: &[Vec<Corner>]) -> Result<Solved> {
    let mut camera = file.camera;
    if file.sized {
        camera.check_image(size.0, size.1)?;
    } else {
        (camera.width, camera.height) = size;
        camera.check_whole_image()?;
    }
    let views: Vec<Result<Used, String>> = corners
        .iter()
        .map(|c| {
            let found = board_pose(c, &camera).map_err(|e| e.to_string())?;
            Ok(Used {
                camera_from_board: found.camera_from_board,
                residuals: found.residuals,
                rms: found.rms,
            })
        })
        .collect();
    let residuals: Vec<&Vec2> = views.iter().flatten().flat_map(|v| &v.residuals).collect();
    let sum: f64 = residuals.iter().map(|r| r.norm_squared()).sum();
    let rms = (sum / residuals.len().max(1) as f64).sqrt();
    Ok(Solved { camera, deviations: None, rms, views })
}

/// Camera and poses.
fn without_camera(
    a: &CalibrateArguments,
    size: (usize, usize),
    corners: &[Vec<Corner>],
) -> Result<Solved, BoardError> {
    let options = CalibrationOptions { distortion: !a.pinhole, third_radial: a.wide };
    let found = calibrate(corners, size, &options)?;
    let views = found.views.into_iter().map(|view| {
        let view = view.map_err(|e| e.to_string())?;
        Ok(Used { camera_from_board: view.camera_from_board, residuals: view.residuals, rms: view.rms })
    });
    let views = views.collect();
    Ok(Solved { camera: found.camera, deviations: Some(found.deviations), rms: found.rms, views })
}

/// What is written, and the pose of each photograph.
fn listed(
    board: &Board,
    solved: Solved,
    photographs: &[Photograph],
    corners: &[Vec<Corner>],
) -> (Calibrated, Vec<Option<Pose>>) {
    let poses = solved.views.iter().map(|v| v.as_ref().ok().map(|v| v.camera_from_board)).collect();
    let of = |((photograph, corners), view): ((&Photograph, &Vec<Corner>), &Result<Used, String>)| {
        let reason = photograph.left_out.clone().or_else(|| view.as_ref().err().cloned());
        let view = view.as_ref().ok().filter(|_| reason.is_none());
        let corner = |(c, r): (&Corner, &Vec2)| ListedCorner {
            tag: c.tag,
            pixel: [c.pixel.x, c.pixel.y],
            residual: [r.x, r.y],
        };
        Listed {
            file: photograph.file.clone(),
            tags: photograph.tags.len(),
            camera_from_board: view.map(|v| pose_rows(&v.camera_from_board)),
            rms_px: view.map(|v| v.rms),
            left_out: reason,
            corners: view.map_or_else(Vec::new, |v| corners.iter().zip(&v.residuals).map(corner).collect()),
        }
    };
    let calibrated = Calibrated {
        paper: board.paper(),
        tag_side: board.tag_side(),
        camera: solved.camera,
        deviations: solved.deviations,
        rms_px: solved.rms,
        photographs: photographs.iter().zip(corners).zip(&solved.views).map(of).collect(),
    };
    (calibrated, poses)
}

/// Why photographs cannot be used, for an error that ends everything.
fn reasons_of(
    photographs: &[Photograph],
    corners: &[Vec<Corner>],
    why: impl Fn(&Photograph) -> Option<String>,
) -> String {
    let reasons: Vec<(&PathBuf, Option<String>)> = photographs
        .iter()
        .zip(corners)
        .map(|(p, c)| {
            let few = (c.len() < 16).then(|| format!("{} tags", c.len() / 4));
            (&p.file, why(p).or(few))
        })
        .collect();
    let text = reasons_text(reasons.iter().map(|(f, r)| (*f, r.as_deref())));
    if text.is_empty() { text } else { format!("; {text}") }
}

fn reasons<'a>(of: impl Iterator<Item = (&'a PathBuf, Option<&'a str>)>) -> String {
    let text = reasons_text(of);
    if text.is_empty() { "show more of the board, sharp and well lit".to_owned() } else { text }
}

/// The first reasons, in one line.
fn reasons_text<'a>(of: impl Iterator<Item = (&'a PathBuf, Option<&'a str>)>) -> String {
    let all: Vec<String> =
        of.filter_map(|(file, reason)| reason.map(|r| format!("{}: {r}", file.display()))).collect();
    let mut text = all.iter().take(5).cloned().collect::<Vec<_>>().join("; ");
    if all.len() > 5 {
        text.push_str(&format!("; and {} more", all.len() - 5));
    }
    text
}

fn print(found: &Calibrated, out: &std::path::Path, used: usize) {
    println!("{:<40} {:>5} {:>9}", "photograph", "tags", "rms px");
    for p in &found.photographs {
        let name = p.file.display().to_string();
        match (&p.rms_px, &p.left_out) {
            (Some(rms), _) => println!("{name:<40} {:>5} {rms:>9.3}", p.tags),
            (None, reason) => {
                println!("{name:<40} {:>5}  left out: {}", p.tags, reason.as_deref().unwrap_or_default());
            }
        }
    }
    if used == 0 {
        println!("no photograph could be used");
        return;
    }
    let c = &found.camera;
    let plus_minus = |i: usize| found.deviations.map_or(String::new(), |d| format!(" +- {:.2}", d[i]));
    println!(
        "fx {:.2}{}, fy {:.2}{}, cx {:.2}{}, cy {:.2}{}",
        c.fx,
        plus_minus(0),
        c.fy,
        plus_minus(1),
        c.cx,
        plus_minus(2),
        c.cy,
        plus_minus(3)
    );
    if let Some(d) = &c.distortion {
        println!("k1 {:.5}, k2 {:.5}, p1 {:.5}, p2 {:.5}, k3 {:.5}", d.k1, d.k2, d.p1, d.p2, d.k3);
    }
    println!(
        "{used} of {} photographs, rms {:.3} pixels; {}",
        found.photographs.len(),
        found.rms_px,
        out.display()
    );
}
