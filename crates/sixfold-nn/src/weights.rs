//! Weight files: a network's tensors and its model card in one safetensors file.
//!
//! Tensors of two or more dimensions are stored as f16, vectors (biases, batch norm) as f32, because a variance may exceed f16's
//! range; so is any tensor with a value above 65504. The [`ModelCard`] is JSON under the key `sixfold_card` of the file's metadata.
//! Names are the fields' names joined with dots, as in `layer1.0.conv1.weight`.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::{self, Read, Write as _};
use std::path::{Path, PathBuf};

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Bool, Int, Tensor, TensorData};
use half::{bf16, f16};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use sixfold_geometry::FrameId;
use sixfold_io::write_atomically_with;

use crate::files::explain;
use crate::parameters::{Changeable, Network, Visitable};

/// Version of the weight file's layout that this version of Sixfold writes and reads.
pub(crate) const FORMAT_VERSION: u32 = 1;

const CARD_KEY: &str = "sixfold_card";
/// The largest header that is read. The largest networks have a few thousand tensors, 100 bytes each.
const MAX_HEADER: u64 = 32 << 20;

/// Information about a set of weights: network, training data, training, and scores.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ModelCard {
    /// Name of the network's architecture. It is checked when loading.
    pub architecture: String,
    /// Version of the file's layout, see `FORMAT_VERSION`. [`save_weights`] fills it in.
    pub format_version: u32,
    /// One line for display.
    pub title: String,
    /// Description of the training data, for display.
    pub data: String,
    /// The frames of a dataset on which it was trained, in order, including those of the trainings that it continues; empty for a
    /// training without any, `None` if unknown. Scores on these frames are meaningless.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub training_frames: Option<Vec<FrameId>>,
    /// Training steps done.
    pub steps: u64,
    /// Seed of the training.
    pub seed: u64,
    /// Command that repeats the training.
    pub command: String,
    /// Its objects, in a form defined by the method.
    pub objects: Vec<serde_json::Value>,
    /// Measured scores by name.
    pub scores: BTreeMap<String, f64>,
    /// Further data that the method needs to use the weights.
    pub extra: serde_json::Value,
}

impl ModelCard {
    /// A card with a name and a title, everything else empty.
    pub fn new(architecture: &str, title: &str) -> Self {
        ModelCard {
            architecture: architecture.to_owned(),
            format_version: FORMAT_VERSION,
            title: title.to_owned(),
            ..ModelCard::default()
        }
    }

    /// Whether a frame was used in the training of the weights; `None` if the card does not say.
    pub fn was_trained_on(&self, frame: FrameId) -> Option<bool> {
        self.training_frames.as_ref().map(|frames| frames.contains(&frame))
    }
}

/// The training frames for a card: these, and those of the weights that the training continues. `None` if the card of those weights
/// does not say.
///
/// # Errors
/// [`WeightsError`] for a file that is not a weight file.
pub fn training_frames(
    init: Option<&Path>,
    frames: &[FrameId],
) -> Result<Option<Vec<FrameId>>, WeightsError> {
    let before = init.map(read_card).transpose()?.map_or(Some(vec![]), |card| card.training_frames);
    Ok(before.map(|mut all| {
        all.extend_from_slice(frames);
        all.sort_unstable();
        all.dedup();
        all
    }))
}

/// Why weights could not be saved or loaded.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The file could not be read.
    #[error("{}: cannot be read: {}", file.display(), explain(source))]
    Read {
        /// The file.
        file: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The file could not be written. An existing file is unchanged.
    #[error("{}: cannot be written: {}", file.display(), explain(source))]
    Write {
        /// The file.
        file: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The file is not a safetensors file, or it is broken.
    #[error("{}: expected a safetensors file, found {reason}; download or train the weights again", file.display())]
    Broken {
        /// The file.
        file: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The file is a safetensors file, but has no model card.
    #[error("{}: expected a model card under {CARD_KEY} in the metadata, found {found}; give a weight file that Sixfold wrote",
        file.display())]
    Card {
        /// The file.
        file: PathBuf,
        /// What was found instead.
        found: String,
    },
    /// The weights are of another network.
    #[error("{}: expected weights of {expected}, found weights of {found}; give the file that belongs to this network",
        file.display())]
    Architecture {
        /// The file.
        file: PathBuf,
        /// The requested architecture.
        expected: String,
        /// The architecture in the card.
        found: String,
    },
    /// The file was written in another layout.
    #[error("{}: expected format version {FORMAT_VERSION}, found {found}; {}", file.display(),
        if *found > FORMAT_VERSION { "use a newer version of Sixfold" } else { "train or download the weights again" })]
    Version {
        /// The file.
        file: PathBuf,
        /// The card's format version.
        found: u32,
    },
    /// A tensor of the network is not in the file.
    #[error("{}: tensor {tensor}: expected shape {expected:?}, found no tensor of that name; \
        the file is of a differently configured network", file.display())]
    Missing {
        /// The file.
        file: PathBuf,
        /// Name of the tensor.
        tensor: String,
        /// The shape that the network needs.
        expected: Vec<usize>,
    },
    /// A tensor has another shape than the network's.
    #[error("{}: tensor {tensor}: expected shape {expected:?}, found {found:?}; \
        the file is of a differently configured network", file.display())]
    Shape {
        /// The file.
        file: PathBuf,
        /// Name of the tensor.
        tensor: String,
        /// The shape that the network needs.
        expected: Vec<usize>,
        /// The shape in the file.
        found: Vec<usize>,
    },
    /// A tensor is in the file that the network does not have.
    #[error("{}: tensor {tensor}: expected no tensor of that name, found shape {found:?}; \
        the file is of a differently configured network", file.display())]
    Unknown {
        /// The file.
        file: PathBuf,
        /// Name of the tensor.
        tensor: String,
        /// The shape in the file.
        found: Vec<usize>,
    },
    /// A tensor has an unsupported number type.
    #[error("{}: tensor {tensor}: expected {expected}, found {found}", file.display())]
    NumberType {
        /// The file.
        file: PathBuf,
        /// Name of the tensor.
        tensor: String,
        /// Supported number types.
        expected: &'static str,
        /// Number type in the file.
        found: String,
    },
    /// A tensor contains an infinite number or NaN.
    #[error("{}: tensor {tensor}: expected finite numbers, found {found}; the training diverged: go back \
         to an earlier checkpoint or lower the learning rate", file.display())]
    NotFinite {
        /// The file.
        file: PathBuf,
        /// Name of the tensor.
        tensor: String,
        /// The first such number.
        found: f32,
    },
    /// The tensors could not be read from the network.
    #[error("{}: tensor {tensor}: expected numbers, found {reason}", file.display())]
    Tensor {
        /// The file.
        file: PathBuf,
        /// Name of the tensor.
        tensor: String,
        /// The cause.
        reason: String,
    },
}

/// Saves all tensors of `module` and the card as one safetensors file. The same weights and card give the same bytes. The file is
/// written under a temporary name and renamed, so an existing file at `path` stays intact on any error.
///
/// # Errors
/// [`WeightsError::Write`], and [`WeightsError::NotFinite`] for weights that are not usable.
pub fn save_weights<M: Module>(module: &M, card: &ModelCard, path: &Path) -> Result<(), WeightsError> {
    // `valid` applies running statistics that are still pending in other threads.
    save_parameters(&module.valid(), card, path)
}

fn save_parameters(module: &dyn Visitable, card: &ModelCard, path: &Path) -> Result<(), WeightsError> {
    let mut collector = Collector { file: path, path: Vec::new(), tensors: Vec::new(), error: None };
    module.show(&mut collector);
    if let Some(error) = collector.error {
        return Err(error);
    }
    let write_error = |source| WeightsError::Write { file: path.to_owned(), source };
    let invalid = |e: &dyn std::fmt::Display| io::Error::new(io::ErrorKind::InvalidData, e.to_string());
    let card = ModelCard { format_version: FORMAT_VERSION, ..card.clone() };
    let card = serde_json::to_string(&card).map_err(|e| write_error(invalid(&e)))?;
    let mut views = Vec::with_capacity(collector.tensors.len());
    for tensor in &collector.tensors {
        let view = TensorView::new(tensor.dtype, tensor.shape.clone(), &tensor.bytes)
            .map_err(|e| write_error(invalid(&e)))?;
        views.push((tensor.name.as_str(), view));
    }
    let metadata = std::iter::once((CARD_KEY.to_owned(), card)).collect();
    let bytes = safetensors::serialize(views, Some(metadata)).map_err(|e| write_error(invalid(&e)))?;
    write_atomically_with(path, |file| file.write_all(&bytes)).map_err(write_error)
}

/// Loads the tensors of a file written by [`save_weights`] into `module` and returns it with the file's card.
///
/// # Errors
/// [`WeightsError`]: an unreadable or broken file, another architecture or format version, and every tensor that is
/// missing, of another shape, unknown to the network or not finite.
pub fn load_weights<M: Module>(
    module: M,
    path: &Path,
    expected_architecture: &str,
) -> Result<(M, ModelCard), WeightsError> {
    // The card is read first: it is small, and gives the best error for a file of another kind.
    load_weights_but(module, path, expected_architecture, None)
}

/// [`load_weights`] from a file that may lack all tensors whose names begin with `without`: these keep their values. For a training
/// that continues from the weights of a network without this part.
///
/// # Errors
/// As [`load_weights`].
pub fn load_weights_but<M: Module>(
    module: M,
    path: &Path,
    expected_architecture: &str,
    without: Option<&str>,
) -> Result<(M, ModelCard), WeightsError> {
    read_card(path)?;
    let bytes = sixfold_io::read_regular(path, sixfold_io::limits::WEIGHTS)
        .map_err(|source| WeightsError::Read { file: path.to_owned(), source })?;
    load(module, path, &bytes, expected_architecture, without)
}

/// [`load_weights`] from the content of a file, for shipped weights; `path` names them in errors.
///
/// # Errors
/// As [`load_weights`].
pub fn load_weights_from_bytes<M: Module>(
    module: M,
    path: &Path,
    bytes: &[u8],
    expected_architecture: &str,
) -> Result<(M, ModelCard), WeightsError> {
    load(module, path, bytes, expected_architecture, None)
}

fn load<M: Module>(
    module: M,
    path: &Path,
    bytes: &[u8],
    expected_architecture: &str,
    without: Option<&str>,
) -> Result<(M, ModelCard), WeightsError> {
    // Running statistics still pending in other threads would later replace the loaded ones.
    drop(module.valid());
    let mut module = Network::new(module);
    let card = load_parameters(&mut module, path, bytes, expected_architecture, without)?;
    Ok((module.into_inner(), card))
}

fn load_parameters(
    module: &mut dyn Changeable,
    path: &Path,
    bytes: &[u8],
    expected_architecture: &str,
    without: Option<&str>,
) -> Result<ModelCard, WeightsError> {
    let broken = |reason: String| WeightsError::Broken { file: path.to_owned(), reason };
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| broken(e.to_string()))?;
    let card = header.metadata().as_ref().and_then(|m| m.get(CARD_KEY));
    let card_error = |found: String| WeightsError::Card { file: path.to_owned(), found };
    let card = card.ok_or_else(|| card_error("none".to_owned()))?;
    let card: ModelCard =
        serde_json::from_str(card).map_err(|e| card_error(format!("one that is not readable ({e})")))?;
    if card.format_version != FORMAT_VERSION {
        return Err(WeightsError::Version { file: path.to_owned(), found: card.format_version });
    }
    if card.architecture != expected_architecture {
        return Err(WeightsError::Architecture {
            file: path.to_owned(),
            expected: expected_architecture.to_owned(),
            found: card.architecture,
        });
    }
    let file = SafeTensors::deserialize(bytes).map_err(|e| broken(e.to_string()))?;
    let tensors: BTreeMap<String, TensorView<'_>> = file.tensors().into_iter().collect();
    let without = without.filter(|part| !tensors.keys().any(|name| name.starts_with(part)));
    let mut filler = Filler { file: path, path: Vec::new(), tensors, without, error: None };
    module.change(&mut filler);
    if let Some(error) = filler.error {
        return Err(error);
    }
    if let Some((tensor, view)) = filler.tensors.into_iter().next() {
        return Err(WeightsError::Unknown { file: path.to_owned(), tensor, found: view.shape().to_vec() });
    }
    Ok(card)
}

/// Reads only the card of a weight file.
///
/// # Errors
/// [`WeightsError::Read`], [`WeightsError::Broken`] and [`WeightsError::Card`].
pub fn read_card(path: &Path) -> Result<ModelCard, WeightsError> {
    #[derive(Deserialize)]
    struct Header {
        #[serde(rename = "__metadata__", default)]
        metadata: BTreeMap<String, String>,
    }
    let read_error = |source| WeightsError::Read { file: path.to_owned(), source };
    let broken = |reason: String| WeightsError::Broken { file: path.to_owned(), reason };
    let mut file = sixfold_io::open_regular(path, sixfold_io::limits::WEIGHTS).map_err(read_error)?;
    let size = file.metadata().map_err(read_error)?.len();
    if size < 8 {
        return Err(broken(format!("a file of {size} bytes")));
    }
    let mut length = [0u8; 8];
    file.read_exact(&mut length).map_err(read_error)?;
    let length = u64::from_le_bytes(length);
    if length > MAX_HEADER.min(size - 8) {
        return Err(broken(format!("a header length of {length} bytes in a file of {size} bytes")));
    }
    let mut header = vec![0u8; length as usize];
    file.read_exact(&mut header).map_err(read_error)?;
    let header: Header = serde_json::from_slice(&header)
        .map_err(|e| broken(format!("a header that is not readable ({e})")))?;
    let card_error = |found: String| WeightsError::Card { file: path.to_owned(), found };
    let card = header.metadata.get(CARD_KEY).ok_or_else(|| card_error("none".to_owned()))?;
    serde_json::from_str(card).map_err(|e| card_error(format!("one that is not readable ({e})")))
}

/// Writes a card as a markdown file, usually next to the weights.
///
/// # Errors
/// [`WeightsError::Write`].
pub fn write_card_markdown(card: &ModelCard, path: &Path) -> Result<(), WeightsError> {
    write_atomically_with(path, |file| file.write_all(card_markdown(card).as_bytes()))
        .map_err(|source| WeightsError::Write { file: path.to_owned(), source })
}

fn card_markdown(card: &ModelCard) -> String {
    let mut text = String::new();
    let title = if card.title.is_empty() { &card.architecture } else { &card.title };
    let _ = writeln!(text, "# {title}\n");
    let frames = card.training_frames.iter().flatten().map(FrameId::to_string).collect::<Vec<_>>();
    let rows = [
        ("Architecture", card.architecture.clone()),
        ("Trained on", card.data.clone()),
        ("Training frames", frames.join(" ")),
        ("Steps", card.steps.to_string()),
        ("Seed", card.seed.to_string()),
        ("Format version", card.format_version.to_string()),
    ];
    for (name, value) in rows.iter().filter(|(_, value)| !value.is_empty()) {
        let _ = writeln!(text, "- {name}: {value}");
    }
    if !card.command.is_empty() {
        let _ = writeln!(text, "\nTrained with:\n\n```\n{}\n```", card.command);
    }
    if !card.scores.is_empty() {
        let _ = writeln!(text, "\n## Scores\n\n| score | value |\n|---|---|");
        for (name, value) in &card.scores {
            let _ = writeln!(text, "| {} | {value:.4} |", name.replace('|', "\\|"));
        }
    }
    if !card.objects.is_empty() {
        let _ = writeln!(text, "\n## Objects\n");
        for object in &card.objects {
            match object {
                serde_json::Value::String(name) => {
                    let _ = writeln!(text, "- {name}");
                }
                other => {
                    let _ = writeln!(text, "- `{other}`");
                }
            }
        }
    }
    if !card.extra.is_null() {
        let extra = serde_json::to_string_pretty(&card.extra).unwrap_or_default();
        let _ = writeln!(text, "\n## Settings\n\n```json\n{extra}\n```");
    }
    text
}

struct NamedTensor {
    name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

/// Collects every tensor of a module as bytes.
struct Collector<'a> {
    file: &'a Path,
    path: Vec<String>,
    tensors: Vec<NamedTensor>,
    error: Option<WeightsError>,
}

impl Collector<'_> {
    fn push(&mut self, dtype: Dtype, shape: Vec<usize>, bytes: Vec<u8>) {
        self.tensors.push(NamedTensor { name: self.path.join("."), dtype, shape, bytes });
    }

    fn fail(&mut self, reason: &dyn std::fmt::Display) {
        let tensor = self.path.join(".");
        let error = WeightsError::Tensor { file: self.file.to_owned(), tensor, reason: reason.to_string() };
        self.error.get_or_insert(error);
    }
}

impl ModuleVisitor for Collector<'_> {
    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let tensor = param.transform_for_save().val();
        let shape = tensor.dims().to_vec();
        let values = match tensor.try_into_vec_as::<f32>() {
            Ok(values) => values,
            Err(e) => return self.fail(&e),
        };
        if let Some(found) = values.iter().copied().find(|v| !v.is_finite()) {
            let tensor = self.path.join(".");
            let error = WeightsError::NotFinite { file: self.file.to_owned(), tensor, found };
            self.error.get_or_insert(error);
            return;
        }
        let half = D >= 2 && values.iter().all(|v| v.abs() <= f16::MAX.to_f32());
        if half {
            let bytes = values.iter().flat_map(|v| f16::from_f32(*v).to_le_bytes()).collect();
            self.push(Dtype::F16, shape, bytes);
        } else {
            let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            self.push(Dtype::F32, shape, bytes);
        }
    }

    fn visit_int<const D: usize>(&mut self, param: &Param<Tensor<D, Int>>) {
        let tensor = param.transform_for_save().val();
        let shape = tensor.dims().to_vec();
        match tensor.try_into_vec_as::<i64>() {
            Ok(values) => self.push(Dtype::I64, shape, values.iter().flat_map(|v| v.to_le_bytes()).collect()),
            Err(e) => self.fail(&e),
        }
    }

    fn visit_bool<const D: usize>(&mut self, param: &Param<Tensor<D, Bool>>) {
        let tensor = param.transform_for_save().val();
        let shape = tensor.dims().to_vec();
        match tensor.try_into_vec_as::<bool>() {
            Ok(values) => self.push(Dtype::BOOL, shape, values.iter().map(|v| u8::from(*v)).collect()),
            Err(e) => self.fail(&e),
        }
    }
}

/// Puts tensors into a module by their names, each once. The first error stops it.
struct Filler<'a> {
    file: &'a Path,
    path: Vec<String>,
    tensors: BTreeMap<String, TensorView<'a>>,
    /// Tensors whose names begin with this keep their values.
    without: Option<&'a str>,
    error: Option<WeightsError>,
}

impl<'a> Filler<'a> {
    /// The tensor with the current name if its shape fits; otherwise `None`, and the error is kept.
    fn take(&mut self, expected: &[usize]) -> Option<TensorView<'a>> {
        if self.error.is_some() {
            return None;
        }
        let (file, tensor, expected) = (self.file.to_owned(), self.path.join("."), expected.to_vec());
        match self.tensors.remove(&tensor) {
            None if self.without.is_some_and(|part| tensor.starts_with(part)) => {}
            None => self.error = Some(WeightsError::Missing { file, tensor, expected }),
            Some(view) if view.shape() != expected => {
                let found = view.shape().to_vec();
                self.error = Some(WeightsError::Shape { file, tensor, expected, found });
            }
            Some(view) => return Some(view),
        }
        None
    }

    fn wrong_type(&mut self, expected: &'static str, found: Dtype) {
        let (file, tensor, found) = (self.file.to_owned(), self.path.join("."), format!("{found:?}"));
        self.error = Some(WeightsError::NumberType { file, tensor, expected, found });
    }

    fn floats(&mut self, view: &TensorView<'_>) -> Option<Vec<f32>> {
        let values = match view.dtype() {
            Dtype::F16 => numbers(view.data(), |b| f16::from_le_bytes(b).to_f32()),
            Dtype::BF16 => numbers(view.data(), |b| bf16::from_le_bytes(b).to_f32()),
            Dtype::F32 => numbers(view.data(), f32::from_le_bytes),
            Dtype::F64 => numbers(view.data(), |b| f64::from_le_bytes(b) as f32),
            other => {
                self.wrong_type("F16, BF16, F32 or F64", other);
                return None;
            }
        };
        if let Some(found) = values.iter().copied().find(|v| !v.is_finite()) {
            let (file, tensor) = (self.file.to_owned(), self.path.join("."));
            self.error = Some(WeightsError::NotFinite { file, tensor, found });
            return None;
        }
        Some(values)
    }
}

impl ModuleMapper for Filler<'_> {
    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let shape = param.lazy_shape();
        let Some(view) = self.take(&shape) else { return param };
        let Some(values) = self.floats(&view) else { return param };
        let (device, id) = (param.lazy_device(), param.id);
        param.transform_for_load(Tensor::from_data(TensorData::new(values, shape), &device), id)
    }

    fn map_int<const D: usize>(&mut self, param: Param<Tensor<D, Int>>) -> Param<Tensor<D, Int>> {
        let shape = param.lazy_shape();
        let Some(view) = self.take(&shape) else { return param };
        if view.dtype() != Dtype::I64 {
            self.wrong_type("I64", view.dtype());
            return param;
        }
        let values = numbers(view.data(), i64::from_le_bytes);
        let (device, id) = (param.lazy_device(), param.id);
        param.transform_for_load(Tensor::from_data(TensorData::new(values, shape), &device), id)
    }

    fn map_bool<const D: usize>(&mut self, param: Param<Tensor<D, Bool>>) -> Param<Tensor<D, Bool>> {
        let shape = param.lazy_shape();
        let Some(view) = self.take(&shape) else { return param };
        if view.dtype() != Dtype::BOOL {
            self.wrong_type("BOOL", view.dtype());
            return param;
        }
        let values: Vec<bool> = view.data().iter().map(|b| *b != 0).collect();
        let (device, id) = (param.lazy_device(), param.id);
        param.transform_for_load(Tensor::from_data(TensorData::new(values, shape), &device), id)
    }
}

fn numbers<const N: usize, T>(bytes: &[u8], from: impl Fn([u8; N]) -> T) -> Vec<T> {
    bytes.as_chunks::<N>().0.iter().map(|chunk| from(*chunk)).collect()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use burn::nn::conv::{Conv2d, Conv2dConfig};
    use burn::nn::{BatchNorm, BatchNormConfig, Linear, LinearConfig};
    use burn::tensor::{Device, Distribution};

    #[derive(Module, Debug)]
    struct Net {
        conv: Conv2d,
        norm: BatchNorm,
        heads: Vec<Linear>,
    }

    fn net(width: usize, device: &Device) -> Net {
        Net {
            conv: Conv2dConfig::new([3, width], [3, 3]).init(device),
            norm: BatchNormConfig::new(width).init(device),
            heads: vec![LinearConfig::new(width, 2).init(device), LinearConfig::new(width, 5).init(device)],
        }
    }

    fn forward(net: &Net, x: Tensor<4>) -> Vec<f32> {
        let x = net.norm.forward(net.conv.forward(x)).mean_dim(3).mean_dim(2);
        let [n, c, _, _] = x.dims();
        net.heads[1].forward(x.reshape([n, c])).try_into_vec_as().unwrap()
    }

    fn card() -> ModelCard {
        let mut card = ModelCard::new("test-net", "A network | for tests");
        card.steps = 7;
        card.scores.insert("AR".to_owned(), 0.5);
        card.objects.push("drill".into());
        card.training_frames = Some(vec![FrameId::new(2, 36), FrameId::new(2, 79)]);
        card.extra = serde_json::json!({"crop": 128});
        card
    }

    #[test]
    fn saved_weights_are_loaded() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("net.safetensors");
        let device = Device::default();
        let original = net(4, &device.clone().autodiff());
        // Running statistics different from their initial values, with the last update still pending.
        let x = Tensor::<4>::random([2, 3, 8, 8], Distribution::Normal(3.0, 2.0), &device.clone().autodiff());
        forward(&original, x.clone());
        save_weights(&original, &card(), &path).unwrap();
        let (loaded, read) = load_weights(net(4, &device), &path, "test-net").unwrap();
        assert_eq!(read, card());
        let x = Tensor::from_data(x.to_data(), &device);
        let (a, b) = (forward(&original.valid(), x.clone()), forward(&loaded, x));
        for (a, b) in a.iter().zip(&b) {
            assert!((a - b).abs() < 2e-3, "f16 rounding only: {a} against {b}");
        }
        let mean: Vec<f32> = loaded.norm.running_mean.value().try_into_vec_as().unwrap();
        assert!(mean.iter().any(|v| *v != 0.0), "the last update of the running mean is in the file");
        // Bytes do not depend on the run, and loaded weights are saved as the same bytes.
        let again = dir.path().join("again.safetensors");
        save_weights(&loaded, &card(), &again).unwrap();
        assert_eq!(fs::read(&path).unwrap(), fs::read(&again).unwrap());
    }

    #[test]
    fn a_continued_training_records_the_frames_of_the_previous_one() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("net.safetensors");
        let device = Device::default();
        save_weights(&net(4, &device), &card(), &path).unwrap();
        let [old, new, other] = [36, 40, 41].map(|im_id| FrameId::new(2, im_id));
        let frames = training_frames(Some(&path), &[new, old]).unwrap();
        let card = ModelCard { training_frames: frames, ..card() };
        assert_eq!(card.training_frames.as_ref().map(Vec::len), Some(3));
        assert_eq!([old, new, other].map(|f| card.was_trained_on(f)), [Some(true), Some(true), Some(false)]);
        assert_eq!(training_frames(None, &[]).unwrap(), Some(vec![]));
        // A card without this information leaves it open, and is written as before.
        let silent = ModelCard::new("test-net", "");
        assert_eq!(silent.was_trained_on(old), None);
        assert!(!serde_json::to_string(&silent).unwrap().contains("training_frames"));
        save_weights(&net(4, &device), &silent, &path).unwrap();
        assert_eq!(training_frames(Some(&path), &[new]).unwrap(), None);
    }

    #[test]
    fn values_outside_f16_are_kept() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("net.safetensors");
        let device = Device::default();
        let mut original = net(4, &device);
        let large = vec![1e6f32; 2 * 4];
        original.heads[0].weight =
            Param::from_tensor(Tensor::from_data(TensorData::new(large.clone(), [4, 2]), &device));
        save_weights(&original, &card(), &path).unwrap();
        let (loaded, _) = load_weights(net(4, &device), &path, "test-net").unwrap();
        assert_eq!(loaded.heads[0].weight.val().try_into_vec_as::<f32>().unwrap(), large);
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("net.safetensors");
        let device = Device::default();
        save_weights(&net(4, &device), &card(), &path).unwrap();

        let message = |e: WeightsError| e.to_string();
        let error = message(load_weights(net(4, &device), &path, "other").unwrap_err());
        assert!(
            error.contains("net.safetensors: expected weights of other, found weights of test-net"),
            "{error}"
        );

        let error = message(load_weights(net(5, &device), &path, "test-net").unwrap_err());
        assert!(
            error.contains("tensor conv.weight: expected shape [5, 3, 3, 3], found [4, 3, 3, 3]"),
            "{error}"
        );

        let mut more = net(4, &device);
        more.heads.push(LinearConfig::new(4, 1).init(&device));
        let error = message(load_weights(more, &path, "test-net").unwrap_err());
        assert!(error.contains("tensor heads.2.weight: expected shape [4, 1], found no tensor"), "{error}");

        // A part that the file lacks altogether may keep its values if it is named; not a tensor of a part that the file has.
        let mut more = net(4, &device);
        more.heads.push(LinearConfig::new(4, 1).init(&device));
        let kept: Vec<f32> = more.heads[2].weight.val().try_into_vec_as().unwrap();
        let (loaded, _) = load_weights_but(more.clone(), &path, "test-net", Some("heads.2")).unwrap();
        assert_eq!(loaded.heads[2].weight.val().try_into_vec_as::<f32>().unwrap(), kept);
        for part in ["heads", "conv"] {
            let error = message(load_weights_but(more.clone(), &path, "test-net", Some(part)).unwrap_err());
            assert!(
                error.contains("tensor heads.2.weight: expected shape [4, 1], found no tensor"),
                "{part}: {error}"
            );
        }

        let mut less = net(4, &device);
        less.heads.pop();
        let error = message(load_weights(less, &path, "test-net").unwrap_err());
        assert!(error.contains("tensor heads.1.bias: expected no tensor of that name"), "{error}");
    }

    #[test]
    fn broken_files_are_errors_and_not_panics() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("net.safetensors");
        let device = Device::default();
        save_weights(&net(4, &device), &card(), &path).unwrap();
        let whole = fs::read(&path).unwrap();
        for length in (0..whole.len()).step_by(37).chain([1, 7, 8, 9, whole.len() - 1]) {
            fs::write(&path, &whole[..length]).unwrap();
            let error = load_weights(net(4, &device), &path, "test-net").unwrap_err();
            assert!(matches!(error, WeightsError::Broken { .. }), "{length} bytes: {error}");
        }
        let mut huge = whole.clone();
        huge[..8].copy_from_slice(&u64::MAX.to_le_bytes());
        fs::write(&path, &huge).unwrap();
        assert!(matches!(read_card(&path).unwrap_err(), WeightsError::Broken { .. }));
        let error = read_card(&dir.path().join("none")).unwrap_err().to_string();
        assert!(error.contains("none: cannot be read") && error.contains("check the path"), "{error}");

        let key = b"\\\"format_version\\\":";
        let version = whole.windows(key.len()).position(|w| w == key).unwrap() + key.len();
        let mut bytes = whole.clone();
        bytes[version] = b'9';
        fs::write(&path, &bytes).unwrap();
        let error = load_weights(net(4, &device), &path, "test-net").unwrap_err().to_string();
        assert!(error.contains("expected format version 1, found 9; use a newer version"), "{error}");
    }

    #[test]
    fn weights_that_are_not_finite_are_refused_and_the_old_file_stays() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("net.safetensors");
        let device = Device::default();
        let mut bad = net(4, &device);
        save_weights(&bad, &card(), &path).unwrap();
        let before = fs::read(&path).unwrap();
        bad.heads[1].bias = Some(Param::from_data([0.0, 0.0, f32::NAN, 0.0, 0.0], &device));
        let error = save_weights(&bad, &card(), &path).unwrap_err().to_string();
        assert!(error.contains("tensor heads.1.bias: expected finite numbers, found NaN"), "{error}");
        assert_eq!(fs::read(&path).unwrap(), before);
        let error = save_weights(&bad.valid(), &card(), &dir.path().join("no/folder")).unwrap_err();
        assert!(matches!(error, WeightsError::NotFinite { .. }));
        let error = save_weights(&net(4, &device), &card(), &dir.path().join("no/folder")).unwrap_err();
        assert!(matches!(error, WeightsError::Write { .. }));
    }

    #[test]
    fn the_readable_card_holds_all_fields() {
        let text = card_markdown(&card());
        for part in [
            "# A network | for tests",
            "- Architecture: test-net",
            "- Training frames: 2/36 2/79",
            "| AR | 0.5000 |",
            "- drill",
            "\"crop\": 128",
        ] {
            assert!(text.contains(part), "{part} is missing in\n{text}");
        }
    }
}
