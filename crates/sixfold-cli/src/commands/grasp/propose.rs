//! `sixfold grasp propose`: from a depth image to ranked grasps and an image of them.

use std::num::NonZeroUsize;
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use serde::Serialize;
#[cfg(feature = "experience")]
use sixfold_dgcm::transfer::{grasps_as_published, grasps_from_experience};
use sixfold_geometry::RgbImage;
use sixfold_grasp::AntipodalOptions;
#[cfg(feature = "experience")]
use sixfold_grasp::{GraspView, Gripper};
use sixfold_shell::Outcome;
use sixfold_shell::folder::OutputFolder;
#[cfg(feature = "experience")]
use sixfold_shell::grasp::experience::{self, NetworkArguments, store_place};
use sixfold_shell::grasp::gripper::gripper;
use sixfold_shell::grasp::input::{self, Input, InputArguments};
use sixfold_shell::grasp::planner::{Planner, PlannerArguments};
use sixfold_shell::grasp::proposals::{Proposed, Table, of_planner, picture, print_table};
#[cfg(feature = "experience")]
use sixfold_shell::grasp::proposals::{nearest_picture, of_both};
use sixfold_shell::output::{JsonArguments, report, write_atomically};
use sixfold_shell::pictures::Pictures;
use sixfold_shell::ranges::count;

#[derive(Debug, Args)]
pub(crate) struct ProposeArguments {
    #[command(flatten)]
    pub input: InputArguments,
    /// Colour image for the overlay in --out
    #[arg(long, value_name = "FILE")]
    pub rgb: Option<PathBuf>,
    /// Gripper: jaws-140, jaws-85, or a file
    #[arg(long, value_name = "NAME_OR_FILE", default_value = "jaws-140")]
    pub gripper: String,
    /// Maximum number of grasps
    #[arg(long, value_name = "N", default_value = "5", value_parser = count::<10_000>)]
    pub number: NonZeroUsize,
    #[command(flatten)]
    pub planner: PlannerArguments,
    /// Also use the experiences of this store, which `sixfold grasp learn` or `sixfold grasp store add` wrote: a file or
    /// postgres://user@host/database
    #[cfg(feature = "experience")]
    #[arg(long, value_name = "FILE", value_parser = store_place())]
    pub experiences: Option<sixfold_experience::StorePlace>,
    #[cfg(feature = "experience")]
    #[command(flatten)]
    pub network: NetworkArguments,
    /// Use only experiences on parts with this name, such as handle, and return only grasps on that part
    #[cfg(feature = "experience")]
    #[arg(long, value_name = "NAME", requires = "experiences")]
    pub part: Option<String>,
    /// Propose grasps as the dissertation describes it (docs/coverage.md lists what still differs)
    #[cfg(feature = "experience")]
    #[arg(long, value_name = "NAME", value_enum, requires = "experiences")]
    pub preset: Option<Preset>,
    /// Use only the visible surface: assume nothing about the object's far side
    #[arg(long)]
    pub seen_only: bool,
    /// Folder for grasps.json, overlay.png and, with --experiences, experiences.png: the nearest of them
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Seed of all random numbers
    #[arg(long, default_value = "0")]
    pub seed: u64,
    #[command(flatten)]
    pub json: JsonArguments,
}

/// How experience is used in the dissertation.
#[cfg(feature = "experience")]
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Preset {
    /// DGCM-Net alone: transferred grasps, clusters by their summed scores
    #[value(alias = "paper")]
    Published,
    /// The planner's grasps, their scores averaged with those of experience nearby
    PublishedCombined,
}

pub(super) fn run(a: &ProposeArguments) -> Result<Outcome> {
    let gripper = gripper(&a.gripper)?;
    let planner = Planner::new(&a.planner)?;
    #[cfg(feature = "experience")]
    check_combination(a, &planner)?;
    let mut folder = a.out.as_deref().map(OutputFolder::take).transpose()?;
    let files = folder.as_mut().map(|f| f.files(&["overlay.png", "grasps.json"])).transpose()?;
    let Input { depth, camera, rgb, view, began } = input::read(&a.input, a.rgb.as_deref(), a.seed)?;
    let (proposed, nearest): (Vec<Proposed>, Option<RgbImage>) = match &view {
        None => (vec![], None),
        Some(view) => {
            let default = AntipodalOptions::default();
            let completion = default.completion.filter(|_| !a.seen_only);
            let options = AntipodalOptions { seed: a.seed, completion, ..default };
            let alone = || anyhow::Ok(of_planner(&planner, &planner.grasps(view, &gripper, &options)?));
            #[cfg(feature = "experience")]
            let (found, nearest) = match &a.experiences {
                Some(_) => with_experience(a, view, &gripper, &planner, &options)?,
                None => (alone()?, None),
            };
            #[cfg(not(feature = "experience"))]
            let (found, nearest) = (alone()?, None);
            (found.into_iter().take(a.number.get()).collect(), nearest)
        }
    };
    let seconds = began.elapsed().as_secs_f64();
    let whole = Whole {
        method: method(a, &planner),
        gripper: gripper.name.clone(),
        object_pixels: view.as_ref().map_or(0, |v| v.mask.as_slice().iter().filter(|m| **m).count()),
        table: view.as_ref().and_then(|v| v.table).map(Table::from),
        cut_by_edge: view.as_ref().is_some_and(|v| v.cut_by_edge),
        grasps: proposed,
        overlay: files.as_ref().map(|files| files[0].clone()),
        seconds,
    };
    if let Some(files) = &files {
        write_atomically(&files[1], serde_json::to_string_pretty(&whole)?.as_bytes())?;
    }
    report(&a.json, &whole, || report_grasps(&whole, a.out.as_deref()))?;
    let mut pictures = Pictures::of(folder);
    if whole.overlay.is_some() {
        pictures.write("overlay.png", &picture(rgb, &depth, &camera, &gripper, &whole.grasps)?);
    }
    if let Some(image) = nearest {
        pictures.write("experiences.png", &image);
    }
    Ok(pictures.outcome(if whole.grasps.is_empty() { Outcome::NothingFound } else { Outcome::Found }))
}

#[derive(Serialize)]
struct Whole {
    method: String,
    gripper: String,
    object_pixels: usize,
    table: Option<Table>,
    cut_by_edge: bool,
    grasps: Vec<Proposed>,
    overlay: Option<PathBuf>,
    seconds: f64,
}

#[cfg(feature = "experience")]
fn method(a: &ProposeArguments, planner: &Planner) -> String {
    let planner = planner.name();
    match (&a.experiences, &a.part) {
        (Some(_), _) if a.preset == Some(Preset::Published) => "dgcm as published".to_owned(),
        (Some(_), _) if a.preset == Some(Preset::PublishedCombined) => {
            format!("{planner} and dgcm as published")
        }
        (None, _) => planner.to_owned(),
        (Some(_), None) => format!("{planner} and dgcm"),
        (Some(_), Some(_)) => "dgcm on a part".to_owned(),
    }
}

#[cfg(not(feature = "experience"))]
fn method(_: &ProposeArguments, planner: &Planner) -> String {
    planner.name().to_owned()
}

/// The ranking by outcomes uses the quality of contacts, which trained planners do not compute.
#[cfg(feature = "experience")]
fn check_combination(a: &ProposeArguments, planner: &Planner) -> Result<()> {
    let learned = !matches!(planner, Planner::Antipodal);
    if learned && a.experiences.is_some() && a.preset != Some(Preset::PublishedCombined) {
        anyhow::bail!(
            "--planner {}: with --experiences it is combined as published; add --preset published-combined, or leave --planner out",
            planner.name()
        );
    }
    Ok(())
}

/// Grasps from geometry and from experience, ranked together; with a part's name, only those on the part according to
/// experience on it. With --out also an image of the nearest experiences.
#[cfg(feature = "experience")]
fn with_experience(
    a: &ProposeArguments,
    view: &GraspView,
    gripper: &Gripper,
    planner: &Planner,
    options: &AntipodalOptions,
) -> Result<(Vec<Proposed>, Option<RgbImage>)> {
    let Some(place) = &a.experiences else { return Ok((vec![], None)) };
    let network = experience::model(&a.network)?;
    let mut memory = experience::memory(place, &network)?;
    let part = a.part.as_deref();
    let grasps = match a.preset {
        None => grasps_from_experience(view, gripper, options, &network, &mut memory, part)?,
        Some(preset) => {
            let planned = (preset == Preset::PublishedCombined)
                .then(|| planner.grasps(view, gripper, options))
                .transpose()?;
            grasps_as_published(view, gripper, options, &network, &mut memory, part, planned.as_deref())?
        }
    };
    experience::note_left_out(&memory.take_left_out(), &place.to_string());
    if grasps.found.nearest.is_empty() {
        let wanted = part.map_or(String::new(), |part| format!(" on a part named {part}"));
        eprintln!("note: {place} holds no experience{wanted} that this network can use");
    }
    let shown = a.out.is_some() && !grasps.found.nearest.is_empty();
    let picture = shown.then(|| nearest_picture(&grasps, &mut memory, gripper)).transpose()?;
    Ok((of_both(planner, &grasps), picture))
}

fn report_grasps(whole: &Whole, folder: Option<&std::path::Path>) {
    if whole.grasps.is_empty() {
        println!(
            "no grasp found for gripper {} ({} pixels of an object)",
            whole.gripper, whole.object_pixels
        );
    } else {
        print_table(&whole.grasps);
    }
    if let Some(folder) = folder {
        println!("grasps.json and overlay.png are in {}", folder.display());
    }
}
