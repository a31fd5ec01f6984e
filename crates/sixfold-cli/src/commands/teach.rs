//! `sixfold teach`: a new object from photographs of it, on the printed board or without one.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use serde::Serialize;
use sixfold_estimator::{Object, ObjectRecord, ObjectStore, PoseEstimator, StoreError};
use sixfold_io::{CameraFile, limits, read_regular, write_rgb};
use sixfold_mesh::{Unit, Verdict, read_mesh};
use sixfold_mttm::{MttmEstimator, ObjectTemplates, TEMPLATES_FILE, TemplateOptions};
use sixfold_ppf::PpfEstimator;
use sixfold_shell::Outcome;
use sixfold_shell::board::{Ends, photograph_files, ruler_in_metres};
use sixfold_shell::output::{JsonArguments, report};
use sixfold_shell::progress::Bar;
use sixfold_shell::ranges;
use sixfold_shell::symmetries::described;
use sixfold_teach::{By, KnownLength, SalientSegmenter, ShapeOptions, TeachOptions, Teaching, World};
use sixfold_views::estimator::ViewsEstimator;

pub(crate) const AFTER_HELP: &str = "Examples:\n  \
    sixfold board --out board.pdf                         # print it, stand the object on it, photograph it from all sides\n  \
    sixfold teach mug --photographs photographs\n  \
    sixfold teach mug --photographs colour --depth depth --depth-scale 1 --camera camera.json\n  \
    sixfold teach mug --photographs photographs --no-board --length 0.12 --ends a.jpg:812,640:1010,655 b.jpg:700,655:934,628\n  \
    sixfold teach mug --photographs photographs.json      # with poses, masks and depth from elsewhere\n  \
    sixfold estimate --rgb image.png --camera camera.json --object mug --method views --out out";

#[derive(Debug, Args)]
pub(crate) struct TeachArguments {
    /// Name of the object: letters, digits, - and _
    pub name: String,
    /// Photographs of the object, on the board but for --no-board (PNG, JPEG), or folders of them: 8 to 40, from all sides; or one JSON file that lists
    /// photographs with the object's pose in each, masks and depth (docs/teach.md), without a board
    #[arg(long, required = true, num_args = 1.., value_name = "DIR")]
    pub photographs: Vec<PathBuf>,
    /// Depth images from the same places (PNG, 16 bit), or folders of them, in the order of the photographs' names
    #[arg(long, num_args = 1.., value_name = "DIR", requires = "depth_scale")]
    pub depth: Vec<PathBuf>,
    /// Millimetres per unit of the depth images
    #[arg(long, value_name = "MM", requires = "depth", value_parser = ranges::depth_scale)]
    pub depth_scale: Option<f64>,
    /// Camera of the photographs (default: computed from them)
    #[arg(long, value_name = "FILE")]
    pub camera: Option<PathBuf>,
    /// Measured length of the printed ruler, millimetres (default: 100)
    #[arg(long, value_name = "MM")]
    pub ruler: Option<f64>,
    /// The photographs show no board: poses from what is around the object, which needs texture and stays in place; needs
    /// --length, or depth
    #[arg(long, conflicts_with = "ruler")]
    pub no_board: bool,
    /// Measured length between the two points of --ends, metres
    #[arg(long, value_name = "METRES", requires_all = ["no_board", "ends"], value_parser = ranges::length)]
    pub length: Option<f64>,
    /// Pixels at which a photograph shows both points of --length, for two or more photographs, from different sides; - for a
    /// point that it does not show
    #[arg(long, num_args = 1.., value_name = "PHOTOGRAPH:X,Y:X,Y", requires = "length")]
    pub ends: Vec<Ends>,
    /// Mesh of the object, to align with the photographs; without colours it gets theirs
    #[arg(long, value_name = "FILE", requires = "unit", conflicts_with = "hull_only")]
    pub mesh: Option<PathBuf>,
    /// Unit of the mesh file: m, cm, mm, in
    #[arg(long, value_name = "UNIT", requires = "mesh")]
    pub unit: Option<Unit>,
    /// Do not search for hollows by comparing photographs
    #[arg(long)]
    pub hull_only: bool,
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
    /// Replace an object of the same name
    #[arg(long)]
    pub replace: bool,
    /// Folder for masks, mesh and images; a stopped run resumes there (default: out/teach/NAME)
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Serialize)]
struct Taught<'a> {
    name: &'a str,
    #[serde(flatten)]
    record: &'a ObjectRecord,
    /// Photographs that are used.
    photographs: usize,
    left_out: Vec<LeftOut>,
    /// Fraction of the surface that no photograph shows.
    unseen: f64,
    /// Fraction of the object's pixels whose depth was measured, or found by comparing photographs.
    with_depth: f64,
    symmetries_proposed: Vec<String>,
    folder: &'a Path,
}

#[derive(Serialize)]
struct LeftOut {
    photograph: String,
    reason: String,
}

pub(crate) fn run(a: &TeachArguments) -> Result<Outcome> {
    let store = ObjectStore::new(&a.store);
    if let Err(error @ StoreError::Name(_)) = store.record(&a.name) {
        return Err(error.into());
    }
    if store.contains(&a.name) && !a.replace {
        bail!(
            "there is an object named {:?} in {} already: give --replace or another name",
            a.name,
            a.store.display()
        );
    }
    let out = a.out.clone().unwrap_or_else(|| Path::new("out/teach").join(&a.name));
    let mut teaching = opened(a, &out)?;
    let options = ShapeOptions { stereo: !a.hull_only, ..ShapeOptions::default() };
    let bar = Bar::stopped_by_interrupts("finding poses");
    teaching.locate(&bar)?;
    bar.finish();
    let bar = Bar::stopped_by_interrupts("finding the object");
    teaching.find_masks(&SalientSegmenter::shipped()?, &options, &bar)?;
    bar.finish();
    let bar = Bar::stopped_by_interrupts("making the mesh");
    teaching.reconstruct(&options, &bar)?;
    bar.finish();
    write_rgb(&out.join("photographs.png"), &teaching.picture()?)?;
    let stored = teaching.store(&store, &a.name, a.replace, prepare)?;
    let facts = teaching.shape().ok_or_else(|| anyhow!("{}: no mesh was made", out.display()))?;
    let proposed = stored.symmetries.iter().filter(|s| s.verdict(true) != Verdict::Sure);
    let taught = Taught {
        name: &a.name,
        record: &stored.record,
        photographs: stored.photographs,
        left_out: left_out(&teaching),
        unseen: facts.unseen,
        with_depth: facts.with_depth,
        symmetries_proposed: proposed.map(described).collect(),
        folder: &out,
    };
    report(&a.json, &taught, || print(&taught))?;
    Ok(Outcome::Found)
}

/// The folder with all that was given.
fn opened(a: &TeachArguments, out: &Path) -> Result<Teaching> {
    match a.photographs.as_slice() {
        [file] if file.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")) => {
            with_poses(a, file, out)
        }
        _ => without_poses(a, out),
    }
}

/// Photographs with poses, from a file.
fn with_poses(a: &TeachArguments, file: &Path, out: &Path) -> Result<Teaching> {
    if a.ruler.is_some() || a.camera.is_some() || !a.depth.is_empty() || a.no_board {
        bail!(
            "--ruler, --camera, --depth and --no-board belong to photographs without poses: {} names what it has",
            file.display()
        );
    }
    let mesh = a.mesh.as_ref().zip(a.unit).map(|(file, unit)| read_mesh(file, unit)).transpose()?;
    Ok(Teaching::open_file(out, file, mesh.as_ref())?)
}

/// Photographs of the object, on the board or without one.
fn without_poses(a: &TeachArguments, out: &Path) -> Result<Teaching> {
    let ruler = ruler_in_metres(a.ruler)?;
    let files = photograph_files(&a.photographs)?;
    let depth = if a.depth.is_empty() { vec![] } else { photograph_files(&a.depth)? };
    if !depth.is_empty() && depth.len() != files.len() {
        bail!("--depth: found {} images, expected one for each of {} photographs", depth.len(), files.len());
    }
    let camera = match (&a.camera, files.first()) {
        (Some(file), Some(first)) => {
            let (width, height) = sixfold_io::ImageFile::new(first).size()?;
            Some(CameraFile::read(file)?.for_image(width, height, file)?)
        }
        _ => None,
    };
    let mesh = a.mesh.as_ref().zip(a.unit).map(|(file, unit)| read_mesh(file, unit)).transpose()?;
    let world = if a.no_board { World::Features } else { World::Board };
    let length = a
        .length
        .map(|metres| anyhow::Ok(KnownLength { metres, ends: Ends::numbered(&a.ends, &files)? }))
        .transpose()?;
    let mut teaching = Teaching::open(out, &TeachOptions { ruler, camera, world })?;
    teaching.set_mesh(mesh.as_ref())?;
    for (i, file) in files.iter().enumerate() {
        let bytes = read_regular(file, limits::IMAGE).with_context(|| file.display().to_string())?;
        let number = teaching.add_photograph(&file.display().to_string(), &bytes)?;
        if let (Some(depth), Some(scale)) = (depth.get(i), a.depth_scale) {
            let bytes = read_regular(depth, limits::IMAGE).with_context(|| depth.display().to_string())?;
            teaching.add_depth(number, &bytes, scale / 1000.0)?;
        }
    }
    let given: Vec<String> = files.iter().map(|f| f.display().to_string()).collect();
    teaching.leave_out_others(&given)?;
    if a.no_board {
        let in_folder = |i: usize| teaching.photographs().iter().position(|p| p.name == given[i]);
        let length = length.map(|length| KnownLength {
            ends: length.ends.iter().filter_map(|(i, ends)| Some((in_folder(*i)?, *ends))).collect(),
            ..length
        });
        teaching.set_length(length)?;
    }
    Ok(teaching)
}

/// What methods derive from an object: now, not at the first estimate.
fn prepare(object: &Object) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
    PpfEstimator::default().prepare(object)?;
    if let (Some(mesh), Some(file)) = (&object.mesh, object.file(TEMPLATES_FILE)) {
        ObjectTemplates::from_mesh(mesh, &TemplateOptions::default())?.write(&file)?;
        MttmEstimator::default().prepare(object)?;
    }
    ViewsEstimator::shipped()?.prepare(object)?;
    Ok(())
}

fn left_out(teaching: &Teaching) -> Vec<LeftOut> {
    let of = |p: &sixfold_teach::Photograph| {
        let by_person = p.left_out_by_person.then(|| "not given this time".to_owned());
        let reason = by_person.or_else(|| p.left_out.clone().filter(|_| p.pose_by != Some(By::Person)))?;
        Some(LeftOut { photograph: p.name.clone(), reason })
    };
    teaching.photographs().iter().filter_map(of).collect()
}

fn print(t: &Taught<'_>) {
    for left in &t.left_out {
        println!("left out {}: {}", left.photograph, left.reason);
    }
    println!(
        "taught {} from {} photographs: diameter {:.1} mm, {} faces, {:.0} % of the surface in no photograph",
        t.name,
        t.photographs,
        1000.0 * t.record.diameter,
        t.record.faces,
        100.0 * t.unseen
    );
    let (discrete, axes) = (t.record.symmetries_discrete.len(), t.record.symmetries_continuous.len());
    println!("symmetries: {discrete} rotations and {axes} axes stored");
    for proposed in &t.symmetries_proposed {
        println!("  perhaps {proposed}: `sixfold object symmetries {} --noise 1`", t.name);
    }
    println!("inspect {}", t.folder.join("photographs.png").display());
}
