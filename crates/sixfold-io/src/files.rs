//! Atomic writes of whole files. Readers never see a partly written file, the leftovers of a killed writer are removed by the next
//! write, and a written file survives a power failure with contents and name (`fsync` of the file before it is renamed, and of its
//! folder after).

use std::fs::{self, File, TryLockError};
use std::io::ErrorKind::{InvalidInput, PermissionDenied, Unsupported};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use crate::lock::still_there;

/// Writes `bytes` to a temporary file beside `path` and renames it: readers get the old file or the new one. Missing parent
/// folders are created.
///
/// # Errors
/// The system's error. The temporary file is then removed and `path` is unchanged, unless only the sync of the folder failed.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> io::Result<()> {
    make_folder_of(path)?;
    write_atomically_with(path, |file| file.write_all(bytes))
}

/// Creates the folder of `path` with its missing parents, and syncs their names to the disk.
///
/// # Errors
/// The system's error.
pub fn make_folder_of(path: &Path) -> io::Result<()> {
    let Some(parent) = path.parent().filter(|p| !p.as_os_str().is_empty()) else { return Ok(()) };
    let missing: Vec<&Path> =
        parent.ancestors().take_while(|a| !a.as_os_str().is_empty() && !a.exists()).collect();
    if missing.is_empty() {
        return Ok(());
    }
    fs::create_dir_all(parent)?;
    missing.into_iter().rev().try_for_each(sync_folder_of)
}

/// Syncs the folder of a file or folder that was created or renamed, so that its name survives a power failure. Where folders
/// cannot be synced (Windows, some network file systems) this depends on the system.
///
/// # Errors
/// The system's error, such as a broken disk.
pub fn sync_folder_of(path: &Path) -> io::Result<()> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    #[cfg(test)]
    tests::SYNCED.with_borrow_mut(|synced| synced.push(folder.to_owned()));
    if !cfg!(unix) {
        return Ok(());
    }
    match File::open(folder).and_then(|folder| folder.sync_all()) {
        // A folder that can be written but not read, or a file system that does not support the request.
        Err(error) if matches!(error.kind(), InvalidInput | PermissionDenied | Unsupported) => Ok(()),
        result => result,
    }
}

/// As [`write_atomically`], with the content from `write`, into an existing folder. A link is kept and its target is written; a
/// device or a pipe (`/dev/null`, `/dev/stdout`) is written directly, not replaced.
///
/// # Errors
/// The error of the system or of `write`, as for [`write_atomically`].
pub fn write_atomically_with(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> io::Result<()> {
    if fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir()) {
        let mut file = BufWriter::new(File::options().write(true).open(path)?);
        return write(&mut file).and_then(|()| file.flush());
    }
    let linked = fs::symlink_metadata(path).is_ok_and(|found| found.is_symlink());
    let linked = if linked { fs::canonicalize(path).ok() } else { None };
    let path = linked.as_deref().unwrap_or(path);
    let (temporary, file) = temporary_beside(path)?;
    let mut file = BufWriter::new(file);
    // The file stays open, and therefore locked, until it is renamed, so that no other process takes it for a leftover.
    let result = write(&mut file)
        .and_then(|()| file.flush())
        .and_then(|()| file.get_ref().sync_all())
        .and_then(|()| fs::rename(&temporary, path));
    match result {
        Ok(()) => {
            remove_left_behind(path);
            sync_folder_of(path)
        }
        Err(error) => {
            // The first error is the one to report; a temporary file left behind changes nothing.
            drop(fs::remove_file(&temporary));
            Err(error)
        }
    }
}

/// The `number`th temporary file of a target, `.NAME.NUMBER.tmp`.
fn temporary(path: &Path, number: usize) -> io::Result<PathBuf> {
    let name = path
        .file_name()
        .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "the path does not end in a file name"))?;
    Ok(path.with_file_name(format!(".{}.{number}.tmp", name.to_string_lossy())))
}

/// An empty, locked temporary file for `path`: the first one that no running writer holds, so that leftovers of killed writers are
/// reused rather than kept for ever.
fn temporary_beside(path: &Path) -> io::Result<(PathBuf, File)> {
    let mut number = 0;
    loop {
        let temporary = temporary(path, number)?;
        let file = File::options().read(true).write(true).create(true).truncate(false).open(&temporary)?;
        match file.try_lock() {
            // Its holder may have renamed or removed it between opening and locking; then this is another file.
            Ok(()) if still_there(&file, &temporary) => {
                file.set_len(0)?;
                return Ok((temporary, file));
            }
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => number += 1,
            // A file system without locks: use a unique name.
            Err(TryLockError::Error(_)) => {
                drop(fs::remove_file(&temporary));
                return unshared(path);
            }
        }
    }
}

/// A temporary file under a name that is unique to this process and call.
fn unshared(path: &Path) -> io::Result<(PathBuf, File)> {
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    let number = COUNTER.fetch_add(1, Ordering::Relaxed);
    let first = temporary(path, 0)?;
    let temporary = first.with_extension(format!("{}.{number}.tmp", std::process::id()));
    let file = File::create(&temporary)?;
    Ok((temporary, file))
}

/// Removes the leftovers of killed writers for this target, except the first temporary file, which the next write uses.
fn remove_left_behind(path: &Path) {
    for number in 1.. {
        let Ok(temporary) = temporary(path, number) else { return };
        let Ok(file) = File::open(&temporary) else { return };
        if file.try_lock().is_ok() && still_there(&file, &temporary) {
            drop(fs::remove_file(&temporary));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use super::*;

    thread_local! {
        /// The folders that this thread has synced.
        pub(super) static SYNCED: RefCell<Vec<PathBuf>> = const { RefCell::new(vec![]) };
    }

    #[test]
    fn names_of_files_and_of_new_folders_are_handed_to_the_disk() {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path();
        let synced = || SYNCED.with_borrow_mut(std::mem::take);
        synced();
        write_atomically(&root.join("a/b/record.json"), b"new").unwrap();
        assert_eq!(synced(), [root.to_owned(), root.join("a"), root.join("a/b")]);
        write_atomically(&root.join("a/b/record.json"), b"newer").unwrap();
        assert_eq!(synced(), [root.join("a/b")]);
        // If nothing could be written, nothing is renamed.
        assert!(write_atomically_with(&root.join("other"), |_| Err(io::Error::other("no"))).is_err());
        assert!(synced().is_empty());
        sync_folder_of(Path::new("Cargo.toml")).unwrap();
        assert_eq!(synced(), [Path::new(".")]);
        if cfg!(unix) {
            assert_eq!(sync_folder_of(&root.join("none/file")).unwrap_err().kind(), io::ErrorKind::NotFound);
        }
    }

    #[cfg(unix)]
    #[test]
    fn links_stay_and_pipes_are_not_replaced() {
        use std::os::unix::fs::FileTypeExt;
        let dir = tempfile::tempdir().unwrap();
        let (file, link) = (dir.path().join("result.json"), dir.path().join("newest.json"));
        write_atomically(&file, b"old").unwrap();
        std::os::unix::fs::symlink("result.json", &link).unwrap();
        write_atomically(&link, b"new").unwrap();
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
        assert_eq!(fs::read(&file).unwrap(), b"new");
        let pipe = dir.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let from = pipe.clone();
        let reader = std::thread::spawn(move || fs::read(from).unwrap());
        write_atomically(&pipe, b"through").unwrap();
        assert_eq!(reader.join().unwrap(), b"through");
        assert!(fs::symlink_metadata(&pipe).unwrap().file_type().is_fifo());
    }

    #[test]
    fn a_file_is_replaced_and_nothing_is_left_beside_it() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("deep/scene_gt.json");
        write_atomically(&path, b"old").unwrap();
        write_atomically(&path, b"new").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert_eq!(fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
    }

    #[test]
    fn a_failed_write_leaves_no_temporary_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("taken");
        fs::create_dir_all(path.join("inside")).unwrap();
        assert!(write_atomically(&path, b"x").is_err());
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_failed_writer_leaves_the_old_file_and_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("weights");
        write_atomically_with(&path, |f| f.write_all(b"old")).unwrap();
        let error = write_atomically_with(&path, |f| {
            f.write_all(b"half of the n")?;
            Err(io::Error::new(io::ErrorKind::StorageFull, "no space left on device"))
        })
        .unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::StorageFull);
        assert_eq!(fs::read(&path).unwrap(), b"old");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn leftovers_of_a_killed_writer_are_removed_by_the_next_write() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("record.json");
        for number in 0..3 {
            fs::write(temporary(&path, number).unwrap(), b"half of the n").unwrap();
        }
        write_atomically(&path, b"new").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"new");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_living_writer_keeps_its_temporary_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("record.json");
        write_atomically_with(&path, |file| {
            file.write_all(b"the slower one")?;
            write_atomically(&path, b"the faster one")?;
            assert_eq!(fs::read(&path)?, b"the faster one");
            Ok(())
        })
        .unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"the slower one");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn many_writers_of_one_file_never_mix() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("record.json");
        std::thread::scope(|scope| {
            for writer in 0..8u8 {
                let path = &path;
                scope.spawn(move || {
                    for _ in 0..50 {
                        write_atomically(path, &[writer; 5000]).unwrap();
                        let read = fs::read(path).unwrap();
                        assert!(read.len() == 5000 && read.iter().all(|b| *b == read[0]));
                    }
                });
            }
        });
        write_atomically(&path, b"last").unwrap();
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }
}
