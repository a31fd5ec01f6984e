//! `sixfold reproduce auto`.

use sixfold_auto::NAMES;

use crate::support::*;

#[test]
fn probabilities_are_fitted_checked_and_kept() {
    let tiny = Tiny::new(true);
    let dir = tiny.path();
    let fit =
        "reproduce auto --dataset tiny --given depth --without-views --fit fitted.json --out fit --json";
    let fitted = sixfold(dir, fit).expect(0).json();
    let row = &fitted["rows"][0];
    assert_eq!((fitted["rows"].as_array().unwrap().len(), &row["given"]), (1, &"depth".into()));
    assert!(row["present"].as_u64().unwrap() > 1 && row["found"].as_f64().unwrap() > 0.6, "{row}");
    let poses: u64 = row["bins"].as_array().unwrap().iter().map(|b| b["poses"].as_u64().unwrap()).sum();
    assert!(poses >= row["present"].as_u64().unwrap() / 2, "{row}");
    for file in ["table.md", "reproduce.json", "reliability.png"] {
        assert!(dir.join("fit").join(file).is_file(), "{file}");
    }
    // Stored images are not searched again, so the times are the same.
    assert_eq!(sixfold(dir, fit).expect(0).json(), fitted);

    // With the fitted file, and with an object that no image shows.
    let mesh = tiny.file("models/obj_000001.ply");
    std::fs::copy(mesh, dir.join("stranger.ply")).unwrap();
    let check =
        "reproduce auto --dataset tiny --given depth --without-views --strangers stranger.ply --unit mm";
    let checked =
        sixfold(dir, &format!("{check} --calibration fitted.json --out check --json")).expect(0).json();
    assert!(checked["rows"][0]["absent"].as_u64().unwrap() > 0, "{checked}");
    assert_eq!(checked["rows"][0]["present"], row["present"]);
    // The stranger is a copy of an object that the images show: where both are reported, one pose has the other's pixels.
    let reported =
        |row: &serde_json::Value| row["kept"].as_f64().unwrap() + row["accepted"].as_f64().unwrap();
    let alone = &checked["rows"][0];
    assert!(reported(&alone["at_once"]) < reported(alone), "{alone}");

    // With exact meshes and with wrong ones: every object is searched twice.
    let twice = sixfold(dir, &fit.replace("--out fit ", "--mesh-error 0 0.1 --out twice ")).expect(0).json();
    let twice = &twice["rows"][0];
    assert_eq!(twice["present"].as_u64().unwrap(), 2 * row["present"].as_u64().unwrap());
    let total = NAMES.iter().position(|name| *name == "total").unwrap();
    let mut agreement = [0.0; 2];
    for row in std::fs::read_dir(dir.join("twice/rows")).unwrap().map(Result::unwrap) {
        let wrong = row.file_name().to_string_lossy().starts_with("0-error1-");
        let searches: serde_json::Value =
            serde_json::from_str(&std::fs::read_to_string(row.path()).unwrap()).unwrap();
        for search in searches.as_array().unwrap() {
            agreement[usize::from(wrong)] += search["poses"][0]["numbers"][total].as_f64().unwrap();
        }
    }
    assert!(agreement[1] < agreement[0] - 0.1, "{agreement:?}");
    fails(dir, &format!("{fit} --mesh-error 0.5"), &["--mesh-error", "0 to 0.1"]);

    fails(dir, &format!("{check} --calibration none.json --out x"), &["none.json"]);
    std::fs::write(dir.join("broken.json"), "{}").unwrap();
    fails(dir, &format!("{check} --calibration broken.json --out y"), &["broken.json", "--fit"]);
    fails(dir, &check.replace(" --unit mm", " --out z"), &["--unit"]);
    fails(dir, &fit.replace("--given depth", "--given depth --seed 5"), &["fit", "other inputs", "seed"]);
}
