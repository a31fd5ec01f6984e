//! Objects under names: a folder with one folder per object.
//!
//! An object's folder holds `object.json` (format version, unit, symmetries, where it came from), `mesh.ply` (metres), and what
//! methods derive from it (`ppf.bin`, `templates.bin`). An object added from depth images has templates and no mesh. A folder
//! is written under another name first and moved into place as a whole.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use sixfold_geometry::nalgebra::Matrix4;
use sixfold_geometry::{Pose, PoseError};
use sixfold_mesh::{
    ContinuousSymmetry, Mesh, MeshError, MeshFileError, ModelInfo, PlyFormat, Unit, read_mesh, write_ply,
};
use thiserror::Error;

use crate::cache::{Cache, CacheError};
use crate::error::Source;
use crate::object::Object;

/// The only version of `object.json` there is.
const VERSION: u32 = 1;

/// Why an object cannot be stored or loaded.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum StoreError {
    /// A name that cannot be a folder's.
    #[error("object name {0:?}: expected up to 100 letters, digits, - and _")]
    Name(String),
    /// There is no such object.
    #[error(
        "no object named {name:?} in {} ({there}); add it with `sixfold object add {name} MESH --unit UNIT`",
        folder.display()
    )]
    Unknown {
        /// The name asked for.
        name: String,
        /// The store.
        folder: PathBuf,
        /// The names there are.
        there: String,
    },
    /// There is one already.
    #[error("there is an object named {name:?} in {} already: give --replace or another name", folder.display())]
    Exists {
        /// The name.
        name: String,
        /// The store.
        folder: PathBuf,
    },
    /// `object.json` is not what it should be.
    #[error("{}: {what}", path.display())]
    Record {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// A symmetry in `object.json` is no rigid transformation.
    #[error("field symmetries_discrete")]
    Symmetry(#[from] PoseError),
    /// A mesh file needs a unit.
    #[error("{}: a mesh file does not say its unit: give --unit mm (or m, cm, in)", path.display())]
    NoUnit {
        /// The file.
        path: PathBuf,
    },
    /// The mesh cannot be read or used.
    #[error(transparent)]
    Mesh(#[from] MeshFileError),
    /// A list of points through which no surface can be laid.
    #[error("{name}: no surface can be laid through its points")]
    NoSurface {
        /// The object.
        name: String,
        /// Why.
        source: MeshError,
    },
    /// The system refused.
    #[error("store {}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// What a method derives from the new object could not be made or kept; nothing was stored.
    #[error("cannot store {}", path.display())]
    Derive {
        /// The object's folder.
        path: PathBuf,
        /// Why.
        source: Source,
    },
    /// The cache cannot be used.
    #[error(transparent)]
    Cache(#[from] CacheError),
}

/// `object.json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectRecord {
    /// Format version.
    pub version: u32,
    /// File the mesh was read from.
    pub source: String,
    /// Unit of that file.
    pub source_unit: Unit,
    /// Diameter in metres.
    pub diameter: f64,
    /// Vertices of the mesh.
    pub vertices: usize,
    /// Faces of the mesh.
    pub faces: usize,
    /// Known from depth images: there are templates and no mesh.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub without_mesh: bool,
    /// Transformations that map the object onto itself, as 4x4 matrices in metres, without the identity.
    pub symmetries_discrete: Vec<[[f64; 4]; 4]>,
    /// Axes about which the object may rotate freely: direction, and a point on the axis in metres.
    pub symmetries_continuous: Vec<FreeAxis>,
}

/// An axis of rotational symmetry in `object.json`.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct FreeAxis {
    /// Direction.
    pub axis: [f64; 3],
    /// A point on it, metres.
    pub offset: [f64; 3],
}

impl ObjectRecord {
    /// The record of a mesh file.
    pub fn of_mesh(source: &Path, unit: Unit, mesh: &Mesh, info: &ModelInfo) -> ObjectRecord {
        let array = |v: &sixfold_geometry::Vec3| [v.x, v.y, v.z];
        let rows = |pose: &Pose| {
            let m = pose.to_matrix();
            std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)]))
        };
        let free = |s: &ContinuousSymmetry| FreeAxis { axis: array(&s.axis), offset: array(&s.offset) };
        ObjectRecord {
            version: VERSION,
            source: source.display().to_string(),
            source_unit: unit,
            diameter: mesh.diameter(),
            vertices: mesh.vertices().len(),
            faces: mesh.faces().len(),
            without_mesh: false,
            symmetries_discrete: info.symmetries_discrete.iter().map(rows).collect(),
            symmetries_continuous: info.symmetries_continuous.iter().map(free).collect(),
        }
    }

    /// The record of an object of `diameter` metres that is known from depth images.
    pub fn of_views(sources: &[PathBuf], diameter: f64) -> ObjectRecord {
        let names: Vec<String> = sources.iter().map(|s| s.display().to_string()).collect();
        ObjectRecord {
            version: VERSION,
            source: names.join(", "),
            source_unit: Unit::Metre,
            diameter,
            vertices: 0,
            faces: 0,
            without_mesh: true,
            symmetries_discrete: vec![],
            symmetries_continuous: vec![],
        }
    }

    fn info(&self, mesh: &Mesh) -> Result<ModelInfo, StoreError> {
        let mut info = ModelInfo::of_mesh(mesh);
        for rows in &self.symmetries_discrete {
            let flat: Vec<f64> = rows.iter().flatten().copied().collect();
            info.symmetries_discrete.push(Pose::from_matrix(&Matrix4::from_row_slice(&flat))?);
        }
        for s in &self.symmetries_continuous {
            let symmetry = ContinuousSymmetry { axis: s.axis.into(), offset: s.offset.into() };
            info.symmetries_continuous.push(symmetry);
        }
        Ok(info)
    }
}

/// An object to be stored.
#[derive(Debug, Clone, Copy)]
pub struct NewObject<'a> {
    /// Its mesh in metres, if it has one.
    pub mesh: Option<&'a Mesh>,
    /// Its record.
    pub record: &'a ObjectRecord,
    /// Replace an object of the same name.
    pub replace: bool,
}

/// A folder of named objects.
#[derive(Debug, Clone)]
pub struct ObjectStore {
    folder: PathBuf,
}

impl ObjectStore {
    /// The store in a folder, which need not be there yet.
    pub fn new(folder: impl Into<PathBuf>) -> ObjectStore {
        ObjectStore { folder: folder.into() }
    }

    fn io(&self, source: io::Error) -> StoreError {
        StoreError::Io { path: self.folder.clone(), source }
    }

    fn place(&self, name: &str) -> Result<PathBuf, StoreError> {
        let good = !name.is_empty()
            && name.len() <= 100
            && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_');
        if !good {
            return Err(StoreError::Name(name.to_owned()));
        }
        let place = self.folder.join(name);
        if !place.exists() {
            self.restore(name, &place);
        }
        Ok(place)
    }

    /// Puts an object back whose replacement was interrupted between its two steps.
    fn restore(&self, name: &str, place: &Path) {
        let prefix = format!(".{name}.");
        let entries = std::fs::read_dir(&self.folder).into_iter().flatten().flatten();
        for path in entries.map(|e| e.path()) {
            let found = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
            if found.starts_with(&prefix) && found.ends_with(".old") && path.join("object.json").is_file() {
                // Another process may do the same: then the object is there already.
                let _ = std::fs::rename(&path, place);
            }
        }
    }

    /// Whether there is an object of this name.
    pub fn contains(&self, name: &str) -> bool {
        self.place(name).is_ok_and(|p| p.join("object.json").is_file())
    }

    /// All names, sorted.
    ///
    /// # Errors
    /// [`StoreError::Io`] where the folder cannot be read.
    pub fn names(&self) -> Result<Vec<String>, StoreError> {
        let entries = match std::fs::read_dir(&self.folder) {
            Ok(entries) => entries,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(vec![]),
            Err(e) => return Err(self.io(e)),
        };
        let mut names = vec![];
        for entry in entries {
            let name = entry.map_err(|e| self.io(e))?.file_name();
            if let Some(name) = name.to_str().filter(|n| self.contains(n)) {
                names.push(name.to_owned());
            }
        }
        names.sort();
        Ok(names)
    }

    /// An object's record.
    ///
    /// # Errors
    /// [`StoreError::Unknown`], with the names there are, and [`StoreError::Record`].
    pub fn record(&self, name: &str) -> Result<ObjectRecord, StoreError> {
        let path = self.place(name)?.join("object.json");
        if !path.is_file() {
            let names = self.names()?;
            let there = if names.is_empty() { "there is none yet".into() } else { names.join(", ") };
            return Err(StoreError::Unknown { name: name.to_owned(), folder: self.folder.clone(), there });
        }
        let wrong = |what: String| StoreError::Record { path: path.clone(), what };
        let text = std::fs::read_to_string(&path).map_err(|e| wrong(e.to_string()))?;
        let record: ObjectRecord = serde_json::from_str(&text).map_err(|e| wrong(e.to_string()))?;
        if record.version != VERSION {
            return Err(wrong(format!(
                "field version: found {}, expected {VERSION}: written by another version of sixfold",
                record.version
            )));
        }
        Ok(record)
    }

    /// An object with what it needs to be prepared.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn load(&self, name: &str) -> Result<Object, StoreError> {
        let record = self.record(name)?;
        loaded(name, &record, self.place(name)?)
    }

    /// Stores an object. `derive` is called with it while it lies in a folder beside the store's others, and may keep there what
    /// methods derive from it; where that fails, nothing is stored.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn add(
        &self,
        name: &str,
        new: NewObject<'_>,
        derive: impl FnOnce(&Object) -> Result<(), Source>,
    ) -> Result<(), StoreError> {
        let place = self.place(name)?;
        if place.exists() && !new.replace {
            return Err(StoreError::Exists { name: name.to_owned(), folder: self.folder.clone() });
        }
        std::fs::create_dir_all(&self.folder).map_err(|e| self.io(e))?;
        let fresh = self.folder.join(format!(".{name}.{}.new", std::process::id()));
        let old = self.folder.join(format!(".{name}.{}.old", std::process::id()));
        let result = (|| -> Result<(), Source> {
            std::fs::create_dir_all(&fresh)?;
            if let Some(mesh) = new.mesh {
                write_ply(fresh.join("mesh.ply"), mesh, Unit::Metre, PlyFormat::BinaryLittleEndian)?;
            }
            // From the stored mesh, whose numbers are rounded: that is what later runs compare them with.
            derive(&loaded(name, new.record, fresh.clone())?)?;
            std::fs::write(fresh.join("object.json"), serde_json::to_string_pretty(new.record)?)?;
            let replaced = place.exists();
            if replaced {
                std::fs::rename(&place, &old)?;
            }
            if let Err(error) = std::fs::rename(&fresh, &place) {
                if replaced {
                    std::fs::rename(&old, &place)?;
                }
                return Err(error.into());
            }
            Ok(())
        })();
        let _ = std::fs::remove_dir_all(&fresh);
        if result.is_ok() || place.exists() {
            let _ = std::fs::remove_dir_all(&old);
        }
        result.map_err(|source| StoreError::Derive { path: place, source })
    }

    /// Removes an object.
    ///
    /// # Errors
    /// [`StoreError`] where there is none, or it cannot be removed.
    pub fn remove(&self, name: &str) -> Result<(), StoreError> {
        self.record(name)?;
        let place = self.place(name)?;
        std::fs::remove_dir_all(&place).map_err(|source| StoreError::Io { path: place, source })
    }

    /// The object that a user names: a stored one, or a mesh file in `unit`, whose derived data goes to `cache`. The second value
    /// is what a user should know of it.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn find(
        &self,
        name_or_mesh: &str,
        unit: Option<Unit>,
        cache: &Cache,
    ) -> Result<(Object, Option<String>), StoreError> {
        let path = Path::new(name_or_mesh);
        if self.contains(name_or_mesh) || (path.extension().is_none() && !path.exists()) {
            // Of an unknown name the error tells the names there are.
            let object = self.load(name_or_mesh)?;
            return Ok((object, None));
        }
        let unit = unit.ok_or_else(|| StoreError::NoUnit { path: path.to_owned() })?;
        let (mesh, note) = with_surface(name_or_mesh, read_mesh(path, unit)?)?;
        let stem = path.file_stem();
        let name = stem.map_or_else(|| name_or_mesh.to_owned(), |n| n.to_string_lossy().into_owned());
        let info = ModelInfo::of_mesh(&mesh);
        let folder = cache.of_mesh(&mesh, &info)?;
        Ok((Object { folder, ..Object::of_mesh(name, mesh, info) }, note))
    }
}

fn loaded(name: &str, record: &ObjectRecord, folder: PathBuf) -> Result<Object, StoreError> {
    let (mut mesh, mut info) = (None, None);
    if !record.without_mesh {
        let (read, _) = with_surface(name, read_mesh(folder.join("mesh.ply"), Unit::Metre)?)?;
        info = Some(record.info(&read)?);
        mesh = Some(Arc::new(read));
    }
    Ok(Object { name: name.to_owned(), id: None, mesh, info, folder: Some(folder) })
}

/// A model that is only points gets a surface of disks, with a note.
fn with_surface(name: &str, mesh: Mesh) -> Result<(Mesh, Option<String>), StoreError> {
    if !mesh.faces().is_empty() {
        return Ok((mesh, None));
    }
    let note = format!("{name} has points and no faces; a surface of small disks is laid through them");
    let mesh = mesh.surfels().map_err(|source| StoreError::NoSurface { name: name.to_owned(), source })?;
    Ok((mesh, Some(note)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::Vec3;

    fn mesh(scale: f64) -> Mesh {
        let vertices = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]];
        let vertices = vertices.map(|v| Vec3::from(v) * scale).to_vec();
        Mesh::new(vertices, vec![[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]).unwrap()
    }

    fn add(
        store: &ObjectStore,
        scale: f64,
        replace: bool,
        derived: Result<(), &str>,
    ) -> Result<(), StoreError> {
        let mesh = mesh(scale);
        let record =
            ObjectRecord::of_mesh(Path::new("a.ply"), Unit::Metre, &mesh, &ModelInfo::of_mesh(&mesh));
        store.add("part", NewObject { mesh: Some(&mesh), record: &record, replace }, |object| {
            std::fs::write(object.file("kept.bin").unwrap(), b"kept")?;
            derived.map_err(Into::into)
        })
    }

    #[test]
    fn a_replacement_that_fails_leaves_the_object_as_it_was() {
        let root = tempfile::tempdir().unwrap();
        let store = ObjectStore::new(root.path().join("store"));
        assert!(add(&store, 1.0, false, Err("the disk is full")).is_err());
        assert_eq!(store.names().unwrap(), Vec::<String>::new());
        add(&store, 1.0, false, Ok(())).unwrap();
        assert!(matches!(add(&store, 1.1, false, Ok(())), Err(StoreError::Exists { .. })));
        let error = add(&store, 1.1, true, Err("the disk is full")).unwrap_err();
        assert!(std::error::Error::source(&error).unwrap().to_string().contains("the disk is full"));
        let diameter = |store: &ObjectStore| store.load("part").unwrap().mesh.unwrap().diameter();
        assert!((diameter(&store) - mesh(1.0).diameter()).abs() < 1e-6);
        add(&store, 1.1, true, Ok(())).unwrap();
        assert!((diameter(&store) - mesh(1.1).diameter()).abs() < 1e-6);
        assert!(store.load("part").unwrap().file("kept.bin").unwrap().is_file());
        // Nothing else is left in the store.
        assert_eq!(std::fs::read_dir(root.path().join("store")).unwrap().count(), 1);
    }

    #[test]
    fn an_object_whose_replacement_was_killed_halfway_is_there_again() {
        let root = tempfile::tempdir().unwrap();
        let store = ObjectStore::new(root.path());
        add(&store, 1.0, false, Ok(())).unwrap();
        std::fs::rename(root.path().join("part"), root.path().join(".part.123.old")).unwrap();
        assert!(store.contains("part"));
        assert!((store.load("part").unwrap().mesh.unwrap().diameter() - mesh(1.0).diameter()).abs() < 1e-6);
    }
}
