//! The file of a HAF planner: JSON, every field checked.

use std::path::Path;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::haf::HafModel;
use super::heights::{CELLS, HeightFeature, Region};

/// Value of the file's field `kind`.
const KIND: &str = "haf-linear-1";
/// Largest file that is read, bytes: ten times a planner of 1000 features.
const MAX_BYTES: u64 = 4 << 20;

/// Errors of HAF planner files.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum HafError {
    /// It cannot be read or written.
    #[error("planner file {file}: {source}")]
    Io {
        /// The file.
        file: String,
        /// The cause.
        source: std::io::Error,
    },
    /// It is not JSON in this format.
    #[error(
        "planner file {file}: expected a file that `sixfold train planner --planner haf` wrote: {source}"
    )]
    Json {
        /// The file.
        file: String,
        /// Position and cause.
        source: serde_json::Error,
    },
    /// A field has an invalid value.
    #[error("planner file {file}: field {field}: found {found}, expected {expected}; train it again")]
    Field {
        /// The file.
        file: String,
        /// The field.
        field: String,
        /// Its value.
        found: String,
        /// The values allowed.
        expected: &'static str,
    },
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Content {
    kind: String,
    card: serde_json::Value,
    probability: [f32; 2],
    bias: f32,
    features: Vec<Weighted>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Weighted {
    weight: f32,
    /// First column and row, the column and row after the last, weight of the mean height.
    regions: Vec<(usize, usize, usize, usize, f32)>,
}

/// Reads a planner file; see [`parse_haf`] for its contents.
///
/// # Errors
/// [`HafError`].
pub fn read_haf(path: &Path) -> Result<HafModel, HafError> {
    let file = path.display().to_string();
    let read = || -> std::io::Result<String> {
        use std::io::Read;
        let mut text = String::new();
        std::fs::File::open(path)?.take(MAX_BYTES).read_to_string(&mut text)?;
        Ok(text)
    };
    let text = read().map_err(|source| HafError::Io { file: file.clone(), source })?;
    parse_haf(&text, &file)
}

/// Reads a planner from the text of its file; `file` is used in messages. The text is JSON: `kind`, the `card` of the training, the
/// `probability` curve's slope and offset, the `bias`, and `features` with `weight` and one to four `regions` as `[column, row, end
/// column, end row, weight]`.
///
/// # Errors
/// [`HafError`].
pub fn parse_haf(text: &str, file: &str) -> Result<HafModel, HafError> {
    let content: Content =
        serde_json::from_str(text).map_err(|source| HafError::Json { file: file.to_owned(), source })?;
    let check = |fits: bool, field: String, found: &dyn std::fmt::Debug, expected: &'static str| match fits {
        true => Ok(()),
        false => Err(HafError::Field { file: file.to_owned(), field, found: format!("{found:?}"), expected }),
    };
    check(content.kind == KIND, "kind".to_owned(), &content.kind, "haf-linear-1")?;
    let finite = content.bias.is_finite() && content.probability.iter().all(|p| p.is_finite());
    let numbers = (content.bias, content.probability);
    check(finite, "bias and probability".to_owned(), &numbers, "finite numbers")?;
    let count = content.features.len();
    check((1..=10_000).contains(&count), "features".to_owned(), &count, "1 to 10000 of them")?;
    let mut features = vec![];
    for (k, weighted) in content.features.into_iter().enumerate() {
        let field = |name: &str| format!("features[{k}].{name}");
        check(weighted.weight.is_finite(), field("weight"), &weighted.weight, "a finite number")?;
        let count = weighted.regions.len();
        check((1..=4).contains(&count), field("regions"), &count, "1 to 4 of them")?;
        let mut regions = vec![];
        for region in weighted.regions {
            let (x0, y0, x1, y1, weight) = region;
            let fits = x0 < x1 && y0 < y1 && x1 <= CELLS && y1 <= CELLS && weight.is_finite();
            check(
                fits,
                field("regions"),
                &region,
                "a rectangle of the grid of 14x14 cells and a finite weight",
            )?;
            regions.push(Region { low: [x0, y0], high: [x1, y1], weight });
        }
        features.push((HeightFeature { regions }, weighted.weight));
    }
    let (bias, probability, card) = (content.bias, content.probability, content.card);
    Ok(HafModel { features, bias, probability, card })
}

/// The text of a planner's file, with one feature per line.
///
/// # Errors
/// [`HafError::Json`] for numbers that are not finite.
pub fn write_haf(model: &HafModel) -> Result<String, HafError> {
    let json = |value: serde_json::Result<String>| {
        value.map_err(|source| HafError::Json { file: "haf".to_owned(), source })
    };
    let features = model.features.iter().map(|(feature, weight)| {
        let region = |r: &Region| (r.low[0], r.low[1], r.high[0], r.high[1], r.weight);
        json(serde_json::to_string(&Weighted {
            weight: *weight,
            regions: feature.regions.iter().map(region).collect(),
        }))
    });
    let features: Vec<String> = features.collect::<Result<_, _>>()?;
    Ok(format!(
        "{{\"kind\":\"{KIND}\",\n\"card\":{},\n\"probability\":{},\n\"bias\":{},\n\"features\":[\n{}\n]}}\n",
        json(serde_json::to_string(&model.card))?,
        json(serde_json::to_string(&model.probability))?,
        json(serde_json::to_string(&model.bias))?,
        features.join(",\n")
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model() -> HafModel {
        let region = |x: usize, weight| Region { low: [x, 2], high: [x + 3, 9], weight };
        let feature = HeightFeature { regions: vec![region(1, 1.0), region(6, -1.0)] };
        HafModel {
            features: vec![(feature, 0.25)],
            bias: -0.5,
            probability: [2.0, 0.1],
            card: serde_json::json!({ "seed": 3 }),
        }
    }

    #[test]
    fn a_planner_survives_its_file() {
        let text = write_haf(&model()).unwrap();
        assert_eq!(parse_haf(&text, "haf.json").unwrap(), model());
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("haf.json");
        std::fs::write(&file, text).unwrap();
        assert_eq!(read_haf(&file).unwrap(), model());
        let error = read_haf(&folder.path().join("none.json")).unwrap_err().to_string();
        assert!(error.contains("none.json"), "{error}");
    }

    #[test]
    fn errors_of_a_planner_file_are_named() {
        let text = write_haf(&model()).unwrap();
        for (before, after, field) in [
            ("haf-linear-1", "haf-linear-2", "kind"),
            ("[1,2,4,9,1.0]", "[4,2,4,9,1.0]", "features[0].regions"),
            ("[1,2,4,9,1.0]", "[1,2,15,9,1.0]", "features[0].regions"),
            ("0.25", "1e60", "weight"),
            ("\"bias\":", "\"basis\":", "basis"),
        ] {
            assert!(text.contains(before), "{before}");
            let error = parse_haf(&text.replace(before, after), "haf.json").unwrap_err().to_string();
            assert!(error.contains("haf.json") && error.contains(field), "{error}");
        }
    }

    #[test]
    fn the_shipped_planner_is_read() {
        assert!(HafModel::shipped().features.len() > 100);
    }
}
