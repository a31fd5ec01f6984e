//! Opening files whose paths come from outside: only regular files, up to a size. Otherwise reading a pipe could wait for ever,
//! and a device such as `/dev/zero` would be read until memory is exhausted.

use std::fs::{File, FileType, Metadata};
use std::io::{self, Read};
use std::path::Path;

/// Limits of [`read_regular`] by kind of file, in bytes: several times as much as any such file needs.
pub mod limits {
    /// A mesh, or a buffer of one.
    pub const MESH: u64 = 2 << 30;
    /// A compressed image file, including textures.
    pub const IMAGE: u64 = 1 << 30;
    /// A camera, a gripper, a list of names, one object's record.
    pub const SMALL_TEXT: u64 = 64 << 20;
    /// Ground truth, detections, targets, results.
    pub const LARGE_TEXT: u64 = 2 << 30;
    /// A network's weights.
    pub const WEIGHTS: u64 = 8 << 30;
    /// Derived data of one object: a description, templates, descriptors.
    pub const DERIVED: u64 = 1 << 30;
}

/// Opens a regular file of at most `limit` bytes to read it.
///
/// # Errors
/// The system's error; [`io::ErrorKind::InvalidInput`] for a folder, a pipe or a device, [`io::ErrorKind::FileTooLarge`] for a
/// larger file. The messages state what was found and expected, but not the file.
pub fn open_regular(path: &Path, limit: u64) -> io::Result<File> {
    // Check before opening, because opening a pipe waits for a writer.
    check(&std::fs::metadata(path)?, limit)?;
    let file = File::open(path)?;
    // It may have been replaced meanwhile.
    check(&file.metadata()?, limit)?;
    Ok(file)
}

/// The bytes of a regular file of at most `limit` bytes.
///
/// # Errors
/// As [`open_regular`].
pub fn read_regular(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let file = open_regular(path, limit)?;
    let size = file.metadata()?.len();
    let mut bytes = Vec::with_capacity(usize::try_from(size).unwrap_or_default());
    // Reading stops at the limit also for a file that grows meanwhile or that reports no size.
    file.take(limit.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit { Err(too_large(bytes.len() as u64, limit)) } else { Ok(bytes) }
}

/// The text of a regular file of at most `limit` bytes, in UTF-8.
///
/// # Errors
/// As [`open_regular`], and [`io::ErrorKind::InvalidData`] for bytes that are not UTF-8.
pub fn read_regular_text(path: &Path, limit: u64) -> io::Result<String> {
    String::from_utf8(read_regular(path, limit)?).map_err(|_| {
        io::Error::new(io::ErrorKind::InvalidData, "found bytes that are no UTF-8, expected text")
    })
}

fn check(found: &Metadata, limit: u64) -> io::Result<()> {
    if !found.is_file() {
        let what = kind(found.file_type());
        let message = format!("found {what}, expected a regular file; write its content into a file first");
        return Err(io::Error::new(io::ErrorKind::InvalidInput, message));
    }
    if found.len() > limit { Err(too_large(found.len(), limit)) } else { Ok(()) }
}

fn too_large(found: u64, limit: u64) -> io::Error {
    let message =
        format!("found {} MB, expected at most {} MB in a file of this kind", found >> 20, limit >> 20);
    io::Error::new(io::ErrorKind::FileTooLarge, message)
}

#[cfg(unix)]
fn kind(kind: FileType) -> &'static str {
    use std::os::unix::fs::FileTypeExt;
    match kind {
        k if k.is_dir() => "a folder",
        k if k.is_fifo() => "a pipe",
        k if k.is_socket() => "a socket",
        _ => "a device",
    }
}

#[cfg(not(unix))]
fn kind(kind: FileType) -> &'static str {
    if kind.is_dir() { "a folder" } else { "a device" }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_regular_files_within_the_limit_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("camera.json");
        std::fs::write(&file, "{}").unwrap();
        assert_eq!(read_regular_text(&file, 2).unwrap(), "{}");
        let error = read_regular(&file, 1).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::FileTooLarge);
        let error = read_regular(folder.path(), 9).unwrap_err().to_string();
        assert!(error.contains("found a folder, expected a regular file"), "{error}");
        assert_eq!(read_regular(&folder.path().join("none"), 9).unwrap_err().kind(), io::ErrorKind::NotFound);
    }

    #[cfg(unix)]
    #[test]
    fn a_pipe_is_not_waited_for_and_a_device_not_read() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("mesh.ply");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let error = read_regular(&pipe, 9).unwrap_err().to_string();
        assert!(error.contains("found a pipe"), "{error}");
        let zeros = folder.path().join("zeros");
        std::os::unix::fs::symlink("/dev/zero", &zeros).unwrap();
        let error = read_regular(&zeros, u64::MAX - 1).unwrap_err().to_string();
        assert!(error.contains("found a device"), "{error}");
    }
}
