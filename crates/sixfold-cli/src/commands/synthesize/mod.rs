//! `sixfold synthesize`: makes a training set of new views from a few cluttered photographs with approximate poses (Neural
//! Object Learning; K. Park, dissertation, chapter 4).

pub(crate) mod arguments;
mod input;

use std::path::Path;

use anyhow::{Result, bail};
use sixfold_nol::model::NolModel;
use sixfold_nol::synthesis::Weighting;
use sixfold_shell::Outcome;
use sixfold_shell::folder::DatasetFolder;
use sixfold_shell::new_views::NewViews;
use sixfold_shell::output::report;
use sixfold_shell::progress::Terminal;

use self::arguments::WeightingKind;
pub(crate) use self::arguments::{AFTER_HELP, SynthesizeArguments};

pub(crate) fn run(a: &SynthesizeArguments) -> Result<Outcome> {
    a.check()?;
    let start = std::time::Instant::now();
    let inputs = [&a.dataset, &a.photographs, &a.frames, &a.weights, &a.detector, &a.backgrounds];
    let inputs: Vec<&Path> = inputs.into_iter().flatten().map(|p| p.as_path()).collect();
    let folder = DatasetFolder::take(&a.out, "synthesize", a.deciding(), &inputs)?;
    let images = input::read(a)?;
    if images.objects.is_empty() {
        bail!("no photograph shows any of the objects; choose other --frames or a lower --min-visible");
    }
    folder.begin(&input::contents(a, &images)?)?;
    let network;
    let weighting = match (a.weighting, &a.weights) {
        (WeightingKind::Network, file) => {
            network = file.as_deref().map_or_else(NolModel::shipped, NolModel::load)?;
            Weighting::Network(&network)
        }
        (WeightingKind::Best, _) => Weighting::Best,
        (WeightingKind::Average, _) => Weighting::Average,
    };
    let new = NewViews {
        split: &a.new_split,
        chosen_by: a.chosen_by(),
        sources: a.sources,
        per_view: a.per_view,
        weighting,
        refinement: a.refinement(),
        disturbed: !a.disturb.is_empty(),
        grid: a.grid(),
        backgrounds: a.backgrounds.as_deref(),
        with_photographs: a.with_photographs,
        compare_photographs: a.preset.is_none(),
    };
    let (mut summary, sheets) = new.make(&folder, images, &Terminal::default())?;
    summary.seconds = start.elapsed().as_secs_f64();
    report(&a.json, &summary, || summary.print())?;
    let found = !summary.objects.is_empty();
    Ok(sheets.outcome(if found { Outcome::Found } else { Outcome::NothingFound }))
}
