//! `sixfold demo`: all steps on the sample frames, from files to scored poses and images.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use sixfold_bop::score_table;
use sixfold_shell::Outcome;
use sixfold_shell::demo::{Demo, DemoFiles};
use sixfold_shell::folder::OutputFolder;
use sixfold_shell::output::{JsonArguments, report};
use sixfold_shell::pictures::Pictures;

#[derive(Debug, Args)]
pub(crate) struct DemoArguments {
    /// Folder for results and images
    #[arg(long, default_value = "out/demo", value_name = "DIR")]
    pub out: PathBuf,
    /// Folder of the sample data (default: the one that comes with Sixfold, docs/install.md)
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Weights for poses from colour (default: those that come with Sixfold)
    #[arg(long, value_name = "FILE.safetensors")]
    pub weights: Option<PathBuf>,
    /// Weights of the detector (default: those that come with Sixfold)
    #[arg(long, value_name = "FILE.safetensors")]
    pub detector: Option<PathBuf>,
    #[command(flatten)]
    pub json: JsonArguments,
}

pub(crate) fn run(a: &DemoArguments) -> Result<Outcome> {
    let mut out = Pictures::of(Some(OutputFolder::take(&a.out)?));
    let files =
        DemoFiles { data: a.data.as_deref(), weights: a.weights.as_deref(), detector: a.detector.as_deref() };
    let demo = Demo::run(&files, &a.out.join("objects"), &mut out)?;
    report(&a.json, &demo, || print_tables(&demo))?;
    Ok(out.outcome(if demo.poses.is_empty() { Outcome::NothingFound } else { Outcome::Found }))
}

fn print_tables(demo: &Demo) {
    println!(
        "{:>10} {:>10} {:>7} {:>12} {:>10} {:>11} {:>8}",
        "image", "depth", "object", "error (mm)", "of diam.", "confidence", "seconds"
    );
    for r in &demo.poses {
        println!(
            "{:>10} {:>10} {:>7} {:>12.1} {:>9.1}% {:>11.3} {:>8.2}",
            r.image,
            r.depth.unwrap_or("none"),
            r.object,
            r.add_s_mm,
            100.0 * r.add_s_of_diameter,
            r.confidence,
            r.seconds
        );
    }
    println!();
    print!("{}", score_table(&demo.evaluation));
    println!("\n{} of {} poses within 10 % of the diameter", demo.correct, demo.targets);
    print_colour(demo);
    println!("\n{:.1} s in all. Images:", demo.seconds);
    for p in demo.pictures.iter().chain(&demo.colour.pictures) {
        println!("  {}", p.display());
    }
}

/// Prints errors of poses from colour beside those from depth.
fn print_colour(demo: &Demo) {
    let colour = &demo.colour;
    if let Some(reason) = &colour.reason {
        println!("\nPoses from colour alone (Pix2Pose): none: {reason}");
        return;
    }
    let boxes = match colour.detector {
        Some(_) => "in the boxes that the detector finds",
        None => "in the boxes of the ground truth",
    };
    println!("\nPoses from colour alone (Pix2Pose), {boxes}; last column: the errors from depth above");
    println!(
        "{:>10} {:>7} {:>12} {:>10} {:>11} {:>8} {:>11}",
        "image", "object", "error (mm)", "of diam.", "confidence", "seconds", "from depth"
    );
    for r in &colour.poses {
        let depth = demo
            .error_from_depth(&r.image, r.object)
            .map_or_else(|| "-".into(), |s| format!("{:.1}%", 100.0 * s));
        println!(
            "{:>10} {:>7} {:>12.1} {:>9.1}% {:>11.3} {:>8.2} {depth:>11}",
            r.image,
            r.object,
            r.add_s_mm,
            100.0 * r.add_s_of_diameter,
            r.confidence,
            r.seconds
        );
    }
    println!("{} of {} poses from colour within 10 % of the diameter", colour.correct, colour.targets);
}
