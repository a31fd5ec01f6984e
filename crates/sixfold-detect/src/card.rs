//! Reads and checks the card of a detector's weight file before a network is created.

use std::path::Path;

use burn::tensor::Device;
use sixfold_nn::choice::Choice;
use sixfold_nn::weights::{ModelCard, WeightsError, read_card};

use crate::anchored::{AnchoredConfig, AnchoredKind, AnchoredNetwork, Wrong};
use crate::model::{ClassEntry, DetectorUse, ModelError};

/// Which network with anchors a card describes, if it describes one.
pub(crate) fn anchored_kind(card: &ModelCard) -> Option<AnchoredKind> {
    AnchoredKind::ALL.iter().copied().find(|kind| kind.architecture() == card.architecture)
}

pub(crate) type AnchoredContent = (AnchoredNetwork, Vec<usize>, Vec<ClassEntry>, DetectorUse, ModelCard);

pub(crate) fn read_anchored(path: &Path, device: &Device) -> Result<AnchoredContent, ModelError> {
    let card = read_card(path)?;
    let wrong = |(field, expected, found): Wrong| ModelError::Card {
        file: path.to_path_buf(),
        field,
        expected,
        found,
    };
    let field = |name: &'static str, field: &'static str, expected: &'static str| {
        (card.extra[name].clone(), move |e: serde_json::Error| (field, expected, e.to_string()))
    };
    let (value, error) = field("network", "extra.network", "the network's sizes");
    let config: AnchoredConfig = serde_json::from_value(value).map_err(error).map_err(wrong)?;
    let (value, error) = field("use", "extra.use", "longest_side and threshold");
    let usage: DetectorUse = serde_json::from_value(value).map_err(error).map_err(wrong)?;
    let (value, error) = field("labels", "extra.labels", "a label for each object");
    let labels: Vec<usize> = serde_json::from_value(value).map_err(error).map_err(wrong)?;
    let classes = classes_of(&card, path)?;
    let bytes = std::fs::metadata(path)
        .map_err(|source| WeightsError::Read { file: path.to_path_buf(), source })?
        .len();
    config.check(bytes).map_err(wrong)?;
    if anchored_kind(&card) != Some(config.kind) {
        return Err(wrong(("extra.network.kind", "the network of the architecture", card.architecture)));
    }
    let range = config.first_label()..config.labels;
    let fit = labels.iter().enumerate().all(|(i, l)| range.contains(l) && !labels[..i].contains(l));
    if labels.len() != classes.len() || !fit {
        let found = format!("{labels:?} for {} objects", classes.len());
        return Err(wrong(("extra.labels", "one of the network's labels for each object", found)));
    }
    if !(0.0..=1.0).contains(&usage.threshold) {
        return Err(wrong(("extra.use.threshold", "0 to 1", usage.threshold.to_string())));
    }
    let (network, card) = AnchoredNetwork::load(path, &config, device)?;
    Ok((network, labels, classes, usage, card))
}

/// The objects of a card, each once.
pub(crate) fn classes_of(card: &ModelCard, path: &Path) -> Result<Vec<ClassEntry>, ModelError> {
    let wrong = |expected, found: String| ModelError::Card {
        file: path.to_path_buf(),
        field: "objects",
        expected,
        found,
    };
    let read = |value: &serde_json::Value| {
        serde_json::from_value(value.clone()).map_err(|e| wrong("an id", e.to_string()))
    };
    let classes = card.objects.iter().map(read).collect::<Result<Vec<ClassEntry>, _>>()?;
    for (place, class) in classes.iter().enumerate() {
        if classes[..place].contains(class) {
            return Err(wrong("every id once", format!("object {} twice", class.id)));
        }
    }
    Ok(classes)
}
