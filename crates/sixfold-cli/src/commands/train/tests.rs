//! The defaults of trainings are defined once, in the recipes; the command line uses them.

use std::fmt::Debug;

use clap::Parser;
use sixfold_detect::proposals::ProposalsRecipe;
use sixfold_detect::recipe::DetectorRecipe;
#[cfg(feature = "experience")]
use sixfold_dgcm::recipe::DgcmRecipe;
#[cfg(feature = "physics")]
use sixfold_mttm::recipe::MttmRecipe;
use sixfold_nol::recipe::NolRecipe;
use sixfold_pix2pose::recipe::{NetworkKind, Pix2PoseRecipe};
#[cfg(feature = "physics")]
use sixfold_planners::recipe::PlannerOptions;
use sixfold_views::recipe::ViewsRecipe;
use sixfold_views::refiner::recipe::RefinerRecipe;

use super::*;

/// The training for a command line without options.
fn parsed(words: &str) -> TrainCommand {
    let words = format!("sixfold train {words} --out out");
    match Arguments::try_parse_from(words.split(' ')).unwrap().command {
        crate::arguments::Command::Train(train) => train.command,
        _ => panic!("{words}: no training"),
    }
}

/// The recipe of a command line.
macro_rules! recipe {
    ($kind:ident, $words:expr) => {
        match parsed($words) {
            TrainCommand::$kind(a) => a.recipe(),
            _ => panic!("{}: another training", $words),
        }
    };
}

fn same<R: Recipe + PartialEq + Debug>(asked: R, default: R) {
    assert_eq!(asked, default);
}

#[test]
fn without_options_the_command_line_asks_for_the_recipes_defaults() {
    macro_rules! default {
        ($recipe:ident) => {
            $recipe { command: command_line(), ..Default::default() }
        };
    }
    same(recipe!(Pix2pose, "pix2pose --object mug.ply"), default!(Pix2PoseRecipe));
    same(recipe!(Detector, "detector --object mug.ply"), default!(DetectorRecipe));
    #[cfg(feature = "physics")]
    same(recipe!(Mttm, "mttm"), default!(MttmRecipe));
    #[cfg(feature = "experience")]
    same(recipe!(Dgcm, "dgcm"), default!(DgcmRecipe));
    same(recipe!(Nol, "nol"), default!(NolRecipe));
    same(recipe!(Views, "views"), default!(ViewsRecipe));
    same(recipe!(Refiner, "refiner"), default!(RefinerRecipe));
    same(recipe!(Proposals, "proposals"), default!(ProposalsRecipe));
    #[cfg(feature = "physics")]
    match parsed("planner --planner gpd") {
        TrainCommand::Planner(a) => assert_eq!(a.options(), default!(PlannerOptions)),
        _ => panic!("another training"),
    }
}

#[test]
fn the_preset_published_asks_for_the_published_recipes_and_other_options_still_count() {
    macro_rules! published {
        ($recipe:ident) => {
            $recipe { command: command_line(), ..$recipe::published() }
        };
    }
    // The older name is accepted too.
    for name in ["published", "paper"] {
        let words = |training: &str| format!("{training} --preset {name}");
        same(recipe!(Pix2pose, &words("pix2pose --object mug.ply")), published!(Pix2PoseRecipe));
        same(recipe!(Detector, &words("detector --object mug.ply")), published!(DetectorRecipe));
        same(recipe!(Nol, &words("nol")), published!(NolRecipe));
        #[cfg(feature = "physics")]
        same(recipe!(Mttm, &words("mttm")), published!(MttmRecipe));
        #[cfg(feature = "experience")]
        same(recipe!(Dgcm, &words("dgcm")), published!(DgcmRecipe));
    }
    let recipe = recipe!(
        Pix2pose,
        "pix2pose --object mug.ply --preset published,lmo --network resnet50 --render-fraction 0.25"
    );
    assert!(recipe.published && recipe.render_fraction == 0.25);
    assert_eq!(recipe.network, NetworkKind::ResNet50);
    assert_eq!(recipe.preset, Some(sixfold_pix2pose::preset::Preset::Lmo));
    let options = recipe!(Nol, "nol --loss gan").options();
    assert_eq!((options.weights, options.adversarial), ([5.0, 10.0, 1.0], 1.0));
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
