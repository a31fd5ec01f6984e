//! `--preset published`: each training for one or two steps with every network of its method, and the published form of each
//! method.

use serde_json::Value;
use sixfold_io::write_mask;
use sixfold_pix2pose::model::Pix2PoseModel;
use sixfold_render::render_depth;

use crate::support::*;

#[test]
fn pix2pose_trains_and_estimates_as_published() {
    let tiny = Tiny::coloured();
    let dir = tiny.path();
    let train = "train pix2pose --dataset tiny --ids 1 --preset published --per-object 2 --steps 2";
    for network in ["paper", "resnet50"] {
        let run = sixfold(dir, &format!("{train} --network {network} --out {network} --json")).expect(0);
        assert!(run.stderr.contains("outlier threshold, chosen on training images"), "{}", run.stderr);
        let losses = &run.json()["losses"];
        for name in ["coordinates", "error", "discriminator", "adversarial"] {
            assert!(losses[name].as_f64().is_some_and(|l| l.is_finite() && l > 0.0), "{name}: {losses}");
        }
        let model = Pix2PoseModel::load(&dir.join(network).join("model.safetensors")).unwrap();
        assert!([0.1, 0.2, 0.3].contains(&model.objects()[0].thresholds[0]));
        assert_eq!(model.objects()[0].thresholds.len(), 1);
        assert_eq!(model.card().extra["training"]["whole_mask"], true);
    }
    fails(dir, &format!("{train} --network compact --out no"), &["--preset", "published", "compact"]);
    // The compact network, trained briefly, in the published form of estimation: no pose is aligned with the image.
    sixfold(
        dir,
        "train pix2pose --dataset tiny --ids 1 --size 64 --per-object 4 --render-fraction 0 --steps 120 --out ours",
    )
    .expect(0);
    let targets =
        [0, 4, 11].map(|im| serde_json::json!({"scene_id": 7, "im_id": im, "obj_id": 1, "inst_count": 1}));
    std::fs::write(dir.join("targets.json"), Value::from(targets.to_vec()).to_string()).unwrap();
    let estimate = "estimate --method pix2pose --weights ours/model.safetensors --dataset tiny \
        --targets targets.json --boxes gt";
    sixfold(dir, &format!("{estimate} --out ours.csv")).expect(0);
    let published = sixfold(dir, &format!("{estimate} --preset published --min-score 0 --out published.csv"));
    assert!(published.code <= 1, "{}", published.stderr);
    let rows = |file: &str| std::fs::read_to_string(dir.join(file)).unwrap();
    assert_ne!(rows("ours.csv"), rows("published.csv"));
    let passes = format!("{estimate} --preset published --passes 2 --out no.csv");
    fails(dir, &passes, &["--passes", "--preset"]);
}

#[test]
fn a_detector_trains_as_published() {
    let tiny = Tiny::coloured();
    let train = "train detector --dataset tiny --preset published --size 128 --batch 1 --steps 1 --json";
    for network in ["retinanet", "compact"] {
        let run = sixfold(tiny.path(), &format!("{train} --network {network} --out {network}")).expect(0);
        assert!(run.json()["losses"]["boxes"].as_f64().is_some_and(f64::is_finite), "{}", run.stdout);
        assert!(tiny.path().join(network).join("model.safetensors").exists());
    }
}

#[test]
fn nol_trains_with_every_loss_of_table_4_6() {
    let dir = tempfile::tempdir().unwrap();
    for loss in ["l1", "image", "smooth", "gan"] {
        let train = format!("train nol --network compact --loss {loss} --steps 1 --out {loss} --json");
        let losses = sixfold(dir.path(), &train).expect(0).json()["losses"].clone();
        assert!(losses["colours"].as_f64().is_some_and(|l| l > 0.0), "{losses}");
        assert_eq!(losses["adversarial"].is_null(), loss != "gan", "{losses}");
    }
}

#[test]
fn nol_trains_as_published() {
    let dir = tempfile::tempdir().unwrap();
    let run = sixfold(dir.path(), "train nol --preset published --steps 1 --out nol --json").expect(0);
    assert!(run.json()["losses"]["features"].as_f64().is_some_and(|l| l > 0.0), "{}", run.stdout);
    let card = sixfold_nn::weights::read_card(&dir.path().join("nol/model.safetensors")).unwrap();
    let batch = &card.extra["training"]["batch"];
    assert_eq!((&batch["min_sources"], &batch["max_sources"]), (&8.into(), &8.into()), "{batch}");
}

#[test]
fn views_are_made_as_published() {
    let tiny = Tiny::coloured();
    let few = "synthesize --dataset tiny --step 90 --elevation 30,30 --size 64 --weighting average --preset published --json";
    let json = sixfold(tiny.path(), &format!("{few} --out new")).expect(0).json();
    for object in json["objects"].as_array().unwrap() {
        // Four directions with seven rotations in the image plane each, and photographs from cameras that are apart.
        assert_eq!(object["images"], 28, "{object}");
        assert!((1..=3).contains(&object["photographs"].as_u64().unwrap()), "{object}");
    }
    let poses: Value =
        serde_json::from_slice(&std::fs::read(tiny.path().join("new/poses.json")).unwrap()).unwrap();
    assert_eq!(poses["refined"], true);
    let one =
        sixfold(tiny.path(), &format!("{few} --rotations 1 --select surface --out one")).expect(0).json();
    assert!(one["objects"].as_array().unwrap().iter().all(|o| o["images"] == 4), "{one}");
}

#[cfg(feature = "physics")]
#[test]
fn mttm_trains_and_estimates_as_published() {
    let case = OneImage::new();
    let dir = case.path();
    let train =
        "train mttm --preset published --steps 1 --anchors 2 --objects 16 --scenes 4 --out mttm --json";
    let losses = sixfold(dir, train).expect(0).json()["losses"].clone();
    assert!(losses["mask"].as_f64().is_some_and(f64::is_finite), "{losses}");
    // With the shipped network: its masks are those of the estimate before alignment.
    let estimate = "estimate --method mttm --preset published --depth depth.png --camera camera.json \
        --object part.ply --unit mm --min-score 0 --json";
    let run = sixfold(dir, &format!("{estimate} --out out")).expect(0).json();
    assert_eq!(run["poses"].as_array().unwrap().len(), 1, "{run}");
    assert!(dir.join("out/masks/1-part-1.png").is_file());
    fails(dir, &format!("{estimate} --matcher points"), &["--matcher", "--preset"]);
}

#[cfg(feature = "experience")]
#[test]
fn dgcm_trains_and_proposes_as_published() {
    let case = OneImage::new();
    let dir = case.path();
    let train = "train dgcm --preset published --steps 1 --pairs 2 --views 64 --out dgcm --json";
    let losses = sixfold(dir, train).expect(0).json()["losses"].clone();
    assert!(losses["coordinates"].as_f64().is_some_and(f64::is_finite), "{losses}");
    let alone = render_depth(&part(), &case.truth, &camera());
    write_mask(&dir.join("mask.png"), &alone.map(|&z| z > 0.0)).unwrap();
    let view = "grasp propose --depth depth.png --camera camera.json --mask mask.png";
    sixfold(dir, &format!("{view} --out out")).expect(0);
    let weights = concat!(env!("CARGO_MANIFEST_DIR"), "/../../weights/dgcm.safetensors");
    let add =
        "grasp store add e.db --depth depth.png --camera camera.json --mask mask.png --grasp out/grasps.json";
    sixfold(dir, &format!("{add} --object part --weights {weights}")).expect(0);
    let with = format!("{view} --experiences e.db --weights {weights} --json");
    let grasps = |preset: &str| {
        let run = sixfold(dir, &format!("{with} --preset {preset}"));
        assert!(run.code <= 1, "{}", run.stderr);
        run.json()
    };
    let (network, both) = (grasps("published"), grasps("published-combined"));
    assert_eq!(network["method"], "dgcm as published");
    assert_eq!(both["method"], "antipodal and dgcm as published");
    let kinds = |json: &Value| -> Vec<String> {
        let kind = |g: &Value| g["experience"]["kind"].as_str().unwrap().to_owned();
        json["grasps"].as_array().unwrap().iter().map(kind).collect()
    };
    assert!(!kinds(&network).is_empty() && kinds(&network).iter().all(|k| k == "experience"), "{network}");
    assert!(!kinds(&both).is_empty() && kinds(&both).iter().all(|k| k == "geometry"), "{both}");
    for grasp in network["grasps"].as_array().unwrap() {
        assert_eq!(grasp["experience"]["hypothesis"], "scaled", "{grasp}");
    }
    fails(dir, &format!("{view} --preset published"), &["--experiences"]);
    // With the planner that the dissertation combines it with.
    let combined = grasps("published-combined --planner gpd");
    assert_eq!(combined["method"], "gpd and dgcm as published");
    assert!(!kinds(&combined).is_empty() && kinds(&combined).iter().all(|k| k == "geometry"), "{combined}");
    fails(dir, &format!("{with} --planner gpd"), &["--planner gpd", "--preset published-combined"]);
}

/// Section 6.3.2: GPD until experience is near enough, then DGCM-Net alone.
#[cfg(feature = "physics")]
#[test]
fn a_hand_learns_as_published() {
    let case = OneImage::new();
    let dir = case.path();
    let weights = concat!(env!("CARGO_MANIFEST_DIR"), "/../../weights/dgcm.safetensors");
    let learn = |store: &str, options: &str| {
        let learn = format!(
            "grasp learn --experiences {store}.db --object part.ply --unit mm --attempts 4 --seed 1 --weights {weights} {options} \
             --out {store} --json"
        );
        let whole = sixfold(dir, &learn).expect(0).json();
        let tried = sixfold(dir, &format!("grasp store list {store}.db --attempts --json")).expect(0).json();
        let tried = tried.as_array().unwrap().clone();
        (whole["objects"][0]["from_experience"].clone(), tried)
    };
    let transferred = |tried: &[Value]| -> Value { tried.iter().map(|t| t["transferred"].clone()).collect() };
    let first = |tried: &[Value]| tried[0]["description"].clone();
    let (by_experience, tried) = learn("published", "--preset published --near 9");
    let switched = by_experience.as_array().unwrap();
    assert!(switched[0] == false && switched[3] == true, "{switched:?}");
    assert_eq!(transferred(&tried), by_experience);
    // Never near enough: the planner alone, which is not ours.
    let (by_experience, planned) = learn("planned", "--preset published --near 0");
    assert_eq!(by_experience, serde_json::json!([false, false, false, false]));
    assert_eq!((transferred(&planned), first(&planned)), (by_experience, first(&tried)));
    let (_, ours) = learn("ours", "--near 9");
    assert_ne!(first(&ours), first(&tried));
    // A run is not continued in the other form.
    let other = format!(
        "grasp learn --experiences ours.db --object part.ply --unit mm --attempts 4 --seed 1 --weights {weights} --near 9 \
         --preset published --out ours"
    );
    fails(dir, &other, &["attempts.jsonl", "other options"]);
}
