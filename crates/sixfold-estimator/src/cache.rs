//! Storage for the data that methods derive from mesh files, kept between runs: one folder per mesh in the user's cache, never
//! beside the mesh.
//!
//! The size is bounded: when the cache exceeds its limit, the least recently used folders are removed. Several processes may
//! share it: files are written under another name first, a folder's name is a hash of the mesh, and a file that disappears is
//! made again.

use std::path::{Path, PathBuf};
use std::time::SystemTime;

use sixfold_geometry::Pose;
use sixfold_io::Fnv1a;
use sixfold_mesh::{Mesh, ModelInfo};
use thiserror::Error;

/// Why the cache cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CacheError {
    /// The system refused.
    #[error(
        "cache folder {}: {source}; give another with --cache DIR, or --no-cache to keep nothing",
        path.display()
    )]
    Io {
        /// The folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
}

/// A folder for data that can be computed again.
#[derive(Debug, Clone, Default)]
pub struct Cache {
    folder: Option<PathBuf>,
    limit: u64,
}

impl Cache {
    /// Default limit of a cache in bytes: some hundred objects with templates and descriptors.
    pub const LIMIT: u64 = 1 << 30;

    /// A cache that keeps nothing.
    pub fn none() -> Cache {
        Cache::default()
    }

    /// A cache in a folder, made when first needed, of at most `limit` bytes.
    pub fn new(folder: impl Into<PathBuf>, limit: u64) -> Cache {
        Cache { folder: Some(folder.into()), limit }
    }

    /// The user's cache: `$XDG_CACHE_HOME/sixfold`, else `~/.cache/sixfold` (XDG Base Directory Specification 0.8); nothing is
    /// stored if neither variable is set.
    pub fn of_user() -> Cache {
        let absolute = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|p| p.is_absolute());
        let base = absolute("XDG_CACHE_HOME").or_else(|| absolute("HOME").map(|home| home.join(".cache")));
        base.map_or_else(Cache::none, |base| Cache::new(base.join("sixfold"), Cache::LIMIT))
    }

    /// Its folder.
    pub fn folder(&self) -> Option<&Path> {
        self.folder.as_deref()
    }

    /// The folder for the data derived from a mesh with its symmetries; marks it as used. `None` without a cache.
    ///
    /// # Errors
    /// [`CacheError`] where the folder cannot be made.
    pub fn of_mesh(&self, mesh: &Mesh, info: &ModelInfo) -> Result<Option<PathBuf>, CacheError> {
        let Some(root) = &self.folder else { return Ok(None) };
        let folder = root.join(format!("{:016x}", fingerprint(mesh, info)));
        let io = |source| CacheError::Io { path: folder.clone(), source };
        std::fs::create_dir_all(&folder).map_err(io)?;
        // The age of this file states when the folder was last used; if it cannot be written, the folder is removed sooner.
        let _ = std::fs::write(folder.join(USED), b"");
        self.prune(&folder);
        Ok(Some(folder))
    }

    /// Removes the least recently used folders until the cache is within its limit; `keep` stays.
    fn prune(&self, keep: &Path) {
        let Some(entries) = self.folder.as_ref().and_then(|f| std::fs::read_dir(f).ok()) else { return };
        let mut folders: Vec<(SystemTime, u64, PathBuf)> = entries
            .flatten()
            .map(|entry| entry.path())
            .filter(|path| is_of_cache(path))
            .map(|path| {
                let used = path.join(USED).metadata().and_then(|m| m.modified());
                (used.unwrap_or(SystemTime::UNIX_EPOCH), size(&path), path)
            })
            .collect();
        folders.sort();
        let mut total: u64 = folders.iter().map(|f| f.1).sum();
        for (_, size, path) in folders {
            if total <= self.limit {
                break;
            }
            if path != keep && std::fs::remove_dir_all(&path).is_ok() {
                total -= size;
            }
        }
    }
}

/// The file whose age states when a folder was last used.
const USED: &str = "used";

/// Whether a folder belongs to the cache: nothing else there is ever removed.
fn is_of_cache(path: &Path) -> bool {
    let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
    path.is_dir() && name.len() == 16 && name.bytes().all(|b| b.is_ascii_hexdigit())
}

fn size(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter_map(|e| e.metadata().ok()).map(|m| m.len()).sum()
}

/// The hash of vertices, faces and symmetries.
fn fingerprint(mesh: &Mesh, info: &ModelInfo) -> u64 {
    let symmetries = info.symmetries_discrete.iter().map(Pose::to_matrix);
    let symmetries = symmetries.flat_map(|m| m.iter().copied().collect::<Vec<f64>>());
    let axes =
        info.symmetries_continuous.iter().flat_map(|s| [s.axis, s.offset]).flat_map(|v| [v.x, v.y, v.z]);
    let mut hash = Fnv1a::default();
    hash.write(&mesh.shape_hash().to_le_bytes());
    symmetries.chain(axes).for_each(|number| hash.write(&number.to_le_bytes()));
    hash.value()
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

    #[test]
    fn a_mesh_finds_its_folder_again_and_another_has_another() {
        let root = tempfile::tempdir().unwrap();
        let cache = Cache::new(root.path().join("cache"), Cache::LIMIT);
        let of = |scale: f64| {
            let mesh = mesh(scale);
            cache.of_mesh(&mesh, &ModelInfo::of_mesh(&mesh)).unwrap().unwrap()
        };
        assert_eq!(of(1.0), of(1.0));
        assert_ne!(of(1.0), of(1.1));
        let other = mesh(1.0);
        assert_eq!(Cache::none().of_mesh(&other, &ModelInfo::of_mesh(&other)).unwrap(), None);
    }

    #[test]
    fn the_least_recently_used_is_removed_first_and_foreign_files_stay() {
        let root = tempfile::tempdir().unwrap();
        let cache = Cache::new(root.path(), 2500);
        std::fs::create_dir(root.path().join("photographs")).unwrap();
        std::fs::write(root.path().join("photographs/one"), [0; 9000]).unwrap();
        let mut folders = vec![];
        for scale in [1.0, 1.1, 1.2, 1.3] {
            let mesh = mesh(scale);
            let folder = cache.of_mesh(&mesh, &ModelInfo::of_mesh(&mesh)).unwrap().unwrap();
            std::fs::write(folder.join("ppf.bin"), [0; 1000]).unwrap();
            // File times have only the resolution of the system's clock.
            std::thread::sleep(std::time::Duration::from_millis(20));
            folders.push(folder);
        }
        let first = mesh(1.0);
        cache.of_mesh(&first, &ModelInfo::of_mesh(&first)).unwrap();
        let there: Vec<bool> = folders.iter().map(|f| f.join("ppf.bin").exists()).collect();
        assert_eq!(there, [false, false, true, true]);
        assert!(root.path().join("photographs/one").exists());
    }

    #[test]
    fn a_folder_that_cannot_be_made_is_named() {
        let root = tempfile::tempdir().unwrap();
        let file = root.path().join("file");
        std::fs::write(&file, b"").unwrap();
        let mesh = mesh(1.0);
        let error = Cache::new(&file, 1).of_mesh(&mesh, &ModelInfo::of_mesh(&mesh)).unwrap_err().to_string();
        assert!(error.contains("file") && error.contains("--no-cache"), "{error}");
    }
}
