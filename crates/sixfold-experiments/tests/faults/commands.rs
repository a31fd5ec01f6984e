//! The table: commands of `sixfold-experiments` that write, on the smallest inputs they accept.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use crate::driver::{copy, kept};
use crate::made;
use crate::support::{OneImage, Tiny};

/// The mesh of one object.
fn mesh(folder: &Path) {
    static CASE: LazyLock<PathBuf> = LazyLock::new(|| {
        let case = OneImage::new();
        let folder = kept("mesh");
        fs::copy(case.path().join("part.ply"), folder.join("part.ply")).unwrap();
        folder
    });
    copy(&CASE, folder);
}

/// A dataset `tiny` of which one image is scored.
fn dataset(folder: &Path) {
    static CASE: LazyLock<PathBuf> = LazyLock::new(|| {
        let tiny = Tiny::coloured();
        let targets = serde_json::json!([{"scene_id": 7, "im_id": 4, "obj_id": 1, "inst_count": 1}]);
        fs::write(tiny.file("test_targets_bop19.json"), targets.to_string()).unwrap();
        let folder = kept("dataset");
        copy(tiny.path(), &folder);
        folder
    });
    copy(&CASE, folder);
}

/// The mesh, a store of experiences with it, and the network.
fn experiences(folder: &Path) {
    static CASE: LazyLock<PathBuf> = LazyLock::new(|| {
        let folder = kept("experiences");
        mesh(&folder);
        made::experiences(&folder);
        fs::remove_dir_all(folder.join("learn")).unwrap();
        fs::copy(made::NETWORK, folder.join("w.safetensors")).unwrap();
        folder
    });
    copy(&CASE, folder);
}

/// The dataset with a network that was trained on two of its frames, and the ground truth as published results.
fn network(folder: &Path) {
    static CASE: LazyLock<PathBuf> = LazyLock::new(|| {
        let tiny = Tiny::coloured();
        tiny.write_truth_as_results("published.csv");
        made::pix2pose(tiny.path());
        fs::copy(tiny.path().join("trained/model.safetensors"), tiny.path().join("w.safetensors")).unwrap();
        fs::remove_dir_all(tiny.path().join("trained")).unwrap();
        let folder = kept("network");
        copy(tiny.path(), &folder);
        folder
    });
    copy(&CASE, folder);
}

rows! {
    reproduce_mttm: dataset, ["out"], None, "reproduce mttm --dataset tiny --out out --no-ppf";
    grasp_measure: mesh, ["out"], None, "grasp measure --object part.ply --unit mm --trials 2 --out out";
    grasp_compare: experiences, ["out"], None,
        "grasp compare --experiences e.db --object part.ply --unit mm --trials 2 --weights w.safetensors --out out";
    reproduce_pix2pose: network, ["out"], None,
        "reproduce pix2pose --dataset tiny --frames frames.json --weights w.safetensors --published published.csv --out out";
}
