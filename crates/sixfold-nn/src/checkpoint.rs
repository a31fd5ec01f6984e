//! Checkpoints: everything a training needs to resume as if it had never stopped.
//!
//! A folder contains the last two checkpoints, one file each (`step-000001000.checkpoint`). A file has named sections (networks in
//! f32, optimiser states, the caller's own state as JSON) and a checksum, and is written atomically. A trainer with several
//! networks, such as a generator and a discriminator, gives each a name.
//!
//! The state of Burn's random number generator is not included, because Burn does not expose it: a training that uses random
//! numbers on the device must seed it again at every step from its own seed and the step.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use burn::module::Module;
use burn::optim::{ModuleOptimizer, OptimizerRecord};
use burn::store::{ModuleRecord, RecordError};
use burn::tensor::Bytes;
use serde::Serialize;
use serde::de::DeserializeOwned;
use sixfold_io::write_atomically_with;

use crate::files::explain;
use crate::fingerprint::Fingerprint;
use crate::parameters::{Changeable, Network, Parameters, Visitable};

const MAGIC: &[u8; 8] = b"sixfckp1";
const ENDING: &str = ".checkpoint";
/// Number of files kept in the folder.
const KEPT: usize = 2;

/// Why a checkpoint could not be written, or a training could not be resumed from one.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// A file or the folder could not be read.
    #[error("{}: cannot be read: {}", file.display(), explain(source))]
    Read {
        /// File or folder.
        file: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// A file could not be written. The checkpoints before it are unchanged.
    #[error("{}: cannot be written: {}", file.display(), explain(source))]
    Write {
        /// File or folder.
        file: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// A network, optimiser or state could not be serialised.
    #[error("checkpoint of step {step}: {section}: cannot be recorded: {reason}")]
    Record {
        /// The checkpoint's step.
        step: u64,
        /// Name of the section.
        section: String,
        /// The cause.
        reason: String,
    },
    /// There are checkpoints, but none of them is intact.
    #[error("{}: expected a whole checkpoint, found only broken ones ({}); remove them to start again", folder.display(),
        reasons.join("; "))]
    NoneWhole {
        /// The folder.
        folder: PathBuf,
        /// What is wrong with each file.
        reasons: Vec<String>,
    },
    /// The checkpoint was written before checkpoints named their inputs.
    #[error("{}: does not say from which inputs it was trained (an earlier version of Sixfold wrote it), \
         so it cannot be checked that they are the same; train again in another folder", file.display())]
    NoFingerprint {
        /// The file.
        file: PathBuf,
    },
    /// The checkpoint is intact, but a requested part is missing or does not fit.
    #[error("{}: {section}: expected {expected}, found {found}; continue with the same options as before, or start again in \
        another folder", file.display())]
    Section {
        /// The file.
        file: PathBuf,
        /// Name of the section.
        section: String,
        /// What was requested.
        expected: String,
        /// What was found.
        found: String,
    },
}

/// Section with the inputs on which a training depends.
const FINGERPRINT: &str = "fingerprint";

/// Builder of a checkpoint.
pub struct CheckpointWriter {
    step: u64,
    sections: BTreeMap<String, Vec<u8>>,
}

impl CheckpointWriter {
    /// An empty checkpoint of a training that has done `step` steps.
    pub fn new(step: u64) -> Self {
        CheckpointWriter { step, sections: BTreeMap::new() }
    }

    fn error(&self, section: &str, reason: impl ToString) -> CheckpointError {
        CheckpointError::Record { step: self.step, section: section.to_owned(), reason: reason.to_string() }
    }

    /// Adds a network's parameters and running statistics, exactly.
    ///
    /// # Errors
    /// [`CheckpointError::Record`].
    pub fn module<M: Module>(mut self, name: &str, module: &M) -> Result<Self, CheckpointError> {
        // `valid` applies running statistics that are still pending in other threads.
        let bytes = record_of(&module.valid()).map_err(|e| self.error(name, e))?;
        self.sections.insert(module_section(name), bytes.to_vec());
        Ok(self)
    }

    /// Adds an optimiser's state.
    ///
    /// # Errors
    /// [`CheckpointError::Record`].
    pub fn optimiser(mut self, name: &str, optimiser: &ModuleOptimizer) -> Result<Self, CheckpointError> {
        let bytes = optimiser.into_bytes().map_err(|e| self.error(name, e))?;
        self.sections.insert(optimiser_section(name), bytes.to_vec());
        Ok(self)
    }

    /// Adds the caller's own state. Numbers that JSON cannot represent (infinite, NaN) are lost.
    ///
    /// # Errors
    /// [`CheckpointError::Record`].
    pub fn state<S: Serialize>(mut self, name: &str, state: &S) -> Result<Self, CheckpointError> {
        let bytes = serde_json::to_vec(state).map_err(|e| self.error(name, e))?;
        self.sections.insert(state_section(name), bytes);
        Ok(self)
    }

    /// Adds the inputs on which the training depends.
    ///
    /// # Errors
    /// [`CheckpointError::Record`].
    pub fn fingerprint(self, fingerprint: &Fingerprint) -> Result<Self, CheckpointError> {
        self.state(FINGERPRINT, fingerprint)
    }

    /// Writes the file into `folder`, which is created if necessary, then removes all but the last two checkpoints, and those of
    /// later steps that remain from before the training was resumed at an earlier step.
    ///
    /// # Errors
    /// [`CheckpointError::Write`]; earlier checkpoints are then unchanged.
    pub fn write(self, folder: &Path) -> Result<PathBuf, CheckpointError> {
        fs::create_dir_all(folder)
            .map_err(|source| CheckpointError::Write { file: folder.to_owned(), source })?;
        let path = folder.join(format!("step-{:09}{ENDING}", self.step));
        let mut hash = Checksum::default();
        write_atomically_with(&path, |file| {
            let mut put = |bytes: &[u8]| {
                hash.update(bytes);
                file.write_all(bytes)
            };
            put(MAGIC)?;
            put(&self.step.to_le_bytes())?;
            put(&(self.sections.len() as u64).to_le_bytes())?;
            for (name, bytes) in &self.sections {
                put(&(name.len() as u64).to_le_bytes())?;
                put(name.as_bytes())?;
                put(&(bytes.len() as u64).to_le_bytes())?;
                put(bytes)?;
            }
            let sum = hash.value();
            file.write_all(&sum.to_le_bytes())
        })
        .map_err(|source| CheckpointError::Write { file: path.clone(), source })?;
        let mut earlier = 0;
        for (step, file) in checkpoint_files(folder)? {
            earlier += usize::from(step < self.step);
            if step > self.step || earlier >= KEPT {
                let removed = fs::remove_file(&file);
                removed.map_err(|source| CheckpointError::Write { file, source })?;
            }
        }
        Ok(path)
    }
}

fn record_of(module: &dyn Visitable) -> Result<Bytes, RecordError> {
    Parameters::of(module).into_record().into_bytes()
}

fn load_record(module: &mut dyn Changeable, record: ModuleRecord) -> Result<(), RecordError> {
    Parameters::of(module.shown()).try_load_record(record)?.put_into(module);
    Ok(())
}

/// An intact checkpoint, read from a file.
#[derive(Debug)]
pub struct Checkpoint {
    file: PathBuf,
    step: u64,
    sections: BTreeMap<String, Vec<u8>>,
    notes: Vec<String>,
}

impl Checkpoint {
    /// The newest intact checkpoint in `folder`, `None` if there is no checkpoint. A newer broken one is skipped with a note.
    ///
    /// # Errors
    /// [`CheckpointError::Read`] and [`CheckpointError::NoneWhole`].
    pub fn latest(folder: &Path) -> Result<Option<Self>, CheckpointError> {
        let files = checkpoint_files(folder)?;
        let mut reasons = Vec::new();
        for (step, file) in files {
            let bytes =
                fs::read(&file).map_err(|source| CheckpointError::Read { file: file.clone(), source })?;
            match parse(&bytes) {
                Ok((found, sections)) if found == step => {
                    let notes = reasons
                        .into_iter()
                        .map(|reason| format!("{reason}; going on from step {step} instead"))
                        .collect();
                    return Ok(Some(Checkpoint { file, step, sections, notes }));
                }
                Ok((found, _)) => reasons.push(format!("{}: holds step {found}", file.display())),
                Err(reason) => reasons.push(format!("{}: broken: {reason}", file.display())),
            }
        }
        if reasons.is_empty() {
            return Ok(None);
        }
        Err(CheckpointError::NoneWhole { folder: folder.to_owned(), reasons })
    }

    /// Steps that the training had done.
    pub fn step(&self) -> u64 {
        self.step
    }

    /// The file from which it was read.
    pub fn file(&self) -> &Path {
        &self.file
    }

    /// Messages about newer broken files, for the user.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    fn section(&self, section: &str) -> Result<&[u8], CheckpointError> {
        let bytes = self.sections.get(section).map(Vec::as_slice);
        bytes.ok_or_else(|| self.error(section, "a section of this name", "none"))
    }

    fn error(&self, section: &str, expected: impl ToString, found: impl ToString) -> CheckpointError {
        CheckpointError::Section {
            file: self.file.clone(),
            section: section.to_owned(),
            expected: expected.to_string(),
            found: found.to_string(),
        }
    }

    /// Restores a network's recorded parameters and running statistics.
    ///
    /// # Errors
    /// [`CheckpointError::Section`] if it is not in the checkpoint or is another network.
    pub fn module<M: Module>(&self, name: &str, module: M) -> Result<M, CheckpointError> {
        let section = module_section(name);
        let bytes = Bytes::from_bytes_vec(self.section(&section)?.to_vec());
        let unfit = |e: RecordError| self.error(&section, "the parameters of this network", e);
        let record = ModuleRecord::from_bytes(bytes).map_err(unfit)?;
        // Running statistics still pending in other threads would later replace the loaded ones.
        drop(module.valid());
        let mut module = Network::new(module);
        load_record(&mut module, record).map_err(unfit)?;
        Ok(module.into_inner())
    }

    /// Restores the recorded state of an optimiser that is configured as before.
    ///
    /// # Errors
    /// [`CheckpointError::Section`] if it is not in the checkpoint or is of another kind of optimiser.
    pub fn optimiser(
        &self,
        name: &str,
        optimiser: ModuleOptimizer,
    ) -> Result<ModuleOptimizer, CheckpointError> {
        let section = optimiser_section(name);
        let bytes = Bytes::from_bytes_vec(self.section(&section)?.to_vec());
        let unfit = |e: RecordError| self.error(&section, "an optimiser's state", e);
        let record = OptimizerRecord::from_bytes(bytes).map_err(unfit)?;
        let expected = record.len();
        let optimiser = optimiser.load_record(record);
        // Burn silently ignores what it cannot use.
        let found = optimiser.to_record().len();
        if found != expected {
            let of_this = format!("a state of {found} tensors that this kind of optimiser can use");
            return Err(self.error(&section, of_this, format!("{expected} tensors")));
        }
        Ok(optimiser)
    }

    /// The caller's own state.
    ///
    /// # Errors
    /// [`CheckpointError::Section`] if it is not in the checkpoint or has another form.
    pub fn state<S: DeserializeOwned>(&self, name: &str) -> Result<S, CheckpointError> {
        let section = state_section(name);
        let bytes = self.section(&section)?;
        serde_json::from_slice(bytes).map_err(|e| self.error(&section, "a state of the same form", e))
    }

    /// The inputs on which the training depends.
    ///
    /// # Errors
    /// [`CheckpointError::NoFingerprint`] for a checkpoint of an earlier version.
    pub fn fingerprint(&self) -> Result<Fingerprint, CheckpointError> {
        if !self.sections.contains_key(&state_section(FINGERPRINT)) {
            return Err(CheckpointError::NoFingerprint { file: self.file.clone() });
        }
        self.state(FINGERPRINT)
    }
}

fn module_section(name: &str) -> String {
    format!("network {name}")
}

fn optimiser_section(name: &str) -> String {
    format!("optimiser {name}")
}

fn state_section(name: &str) -> String {
    format!("state {name}")
}

/// Steps and files of all checkpoints in a folder, newest first.
fn checkpoint_files(folder: &Path) -> Result<Vec<(u64, PathBuf)>, CheckpointError> {
    let error = |source| CheckpointError::Read { file: folder.to_owned(), source };
    let entries = match fs::read_dir(folder) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        other => other.map_err(error)?,
    };
    let mut files = Vec::new();
    for entry in entries {
        let entry = entry.map_err(error)?;
        let name = entry.file_name();
        let step = name.to_str().and_then(|n| n.strip_prefix("step-")?.strip_suffix(ENDING)?.parse().ok());
        if let Some(step) = step {
            files.push((step, entry.path()));
        }
    }
    files.sort_unstable_by(|a, b| b.cmp(a));
    Ok(files)
}

/// Step and sections of a file, or the reason why it is invalid.
fn parse(bytes: &[u8]) -> Result<(u64, BTreeMap<String, Vec<u8>>), String> {
    let content_length = bytes.len().checked_sub(8).ok_or("it ends too early")?;
    let (content, sum) = bytes.split_at(content_length);
    if !content.starts_with(MAGIC) {
        return Err("it does not start as a checkpoint does".to_owned());
    }
    let mut hash = Checksum::default();
    // The checksum is computed over the same pieces as when writing.
    let mut rest = content;
    let mut take = |length: u64| -> Result<&[u8], String> {
        let length = usize::try_from(length).ok().filter(|l| *l <= rest.len()).ok_or("it ends too early")?;
        let (piece, after) = rest.split_at(length);
        rest = after;
        hash.update(piece);
        Ok(piece)
    };
    let number = |piece: &[u8]| piece.iter().rev().fold(0u64, |n, b| n << 8 | u64::from(*b));
    take(MAGIC.len() as u64)?;
    let step = number(take(8)?);
    let count = number(take(8)?);
    let mut sections = BTreeMap::new();
    for _ in 0..count {
        let length = number(take(8)?);
        let name = String::from_utf8_lossy(take(length)?).into_owned();
        let length = number(take(8)?);
        sections.insert(name, take(length)?.to_vec());
    }
    if !rest.is_empty() || hash.value() != number(sum) {
        return Err("its checksum is wrong".to_owned());
    }
    Ok((step, sections))
}

/// FNV-1a over words of eight bytes; the last, shorter word of a piece is filled with zeros and its length is added.
struct Checksum(u64);

impl Default for Checksum {
    fn default() -> Self {
        Checksum(0xcbf2_9ce4_8422_2325)
    }
}

impl Checksum {
    fn word(&mut self, word: u64) {
        self.0 = (self.0 ^ word).wrapping_mul(0x0000_0100_0000_01b3).rotate_left(23);
    }

    fn update(&mut self, piece: &[u8]) {
        let (words, rest) = piece.as_chunks::<8>();
        for word in words {
            self.word(u64::from_le_bytes(*word));
        }
        let mut last = [0; 8];
        last[..rest.len()].copy_from_slice(rest);
        self.word(u64::from_le_bytes(last));
        self.word(piece.len() as u64);
    }

    fn value(&self) -> u64 {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::nn::conv::{Conv2d, Conv2dConfig};
    use burn::nn::{BatchNorm, BatchNormConfig, Linear, LinearConfig};
    use burn::optim::{AdamConfig, AdamWConfig, GradientsParams, SgdConfig};
    use burn::tensor::{Device, Tensor, TensorData};
    use serde::Deserialize;

    #[derive(Module, Debug)]
    struct Net {
        conv: Conv2d,
        norm: BatchNorm,
        head: Linear,
    }

    fn net(width: usize, device: &Device) -> Net {
        Net {
            conv: Conv2dConfig::new([2, width], [3, 3]).init(device),
            norm: BatchNormConfig::new(width).init(device),
            head: LinearConfig::new(width, 1).init(device),
        }
    }

    /// A training whose data depend on the step, as in a real one.
    fn train(net: Net, optimiser: &mut ModuleOptimizer, steps: std::ops::Range<u64>, device: &Device) -> Net {
        steps.fold(net, |net, step| {
            let values: Vec<f32> =
                (0..4 * 2 * 36).map(|i| ((i * i) as f32 * 0.37 + step as f32).sin()).collect();
            let x = Tensor::<4>::from_data(TensorData::new(values, [4, 2, 6, 6]), device);
            let target = x.clone().mean_dim(3).mean_dim(2).slice([0..4, 0..1]).reshape([4, 1]);
            let y = net.norm.forward(net.conv.forward(x)).mean_dim(3).mean_dim(2);
            let [n, c, _, _] = y.dims();
            let loss = (net.head.forward(y.reshape([n, c])) - target).square().mean();
            let gradients = GradientsParams::from_grads(loss.backward(), &net);
            optimiser.step(1e-2, net, gradients)
        })
    }

    fn numbers(net: &Net) -> Vec<u32> {
        let bits = |v: Vec<f32>| v.into_iter().map(f32::to_bits).collect::<Vec<_>>();
        let net = net.valid();
        [
            bits(net.conv.weight.val().try_into_vec_as().unwrap()),
            bits(net.norm.gamma.val().try_into_vec_as().unwrap()),
            bits(net.norm.running_mean.value().try_into_vec_as().unwrap()),
            bits(net.norm.running_var.value().try_into_vec_as().unwrap()),
            bits(net.head.weight.val().try_into_vec_as().unwrap()),
        ]
        .concat()
    }

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Own {
        best: f64,
        order: Vec<u32>,
    }

    #[test]
    fn ten_steps_a_pause_and_ten_steps_are_twenty_steps_bit_by_bit() {
        let device = Device::default().autodiff();
        let optimisers: [fn() -> ModuleOptimizer; 2] =
            [|| AdamConfig::new().init(), || AdamWConfig::new().with_weight_decay(0.01).init()];
        for optimiser in optimisers {
            let dir = tempfile::tempdir().unwrap();
            let start = net(5, &device);
            let start_bytes = start.clone().into_record().into_bytes().unwrap();
            let straight = train(start, &mut optimiser(), 0..20, &device);

            let begin = net(5, &device).load_record(ModuleRecord::from_bytes(start_bytes).unwrap());
            let mut first = optimiser();
            let half = train(begin, &mut first, 0..10, &device);
            let own = Own { best: 0.1, order: vec![3, 1, 2] };
            CheckpointWriter::new(10)
                .module("net", &half)
                .and_then(|w| w.optimiser("net", &first))
                .and_then(|w| w.state("trainer", &own))
                .and_then(|w| w.write(dir.path()))
                .unwrap();
            drop((half, first));

            // Networks are initialised randomly, so only the checkpoint can make them equal.
            let checkpoint = Checkpoint::latest(dir.path()).unwrap().unwrap();
            assert_eq!((checkpoint.step(), checkpoint.notes().len()), (10, 0));
            assert_eq!(checkpoint.state::<Own>("trainer").unwrap(), own);
            let resumed = checkpoint.module("net", net(5, &device)).unwrap();
            let mut second = checkpoint.optimiser("net", optimiser()).unwrap();
            let resumed = train(resumed, &mut second, 10..20, &device);
            assert_eq!(numbers(&straight), numbers(&resumed));
        }
    }

    fn write(dir: &Path, step: u64) {
        CheckpointWriter::new(step).state("n", &step).unwrap().write(dir).unwrap();
    }

    fn steps(dir: &Path) -> Vec<u64> {
        checkpoint_files(dir).unwrap().iter().map(|f| f.0).collect()
    }

    #[test]
    fn the_last_two_are_kept() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("made/when/needed");
        assert!(Checkpoint::latest(&folder).unwrap().is_none());
        for step in [10, 20, 30, 40] {
            write(&folder, step);
        }
        assert_eq!(steps(&folder), [40, 30]);
        // Resumed at 30 and written at 35: 40 belongs to the abandoned part of the training.
        write(&folder, 35);
        assert_eq!(steps(&folder), [35, 30]);
    }

    #[test]
    fn a_broken_newest_falls_back_to_the_one_before() {
        let dir = tempfile::tempdir().unwrap();
        write(dir.path(), 10);
        write(dir.path(), 20);
        let newest = dir.path().join("step-000000020.checkpoint");
        let whole = fs::read(&newest).unwrap();
        let mut broken: Vec<Vec<u8>> = (0..whole.len()).map(|n| whole[..n].to_vec()).collect();
        broken.extend((0..whole.len()).map(|n| {
            let mut flipped = whole.clone();
            flipped[n] ^= 0x10;
            flipped
        }));
        for bytes in broken {
            fs::write(&newest, &bytes).unwrap();
            let checkpoint = Checkpoint::latest(dir.path()).unwrap().unwrap();
            assert_eq!((checkpoint.step(), checkpoint.notes().len()), (10, 1));
            assert!(
                checkpoint.notes()[0].ends_with("going on from step 10 instead"),
                "{:?}",
                checkpoint.notes()
            );
            assert_eq!(checkpoint.state::<u64>("n").unwrap(), 10);
        }
        fs::write(dir.path().join("step-000000010.checkpoint"), b"nonsense").unwrap();
        let error = Checkpoint::latest(dir.path()).unwrap_err().to_string();
        assert!(error.contains("found only broken ones"), "{error}");
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let device = Device::default().autodiff();
        let mut optimiser = AdamConfig::new().init();
        let trained = train(net(5, &device), &mut optimiser, 0..1, &device);
        CheckpointWriter::new(1)
            .module("net", &trained)
            .and_then(|w| w.optimiser("net", &optimiser))
            .and_then(|w| w.write(dir.path()))
            .unwrap();
        let checkpoint = Checkpoint::latest(dir.path()).unwrap().unwrap();
        let error = checkpoint.module("net", net(6, &device)).unwrap_err().to_string();
        assert!(error.contains("network net: expected the parameters of this network"), "{error}");
        let error = checkpoint.module("other", net(5, &device)).unwrap_err().to_string();
        assert!(error.contains("network other: expected a section of this name, found none"), "{error}");
        assert!(checkpoint.optimiser("net", SgdConfig::new().init()).is_err());
        assert!(checkpoint.state::<u64>("n").is_err());
    }
}
