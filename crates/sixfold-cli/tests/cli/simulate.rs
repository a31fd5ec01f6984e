//! `sixfold simulate-depth`.

use sixfold_bop::BopDataset;
use sixfold_io::read_depth;

use crate::support::*;

#[test]
fn simulated_depth_can_be_estimated_on() {
    let tiny = Tiny::new(false);
    let simulate = "simulate-depth --dataset tiny --split test --out simulated";
    let json = sixfold(tiny.path(), &format!("{simulate} --json")).expect(0).json();
    assert_eq!(json["images"], 3);
    let file = "simulated/test/000007/depth/000004.png";
    let first = std::fs::read(tiny.path().join(file)).unwrap();
    let scene = BopDataset::open(&tiny.path().join("simulated"), "test").unwrap().scene(7).unwrap();
    assert_eq!(scene.image_ids(), [0, 4, 11]);

    // Near the ideal depth, but not the same: there is noise.
    sixfold(tiny.path(), "simulate-depth --dataset tiny --out ideal --sensor ideal --images 4").expect(0);
    let noisy = read_depth(&tiny.path().join(file), 1e-3).unwrap();
    let ideal = read_depth(&tiny.path().join("ideal/test/000007/depth/000004.png"), 1e-3).unwrap();
    assert!(!tiny.path().join("ideal/test/000007/depth/000000.png").exists());
    let differences: Vec<f32> = noisy
        .as_slice()
        .iter()
        .zip(ideal.as_slice())
        .filter(|(a, b)| **a > 0.0 && **b > 0.0)
        .map(|(a, b)| (a - b).abs())
        .collect();
    assert!(differences.len() > WIDTH * HEIGHT / 3);
    let near = differences.iter().filter(|d| **d < 0.01).count();
    assert!(near as f64 > 0.95 * differences.len() as f64);
    assert!(differences.iter().any(|d| *d > 5e-4));

    // Existing files are not overwritten; the same seed gives the same bytes, another seed different ones.
    fails(tiny.path(), simulate, &["simulated", "exists"]);
    for (seed, same) in [(0, true), (3, false)] {
        let out = format!("again{seed}");
        sixfold(tiny.path(), &format!("simulate-depth --dataset tiny --out {out} --seed {seed} --threads 1"))
            .expect(0);
        let again = std::fs::read(tiny.path().join(file.replace("simulated", &out))).unwrap();
        assert_eq!(again == first, same, "seed {seed}");
    }

    sixfold(tiny.path(), "estimate --dataset simulated --out results.csv").expect(0);
    let json = sixfold(tiny.path(), "eval --dataset simulated --results results.csv --json").expect(0).json();
    assert!(json["ar_mssd"].as_f64().unwrap() > 0.7, "{json}");
    assert!(json["ar_vsd"].is_f64(), "{json}");
}
