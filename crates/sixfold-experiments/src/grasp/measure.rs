//! `sixfold grasp measure`: how often the planner's first proposal holds, per class, from single simulated depth views.

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use serde::Serialize;
use sixfold_geometry::RgbImage;
use sixfold_grasp::{DrawnGrasp, Gripper, draw_grasps};
use sixfold_simulation::{
    Attempt, AttemptOptions, AttemptOutcome, ConvexParts, PartsOptions, TrialOptions, TrialReport, attempt,
    wilson_interval,
};

use sixfold_shell::Outcome;
use sixfold_shell::folder::OutputFolder;
use sixfold_shell::grasp::object_list::{ObjectsArguments, file_name, named_objects};
use sixfold_shell::grasp::trial::{PhysicsArguments, outcome_name, physics};
use sixfold_shell::output::{JsonArguments, report};
use sixfold_shell::overlay;
use sixfold_shell::progress::{Progress, check_interrupt};

/// Images of this many attempts on each object are kept.
const PICTURES: u64 = 2;

#[derive(Debug, Args)]
pub(crate) struct MeasureArguments {
    #[command(flatten)]
    pub objects: ObjectsArguments,
    /// Attempts on each object
    #[arg(long, value_name = "N", default_value = "15", value_parser = sixfold_shell::ranges::count::<100_000>)]
    pub trials: NonZeroUsize,
    /// Let the objects fall in any orientation; otherwise they stand with their own z axis up
    #[arg(long)]
    pub any_orientation: bool,
    /// Ideal depth images, without a sensor's noise
    #[arg(long)]
    pub no_noise: bool,
    #[command(flatten)]
    pub physics: PhysicsArguments,
    /// Folder for trials.json (all poses and outcomes, the objects' convex parts) and images of the first attempts
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Seed of poses, view points, noise and the planner
    #[arg(long, default_value = "0")]
    pub seed: u64,
    #[command(flatten)]
    pub json: JsonArguments,
}

pub(super) fn run(a: &MeasureArguments) -> Result<Outcome> {
    let (gripper, trial) = physics(&a.physics)?;
    let mut options =
        AttemptOptions { any_orientation: a.any_orientation, trial, ..AttemptOptions::default() };
    if a.no_noise {
        options.sensor = None;
    }
    let objects = named_objects(&a.objects)?;
    let trials = a.trials.get() as u64;
    let mut progress = Progress::new("attempts", objects.len() * a.trials.get());
    let mut folder = a.out.as_deref().map(OutputFolder::take).transpose()?;
    let mut measured: Vec<Measured> = vec![];
    for (class, name, mesh) in &objects {
        let parts = ConvexParts::of_mesh(mesh, &PartsOptions::default()).with_context(|| name.clone())?;
        let mut done = Measured {
            class: class.clone(),
            name: name.clone(),
            trials: vec![],
            parts: parts.parts().iter().map(|part| part.iter().map(|&p| p.into()).collect()).collect(),
        };
        for number in 0..trials {
            check_interrupt("nothing was written")?;
            let result = attempt(mesh, &parts, &gripper, &options, a.seed, number)?;
            if let Some(folder) = folder.as_mut().filter(|_| number < PICTURES)
                && let Some(image) = picture(&gripper, &result)?
            {
                folder.write_rgb(&format!("{}-{number}.png", file_name(name)), &image)?;
            }
            done.trials.push(Tried::new(number, &result));
            progress.step(name.clone());
        }
        measured.push(done);
    }
    progress.finish();
    let whole = Whole {
        method: "antipodal",
        seed: a.seed,
        any_orientation: a.any_orientation,
        noise: !a.no_noise,
        classes: classes(&measured),
        gripper,
        trial,
        objects: measured,
    };
    if let Some(folder) = &mut folder {
        folder.write_text("trials.json", &serde_json::to_string(&whole)?)?;
    }
    report(&a.json, &whole, || print_table(&whole))?;
    Ok(if whole.classes.iter().any(|c| c.successes > 0) { Outcome::Found } else { Outcome::NothingFound })
}

#[derive(Serialize)]
struct Whole {
    method: &'static str,
    seed: u64,
    any_orientation: bool,
    noise: bool,
    gripper: Gripper,
    trial: TrialOptions,
    classes: Vec<Class>,
    objects: Vec<Measured>,
}

#[derive(Serialize)]
struct Class {
    class: String,
    trials: usize,
    successes: usize,
    rate: f64,
    /// Wilson interval, 95 %.
    interval: (f64, f64),
    endings: BTreeMap<String, usize>,
    median_planning_seconds: f64,
    median_trial_seconds: f64,
}

#[derive(Serialize)]
struct Measured {
    class: String,
    name: String,
    trials: Vec<Tried>,
    /// Corners of the convex parts, metres, in the object's frame.
    parts: Vec<Vec<[f64; 3]>>,
}

#[derive(Serialize)]
struct Tried {
    number: u64,
    ending: AttemptOutcome,
    world_from_object: [[f64; 4]; 4],
    world_from_gripper: Option<[[f64; 4]; 4]>,
    opening: Option<f64>,
    quality: Option<f64>,
    report: Option<TrialReport>,
    planning_seconds: f64,
    trial_seconds: f64,
}

impl Tried {
    fn new(number: u64, result: &Attempt) -> Tried {
        let best = result.proposals.first();
        let world_from_camera = result.view.as_ref().map(|v| v.world_from_camera);
        Tried {
            number,
            ending: result.ending,
            world_from_object: result.world_from_object.rows(),
            world_from_gripper: best.zip(world_from_camera).map(|(g, w)| (w * g.camera_from_gripper).rows()),
            opening: best.map(|g| g.opening),
            quality: best.map(|g| g.quality.total()),
            report: result.report,
            planning_seconds: result.planning_seconds,
            trial_seconds: result.trial_seconds,
        }
    }

    /// If the object did not come to rest, the attempt does not count.
    fn counts(&self) -> bool {
        self.ending != AttemptOutcome::NoRest
    }
}

fn classes(measured: &[Measured]) -> Vec<Class> {
    let mut names: Vec<&str> = vec![];
    for m in measured {
        if !names.contains(&m.class.as_str()) {
            names.push(&m.class);
        }
    }
    let summary = |class: &str, tried: &[&Tried]| {
        let counted: Vec<&&Tried> = tried.iter().filter(|t| t.counts()).collect();
        let successes = counted.iter().filter(|t| t.ending.is_success()).count();
        let mut endings = BTreeMap::new();
        for t in tried {
            *endings.entry(outcome_name(t.ending)).or_default() += 1;
        }
        let median = |mut values: Vec<f64>| {
            values.sort_by(f64::total_cmp);
            values.get(values.len() / 2).copied().unwrap_or(0.0)
        };
        Class {
            class: class.to_owned(),
            trials: counted.len(),
            successes,
            rate: successes as f64 / counted.len().max(1) as f64,
            interval: wilson_interval(successes, counted.len()),
            endings,
            median_planning_seconds: median(counted.iter().map(|t| t.planning_seconds).collect()),
            median_trial_seconds: median(
                counted.iter().filter(|t| t.report.is_some()).map(|t| t.trial_seconds).collect(),
            ),
        }
    };
    let mut classes: Vec<Class> = names
        .iter()
        .map(|name| {
            let tried: Vec<&Tried> =
                measured.iter().filter(|m| m.class == *name).flat_map(|m| &m.trials).collect();
            summary(name, &tried)
        })
        .collect();
    let all: Vec<&Tried> = measured.iter().flat_map(|m| &m.trials).collect();
    classes.push(summary("all", &all));
    classes
}

fn print_table(whole: &Whole) {
    println!(
        "{:<12} {:>6} {:>6} {:>6} {:>15} {:>9} {:>9}  outcomes",
        "class", "trials", "held", "rate", "95 % interval", "plan (s)", "trial (s)"
    );
    for c in &whole.classes {
        let endings: Vec<String> = c.endings.iter().map(|(name, n)| format!("{name} {n}")).collect();
        println!(
            "{:<12} {:>6} {:>6} {:>6.2} {:>15} {:>9.2} {:>9.2}  {}",
            c.class,
            c.trials,
            c.successes,
            c.rate,
            format!("{:.2} to {:.2}", c.interval.0, c.interval.1),
            c.median_planning_seconds,
            c.median_trial_seconds,
            endings.join(", ")
        );
    }
}

/// The view with the gripper that was tried: green when it held, red when not.
fn picture(gripper: &Gripper, result: &Attempt) -> Result<Option<RgbImage>> {
    let (Some(view), Some(best)) = (&result.view, result.proposals.first()) else { return Ok(None) };
    let color = if result.ending.is_success() { [60, 220, 80] } else { [235, 70, 60] };
    let drawn = [DrawnGrasp { camera_from_gripper: best.camera_from_gripper, opening: best.opening, color }];
    let background = overlay::depth_picture(&view.depth);
    Ok(Some(draw_grasps(&background, Some(&view.depth), &view.camera, gripper, &drawn)?))
}
