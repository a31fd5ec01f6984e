//! Named objects: a folder with one folder per object.
//!
//! An object's folder holds `object.json` (format version, unit, symmetries, source file), `mesh.ply` (metres), and data that
//! methods derive from it (`ppf.bin`, `templates.bin`) or learn for it (`pix2pose.safetensors`). An object added from depth images has templates and no mesh. A folder is
//! written under another name first and moved into place as a whole; one that is replaced or removed is moved away first. One
//! process at a time changes an object; after a killed process, the next one cleans up.

use std::collections::BTreeSet;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use sixfold_geometry::{Pose, Vec3};
use sixfold_io::{LockError, WriteLock, limits, read_regular_text, sync_folder_of, write_atomically};
use sixfold_mesh::{
    ContinuousSymmetry, Mesh, MeshError, MeshFileError, ModelInfo, PlyFormat, Unit, read_mesh, write_ply,
};
use thiserror::Error;

use crate::cache::{Cache, CacheError};
use crate::error::Source;
use crate::object::Object;

/// The only version of `object.json`.
const VERSION: u32 = 1;
/// Allowed diameters of an object known from depth images, metres: the same as for meshes of tabletop objects.
const DIAMETERS: std::ops::RangeInclusive<f64> =
    sixfold_mesh::SMALLEST_DIAMETER..=sixfold_mesh::LARGEST_DIAMETER;
/// Largest relative difference of the diameter in `object.json` and the mesh's: the mesh is stored in single precision.
const SAME_DIAMETER: f64 = 1e-3;
/// The same for a point, as a fraction of its distance from the origin.
const SAME_POINT: f64 = 1e-6;
/// Maximum number of discrete symmetries (with the identity) times axes in `object.json`: a gear with 360 teeth has 360.
const MAX_SYMMETRIES: usize = 1000;
/// Largest distance of a point on an axis from the origin, and largest translation of a symmetry, metres.
const FURTHEST: f64 = 2.0 * sixfold_mesh::LARGEST_OFFSET;
/// How long to wait for another process that has moved an object away and not yet moved the new one into place.
const PATIENCE: Duration = Duration::from_secs(5);
/// Maximum number of listings of the store until two are the same.
const LISTINGS: usize = 5;
/// Maximum number of attempts to find an object while another process changes it.
const ATTEMPTS: usize = 20;

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
    /// Something with this name exists that is not an object.
    #[error(
        "{} is not a stored object (it has no object.json) and was not changed: give another name, or remove it yourself",
        path.display()
    )]
    NotAnObject {
        /// The file or folder.
        path: PathBuf,
    },
    /// Another process changes the object.
    #[error(transparent)]
    Locked(#[from] LockError),
    /// `object.json` is invalid.
    #[error("{}: {what}; add the object again with `sixfold object add {name} ... --replace`", path.display())]
    Record {
        /// The object.
        name: String,
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// The stored mesh cannot be read.
    #[error("add the object again with `sixfold object add {name} MESH --unit UNIT --replace`")]
    StoredMesh {
        /// The object.
        name: String,
        /// Why.
        source: Box<MeshFileError>,
    },
    /// A mesh file needs a unit.
    #[error("{}: a mesh file does not say its unit: give --unit mm (or m, cm, in)", path.display())]
    NoUnit {
        /// The file.
        path: PathBuf,
    },
    /// The mesh cannot be read or used.
    #[error(transparent)]
    Mesh(#[from] MeshFileError),
    /// A list of points through which no surface can be fitted.
    #[error("{name}: no surface can be fitted to its points")]
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
        /// The system's error.
        source: io::Error,
    },
    /// Derived data of an object could not be computed or stored; a new object was not stored either.
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
        let free = |s: &ContinuousSymmetry| FreeAxis { axis: array(&s.axis), offset: array(&s.offset) };
        ObjectRecord {
            version: VERSION,
            source: source.display().to_string(),
            source_unit: unit,
            diameter: mesh.diameter(),
            vertices: mesh.vertices().len(),
            faces: mesh.faces().len(),
            without_mesh: false,
            symmetries_discrete: info.symmetries_discrete.iter().map(Pose::rows).collect(),
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

    /// Diameter, box and symmetries; an error describes how the record contradicts the mesh.
    fn info(&self, mesh: &Mesh) -> Result<ModelInfo, String> {
        let mut info = ModelInfo::of_mesh(mesh);
        let furthest = info.min.abs().sup(&(info.min + info.size).abs()).amax();
        let rounding = SAME_DIAMETER * info.diameter + SAME_POINT * furthest;
        if !((self.diameter - info.diameter).abs() <= rounding) {
            return Err(format!(
                "field diameter: found {} m, that of mesh.ply beside it is {} m",
                self.diameter, info.diameter
            ));
        }
        for (field, found, expected) in
            [("vertices", self.vertices, mesh.vertices().len()), ("faces", self.faces, mesh.faces().len())]
        {
            if found != expected {
                return Err(format!("field {field}: found {found}, mesh.ply beside it has {expected}"));
            }
        }
        let (discrete, axes) = (self.symmetries_discrete.len() + 1, self.symmetries_continuous.len().max(1));
        if discrete.saturating_mul(axes) > MAX_SYMMETRIES {
            return Err(format!(
                "fields symmetries_discrete and symmetries_continuous: found {discrete} times {axes}, expected up to \
                 {MAX_SYMMETRIES}"
            ));
        }
        for rows in &self.symmetries_discrete {
            let pose = Pose::from_rows(rows).map_err(|e| format!("field symmetries_discrete: {e}"))?;
            if !(pose.translation().norm() <= FURTHEST) {
                return Err(format!(
                    "field symmetries_discrete: found one that moves the object by more than {FURTHEST} m"
                ));
            }
            info.symmetries_discrete.push(pose);
        }
        for s in &self.symmetries_continuous {
            let axis = Vec3::from(s.axis).try_normalize(1e-9).filter(|a| (a.norm() - 1.0).abs() < 1e-9);
            let axis = axis.ok_or_else(|| {
                format!("field symmetries_continuous.axis: found {:?}, expected a direction", s.axis)
            })?;
            let offset = Vec3::from(s.offset);
            if !(offset.norm() <= FURTHEST) {
                return Err(format!(
                    "field symmetries_continuous.offset: found {:?}, expected a point of the object in metres",
                    s.offset
                ));
            }
            info.symmetries_continuous.push(ContinuousSymmetry { axis, offset });
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
    /// Whether an object of the same name is replaced.
    pub replace: bool,
}

/// A folder of named objects.
#[derive(Debug, Clone)]
pub struct ObjectStore {
    folder: PathBuf,
}

impl ObjectStore {
    /// The store in a folder, which need not exist yet.
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
        if place.exists() { Ok(place) } else { Ok(self.restored(name, place)) }
    }

    /// [`ObjectStore::place`] for callers that change the object.
    fn writable_place(&self, name: &str) -> Result<PathBuf, StoreError> {
        let (found, place) = (self.place(name)?, self.folder.join(name));
        if found == place {
            return Ok(place);
        }
        // This is the only copy.
        let what = format!("{} cannot be moved back there", found.display());
        Err(StoreError::Io { path: place, source: io::Error::other(what) })
    }

    /// Finds an object that is not in its place. If a process was killed between the two steps of a replacement, the old object is
    /// moved back. If a process is between them now, this waits for it.
    fn restored(&self, name: &str, place: PathBuf) -> PathBuf {
        let start = Instant::now();
        loop {
            let Some(old) = self.beside(name, OLD).into_iter().find(|p| is_object(p)) else { return place };
            match WriteLock::take(&place) {
                // A complete new object may be in the place meanwhile: then this one is used.
                Ok(_lock) if place.exists() || std::fs::rename(&old, &place).is_ok() => return place,
                Err(LockError::Taken { .. }) if start.elapsed() < PATIENCE => {
                    std::thread::sleep(Duration::from_millis(5));
                    if place.exists() {
                        return place;
                    }
                }
                // A read-only store.
                _ => return old,
            }
        }
    }

    /// Folders that an unfinished change left beside an object: `.NAME.PROCESS.ENDING`.
    fn beside(&self, name: &str, ending: &str) -> Vec<PathBuf> {
        let (prefix, ending) = (format!(".{name}."), format!(".{ending}"));
        let entries = std::fs::read_dir(&self.folder).into_iter().flatten().flatten().map(|e| e.path());
        let of_this = |path: &PathBuf| {
            let found = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
            let process = found.strip_prefix(&prefix).and_then(|rest| rest.strip_suffix(&ending));
            process.is_some_and(|p| p.parse::<u32>().is_ok())
        };
        entries.filter(of_this).collect()
    }

    /// The name of this process's folder beside an object.
    fn own(&self, name: &str, ending: &str) -> PathBuf {
        self.folder.join(format!(".{name}.{}.{ending}", std::process::id()))
    }

    /// Removes the leftovers of killed processes for an object that is in its place or does not exist. The caller holds its lock.
    fn tidy(&self, name: &str) {
        for path in [NEW, OLD, GONE].into_iter().flat_map(|ending| self.beside(name, ending)) {
            // Folders that cannot be removed only take space.
            let _ = std::fs::remove_dir_all(path);
        }
    }

    /// Whether there is an object of this name.
    pub fn contains(&self, name: &str) -> bool {
        self.whole(name, |place| is_object(place).then_some(())).is_some()
    }

    /// The result of `read` on the object's folder. If a replacement moves the folder away at that moment, it is searched again.
    fn whole<T>(&self, name: &str, read: impl Fn(&Path) -> Option<T>) -> Option<T> {
        for _ in 0..ATTEMPTS {
            let found = self.place(name).ok().and_then(|place| read(&place));
            if found.is_some() || !self.is_changing(name) {
                return found;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        None
    }

    /// Whether a process is replacing or removing the object, or was killed while doing so.
    fn is_changing(&self, name: &str) -> bool {
        self.folder.join(format!(".{name}.lock")).exists() || !self.beside(name, OLD).is_empty()
    }

    /// All names, sorted.
    ///
    /// # Errors
    /// [`StoreError::Io`] where the folder cannot be read.
    pub fn names(&self) -> Result<Vec<String>, StoreError> {
        let mut names = self.names_once()?;
        // A folder that is renamed while the store is listed may be missing under both names.
        for _ in 0..LISTINGS {
            let again = self.names_once()?;
            if again == names {
                break;
            }
            names = again;
        }
        Ok(names.into_iter().collect())
    }

    fn names_once(&self) -> Result<BTreeSet<String>, StoreError> {
        let entries = match std::fs::read_dir(&self.folder) {
            Ok(entries) => entries,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(BTreeSet::new()),
            Err(e) => return Err(self.io(e)),
        };
        let mut names = BTreeSet::new();
        for entry in entries {
            let entry = entry.map_err(|e| self.io(e))?.file_name();
            let Some(entry) = entry.to_str() else { continue };
            // `.NAME.PROCESS.old` gives the name too: a replacement is in progress or was interrupted.
            let name = match entry.strip_prefix('.') {
                Some(rest) if entry.ends_with(OLD) => rest.split('.').next().unwrap_or_default(),
                _ => entry,
            };
            if !names.contains(name) && self.contains(name) {
                names.insert(name.to_owned());
            }
        }
        Ok(names)
    }

    /// All objects with their records, by name; one that another process removes meanwhile is left out.
    ///
    /// # Errors
    /// As [`ObjectStore::names`] and [`ObjectStore::record`].
    pub fn records(&self) -> Result<Vec<(String, ObjectRecord)>, StoreError> {
        let mut records = vec![];
        for name in self.names()? {
            match self.record(&name) {
                Ok(record) => records.push((name, record)),
                Err(StoreError::Unknown { .. }) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(records)
    }

    /// An object's record.
    ///
    /// # Errors
    /// [`StoreError::Unknown`], with the names there are, and [`StoreError::Record`].
    pub fn record(&self, name: &str) -> Result<ObjectRecord, StoreError> {
        let path = self.place(name)?.join("object.json");
        let text = self.whole(name, |place| {
            match read_regular_text(&place.join("object.json"), limits::SMALL_TEXT) {
                Err(e) if matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => None,
                other => Some(other),
            }
        });
        let wrong = |what: String| StoreError::Record { name: name.to_owned(), path: path.clone(), what };
        let Some(text) = text else {
            let names = self.names()?;
            let there = if names.is_empty() { "there is none yet".into() } else { names.join(", ") };
            return Err(StoreError::Unknown { name: name.to_owned(), folder: self.folder.clone(), there });
        };
        let text = text.map_err(|e| wrong(e.to_string()))?;
        let record: ObjectRecord = serde_json::from_str(&text).map_err(|e| wrong(e.to_string()))?;
        if record.version != VERSION {
            return Err(wrong(format!(
                "field version: found {}, expected {VERSION}: written by another version of sixfold",
                record.version
            )));
        }
        if record.without_mesh && !DIAMETERS.contains(&record.diameter) {
            return Err(wrong(format!(
                "field diameter: found {} m, expected {DIAMETERS:?}",
                record.diameter
            )));
        }
        Ok(record)
    }

    /// An object with the data needed to prepare it.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn load(&self, name: &str) -> Result<Object, StoreError> {
        let read = || loaded(name, &self.record(name)?, self.place(name)?);
        // The object was replaced while its files were read: the second attempt reads files of one object.
        read().or_else(|_| read())
    }

    /// Stores an object. Before the object is moved into place, `derive` is called with it and may store derived data in its
    /// folder; if that fails, nothing is stored.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn add(
        &self,
        name: &str,
        new: NewObject<'_>,
        derive: impl FnOnce(&Object) -> Result<(), Source>,
    ) -> Result<(), StoreError> {
        let place = self.writable_place(name)?;
        std::fs::create_dir_all(&self.folder).map_err(|e| self.io(e))?;
        let _lock = WriteLock::take(&place)?;
        let replaced = place.exists();
        if replaced && !is_object(&place) {
            return Err(StoreError::NotAnObject { path: place });
        }
        if replaced && !new.replace {
            return Err(StoreError::Exists { name: name.to_owned(), folder: self.folder.clone() });
        }
        self.tidy(name);
        let fresh = self.own(name, NEW);
        let result = (|| -> Result<(), Source> {
            std::fs::create_dir_all(&fresh)?;
            if let Some(mesh) = new.mesh {
                write_ply(fresh.join("mesh.ply"), mesh, Unit::Metre, PlyFormat::BinaryLittleEndian)?;
            }
            // Derive from the stored mesh, whose numbers are rounded, because later runs compare with it.
            derive(&loaded(name, new.record, fresh.clone())?)?;
            write_atomically(
                &fresh.join("object.json"),
                serde_json::to_string_pretty(new.record)?.as_bytes(),
            )?;
            let away = if replaced { Some(self.own(name, OLD)) } else { None };
            swap(&fresh, &place, away.as_deref(), |from, to| std::fs::rename(from, to))?;
            Ok(sync_folder_of(&place)?)
        })();
        if place.exists() {
            self.tidy(name);
        } else {
            // The object may exist only under its other name: it is moved back at the next access.
            let _ = std::fs::remove_dir_all(&fresh);
        }
        result.map_err(|source| StoreError::Derive { path: place, source })
    }

    /// Calls `add` with a stored object, to add data to its folder while no other process replaces or removes it.
    ///
    /// # Errors
    /// [`StoreError`] where there is none or another process changes it, and [`StoreError::Derive`] if `add` fails.
    pub fn extend(
        &self,
        name: &str,
        add: impl FnOnce(&Object) -> Result<(), Source>,
    ) -> Result<(), StoreError> {
        let place = self.writable_place(name)?;
        // The error lists the existing objects.
        self.record(name)?;
        let _lock = WriteLock::take(&place)?;
        let object = self.load(name)?;
        add(&object).map_err(|source| StoreError::Derive { path: place, source })
    }

    /// Removes an object.
    ///
    /// # Errors
    /// [`StoreError`] where there is none, another process changes it, or it cannot be removed.
    pub fn remove(&self, name: &str) -> Result<(), StoreError> {
        let place = self.writable_place(name)?;
        if !self.folder.exists() {
            // The error lists the existing objects.
            self.record(name)?;
        }
        let _lock = WriteLock::take(&place)?;
        // Also cleans up after an interrupted removal, which has left no object.
        self.tidy(name);
        if !is_object(&place) {
            self.record(name)?;
        }
        let gone = self.own(name, GONE);
        // Rename the folder first, so that an interrupted removal does not leave half an object.
        std::fs::rename(&place, &gone)
            .and_then(|()| sync_folder_of(&place))
            .map_err(|source| StoreError::Io { path: place, source })?;
        std::fs::remove_dir_all(&gone).map_err(|source| StoreError::Io { path: gone, source })
    }

    /// The object that a user names: a stored one, or a mesh file in `unit`, whose derived data goes to `cache`. The second value
    /// is a note for the user.
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
            // For an unknown name, the error lists the existing names.
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

/// Endings of the folders beside an object: being written, being replaced, being removed.
const NEW: &str = "new";
const OLD: &str = "old";
const GONE: &str = "gone";

fn is_object(place: &Path) -> bool {
    place.join("object.json").is_file()
}

/// Moves the existing object to `away` and `fresh` into its place. If the second step fails, the first is undone; if that fails
/// too, the object is at `away`, where [`ObjectStore::restored`] finds it.
fn swap(
    fresh: &Path,
    place: &Path,
    away: Option<&Path>,
    rename: impl Fn(&Path, &Path) -> io::Result<()>,
) -> io::Result<()> {
    if let Some(away) = away {
        rename(place, away)?;
    }
    rename(fresh, place).inspect_err(|_| {
        if let Some(away) = away {
            // The first error is the one to report.
            let _ = rename(away, place);
        }
    })
}

fn loaded(name: &str, record: &ObjectRecord, folder: PathBuf) -> Result<Object, StoreError> {
    let (mut mesh, mut info) = (None, None);
    if !record.without_mesh {
        let read = read_mesh(folder.join("mesh.ply"), Unit::Metre)
            .map_err(|source| StoreError::StoredMesh { name: name.to_owned(), source: Box::new(source) })?;
        let wrong =
            |what| StoreError::Record { name: name.to_owned(), path: folder.join("object.json"), what };
        let mut of_record = record.info(&read).map_err(wrong)?;
        let (surface, note) = with_surface(name, read)?;
        if note.is_some() {
            // The surface through the points has a different box.
            let own = ModelInfo::of_mesh(&surface);
            (of_record.diameter, of_record.min, of_record.size) = (own.diameter, own.min, own.size);
        }
        info = Some(of_record);
        mesh = Some(Arc::new(surface));
    }
    Ok(Object { name: name.to_owned(), id: None, mesh, info, folder: Some(folder) })
}

/// Gives a model of points only a surface of disks, with a note.
fn with_surface(name: &str, mesh: Mesh) -> Result<(Mesh, Option<String>), StoreError> {
    if !mesh.faces().is_empty() {
        return Ok((mesh, None));
    }
    let note = format!("{name} has points and no faces; a surface of small disks is fitted to them");
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
    fn a_removal_that_was_killed_halfway_is_finished_by_the_next() {
        let dir = tempfile::tempdir().unwrap();
        let store = ObjectStore::new(dir.path());
        let gone = dir.path().join(".part.1.gone");
        std::fs::create_dir(&gone).unwrap();
        std::fs::write(gone.join("mesh.ply"), b"half an object").unwrap();
        std::fs::write(dir.path().join(".part.lock"), b"1").unwrap();
        assert!(matches!(store.remove("part"), Err(StoreError::Unknown { .. })));
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
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
    fn data_are_added_to_an_object_that_is_there() {
        let root = tempfile::tempdir().unwrap();
        let store = ObjectStore::new(root.path());
        let write = |object: &Object| Ok(std::fs::write(object.file("weights.bin").unwrap(), b"weights")?);
        assert!(matches!(store.extend("part", write), Err(StoreError::Unknown { .. })));
        add(&store, 1.0, false, Ok(())).unwrap();
        store.extend("part", write).unwrap();
        for kept in ["weights.bin", "kept.bin"] {
            assert!(store.load("part").unwrap().file(kept).unwrap().is_file(), "{kept}");
        }
        let failed = store.extend("part", |_| Err("the disk is full".into())).unwrap_err();
        assert!(std::error::Error::source(&failed).unwrap().to_string().contains("the disk is full"));
        // Nobody else changes it meanwhile.
        let meanwhile = store.extend("part", |_| Ok(store.remove("part")?)).unwrap_err();
        assert!(std::error::Error::source(&meanwhile).unwrap().to_string().contains("another process"));
        assert_eq!(store.names().unwrap(), ["part"]);
    }

    /// Both kinds of failure between the two renames: the second one fails, or the process dies.
    #[test]
    fn a_replacement_that_ends_between_its_two_renames_loses_nothing() {
        let root = tempfile::tempdir().unwrap();
        let store = ObjectStore::new(root.path());
        add(&store, 1.0, false, Ok(())).unwrap();
        let diameter = || store.load("part").unwrap().mesh.unwrap().diameter();
        let (place, away) = (root.path().join("part"), store.own("part", OLD));
        let fresh = || {
            let fresh = store.own("part", NEW);
            std::fs::create_dir_all(&fresh).unwrap();
            fresh
        };
        for failing in [1..2, 1..3] {
            let calls = std::cell::Cell::new(0);
            let result = swap(&fresh(), &place, Some(&away), |from, to| {
                calls.set(calls.get() + 1);
                if failing.contains(&(calls.get() - 1)) {
                    return Err(io::Error::from(io::ErrorKind::StorageFull));
                }
                std::fs::rename(from, to)
            });
            assert_eq!(result.unwrap_err().kind(), io::ErrorKind::StorageFull);
            // If undoing failed too, it exists only under its other name.
            assert_eq!(place.exists(), failing.len() == 1);
            assert_eq!(store.names().unwrap(), ["part"]);
            assert!((diameter() - mesh(1.0).diameter()).abs() < 1e-6 && place.exists());
        }
        // Killed between the renames: the same folders, and the lock file of a dead process.
        fresh();
        std::fs::rename(&place, root.path().join(".part.1.old")).unwrap();
        std::fs::write(root.path().join(".part.lock"), "1").unwrap();
        assert_eq!(store.records().unwrap()[0].0, "part");
        assert!((diameter() - mesh(1.0).diameter()).abs() < 1e-6);
        // Killed after the renames: the new object stays, and the remains of the old one are not restored.
        std::fs::create_dir(root.path().join(".part.2.old")).unwrap();
        std::fs::copy(place.join("object.json"), root.path().join(".part.2.old/object.json")).unwrap();
        store.remove("part").unwrap();
        assert_eq!(store.names().unwrap(), Vec::<String>::new());
        assert_eq!(std::fs::read_dir(root.path()).unwrap().count(), 0);
    }

    #[test]
    fn concurrent_changes_are_serialised_and_readers_see_a_consistent_object() {
        let root = tempfile::tempdir().unwrap();
        let store = ObjectStore::new(root.path());
        add(&store, 1.0, false, Ok(())).unwrap();
        let done = std::sync::atomic::AtomicUsize::new(0);
        std::thread::scope(|scope| {
            for k in 0..2 {
                let (store, done) = (&store, &done);
                scope.spawn(move || {
                    for _ in 0..60 {
                        match add(store, 1.0 + 0.1 * f64::from(k), true, Ok(())) {
                            Ok(()) | Err(StoreError::Locked(LockError::Taken { .. })) => {}
                            Err(error) => panic!("{error:?}"),
                        }
                    }
                    done.fetch_add(1, std::sync::atomic::Ordering::SeqCst);
                });
            }
            while done.load(std::sync::atomic::Ordering::SeqCst) < 2 {
                let records = store.records().unwrap();
                assert_eq!(records.iter().map(|r| r.0.as_str()).collect::<Vec<_>>(), ["part"]);
            }
        });
        let found = store.load("part").unwrap().mesh.unwrap().diameter() / mesh(1.0).diameter();
        assert!((found - 1.0).abs() < 1e-6 || (found - 1.1).abs() < 1e-6, "{found}");
        assert_eq!(std::fs::read_dir(root.path()).unwrap().count(), 1);
        let lock = WriteLock::take(&root.path().join("part")).unwrap();
        for result in [add(&store, 1.0, true, Ok(())), store.remove("part")] {
            assert!(matches!(result, Err(StoreError::Locked(_))), "{result:?}");
        }
        drop(lock);
        store.remove("part").unwrap();
    }

    #[test]
    fn a_folder_that_is_no_object_is_neither_replaced_nor_removed() {
        let root = tempfile::tempdir().unwrap();
        let store = ObjectStore::new(root.path());
        std::fs::create_dir(root.path().join("part")).unwrap();
        std::fs::write(root.path().join("part/photograph.png"), "of my grandmother").unwrap();
        let error = add(&store, 1.0, true, Ok(())).unwrap_err();
        assert!(matches!(error, StoreError::NotAnObject { .. }), "{error}");
        assert!(matches!(store.remove("part"), Err(StoreError::Unknown { .. })));
        assert!(root.path().join("part/photograph.png").is_file());
    }

    #[test]
    fn a_broken_file_of_the_store_is_an_error_with_advice() {
        let root = tempfile::tempdir().unwrap();
        let store = ObjectStore::new(root.path());
        add(&store, 1.0, false, Ok(())).unwrap();
        let file = root.path().join("part/object.json");
        let good = std::fs::read_to_string(&file).unwrap();
        let axis = |axis: &str, offset: &str| {
            format!("\"symmetries_continuous\": [{{\"axis\": {axis}, \"offset\": {offset}}}]")
        };
        let none = "\"symmetries_continuous\": []";
        let diameter = format!("\"diameter\": {}", mesh(1.0).diameter());
        for (field, from, to) in [
            ("diameter", diameter.as_str(), "\"diameter\": 12.5".to_owned()),
            ("diameter", &diameter, "\"diameter\": 0".to_owned()),
            ("faces", "\"faces\": 4", "\"faces\": 4000000000".to_owned()),
            ("vertices", "\"vertices\": 4", "\"vertices\": 0".to_owned()),
            ("axis", none, axis("[0, 0, 0]", "[0, 0, 0]")),
            ("offset", none, axis("[0, 0, 1]", "[0, 0, 1e200]")),
            (
                "symmetries_discrete",
                "\"symmetries_discrete\": []",
                "\"symmetries_discrete\": [[[1,0,0,0],[0,1,0,0],[0,0,1,1e300],[0,0,0,1]]]".to_owned(),
            ),
            ("version", "\"version\": 1", "\"version\": 7".to_owned()),
        ] {
            assert!(good.contains(from), "{from}: {good}");
            std::fs::write(&file, good.replacen(from, &to, 1)).unwrap();
            let error = store.load("part").unwrap_err().to_string();
            for part in [field, "object.json", "sixfold object add part", "--replace"] {
                assert!(error.contains(part), "{part}: {error}");
            }
        }
        std::fs::write(&file, &good).unwrap();
        store.load("part").unwrap();
        std::fs::write(root.path().join("part/mesh.ply"), "ply\n").unwrap();
        let error = store.load("part").unwrap_err();
        assert!(error.to_string().contains("object add part"), "{error}");
        // An object that cannot be read can be removed.
        std::fs::write(&file, "{").unwrap();
        store.remove("part").unwrap();
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
