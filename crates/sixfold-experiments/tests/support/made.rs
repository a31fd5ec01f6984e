//! Inputs of the experiments that other commands make: a store of experiences, and a trained network.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use clap::Parser;
use sixfold_data::{FrameSelection, TrainingSet};
use sixfold_nn::recipe::{Session, TrainingEvent, train};
use sixfold_pix2pose::recipe::{MIN_VISIBILITY, Pix2PoseRecipe};
use sixfold_shell::grasp::learn::{LearnArguments, learn};

/// The network for grasps that comes with Sixfold.
pub const NETWORK: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../weights/dgcm.safetensors");

#[derive(Parser)]
struct Learn {
    #[command(flatten)]
    arguments: LearnArguments,
}

/// A store `e.db` of what three scenes with `part.ply`, both in `folder`, have taught.
pub fn experiences(folder: &Path) {
    let folder = folder.display();
    let words = format!(
        "learn --experiences {folder}/e.db --object {folder}/part.ply --unit mm --attempts 3 --tries 3 --near 9 --weights {NETWORK} --out {folder}/learn"
    );
    learn(&Learn::parse_from(words.split_whitespace()).arguments).unwrap();
}

/// A small network for object 1 of the dataset `tiny` in `folder` after three steps on frames 0 and 11, which `frames.json` lists:
/// `trained/model.safetensors`.
pub fn pix2pose(folder: &Path) {
    let file = folder.join("frames.json");
    let frames = r#"[{"scene_id": 7, "im_id": 0}, {"scene_id": 7, "im_id": 11}]"#;
    std::fs::write(&file, frames).unwrap();
    let frames = FrameSelection::File(file);
    let material =
        TrainingSet::of_dataset(&folder.join("tiny"), "test", &[1], &frames, MIN_VISIBILITY).unwrap();
    let recipe = Pix2PoseRecipe {
        steps: Some(3),
        per_object: Some(4),
        rotation: 0.0,
        render_fraction: 0.0,
        size: 64,
        ..Pix2PoseRecipe::default()
    };
    let (out, stop) = (folder.join("trained"), AtomicBool::new(false));
    let mut events = |_: TrainingEvent<'_>| ();
    train(&recipe, material, &mut Session::new(&out, &stop, &mut events)).unwrap();
}
