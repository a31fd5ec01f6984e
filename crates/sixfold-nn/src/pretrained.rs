//! Weights trained by others: PyTorch's `.pth` files and `.safetensors` files with PyTorch's names.
//!
//! A network whose tensors have the names of the PyTorch model reads them one by one; names may differ by a mapping that the
//! network defines. Everything must match: a file of another network is refused with the first tensor that does not match.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use burn::module::{Module, ModuleMapper, Param};
use burn::tensor::{Tensor, TensorData};
use half::{bf16, f16};
use pytorch_reader::{DType, PytorchReader};
use safetensors::tensor::{Dtype, SafeTensors};

use crate::files::explain;
use crate::parameters::{Changeable, Network};

/// Prefixes that training scripts add to the names: data-parallel wrappers and dictionaries around the state.
const PREFIXES: [&str; 7] =
    ["", "module.", "state_dict.", "state_dict.module.", "model.", "model_state_dict.", "model.module."];

/// Why the weights could not be used.
#[derive(Debug, thiserror::Error)]
pub enum PretrainedError {
    /// The file could not be read.
    #[error("{}: cannot be read: {}", file.display(), explain(source))]
    Read {
        /// The file.
        file: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The file's content does not match its ending.
    #[error("{}: expected {expected}, found {reason}; download it again", file.display())]
    Broken {
        /// The file.
        file: PathBuf,
        /// The format according to the ending.
        expected: &'static str,
        /// What is wrong.
        reason: String,
    },
    /// The ending is unknown.
    #[error("{}: expected a file that ends in .pth, .pt or .safetensors, found ending {found:?}", file.display())]
    Ending {
        /// The file.
        file: PathBuf,
        /// Its ending.
        found: String,
    },
    /// A tensor of the network is not in the file.
    #[error("{}: tensor {tensor}: expected shape {expected:?}, found no tensor of that name; \
        give the weights of {network}", file.display())]
    Missing {
        /// The file.
        file: PathBuf,
        /// PyTorch's name of the tensor.
        tensor: String,
        /// The shape that the network needs.
        expected: Vec<usize>,
        /// The network.
        network: String,
    },
    /// A tensor has another shape than the network's.
    #[error("{}: tensor {tensor}: expected shape {expected:?}, found {found:?}; give the weights of {network}",
        file.display())]
    Shape {
        /// The file.
        file: PathBuf,
        /// PyTorch's name of the tensor.
        tensor: String,
        /// The shape that the network needs.
        expected: Vec<usize>,
        /// The shape in the file.
        found: Vec<usize>,
        /// The network.
        network: String,
    },
    /// A tensor is in the file that the network does not have.
    #[error("{}: tensor {tensor}: expected no tensor of that name, found shape {found:?}; give the weights of {network}",
        file.display())]
    Unknown {
        /// The file.
        file: PathBuf,
        /// Its name in the file.
        tensor: String,
        /// The shape in the file.
        found: Vec<usize>,
        /// The network.
        network: String,
    },
    /// A tensor's numbers cannot be used.
    #[error("{}: tensor {tensor}: expected finite floating-point numbers, found {found}; download the file again",
        file.display())]
    Numbers {
        /// The file.
        file: PathBuf,
        /// Its name in the file.
        tensor: String,
        /// The content found.
        found: String,
    },
}

/// Location of a tensor's numbers.
enum Source {
    PyTorch(pytorch_reader::Tensor),
    /// Number type, and first and last byte in the file's content.
    Safetensors(Dtype, std::ops::Range<usize>),
}

struct Entry {
    shape: Vec<usize>,
    source: Source,
}

/// An open weight file: names and shapes are in memory, numbers are read on request.
pub struct PretrainedFile {
    path: PathBuf,
    entries: BTreeMap<String, Entry>,
    /// The whole content of a safetensors file, otherwise empty.
    content: Vec<u8>,
}

impl PretrainedFile {
    /// Opens a `.pth`, `.pt` or `.safetensors` file.
    ///
    /// # Errors
    /// [`PretrainedError::Read`], [`PretrainedError::Broken`] and [`PretrainedError::Ending`].
    pub fn open(path: &Path) -> Result<Self, PretrainedError> {
        let file = path.to_owned();
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        match ending.as_str() {
            "safetensors" => Self::open_safetensors(file),
            "pth" | "pt" => Self::open_pytorch(file),
            _ => Err(PretrainedError::Ending { file, found: ending }),
        }
    }

    fn open_pytorch(path: PathBuf) -> Result<Self, PretrainedError> {
        if let Err(source) = fs::File::open(&path) {
            return Err(PretrainedError::Read { file: path, source });
        }
        let reader = PytorchReader::new(&path).map_err(|e| PretrainedError::Broken {
            file: path.clone(),
            expected: "a PyTorch weight file",
            reason: e.to_string(),
        })?;
        let entries = reader
            .into_tensors()
            .into_iter()
            .map(|(name, t)| (name, Entry { shape: t.shape().to_vec(), source: Source::PyTorch(t) }))
            .collect();
        Ok(PretrainedFile { path, entries, content: Vec::new() })
    }

    fn open_safetensors(path: PathBuf) -> Result<Self, PretrainedError> {
        let content = match fs::read(&path) {
            Ok(content) => content,
            Err(source) => return Err(PretrainedError::Read { file: path, source }),
        };
        let broken = |e: safetensors::SafeTensorError| PretrainedError::Broken {
            file: path.clone(),
            expected: "a safetensors file",
            reason: e.to_string(),
        };
        let (header, metadata) = SafeTensors::read_metadata(&content).map_err(broken)?;
        let start = 8 + header;
        let entries = metadata
            .tensors()
            .into_iter()
            .map(|(name, info)| {
                let (first, last) = info.data_offsets;
                let source = Source::Safetensors(info.dtype, start + first..start + last);
                (name, Entry { shape: info.shape.clone(), source })
            })
            .collect();
        Ok(PretrainedFile { path, entries, content })
    }

    /// Name and shape of every tensor, in the names' order.
    pub fn tensors(&self) -> impl Iterator<Item = (&str, &[usize])> {
        self.entries.iter().map(|(name, entry)| (name.as_str(), entry.shape.as_slice()))
    }

    /// The numbers of one tensor; `network` is used in messages.
    ///
    /// # Errors
    /// [`PretrainedError`] if it is missing, has another shape or has numbers that are not finite.
    pub fn tensor(&self, name: &str, shape: &[usize], network: &str) -> Result<Vec<f32>, PretrainedError> {
        let (file, tensor, expected) = (self.path.clone(), name.to_owned(), shape.to_vec());
        let network = network.to_owned();
        let Some(entry) = self.entries.get(name) else {
            return Err(PretrainedError::Missing { file, tensor, expected, network });
        };
        if entry.shape != shape {
            let found = entry.shape.clone();
            return Err(PretrainedError::Shape { file, tensor, expected, found, network });
        }
        self.numbers(name, entry)
    }

    fn numbers(&self, name: &str, entry: &Entry) -> Result<Vec<f32>, PretrainedError> {
        let unusable = |found: String| PretrainedError::Numbers {
            file: self.path.clone(),
            tensor: name.to_owned(),
            found,
        };
        let values = match &entry.source {
            Source::PyTorch(tensor) => {
                let bytes = tensor.read().map_err(|e| unusable(e.to_string()))?;
                match tensor.dtype() {
                    DType::F32 => decode(&bytes, f32::from_ne_bytes),
                    DType::F64 => decode(&bytes, |b| f64::from_ne_bytes(b) as f32),
                    DType::F16 => decode(&bytes, |b| f16::from_ne_bytes(b).to_f32()),
                    DType::BF16 => decode(&bytes, |b| bf16::from_ne_bytes(b).to_f32()),
                    other => return Err(unusable(format!("{other:?}"))),
                }
            }
            Source::Safetensors(dtype, range) => {
                let bytes = self.content.get(range.clone());
                let bytes = bytes.ok_or_else(|| unusable("the end of the file".to_owned()))?;
                match dtype {
                    Dtype::F32 => decode(bytes, f32::from_le_bytes),
                    Dtype::F64 => decode(bytes, |b| f64::from_le_bytes(b) as f32),
                    Dtype::F16 => decode(bytes, |b| f16::from_le_bytes(b).to_f32()),
                    Dtype::BF16 => decode(bytes, |b| bf16::from_le_bytes(b).to_f32()),
                    other => return Err(unusable(format!("{other:?}"))),
                }
            }
        };
        let expected: usize = entry.shape.iter().product();
        if values.len() != expected {
            return Err(unusable(format!("{} numbers instead of {expected}", values.len())));
        }
        match values.iter().find(|v| !v.is_finite()) {
            Some(value) => Err(unusable(value.to_string())),
            None => Ok(values),
        }
    }
}

fn decode<const N: usize>(bytes: &[u8], from: impl Fn([u8; N]) -> f32) -> Vec<f32> {
    bytes.as_chunks::<N>().0.iter().map(|b| from(*b)).collect()
}

/// Mapping of a network's names to those of a file.
pub struct Naming<'a> {
    /// Description of the network, for errors.
    pub network: &'a str,
    /// PyTorch's names of a tensor, the usual one first, from the module's fields' names joined with dots.
    pub names: &'a dyn Fn(&str) -> Vec<String>,
    /// Which of the file's tensors (without prefix) may be unused.
    pub unused: &'a dyn Fn(&str) -> bool,
}

/// Loads the tensors of a file into a module. Weights of Burn's `Linear` are transposed, PyTorch's batch counters are ignored.
///
/// # Errors
/// [`PretrainedError`] with the first tensor that is missing, of another shape, unknown or not finite.
pub fn fill<M: Module>(module: M, file: &PretrainedFile, naming: &Naming<'_>) -> Result<M, PretrainedError> {
    // Running statistics still pending in other threads would later replace the loaded ones.
    drop(module.valid());
    let mut module = Network::new(module);
    fill_parameters(&mut module, file, naming)?;
    Ok(module.into_inner())
}

fn fill_parameters(
    module: &mut dyn Changeable,
    file: &PretrainedFile,
    naming: &Naming<'_>,
) -> Result<(), PretrainedError> {
    let mut filler = Filler {
        file,
        naming,
        prefix: None,
        path: Vec::new(),
        containers: Vec::new(),
        used: BTreeSet::new(),
        error: None,
    };
    module.change(&mut filler);
    if let Some(error) = filler.error {
        return Err(error);
    }
    let prefix = filler.prefix.unwrap_or("");
    for (name, entry) in file.entries.iter().filter(|(name, _)| !filler.used.contains(name.as_str())) {
        let bare = name.strip_prefix(prefix).unwrap_or(name);
        if !(bare.ends_with("num_batches_tracked") || (naming.unused)(bare)) {
            return Err(PretrainedError::Unknown {
                file: file.path.clone(),
                tensor: name.clone(),
                found: entry.shape.clone(),
                network: naming.network.to_owned(),
            });
        }
    }
    Ok(())
}

struct Filler<'a> {
    file: &'a PretrainedFile,
    naming: &'a Naming<'a>,
    /// Determined with the first tensor.
    prefix: Option<&'static str>,
    path: Vec<String>,
    containers: Vec<String>,
    used: BTreeSet<&'a str>,
    error: Option<PretrainedError>,
}

impl Filler<'_> {
    /// The file's numbers for the current tensor, whose shape in the network is `shape`.
    fn take(&mut self, shape: &[usize]) -> Result<Vec<f32>, PretrainedError> {
        let transposed = shape.len() == 2 && self.containers.last().is_some_and(|c| c == "Struct:Linear");
        let expected: Vec<usize> =
            if transposed { shape.iter().rev().copied().collect() } else { shape.to_vec() };
        let names = (self.naming.names)(&self.path.join("."));
        let known = self.prefix.as_slice();
        let prefixes = if known.is_empty() { &PREFIXES } else { known };
        let found = prefixes.iter().find_map(|prefix| {
            let entry = |name: &String| self.file.entries.get_key_value(&format!("{prefix}{name}"));
            names.iter().find_map(entry).map(|found| (*prefix, found))
        });
        let network = self.naming.network.to_owned();
        let path = self.file.path.clone();
        let Some((prefix, (name, entry))) = found else {
            let tensor = names.into_iter().next().unwrap_or_default();
            return Err(PretrainedError::Missing { file: path, tensor, expected, network });
        };
        self.prefix = Some(prefix);
        self.used.insert(name);
        if entry.shape != expected {
            let (tensor, found) = (name.clone(), entry.shape.clone());
            return Err(PretrainedError::Shape { file: path, tensor, expected, found, network });
        }
        let values = self.file.numbers(name, entry)?;
        if let [rows, columns] = shape
            && transposed
        {
            return Ok((0..rows * columns).map(|i| values[i % columns * rows + i / columns]).collect());
        }
        Ok(values)
    }
}

impl ModuleMapper for Filler<'_> {
    fn enter_module(&mut self, name: &str, container_type: &str) {
        self.path.push(name.to_owned());
        self.containers.push(container_type.to_owned());
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
        self.containers.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        if self.error.is_some() {
            return param;
        }
        let shape = param.lazy_shape();
        match self.take(&shape) {
            Ok(values) => {
                let (device, id) = (param.lazy_device(), param.id);
                param.transform_for_load(Tensor::from_data(TensorData::new(values, shape), &device), id)
            }
            Err(error) => {
                self.error = Some(error);
                param
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::batch_norm::{BatchNorm, BatchNormConfig};
    use crate::conv_norm::{BareConv, BareConvConfig};
    use burn::nn::{Linear, LinearConfig};
    use burn::tensor::Device;
    use rand::SeedableRng;
    use safetensors::tensor::TensorView;

    #[derive(Module, Debug)]
    struct Net {
        conv: BareConv,
        norm: BatchNorm,
        fc: Linear,
    }

    fn net(device: &Device) -> Net {
        Net {
            conv: BareConvConfig::new([2, 4], 3).init(&mut rand_chacha::ChaCha8Rng::seed_from_u64(1), device),
            norm: BatchNormConfig::new(4).init(device),
            fc: LinearConfig::new(4, 3).init(device),
        }
    }

    type Numbered = (String, Vec<usize>, Vec<f32>);

    /// The network's tensors with PyTorch's names and layout.
    fn tensors() -> Vec<Numbered> {
        let shapes = [
            ("conv.weight", vec![4, 2, 3, 3]),
            ("norm.weight", vec![4]),
            ("norm.bias", vec![4]),
            ("norm.running_mean", vec![4]),
            ("norm.running_var", vec![4]),
            ("norm.num_batches_tracked", vec![]),
            ("fc.weight", vec![3, 4]),
            ("fc.bias", vec![3]),
        ];
        shapes
            .into_iter()
            .enumerate()
            .map(|(i, (name, shape))| {
                let count: usize = shape.iter().product();
                (name.to_owned(), shape, (0..count).map(|j| (100 * i + j) as f32).collect())
            })
            .collect()
    }

    fn write(dir: &Path, tensors: &[Numbered]) -> PathBuf {
        let path = dir.join("weights.safetensors");
        let bytes: Vec<Vec<u8>> =
            tensors.iter().map(|t| t.2.iter().flat_map(|v| v.to_le_bytes()).collect()).collect();
        let views = tensors.iter().zip(&bytes).map(|((name, shape, _), bytes)| {
            (name, TensorView::new(Dtype::F32, shape.clone(), bytes).unwrap())
        });
        fs::write(&path, safetensors::serialize(views, None).unwrap()).unwrap();
        path
    }

    fn load(path: &Path) -> Result<Net, PretrainedError> {
        let naming = Naming {
            network: "a test",
            names: &|name| vec![name.to_owned()],
            unused: &|name| name == "spare",
        };
        fill(net(&Device::default()), &PretrainedFile::open(path)?, &naming)
    }

    #[test]
    fn tensors_are_loaded_into_their_modules() {
        let dir = tempfile::tempdir().unwrap();
        for prefix in ["", "module.", "state_dict.module."] {
            let mut all = tensors();
            all.push(("spare".to_owned(), vec![1], vec![0.0]));
            all.iter_mut().for_each(|t| t.0 = format!("{prefix}{}", t.0));
            let net = load(&write(dir.path(), &all)).unwrap();
            assert_eq!(net.conv.weight.val().try_into_vec_as::<f32>().unwrap(), tensors()[0].2);
            assert_eq!(net.norm.running_var.value().try_into_vec_as::<f32>().unwrap(), tensors()[4].2);
            let weight: Vec<f32> = net.fc.weight.val().transpose().try_into_vec_as().unwrap();
            assert_eq!(weight, tensors()[6].2, "PyTorch has outputs x inputs, Burn inputs x outputs");
        }
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let message = |change: &dyn Fn(&mut Vec<Numbered>)| {
            let mut all = tensors();
            change(&mut all);
            load(&write(dir.path(), &all)).unwrap_err().to_string()
        };
        let error = message(&|t| drop(t.remove(3)));
        assert!(error.contains("tensor norm.running_mean: expected shape [4], found no tensor"), "{error}");
        let error = message(&|t| t[6].1 = vec![4, 3]);
        assert!(error.contains("tensor fc.weight: expected shape [3, 4], found [4, 3]"), "{error}");
        let error = message(&|t| t.push(("more.weight".to_owned(), vec![1], vec![0.0])));
        assert!(
            error.contains("tensor more.weight: expected no tensor of that name, found shape [1]"),
            "{error}"
        );
        let error = message(&|t| t[0].2[5] = f32::INFINITY);
        assert!(
            error.contains("tensor conv.weight: expected finite floating-point numbers, found inf"),
            "{error}"
        );
    }

    #[test]
    fn broken_files_are_errors_and_not_panics() {
        let dir = tempfile::tempdir().unwrap();
        let path = write(dir.path(), &tensors());
        let whole = fs::read(&path).unwrap();
        for length in 0..whole.len() {
            for ending in ["safetensors", "pth"] {
                let path = dir.path().join("part").with_extension(ending);
                fs::write(&path, &whole[..length]).unwrap();
                assert!(load(&path).is_err(), "{length} bytes as {ending}");
            }
        }
        let error = load(&dir.path().join("none.pth")).err().unwrap().to_string();
        assert!(error.contains("none.pth: cannot be read"), "{error}");
        let error = load(&dir.path().join("weights.h5")).err().unwrap().to_string();
        assert!(error.contains("found ending \"h5\""), "{error}");
    }
}
