//! A detector trained with torchvision: a file of weights and, next to it, a file that maps its labels to objects.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use sixfold_io::limits;
use sixfold_nn::pretrained::PretrainedError;
use sixfold_nn::weights::{ModelCard, WeightsError};

use crate::anchored::{AnchoredConfig, AnchoredNetwork};
use crate::model::{ClassEntry, ModelError};

/// Maximum number of labels in the file next to the weights.
const MAX_LABELS: usize = 10_000;
/// Sides of images in the network, pixels; as for the networks that Sixfold trains.
const SIDES: std::ops::RangeInclusive<usize> = 32..=16_384;

/// Content of the file next to the weights; every field is optional.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Beside {
    /// Object ids by label; other labels are not detected. If missing, every label is the id of its object.
    #[serde(default)]
    objects: Option<BTreeMap<usize, u32>>,
    /// See [`crate::anchored::AnchoredConfig::norm_epsilon`].
    #[serde(default)]
    norm_epsilon: Option<f64>,
    /// Shorter side of the images in the network, pixels; torchvision's `min_size`.
    #[serde(default)]
    min_side: Option<usize>,
    /// Maximum length of the longer side, pixels; torchvision's `max_size`.
    #[serde(default)]
    max_side: Option<usize>,
    /// Detections with a lower score are left out by default.
    #[serde(default)]
    pub threshold: Option<f32>,
}

/// A network of torchvision with the objects of its labels.
pub(crate) struct Torchvision {
    pub network: AnchoredNetwork,
    /// Label of every class.
    pub labels: Vec<usize>,
    pub classes: Vec<ClassEntry>,
    pub beside: Beside,
    pub card: ModelCard,
}

/// The file next to torchvision's weights that maps its labels to objects: `detector.objects.json` for `detector.pth`. It need not
/// exist.
pub fn objects_file(weights: &Path) -> PathBuf {
    weights.with_extension("objects.json")
}

/// [`objects_file`] if it exists; the options and inputs of a run must list it in addition to the weights.
pub fn existing_objects_file(weights: &Path) -> Option<PathBuf> {
    Some(objects_file(weights)).filter(|file| file.is_file())
}

impl Beside {
    /// Reads the file next to these weights, or returns the defaults if there is none.
    fn read(weights: &Path) -> Result<Beside, ModelError> {
        let file = objects_file(weights);
        let wrong = |found: String| ModelError::Objects { file: file.clone(), found };
        let bytes = match sixfold_io::read_regular(&file, limits::SMALL_TEXT) {
            Ok(bytes) => bytes,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Beside::default()),
            Err(error) => return Err(wrong(error.to_string())),
        };
        let beside: Beside = serde_json::from_slice(&bytes).map_err(|e| wrong(e.to_string()))?;
        let Beside { objects, norm_epsilon, min_side, max_side, threshold } = &beside;
        let fractions = [("norm_epsilon", *norm_epsilon), ("threshold", threshold.map(f64::from))];
        if let Some((field, Some(found))) =
            fractions.into_iter().find(|(_, f)| f.is_some_and(|f| !(0.0..=1.0).contains(&f)))
        {
            return Err(wrong(format!("{field} {found}, which is not within 0 to 1")));
        }
        let sides = [("min_side", *min_side), ("max_side", *max_side)];
        if let Some((field, Some(found))) =
            sides.into_iter().find(|(_, s)| s.is_some_and(|s| !SIDES.contains(&s)))
        {
            let (minimum, greatest) = (SIDES.start(), SIDES.end());
            return Err(wrong(format!(
                "{field} {found}, which is not within {minimum} to {greatest} pixels"
            )));
        }
        let count = objects.as_ref().map_or(1, BTreeMap::len);
        if count == 0 || count > MAX_LABELS {
            return Err(wrong(format!("{count} objects, expected 1 to {MAX_LABELS}")));
        }
        Ok(beside)
    }

    fn change(&self, config: &mut AnchoredConfig) {
        config.norm_epsilon = self.norm_epsilon.unwrap_or(config.norm_epsilon);
        config.min_side = self.min_side.unwrap_or(config.min_side);
        config.max_side = self.max_side.unwrap_or(config.max_side);
    }

    /// Labels and objects of a network of labels `first..labels`.
    fn classes(
        &self,
        weights: &Path,
        first: usize,
        labels: usize,
    ) -> Result<(Vec<usize>, Vec<ClassEntry>), ModelError> {
        let wrong = |found: String| ModelError::Objects { file: objects_file(weights), found };
        let Some(objects) = &self.objects else {
            return Ok((first..labels).map(|label| (label, ClassEntry { id: label as u32 })).unzip());
        };
        let mut seen = BTreeMap::new();
        for (label, id) in objects {
            if !(first..labels).contains(label) {
                let last = labels.saturating_sub(1);
                return Err(wrong(format!(
                    "label {label}, but the weights have the labels {first} to {last}"
                )));
            }
            if let Some(other) = seen.insert(*id, *label) {
                return Err(wrong(format!("object {id} for the labels {other} and {label}")));
            }
        }
        Ok(objects.iter().map(|(label, id)| (*label, ClassEntry { id: *id })).unzip())
    }
}

/// Reads weights of torchvision.
///
/// # Errors
/// [`ModelError`] for a file that cannot be read or does not contain one of the three networks, and for an invalid file next to it.
pub(crate) fn read(path: &Path) -> Result<Torchvision, ModelError> {
    let beside = Beside::read(path)?;
    let network =
        AnchoredNetwork::recognised(path, |config| beside.change(config)).map_err(|error| match error {
            PretrainedError::Read { file, source } => {
                ModelError::Weights(WeightsError::Read { file, source })
            }
            other => ModelError::Torchvision(other),
        })?;
    let network = network.ok_or_else(|| ModelError::Foreign { file: path.to_path_buf() })?;
    let config = network.config();
    let (labels, classes) = beside.classes(path, config.first_label(), config.labels)?;
    let name = config.kind.torchvision();
    let mut card = ModelCard::new(name, &format!("torchvision's {name}"));
    card.objects = classes.iter().map(|c| serde_json::to_value(c).unwrap_or_default()).collect();
    card.extra = serde_json::json!({ "network": config });
    let network = network.with_labels(&labels);
    Ok(Torchvision { network, labels, classes, beside, card })
}
