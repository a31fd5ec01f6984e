//! `sixfold grasp store`: the experiences, looked at and looked after.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, Subcommand};
use serde::{Deserialize, Serialize};
use sixfold_experience::{Crop, Description, Experience, ExperienceStore, StorePlace, Stored};
use sixfold_geometry::Pose;
use sixfold_geometry::nalgebra::Matrix4;
use sixfold_grasp::{AntipodalQuality, Grasp};
use sixfold_io::write_rgb;

use super::input::{self, InputArguments};
use sixfold_shell::Outcome;
use sixfold_shell::folder::OutputFolder;
use sixfold_shell::grasp::experience::{NetworkArguments, model, now};
use sixfold_shell::grasp::gripper::gripper;
use sixfold_shell::output::{JsonArguments, report};
use sixfold_shell::progress::{Progress, check_interrupt};

#[derive(Debug, Args)]
pub(crate) struct StoreArguments {
    #[command(subcommand)]
    pub command: StoreCommand,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Debug, Subcommand)]
pub(crate) enum StoreCommand {
    /// Store a grasp that worked: a depth image and a grasp on it
    #[command(
        after_help = "Example:\n  sixfold grasp store add experience.db --depth depth.png --mask mask.png --camera camera.json --grasp grasps.json \
        --object mug --part handle"
    )]
    Add(Box<AddArguments>),
    /// List all experiences
    #[command(after_help = "Example:\n  sixfold grasp store list experience.db")]
    List {
        /// The store
        #[arg(value_name = "FILE")]
        file: StorePlace,
    },
    /// Show one experience: what is known, and an image
    #[command(after_help = "Example:\n  sixfold grasp store show experience.db 1 --picture 1.png")]
    Show {
        /// The store
        #[arg(value_name = "FILE")]
        file: StorePlace,
        /// Number of the experience
        #[arg(value_name = "ID")]
        id: i64,
        /// The image: normals with the gripper, VD-NOC, region of interest
        #[arg(long, value_name = "PNG")]
        picture: Option<PathBuf>,
    },
    /// Forget experiences
    #[command(after_help = "Example:\n  sixfold grasp store forget experience.db 3 4")]
    Forget {
        /// The store
        #[arg(value_name = "FILE")]
        file: StorePlace,
        /// Numbers of the experiences
        #[arg(value_name = "ID", required = true)]
        ids: Vec<i64>,
    },
    /// Take over the experiences of other stores
    #[command(after_help = "Example:\n  sixfold grasp store merge all.db robot-a.db robot-b.db")]
    Merge {
        /// The store that gets them; it is made where there is none
        #[arg(value_name = "FILE")]
        file: StorePlace,
        /// The other stores
        #[arg(value_name = "OTHER", required = true)]
        others: Vec<StorePlace>,
    },
    /// Write all experiences as files: images, and JSON with everything else
    #[command(after_help = "Example:\n  sixfold grasp store export experience.db --out out/experiences")]
    Export {
        /// The store
        #[arg(value_name = "FILE")]
        file: StorePlace,
        /// Folder for the files
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
    },
    /// Encode all experiences again, with another network, into another store
    #[command(
        after_help = "Example:\n  sixfold grasp store refresh experience.db --out new.db --weights dgcm.safetensors"
    )]
    Refresh {
        /// The store
        #[arg(value_name = "FILE")]
        file: StorePlace,
        /// The new store
        #[arg(long, value_name = "FILE")]
        out: StorePlace,
        #[command(flatten)]
        network: NetworkArguments,
    },
}

#[derive(Debug, Args)]
pub(crate) struct AddArguments {
    /// The store; it is made where there is none
    #[arg(value_name = "FILE")]
    pub file: StorePlace,
    #[command(flatten)]
    pub input: InputArguments,
    /// The grasp: a grasps.json of `sixfold grasp propose`, or JSON with camera_from_gripper (4x4, metres), opening and width
    #[arg(long, value_name = "FILE")]
    pub grasp: PathBuf,
    /// Which grasp of a list, from 1
    #[arg(long, value_name = "N", default_value = "1")]
    pub number: usize,
    /// Gripper: jaws-140, jaws-85, or a file
    #[arg(long, value_name = "NAME_OR_FILE", default_value = "jaws-140")]
    pub gripper: String,
    /// What was grasped
    #[arg(long, value_name = "NAME")]
    pub object: String,
    /// The part that was grasped, such as handle
    #[arg(long, value_name = "NAME")]
    pub part: Option<String>,
    /// Where the experience comes from
    #[arg(long, value_name = "TEXT", default_value = "added by hand")]
    pub provenance: String,
    #[command(flatten)]
    pub network: NetworkArguments,
}

pub(super) fn run(a: &StoreArguments) -> Result<Outcome> {
    match &a.command {
        StoreCommand::Add(add) => self::add(add, &a.json),
        StoreCommand::List { file } => list(file, &a.json),
        StoreCommand::Show { file, id, picture } => show(file, *id, picture.as_deref(), &a.json),
        StoreCommand::Forget { file, ids } => forget(file, ids, &a.json),
        StoreCommand::Merge { file, others } => merge(file, others, &a.json),
        StoreCommand::Export { file, out } => export(file, out, &a.json),
        StoreCommand::Refresh { file, out, network } => refresh(file, out, network, &a.json),
    }
}

#[derive(Deserialize)]
struct GraspFile {
    camera_from_gripper: [[f64; 4]; 4],
    opening: f64,
    width: f64,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum GraspsFile {
    List { grasps: Vec<GraspFile> },
    One(GraspFile),
}

fn read_grasp(path: &Path, number: usize) -> Result<Grasp> {
    let file = path.display();
    let text = std::fs::read_to_string(path).with_context(|| file.to_string())?;
    let read: GraspsFile = serde_json::from_str(&text).with_context(|| {
        format!("{file}: expected camera_from_gripper (4x4, metres), opening and width (metres), or a list of them as `grasps`")
    })?;
    let grasps = match read {
        GraspsFile::List { grasps } => grasps,
        GraspsFile::One(grasp) => vec![grasp],
    };
    let count = grasps.len();
    let Some(grasp) = number.checked_sub(1).and_then(|i| grasps.into_iter().nth(i)) else {
        bail!("--number: found {number}, expected 1 to {count}: {file} holds {count} grasps");
    };
    for (field, value) in [("opening", grasp.opening), ("width", grasp.width)] {
        if !(value > 0.0 && value < 1.0) {
            bail!("{file}: field {field}: found {value}, expected above 0 and below 1 m");
        }
    }
    let pose = Pose::from_matrix(&Matrix4::from_fn(|i, j| grasp.camera_from_gripper[i][j]))
        .with_context(|| format!("{file}: field camera_from_gripper"))?;
    let quality = AntipodalQuality { alignment: 0.0, support: 0.0, centring: 0.0, observed: 0.0 };
    Ok(Grasp { camera_from_gripper: pose, opening: grasp.opening, width: grasp.width, quality })
}

#[derive(Serialize)]
struct Added {
    id: i64,
    /// False when it was there already.
    new: bool,
    region_pixels: usize,
}

fn add(a: &AddArguments, json: &JsonArguments) -> Result<Outcome> {
    let gripper = gripper(&a.gripper)?;
    let grasp = read_grasp(&a.grasp, a.number)?;
    let network = model(&a.network)?;
    let input = input::read(&a.input, 0)?;
    let Some(view) = &input.view else {
        bail!("{}: nothing stands on the table; give --mask", a.input.depth.display());
    };
    let crop =
        Crop::of_view(view, network.crop_options()).with_context(|| a.input.depth.display().to_string())?;
    let part = a.part.as_deref();
    let experience = Experience::new(&network, crop, &grasp, &gripper, &a.object, part, now(), &a.provenance);
    let region_pixels = experience.region.iter().filter(|r| **r).count();
    if region_pixels == 0 {
        bail!(
            "{}: the gripper is nowhere near the object; do grasp and depth image belong together, and is the grasp in metres in the camera's frame?",
            a.grasp.display()
        );
    }
    let (id, new) = a.file.create()?.add(&experience)?;
    report(json, &Added { id, new, region_pixels }, || {
        println!("experience {id} {}", if new { "is stored" } else { "was stored already" });
    })?;
    Ok(Outcome::Found)
}

fn list(file: &StorePlace, json: &JsonArguments) -> Result<Outcome> {
    let all = file.open()?.list()?;
    report(json, &all, || {
        println!("{:>6} {:>12} {:>10} {:>10} {:>10} from", "id", "object", "part", "gripper", "width (m)");
        for s in &all {
            let part = s.part.as_deref().unwrap_or("-");
            println!(
                "{:>6} {:>12} {:>10} {:>10} {:>10.4} {}",
                s.id, s.object, part, s.gripper, s.width, s.provenance
            );
        }
        println!("{} experiences", all.len());
    })?;
    Ok(if all.is_empty() { Outcome::NothingFound } else { Outcome::Found })
}

fn found(store: &dyn ExperienceStore, file: &StorePlace, id: i64) -> Result<Stored> {
    match store.get(id)? {
        Some(stored) => Ok(stored),
        None => bail!(
            "{}: there is no experience {id}; `sixfold grasp store list` shows which there are",
            file.display()
        ),
    }
}

fn show(file: &StorePlace, id: i64, picture: Option<&Path>, json: &JsonArguments) -> Result<Outcome> {
    let stored = found(&*file.open()?, file, id)?;
    if let Some(path) = picture {
        write_rgb(path, &stored.experience.picture()?)?;
    }
    let shown = Description::new(&stored, false);
    report(json, &shown, || {
        let s = &shown.summary;
        println!("experience {}: {} ({})", s.id, s.object, s.part.as_deref().unwrap_or("no part"));
        println!("gripper {}, opening {:.3} m, width {:.3} m", s.gripper, shown.opening, s.width);
        println!(
            "{} pixels of the object, {} in the region of interest",
            shown.object_pixels, shown.region_pixels
        );
        println!("network {}, {} features, from: {}", s.network, shown.copies, s.provenance);
    })?;
    Ok(Outcome::Found)
}

#[derive(Serialize)]
struct Forgotten {
    forgotten: Vec<i64>,
    unknown: Vec<i64>,
}

fn forget(file: &StorePlace, ids: &[i64], json: &JsonArguments) -> Result<Outcome> {
    let mut store = file.open()?;
    let mut done = Forgotten { forgotten: vec![], unknown: vec![] };
    for &id in ids {
        if store.forget(id)? { done.forgotten.push(id) } else { done.unknown.push(id) }
    }
    report(json, &done, || {
        println!("{} experiences forgotten", done.forgotten.len());
        for id in &done.unknown {
            println!("there was no experience {id}");
        }
    })?;
    Ok(if done.forgotten.is_empty() { Outcome::NothingFound } else { Outcome::Found })
}

#[derive(Serialize)]
struct Merged {
    added: usize,
    experiences: usize,
}

fn merge(file: &StorePlace, others: &[StorePlace], json: &JsonArguments) -> Result<Outcome> {
    let sources: Vec<_> = others.iter().map(StorePlace::open).collect::<Result<_, _>>()?;
    let mut store = file.create()?;
    let mut added = 0;
    for (source, name) in sources.iter().zip(others) {
        check_interrupt("what was taken over is kept; the same command resumes")?;
        added += store.merge(&**source).with_context(|| name.display().to_string())?;
    }
    let merged = Merged { added, experiences: store.list()?.len() };
    report(json, &merged, || {
        println!("{} experiences taken over, {} in {}", merged.added, merged.experiences, file.display());
    })?;
    Ok(if added > 0 { Outcome::Found } else { Outcome::NothingFound })
}

#[derive(Serialize)]
struct Exported {
    experiences: usize,
    unreadable: usize,
    folder: PathBuf,
}

fn export(file: &StorePlace, out: &Path, json: &JsonArguments) -> Result<Outcome> {
    let store = file.open()?;
    let all = store.list()?;
    let mut folder = OutputFolder::take(out)?;
    let mut progress = Progress::new("experiences", all.len());
    let mut done = Exported { experiences: 0, unreadable: 0, folder: out.to_path_buf() };
    for summary in &all {
        check_interrupt("what was written is whole")?;
        match store.get(summary.id) {
            Ok(Some(stored)) => {
                let name = format!("{:06}", stored.id);
                folder.write_rgb(&format!("{name}.png"), &stored.experience.picture()?)?;
                let shown = Description::new(&stored, true);
                let text = serde_json::to_string_pretty(&shown)?;
                folder.write_text(&format!("{name}.json"), &text)?;
                done.experiences += 1;
            }
            Ok(None) => {}
            Err(error) => {
                eprintln!("left out: {error}");
                done.unreadable += 1;
            }
        }
        progress.step(summary.object.clone());
    }
    progress.finish();
    report(json, &done, || println!("{} experiences are in {}", done.experiences, out.display()))?;
    Ok(match (done.experiences, done.unreadable) {
        (_, 1..) => Outcome::Incomplete,
        (0, _) => Outcome::NothingFound,
        _ => Outcome::Found,
    })
}

fn refresh(
    file: &StorePlace,
    out: &StorePlace,
    network: &NetworkArguments,
    json: &JsonArguments,
) -> Result<Outcome> {
    if file == out {
        bail!("--out: expected another file than the store itself");
    }
    let network = model(network)?;
    let source = file.open()?;
    let mut target = out.create()?;
    let all = source.list()?;
    let mut progress = Progress::new("experiences", all.len());
    let mut added = 0;
    for summary in &all {
        check_interrupt("what was encoded is kept; the same command resumes")?;
        let Some(stored) = source.get(summary.id)? else { continue };
        let encoded = stored.experience.encoded(&network);
        let encoded = encoded.with_context(|| format!("experience {}", stored.id))?;
        added += usize::from(target.add(&encoded)?.1);
        progress.step(summary.object.clone());
    }
    progress.finish();
    let merged = Merged { added, experiences: target.list()?.len() };
    report(json, &merged, || println!("{} experiences are in {}", merged.experiences, out.display()))?;
    Ok(if merged.experiences > 0 { Outcome::Found } else { Outcome::NothingFound })
}
