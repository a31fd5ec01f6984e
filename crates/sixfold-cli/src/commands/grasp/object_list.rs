//! The objects that simulated trials are made with: meshes by name, or a list in a file.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use serde::Deserialize;
use sixfold_geometry::Pose;
use sixfold_mesh::{Mesh, Unit, read_mesh};

use crate::objects;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Listed {
    class: String,
    mesh: PathBuf,
    unit: Unit,
    /// The axis of the mesh that points up when the object stands.
    #[serde(default)]
    up: Up,
}

#[derive(Deserialize, Default)]
#[serde(rename_all = "lowercase")]
enum Up {
    X,
    Y,
    #[default]
    Z,
}

impl Up {
    /// Turns the axis to z.
    fn turn(&self) -> Pose {
        let quarter = std::f64::consts::FRAC_PI_2;
        match self {
            Up::X => Pose::exp(&[0.0, 0.0, 0.0, 0.0, -quarter, 0.0].into()),
            Up::Y => Pose::exp(&[0.0, 0.0, 0.0, quarter, 0.0, 0.0].into()),
            Up::Z => Pose::identity(),
        }
    }
}

/// Objects by name, or by a list.
#[derive(Debug, Args)]
pub(crate) struct ObjectsArguments {
    /// Objects: mesh files, or names of stored objects; each is a class of its own
    #[arg(long = "object", value_name = "NAME_OR_MESH", num_args = 1..)]
    pub objects: Vec<String>,
    /// Unit of the mesh files: m, cm, mm, in
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// List of objects in place of --object: JSON, [{"class": "mug", "mesh": "mug.ply", "unit": "mm", "up": "z"}, ...]
    #[arg(long, value_name = "FILE", conflicts_with_all = ["objects", "unit"])]
    pub list: Option<PathBuf>,
    /// Folder that the list's meshes are in (default: the list's own)
    #[arg(long, value_name = "DIR", requires = "list")]
    pub meshes: Option<PathBuf>,
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
}

/// Class, name and mesh of every object.
pub(super) fn named_objects(a: &ObjectsArguments) -> Result<Vec<(String, String, Mesh)>> {
    let Some(list) = a.list.as_deref() else {
        if a.objects.is_empty() {
            bail!("--object NAME_OR_MESH or --list FILE is missing");
        }
        return a
            .objects
            .iter()
            .map(|name| {
                let object = objects::find(name, a.unit, &a.store)?;
                Ok((object.name.clone(), object.name.clone(), object.mesh))
            })
            .collect();
    };
    let text = std::fs::read_to_string(list).with_context(|| list.display().to_string())?;
    let listed: Vec<Listed> = serde_json::from_str(&text).with_context(|| {
        format!("{}: expected a list of objects with class, mesh and unit", list.display())
    })?;
    if listed.is_empty() {
        bail!("{}: the list is empty: name at least one object", list.display());
    }
    let folder = match &a.meshes {
        Some(folder) => folder.clone(),
        None => list.parent().map(Path::to_path_buf).unwrap_or_default(),
    };
    listed
        .into_iter()
        .map(|l| {
            let mesh = read_mesh(folder.join(&l.mesh), l.unit)?.transformed(&l.up.turn());
            Ok((l.class, l.mesh.display().to_string(), mesh))
        })
        .collect()
}

/// A name as part of a file's name.
pub(super) fn file_name(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect()
}
