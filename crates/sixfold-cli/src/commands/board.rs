//! `sixfold board`: the sheet of tags to print.

use std::path::PathBuf;

use anyhow::{Result, bail};
use clap::Args;
use serde_json::json;
use sixfold_board::{Board, Paper};
use sixfold_io::write_rgb;
use sixfold_shell::Outcome;
use sixfold_shell::output::{JsonArguments, report, write_atomically};

/// Pixels per millimetre of the PNG: 24 for a cell of a tag.
const DOTS: f64 = 8.0;

#[derive(Debug, Args)]
pub(crate) struct BoardArguments {
    /// Size of the paper: a4, a3, letter
    #[arg(long, value_name = "PAPER", default_value = "a4")]
    pub paper: Paper,
    /// File to write: .pdf for printing, .png for viewing
    #[arg(long, value_name = "FILE", default_value = "board.pdf")]
    pub out: PathBuf,
    #[command(flatten)]
    pub json: JsonArguments,
}

pub(crate) fn run(a: &BoardArguments) -> Result<Outcome> {
    let board = Board::new(a.paper);
    match a.out.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase).as_deref() {
        Some("pdf") => write_atomically(&a.out, &board.pdf())?,
        Some("png") => write_rgb(&a.out, &board.image(DOTS))?,
        _ => bail!("--out {}: expected a name that ends in .pdf or .png", a.out.display()),
    }
    let (width, height) = a.paper.size();
    let value = json!({
        "file": a.out,
        "paper": a.paper,
        "width": width,
        "height": height,
        "tags": board.len(),
        "tag_side": board.tag_side(),
        "ruler": 0.1,
    });
    report(&a.json, &value, || {
        println!("{}: {} tags of {:.0} mm", a.out.display(), board.len(), 1000.0 * board.tag_side());
        println!("print it at 100 %, and check that its ruler measures 100 mm");
    })?;
    Ok(Outcome::Found)
}
