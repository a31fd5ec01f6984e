//! `sixfold teach --train`: a network of an object's own, from its photographs to a pose.

use sixfold_pix2pose::model::Pix2PoseModel;

use crate::support::*;

const TEACH: &str =
    "teach part --photographs photographs.json --hull-only --train --train-steps 2 --view-step 90 --json";
const WEIGHTS: &str = "sixfold-objects/part/pix2pose.safetensors";
const IMAGE: &str = "--rgb tiny/test/000007/rgb/000004.png --camera tiny/camera.json --box 60,70,110,110";

/// The only folder whose name begins so.
fn only(folder: &std::path::Path, begins: &str) -> std::path::PathBuf {
    let all = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let begins = |path: &std::path::PathBuf| path.file_name().unwrap().to_str().unwrap().starts_with(begins);
    let found: Vec<_> = all.filter(begins).collect();
    assert_eq!(found.len(), 1, "{found:?}");
    found[0].clone()
}

#[test]
fn a_taught_object_gets_weights_of_its_own() {
    let tiny = Tiny::coloured();
    let dir = tiny.path();
    write_posed_photographs(&tiny);
    let taught = sixfold(dir, TEACH).expect(0).json();
    let trained = &taught["trained"];
    assert_eq!((&taught["name"], &taught["photographs"]), (&"part".into(), &3.into()), "{taught}");
    assert_eq!(
        (&trained["steps"], &trained["synthesized"], &trained["photographs"]),
        (&2.into(), &4.into(), &3.into())
    );
    assert_eq!(trained["weights"], WEIGHTS);
    assert!(
        trained["seconds"]["views"].as_f64().unwrap() > 0.0
            && trained["seconds"]["training"].as_f64().unwrap() > 0.0
    );
    // The weights know the mesh of the record.
    let model = Pix2PoseModel::load(&dir.join(WEIGHTS)).unwrap();
    let mesh = sixfold_mesh::read_mesh(dir.join("sixfold-objects/part/mesh.ply"), sixfold_mesh::Unit::Metre)
        .unwrap();
    assert_eq!(model.objects()[0].check_mesh(&mesh), Ok(()));
    assert!(model.card().data.contains("object part: 4 views"), "{}", model.card().data);

    // Nothing is left to do, with the photographs and without them.
    let before = std::fs::read(dir.join(WEIGHTS)).unwrap();
    let own = TEACH.replace("--photographs photographs.json --hull-only ", "");
    for command in [TEACH, &own] {
        let again = sixfold(dir, command).expect(0).json();
        assert_eq!(
            (&again["trained"]["seconds"], &again["trained"]["steps"]),
            (&serde_json::Value::Null, &2.into())
        );
    }
    // Lost weights: those of the finished training again, with the views that are there.
    std::fs::remove_file(dir.join(WEIGHTS)).unwrap();
    let views = only(&only(&dir.join("out/teach/part"), "training-"), "views-90");
    let view = views.join("train_nol/000001/coordinates/000000.png");
    let made = std::fs::metadata(&view).unwrap().modified().unwrap();
    let again = sixfold(dir, &own).expect(0).json();
    assert!(again["trained"]["seconds"]["views"].is_number() && again["photographs"].is_null(), "{again}");
    assert!(std::fs::read(dir.join(WEIGHTS)).unwrap() == before, "other weights");
    assert_eq!(std::fs::metadata(&view).unwrap().modified().unwrap(), made);
    // Weights of another training are kept, until they are to be replaced.
    fails(
        dir,
        &own.replace("--train-steps 2", "--train-steps 3"),
        &["pix2pose.safetensors", "2 steps", "--replace"],
    );
    let three = format!("{} --replace", own.replace("--train-steps 2", "--train-steps 3"));
    assert_eq!(sixfold(dir, &three).expect(0).json()["trained"]["steps"], 3);
    fails(dir, &TEACH.replace("--train --train-steps 2 --view-step 90 ", ""), &["\"part\"", "--replace"]);

    // They are found without --weights: two steps teach nothing, but the method answers.
    let run = sixfold(dir, &format!("estimate --method pix2pose --object part {IMAGE} --min-score 0 --json"));
    assert!(run.code < 2, "{}", run.stderr);
    // `auto` asks the method for objects with weights alone.
    std::fs::write(dir.join(WEIGHTS), "no weights").unwrap();
    sixfold(dir, "object add other tiny/models/obj_000002.ply --unit mm").expect(0);
    let auto =
        |object: &str| sixfold(dir, &format!("estimate --object {object} {IMAGE} --min-score 0")).stderr;
    let (with, without) = (auto("part"), auto("other"));
    assert!(
        with.contains("--method pix2pose was not asked") && with.contains("pix2pose.safetensors"),
        "{with}"
    );
    assert!(!without.contains("pix2pose"), "{without}");
    let other = format!("estimate --method pix2pose --object other {IMAGE}");
    fails(dir, &other, &["other", "weights of its own", "sixfold teach NAME --train", "--weights FILE"]);
    fails(dir, "teach other --train", &["other", "without photographs", "--photographs DIR --replace"]);
}

#[test]
fn trainings_of_objects_that_cannot_be() {
    let tiny = Tiny::coloured();
    let dir = tiny.path();
    fails(dir, "teach part --train", &["no object named \"part\"", "--photographs DIR"]);
    fails(dir, "teach part", &["--photographs"]);
    fails(dir, "teach ../part --train", &["letters, digits"]);
    fails(dir, "teach part --train --camera camera.json", &["--camera", "without --photographs"]);
    fails(dir, "teach part --photographs p --train-steps 5", &["--train"]);
    fails(dir, "teach part --train --train-steps 0", &["--train-steps", "1 to 1000000"]);
    fails(dir, "teach part --train --view-step 0.5", &["--view-step", "degrees from 1 to 90"]);
    fails(
        dir,
        "estimate --method pix2pose --rgb a.png --camera c.json",
        &["--weights", "sixfold teach NAME --train"],
    );
    assert!(!dir.join("sixfold-objects").exists() && !dir.join("out").exists());
}
