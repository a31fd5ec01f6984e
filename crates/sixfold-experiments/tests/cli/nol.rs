//! `sixfold reproduce nol`.

use crate::support::*;

#[test]
fn the_tables_of_neural_object_learning_are_made_and_kept() {
    let tiny = Tiny::coloured();
    let dir = tiny.path();
    std::fs::write(dir.join("frames.json"), r#"[{"scene_id": 7, "im_id": 0}, {"scene_id": 7, "im_id": 11}]"#)
        .unwrap();
    let reproduce = "reproduce nol --dataset tiny --frames frames.json --quick --json --out reproduced";
    let whole = sixfold(dir, reproduce).expect(0).json();
    let poses = whole["poses"].as_array().unwrap();
    // The disturbed poses, the published rule without a network, three of ours, and one started at the annotated poses.
    assert_eq!(poses.len(), 6, "{whole}");
    let of = |k: usize, field: &str| poses[k]["all"][field].as_f64().unwrap();
    assert!(of(5, "millimetres") < of(4, "millimetres") && poses[5]["all"]["improved"].is_null(), "{whole}");
    // The same disturbances on rendered frames, with other light and backgrounds.
    let drawn = whole["drawn_poses"].as_array().unwrap();
    let of_rendered = |k: usize| drawn[k]["all"]["millimetres"].as_f64().unwrap();
    assert_eq!(of_rendered(0), of(0, "millimetres"), "{whole}");
    assert!(of_rendered(4) < of_rendered(0) && of_rendered(4) != of(4, "millimetres"), "{whole}");
    assert_eq!(of(0, "sources"), 4.0);
    assert!(of(0, "millimetres") > 2.0 && of(0, "degrees") > 0.5, "{whole}");
    assert!(of(4, "millimetres") < of(0, "millimetres"), "{whole}");
    assert_eq!(whole["targets_of_views"][0], 2, "{whole}");
    let views = whole["views"].as_array().unwrap();
    // Plain texturing and averaging: from three sets of poses, one of them also with contradicted pixels removed, and
    // with two wrong meshes.
    assert_eq!(views.len(), 12, "{whole}");
    for view in views {
        assert!(view["plain"]["psnr"].as_f64().unwrap() > 10.0, "{view}");
        assert!((-1.0..=1.0).contains(&view["plain"]["ssim"].as_f64().unwrap()), "{view}");
    }
    assert!(whole["speed"]["refinement"].as_f64().unwrap() > 0.0);
    let table = std::fs::read_to_string(dir.join("reproduced/table.md")).unwrap();
    assert!(table.contains("vertices 1 mm off") && table.contains("ours, both"), "{table}");
    for picture in ["views.png", "geometry.png", "drawn.png"] {
        assert!(dir.join("reproduced").join(picture).is_file(), "{picture}");
    }
    // Stored rows are not made again, and their times are kept.
    let again = sixfold(dir, reproduce).expect(0);
    assert_eq!(again.json(), whole);
    assert!(!again.stderr.contains("row "), "{}", again.stderr);
    // Without --quick the rows are kept and others are added.
    let more = sixfold(dir, &reproduce.replace(" --quick", "")).expect(0);
    assert!(more.stderr.contains("row poses-both-2") && !more.stderr.contains("row poses-both-0"));
    fails(dir, &format!("{reproduce} --seed 1"), &["reproduced", "other inputs", "seed"]);
}

#[test]
fn errors_explain_why_a_reproduction_fails() {
    let tiny = Tiny::coloured();
    let dir = tiny.path();
    let all = r#"[{"scene_id": 7, "im_id": 0}, {"scene_id": 7, "im_id": 4}, {"scene_id": 7, "im_id": 11}]"#;
    std::fs::write(dir.join("frames.json"), all).unwrap();
    let reproduce = "reproduce nol --dataset tiny --frames frames.json --out reproduced";
    fails(dir, reproduce, &["3 frames to learn from", "0 others", "frames.json"]);
    fails(dir, &format!("{reproduce} --weights none.safetensors"), &["none.safetensors"]);
    fails(dir, &format!("{reproduce} --compare bare"), &["--compare", "NAME=FILE"]);
    fails(dir, &format!("{reproduce} --compare best=x.safetensors"), &["best", "taken"]);
}
