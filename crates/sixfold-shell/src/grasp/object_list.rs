//! The objects of simulated trials: meshes by name, or a list in a file.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use serde::Deserialize;
use sixfold_geometry::random::stream;
use sixfold_geometry::{Pose, Vec3};
use sixfold_mesh::{Mesh, Unit, read_mesh};
use sixfold_synth::shapes::{Family, member};

use crate::objects;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Listed {
    class: String,
    /// A mesh file and its unit, or a synthetic object.
    #[serde(default)]
    mesh: Option<PathBuf>,
    #[serde(default)]
    unit: Option<Unit>,
    #[serde(default)]
    synthetic: Option<Synthetic>,
    /// The axis of the mesh that points up when the object stands.
    #[serde(default)]
    up: Up,
    /// A part with a name, such as a handle: a box of the mesh as it stands (z up), metres.
    #[serde(default)]
    part: Option<PartBox>,
}

/// A member of a family of synthetic objects.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Synthetic {
    family: Family,
    /// Which of its members.
    number: u64,
}

/// Seed of the synthetic objects of lists, different from the seeds of `learn` and of trainings.
const LISTED_SEED: u64 = 0x6c69_7374;

impl Listed {
    /// Name and mesh, standing.
    fn object(&self, folder: &Path) -> Result<(String, Mesh)> {
        match (&self.mesh, self.unit, &self.synthetic) {
            (Some(file), Some(unit), None) => {
                let mesh = read_mesh(folder.join(file), unit)?;
                Ok((file.display().to_string(), mesh.transformed(&self.up.turn())))
            }
            (None, None, Some(made)) => {
                let number = made.number.wrapping_mul(64).wrapping_add(made.family as u64);
                let mesh = member(made.family, &mut stream(LISTED_SEED, number))?.mesh;
                Ok((format!("synthetic {} {}", made.family.name(), made.number), mesh))
            }
            _ => bail!("class {}: expected mesh and unit, or synthetic alone", self.class),
        }
    }
}

/// A named part of an object: everything inside a box in the object's frame, metres.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartBox {
    /// Its name.
    pub name: String,
    low: [f64; 3],
    high: [f64; 3],
}

impl PartBox {
    /// Whether a point is inside the box enlarged by `margin` metres on each side.
    pub fn contains(&self, p: &Vec3, margin: f64) -> bool {
        (0..3).all(|k| p[k] >= self.low[k] - margin && p[k] <= self.high[k] + margin)
    }
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
    /// The rotation that takes the axis to z.
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
#[derive(Debug, Default, Args)]
pub struct ObjectsArguments {
    /// Objects: mesh files, or names of stored objects; each is a class of its own
    #[arg(long = "object", value_name = "NAME_OR_MESH", num_args = 1..)]
    pub objects: Vec<String>,
    /// Unit of the mesh files: m, cm, mm, in
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
    /// List of objects in place of --object: JSON, [{"class": "mug", "mesh": "mug.ply", "unit": "mm", "up": "z"}, {"class": "cup",
    /// "synthetic": {"family": "cup", "number": 1}}, ...]
    #[arg(long, value_name = "FILE", conflicts_with_all = ["objects", "unit"])]
    pub list: Option<PathBuf>,
    /// Folder that the list's meshes are in (default: the list's own)
    #[arg(long, value_name = "DIR", requires = "list", conflicts_with = "objects")]
    pub meshes: Option<PathBuf>,
    /// Folder of stored objects
    #[arg(long, value_name = "DIR", env = "SIXFOLD_STORE", default_value = "sixfold-objects")]
    pub store: PathBuf,
}

/// Class, name and mesh of every object.
pub fn named_objects(a: &ObjectsArguments) -> Result<Vec<(String, String, Mesh)>> {
    Ok(objects_with_parts(a)?.0)
}

/// Classes, names and meshes of objects.
pub type Named = Vec<(String, String, Mesh)>;

/// Class, name and mesh of every object, and its named part where the list states one.
pub fn objects_with_parts(a: &ObjectsArguments) -> Result<(Named, Vec<Option<PartBox>>)> {
    let Some(list) = a.list.as_deref() else {
        if a.objects.is_empty() {
            bail!("--object NAME_OR_MESH or --list FILE is missing");
        }
        let named: Result<Named> = a
            .objects
            .iter()
            .map(|name| {
                let object = objects::find(name, a.unit, &a.store)?;
                Ok((object.name.clone(), object.name.clone(), object.mesh))
            })
            .collect();
        return named.map(|named| (named, vec![None; a.objects.len()]));
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
    let parts = listed.iter().map(|l| l.part.clone()).collect();
    let named: Result<Named> = listed
        .into_iter()
        .map(|l| {
            let (name, mesh) = l.object(&folder).with_context(|| list.display().to_string())?;
            Ok((l.class, name, mesh))
        })
        .collect();
    Ok((named?, parts))
}

/// A name as part of a file's name.
pub fn file_name(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect()
}
