//! `sixfold object symmetries` and `sixfold object add --find-symmetries`: rotations that map an object onto itself, with evidence.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use sixfold_io::write_rgb;
use sixfold_mesh::{
    FoundSymmetry, Mesh, ModelInfo, SymmetryOptions, Unit, Verdict, find_symmetries, sure_symmetries,
};
use sixfold_shell::output::{JsonArguments, report};
use sixfold_shell::symmetries::{ListedSymmetry, described, picture, table};
use sixfold_shell::{Outcome, objects, ranges};

use super::arguments::AddArguments;

/// `sixfold object symmetries`.
#[derive(Debug, Args)]
pub(crate) struct SymmetriesArguments {
    /// Mesh file or name of a stored object
    #[arg(value_name = "MESH_OR_NAME")]
    pub object: String,
    /// Unit of the mesh file: m, cm, mm, in
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// Noise of the mesh's surface, standard deviation in millimetres: 1 for a mesh from photographs or depth images
    #[arg(long, value_name = "MM", default_value_t = 0.0, value_parser = ranges::surface_noise)]
    pub noise: f64,
    /// Image to write: the object, and the object rotated by each symmetry, side by side
    #[arg(long, value_name = "FILE.png")]
    pub out: Option<PathBuf>,
}

/// What is held against itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Evidence {
    /// Shape alone: for methods that use depth
    Shape,
    /// Shape and colours, if the mesh has colours
    Colors,
}

pub(crate) fn run(a: &SymmetriesArguments, store: &Path, json: &JsonArguments) -> Result<Outcome> {
    let object = objects::find(&a.object, a.unit, store)?;
    let found = find(&object.mesh, a.noise)?;
    if let Some(file) = &a.out {
        write_rgb(file, &picture(&object.mesh, &found))?;
    }
    let listed: Vec<ListedSymmetry> = found.iter().map(ListedSymmetry::of).collect();
    report(json, &listed, || table(&object.name, object.info.diameter, &found))?;
    Ok(if found.is_empty() { Outcome::NothingFound } else { Outcome::Found })
}

fn find(mesh: &Mesh, noise: f64) -> Result<Vec<FoundSymmetry>> {
    find_symmetries(mesh, &SymmetryOptions { noise: noise * 1e-3, ..SymmetryOptions::default() })
        .with_context(|| format!("--noise: found {noise} mm"))
}

/// Adds the sure symmetries of a mesh to `info` if `add --find-symmetries` requests them; returns a description of what is stored
/// and what is not.
pub(crate) fn add_to(info: &mut ModelInfo, mesh: &Mesh, a: &AddArguments) -> Result<Vec<String>> {
    let Some(evidence) = a.find_symmetries else { return Ok(vec![]) };
    if info.is_symmetric() {
        bail!(
            "--find-symmetries: found symmetries of the object in --models-info already; leave out one of the two"
        );
    }
    let by_color = evidence == Evidence::Colors;
    let found = find(mesh, a.noise)?;
    (info.symmetries_discrete, info.symmetries_continuous) = sure_symmetries(&found, by_color);
    let line = |s: &FoundSymmetry| {
        let what = described(s);
        match s.verdict(by_color) {
            Verdict::Sure => format!("stored: {what}"),
            Verdict::Likely => format!("likely, not stored: {what}"),
            Verdict::None => format!("not stored, colours differ: {what}"),
        }
    };
    let none = || vec!["no symmetry found".to_owned()];
    Ok(if found.is_empty() { none() } else { found.iter().map(line).collect() })
}
