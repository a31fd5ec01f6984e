//! The defaults of trainings are defined once, in the recipes; this checks that Python's stub shows them.

#![cfg(feature = "experience")]

use std::collections::BTreeMap;

use sixfold::nn::choice::Choice;

/// The defaults that Python's stub shows for a training, as text.
fn stub(function: &str) -> BTreeMap<String, String> {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../../python/package/sixfold/__init__.pyi");
    let text = std::fs::read_to_string(file).unwrap();
    let start = text.find(&format!("def {function}(")).unwrap();
    text[start..]
        .lines()
        .skip(1)
        .take_while(|line| !line.starts_with(')'))
        .filter_map(|line| {
            let (name, rest) = line.trim().split_once(':')?;
            let (_, default) = rest.trim_end_matches(',').rsplit_once(" = ")?;
            Some((name.to_owned(), default.to_owned()))
        })
        .filter(|(_, default)| default != "None")
        .collect()
}

/// A truth value as Python writes it.
fn word(flag: bool) -> String {
    if flag { "True" } else { "False" }.to_owned()
}

/// A name as Python writes it.
fn name(name: &str) -> String {
    format!("{name:?}")
}

/// Compares the defaults in the stub of a Python function with those of the recipe.
fn check(function: &str, expected: Vec<(&str, String)>) {
    let expected = expected.into_iter().map(|(name, default)| (name.to_owned(), default)).collect();
    assert_eq!(stub(function), expected, "{function}");
}

#[test]
fn the_python_stub_has_the_defaults_of_image_trainings() {
    // Not part of the recipe: which of a dataset's frames are read.
    let renders_only = || ("renders_only", word(false));
    let d = sixfold::pix2pose::recipe::Pix2PoseRecipe::default();
    check(
        "train_pix2pose",
        vec![
            renders_only(),
            ("network", name(d.network.name())),
            ("frozen_stages", d.frozen_stages.to_string()),
            ("render_fraction", d.render_fraction.to_string()),
            ("near_photographs", d.near_photographs.to_string()),
            ("size", d.size.to_string()),
            ("mesh_colors", word(d.mesh_colors)),
            ("convex_hull", word(d.convex_hull)),
            ("transformer_loss", word(d.transformer_loss)),
            ("view_limits", word(d.view_limits)),
            ("seed", d.seed.to_string()),
        ],
    );
    let d = sixfold::detect::recipe::DetectorRecipe::default();
    check(
        "train_detector",
        vec![
            renders_only(),
            ("network", name(d.network.name())),
            ("steps", d.steps.to_string()),
            ("batch", d.batch.to_string()),
            ("learning_rate", d.learning_rate.to_string()),
            ("encoder_rate", d.encoder_rate.to_string()),
            ("frozen_stages", d.frozen_stages.to_string()),
            ("size", d.size.to_string()),
            ("photograph_fraction", d.photograph_fraction.to_string()),
            ("render_fraction", d.render_fraction.to_string()),
            ("longest_side", d.longest_side.to_string()),
            ("threshold", d.threshold.to_string()),
            ("mesh_colors", word(d.mesh_colors)),
            ("seed", d.seed.to_string()),
        ],
    );
}

#[test]
fn the_stub_of_python_shows_the_defaults_of_the_others() {
    let d = sixfold::mttm::recipe::MttmRecipe::default();
    check(
        "train_mttm",
        vec![
            ("network", name(d.network.name())),
            ("objects", d.objects.to_string()),
            ("scenes", d.scenes.to_string()),
            ("seed", d.seed.to_string()),
        ],
    );
    let d = sixfold::dgcm::recipe::DgcmRecipe::default();
    check(
        "train_dgcm",
        vec![
            ("network", name(d.network.name())),
            ("views", d.views.to_string()),
            ("seed", d.seed.to_string()),
        ],
    );
    let d = sixfold::nol::recipe::NolRecipe::default();
    check(
        "train_nol",
        vec![
            ("network", name(d.network.name())),
            ("lstm", word(d.parts.integrator.name() == "lstm")),
            ("decoder", word(d.parts.decoder)),
            ("seed", d.seed.to_string()),
        ],
    );
    let d = sixfold::views::recipe::ViewsRecipe::default().options;
    check(
        "train_views",
        vec![
            ("steps", d.common.steps.to_string()),
            ("learning_rate", d.common.learning_rate.to_string()),
            ("batch", d.batch.to_string()),
            ("seed", d.common.seed.to_string()),
        ],
    );
    let d = sixfold::views::refiner::recipe::RefinerRecipe::default().options;
    check(
        "train_refiner",
        vec![
            ("steps", d.common.steps.to_string()),
            ("learning_rate", d.common.learning_rate.to_string()),
            ("batch", d.batch.to_string()),
            ("seed", d.common.seed.to_string()),
        ],
    );
    let d = sixfold::detect::proposals::ProposalsRecipe::default();
    check(
        "train_proposals",
        vec![
            ("steps", d.options.common.steps.to_string()),
            ("learning_rate", d.options.common.learning_rate.to_string()),
            ("batch", d.options.batch.to_string()),
            ("objects", d.objects.to_string()),
            ("size", d.size.to_string()),
            ("seed", d.options.common.seed.to_string()),
        ],
    );
}
