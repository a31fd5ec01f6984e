//! Folders that commands write: one writer at a time, and files of others are never replaced. A dataset can only be resumed
//! with the options and the inputs that it was started with; a folder of images keeps a list of the files that commands wrote.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use serde_json::{Value, json};
use sixfold_geometry::RgbImage;
use sixfold_io::{Fnv1a, LockError, WriteLock, fnv1a_of_file};
use sixfold_mesh::{Mesh, ModelInfo, ModelsInfo, PlyFormat, Unit, ply_files};

use crate::output::write_atomically;

/// Holds the options of a dataset and the hashes of its inputs.
const OPTIONS: &str = "options.json";
/// Lists the files of a folder that commands wrote.
const OWN_FILES: &str = ".sixfold-files";

/// Hashes of the contents of a command's inputs, by name. Paths are not enough, since files change.
#[derive(Debug, Default)]
pub struct Contents(BTreeMap<String, Fnv1a>);

impl Contents {
    /// The hash of one input, to be filled.
    pub fn of(&mut self, name: impl Into<String>) -> &mut Fnv1a {
        self.0.entry(name.into()).or_default()
    }

    /// Adds a file, or the files of a folder with their names.
    ///
    /// # Errors
    /// When one cannot be read.
    pub fn add_path(&mut self, name: &str, path: &Path) -> Result<()> {
        let mut files = vec![path.to_path_buf()];
        if path.is_dir() {
            let read = std::fs::read_dir(path).with_context(|| path.display().to_string())?;
            files = read.map(|entry| Ok(entry?.path())).collect::<Result<_>>()?;
            files.retain(|file| file.is_file());
            files.sort();
        }
        for file in files {
            let hash = fnv1a_of_file(&file).with_context(|| file.display().to_string())?;
            self.of(name).write(file.file_name().unwrap_or_default().as_encoded_bytes());
            self.of(name).write(&hash.to_le_bytes());
        }
        Ok(())
    }

    /// Adds an object: its whole mesh, diameter and symmetries.
    pub fn add_object(&mut self, name: &str, mesh: &Mesh, info: &ModelInfo) {
        let hash = self.of(name);
        hash.write(&mesh.contents_hash().to_le_bytes());
        hash.write(&info.contents_hash().to_le_bytes());
    }

    /// One hash of all of them.
    pub fn value(&self) -> u64 {
        let mut all = Fnv1a::default();
        all.write(self.to_json().to_string().as_bytes());
        all.value()
    }

    fn to_json(&self) -> Value {
        self.0.iter().map(|(name, hash)| (name.clone(), json!(format!("{:016x}", hash.value())))).collect()
    }
}

/// The folder of a new dataset.
pub struct DatasetFolder {
    path: PathBuf,
    options: Value,
    _lock: WriteLock,
}

impl DatasetFolder {
    /// Takes the folder for `command` with these options, a JSON object. `inputs` are the paths that the command reads.
    ///
    /// # Errors
    /// When the folder is an input, another process writes it, it was started with other options, or it holds anything else.
    pub fn take(path: &Path, command: &str, mut options: Value, inputs: &[&Path]) -> Result<DatasetFolder> {
        let lock = lock(path)?;
        // The lock created the parent folders: only now can a path with `..` be resolved.
        refuse_inputs(path, inputs)?;
        options["command"] = json!(command);
        let folder = DatasetFolder { path: path.to_path_buf(), options, _lock: lock };
        match folder.kept()? {
            Some(kept) => folder.compare(&kept, &folder.options, "made with another")?,
            None => refuse_contents(path)?,
        }
        Ok(folder)
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Stores the hashes of the inputs, or compares them with those stored when the folder was started. Nothing is written
    /// before that.
    ///
    /// # Errors
    /// When the inputs have changed: new images would belong to other objects than those in the folder.
    pub fn begin(&self, contents: &Contents) -> Result<()> {
        let contents = contents.to_json();
        match self.kept()? {
            Some(kept) => self.compare(&kept["contents"], &contents, "made from other contents of"),
            None => {
                let mut options = self.options.clone();
                options["contents"] = contents;
                write_atomically(&self.path.join(OPTIONS), format!("{options:#}\n").as_bytes())
            }
        }
    }

    fn kept(&self) -> Result<Option<Value>> {
        let file = self.path.join(OPTIONS);
        if !file.exists() {
            return Ok(None);
        }
        let text = std::fs::read_to_string(&file).with_context(|| file.display().to_string())?;
        let kept: Value = serde_json::from_str(&text).with_context(|| {
            format!("{}: not the options of a dataset; choose another --out", file.display())
        })?;
        Ok(Some(kept))
    }

    fn compare(&self, before: &Value, now: &Value, what: &str) -> Result<()> {
        let keys = [before, now].into_iter().filter_map(Value::as_object).flat_map(|o| o.keys());
        let differs =
            |key: &&String| key.as_str() != "contents" && before.get(key.as_str()) != now.get(key.as_str());
        if let Some(key) = keys.into_iter().find(differs) {
            bail!(
                "{}: {what} {key} (there {}, now {}); give the same to continue, or another --out",
                self.path.join(OPTIONS).display(),
                before.get(key.as_str()).unwrap_or(&Value::Null),
                now.get(key.as_str()).unwrap_or(&Value::Null)
            );
        }
        Ok(())
    }

    /// Writes the models with their `models_info.json`.
    ///
    /// # Errors
    /// As `DatasetFolder::write_once`.
    pub fn write_models<'a>(
        &self,
        models: impl Iterator<Item = (u32, &'a Mesh, &'a ModelInfo)>,
    ) -> Result<()> {
        let mut infos = ModelsInfo::default();
        for (id, mesh, info) in models {
            let path = self.path.join("models").join(format!("obj_{id:06}.ply"));
            for (file, bytes) in ply_files(&path, mesh, Unit::Millimetre, PlyFormat::BinaryLittleEndian)? {
                self.write_once(&file, &bytes)?;
            }
            infos.0.insert(id, info.clone());
        }
        self.write_once(&self.path.join("models/models_info.json"), infos.to_text().as_bytes())
    }

    /// Writes a file of the folder unless it is there and equal.
    ///
    /// # Errors
    /// When it exists with other contents: images in the folder already belong to it.
    pub(crate) fn write_once(&self, file: &Path, bytes: &[u8]) -> Result<()> {
        match std::fs::read(file) {
            Ok(there) if there == bytes => Ok(()),
            Ok(_) => bail!(
                "{}: it differs from what this command wrote there: the file was changed; remove the folder and start again, or choose \
                 another --out",
                file.display()
            ),
            Err(_) => write_atomically(file, bytes),
        }
    }
}

/// The lock of a folder, the same for every path to it. The lock file is beside the folder, which need not exist, or inside it
/// where nothing can be written beside it, as for a mounted folder.
fn lock(path: &Path) -> Result<WriteLock> {
    let place = path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    match WriteLock::take(&place) {
        Err(LockError::Io { .. }) if place.is_dir() => Ok(WriteLock::take(&place.join("folder"))?),
        lock => Ok(lock?),
    }
}

/// An error where `out` is one of the inputs, by whatever path.
fn refuse_inputs(out: &Path, inputs: &[&Path]) -> Result<()> {
    let Ok(place) = out.canonicalize() else { return Ok(()) };
    if let Some(input) = inputs.iter().find(|input| input.canonicalize().is_ok_and(|i| i == place)) {
        bail!(
            "--out {}: holds another dataset or file: it is the input {}, which would be written over; choose another --out",
            out.display(),
            input.display()
        );
    }
    Ok(())
}

/// An error where a folder holds anything but hidden files.
fn refuse_contents(out: &Path) -> Result<()> {
    let hidden = |name: &std::ffi::OsStr| name.as_encoded_bytes().starts_with(b".");
    match std::fs::read_dir(out) {
        Ok(entries) => {
            let mut names: Vec<_> = entries.flatten().map(|e| e.file_name()).filter(|n| !hidden(n)).collect();
            names.sort();
            let Some(first) = names.first() else { return Ok(()) };
            bail!(
                "--out {}: holds another dataset or other files ({}), which would be written over; choose another --out",
                out.display(),
                first.to_string_lossy()
            );
        }
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(error).with_context(|| format!("--out {}", out.display())),
    }
}

/// A folder for a command's images and files, which may hold other files too.
pub struct OutputFolder {
    path: PathBuf,
    own: BTreeSet<String>,
    _lock: WriteLock,
}

impl OutputFolder {
    /// Takes the folder.
    ///
    /// # Errors
    /// When another process writes it.
    pub fn take(path: &Path) -> Result<OutputFolder> {
        let lock = lock(path)?;
        let own = std::fs::read_to_string(path.join(OWN_FILES)).unwrap_or_default();
        let own = own.lines().map(str::to_owned).collect();
        Ok(OutputFolder { path: path.to_path_buf(), own, _lock: lock })
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The path of a file to be written, which is added to the list of the folder's own files.
    ///
    /// # Errors
    /// When the file exists and no command wrote it.
    pub fn file(&mut self, name: &str) -> Result<PathBuf> {
        Ok(self.files(&[name])?.remove(0))
    }

    /// The paths of all files to be written: either all of them can be written, or none is touched.
    ///
    /// # Errors
    /// As [`OutputFolder::file`].
    pub fn files(&mut self, names: &[&str]) -> Result<Vec<PathBuf>> {
        let foreign =
            |name: &&&str| !self.own.contains(**name) && self.path.join(name).symlink_metadata().is_ok();
        if let Some(name) = names.iter().find(foreign) {
            bail!(
                "{}: is there already and was not written by this program; move it, or choose another folder for the output",
                self.path.join(name).display()
            );
        }
        let new: Vec<String> = names
            .iter()
            .map(|name| (*name).to_owned())
            .filter(|name| self.own.insert(name.clone()))
            .collect();
        if !new.is_empty() {
            let list = self.path.join(OWN_FILES);
            note_files(&list, &new).with_context(|| list.display().to_string())?;
        }
        Ok(names.iter().map(|name| self.path.join(name)).collect())
    }

    /// Writes an image.
    ///
    /// # Errors
    /// As [`OutputFolder::file`], and when it cannot be written.
    pub fn write_rgb(&mut self, name: &str, image: &RgbImage) -> Result<PathBuf> {
        let path = self.file(name)?;
        sixfold_io::write_rgb(&path, image)?;
        Ok(path)
    }

    /// Writes a text.
    ///
    /// # Errors
    /// As [`OutputFolder::file`], and when it cannot be written.
    pub fn write_text(&mut self, name: &str, text: &str) -> Result<PathBuf> {
        let path = self.file(name)?;
        write_atomically(&path, text.as_bytes())?;
        Ok(path)
    }
}

/// Adds names to the list of a folder's own files, before the files are written.
fn note_files(list: &Path, names: &[String]) -> std::io::Result<()> {
    if let Some(folder) = list.parent() {
        std::fs::create_dir_all(folder)?;
    }
    let mut file = std::fs::File::options().append(true).read(true).create(true).open(list)?;
    let mut before = vec![];
    file.read_to_end(&mut before)?;
    // A process that was killed may have left an incomplete line.
    let gap = if before.last().is_some_and(|byte| *byte != b'\n') { "\n" } else { "" };
    file.write_all(format!("{gap}{}\n", names.join("\n")).as_bytes())
}

/// Copies the files of a folder, without subfolders.
///
/// # Errors
/// When one cannot be read or written.
pub fn copy_files(from: &Path, to: &Path) -> Result<()> {
    std::fs::create_dir_all(to).with_context(|| format!("folder {}", to.display()))?;
    for entry in std::fs::read_dir(from).with_context(|| format!("folder {}", from.display()))? {
        let path = entry?.path();
        if let Some(name) = path.file_name().filter(|_| path.is_file()) {
            std::fs::copy(&path, to.join(name)).with_context(|| format!("cannot copy {}", path.display()))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error<T>(result: Result<T>) -> String {
        result.map(|_| ()).unwrap_err().to_string()
    }

    #[test]
    fn a_dataset_folder_is_for_one_command_its_options_and_contents() {
        let root = tempfile::tempdir().unwrap();
        let out = root.path().join("new");
        let (dataset, input) = (root.path().join("dataset"), root.path().join("input"));
        std::fs::create_dir_all(&dataset).unwrap();
        std::fs::write(dataset.join("camera.json"), "{}").unwrap();
        std::fs::write(&input, "one").unwrap();
        let take =
            |out: &Path, seed: u32| DatasetFolder::take(out, "make", json!({ "seed": seed }), &[&dataset]);
        let contents = || {
            let mut contents = Contents::default();
            contents.add_path("mesh", &input).unwrap();
            contents
        };
        // Refused: its input by any path, and a folder with files that are not its own.
        for path in ["dataset", "new/../dataset", "./dataset/"] {
            assert!(error(take(&root.path().join(path), 1)).contains("is the input"), "{path}");
        }
        std::fs::create_dir_all(&out).unwrap();
        std::fs::write(out.join("notes.txt"), "mine").unwrap();
        assert!(error(take(&out, 1)).contains("notes.txt"));
        std::fs::remove_file(out.join("notes.txt")).unwrap();

        let folder = take(&out, 1).unwrap();
        assert!(error(take(&out, 1)).contains("another process"));
        folder.begin(&contents()).unwrap();
        folder.write_once(&out.join("a"), b"x").unwrap();
        folder.write_once(&out.join("a"), b"x").unwrap();
        assert!(error(folder.write_once(&out.join("a"), b"y")).contains("changed"));
        drop(folder);
        take(&out, 1).unwrap().begin(&contents()).unwrap();
        assert!(error(take(&out, 2)).contains("another seed (there 1, now 2)"));
        assert!(
            error(DatasetFolder::take(&out, "paint", json!({ "seed": 1 }), &[])).contains("another command")
        );
        std::fs::write(&input, "two").unwrap();
        assert!(error(take(&out, 1).unwrap().begin(&contents())).contains("other contents of mesh"));
    }

    #[test]
    fn an_output_folder_replaces_its_own_files_only() {
        let root = tempfile::tempdir().unwrap();
        std::fs::write(root.path().join("depth.png"), "taken with a camera").unwrap();
        let mut folder = OutputFolder::take(root.path()).unwrap();
        assert!(error(folder.files(&["mask.png", "depth.png"])).contains("depth.png"));
        assert!(!root.path().join(OWN_FILES).exists());
        folder.write_text("result.json", "1").unwrap();
        drop(folder);
        OutputFolder::take(root.path()).unwrap().write_text("result.json", "2").unwrap();
        assert_eq!(std::fs::read_to_string(root.path().join("result.json")).unwrap(), "2");
        assert_eq!(std::fs::read_to_string(root.path().join("depth.png")).unwrap(), "taken with a camera");
    }
}
