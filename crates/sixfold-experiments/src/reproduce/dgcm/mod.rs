//! `sixfold reproduce dgcm`: the tables and figures of chapter 6 from one command, each part resumable.

mod handles;
mod offline;
mod pictures;
mod recorded;

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use clap::Args;
use serde::Serialize;
use sixfold_dgcm::model::DgcmModel;
use sixfold_experience::StorePlace;
use sixfold_io::write_rgb;

use self::handles::Handles;
use self::offline::{Answer, COUNTS, Form, Instance, Offline, Question, Size};
use self::pictures::Line;
use super::kept::{write_result, write_table};
use crate::grasp::compare::{self, CompareArguments};
use crate::grasp::ways::METHODS;
use sixfold_shell::Outcome;
use sixfold_shell::grasp::experience::{NetworkArguments, OutboxArguments, memory, model};
use sixfold_shell::grasp::learn::{self, Curve, LearnArguments, LearnPreset};
use sixfold_shell::grasp::object_list::{Named, ObjectsArguments, PartBox, file_name, objects_with_parts};
use sixfold_shell::grasp::planner::Planner;
use sixfold_shell::grasp::trial::{Hardness, PhysicsArguments, hardness};
use sixfold_shell::output::JsonArguments;

/// Values of `--figure`: figure 6.7 in all forms, by the network alone, and as published; figures 6.10 to 6.12, ours and as published;
/// figure 6.13.
const FIGURES: [&str; 6] = ["6.7", "6.7-network", "6.7-published", "6.10", "6.10-published", "6.13"];
/// Largest feature distance at which experience proposes a grasp (dissertation, section 6.3.2).
const NEAR: f64 = 0.9;
/// Runs of learning from an empty store, each with its own seed.
const RUNS: u64 = 4;
/// Number of tries of each grasp of table 6.2, each with another error of the hand.
const TRIES: usize = 4;
/// Classes that grasps of this hand hardly ever hold in the hard setting; the averages are given with and without them.
const HARDLY: [&str; 2] = ["plate", "scissors"];
/// Objects that are learned from an empty store, by the end of the mesh's path.
const FROM_NOTHING: [&str; 3] = ["PowerDrill.ply", "MustardBottle.ply", "Banana.ply"];

#[derive(Debug, Args)]
pub(crate) struct ReproduceDgcmArguments {
    /// List of test objects, as benches/grasp-objects.json
    #[arg(long, value_name = "FILE", required_unless_present = "recorded")]
    pub list: Option<PathBuf>,
    /// Measure figure 6.7 on recorded depth images with annotated grasps instead of simulated ones: JSON, [{"class": "mug", "object":
    /// "red mug", "depth": "1.png", "camera": "camera.json", "mask": "1-mask.png", "camera_from_gripper": [[...], ...], "width":
    /// 0.04}, ...], files relative to it (docs/published.md)
    #[arg(long, value_name = "FILE", conflicts_with_all = ["list", "meshes"], requires = "figure")]
    pub recorded: Option<PathBuf>,
    /// Folder that the list's meshes are in (default: the list's own)
    #[arg(long, value_name = "DIR")]
    pub meshes: Option<PathBuf>,
    /// Few scenes and views, for a quick check
    #[arg(long)]
    pub quick: bool,
    /// Measure only this figure of the dissertation: the errors of transferred grasps in all forms (6.7), by the network's
    /// hypotheses alone or as published; learning from an empty store (6.10, also 6.11 and 6.12), ours or as published; handles (6.13)
    #[arg(long, value_name = "FIGURE", value_parser = FIGURES)]
    pub figure: Option<String>,
    #[command(flatten)]
    pub network: NetworkArguments,
    /// Folder for table.md, reproduce.json, images and intermediate results
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Seed of all random numbers
    #[arg(long, default_value = "0")]
    pub seed: u64,
}

#[derive(Serialize)]
struct Whole {
    quick: bool,
    compare: compare::Whole,
    #[serde(flatten)]
    transfer: Transfer,
    incremental: Vec<FromNothing>,
    handles: Vec<handles::Row>,
}

/// Figure 6.7.
#[derive(Serialize)]
struct Transfer {
    curves: Vec<Point>,
    /// The same by the network's hypotheses alone.
    curves_network: Vec<Point>,
    /// The same in the published form, with the gripper at a fixed distance from the surface.
    curves_published: Vec<Point>,
    pairs: Vec<Pair>,
    stretched: Vec<Stretched>,
}

/// One object learned from an empty store, in several runs.
#[derive(Serialize)]
struct FromNothing {
    hard: bool,
    curves: Vec<Curve>,
}

impl FromNothing {
    fn setting(&self) -> &'static str {
        if self.hard { "hard" } else { "ordinary" }
    }
}

/// A point in the left part of figure 6.7.
#[derive(Serialize)]
struct Point {
    class: String,
    count: usize,
    all_classes: bool,
    asked: usize,
    /// Fractions within 5 cm and 15 degrees, and within 1 cm and 10 degrees.
    within: [f64; 2],
}

#[derive(Serialize)]
struct Pair {
    from: String,
    to: String,
    within: [f64; 2],
}

/// Results for objects stretched by at most a factor.
#[derive(Serialize)]
struct Stretched {
    /// The largest change of an axis: 1.2 means 1/1.2 to 1.2.
    up_to: f64,
    asked: usize,
    within: [f64; 2],
}

/// Both limits: 5 cm and 15 degrees, as published, and 1 cm and 10 degrees.
fn within<'a>(answers: impl IntoIterator<Item = &'a Answer>) -> (usize, [f64; 2]) {
    let mut count = 0usize;
    let mut near = [0usize; 2];
    for a in answers {
        count += 1;
        near[0] += usize::from(a.within(0.05, 15.0));
        near[1] += usize::from(a.within(0.01, 10.0));
    }
    (count, near.map(|n| n as f64 / count.max(1) as f64))
}

/// What the parts without a store share.
struct Context {
    setting: Hardness,
    network: DgcmModel,
    objects: Named,
    parts: Vec<Option<PartBox>>,
    instances: Vec<Instance>,
    /// A hash of the list of recorded views.
    recorded: Option<u64>,
}

impl Context {
    fn of(a: &ReproduceDgcmArguments) -> Result<Context> {
        let setting = hardness(&physics(), true)?;
        let network = model(&a.network)?;
        if let Some(list) = &a.recorded {
            let (instances, hash) = recorded::instances(list, &setting.gripper)?;
            let (objects, parts) = Default::default();
            return Ok(Context { setting, network, objects, parts, instances, recorded: Some(hash) });
        }
        let (objects, parts) = objects_with_parts(&a.objects())?;
        let instances = offline::instances(&objects, &setting.gripper);
        if instances.is_empty() {
            let list = a.list.as_deref().unwrap_or(Path::new("--list"));
            bail!("{}: no object that {} could hold from above", list.display(), setting.gripper.name);
        }
        Ok(Context { setting, network, objects, parts, instances, recorded: None })
    }

    /// Figure 6.13: grasps on handles.
    fn handles(&self, a: &ReproduceDgcmArguments) -> Result<Vec<handles::Row>> {
        let handled = a.out.join("handles").join("experience.db");
        learn::learn(&LearnArguments {
            families: vec!["mug".to_owned(), "drill".to_owned()],
            members: if a.quick { 1 } else { 12 },
            // The question is where the grasp is, not whether this hand could lift the object with it: the easy setting gives
            // more experience.
            hard: false,
            tries: 10,
            part: Some("handle".to_owned()),
            near: 0.0,
            ..a.learning("handles/learn", &handled, 4, vec![])
        })?;
        let Context { setting, network, objects, parts, .. } = self;
        let views = if a.quick { 2 } else { 10 };
        let planners = &[Planner::gpd(None)?, Planner::haf(None)?];
        let handles = Handles { objects, parts, network, planners, setting, views, seed: a.seed };
        handles.run(&mut memory(&StorePlace::File(handled), network)?, &a.out.join("handles"))
    }

    /// Figure 6.7 in both forms.
    fn transfer(&self, a: &ReproduceDgcmArguments) -> Result<Transfer> {
        let wanted = |form| a.figure.as_deref().is_none_or(|f| f == FIGURES[0] || f == FIGURES[form]);
        let size = if a.quick {
            Size { views: 1, rounds: 1, stretched: 2 }
        } else {
            Size { views: 6, rounds: 5, stretched: 24 }
        };
        // Views as from a camera; the hand's error is not simulated here.
        let answers = |form, folder| {
            Offline {
                instances: &self.instances,
                recorded: self.recorded,
                network: &self.network,
                gripper: &self.setting.gripper,
                options: &self.setting.options,
                size,
                form,
                seed: a.seed,
            }
            .run(&a.out.join(folder))
        };
        let ours = if wanted(0) { answers(Form::Ours, "offline")? } else { vec![] };
        let network = if wanted(1) { answers(Form::Network, "offline-network")? } else { vec![] };
        let published = if wanted(2) { answers(Form::Published, "offline-published")? } else { vec![] };
        // Pairs and stretched copies are shown in one form.
        let shown = [&ours, &network, &published].into_iter().find(|answers| !answers.is_empty());
        let shown = shown.map_or(&[][..], Vec::as_slice);
        Ok(Transfer {
            curves: points(&ours),
            curves_network: points(&network),
            curves_published: points(&published),
            pairs: pairs(&self.instances, shown),
            stretched: stretched(shown),
        })
    }
}

pub(crate) fn run(a: &ReproduceDgcmArguments, json: &JsonArguments) -> Result<Outcome> {
    if let Some(figure) = a.figure.as_deref() {
        if a.recorded.is_some() && !figure.starts_with("6.7") {
            bail!("--recorded: found --figure {figure}, expected 6.7, 6.7-network or 6.7-published");
        }
        let context = Context::of(a)?;
        match figure {
            "6.10" | "6.10-published" => {
                let preset = (figure != "6.10").then_some(LearnPreset::Published);
                let learned = from_nothing(a, &context.objects, preset)?;
                draw_learning(&learned, &a.out)?;
                let text = learning_markdown(&learned);
                write_result(&a.out, "learning.json", &text, &learned, "learning.json is", json)?;
            }
            "6.13" => {
                let rows = context.handles(a)?;
                write_result(
                    &a.out,
                    "handles.json",
                    &handles_markdown(&rows),
                    &rows,
                    "handles.json is",
                    json,
                )?;
            }
            _ => {
                let transfer = context.transfer(a)?;
                transfer.draw(&a.out, &context.instances)?;
                let mut text = String::new();
                transfer.add_markdown(&mut text);
                write_result(&a.out, "transfer.json", &text, &transfer, "transfer.json is", json)?;
            }
        }
        return Ok(Outcome::Found);
    }
    let experiences = a.out.join("experience.db");
    eprintln!("1 of 5: experience on synthetic objects");
    learn::learn(&LearnArguments {
        families: vec!["all".to_owned()],
        members: if a.quick { 1 } else { 5 },
        tries: 2,
        explore: 8,
        near: 0.0,
        ..a.learning("learn", &experiences, 4, vec![])
    })?;
    eprintln!("2 of 5: table 6.2, geometry and experience on the same scenes");
    let compare = compare::compare(&CompareArguments {
        experiences: StorePlace::File(experiences.clone()),
        objects: a.objects(),
        trials: if a.quick { 1 } else { 15 },
        tries: TRIES,
        hard: true,
        published_rules: false,
        physics: physics(),
        network: NetworkArguments { weights: a.network.weights.clone() },
        gpd: None,
        haf: None,
        out: a.out.join("compare"),
        seed: a.seed,
        json: JsonArguments::default(),
    })?;
    eprintln!("3 of 5: figure 6.7, against the number of experiences and between objects");
    let context = Context::of(a)?;
    let transfer = context.transfer(a)?;
    eprintln!("4 of 5: figures 6.10 to 6.12, learning from nothing");
    let incremental = from_nothing(a, &context.objects, None)?;
    eprintln!("5 of 5: figure 6.13, handles");
    let handles = context.handles(a)?;
    let whole = Whole { quick: a.quick, compare, transfer, incremental, handles };
    whole.draw(&a.out, &context.instances)?;
    write_table(&a.out, &whole.markdown(), &whole, "table.md, reproduce.json and images are", json)?;
    Ok(Outcome::Found)
}

/// Figures 6.10 to 6.12: objects learned from an empty store.
fn from_nothing(
    a: &ReproduceDgcmArguments,
    objects: &Named,
    preset: Option<LearnPreset>,
) -> Result<Vec<FromNothing>> {
    let kept = if preset.is_some() { "incremental-published" } else { "incremental" };
    let mut incremental = vec![];
    for (name, path) in objects.iter().map(|o| (&o.1, a.path_of(&o.1))) {
        if !FROM_NOTHING.iter().any(|end| name.ends_with(end)) {
            continue;
        }
        for hard in [false, true] {
            let mut curves = vec![];
            for run in 0..if a.quick { 1 } else { RUNS } {
                let setting = if hard { "hard" } else { "ordinary" };
                let folder = format!("{kept}/{}-{setting}-{run}", file_name(name));
                let store = a.out.join(&folder).join("experience.db");
                let attempts = if a.quick { 3 } else { 16 };
                let learned = learn::learn(&LearnArguments {
                    hard,
                    seed: a.seed + run,
                    preset,
                    ..a.learning(&folder, &store, attempts, vec![path.clone()])
                })?;
                curves.extend(learned.objects);
            }
            incremental.push(FromNothing { hard, curves });
        }
    }
    Ok(incremental)
}

/// The command line's defaults.
fn physics() -> PhysicsArguments {
    PhysicsArguments { gripper: "jaws-140".to_owned(), mass: None, friction: None, force: None }
}

impl ReproduceDgcmArguments {
    fn objects(&self) -> ObjectsArguments {
        ObjectsArguments {
            list: self.list.clone(),
            meshes: self.meshes.clone(),
            ..ObjectsArguments::default()
        }
    }

    fn path_of(&self, name: &str) -> String {
        let of_list = || self.list.as_deref().and_then(Path::parent).map(Path::to_path_buf);
        let folder = self.meshes.clone().or_else(of_list);
        folder.unwrap_or_default().join(name).display().to_string()
    }

    /// Arguments of learning in the hard setting, on meshes in millimetres or on the objects added later.
    fn learning(&self, folder: &str, store: &Path, attempts: u64, meshes: Vec<String>) -> LearnArguments {
        LearnArguments {
            experiences: StorePlace::File(store.to_path_buf()),
            outbox: OutboxArguments::default(),
            families: vec![],
            members: 1,
            objects: ObjectsArguments {
                objects: meshes,
                unit: Some(sixfold_mesh::Unit::Millimetre),
                ..ObjectsArguments::default()
            },
            attempts,
            tries: 1,
            explore: 0,
            preset: None,
            near: NEAR,
            part: None,
            hard: true,
            physics: physics(),
            network: NetworkArguments { weights: self.network.weights.clone() },
            out: self.out.join(folder),
            seed: self.seed,
            json: JsonArguments::default(),
        }
    }
}

fn points(answers: &[Answer]) -> Vec<Point> {
    let mut classes: Vec<&String> = vec![];
    for a in answers {
        if let Question::Count { class, .. } = &a.question
            && !classes.contains(&class)
        {
            classes.push(class);
        }
    }
    let mut points = vec![];
    for wanted in classes {
        for all_classes in [false, true] {
            for wanted_count in COUNTS {
                let (asked, within) = within(answers.iter().filter(|a| {
                    matches!(&a.question, Question::Count { class, count, all, .. }
                        if class == wanted && *count == wanted_count && *all == all_classes)
                }));
                points.push(Point { class: wanted.clone(), count: wanted_count, all_classes, asked, within });
            }
        }
    }
    points
}

/// The mean over all classes for a number of experiences.
fn mean_cell(curves: &[Point], count: usize, all: bool) -> String {
    let some: Vec<&Point> = curves.iter().filter(|p| p.count == count && p.all_classes == all).collect();
    let mean = |k: usize| some.iter().map(|p| p.within[k]).sum::<f64>() / some.len().max(1) as f64;
    format!("{:.2} / {:.2}", mean(0), mean(1))
}

fn pairs(instances: &[Instance], answers: &[Answer]) -> Vec<Pair> {
    let mut pairs = vec![];
    for a in instances {
        for b in instances {
            let (asked, within) = within(answers.iter().filter(
                |x| matches!(&x.question, Question::Pair { from, to, .. } if *from == a.name && *to == b.name),
            ));
            if asked > 0 {
                pairs.push(Pair { from: a.name.clone(), to: b.name.clone(), within });
            }
        }
    }
    pairs
}

fn stretched(answers: &[Answer]) -> Vec<Stretched> {
    let change = |a: &Answer| match &a.question {
        Question::Stretched { factors, .. } => {
            let largest = factors.iter().map(|f| (*f as f64 / 100.0).ln().abs()).fold(0.0, f64::max);
            Some(largest.exp())
        }
        _ => None,
    };
    let mut low = 1.0;
    [1.4, 1.7, 2.01]
        .into_iter()
        .map(|up_to| {
            let (asked, within) =
                within(answers.iter().filter(|a| change(a).is_some_and(|c| c > low && c <= up_to)));
            low = up_to;
            Stretched { up_to, asked, within }
        })
        .collect()
}

impl Transfer {
    fn draw(&self, folder: &Path, instances: &[Instance]) -> Result<()> {
        for (k, name) in ["5 cm and 15 degrees", "1 cm and 10 degrees"].iter().enumerate() {
            let mut lines: Vec<Line> = vec![];
            for p in &self.curves {
                let Some(column) = COUNTS.iter().position(|c| *c == p.count) else { continue };
                match lines.iter_mut().find(|l| l.class == p.class && l.all == p.all_classes) {
                    Some(line) => line.fractions[column] = p.within[k],
                    None => {
                        let mut fractions = [0.0; COUNTS.len()];
                        fractions[column] = p.within[k];
                        lines.push(Line { class: p.class.clone(), all: p.all_classes, fractions });
                    }
                }
            }
            let tag = ["5cm", "1cm"][k];
            let title = format!("grasps within {name}");
            write_rgb(&folder.join(format!("experience-{tag}.png")), &pictures::curves(&title, &lines))?;
            let names: Vec<String> = instances.iter().map(short).collect();
            let fractions: Vec<Vec<Option<f64>>> = instances
                .iter()
                .map(|a| {
                    let find = |b: &Instance| {
                        self.pairs.iter().find(|p| p.from == a.name && p.to == b.name).map(|p| p.within[k])
                    };
                    instances.iter().map(find).collect()
                })
                .collect();
            let picture = pictures::matrix(&title, &names, &fractions);
            write_rgb(&folder.join(format!("between-objects-{tag}.png")), &picture)?;
        }
        Ok(())
    }

    fn add_markdown(&self, out: &mut String) {
        *out += "\nNearness to the wanted grasp from above (figure 6.7): within 5 cm and 15 degrees / 1 cm and 10 degrees\n\n";
        let heads: Vec<String> = COUNTS.iter().map(|n| format!("{n} per object")).collect();
        let _ = writeln!(out, "| class | experience of | {} |", heads.join(" | "));
        let _ = writeln!(out, "|---|---|{}", "---|".repeat(COUNTS.len()));
        let mut add = |curves: &[Point], of: [&str; 2]| {
            for row in curves.chunks(COUNTS.len()) {
                let Some(first) = row.first() else { continue };
                let of = of[usize::from(first.all_classes)];
                let cells: Vec<String> =
                    row.iter().map(|p| format!("{:.2} / {:.2}", p.within[0], p.within[1])).collect();
                let _ = writeln!(out, "| {} | {of} | {} |", first.class, cells.join(" | "));
            }
            for all in [false, true].into_iter().filter(|_| !curves.is_empty()) {
                let cells: Vec<String> = COUNTS.iter().map(|n| mean_cell(curves, *n, all)).collect();
                let _ = writeln!(out, "| mean | {} | {} |", of[usize::from(all)], cells.join(" | "));
            }
        };
        add(&self.curves, ["its class", "all classes"]);
        add(&self.curves_network, ["its class, network alone", "all classes, network alone"]);
        add(&self.curves_published, ["its class, as published", "all classes, as published"]);
        let mean_pair = |same: bool| {
            let some: Vec<&Pair> = self.pairs.iter().filter(|p| (p.from == p.to) == same).collect();
            let mean = |k: usize| some.iter().map(|p| p.within[k]).sum::<f64>() / some.len().max(1) as f64;
            format!("{:.2} / {:.2}", mean(0), mean(1))
        };
        let _ = writeln!(
            out,
            "\nAll experience of one object, grasp on the same one {}, on another {} (between-objects-5cm.png)\n",
            mean_pair(true),
            mean_pair(false)
        );
        if self.stretched.iter().all(|s| s.asked == 0) {
            return;
        }
        *out += "Experience of an object, grasp on the same one stretched along each axis\n\n| largest change of an axis | views | within |\n|---|---|---|\n";
        for s in &self.stretched {
            let _ = writeln!(
                out,
                "| up to {:.1} times | {} | {:.2} / {:.2} |",
                s.up_to, s.asked, s.within[0], s.within[1]
            );
        }
    }
}

impl Whole {
    fn draw(&self, folder: &Path, instances: &[Instance]) -> Result<()> {
        self.transfer.draw(folder, instances)?;
        draw_learning(&self.incremental, folder)
    }

    fn markdown(&self) -> String {
        let mut out = String::new();
        if self.quick {
            out += "**Quick: a check, not a measurement.**\n\n";
        }
        let c = &self.compare;
        let _ = writeln!(
            out,
            "Fraction of grasps that held (table 6.2), hard setting, each tried with {TRIES} errors of the hand, with 95 % intervals \
             after Wilson as if tried once\n"
        );
        let _ = writeln!(out, "| class | scenes | {} |", METHODS.join(" | "));
        let _ = writeln!(out, "|---|---|{}", "---|".repeat(METHODS.len()));
        for class in &c.classes {
            let cells: Vec<String> = class
                .rates
                .iter()
                .zip(&class.intervals)
                .map(|(rate, (low, high))| format!("{rate:.2} ({low:.2} to {high:.2})"))
                .collect();
            let _ = writeln!(out, "| {} | {} | {} |", class.class, class.trials, cells.join(" | "));
        }
        let mean = |left_out: &[&str]| -> Vec<String> {
            let some: Vec<_> = c
                .classes
                .iter()
                .filter(|x| x.class != "all" && !left_out.contains(&x.class.as_str()))
                .collect();
            (0..METHODS.len())
                .map(|k| {
                    let sum: f64 = some.iter().map(|x| x.rates[k]).sum();
                    format!("{:.3}", sum / some.len().max(1) as f64)
                })
                .collect()
        };
        let _ = writeln!(out, "| mean of classes | | {} |", mean(&[]).join(" | "));
        let _ = writeln!(out, "| mean without {} | | {} |", HARDLY.join(" and "), mean(&HARDLY).join(" | "));
        let seconds: Vec<String> = c.median_seconds.iter().map(|s| format!("{s:.2}")).collect();
        let _ = writeln!(out, "| median seconds to ranked grasps | | {} |", seconds.join(" | "));
        self.transfer.add_markdown(&mut out);
        out += &learning_markdown(&self.incremental);
        out += &handles_markdown(&self.handles);
        out
    }
}

/// The table of figures 6.10 to 6.12.
fn learning_markdown(incremental: &[FromNothing]) -> String {
    let mut out = String::new();
    out += "\nLearning from nothing (figures 6.10 to 6.12): attempts of the first run in their order, G geometry, E experience, capitals held; successes of all runs\n\n| object | setting | attempts | held after the second success |\n|---|---|---|---|\n";
    for of_object in incremental {
        let Some(first) = of_object.curves.first() else { continue };
        let (held, of) = of_object
            .curves
            .iter()
            .map(|c| after_second(&c.held))
            .fold((0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        let _ = writeln!(
            out,
            "| {} | {} | {} | {held} of {of} |",
            first.object,
            of_object.setting(),
            learn::marks(first)
        );
    }
    out
}

/// The table of figure 6.13.
fn handles_markdown(rows: &[handles::Row]) -> String {
    let mut out = String::new();
    out += "\nFirst grasp on the handle (figure 6.13), number of views that show it: with experience on handles, ours, as published alone and joined with GPD; by planners\n\n";
    let heads = handles::METHODS.map(|m| m.0).join(" | ");
    let _ = writeln!(out, "| object | views | {heads} |\n|---|---|{}", "---|".repeat(handles::METHODS.len()));
    let mut names: Vec<&String> = vec![];
    for row in rows {
        if !names.contains(&&row.object) {
            names.push(&row.object);
        }
    }
    for name in names {
        let rows: Vec<_> = rows.iter().filter(|r| r.object == *name).collect();
        let counts = handles::METHODS
            .map(|(_, on_handle)| rows.iter().filter(|r| on_handle(r) == Some(true)).count().to_string());
        let _ = writeln!(out, "| {name} | {} | {} |", rows.len(), counts.join(" | "));
    }
    out
}

/// Figures 6.10 to 6.12 as an image.
fn draw_learning(incremental: &[FromNothing], folder: &Path) -> Result<()> {
    let first: Vec<(&str, &Curve)> =
        incremental.iter().filter_map(|o| Some((o.setting(), o.curves.first()?))).collect();
    Ok(write_rgb(&folder.join("incremental.png"), &pictures::incremental(&first, NEAR))?)
}

/// The number of successful attempts after the second success, and the number of these attempts.
fn after_second(held: &[bool]) -> (usize, usize) {
    let second = held.iter().enumerate().filter(|(_, h)| **h).nth(1).map_or(held.len(), |(k, _)| k + 1);
    (held[second..].iter().filter(|h| **h).count(), held.len() - second)
}

/// An object's name for an image.
fn short(instance: &Instance) -> String {
    let name = instance.name.trim_end_matches("/textured.obj");
    let name = name.rsplit('/').next().unwrap_or(name);
    name.trim_end_matches(".ply").to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn successes_after_the_second_one() {
        assert_eq!(after_second(&[false, true, false, true, true, false, true]), (2, 3));
        assert_eq!(after_second(&[true, false]), (0, 0));
        assert_eq!(after_second(&[]), (0, 0));
    }
}
