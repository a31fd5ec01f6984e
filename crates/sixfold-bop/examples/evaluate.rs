//! Scores a result file on a dataset and prints the JSON; with a third argument also draws the recall curves.
//!
//!     cargo run --release -p sixfold-bop --example evaluate -- DATASET RESULTS.csv [CURVES.png]

use std::error::Error;
use std::path::Path;

use sixfold_bop::{BopDataset, EvalOptions, evaluate, read_results, write_recall_curves};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [dataset, results, rest @ ..] = &args[..] else {
        return Err("usage: evaluate DATASET RESULTS.csv [CURVES.png]".into());
    };
    let dataset = BopDataset::open(Path::new(dataset), "test")?;
    let estimates = read_results(Path::new(results))?;
    let targets = dataset.targets(None)?;
    let found = evaluate(&dataset, &estimates, &targets, &EvalOptions::default(), &())?;
    println!("{}", serde_json::to_string_pretty(&found)?);
    if let Some(path) = rest.first() {
        write_recall_curves(Path::new(path), &found)?;
    }
    Ok(())
}
