//! `sixfold teach`: a new object from photographs of it, on the printed board or without one, and a network trained for it.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

use anyhow::{Result, anyhow};
use clap::Args;
use serde::Serialize;
use sixfold_auto::prepare_all;
use sixfold_estimator::{ObjectRecord, ObjectStore, StoreError};
use sixfold_io::write_rgb;
use sixfold_mesh::{Unit, Verdict};
use sixfold_shell::Outcome;
use sixfold_shell::board::Ends;
use sixfold_shell::object_training::{ObjectTraining, STEPS, TrainedObject, VIEW_STEP};
use sixfold_shell::output::{JsonArguments, report};
use sixfold_shell::progress::{Bar, Terminal};
use sixfold_shell::ranges::{self, count};
use sixfold_shell::symmetries::described;
use sixfold_shell::teachings::{LeftOut, TeachingFiles};
use sixfold_teach::{SalientSegmenter, ShapeOptions};

pub(crate) const AFTER_HELP: &str = "Examples:\n  \
    sixfold board --out board.pdf                         # print it, stand the object on it, photograph it from all sides\n  \
    sixfold teach mug --photographs photographs\n  \
    sixfold teach mug --photographs colour --depth depth --depth-scale 1 --camera camera.json\n  \
    sixfold teach mug --photographs photographs --no-board --length 0.12 --ends a.jpg:812,640:1010,655 b.jpg:700,655:934,628\n  \
    sixfold teach mug --photographs image.png --depth depth.png --depth-scale 1 --camera camera.json --no-board   # one view\n  \
    sixfold teach mug --photographs photographs.json      # with poses, masks and depth from elsewhere\n  \
    sixfold teach mug --train                             # a network for the object taught before\n  \
    sixfold estimate --rgb image.png --camera camera.json --object mug --method views --out out\n\n\
    After a stop, the same command resumes.";

#[derive(Debug, Args)]
pub(crate) struct TeachArguments {
    /// Name of the object: letters, digits, - and _
    pub name: String,
    /// Photographs of the object, on the board unless --no-board (PNG, JPEG), or folders of them: 8 to 40, from all sides; one is
    /// enough with --depth, --camera and --no-board. Or one JSON file that lists photographs with the object's pose in each, masks and depth (docs/teach.md), without a board
    #[arg(long, required_unless_present = "train", num_args = 1.., value_name = "DIR")]
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
    /// Then train Pix2Pose for the object on views synthesized from its photographs, and store the weights with it; without
    /// --photographs on those of the object taught before
    #[arg(long)]
    pub train: bool,
    #[arg(long, value_name = "N", requires = "train", value_parser = count::<1_000_000>, help = steps_help())]
    pub train_steps: Option<NonZeroUsize>,
    #[arg(long, value_name = "DEGREES", requires = "train", value_parser = ranges::view_step, help = view_step_help())]
    pub view_step: Option<f64>,
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
    /// Replace an object of the same name; without --photographs its weights
    #[arg(long)]
    pub replace: bool,
    /// Folder for masks, mesh, images and the training; a stopped run resumes there (default: out/teach/NAME)
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    #[command(flatten)]
    pub json: JsonArguments,
}

fn steps_help() -> String {
    format!(
        "Training steps (default: {STEPS}, about 12 minutes of processor time with the views); more steps give better poses"
    )
}

fn view_step_help() -> String {
    format!("Degrees between synthesized views, in azimuth and elevation (default: {VIEW_STEP})")
}

#[derive(Serialize)]
struct Answer<'a> {
    name: &'a str,
    #[serde(flatten)]
    record: ObjectRecord,
    #[serde(flatten)]
    taught: Option<Taught>,
    #[serde(skip_serializing_if = "Option::is_none")]
    trained: Option<TrainedObject>,
}

/// Facts about an object that was taught now.
#[derive(Serialize)]
struct Taught {
    /// Number of used photographs.
    photographs: usize,
    left_out: Vec<LeftOut>,
    /// Fraction of the surface that no photograph shows.
    unseen: f64,
    /// Fraction of the object's pixels whose depth was measured, or found by comparing photographs.
    with_depth: f64,
    symmetries_proposed: Vec<String>,
    folder: PathBuf,
}

pub(crate) fn run(a: &TeachArguments) -> Result<Outcome> {
    let store = ObjectStore::new(&a.store);
    if let Err(error @ StoreError::Name(_)) = store.record(&a.name) {
        return Err(error.into());
    }
    let out = a.out.clone().unwrap_or_else(|| Path::new("out/teach").join(&a.name));
    let (record, taught) = match a.photographs.is_empty() {
        true => (None, None),
        false => teach(a, &store, &out).map(|(record, taught)| (Some(record), Some(taught)))?,
    };
    let training = ObjectTraining {
        store: &store,
        name: &a.name,
        steps: a.train_steps.map_or(STEPS, NonZeroUsize::get),
        view_step: a.view_step.unwrap_or(VIEW_STEP),
        replace: a.replace,
        out: &out,
    };
    let trained = a.train.then(|| training.run(&Terminal::default())).transpose()?;
    let record = record.map_or_else(|| store.record(&a.name), Ok)?;
    let answer = Answer { name: &a.name, record, taught, trained };
    report(&a.json, &answer, || print(&answer))?;
    Ok(Outcome::Found)
}

/// Makes the object's record and stores it, unless an earlier run of the same command did.
fn teach(a: &TeachArguments, store: &ObjectStore, out: &Path) -> Result<(ObjectRecord, Taught)> {
    let there = store.contains(&a.name) && !a.replace;
    let refused = || {
        let only = if a.train { ", or leave out --photographs to train on its own" } else { "" };
        anyhow!(
            "there is an object named {:?} in {} already: give --replace or another name{only}",
            a.name,
            a.store.display()
        )
    };
    // Only a training may have been stopped after the object was stored.
    if there && !(a.train && out.join("teaching.json").exists()) {
        return Err(refused());
    }
    let mut teaching = files(a).open(out)?;
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
    let stored = match there {
        true => teaching.stored(store, &a.name)?.ok_or_else(refused)?,
        false => teaching.store(store, &a.name, a.replace, prepare_all)?,
    };
    let facts = teaching.shape().ok_or_else(|| anyhow!("{}: no mesh was made", out.display()))?;
    let proposed = stored.symmetries.iter().filter(|s| s.verdict(true) != Verdict::Sure);
    let taught = Taught {
        photographs: stored.photographs,
        left_out: LeftOut::all(&teaching),
        unseen: facts.unseen,
        with_depth: facts.with_depth,
        symmetries_proposed: proposed.map(described).collect(),
        folder: out.to_path_buf(),
    };
    Ok((stored.record, taught))
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

fn print(answer: &Answer<'_>) {
    let Answer { name, record, .. } = answer;
    if let Some(t) = &answer.taught {
        for left in &t.left_out {
            println!("left out {}: {}", left.photograph, left.reason);
        }
        println!(
            "taught {name} from {} photographs: diameter {:.1} mm, {} faces, {:.0} % of the surface in no photograph",
            t.photographs,
            1000.0 * record.diameter,
            record.faces,
            100.0 * t.unseen
        );
        let (discrete, axes) = (record.symmetries_discrete.len(), record.symmetries_continuous.len());
        println!("symmetries: {discrete} rotations and {axes} axes stored");
        for proposed in &t.symmetries_proposed {
            println!("  perhaps {proposed}: `sixfold object symmetries {name} --noise 1`");
        }
        println!("inspect {}", t.folder.join("photographs.png").display());
    }
    if let Some(trained) = &answer.trained {
        trained.print();
    }
}
