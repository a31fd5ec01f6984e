//! `sixfold teach`: a new object from photographs of it, on the printed board or without one.

use std::path::{Path, PathBuf};

use anyhow::{Result, anyhow, bail};
use clap::Args;
use serde::Serialize;
use sixfold_auto::prepare_all;
use sixfold_estimator::{ObjectRecord, ObjectStore, StoreError};
use sixfold_io::write_rgb;
use sixfold_mesh::{Unit, Verdict};
use sixfold_shell::Outcome;
use sixfold_shell::board::Ends;
use sixfold_shell::output::{JsonArguments, report};
use sixfold_shell::progress::Bar;
use sixfold_shell::ranges;
use sixfold_shell::symmetries::described;
use sixfold_shell::teachings::{LeftOut, TeachingFiles};
use sixfold_teach::{SalientSegmenter, ShapeOptions};

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
    /// Photographs of the object, on the board unless --no-board (PNG, JPEG), or folders of them: 8 to 40, from all sides; or one
    /// JSON file that lists photographs with the object's pose in each, masks and depth (docs/teach.md), without a board
    #[arg(long, required = true, num_args = 1.., value_name = "DIR")]
    pub photographs: Vec<PathBuf>,
    /// Depth images from the same viewpoints (PNG, 16 bit), or folders of them, in the order of the photographs' names
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
    /// The photographs show no board: camera poses come from the object's surroundings, which need texture and must not move; needs
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
    /// Number of used photographs.
    photographs: usize,
    left_out: Vec<LeftOut>,
    /// Fraction of the surface that no photograph shows.
    unseen: f64,
    /// Fraction of the object's pixels whose depth was measured, or found by comparing photographs.
    with_depth: f64,
    symmetries_proposed: Vec<String>,
    folder: &'a Path,
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
    let mut teaching = files(a).open(&out)?;
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
    let stored = teaching.store(&store, &a.name, a.replace, prepare_all)?;
    let facts = teaching.shape().ok_or_else(|| anyhow!("{}: no mesh was made", out.display()))?;
    let proposed = stored.symmetries.iter().filter(|s| s.verdict(true) != Verdict::Sure);
    let taught = Taught {
        name: &a.name,
        record: &stored.record,
        photographs: stored.photographs,
        left_out: LeftOut::all(&teaching),
        unseen: facts.unseen,
        with_depth: facts.with_depth,
        symmetries_proposed: proposed.map(described).collect(),
        folder: &out,
    };
    report(&a.json, &taught, || print(&taught))?;
    Ok(Outcome::Found)
}

/// The files that the arguments name.
fn files(a: &TeachArguments) -> TeachingFiles<'_> {
    TeachingFiles {
        photographs: &a.photographs,
        depth: &a.depth,
        depth_scale: a.depth_scale,
        camera: a.camera.as_deref(),
        ruler: a.ruler,
        without_board: a.no_board,
        length: a.length,
        ends: &a.ends,
        mesh: a.mesh.as_deref().zip(a.unit),
    }
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
