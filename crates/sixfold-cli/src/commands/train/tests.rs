//! The defaults of trainings stand once, in the recipes: command line, help and Python's stub show those.

use std::collections::BTreeMap;
use std::fmt::Debug;

use clap::Parser;
use sixfold_nn::choice::Choice;

use super::*;

/// What the command line asks for without options.
fn parsed(words: &str) -> TrainCommand {
    let words = format!("sixfold train {words} --out out");
    match Arguments::try_parse_from(words.split(' ')).unwrap().command {
        crate::arguments::Command::Train(train) => train.command,
        _ => panic!("{words}: no training"),
    }
}

fn help(training: &str) -> String {
    let mut command = Arguments::command();
    let train = command.find_subcommand_mut("train").unwrap();
    let help = train.find_subcommand_mut(training).unwrap().render_long_help().to_string();
    help.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[test]
fn without_options_the_command_line_asks_for_the_recipes_defaults() {
    fn same<R: Recipe + PartialEq + Debug>(asked: R, default: R) {
        assert_eq!(asked, default);
    }
    let command = command_line();
    match parsed("pix2pose --object mug.ply") {
        TrainCommand::Pix2pose(a) => {
            same(a.recipe(), sixfold_pix2pose::recipe::Pix2PoseRecipe { command, ..Default::default() });
        }
        _ => panic!(),
    }
    let command = command_line();
    match parsed("detector --object mug.ply") {
        TrainCommand::Detector(a) => {
            same(a.recipe(), sixfold_detect::recipe::DetectorRecipe { command, ..Default::default() });
        }
        _ => panic!(),
    }
    #[cfg(feature = "physics")]
    match parsed("mttm") {
        TrainCommand::Mttm(a) => {
            let command = command_line();
            same(a.recipe(), sixfold_mttm::recipe::MttmRecipe { command, ..Default::default() });
        }
        _ => panic!(),
    }
    #[cfg(feature = "experience")]
    match parsed("dgcm") {
        TrainCommand::Dgcm(a) => {
            let command = command_line();
            same(a.recipe(), sixfold_dgcm::recipe::DgcmRecipe { command, ..Default::default() });
        }
        _ => panic!(),
    }
    let command = command_line();
    match parsed("nol") {
        TrainCommand::Nol(a) => {
            same(a.recipe(), sixfold_nol::recipe::NolRecipe { command, ..Default::default() });
        }
        _ => panic!(),
    }
    let command = command_line();
    match parsed("views") {
        TrainCommand::Views(a) => {
            same(a.recipe(), sixfold_views::recipe::ViewsRecipe { command, ..Default::default() });
        }
        _ => panic!(),
    }
    let command = command_line();
    match parsed("refiner") {
        TrainCommand::Refiner(a) => {
            same(a.recipe(), sixfold_views::refiner::recipe::RefinerRecipe { command, ..Default::default() });
        }
        _ => panic!(),
    }
}

#[test]
fn the_preset_published_asks_for_the_published_recipes_and_other_options_still_count() {
    // The older name is understood too.
    for name in ["published", "paper"] {
        let command = command_line();
        match parsed(&format!("pix2pose --object mug.ply --preset {name}")) {
            TrainCommand::Pix2pose(a) => {
                let published = sixfold_pix2pose::recipe::Pix2PoseRecipe::published();
                assert_eq!(a.recipe(), sixfold_pix2pose::recipe::Pix2PoseRecipe { command, ..published });
            }
            _ => panic!(),
        }
        let command = command_line();
        match parsed(&format!("detector --object mug.ply --preset {name}")) {
            TrainCommand::Detector(a) => {
                let published = sixfold_detect::recipe::DetectorRecipe::published();
                assert_eq!(a.recipe(), sixfold_detect::recipe::DetectorRecipe { command, ..published });
            }
            _ => panic!(),
        }
        let command = command_line();
        match parsed(&format!("nol --preset {name}")) {
            TrainCommand::Nol(a) => {
                let published = sixfold_nol::recipe::NolRecipe::published();
                assert_eq!(a.recipe(), sixfold_nol::recipe::NolRecipe { command, ..published });
            }
            _ => panic!(),
        }
        #[cfg(feature = "physics")]
        match parsed(&format!("mttm --preset {name}")) {
            TrainCommand::Mttm(a) => {
                let (command, published) = (command_line(), sixfold_mttm::recipe::MttmRecipe::published());
                assert_eq!(a.recipe(), sixfold_mttm::recipe::MttmRecipe { command, ..published });
            }
            _ => panic!(),
        }
        #[cfg(feature = "experience")]
        match parsed(&format!("dgcm --preset {name}")) {
            TrainCommand::Dgcm(a) => {
                let (command, published) = (command_line(), sixfold_dgcm::recipe::DgcmRecipe::published());
                assert_eq!(a.recipe(), sixfold_dgcm::recipe::DgcmRecipe { command, ..published });
            }
            _ => panic!(),
        }
    }
    match parsed("pix2pose --object mug.ply --preset published,lmo --network resnet50 --render-share 0.25") {
        TrainCommand::Pix2pose(a) => {
            let recipe = a.recipe();
            assert!(recipe.published && recipe.render_share == 0.25);
            assert_eq!(recipe.network, sixfold_pix2pose::recipe::NetworkKind::ResNet50);
            assert_eq!(recipe.preset, Some(sixfold_pix2pose::preset::Preset::Lmo));
        }
        _ => panic!(),
    }
    match parsed("nol --loss gan") {
        TrainCommand::Nol(a) => {
            assert_eq!(
                (a.recipe().options().weights, a.recipe().options().adversarial),
                ([5.0, 10.0, 1.0], 1.0)
            );
        }
        _ => panic!(),
    }
}

#[test]
fn help_shows_the_defaults() {
    let shown = [
        ("pix2pose", "(default: 8000; the dissertation's networks: 25000). 0: the weights"),
        ("pix2pose", "(default: 4; the dissertation's networks: 50)"),
        ("pix2pose", "(default: 0.002; the dissertation's networks: 0.0001)"),
        ("pix2pose", "Largest rotation of photographs in the image plane, degrees [default: 45]"),
        ("pix2pose", "Side of the network's input in pixels; the output has half of it [default: 128]"),
        ("pix2pose", "- tless: T-LESS"),
        ("detector", "Highest learning rate [default: 0.002]"),
        ("detector", "Largest rotation in the image plane, degrees [default: 15]"),
        ("detector", "unless something else is asked for, 0 to 1 [default: 0.4]"),
        ("nol", "(default: 5000; the dissertation's network: 350000)"),
        ("nol", "- average: Their mean, for comparison"),
        ("nol", "[default: lstm]"),
        #[cfg(feature = "physics")]
        ("mttm", "Regions with an object in a step (default: 40; the dissertation's network: 16)"),
        #[cfg(feature = "experience")]
        ("dgcm", "(default: 10, with 3 negative ones; the dissertation's network: 25 of both)"),
        #[cfg(feature = "experience")]
        ("dgcm", "features' (default: 300; the dissertation's network: 1)"),
    ];
    for (training, text) in shown {
        let help = help(training);
        assert!(help.contains(text), "{training}: {text}\n{help}");
    }
}

/// The defaults that Python's stub shows for a training, as they stand there.
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

/// Holds the defaults in the stub of a Python function against those of the recipe.
fn check(function: &str, expected: Vec<(&str, String)>) {
    let expected = expected.into_iter().map(|(name, default)| (name.to_owned(), default)).collect();
    assert_eq!(stub(function), expected, "{function}");
}

#[test]
fn the_stub_of_python_shows_the_defaults_of_what_learns_from_images() {
    // Not of the recipe: which of a dataset's frames are read.
    let renders_only = || ("renders_only", word(false));
    let d = sixfold_pix2pose::recipe::Pix2PoseRecipe::default();
    check(
        "train_pix2pose",
        vec![
            renders_only(),
            ("network", name(d.network.name())),
            ("frozen_stages", d.frozen_stages.to_string()),
            ("render_share", d.render_share.to_string()),
            ("near_photographs", d.near_photographs.to_string()),
            ("size", d.size.to_string()),
            ("mesh_colors", word(d.mesh_colors)),
            ("convex_hull", word(d.convex_hull)),
            ("transformer_loss", word(d.transformer_loss)),
            ("view_limits", word(d.view_limits)),
            ("seed", d.seed.to_string()),
        ],
    );
    let d = sixfold_detect::recipe::DetectorRecipe::default();
    check(
        "train_detector",
        vec![
            renders_only(),
            ("network", name(d.network.name())),
            ("steps", d.steps.to_string()),
            ("batch", d.batch.to_string()),
            ("learning_rate", d.learning_rate.to_string()),
            ("encoder_share", d.encoder_share.to_string()),
            ("frozen_stages", d.frozen_stages.to_string()),
            ("size", d.size.to_string()),
            ("photograph_share", d.photograph_share.to_string()),
            ("render_share", d.render_share.to_string()),
            ("longest_side", d.longest_side.to_string()),
            ("threshold", d.threshold.to_string()),
            ("mesh_colors", word(d.mesh_colors)),
            ("seed", d.seed.to_string()),
        ],
    );
}

#[test]
fn the_stub_of_python_shows_the_defaults_of_the_others() {
    #[cfg(feature = "physics")]
    {
        let d = sixfold_mttm::recipe::MttmRecipe::default();
        check(
            "train_mttm",
            vec![
                ("network", name(d.network.name())),
                ("objects", d.objects.to_string()),
                ("scenes", d.scenes.to_string()),
                ("seed", d.seed.to_string()),
            ],
        );
    }
    #[cfg(feature = "experience")]
    {
        let d = sixfold_dgcm::recipe::DgcmRecipe::default();
        check(
            "train_dgcm",
            vec![
                ("network", name(d.network.name())),
                ("views", d.views.to_string()),
                ("seed", d.seed.to_string()),
            ],
        );
    }
    let d = sixfold_nol::recipe::NolRecipe::default();
    check(
        "train_nol",
        vec![
            ("network", name(d.network.name())),
            ("lstm", word(d.parts.integrator.name() == "lstm")),
            ("decoder", word(d.parts.decoder)),
            ("seed", d.seed.to_string()),
        ],
    );
    let d = sixfold_views::recipe::ViewsRecipe::default().options;
    check(
        "train_views",
        vec![
            ("steps", d.common.steps.to_string()),
            ("learning_rate", d.common.learning_rate.to_string()),
            ("batch", d.batch.to_string()),
            ("seed", d.common.seed.to_string()),
        ],
    );
    let d = sixfold_views::refiner::recipe::RefinerRecipe::default().options;
    check(
        "train_refiner",
        vec![
            ("steps", d.common.steps.to_string()),
            ("learning_rate", d.common.learning_rate.to_string()),
            ("batch", d.batch.to_string()),
            ("seed", d.common.seed.to_string()),
        ],
    );
}

#[test]
fn an_option_out_of_its_range_is_named_by_its_flag() {
    let error = |field| by_flag(&OptionError::new(field, 3, "more")).to_string();
    assert_eq!(error("longest_side"), "--longest-side: found 3, expected more");
    assert_eq!(error("regions"), "regions: found 3, expected more");
    let wrong = Arguments::try_parse_from("sixfold train nol --out o --learning-rate 0".split(' ')).unwrap();
    match wrong.command {
        crate::arguments::Command::Train(train) => {
            assert!(run(&train).unwrap_err().to_string().starts_with("--learning-rate: found 0"));
        }
        _ => panic!(),
    }
}
