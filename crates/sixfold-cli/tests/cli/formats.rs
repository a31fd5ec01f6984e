//! Small datasets in exactly the formats of the dissertation's datasets that are not available here, run through the
//! commands of docs/published.md.

use std::path::Path;

use serde_json::{Value, json};
use sixfold_bop::{BopDataset, Estimate, read_results};
use sixfold_geometry::{Image, Pose};
use sixfold_io::{read_depth, write_rgb};
use sixfold_mesh::{Mesh, ModelInfo, ModelsInfo, PlyFormat, Unit, read_mesh, write_ply};

use crate::support::*;

/// Every pose of a dataset's split has an estimate within 5 mm and 3 degrees.
fn assert_found(dataset: &Path, split: &str, results: &Path) {
    let dataset = BopDataset::open(dataset, split).unwrap();
    let results = read_results(results).unwrap();
    let mut count = 0;
    for scene_id in dataset.scene_ids() {
        let scene = dataset.scene(scene_id).unwrap();
        for im_id in scene.image_ids() {
            for truth in &scene.image(im_id).unwrap().ground_truth {
                let found = results
                    .iter()
                    .find(|r| (r.scene_id, r.im_id, r.obj_id) == (scene_id, im_id, truth.obj_id));
                assert_near(&found.unwrap().camera_from_object, &truth.camera_from_object);
                count += 1;
            }
        }
    }
    assert_eq!(count, 6);
}

/// T-LESS in BOP's form: `test_primesense`, CAD and reconstructed models, and no folder `models`.
fn tless() -> Tiny {
    let tiny = Tiny::coloured();
    std::fs::rename(tiny.file("models"), tiny.file("models_cad")).unwrap();
    std::fs::rename(tiny.file("test"), tiny.file("test_primesense")).unwrap();
    std::fs::create_dir(tiny.file("models_reconst")).unwrap();
    let mut infos = ModelsInfo::default();
    for id in 1..=2 {
        // Reconstructions are not exact: these are two per cent larger.
        let name = format!("obj_{id:06}.ply");
        let mesh =
            read_mesh(tiny.file(&format!("models_cad/{name}")), Unit::Millimetre).unwrap().scaled(1.02);
        let file = tiny.file(&format!("models_reconst/{name}"));
        write_ply(file, &mesh, Unit::Millimetre, PlyFormat::BinaryLittleEndian).unwrap();
        infos.0.insert(id, ModelInfo::of_mesh(&mesh));
    }
    infos.write(tiny.file("models_reconst/models_info.json")).unwrap();
    tiny
}

const TLESS: &str = "--dataset tiny --split test_primesense";

/// With the quickest method: what is tested is the format.
const ESTIMATE: &str = "estimate --method ppf";

#[test]
fn tless_with_either_kind_of_models() {
    let tiny = tless();
    let dir = tiny.path();
    let estimate = |models: &str| {
        let run = format!("{ESTIMATE} {TLESS} --models {models} --targets all --out {models}.csv");
        sixfold(dir, &run).expect(0);
        let eval =
            format!("eval {TLESS} --models models_cad --preset published --results {models}.csv --json");
        sixfold(dir, &eval).expect(0).json()
    };
    assert_eq!(estimate("models_cad")["ar_vsd"], 1.0);
    assert_found(&tiny.path().join("tiny"), "test_primesense", &dir.join("models_cad.csv"));
    // The run is not resumed with other models, and their poses differ.
    let same = format!("{ESTIMATE} {TLESS} --models models_reconst --targets all --out models_cad.csv");
    fails(dir, &same, &["models_cad.csv", "other options"]);
    estimate("models_reconst");
    let poses = |file: &str| std::fs::read_to_string(dir.join(file)).unwrap();
    assert_ne!(poses("models_cad.csv"), poses("models_reconst.csv"));
    fails(
        dir,
        &format!("{ESTIMATE} {TLESS} --models models_mine --out a.csv"),
        &["--models", "models_mine", "models_cad"],
    );
    // One object alone.
    let run = sixfold(
        dir,
        &format!("{ESTIMATE} {TLESS} --models models_cad --targets all --ids 2 --out two.csv --json"),
    );
    assert_eq!(run.expect(0).json()["targets"], 3);
    let run =
        sixfold(dir, &format!("simulate-depth {TLESS} --models models_reconst --out simulated")).expect(0);
    drop(run);
    let copied = std::fs::read(dir.join("simulated/models/obj_000001.ply")).unwrap();
    assert!(copied == std::fs::read(tiny.file("models_reconst/obj_000001.ply")).unwrap());
}

/// The split of T-LESS's training images, with the test images and their annotations.
fn write_training_images(tiny: &Tiny) {
    let (from, to) = (tiny.file("test_primesense/000007"), tiny.file("train_primesense/000007"));
    std::fs::create_dir_all(to.join("depth")).unwrap();
    for folder in ["", "depth"] {
        for entry in std::fs::read_dir(from.join(folder)).unwrap().map(Result::unwrap) {
            if entry.path().is_file() {
                std::fs::copy(entry.path(), to.join(folder).join(entry.file_name())).unwrap();
            }
        }
    }
}

/// Figures 5.7 to 5.9: templates from training images instead of rendered ones.
#[test]
fn templates_are_taken_from_the_depth_images_of_another_split() {
    let tiny = tless();
    let dir = tiny.path();
    write_training_images(&tiny);
    let estimate =
        format!("estimate --method mttm --matcher points {TLESS} --models models_cad --targets all");
    let images = format!("{estimate} --template-images train_primesense --templates-only");
    sixfold(dir, &format!("{images} --out images.csv")).expect(0);
    assert_found(&tiny.path().join("tiny"), "test_primesense", &dir.join("images.csv"));
    let rendered = format!("{estimate} --templates-only --ids 1 --out rendered.csv");
    sixfold(dir, &rendered).expect(0);
    let of_image = read_results(&dir.join("images.csv")).unwrap();
    let of_mesh = read_results(&dir.join("rendered.csv")).unwrap();
    let first = |all: &[Estimate]| all.iter().find(|e| e.obj_id == 1).unwrap().camera_from_object;
    assert_ne!(first(&of_image).to_matrix(), first(&of_mesh).to_matrix());
    // The poses are those of the images' annotations: rotated ones there give rotated poses here.
    let rotated = Pose::exp(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.2].into());
    let truth = tiny.file("train_primesense/000007/scene_gt.json");
    let mut annotated: Value = serde_json::from_slice(&std::fs::read(&truth).unwrap()).unwrap();
    for (im_id, _) in &tiny.truth {
        let pose = tiny.truth_of(*im_id, 1) * rotated;
        let matrix = pose.to_matrix();
        let rows: Vec<f64> = (0..9).map(|k| matrix[(k / 3, k % 3)]).collect();
        annotated[im_id.to_string()][0]["cam_R_m2c"] = rows.into();
    }
    std::fs::write(&truth, annotated.to_string()).unwrap();
    fails(dir, &format!("{images} --out images.csv"), &["set of given templates of object 1", "images.csv"]);
    sixfold(dir, &format!("{images} --ids 1 --out rotated.csv")).expect(0);
    let found = read_results(&dir.join("rotated.csv")).unwrap();
    assert_eq!(found.len(), 3);
    for e in found {
        assert_near(&e.camera_from_object, &(tiny.truth_of(e.im_id, 1) * rotated));
    }
    // Images that are searched themselves, or that show an object too little.
    let same = format!("{estimate} --template-images test_primesense --out a.csv");
    fails(dir, &same, &["--template-images test_primesense", "--template-frames"]);
    fails(
        dir,
        &format!("{estimate} --template-images train --out a.csv"),
        &["tiny/train", "split is missing"],
    );
    let frames = r#"[{"scene_id": 7, "im_id": 5}]"#;
    std::fs::write(dir.join("frames.json"), frames).unwrap();
    fails(dir, &format!("{images} --template-frames frames.json --out a.csv"), &["5", "000007"]);
    std::fs::remove_file(tiny.file("train_primesense/000007/depth/000004.png")).unwrap();
    fails(dir, &format!("{images} --out a.csv"), &["7/4", "no depth image", "simulate-depth"]);
}

#[cfg(feature = "networks")]
#[test]
fn tless_networks_learn_from_cad_models() {
    let tiny = tless();
    let dir = tiny.path();
    let train = |models: &str| {
        format!(
            "train pix2pose --preset tless --network compact {TLESS} --models {models} --ids 1 --steps 1 --size 32 \
             --per-object 2 --out trained"
        )
    };
    sixfold(dir, &train("models_cad")).expect(0);
    fails(dir, &train("models_reconst"), &["trained", "mesh of object 1 was"]);
    let estimate = format!(
        "estimate --method pix2pose --preset published --weights trained/model.safetensors {TLESS} --models models_cad \
         --targets all --ids 1 --boxes gt --out pix2pose.csv"
    );
    let status = sixfold(dir, &estimate);
    // One training step is not enough to find anything: only check that it runs.
    assert!(matches!(status.code, 0 | 1), "{}", status.stderr);
}

/// SMOT in its own format, made of the scene of a BOP dataset.
fn write_smot(tiny: &Tiny, source: &Path) {
    let sequence = source.join("test/seq7");
    for folder in [sequence.join("color"), sequence.join("depth"), source.join("models")] {
        std::fs::create_dir_all(folder).unwrap();
    }
    let c = camera();
    // Column by column.
    let k = [c.fx, 0.0, 0.0, 0.0, c.fy, 0.0, c.cx, c.cy, 1.0];
    let intrinsics = json!({ "width": c.width, "height": c.height, "intrinsic_matrix": k });
    std::fs::write(source.join("camera_intrinsic.json"), intrinsics.to_string()).unwrap();
    let mut truth = serde_json::Map::new();
    for (im_id, here) in &tiny.truth {
        let name = format!("{im_id:06}.png");
        std::fs::copy(tiny.file(&format!("test/000007/rgb/{name}")), sequence.join("color").join(&name))
            .unwrap();
        let depth = read_depth(&tiny.file(&format!("test/000007/depth/{name}")), DEPTH_SCALE).unwrap();
        sixfold_io::write_depth(&sequence.join("depth").join(&name), &depth, 1e-3).unwrap();
        let entries = here.iter().map(|g| {
            let (r, t) = (g.camera_from_object.rotation_matrix(), g.camera_from_object.translation());
            json!({ "cam_R_m2c": r.transpose().as_slice(), "cam_t_m2c": t.as_slice(), "obj_id": g.obj_id.to_string() })
        });
        truth.insert(im_id.to_string(), entries.collect::<Value>());
    }
    std::fs::write(sequence.join("scene_gt.json"), Value::Object(truth).to_string()).unwrap();
    for id in 1..=2 {
        let mesh = read_mesh(tiny.file(&format!("models/obj_{id:06}.ply")), Unit::Millimetre).unwrap();
        write_ply(source.join(format!("models/obj_{id:02}.ply")), &mesh, Unit::Metre, PlyFormat::Ascii)
            .unwrap();
    }
}

#[test]
fn smot_is_converted_searched_and_scored() {
    let tiny = Tiny::coloured();
    let dir = tiny.path();
    write_smot(&tiny, &dir.join("SMOT"));
    let import = "import smot SMOT --split test --out smot";
    let json = sixfold(dir, &format!("{import} --json")).expect(0).json();
    assert_eq!((&json["images"], &json["objects"]), (&3.into(), &json!([1, 2])));
    // Table 4.2: the sides that the images show.
    let elevations = tiny.truth.iter().map(|(im_id, _)| {
        let camera = tiny.truth_of(*im_id, 2).inverse().translation();
        (camera.z / camera.norm()).asin().to_degrees()
    });
    let lowest = elevations.fold(f64::INFINITY, f64::min);
    let views = &json["views"]["2"];
    assert_eq!(views["images"], 3);
    assert!((views["elevation"][0].as_f64().unwrap() - lowest).abs() < 1e-6, "{views} {lowest}");
    sixfold(dir, &format!("{ESTIMATE} --dataset smot --out smot.csv")).expect(0);
    assert_found(&dir.join("smot"), "test", &dir.join("smot.csv"));
    for (im_id, here) in &tiny.truth {
        let scene = BopDataset::open(&dir.join("smot"), "test").unwrap().scene(7).unwrap();
        let found = scene.image(*im_id).unwrap().ground_truth[0].camera_from_object;
        assert!(found.distance_to(&here[0].camera_from_object) < 1e-9);
    }
    let scores = sixfold(dir, "eval --dataset smot --results smot.csv --json").expect(0).json();
    assert_eq!(scores["add_s_recall"]["mean"], 1.0, "{scores}");
    fails(dir, import, &["smot", "exists already", "--out"]);
    fails(dir, "import smot SMOT --out other", &["train", "missing"]);
}

/// A dictionary as Python 2 pickles it with its first protocol, with arrays of 64 bit numbers.
fn pickled(name: &str, arrays: &[(&str, &[usize], Vec<f64>)]) -> String {
    let mut text = format!("(dp0\nS'objName'\np1\nS'{name}'\np2\ns");
    for (key, shape, values) in arrays {
        let shape: String = shape.iter().map(|side| format!("I{side}\n")).collect();
        let bytes: String =
            values.iter().flat_map(|v| v.to_le_bytes()).map(|b| format!("\\x{b:02x}")).collect();
        text += &format!(
            "S'{key}'\ncnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR(I1\n({shape}t\
             cnumpy\ndtype\n(S'f8'\nI0\nI1\ntR(I3\nS'<'\nNNNI-1\nI-1\nI0\ntbI00\nS'{bytes}'\ntbs"
        );
    }
    text + "."
}

/// HO-3D in its own format, made of the first object of a BOP dataset's scene.
fn write_ho3d(tiny: &Tiny, source: &Path, models: &Path) {
    let sequence = source.join("train/ABF10");
    for folder in
        [sequence.join("rgb"), sequence.join("depth"), sequence.join("meta"), models.join("035_power_drill")]
    {
        std::fs::create_dir_all(folder).unwrap();
    }
    let c = camera();
    for (im_id, here) in &tiny.truth {
        let name = format!("{im_id:04}");
        let of_bop = |folder: &str| tiny.file(&format!("test/000007/{folder}/{im_id:06}.png"));
        std::fs::copy(of_bop("rgb"), sequence.join(format!("rgb/{name}.png"))).unwrap();
        let depth = read_depth(&of_bop("depth"), DEPTH_SCALE).unwrap();
        let spread = Image::from_fn(c.width, c.height, |x, y| {
            let units = (f64::from(depth[(x, y)]) / 0.000_124_986_647_279_001_77).round() as u32;
            [(units % 256) as u8, (units / 256) as u8, 0]
        });
        write_rgb(&sequence.join(format!("depth/{name}.png")), &spread).unwrap();
        // OpenGL's camera: y up, z back.
        let pose: Pose = here[0].camera_from_object;
        let (axis, t) = (pose.rotation_matrix(), pose.translation());
        let rotated =
            sixfold_geometry::Mat3::from_fn(|i, j| if i == 0 { axis[(i, j)] } else { -axis[(i, j)] });
        let vector = Pose::from_parts(&rotated, t).unwrap().rotation().scaled_axis();
        let arrays: [(&str, &[usize], Vec<f64>); 3] = [
            ("objRot", &[3, 1], vector.as_slice().to_vec()),
            ("objTrans", &[3], vec![t.x, -t.y, -t.z]),
            ("camMat", &[3, 3], vec![c.fx, 0.0, c.cx, 0.0, c.fy, c.cy, 0.0, 0.0, 1.0]),
        ];
        std::fs::write(sequence.join(format!("meta/{name}.pkl")), pickled("035_power_drill", &arrays))
            .unwrap();
    }
    let mesh: Mesh = read_mesh(tiny.file("models/obj_000001.ply"), Unit::Millimetre).unwrap();
    let mut obj = String::new();
    mesh.vertices().iter().for_each(|v| obj += &format!("v {} {} {}\n", v.x, v.y, v.z));
    mesh.faces().iter().for_each(|f| obj += &format!("f {} {} {}\n", f[0] + 1, f[1] + 1, f[2] + 1));
    std::fs::write(models.join("035_power_drill/textured_simple.obj"), obj).unwrap();
}

#[test]
fn ho3d_is_converted_searched_and_scored() {
    let tiny = Tiny::coloured();
    let dir = tiny.path();
    write_ho3d(&tiny, &dir.join("HO3D"), &dir.join("ycb"));
    let json = sixfold(dir, "import ho3d HO3D --models ycb --out ho3d --json").expect(0).json();
    assert_eq!((&json["images"], &json["objects"]), (&3.into(), &json!([35])));
    sixfold(dir, &format!("{ESTIMATE} --dataset ho3d --split train --out ho3d.csv")).expect(0);
    let results = read_results(&dir.join("ho3d.csv")).unwrap();
    assert_eq!(results.len(), 3);
    for r in results {
        assert_near(&r.camera_from_object, &tiny.truth_of(r.im_id, 1));
    }
    let scores = sixfold(dir, "eval --dataset ho3d --split train --results ho3d.csv --json").expect(0).json();
    assert_eq!(scores["add_s_recall"]["mean"], 1.0, "{scores}");
    let every =
        sixfold(dir, "import ho3d HO3D --models ycb --every 2 --sequences ABF10 --out two --json").expect(0);
    assert_eq!(every.json()["images"], 2);
    fails(dir, "import ho3d HO3D --models ycb --every 0 --out three", &["--every"]);
    fails(dir, "import ho3d HO3D --models nowhere --out four", &["035_power_drill", "YCB-Video"]);
}

#[test]
fn source_images_of_nol_are_converted() {
    let dir = tempfile::tempdir().unwrap();
    let file =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../sixfold-bop/tests/fixtures/import/nol_obj_07.hdf5");
    if !file.is_file() {
        eprintln!("skipped: {} is not there", file.display());
        return;
    }
    std::fs::copy(file, dir.path().join("obj_07.hdf5")).unwrap();
    let camera = r#"{"width": 64, "height": 48, "cam_K": [60, 0, 31.5, 0, 62, 23.5, 0, 0, 0]}"#;
    std::fs::write(dir.path().join("camera.json"), camera).unwrap();
    let import = "import nol obj_07.hdf5 --camera camera.json";
    let json = sixfold(dir.path(), &format!("{import} --out nol --json")).expect(0).json();
    assert_eq!((&json["images"], &json["objects"]), (&2.into(), &json!([7])));
    let json = sixfold(dir.path(), &format!("{import} --object-id 3 --out three --json")).expect(0).json();
    assert_eq!(json["objects"], json!([3]));
    fails(dir.path(), "import nol camera.json --camera camera.json --out no", &["camera.json", "HDF5"]);
}
