//! Where objects come from: a mesh file, or the store of named objects.
//!
//! The store is a folder with one folder per object: `object.json` (format version, unit, symmetries, where it came from),
//! `mesh.ply` (metres), and what methods learn about it (`ppf.bin`, `templates.bin`). An object added from depth images has
//! templates and no mesh.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use serde::{Deserialize, Serialize};
use sixfold_geometry::Pose;
use sixfold_match::{ModelOptions, ObjectModel};
use sixfold_mesh::{ContinuousSymmetry, Mesh, ModelInfo, PlyFormat, Unit, read_mesh, write_ply};
use sixfold_mttm::ObjectTemplates;

/// Step at which a continuous symmetry is cut into poses when hypotheses are joined.
const SYMMETRY_STEP: f64 = 0.05;
/// The only version of `object.json` there is.
const VERSION: u32 = 1;

/// An object ready to be looked for.
#[derive(Debug)]
pub struct Object {
    /// Its name in tables.
    pub name: String,
    /// Metres.
    pub mesh: Mesh,
    /// Diameter and symmetries.
    pub info: ModelInfo,
    /// Where its description is kept.
    pub description: PathBuf,
}

impl Object {
    /// The description for point pair features, from disk or computed (and then kept).
    pub fn ppf_model(&self) -> Result<ObjectModel> {
        let (model, note) = ObjectModel::cached(
            &self.description,
            &self.mesh,
            &self.info.symmetry_poses(SYMMETRY_STEP),
            &ModelOptions::default(),
        )
        .with_context(|| format!("object {}", self.name))?;
        if let Some(note) = note {
            eprintln!("note: description of {} not kept or renewed: {note}", self.name);
        }
        Ok(model)
    }
}

/// `object.json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    /// Of the format.
    pub version: u32,
    /// File the mesh was read from.
    pub source: String,
    /// Unit of that file.
    pub source_unit: Unit,
    /// Diameter in metres.
    pub diameter: f64,
    /// Of the mesh.
    pub vertices: usize,
    /// Of the mesh.
    pub faces: usize,
    /// Known from depth images: there are templates and no mesh.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub without_mesh: bool,
    /// Transformations that map the object onto itself, as 4x4 matrices in metres, without the identity.
    pub symmetries_discrete: Vec<[[f64; 4]; 4]>,
    /// Axes about which the object may turn freely: direction, and a point on the axis in metres.
    pub symmetries_continuous: Vec<FreeAxis>,
}

/// An axis about which an object may turn freely.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct FreeAxis {
    /// Direction.
    pub axis: [f64; 3],
    /// A point on the axis, metres.
    pub offset: [f64; 3],
}

impl Record {
    fn info(&self, mesh: &Mesh) -> Result<ModelInfo> {
        let mut info = ModelInfo::of_mesh(mesh);
        for rows in &self.symmetries_discrete {
            let flat: Vec<f64> = rows.iter().flatten().copied().collect();
            let matrix = sixfold_geometry::nalgebra::Matrix4::from_row_slice(&flat);
            info.symmetries_discrete.push(Pose::from_matrix(&matrix).context("field symmetries_discrete")?);
        }
        for s in &self.symmetries_continuous {
            info.symmetries_continuous
                .push(ContinuousSymmetry { axis: s.axis.into(), offset: s.offset.into() });
        }
        Ok(info)
    }
}

/// A folder of named objects.
pub struct Store<'a> {
    /// Where it is.
    pub folder: &'a Path,
}

impl Store<'_> {
    fn place(&self, name: &str) -> Result<PathBuf> {
        let good = !name.is_empty()
            && name.len() <= 100
            && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_');
        if !good {
            bail!("object name {name:?}: expected up to 100 letters, digits, - and _");
        }
        Ok(self.folder.join(name))
    }

    /// Whether there is an object of that name.
    pub fn contains(&self, name: &str) -> bool {
        self.place(name).is_ok_and(|p| p.join("object.json").is_file())
    }

    /// The names of all objects, sorted.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub fn names(&self) -> Result<Vec<String>> {
        let entries = match std::fs::read_dir(self.folder) {
            Ok(entries) => entries,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(vec![]),
            Err(e) => return Err(e).with_context(|| format!("store {}", self.folder.display())),
        };
        let mut names = vec![];
        for entry in entries {
            let name = entry.with_context(|| format!("store {}", self.folder.display()))?.file_name();
            if let Some(name) = name.to_str().filter(|n| self.contains(n)) {
                names.push(name.to_owned());
            }
        }
        names.sort();
        Ok(names)
    }

    /// What is known of an object.
    ///
    /// # Errors
    /// When there is none of that name, or its file is not one of this version.
    pub fn record(&self, name: &str) -> Result<Record> {
        let path = self.place(name)?.join("object.json");
        if !path.is_file() {
            let names = self.names()?;
            let there = if names.is_empty() { "there is none yet".into() } else { names.join(", ") };
            bail!(
                "no object named {name:?} in {} ({there}); add it with `sixfold object add {name} MESH --unit UNIT`",
                self.folder.display()
            );
        }
        let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        let record: Record = serde_json::from_str(&text).with_context(|| path.display().to_string())?;
        if record.version != VERSION {
            bail!(
                "{}: field version: found {}, expected {VERSION}: written by another version of sixfold",
                path.display(),
                record.version
            );
        }
        Ok(record)
    }

    /// An object with its mesh.
    ///
    /// # Errors
    /// As [`Store::record`], and when the object has no mesh.
    pub fn load(&self, name: &str) -> Result<Object> {
        let record = self.record(name)?;
        if record.without_mesh {
            bail!(
                "object {name} was added from depth images and has no mesh: only --method mttm can look for it"
            );
        }
        let place = self.place(name)?;
        let mesh = with_surface(name, read_mesh(place.join("mesh.ply"), Unit::Metre)?)?;
        let info = record.info(&mesh)?;
        Ok(Object { name: name.to_owned(), mesh, info, description: place.join("ppf.bin") })
    }

    /// Where an object's templates are.
    pub fn templates_file(&self, name: &str) -> Result<PathBuf> {
        Ok(self.place(name)?.join("templates.bin"))
    }

    /// Stores an object: written beside first, then moved into place as a whole.
    pub fn add(
        &self,
        name: &str,
        mesh: Option<&Mesh>,
        templates: Option<&ObjectTemplates>,
        record: &Record,
        replace: bool,
    ) -> Result<()> {
        let place = self.place(name)?;
        if place.exists() && !replace {
            bail!(
                "there is an object named {name:?} in {} already: give --replace or another name",
                self.folder.display()
            );
        }
        std::fs::create_dir_all(self.folder).with_context(|| format!("store {}", self.folder.display()))?;
        let fresh = self.folder.join(format!(".{name}.{}.new", std::process::id()));
        let old = self.folder.join(format!(".{name}.{}.old", std::process::id()));
        let result = (|| -> Result<()> {
            std::fs::create_dir_all(&fresh)?;
            if let Some(mesh) = mesh {
                write_ply(fresh.join("mesh.ply"), mesh, Unit::Metre, PlyFormat::BinaryLittleEndian)?;
            }
            if let Some(templates) = templates {
                templates.write(&fresh.join("templates.bin"))?;
            }
            std::fs::write(fresh.join("object.json"), serde_json::to_string_pretty(record)?)?;
            if place.exists() {
                std::fs::rename(&place, &old)?;
            }
            std::fs::rename(&fresh, &place)?;
            Ok(())
        })();
        let _ = std::fs::remove_dir_all(&fresh);
        let _ = std::fs::remove_dir_all(&old);
        result.with_context(|| format!("cannot store {}", place.display()))
    }

    /// Removes an object.
    ///
    /// # Errors
    /// When there is none of that name, or it cannot be removed.
    pub fn remove(&self, name: &str) -> Result<()> {
        self.record(name)?;
        let place = self.place(name)?;
        std::fs::remove_dir_all(&place).with_context(|| format!("cannot remove {}", place.display()))
    }
}

/// Makes the record of a mesh file.
pub fn new_record(source: &Path, unit: Unit, mesh: &Mesh, info: &ModelInfo) -> Record {
    let array = |v: &sixfold_geometry::Vec3| [v.x, v.y, v.z];
    Record {
        version: VERSION,
        source: source.display().to_string(),
        source_unit: unit,
        diameter: mesh.diameter(),
        vertices: mesh.vertices().len(),
        faces: mesh.faces().len(),
        without_mesh: false,
        symmetries_discrete: info.symmetries_discrete.iter().map(crate::output::pose_rows).collect(),
        symmetries_continuous: info
            .symmetries_continuous
            .iter()
            .map(|s| FreeAxis { axis: array(&s.axis), offset: array(&s.offset) })
            .collect(),
    }
}

/// Makes the record of an object known from depth images.
pub fn new_record_of_views(sources: &[PathBuf], templates: &ObjectTemplates) -> Record {
    let names: Vec<String> = sources.iter().map(|s| s.display().to_string()).collect();
    Record {
        version: VERSION,
        source: names.join(", "),
        source_unit: Unit::Metre,
        diameter: templates.diameter,
        vertices: 0,
        faces: 0,
        without_mesh: true,
        symmetries_discrete: vec![],
        symmetries_continuous: vec![],
    }
}

/// A mesh file (then `unit` is needed) or the name of a stored object.
pub fn find(name_or_mesh: &str, unit: Option<Unit>, store: &Path) -> Result<Object> {
    let store = Store { folder: store };
    if store.contains(name_or_mesh) {
        return store.load(name_or_mesh);
    }
    let path = Path::new(name_or_mesh);
    if path.extension().is_none() && !path.exists() {
        // Reports the names there are.
        store.record(name_or_mesh)?;
    }
    let unit = unit.ok_or_else(|| {
        anyhow!("{}: a mesh file does not say its unit: give --unit mm (or m, cm, in)", path.display())
    })?;
    let mesh = with_surface(name_or_mesh, read_mesh(path, unit)?)?;
    let name = path.file_stem().map_or_else(|| name_or_mesh.to_owned(), |n| n.to_string_lossy().into_owned());
    let info = ModelInfo::of_mesh(&mesh);
    Ok(Object { name, mesh, info, description: description_beside(path) })
}

/// A model that is only points gets a surface of disks.
fn with_surface(name: &str, mesh: Mesh) -> Result<Mesh> {
    if !mesh.faces().is_empty() {
        return Ok(mesh);
    }
    eprintln!("note: {name} has points and no faces; a surface of small disks is laid through them");
    mesh.surfels().with_context(|| format!("{name}: no surface can be laid through its points"))
}

/// `mug.ply` keeps its description in `mug.sixfold-ppf`.
pub fn description_beside(mesh: &Path) -> PathBuf {
    mesh.with_extension("sixfold-ppf")
}
