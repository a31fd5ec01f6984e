//! `sixfold grasp store`: lists, shows, removes, merges and exports experiences.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, Subcommand};
use serde::Serialize;
use sixfold_experience::{Attempt, Crop, Description, Experience, ExperienceStore, StorePlace, Stored};
use sixfold_grasp::read_grasp;
use sixfold_io::write_rgb;
use sixfold_shell::Outcome;
use sixfold_shell::grasp::experience::{NetworkArguments, model, note_left_out, now, store_place};
use sixfold_shell::grasp::gripper::gripper;
use sixfold_shell::grasp::input::{self, InputArguments};
use sixfold_shell::grasp::store::{self, Moved};
use sixfold_shell::output::{JsonArguments, report};

#[derive(Debug, Args)]
pub(crate) struct StoreArguments {
    #[command(subcommand)]
    pub command: StoreCommand,
    #[command(flatten)]
    pub json: JsonArguments,
}

#[derive(Debug, Subcommand)]
pub(crate) enum StoreCommand {
    /// Store a grasp that held: a depth image and a grasp on it
    #[command(
        after_help = "Example:\n  sixfold grasp store add experience.db --depth depth.png --mask mask.png --camera camera.json --grasp grasps.json \
        --object mug --part handle"
    )]
    Add(Box<AddArguments>),
    /// List all experiences, or all attempts
    #[command(after_help = "Example:\n  sixfold grasp store list experience.db")]
    List {
        /// The store
        #[arg(value_name = "FILE", value_parser = store_place())]
        file: StorePlace,
        /// List all grasps that were tried, also those that failed
        #[arg(long)]
        attempts: bool,
    },
    /// Show one experience, and write an image of it
    #[command(after_help = "Example:\n  sixfold grasp store show experience.db 1 --picture 1.png")]
    Show {
        /// The store
        #[arg(value_name = "FILE", value_parser = store_place())]
        file: StorePlace,
        /// Number of the experience
        #[arg(value_name = "ID")]
        id: i64,
        /// The image: normals with the gripper, VD-NOC, region of interest
        #[arg(long, value_name = "PNG")]
        picture: Option<PathBuf>,
    },
    /// Forget experiences and attempts
    #[command(
        after_help = "Examples:\n  sixfold grasp store forget experience.db 3 4\n  sixfold grasp store forget experience.db --attempt 17"
    )]
    Forget {
        /// The store
        #[arg(value_name = "FILE", value_parser = store_place())]
        file: StorePlace,
        /// Numbers of the experiences
        #[arg(value_name = "ID", required_unless_present = "attempt")]
        ids: Vec<i64>,
        /// Number of an attempt (`list --attempts` shows them); may be given several times
        #[arg(long, value_name = "ID")]
        attempt: Vec<i64>,
    },
    /// Add the experiences of other stores
    #[command(after_help = "Example:\n  sixfold grasp store merge all.db robot-a.db robot-b.db")]
    Merge {
        /// The store that receives them; it is created if it does not exist
        #[arg(value_name = "FILE", value_parser = store_place())]
        file: StorePlace,
        /// The other stores
        #[arg(value_name = "OTHER", required = true, value_parser = store_place())]
        others: Vec<StorePlace>,
    },
    /// Write all experiences as files: images, and JSON with everything else
    #[command(after_help = "Example:\n  sixfold grasp store export experience.db --out out/experiences")]
    Export {
        /// The store
        #[arg(value_name = "FILE", value_parser = store_place())]
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
        #[arg(value_name = "FILE", value_parser = store_place())]
        file: StorePlace,
        /// The new store
        #[arg(long, value_name = "FILE", value_parser = store_place())]
        out: StorePlace,
        #[command(flatten)]
        network: NetworkArguments,
    },
}

#[derive(Debug, Args)]
pub(crate) struct AddArguments {
    /// The store; it is created if it does not exist
    #[arg(value_name = "FILE", value_parser = store_place())]
    pub file: StorePlace,
    #[command(flatten)]
    pub input: InputArguments,
    /// The grasp: a grasps.json of `sixfold grasp propose`, or JSON with camera_from_gripper (4x4, metres), opening and width
    #[arg(long, value_name = "FILE")]
    pub grasp: PathBuf,
    /// Number of the grasp in the file, from 1
    #[arg(long, value_name = "N", default_value = "1")]
    pub number: usize,
    /// Gripper: jaws-140, jaws-85, or a file
    #[arg(long, value_name = "NAME_OR_FILE", default_value = "jaws-140")]
    pub gripper: String,
    /// Name of the object that was grasped
    #[arg(long, value_name = "NAME")]
    pub object: String,
    /// The part that was grasped, such as handle
    #[arg(long, value_name = "NAME")]
    pub part: Option<String>,
    /// Origin of the experience
    #[arg(long, value_name = "TEXT", default_value = "added by hand")]
    pub provenance: String,
    #[command(flatten)]
    pub network: NetworkArguments,
}

pub(super) fn run(a: &StoreArguments) -> Result<Outcome> {
    match &a.command {
        StoreCommand::Add(add) => self::add(add, &a.json),
        StoreCommand::List { file, attempts: true } => list_attempts(file, &a.json),
        StoreCommand::List { file, attempts: false } => list(file, &a.json),
        StoreCommand::Show { file, id, picture } => show(file, *id, picture.as_deref(), &a.json),
        StoreCommand::Forget { file, ids, attempt } => forget(file, ids, attempt, &a.json),
        StoreCommand::Merge { file, others } => merge(file, others, &a.json),
        StoreCommand::Export { file, out } => export(file, out, &a.json),
        StoreCommand::Refresh { file, out, network } => refresh(file, out, network, &a.json),
    }
}

fn add(a: &AddArguments, json: &JsonArguments) -> Result<Outcome> {
    let gripper = gripper(&a.gripper)?;
    let grasp = read_grasp(&a.grasp, a.number)?;
    let network = model(&a.network)?;
    let input = input::read(&a.input, None, 0)?;
    let Some(view) = &input.view else {
        bail!("{}: no object found on the table; give --mask", a.input.depth.display());
    };
    let crop =
        Crop::of_view(view, network.crop_options()).with_context(|| a.input.depth.display().to_string())?;
    let part = a.part.as_deref();
    let experience = Experience::new(&network, crop, &grasp, &gripper, &a.object, part, now(), &a.provenance);
    let added = store::add(&a.file, &experience, &a.grasp)?;
    report(json, &added, || {
        println!("experience {} {}", added.id, if added.new { "is stored" } else { "was stored already" });
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
        None => {
            bail!("{}: there is no experience {id}; `sixfold grasp store list` lists the ids", file.display())
        }
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

fn list_attempts(file: &StorePlace, json: &JsonArguments) -> Result<Outcome> {
    #[derive(Serialize)]
    struct Line {
        id: i64,
        #[serde(flatten)]
        attempt: Attempt,
    }
    let (mut all, mut broken) = (vec![], vec![]);
    for (id, attempt) in file.open()?.attempt_rows(0)? {
        match attempt {
            Ok(attempt) => all.push(Line { id, attempt }),
            Err(error) => broken.push(error),
        }
    }
    note_left_out(&broken, &file.to_string());
    report(json, &all, || {
        println!("{:>6} {:>12} {:>10} {:>6} from", "id", "object", "gripper", "held");
        for Line { id, attempt: a } in &all {
            let held = if a.held { "yes" } else { "no" };
            println!("{id:>6} {:>12} {:>10} {held:>6} {}", a.object, a.gripper, a.provenance);
        }
        println!("{} attempts", all.len());
    })?;
    Ok(if all.is_empty() { Outcome::NothingFound } else { Outcome::Found })
}

fn forget(file: &StorePlace, ids: &[i64], attempts: &[i64], json: &JsonArguments) -> Result<Outcome> {
    let done = store::forget(file, ids, attempts)?;
    report(json, &done, || {
        if !ids.is_empty() {
            println!("{} experiences forgotten", done.forgotten.len());
        }
        if !attempts.is_empty() {
            println!("{} attempts forgotten", done.attempts.len());
        }
        done.unknown.iter().for_each(|id| println!("there was no experience {id}"));
        done.unknown_attempts.iter().for_each(|id| println!("there was no attempt {id}"));
    })?;
    let nothing = done.forgotten.is_empty() && done.attempts.is_empty();
    Ok(if nothing { Outcome::NothingFound } else { Outcome::Found })
}

/// `found`: whether the command did its task.
fn outcome_of(moved: &Moved, found: bool) -> Outcome {
    match (moved.unreadable, found) {
        (1.., _) => Outcome::Incomplete,
        (_, true) => Outcome::Found,
        (_, false) => Outcome::NothingFound,
    }
}

fn merge(file: &StorePlace, others: &[StorePlace], json: &JsonArguments) -> Result<Outcome> {
    let merged = store::merge(file, others)?;
    report(json, &merged, || {
        println!("{} experiences taken over, {} in {}", merged.added, merged.experiences, file.display());
    })?;
    Ok(outcome_of(&merged, merged.added > 0))
}

fn export(file: &StorePlace, out: &Path, json: &JsonArguments) -> Result<Outcome> {
    let done = store::export(file, out)?;
    report(json, &done, || println!("{} experiences are in {}", done.experiences, out.display()))?;
    Ok(done.outcome())
}

fn refresh(
    file: &StorePlace,
    out: &StorePlace,
    network: &NetworkArguments,
    json: &JsonArguments,
) -> Result<Outcome> {
    let moved = store::refresh(file, out, &model(network)?)?;
    report(json, &moved, || println!("{} experiences are in {}", moved.experiences, out.display()))?;
    Ok(outcome_of(&moved, moved.experiences > 0))
}
