//! One writer at a time: an advisory lock on a file or folder that several runs of a program could write at once.

use std::fs::{File, TryLockError};
use std::io::{self, Read, Seek, Write};
use std::path::{Path, PathBuf};

use thiserror::Error;

/// Why a lock cannot be taken.
#[derive(Debug, Error)]
pub enum LockError {
    /// Another process writes there.
    #[error(
        "{}: another process{} is writing it; wait until that one is done, or choose another place for this one's output",
        path.display(), holder.map(|id| format!(" ({id})")).unwrap_or_default()
    )]
    Taken {
        /// The path to be locked.
        path: PathBuf,
        /// The other process, if its id could be read.
        holder: Option<u32>,
    },
    /// The system could not make or lock the lock file.
    #[error("{}: cannot be locked: {source}", path.display())]
    Io {
        /// The lock file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
}

/// A lock that is held until it is dropped. It is a file `.NAME.lock` beside the locked path, which is removed with the lock;
/// the file of a killed process locks nothing.
#[derive(Debug)]
pub struct WriteLock {
    path: PathBuf,
    /// Folders that were created for the lock file, the deepest first: they are removed with it unless they contain other
    /// files.
    made: Vec<PathBuf>,
    /// Holds the system's lock, which the system releases when the process ends.
    _file: File,
}

impl WriteLock {
    /// Locks `path`, a file or a folder that need not exist yet. Missing parent folders are created.
    ///
    /// # Errors
    /// [`LockError::Taken`] immediately when another process, or another lock of this one, holds it.
    pub fn take(path: &Path) -> Result<WriteLock, LockError> {
        let lock = lock_file(path).map_err(|source| LockError::Io { path: path.into(), source })?;
        let io = |source| LockError::Io { path: lock.clone(), source };
        let parent = lock.parent().filter(|p| !p.as_os_str().is_empty());
        let missing = |parent: &&Path| !parent.as_os_str().is_empty() && !parent.exists();
        let made = parent.into_iter().flat_map(Path::ancestors).take_while(missing);
        let made: Vec<PathBuf> = made.map(Path::to_path_buf).collect();
        loop {
            if let Some(parent) = parent {
                std::fs::create_dir_all(parent).map_err(io)?;
            }
            let opened = File::options().read(true).write(true).create(true).truncate(false).open(&lock);
            let mut file = match opened {
                // Another lock had created the folder and has removed it again.
                Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
                opened => opened.map_err(io)?,
            };
            match file.try_lock() {
                Ok(()) => {}
                Err(TryLockError::WouldBlock) => {
                    let mut text = String::new();
                    let holder = file.read_to_string(&mut text).ok().and_then(|_| text.trim().parse().ok());
                    return Err(LockError::Taken { path: path.into(), holder });
                }
                Err(TryLockError::Error(source)) => return Err(io(source)),
            }
            // The previous holder may have removed the file between opening and locking: then this lock has no effect.
            if !still_there(&file, &lock) {
                continue;
            }
            // The id only tells other processes who holds the lock: on a full disk the lock holds nevertheless.
            let id = format!("{}\n", std::process::id());
            let _ = file.set_len(0).and_then(|()| file.rewind()).and_then(|()| file.write_all(id.as_bytes()));
            return Ok(WriteLock { path: lock, made, _file: file });
        }
    }
}

impl Drop for WriteLock {
    fn drop(&mut self) {
        // The file is removed while still locked; if the system does not allow that, an empty lock file remains.
        let _ = std::fs::remove_file(&self.path);
        for folder in &self.made {
            let _ = std::fs::remove_dir(folder);
        }
    }
}

fn lock_file(path: &Path) -> io::Result<PathBuf> {
    let name = match path.file_name() {
        Some(name) => name.to_os_string(),
        // `.` and `..` are not names.
        None => path.canonicalize()?.file_name().map(ToOwned::to_owned).unwrap_or_default(),
    };
    let place = if path.file_name().is_some() { path.to_path_buf() } else { path.canonicalize()? };
    Ok(place.with_file_name(format!(".{}.lock", name.to_string_lossy())))
}

/// Whether `path` still refers to this open file.
#[cfg(unix)]
pub(crate) fn still_there(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    match (file.metadata(), std::fs::metadata(path)) {
        (Ok(mine), Ok(there)) => mine.ino() == there.ino() && mine.dev() == there.dev(),
        _ => false,
    }
}

/// Whether `path` still refers to a file; whether it is this one cannot be checked here.
#[cfg(not(unix))]
pub(crate) fn still_there(_: &File, path: &Path) -> bool {
    path.exists()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_second_writer_is_refused_until_the_first_is_done() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("deep/results.csv");
        let first = WriteLock::take(&path).unwrap();
        let error = WriteLock::take(&path).unwrap_err().to_string();
        let id = std::process::id().to_string();
        assert!(error.contains("results.csv") && error.contains(&id), "{error}");
        drop(first);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        drop(WriteLock::take(&path).unwrap());
    }

    #[test]
    fn a_lock_file_without_its_process_locks_nothing() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(".out.lock"), "123").unwrap();
        drop(WriteLock::take(&folder.path().join("out")).unwrap());
        assert!(!folder.path().join(".out.lock").exists());
    }

    #[test]
    fn many_threads_take_it_one_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out");
        let inside = std::sync::atomic::AtomicUsize::new(0);
        let taken = std::sync::atomic::AtomicUsize::new(0);
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    for _ in 0..200 {
                        let Ok(lock) = WriteLock::take(&path) else { continue };
                        assert_eq!(inside.fetch_add(1, std::sync::atomic::Ordering::SeqCst), 0);
                        taken.fetch_add(1, std::sync::atomic::Ordering::SeqCst);
                        inside.fetch_sub(1, std::sync::atomic::Ordering::SeqCst);
                        drop(lock);
                    }
                });
            }
        });
        assert!(taken.into_inner() > 0);
    }
}
