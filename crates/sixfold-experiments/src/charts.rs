//! `sixfold-experiments charts`: the charts of the documentation, from the files in `results/`.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, anyhow, bail};
use clap::Args;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sixfold_geometry::RgbImage;
use sixfold_io::{limits, read_regular_text, read_rgb, write_rgb};
use sixfold_plot::{BarChart, BarGroup};
use sixfold_shell::Outcome;
use sixfold_shell::output::{JsonArguments, report};

#[derive(Debug, Args)]
pub(crate) struct ChartsArguments {
    /// What the charts show: docs/charts.json
    #[arg(long, value_name = "FILE", default_value = "docs/charts.json")]
    charts: PathBuf,
    /// Folder of the result files
    #[arg(long, value_name = "DIR", default_value = "results")]
    results: PathBuf,
    /// Folder of the images
    #[arg(long, value_name = "DIR", default_value = "docs/images")]
    out: PathBuf,
    /// Write nothing: exit 2 if an image differs from its results
    #[arg(long)]
    check: bool,
    #[command(flatten)]
    json: JsonArguments,
}

/// The images that were written or compared.
#[derive(Debug, Serialize)]
struct Written {
    images: Vec<String>,
}

/// A chart; `groups` from top to bottom.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Chart {
    image: String,
    title: String,
    axis: String,
    #[serde(default)]
    series: Vec<String>,
    #[serde(default)]
    logarithmic: bool,
    #[serde(default)]
    end: Option<f64>,
    groups: Vec<Group>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Group {
    label: String,
    /// A file of results.
    file: String,
    /// Where its values are in the file (JSON pointers, RFC 6901).
    values: Vec<String>,
}

pub(crate) fn run(a: &ChartsArguments) -> Result<Outcome> {
    let text =
        read_regular_text(&a.charts, limits::SMALL_TEXT).with_context(|| a.charts.display().to_string())?;
    let charts: Vec<Chart> = serde_json::from_str(&text).with_context(|| a.charts.display().to_string())?;
    let (mut images, mut differ) = (vec![], vec![]);
    for chart in &charts {
        let image = chart.read(&a.results)?.render();
        let file = a.out.join(&chart.image);
        if a.check {
            differ.extend((!is_same(&file, &image)).then(|| file.display().to_string()));
        } else {
            write_rgb(&file, &image)?;
        }
        images.push(file.display().to_string());
    }
    if !differ.is_empty() {
        bail!("{}: differs from the results; run `sixfold-experiments charts`", differ.join(", "));
    }
    let verb = if a.check { "as its results say:" } else { "wrote" };
    let written = Written { images };
    report(&a.json, &written, || written.images.iter().for_each(|image| println!("{verb} {image}")))?;
    Ok(Outcome::Found)
}

fn is_same(file: &Path, image: &RgbImage) -> bool {
    read_rgb(file).is_ok_and(|there| there == *image)
}

impl Chart {
    fn read(&self, results: &Path) -> Result<BarChart> {
        let mut groups = vec![];
        for group in &self.groups {
            let path = results.join(&group.file);
            let text =
                read_regular_text(&path, limits::LARGE_TEXT).with_context(|| path.display().to_string())?;
            let file: Value = serde_json::from_str(&text).with_context(|| path.display().to_string())?;
            let number = |pointer: &String| {
                let value = file.pointer(pointer).and_then(Value::as_f64);
                value.ok_or_else(|| anyhow!("{}: found no number at {pointer}", path.display()))
            };
            let values = group.values.iter().map(number).collect::<Result<_>>()?;
            groups.push(BarGroup { label: group.label.clone(), values });
        }
        Ok(BarChart {
            title: self.title.clone(),
            axis: self.axis.clone(),
            series: self.series.clone(),
            groups,
            logarithmic: self.logarithmic,
            end: self.end,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chart_shows_its_results_and_a_change_is_detected() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        std::fs::write(at("r.json"), r#"{"rows": [["a", 0.5], ["b", 1.0]]}"#).unwrap();
        let charts = |second: &str| {
            format!(
                r#"[{{"image": "c.png", "title": "t", "axis": "x", "groups": [
                {{"label": "a", "file": "r.json", "values": ["/rows/0/1"]}},
                {{"label": "b", "file": "r.json", "values": ["{second}"]}}]}}]"#
            )
        };
        std::fs::write(at("charts.json"), charts("/rows/1/1")).unwrap();
        let arguments = |check: bool| ChartsArguments {
            charts: at("charts.json"),
            results: dir.path().into(),
            out: dir.path().into(),
            check,
            json: JsonArguments::default(),
        };
        assert!(run(&arguments(true)).unwrap_err().to_string().contains("c.png"));
        run(&arguments(false)).unwrap();
        run(&arguments(true)).unwrap();
        std::fs::write(at("r.json"), r#"{"rows": [["a", 0.5], ["b", 0.9]]}"#).unwrap();
        assert!(run(&arguments(true)).is_err());
        std::fs::write(at("charts.json"), charts("/rows/1/0")).unwrap();
        let error = run(&arguments(true)).unwrap_err().to_string();
        assert!(error.contains("r.json") && error.contains("/rows/1/0"), "{error}");
    }
}
