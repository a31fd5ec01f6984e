//! `sixfold grasp compare`: geometry, experience and both, on the same simulated scenes (table 6.2).

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use clap::Args;
use serde::{Deserialize, Serialize};
use sixfold_dgcm::transfer::{Memory, Ranked};
use sixfold_experience::StorePlace;
use sixfold_grasp::{AntipodalOptions, DrawnGrasp, Gripper, draw_grasps};
use sixfold_io::write_rgb;
use sixfold_mesh::Mesh;
use sixfold_simulation::{
    AttemptOptions, AttemptOutcome, ConvexParts, PartsOptions, Scene, SimulatedView, scene, try_grasp,
    wilson_interval_of_fraction,
};

use super::ways::{METHODS, RULES, Ways};
use sixfold_shell::Outcome;
use sixfold_shell::grasp::experience::{NetworkArguments, memory, model, store_place};
use sixfold_shell::grasp::journal::Journal;
use sixfold_shell::grasp::object_list::{ObjectsArguments, file_name, named_objects};
use sixfold_shell::grasp::planner::Planner;
use sixfold_shell::grasp::trial::{Hardness, PhysicsArguments, hardness, outcome_name};
use sixfold_shell::output::{JsonArguments, report, write_atomically};
use sixfold_shell::overlay;
use sixfold_shell::progress::{Progress, check_interrupt};
use sixfold_shell::ranges::in_range;

/// Images of this many scenes of each object are kept.
const PICTURES: u64 = 2;
#[derive(Debug, Args)]
pub(crate) struct CompareArguments {
    /// The store of experiences, a file or postgres://user@host/database
    #[arg(long, value_name = "FILE", value_parser = store_place())]
    pub experiences: StorePlace,
    #[command(flatten)]
    pub objects: ObjectsArguments,
    /// Scenes of each object
    #[arg(long, value_name = "N", default_value = "15")]
    pub trials: u64,
    /// A harder setting: twice the sensor noise and lost edges, errors of the gripper's pose of 5 mm and 3 degrees (standard
    /// deviation per axis), friction of 0.25, unknown to the planner, objects of 0.5 kg
    #[arg(long)]
    pub hard: bool,
    /// Number of tries of each grasp, each with another error of the gripper's pose; more tries reduce random variation (only with
    /// --hard: without errors all tries are the same)
    #[arg(long, value_name = "N", default_value = "1")]
    pub tries: usize,
    /// Compare DGCM-Net in the published form with itself, one of its rules at a time replaced by ours, instead of the planners
    #[arg(long)]
    pub published_rules: bool,
    #[command(flatten)]
    pub physics: PhysicsArguments,
    #[command(flatten)]
    pub network: NetworkArguments,
    /// Trained GPD: a file that `sixfold train planner` wrote (default: the one that comes with Sixfold)
    #[arg(long, value_name = "FILE")]
    pub gpd: Option<PathBuf>,
    /// Trained HAF: a file that `sixfold train planner` wrote (default: the one that comes with Sixfold)
    #[arg(long, value_name = "FILE")]
    pub haf: Option<PathBuf>,
    /// Folder for trials.jsonl (from which a stopped run resumes), table.json and images of the first scenes
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Seed of poses, view points, noise and the planner
    #[arg(long, default_value = "0")]
    pub seed: u64,
    #[command(flatten)]
    pub json: JsonArguments,
}

/// One method on one scene.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Row {
    class: String,
    object: String,
    number: u64,
    method: String,
    /// Outcome of the first try.
    ending: String,
    /// Tries that held.
    held: usize,
    /// Whether the object came to rest; otherwise the row does not count as an attempt.
    counts: bool,
    /// Distance of the nearest experience's feature.
    nearest: Option<f64>,
    /// Number of candidates from geometry and from experience.
    candidates: (usize, usize),
    /// Whether the tried grasp was one transferred from experience.
    transferred: bool,
    seconds: f64,
    trial_seconds: f64,
}

#[derive(Serialize)]
struct Recorded<'a> {
    objects: Vec<&'a str>,
    trials: u64,
    tries: usize,
    hard: bool,
    seed: u64,
    network: String,
    planners: [String; 2],
    experiences: usize,
    outcomes: usize,
    methods: Vec<&'a str>,
    gripper: &'a Gripper,
    mass: f64,
}

/// The result of the comparison.
#[derive(Serialize)]
pub(crate) struct Whole {
    hard: bool,
    /// Tries of each grasp.
    tries: usize,
    experiences: usize,
    outcomes: usize,
    friction: f64,
    mass: f64,
    pub classes: Vec<Class>,
    /// In the order of the methods.
    pub median_seconds: Vec<f64>,
    methods: Vec<&'static str>,
}

#[derive(Serialize)]
pub(crate) struct Class {
    pub class: String,
    pub trials: usize,
    /// In the order of the methods.
    pub rates: Vec<f64>,
    /// Wilson intervals, 95 %.
    pub intervals: Vec<(f64, f64)>,
}

pub(crate) fn run(a: &CompareArguments) -> Result<Outcome> {
    in_range("--trials", a.trials, 1..=1_000_000)?;
    in_range("--tries", a.tries, 1..=1000)?;
    let whole = compare(a)?;
    report(&a.json, &whole, || print_table(&whole))?;
    Ok(if whole.classes.iter().any(|c| c.rates.iter().any(|r| *r > 0.0)) {
        Outcome::Found
    } else {
        Outcome::NothingFound
    })
}

impl CompareArguments {
    fn methods(&self) -> Vec<&'static str> {
        if self.published_rules { RULES.iter().map(|r| r.name).collect() } else { METHODS.to_vec() }
    }
}

/// Runs the comparison, or resumes it.
pub(crate) fn compare(a: &CompareArguments) -> Result<Whole> {
    if a.trials == 0 {
        bail!("--trials: found 0, expected at least 1");
    }
    if a.tries == 0 || a.tries > 1 && !a.hard {
        bail!(
            "--tries: found {}, expected at least 1, and 1 without --hard: without errors of the gripper's \
             pose all tries are the same",
            a.tries
        );
    }
    let setting = hardness(&a.physics, a.hard)?;
    let Hardness { gripper, real, options, .. } = &setting;
    let network = model(&a.network)?;
    let mut memory = memory(&a.experiences, &network)?;
    let planners =
        [Planner::gpd(a.gpd.as_deref()).context("--gpd")?, Planner::haf(a.haf.as_deref()).context("--haf")?];
    let objects = named_objects(&a.objects)?;
    let recorded = Recorded {
        objects: objects.iter().map(|o| o.1.as_str()).collect(),
        trials: a.trials,
        tries: a.tries,
        hard: a.hard,
        seed: a.seed,
        network: network.fingerprint(),
        planners: planners.each_ref().map(Planner::fingerprint),
        experiences: memory.len(),
        outcomes: memory.outcomes(&gripper.name).attempts,
        methods: a.methods(),
        gripper: real,
        mass: options.trial.mass,
    };
    let file = a.out.join("trials.jsonl");
    let (mut journal, mut rows) = Journal::open_groups::<Row>(&file, &recorded, recorded.methods.len())?;
    let mut progress = Progress::new("scenes", objects.len() * a.trials as usize);
    let ways = Ways { gripper, network: &network, planners: &planners };
    let scenes = Scenes { a, setting: &setting, options, ways };
    for (class, name, mesh) in &objects {
        let done = |number: u64| rows.iter().any(|r| r.object == *name && r.number == number);
        let missing: Vec<u64> = (0..a.trials).filter(|n| !done(*n)).collect();
        (missing.len()..a.trials as usize).for_each(|_| progress.step(name.clone()));
        if missing.is_empty() {
            continue;
        }
        let parts = ConvexParts::of_mesh(mesh, &PartsOptions::default()).with_context(|| name.clone())?;
        for number in missing {
            check_interrupt("finished scenes are kept; run the same command again to continue")?;
            let new = scenes.rows(class, name, mesh, &parts, number, &mut memory)?;
            journal.group(&new)?;
            rows.extend(new);
            progress.step(name.clone());
        }
    }
    progress.finish();
    let whole = Whole {
        hard: a.hard,
        tries: a.tries,
        experiences: memory.len(),
        outcomes: memory.outcomes(&gripper.name).attempts,
        friction: real.friction,
        mass: options.trial.mass,
        classes: classes(&rows, a.tries, &a.methods()),
        median_seconds: a.methods().iter().map(|m| median_seconds(&rows, m)).collect(),
        methods: a.methods(),
    };
    write_atomically(&a.out.join("table.json"), serde_json::to_string_pretty(&whole)?.as_bytes())?;
    Ok(whole)
}

struct Scenes<'a> {
    a: &'a CompareArguments,
    setting: &'a Hardness,
    options: &'a AttemptOptions,
    ways: Ways<'a>,
}

impl Scenes<'_> {
    /// All methods on one scene.
    fn rows(
        &self,
        class: &str,
        name: &str,
        mesh: &Mesh,
        parts: &ConvexParts,
        number: u64,
        memory: &mut Memory,
    ) -> Result<Vec<Row>> {
        let scene = scene(mesh, parts, self.options, self.a.seed, number);
        let empty = Row {
            class: class.to_owned(),
            object: name.to_owned(),
            number,
            method: String::new(),
            ending: outcome_name(scene.ending),
            held: 0,
            counts: scene.ending != AttemptOutcome::NoRest,
            nearest: None,
            candidates: (0, 0),
            transferred: false,
            seconds: scene.seconds,
            trial_seconds: 0.0,
        };
        let methods = self.a.methods().into_iter();
        let rows: Vec<Row> = methods.map(|m| Row { method: m.to_owned(), ..empty.clone() }).collect();
        let (Some(view), Some(seen)) = (&scene.view, &scene.seen) else { return Ok(rows) };
        let planner = AntipodalOptions { seed: scene.noise, ..self.options.planner };
        let answers = if self.a.published_rules {
            self.ways.answers_by_rules(view, &planner, memory)?
        } else {
            self.ways.answers(view, &planner, memory)?
        };
        let mut out = vec![];
        for (mut row, (ranked, seconds)) in rows.into_iter().zip(&answers.ranked) {
            row.nearest = answers.nearest;
            row.candidates = answers.candidates;
            row.seconds += seconds;
            if let Some(best) = ranked.first() {
                self.attempt(&mut row, best, seen, &scene, parts)?;
                if number < PICTURES {
                    self.picture(&row, seen, best)?;
                }
            }
            out.push(row);
        }
        Ok(out)
    }

    /// Tries a method's first grasp the requested number of times.
    fn attempt(
        &self,
        row: &mut Row,
        best: &Ranked,
        seen: &SimulatedView,
        scene: &Scene,
        parts: &ConvexParts,
    ) -> Result<()> {
        let began = Instant::now();
        let sent = seen.world_from_camera * best.grasp.camera_from_gripper;
        for k in 0..self.a.tries {
            let tried = try_grasp(
                parts,
                &scene.world_from_object,
                &self.setting.real,
                &self.setting.reached(&sent, scene.noise.wrapping_add(k as u64)),
                best.grasp.opening,
                &self.options.trial,
            )?;
            let ending = AttemptOutcome::Tried(tried.outcome);
            row.held += usize::from(ending.is_success());
            if k == 0 {
                row.trial_seconds = began.elapsed().as_secs_f64();
                row.ending = outcome_name(ending);
            }
        }
        row.transferred = best.proposal.is_some();
        Ok(())
    }

    /// The view with the gripper that was tried: green when it held more often than not, red when not.
    fn picture(&self, row: &Row, seen: &SimulatedView, best: &Ranked) -> Result<()> {
        let color = if 2 * row.held > self.a.tries { [60, 220, 80] } else { [235, 70, 60] };
        let grasp = &best.grasp;
        let drawn =
            [DrawnGrasp { camera_from_gripper: grasp.camera_from_gripper, opening: grasp.opening, color }];
        let background = overlay::depth_picture(&seen.depth);
        let image = draw_grasps(&background, Some(&seen.depth), &seen.camera, &self.setting.gripper, &drawn)?;
        let name = format!("{}-{}-{}.png", file_name(&row.object), row.number, file_name(&row.method));
        Ok(write_rgb(&self.a.out.join(name), &image)?)
    }
}

fn median_seconds(rows: &[Row], method: &str) -> f64 {
    let mut seconds: Vec<f64> =
        rows.iter().filter(|r| r.method == method && r.counts).map(|r| r.seconds).collect();
    seconds.sort_by(f64::total_cmp);
    seconds.get(seconds.len() / 2).copied().unwrap_or(0.0)
}

fn classes(rows: &[Row], tries: usize, methods: &[&str]) -> Vec<Class> {
    let mut names: Vec<&str> = vec![];
    for row in rows {
        if !names.contains(&row.class.as_str()) {
            names.push(&row.class);
        }
    }
    let of = |name: &str, wanted: &dyn Fn(&Row) -> bool| {
        let (mut rates, mut intervals, mut trials) = (vec![], vec![], 0);
        for method in methods {
            let mine: Vec<&Row> =
                rows.iter().filter(|r| r.method == *method && r.counts && wanted(r)).collect();
            let held: usize = mine.iter().map(|r| r.held).sum();
            trials = mine.len();
            let rate = held as f64 / (tries * trials).max(1) as f64;
            rates.push(rate);
            intervals.push(wilson_interval_of_fraction(rate, trials));
        }
        Class { class: name.to_owned(), trials, rates, intervals }
    };
    let mut classes: Vec<Class> = names.iter().map(|n| of(n, &|r: &Row| r.class == *n)).collect();
    classes.push(of("all", &|_| true));
    classes
}

fn print_table(whole: &Whole) {
    let heads: Vec<String> = whole.methods.iter().map(|m| format!("{m:>20}")).collect();
    println!("{:>10} {:>7} {}", "", "scenes", heads.join(" "));
    for c in &whole.classes {
        let cells: Vec<String> = c
            .rates
            .iter()
            .zip(&c.intervals)
            .map(|(rate, (low, high))| format!("{:>20}", format!("{rate:.2} ({low:.2} to {high:.2})")))
            .collect();
        println!("{:>10} {:>7} {}", c.class, c.trials, cells.join(" "));
    }
    let seconds: Vec<String> = whole.median_seconds.iter().map(|s| format!("{s:.3}")).collect();
    println!("median seconds from depth to ranked grasps: {}", seconds.join(", "));
    println!(
        "{} experiences, {} outcomes; friction {}, {} kg; each grasp tried {} times; 95 % intervals after Wilson, by scenes",
        whole.experiences, whole.outcomes, whole.friction, whole.mass, whole.tries
    );
}
