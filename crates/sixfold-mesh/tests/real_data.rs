//! The readers and measurements on real models, if they are available (`SIXFOLD_DATA`, or `../shared/data`
//! beside the workspace).

mod support;

use std::path::PathBuf;
use std::time::Instant;

use sixfold_mesh::{Mesh, ModelsInfo, Unit, read_mesh, simplify};

use support::data;

fn files(folder: PathBuf, ending: &str) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(&folder)
        .unwrap_or_else(|e| panic!("{}: {e}", folder.display()))
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == ending))
        .collect();
    files.sort();
    files
}

fn read(path: &PathBuf, unit: Unit) -> Mesh {
    read_mesh(path, unit).unwrap_or_else(|error| panic!("{error}"))
}

#[test]
fn bop_models_have_the_published_diameters_and_boxes() {
    let Some(data) = data() else { return };
    for dataset in ["lmo", "hope"] {
        let folder = data.join(dataset).join("models");
        let text = std::fs::read(folder.join("models_info.json")).unwrap();
        let info: serde_json::Value = serde_json::from_slice(&text).unwrap();
        let infos = ModelsInfo::parse(&text, dataset).unwrap();
        let paths = files(folder, "ply");
        assert!(paths.len() >= 8);
        for path in paths {
            let start = Instant::now();
            let mesh = read(&path, Unit::Millimetre);
            let read_time = start.elapsed();
            let id = path.file_stem().unwrap().to_str().unwrap()[4..].parse::<u32>().unwrap().to_string();
            let number = |field: &str| info[&id][field].as_f64().unwrap();
            // The boxes in HOPE's info differ from these models by up to 0.46 mm, with any tool.
            let tolerance = if dataset == "lmo" { 1e-3 } else { 0.5 };
            let start = Instant::now();
            let diameter = 1e3 * mesh.diameter();
            eprintln!(
                "{dataset} {id}: {} faces, read {read_time:?}, diameter {diameter:.6} mm in {:?}",
                mesh.faces().len(),
                start.elapsed()
            );
            assert!((diameter - number("diameter")).abs() < tolerance, "{dataset} {id}: {diameter}");
            infos.check_mesh(id.parse().unwrap(), &mesh, dataset).unwrap();
            infos.check_symmetries(id.parse().unwrap(), &mesh, dataset).unwrap();
            let (low, high) = mesh.bounding_box();
            for (axis, name) in ["x", "y", "z"].iter().enumerate() {
                assert!((1e3 * low[axis] - number(&format!("min_{name}"))).abs() < tolerance);
                assert!((1e3 * (high - low)[axis] - number(&format!("size_{name}"))).abs() < tolerance);
            }
            if dataset == "lmo" {
                assert_eq!(mesh.colors().unwrap().len(), mesh.vertices().len());
                let agree = mesh.normals().unwrap().iter().zip(computed_normals(&mesh));
                let cosine = agree.map(|(a, b)| a.dot(&b)).sum::<f64>() / mesh.vertices().len() as f64;
                assert!(cosine > 0.9, "{id}: computed normals look another way, {cosine}");
            }
        }
    }
}

fn computed_normals(mesh: &Mesh) -> Vec<sixfold_geometry::Vec3> {
    Mesh::new(mesh.vertices().to_vec(), mesh.faces().to_vec()).unwrap().vertex_normals()
}

#[test]
fn other_plys() {
    let Some(data) = data() else { return };
    for path in files(data.join("meshes/ycb"), "ply") {
        let mesh = read(&path, Unit::Millimetre);
        assert!(mesh.faces().len() > 15_000 && (0.05..0.35).contains(&mesh.diameter()), "{}", path.display());
    }
    let basket = read(&data.join("tyol_frame/obj.ply"), Unit::Millimetre);
    let points = read(&data.join("tyol_frame/obj_new.ply"), Unit::Metre);
    assert_eq!((basket.vertices().len(), basket.faces().len()), (5880, 12012));
    assert_eq!((points.vertices().len(), points.faces().len()), (5880, 0));
    let cup = read(&data.join("icbin_frames/2/model.ply"), Unit::Millimetre);
    assert_eq!((cup.vertices().len(), cup.faces().len()), (32774, 65217));
    eprintln!("{} {} {}", basket.diameter(), points.diameter(), cup.diameter());
}

#[test]
fn a_wrong_unit_is_explained() {
    let Some(data) = data() else { return };
    let error = read_mesh(data.join("lmo/models/obj_000001.ply"), Unit::Metre).unwrap_err().to_string();
    let expected =
        "the diameter would be 102 m as metres; 102 mm if the file is in millimetres: give --unit mm";
    assert!(error.contains(expected), "{error}");
}

#[test]
fn textured_objs() {
    let Some(data) = data() else { return };
    let mut count = 0;
    for (folder, unit) in [("meshes", Unit::Metre), ("hope/models_textured", Unit::Millimetre)] {
        for entry in std::fs::read_dir(data.join(folder)).unwrap() {
            let path = entry.unwrap().path().join("textured.obj");
            if !path.is_file() {
                continue;
            }
            count += 1;
            // Unlike its neighbours, this one is in centimetres.
            let unit = if path.to_string_lossy().contains("libero_mug") { Unit::Centimetre } else { unit };
            let start = Instant::now();
            let mesh = read(&path, unit);
            eprintln!(
                "{}: {} faces, {:.1} mm, {:?}",
                path.display(),
                mesh.faces().len(),
                1e3 * mesh.diameter(),
                start.elapsed()
            );
            assert!(mesh.texture().unwrap().width() >= 64);
            assert_eq!(mesh.texcoords().unwrap().len(), mesh.vertices().len());
        }
    }
    assert!(count >= 13, "{count}");
    // The textured and the plain model of HOPE are the same object in the same frame.
    let plain = read(&data.join("hope/models/obj_000002.ply"), Unit::Millimetre);
    let textured = read(&data.join("hope/models_textured/obj_000002/textured.obj"), Unit::Millimetre);
    assert!((plain.diameter() - textured.diameter()).abs() < 1e-3);
    assert!((plain.bounding_box().0 - textured.bounding_box().0).norm() < 1e-3);
}

#[test]
fn simplified_models_keep_their_size() {
    let Some(data) = data() else { return };
    for path in files(data.join("lmo/models"), "ply") {
        let mesh = read(&path, Unit::Millimetre);
        let start = Instant::now();
        let small = simplify(&mesh, 2000);
        let time = start.elapsed();
        let ratio = small.diameter() / mesh.diameter();
        let (low, high) = mesh.bounding_box();
        let (small_low, small_high) = small.bounding_box();
        eprintln!(
            "{}: {} to {} faces in {time:?}, diameter x {ratio:.5}, area x {:.4}",
            path.display(),
            mesh.faces().len(),
            small.faces().len(),
            small.surface_area() / mesh.surface_area()
        );
        assert!(small.faces().len() <= 2000);
        assert!((ratio - 1.0).abs() < 0.02);
        let off = (low - small_low).amax().max((high - small_high).amax());
        assert!(off < 0.02 * mesh.diameter(), "{off}");
        assert_eq!(small.colors().unwrap().len(), small.vertices().len());
    }
}
