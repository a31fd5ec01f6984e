//! Options of this program that would have no effect in combination with others, and are refused.

use sixfold_shell::idle::Idle;
use sixfold_shell::idle::When::{Is, IsNot, With, Without};

/// One entry for each reason.
#[rustfmt::skip]
pub(crate) const IDLE: &[Idle] = &[
    Idle { command: "estimate", options: &["unit", "store", "instances"], when: &[With("dataset")] },
    Idle { command: "estimate", options: &["split"], when: &[Without("dataset")] },
    Idle { command: "estimate", options: &["depth_scale"], when: &[Without("depth")] },
    Idle { command: "estimate", options: &["object_id"], when: &[Is("method", &["ppf", "mttm"]), Without("detector")] },
    Idle { command: "estimate", options: &["object_id"], when: &[Is("method", &["auto", "pix2pose"]), Without("weights"), Without("detector")] },
    Idle { command: "estimate", options: &["detector"], when: &[IsNot("boxes", "detect")] },
    Idle { command: "estimate", options: &["weights"], when: &[Is("method", &["mttm"]), Is("matcher", &["points"])] },
    Idle { command: "estimate", options: &["matcher"], when: &[Is("masks", &["network"]), Is("matcher", &["points", "both"])] },
    Idle { command: "estimate", options: &["cache"], when: &[With("no_cache")] },
    Idle { command: "detect", options: &["split"], when: &[Without("dataset")] },
    Idle { command: "eval", options: &["min_score"], when: &[Without("detections")] },
    Idle { command: "eval", options: &["detection_ap", "no_vsd", "curves"], when: &[With("detections")] },
    Idle { command: "object add", options: &["model_id"], when: &[Without("models_info")] },
    Idle { command: "object add", options: &["unit", "models_info", "model_id", "symmetric_about"], when: &[With("depth")] },
    Idle { command: "synthesize", options: &["split"], when: &[Without("dataset")] },
    Idle { command: "synthesize", options: &["rough", "scene"], when: &[With("no_refine")] },
    Idle { command: "simulate-scenes", options: &["unit", "store"], when: &[Without("objects")] },
    Idle {
        command: "teach",
        options: &["depth", "depth_scale", "camera", "ruler", "no_board", "length", "ends", "mesh", "unit", "hull_only"],
        when: &[Without("photographs")],
    },
    Idle { command: "train pix2pose", options: &["split"], when: &[Without("dataset")] },
    Idle { command: "train pix2pose", options: &["unit", "store"], when: &[Without("objects")] },
    Idle { command: "train pix2pose", options: &["no_adversarial"], when: &[Is("network", &["compact"])] },
    // Without a preset, the network is the compact one.
    Idle { command: "train pix2pose", options: &["no_adversarial"], when: &[Without("network"), Without("preset")] },
    Idle { command: "train detector", options: &["split"], when: &[Without("dataset")] },
    Idle { command: "train detector", options: &["unit", "store"], when: &[Without("objects")] },
    Idle { command: "grasp propose", options: &["weights"], when: &[Without("experiences")] },
    Idle { command: "grasp propose", options: &["rgb"], when: &[Without("out")] },
    Idle { command: "grasp try", options: &["approach", "closing"], when: &[With("grasp")] },
    Idle { command: "grasp learn", options: &["unit", "store"], when: &[Without("objects")] },
];

#[cfg(all(test, feature = "experience", feature = "physics"))]
mod tests {
    use clap::CommandFactory;

    use super::*;
    use crate::arguments::Arguments;

    #[test]
    fn the_table_names_options_that_there_are() {
        assert_eq!(IDLE.iter().find_map(|idle| idle.unknown(&Arguments::command())), None);
    }
}
