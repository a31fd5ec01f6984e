//! `sixfold reproduce mttm`.

use crate::support::*;

#[test]
fn a_dataset_is_reproduced_and_it_goes_on() {
    let tiny = Tiny::new(true);
    let dir = tiny.path();
    let reproduce = "reproduce mttm --dataset tiny --out reproduced --json";
    let whole = sixfold(dir, reproduce).expect(0).json();
    let keys: Vec<&str> =
        whole["rows"].as_array().unwrap().iter().map(|row| row["key"].as_str().unwrap()).collect();
    for key in ["both", "both-printed-score", "network", "network-nearest", "points", "points-nearest", "ppf"]
    {
        assert!(keys.contains(&key), "{key} of {keys:?}");
    }
    assert_eq!((keys.len(), keys[0]), (11, "both"));
    assert!(whole["rows"][0]["all"]["add_s"].as_f64().unwrap() > 0.6, "{whole}");
    assert!(whole["rows"][0]["all"]["iou"].as_f64().unwrap() > 0.6, "{whole}");
    let table = std::fs::read_to_string(dir.join("reproduced/table.md")).unwrap();
    assert!(table.contains("point pair features"), "{table}");
    // Kept images are not measured again, so the second run gives the same times, but for the last digit, which reading
    // numbers as text may cost.
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
    fails(dir, "reproduce mttm --dataset tiny --out reproduced --no-ppf", &["reproduced", "other inputs"]);
}
