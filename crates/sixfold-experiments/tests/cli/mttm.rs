//! `sixfold reproduce mttm`.

use crate::support::*;

#[test]
fn a_reproduction_resumes() {
    let tiny = Tiny::new(true);
    let dir = tiny.path();
    let reproduce = "reproduce mttm --dataset tiny --out reproduced --json";
    let whole = sixfold(dir, reproduce).expect(0).json();
    let keys: Vec<&str> =
        whole["rows"].as_array().unwrap().iter().map(|row| row["key"].as_str().unwrap()).collect();
    for key in [
        "both",
        "both-printed-score",
        "network",
        "network-nearest",
        "network-masks",
        "network-masks-verified",
        "published",
        "published-template-pose",
        "points",
        "points-nearest",
        "ppf",
    ] {
        assert!(keys.contains(&key), "{key} of {keys:?}");
    }
    assert_eq!((keys.len(), keys[0]), (15, "both"));
    assert!(whole["rows"][0]["all"]["add_s"].as_f64().unwrap() > 0.6, "{whole}");
    assert!(whole["rows"][0]["all"]["iou"].as_f64().unwrap() > 0.6, "{whole}");
    let table = std::fs::read_to_string(dir.join("reproduced/table.md")).unwrap();
    assert!(table.contains("point pair features"), "{table}");
    // Without the predicted rotation alignment starts elsewhere, and ends at least a little elsewhere.
    let outcomes = |key: &str| {
        let files = std::fs::read_dir(dir.join("reproduced/images")).unwrap();
        let of_image = files.map(|file| {
            let text = std::fs::read(file.unwrap().path()).unwrap();
            let image: serde_json::Value = serde_json::from_slice(&text).unwrap();
            image[key].as_array().unwrap().iter().map(|o| o["error"].clone()).collect::<Vec<_>>()
        });
        of_image.collect::<Vec<_>>().concat()
    };
    let [published, template_pose] = ["published", "published-template-pose"].map(outcomes);
    assert_eq!(published.len(), template_pose.len());
    assert_ne!(published, template_pose);
    // Stored images are not measured again, so the second run gives the same times, except for the last digit, which may change
    // when numbers are read as text.
    let mut again = sixfold(dir, reproduce).expect(0).json();
    for (row, before) in
        again["rows"].as_array_mut().unwrap().iter_mut().zip(whole["rows"].as_array().unwrap())
    {
        for (seconds, before) in [0, 1].map(|i| (&row["seconds"][i], &before["seconds"][i])) {
            assert!((seconds.as_f64().unwrap() - before.as_f64().unwrap()).abs() < 1e-12, "{row} {before}");
        }
        row["seconds"] = before["seconds"].clone();
    }
    assert_eq!(again, whole);
    // Another instance of an object in the ground truth, listed last and not visible: the objects found before still count.
    let file = tiny.file("test/000007/scene_gt.json");
    let mut truth: serde_json::Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    for poses in truth.as_object_mut().unwrap().values_mut() {
        let mut other = poses[0].clone();
        other["cam_t_m2c"] = serde_json::json!([0.0, 0.0, 5000.0]);
        poses.as_array_mut().unwrap().push(other);
    }
    std::fs::write(&file, truth.to_string()).unwrap();
    std::fs::remove_file(tiny.file("test/000007/scene_gt_info.json")).ok();
    // Some rows alone have the same scores.
    let several = "reproduce mttm --dataset tiny --out several --no-ppf --rows network-masks,both --json";
    let several = sixfold(dir, several).expect(0).json();
    assert_eq!(several["rows"].as_array().unwrap().len(), 2);
    let score = |of: &serde_json::Value, key: &str, score: &str| {
        let row = of["rows"].as_array().unwrap().iter().find(|row| row["key"] == key).unwrap();
        row["all"][score].as_f64().unwrap()
    };
    for (key, of) in ["both", "network-masks"].into_iter().flat_map(|key| [(key, "add_s"), (key, "iou")]) {
        assert_eq!(score(&several, key, of), score(&whole, key, of), "{key}, {of}: {several}");
    }
    fails(dir, "reproduce mttm --dataset tiny --out reproduced --no-ppf", &["reproduced", "other inputs"]);
    fails(dir, "reproduce mttm --dataset tiny --out other --rows other", &["other", "--rows"]);
}
