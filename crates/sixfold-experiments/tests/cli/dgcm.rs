//! `sixfold reproduce dgcm`: all five parts, quickly, on one object that the test writes.

use sixfold_geometry::random::stream;
use sixfold_geometry::{Pose, Vec3};
use sixfold_grasp::gripper_pose;
use sixfold_io::write_depth;
use sixfold_mesh::{PlyFormat, Unit, write_ply};
use sixfold_synth::shapes::{Family, member};

use crate::support::*;

/// The network that comes with Sixfold.
const NETWORK: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../weights/dgcm.safetensors");

#[test]
fn the_tables_of_chapter_6_are_made_and_kept() {
    let case = OneImage::new();
    let dir = case.path();
    std::fs::write(
        dir.join("objects.json"),
        r#"[{"class": "part", "mesh": "part.ply", "unit": "mm",
             "part": {"name": "handle", "low": [-0.065, -0.045, 0.03], "high": [-0.015, 0.015, 0.115]}}]"#,
    )
    .unwrap();
    let command = format!("reproduce dgcm --list objects.json --weights {NETWORK} --quick --out out --json");
    let json = sixfold(dir, &command).expect(0).json();
    // Table 6.2: one scene for each method of choosing a grasp, including the published ones; rates of four
    // tries.
    let class = &json["compare"]["classes"][0];
    let rates: Vec<f64> = class["rates"].as_array().unwrap().iter().map(|r| r.as_f64().unwrap()).collect();
    assert_eq!((rates.len(), &class["class"]), (11, &"part".into()));
    assert!(rates.iter().all(|r| (4.0 * r).fract() == 0.0 && (0.0..=1.0).contains(r)), "{rates:?}");
    // Figure 6.7: experience of the same class and of all classes, for each number of experiences; with one
    // object they are the same.
    let curves = json["curves"].as_array().unwrap();
    assert_eq!(curves.len(), 8, "{curves:?}");
    assert!(curves.iter().all(|c| c["asked"].as_u64().unwrap() > 0), "{curves:?}");
    let near = serde_json::json!([1.0, 1.0]);
    assert!(curves.iter().all(|c| c["within"] == near), "{curves:?}");
    assert_eq!(json["pairs"], serde_json::json!([{"from": "part.ply", "to": "part.ply", "within": near}]));
    // The same by the network alone, with the gripper where it is free and as published.
    for form in ["curves_network", "curves_published"] {
        let curves = json[form].as_array().unwrap();
        assert_eq!(curves.len(), 8, "{curves:?}");
        // Hypotheses of the network alone: near enough with eight experiences.
        assert!(curves.iter().all(|c| c["count"] != 8 || c["within"] == near), "{form}: {curves:?}");
    }
    // Figure 6.13: grasps are on the handle, as experience is of handles only.
    let handles = json["handles"].as_array().unwrap();
    assert!(handles.len() == 2 && handles.iter().all(|h| h["by_experience"] == true), "{handles:?}");
    let table = std::fs::read_to_string(dir.join("out/table.md")).unwrap();
    let head =
        "| class | scenes | geometry | experience | network | published | agreement | outcomes | both |";
    assert!(table.contains(head), "{table}");
    let mean = table.lines().find(|l| l.starts_with("| mean of classes")).unwrap();
    let cells: Vec<f64> = mean.split('|').filter_map(|c| c.trim().parse().ok()).collect();
    assert!(
        cells.iter().zip(&rates).all(|(c, r)| (c - r).abs() < 1e-3) && cells.len() == 11,
        "{mean} {rates:?}"
    );
    for file in ["experience-5cm.png", "between-objects-1cm.png", "incremental.png", "reproduce.json"] {
        assert!(dir.join("out").join(file).is_file(), "{file}");
    }
    // One of the forms alone.
    let figure = command.replace("--out out", "--out figure --figure 6.7-published");
    let figure = sixfold(dir, &figure).expect(0).json();
    assert_eq!(figure["curves_published"], json["curves_published"]);
    assert_eq!(
        (&figure["curves"], &figure["curves_network"]),
        (&serde_json::json!([]), &serde_json::json!([]))
    );
    assert!(dir.join("figure/transfer.json").is_file() && !dir.join("figure/compare").exists());
    let alone = command.replace("--out out", "--out alone --figure 6.10");
    assert_eq!(sixfold(dir, &alone).expect(0).json(), json["incremental"]);
    assert!(dir.join("alone/learning.json").is_file());
    // Run again: everything exists already.
    let trials = std::fs::read(dir.join("out/compare/trials.jsonl")).unwrap();
    let again = sixfold(dir, &command).expect(0).json();
    assert_eq!(
        (&again["compare"]["classes"], &again["curves"]),
        (&json["compare"]["classes"], &json["curves"])
    );
    assert_eq!(std::fs::read(dir.join("out/compare/trials.jsonl")).unwrap(), trials);
}

/// Figure 6.13 on a mug, which planners hold by its body.
#[test]
fn experience_on_handles_and_nothing_else_leads_to_the_handle() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let mug = member(Family::Mug, &mut stream(4, 0)).unwrap();
    write_ply(dir.join("mug.ply"), &mug.mesh, Unit::Metre, PlyFormat::BinaryLittleEndian).unwrap();
    let handle: Vec<Vec3> =
        mug.mesh.vertices().iter().filter(|p| mug.part_at(p) == "handle").copied().collect();
    let low = handle.iter().fold(handle[0], |a, b| a.inf(b));
    let high = handle.iter().fold(handle[0], |a, b| a.sup(b));
    let part =
        serde_json::json!({"name": "handle", "low": [low.x, low.y, low.z], "high": [high.x, high.y, high.z]});
    let list = serde_json::json!([{"class": "mug", "mesh": "mug.ply", "unit": "m", "part": part}]);
    std::fs::write(dir.join("mugs.json"), list.to_string()).unwrap();
    let command =
        format!("reproduce dgcm --list mugs.json --weights {NETWORK} --quick --figure 6.13 --out out --json");
    let rows = sixfold(dir, &command).expect(0).json();
    let count = |method: &str| rows.as_array().unwrap().iter().filter(|row| row[method] == true).count();
    let of_planners = ["by_geometry", "by_gpd", "by_haf"].map(count);
    assert_eq!(
        (rows.as_array().unwrap().len(), count("by_experience"), of_planners),
        (2, 2, [0; 3]),
        "{rows}"
    );
    // The columns of the figure: normals and the six methods, below each other both views.
    let figure = sixfold_io::read_rgb(&dir.join("out/handles/handles.png")).unwrap();
    assert_eq!(figure.size(), (7 * 200, 24 + 2 * 200));
    let green = |column: usize| {
        let pixels = (24..424).flat_map(|y| (0..200).map(move |x| (200 * column + x, y)));
        pixels.filter(|&at| figure[at][1] > figure[at][0].saturating_add(40)).count()
    };
    assert!(green(1) > 200 && [4, 5, 6].map(green) == [0; 3], "{:?}", [1, 4, 5, 6].map(green));
    assert!(dir.join("out/handles.json").is_file());
}

/// Figure 6.7 on recorded depth images with annotated grasps.
#[test]
fn transfer_is_measured_on_recorded_images() {
    let case = OneImage::new();
    let dir = case.path();
    // On top of the part's tower, from above, closing across it.
    let tip = Vec3::new(-0.04, -0.015, 0.09);
    let grasp = gripper_pose(&tip, &-Vec3::z(), &Vec3::x()).unwrap();
    let list = |name: &str, moved: f64| {
        let image = |k: u32| {
            let x = 0.02 * f64::from(k);
            let pose = on_table(x - 0.03, 0.01, 0.2 * f64::from(k));
            let depth = format!("{k}.png");
            write_depth(&dir.join(&depth), &depth_of(&[(&part(), pose)]), DEPTH_SCALE).unwrap();
            let along = Pose::from_translation(Vec3::new(moved * f64::from(k), 0.0, 0.0));
            let matrix = (pose * along * grasp).to_matrix();
            let rows: Vec<Vec<f64>> = (0..4).map(|i| (0..4).map(|j| matrix[(i, j)]).collect()).collect();
            serde_json::json!({
                "class": "part", "object": "part", "depth": depth, "camera": "camera.json",
                "camera_from_gripper": rows, "width": 0.04,
            })
        };
        let images: Vec<serde_json::Value> = (0..4).map(image).collect();
        std::fs::write(dir.join(name), serde_json::to_string(&images).unwrap()).unwrap();
    };
    list("views.json", 0.0);
    list("moved.json", 0.1);
    let measure = |list: &str| {
        format!(
            "reproduce dgcm --recorded {list} --weights {NETWORK} --quick --figure 6.7 --out {list}-out --json"
        )
    };
    let within = |list: &str| {
        let json = sixfold(dir, &measure(list)).expect(0).json();
        // Two of the four images are experience, two are tested.
        let curves = json["curves"].as_array().unwrap().clone();
        assert!(curves.len() == 8 && curves.iter().all(|c| c["asked"] == 2), "{curves:?}");
        curves.iter().map(|c| c["within"][0].as_f64().unwrap()).collect::<Vec<_>>()
    };
    assert_eq!(within("views.json"), [1.0; 8]);
    // Grasps that are annotated elsewhere in each image: what is transferred is not what is wanted.
    assert_eq!(within("moved.json"), [0.0; 8]);
    assert!(dir.join("views.json-out/experience-5cm.png").is_file());
    // Resumed with another list.
    std::fs::copy(dir.join("moved.json"), dir.join("views.json")).unwrap();
    fails(dir, &measure("views.json"), &["answers.jsonl", "other options"]);
    for (from, to, words) in [
        ("\"width\":0.04", "\"width\":0.4", ["image 1", "width: found 0.4 m", "jaws-140"]),
        ("\"depth\":\"2.png\"", "\"depth\":\"9.png\"", ["image 3", "9.png", "No such file"]),
        ("\"class\"", "\"klass\"", ["bad.json", "klass", "expected"]),
    ] {
        let good = std::fs::read_to_string(dir.join("moved.json")).unwrap();
        std::fs::write(dir.join("bad.json"), good.replace(from, to)).unwrap();
        fails(dir, &measure("bad.json"), &words);
    }
    let one = std::fs::read_to_string(dir.join("moved.json")).unwrap();
    let one: Vec<serde_json::Value> = serde_json::from_str(&one).unwrap();
    std::fs::write(dir.join("bad.json"), serde_json::to_string(&one[..1]).unwrap()).unwrap();
    fails(dir, &measure("bad.json"), &["1 image of object part", "at least 2"]);
    let other = measure("moved.json").replace("--figure 6.7", "--figure 6.13");
    fails(dir, &other, &["--recorded", "found --figure 6.13"]);
}
