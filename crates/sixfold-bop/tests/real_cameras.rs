//! The cameras of real datasets all pass the checks that refuse impossible ones: those of the sample frames, and of the available
//! datasets.

mod support;

use std::path::{Path, PathBuf};

use sixfold_bop::BopDataset;
use sixfold_io::CameraFile;

/// Files of this name below a folder.
fn below(folder: &Path, name: &str, depth: usize, found: &mut Vec<PathBuf>) {
    let Ok(entries) = std::fs::read_dir(folder) else { return };
    for path in entries.flatten().map(|entry| entry.path()) {
        if path.is_dir() && depth > 0 {
            below(&path, name, depth - 1, found);
        } else if path.file_name().is_some_and(|n| n == name) {
            found.push(path);
        }
    }
}

#[test]
fn the_cameras_of_real_datasets_pass() {
    let mut folders = vec![PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../data/demo"))];
    folders.extend(support::data(""));
    for folder in folders {
        let mut files = vec![];
        below(&folder, "camera.json", 3, &mut files);
        for file in files {
            let read = CameraFile::read(&file).unwrap();
            let (width, height) =
                if read.sized { (read.camera.width, read.camera.height) } else { (640, 480) };
            read.for_image(width, height, &file).unwrap();
        }
        let mut scenes = vec![];
        below(&folder, "scene_camera.json", 3, &mut scenes);
        for file in scenes {
            let dataset = BopDataset::open(file.parent().unwrap(), "test").unwrap();
            for scene in dataset.scene_ids().into_iter().map(|id| dataset.scene(id).unwrap()) {
                for camera in scene.image_ids().into_iter().map(|id| scene.camera(id).unwrap()) {
                    camera.check_whole_image().unwrap();
                }
            }
        }
    }
}
