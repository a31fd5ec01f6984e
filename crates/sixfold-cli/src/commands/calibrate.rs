//! `sixfold calibrate`: a camera's intrinsics and poses from photographs of the board.

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Args;
use sixfold_board::CalibrationOptions;
use sixfold_io::CameraFile;
use sixfold_shell::Outcome;
use sixfold_shell::board::{Calibrated, photograph_files, read_photographs, ruler_in_metres};
use sixfold_shell::folder::OutputFolder;
use sixfold_shell::output::{JsonArguments, report};

#[derive(Debug, Args)]
pub(crate) struct CalibrateArguments {
    /// Photographs of the board (PNG, JPEG), or folders of them
    #[arg(required = true, value_name = "PHOTOGRAPHS")]
    pub photographs: Vec<PathBuf>,
    /// Use the intrinsics of this file, and compute only poses
    #[arg(long, value_name = "FILE", conflicts_with_all = ["pinhole", "wide"])]
    pub camera: Option<PathBuf>,
    /// Measured length of the printed ruler, millimetres (default: 100)
    #[arg(long, value_name = "MM")]
    pub ruler: Option<f64>,
    /// Estimate no lens distortion
    #[arg(long, conflicts_with = "wide")]
    pub pinhole: bool,
    /// Also estimate the distortion coefficient k3, for wide lenses
    #[arg(long)]
    pub wide: bool,
    /// Folder for the camera file, the poses and the images
    #[arg(long, value_name = "DIR", default_value = "out/calibration")]
    pub out: PathBuf,
    #[command(flatten)]
    pub json: JsonArguments,
}

pub(crate) fn run(a: &CalibrateArguments) -> Result<Outcome> {
    let ruler = ruler_in_metres(a.ruler)?;
    let known = a.camera.as_deref().map(CameraFile::read).transpose()?;
    let files = photograph_files(&a.photographs)?;
    let mut folder = OutputFolder::take(&a.out)?;
    let mut photographs = read_photographs(&files)?;
    let unreadable = photographs.iter().any(|p| p.unreadable);
    let options = CalibrationOptions { distortion: !a.pinhole, third_radial: a.wide };
    let mut found = Calibrated::of(&mut photographs, ruler, known.as_ref(), &options)?;
    let used = found.used();
    if used > 0 {
        let camera = serde_json::to_string_pretty(&found.calibrated.camera)?;
        let all = serde_json::to_string_pretty(&found.calibrated)?;
        folder.write_rgb("photographs.png", &found.overview(&photographs))?;
        folder.write_rgb("residuals.png", &found.residuals())?;
        folder.write_text("camera.json", &format!("{camera}\n"))?;
        folder.write_text("photographs.json", &format!("{all}\n"))?;
    }
    found.calibrated.photographs.iter_mut().for_each(|photograph| photograph.corners.clear());
    report(&a.json, &found.calibrated, || print(&found.calibrated, &a.out, used))?;
    Ok(match (used, unreadable) {
        (0, _) => Outcome::NothingFound,
        (_, true) => Outcome::Incomplete,
        _ => Outcome::Found,
    })
}

fn print(found: &Calibrated, out: &Path, used: usize) {
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
