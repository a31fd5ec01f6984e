//! `sixfold grasp propose`: from a depth image to ranked grasps and an image of them.

use std::num::NonZeroUsize;
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use serde::Serialize;
use sixfold_geometry::Pose;
use sixfold_grasp::{
    AntipodalOptions, AntipodalQuality, ClusterOptions, DrawnGrasp, Grasp, GraspView, Gripper,
    antipodal_grasps, cluster_grasps, draw_grasps,
};

use super::input::{self, Input, InputArguments};
use sixfold_shell::Outcome;
#[cfg(feature = "experience")]
use sixfold_shell::grasp::experience::{self, NetworkArguments};
use sixfold_shell::grasp::gripper::gripper;
use sixfold_shell::output::{JsonArguments, pose_rows, report, write_atomically};
use sixfold_shell::overlay;
use sixfold_shell::pictures::Pictures;

#[derive(Debug, Args)]
pub(crate) struct ProposeArguments {
    #[command(flatten)]
    pub input: InputArguments,
    /// Gripper: jaws-140, jaws-85, or a file
    #[arg(long, value_name = "NAME_OR_FILE", default_value = "jaws-140")]
    pub gripper: String,
    /// Most grasps
    #[arg(long, value_name = "N", default_value = "5")]
    pub number: NonZeroUsize,
    /// Propose from experience too: a store that `sixfold grasp learn` or `sixfold grasp store add` wrote, a file or
    /// postgres://user@host/database
    #[cfg(feature = "experience")]
    #[arg(long, value_name = "FILE")]
    pub experiences: Option<sixfold_experience::StorePlace>,
    #[cfg(feature = "experience")]
    #[command(flatten)]
    pub network: NetworkArguments,
    /// Only experiences on parts of this name, such as handle, and only grasps that hold what they held
    #[cfg(feature = "experience")]
    #[arg(long, value_name = "NAME", requires = "experiences")]
    pub part: Option<String>,
    /// Take only what was seen: assume nothing of the object's far side
    #[arg(long)]
    pub seen_only: bool,
    /// Folder for grasps.json and overlay.png
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Seed of everything random
    #[arg(long, default_value = "0")]
    pub seed: u64,
    #[command(flatten)]
    pub json: JsonArguments,
}

/// The best grasp's colour; the others are blue.
const BEST: [u8; 3] = [60, 220, 80];
const OTHER: [u8; 3] = [86, 150, 233];

pub(super) fn run(a: &ProposeArguments) -> Result<Outcome> {
    let gripper = gripper(&a.gripper)?;
    let Input { depth, camera, rgb, view, began } = input::read(&a.input, a.seed)?;
    let proposed: Vec<Proposed> = match &view {
        None => vec![],
        Some(view) => {
            let default = AntipodalOptions::default();
            let completion = default.completion.filter(|_| !a.seen_only);
            let planner = AntipodalOptions { seed: a.seed, completion, ..default };
            #[cfg(feature = "experience")]
            let found = match &a.experiences {
                Some(_) => with_experience(a, view, &gripper, &planner)?,
                None => by_geometry(view, &gripper, &planner)?,
            };
            #[cfg(not(feature = "experience"))]
            let found = by_geometry(view, &gripper, &planner)?;
            found.into_iter().take(a.number.get()).collect()
        }
    };
    let seconds = began.elapsed().as_secs_f64();
    let whole = Whole {
        method: method(a),
        gripper: gripper.name.clone(),
        object_pixels: view.as_ref().map_or(0, |v| v.mask.as_slice().iter().filter(|m| **m).count()),
        table: view
            .as_ref()
            .and_then(|v| v.table)
            .map(|t| Table { normal: t.normal.into(), offset: t.offset }),
        cut_by_edge: view.as_ref().is_some_and(|v| v.cut_by_edge),
        grasps: proposed,
        overlay: a.out.as_ref().map(|folder| folder.join("overlay.png")),
        seconds,
    };
    if let Some(folder) = &a.out {
        let text = serde_json::to_string_pretty(&whole)?;
        write_atomically(&folder.join("grasps.json"), text.as_bytes())?;
    }
    report(&a.json, &whole, || print_table(&whole, a.out.as_deref()))?;
    let mut pictures = Pictures::default();
    if let Some(path) = &whole.overlay {
        let background = rgb.unwrap_or_else(|| overlay::depth_picture(&depth));
        let drawn = drawn(&whole.grasps);
        pictures.write(path, &draw_grasps(&background, Some(&depth), &camera, &gripper, &drawn)?);
    }
    Ok(pictures.outcome(if whole.grasps.is_empty() { Outcome::NothingFound } else { Outcome::Found }))
}

/// The grasps as an image shows them, the best one on top.
fn drawn(grasps: &[Proposed]) -> Vec<DrawnGrasp> {
    let drawn = grasps.iter().enumerate().rev().map(|(i, p)| DrawnGrasp {
        camera_from_gripper: p.pose,
        opening: p.opening,
        color: if i == 0 { BEST } else { OTHER },
    });
    drawn.collect()
}

#[derive(Serialize)]
struct Whole {
    method: &'static str,
    gripper: String,
    object_pixels: usize,
    table: Option<Table>,
    cut_by_edge: bool,
    grasps: Vec<Proposed>,
    overlay: Option<PathBuf>,
    seconds: f64,
}

/// `normal . p = offset` in the camera's frame, metres.
#[derive(Serialize)]
struct Table {
    normal: [f64; 3],
    offset: f64,
}

#[derive(Serialize)]
struct Proposed {
    camera_from_gripper: [[f64; 4]; 4],
    opening: f64,
    width: f64,
    quality: f64,
    parts: AntipodalQuality,
    cluster_score: f64,
    cluster_members: usize,
    /// The experience it was transferred from, or that agrees with it.
    #[serde(skip_serializing_if = "Option::is_none")]
    experience: Option<FromExperience>,
    #[serde(skip)]
    pose: Pose,
}

#[derive(Serialize)]
struct FromExperience {
    kind: &'static str,
    /// Number of the experience in its store.
    id: Option<i64>,
    /// Distance of the features.
    distance: Option<f64>,
    /// Whether a difference in size was taken for a scale or for a turn.
    hypothesis: Option<&'static str>,
    /// The fraction of experience that agrees with the grasp.
    share: f64,
}

impl Proposed {
    fn new(grasp: &Grasp, score: f64, members: usize) -> Proposed {
        Proposed {
            camera_from_gripper: pose_rows(&grasp.camera_from_gripper),
            opening: grasp.opening,
            width: grasp.width,
            quality: grasp.quality.total(),
            parts: grasp.quality,
            cluster_score: score,
            cluster_members: members,
            experience: None,
            pose: grasp.camera_from_gripper,
        }
    }
}

fn by_geometry(view: &GraspView, gripper: &Gripper, planner: &AntipodalOptions) -> Result<Vec<Proposed>> {
    let grasps = antipodal_grasps(view, gripper, planner)?;
    let clusters = cluster_grasps(&grasps, &ClusterOptions::default());
    Ok(clusters.iter().map(|c| Proposed::new(&c.best, c.score, c.members)).collect())
}

#[cfg(feature = "experience")]
fn method(a: &ProposeArguments) -> &'static str {
    match (&a.experiences, &a.part) {
        (None, _) => "antipodal",
        (Some(_), None) => "antipodal and dgcm",
        (Some(_), Some(_)) => "dgcm on a part",
    }
}

#[cfg(not(feature = "experience"))]
fn method(_: &ProposeArguments) -> &'static str {
    "antipodal"
}

/// Grasps of both kinds, ranked together; with a part's name, those that hold what experience on it held.
#[cfg(feature = "experience")]
fn with_experience(
    a: &ProposeArguments,
    view: &GraspView,
    gripper: &Gripper,
    planner: &AntipodalOptions,
) -> Result<Vec<Proposed>> {
    use sixfold_dgcm::transfer::{Kind, ProposeOptions, propose, rank_by_outcome, rank_on_part};
    use sixfold_grasp::GraspFitter;
    let Some(file) = &a.experiences else { return Ok(vec![]) };
    let model = experience::model(&a.network)?;
    let mut memory = experience::memory(file, &model)?;
    let options = ProposeOptions { part: a.part.clone(), ..ProposeOptions::default() };
    let fitter = GraspFitter::new(view, gripper, planner)?;
    let found = propose(&fitter, &model, &mut memory, &options)?;
    if found.nearest.is_empty() {
        let wanted = a.part.as_ref().map_or(String::new(), |part| format!(" on a part named {part}"));
        eprintln!("note: {} holds no experience{wanted} that this network can use", file.display());
    }
    let geometry = antipodal_grasps(view, gripper, planner)?;
    let outcomes = memory.outcomes(&gripper.name);
    let clusters = ClusterOptions::default();
    let ranked = match &a.part {
        None => rank_by_outcome(&geometry, &found.proposals, &clusters, &fitter, &outcomes),
        Some(_) => rank_on_part(&geometry, &found, &clusters, &fitter, &outcomes),
    };
    Ok(ranked
        .iter()
        .map(|r| {
            let proposal = r.proposal.map(|i| &found.proposals[i]);
            let experience = FromExperience {
                kind: match r.kind {
                    Kind::Geometry => "geometry",
                    Kind::Experience => "experience",
                },
                id: proposal.map(|p| p.from.experience),
                distance: proposal.map(|p| p.from.distance),
                hypothesis: proposal.map(|p| p.hypothesis.name()),
                share: r.experience,
            };
            Proposed { experience: Some(experience), ..Proposed::new(&r.grasp, r.score, r.members) }
        })
        .collect())
}

fn print_table(whole: &Whole, folder: Option<&std::path::Path>) {
    if whole.grasps.is_empty() {
        println!(
            "no grasp found for gripper {} ({} pixels of an object)",
            whole.gripper, whole.object_pixels
        );
    } else {
        println!(
            "{:>2} {:>8} {:>8} {:>10} {:>10} {:>26}",
            "", "quality", "members", "width (m)", "open (m)", "tips' middle (m)"
        );
    }
    for (i, g) in whole.grasps.iter().enumerate() {
        let t: Vec<String> = g.camera_from_gripper[..3].iter().map(|r| format!("{:8.4}", r[3])).collect();
        println!(
            "{:>2} {:>8.3} {:>8} {:>10.4} {:>10.4} {:>26}",
            i + 1,
            g.quality,
            g.cluster_members,
            g.width,
            g.opening,
            t.join(" ")
        );
    }
    if let Some(folder) = folder {
        println!("grasps.json and overlay.png are in {}", folder.display());
    }
}
