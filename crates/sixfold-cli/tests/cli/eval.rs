//! `sixfold eval`.

use crate::support::*;

const ARGUMENTS: &str = "eval --dataset tiny --results results.csv";

#[test]
fn ground_truth_scores_one() {
    let tiny = Tiny::new(true);
    tiny.write_truth_as_results("results.csv");
    let run =
        sixfold(tiny.path(), &format!("{ARGUMENTS} --json --detection-ap --curves curves.png")).expect(0);
    let json = run.json();
    for key in ["ar", "ar_vsd", "ar_mssd", "ar_mspd"] {
        assert_eq!(json[key], 1.0, "{key}: {json}");
    }
    for key in ["1", "2", "mean"] {
        assert_eq!(json["add_s_recall"][key], 1.0, "{key}: {json}");
    }
    assert_eq!(json["targets"], 6);
    assert_eq!(json["detection"]["ap"], 1.0);
    // Ground truth has no times.
    let reasons: Vec<&String> = json["reasons"].as_object().unwrap().keys().collect();
    assert_eq!(reasons, ["average_time_per_image"]);
    let curves = image::open(tiny.path().join("curves.png")).unwrap();
    assert!(curves.width() > 200 && curves.height() > 200);
}

#[test]
fn itodd_has_a_delta_of_its_own() {
    let tiny = Tiny::new(true);
    let dir = tiny.path();
    // Poses 12 mm behind the truth: their visible part depends on whether delta is 5 or 15 mm.
    tiny.write_truth_as_results("results.csv");
    move_results(dir, 12.0);
    let vsd = |arguments: &str| {
        let json = sixfold(dir, &format!("{arguments} --json")).expect(0).json();
        json["ar_vsd"].as_f64().unwrap()
    };
    let (default, five) = (vsd(ARGUMENTS), vsd(&format!("{ARGUMENTS} --vsd-delta 5")));
    assert_eq!(default, vsd(&format!("{ARGUMENTS} --vsd-delta 15")));
    assert!((five - default).abs() > 1e-3, "{five} {default}");
    std::fs::rename(dir.join("tiny"), dir.join("itodd")).unwrap();
    let itodd = ARGUMENTS.replace("tiny", "itodd");
    assert_eq!(vsd(&itodd), five);
    assert_eq!(vsd(&format!("{itodd} --vsd-delta 15")), default);
    fails(dir, &format!("{itodd} --vsd-delta 5000"), &["--vsd-delta", "5000"]);
}

/// The results with every pose moved along the camera's axis, millimetres.
fn move_results(dir: &std::path::Path, millimetres: f64) {
    let text = std::fs::read_to_string(dir.join("results.csv")).unwrap();
    let moved = |line: &str| {
        let mut fields: Vec<String> = line.split(',').map(str::to_owned).collect();
        let mut t: Vec<f64> = fields[5].split(' ').map(|v| v.parse().unwrap()).collect();
        t[2] += millimetres;
        fields[5] = t.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
        fields.join(",")
    };
    let (head, rows) = text.split_once('\n').unwrap();
    let rows: Vec<String> = rows.lines().map(moved).collect();
    std::fs::write(dir.join("results.csv"), format!("{head}\n{}\n", rows.join("\n"))).unwrap();
}

#[test]
fn vsd_as_published_is_recall_at_one_tolerance() {
    let tiny = Tiny::new(true);
    let dir = tiny.path();
    let vsd = |options: &str| {
        let run = sixfold(dir, &format!("{ARGUMENTS} --json {options}")).expect(0);
        run.json()
    };
    // The dataset's own file requests half of the targets; with the published preset all annotated poses count.
    let targets = tiny.file("test_targets_bop19.json");
    let text = std::fs::read_to_string(&targets).unwrap();
    let lines: Vec<&str> = text.lines().filter(|l| l.contains("\"im_id\":0")).collect();
    std::fs::write(&targets, format!("[{}]", lines.join("\n").trim_end_matches(','))).unwrap();
    // Further away by 12 mm is within 20 mm, by 21 mm it is not; each pose is right or wrong as a whole.
    tiny.write_truth_as_results("results.csv");
    move_results(dir, -12.0);
    let json = vsd("--preset published");
    assert_eq!((json["ar_vsd"].as_f64(), json["targets"].as_u64()), (Some(1.0), Some(6)), "{json}");
    assert!(json["ar"].is_null() && json["reasons"]["ar"].is_string(), "{json}");
    let protocol = json["vsd_protocol"].as_str().unwrap();
    assert!(["0.3", "20 mm", "missing"].iter().all(|part| protocol.contains(part)), "{protocol}");
    assert_eq!(vsd("")["targets"], 2);
    assert_eq!(vsd("--targets all")["targets"], 6);
    assert!(vsd("")["vsd_protocol"].is_null());
    let two = vsd("--targets all --ids 2");
    assert_eq!((&two["targets"], two["objects"].as_object().unwrap().len()), (&3.into(), 1), "{two}");
    fails(dir, &format!("{ARGUMENTS} --ids 3"), &["--ids", "none of these"]);
    move_results(dir, -9.0);
    assert_eq!(vsd("--preset published")["ar_vsd"], 0.0);
    assert_eq!(vsd("--preset published --vsd-tau 40")["ar_vsd"], 1.0);
    assert_eq!(vsd("--vsd-tau 40 --vsd-threshold 0.3")["ar_vsd"], 1.0);
    let run = sixfold(dir, &format!("{ARGUMENTS} --preset published")).expect(0);
    assert!(run.stdout.contains("tolerances of 20 mm") && !run.stdout.contains("AR_VSD"), "{}", run.stdout);
    fails(dir, &format!("{ARGUMENTS} --vsd-tau 0"), &["--vsd-tau", "above 0"]);
}

#[test]
fn models_of_another_folder_are_scored_with() {
    let tiny = Tiny::new(true);
    tiny.write_truth_as_results("results.csv");
    // Like T-LESS: no folder `models`. In models_reconst, object 1 has another, symmetric shape.
    std::fs::rename(tiny.file("models"), tiny.file("models_cad")).unwrap();
    fails(
        tiny.path(),
        &format!("{ARGUMENTS} --models models_reconst"),
        &["--models", "models_reconst", "models_cad"],
    );
    let json = sixfold(tiny.path(), &format!("{ARGUMENTS} --models models_cad --json")).expect(0).json();
    assert_eq!(json["ar"], 1.0, "{json}");
    std::fs::create_dir(tiny.file("models_reconst")).unwrap();
    let model = tiny.file("models_cad/obj_000002.ply");
    std::fs::copy(&model, tiny.file("models_reconst/obj_000001.ply")).unwrap();
    std::fs::copy(&model, tiny.file("models_reconst/obj_000002.ply")).unwrap();
    // Diameter and symmetries come from the models folder's own file, so nothing is known of other models.
    let json = sixfold(tiny.path(), &format!("{ARGUMENTS} --models models_reconst --json")).expect(1).json();
    assert!(json["reasons"]["ar"].as_str().unwrap().contains("models_info.json"), "{json}");
}

#[test]
fn missing_scores_are_null_with_a_reason() {
    let tiny = Tiny::new(false);
    tiny.write_truth_as_results("results.csv");
    let json = sixfold(tiny.path(), &format!("{ARGUMENTS} --json")).expect(0).json();
    for key in ["ar", "ar_vsd"] {
        assert!(json[key].is_null(), "{json}");
        assert!(json["reasons"][key].as_str().unwrap().contains("depth"), "{json}");
    }
    assert_eq!(json["ar_mssd"], 1.0);
    assert_eq!(json["ar_mspd"], 1.0);
    let run = sixfold(tiny.path(), ARGUMENTS).expect(0);
    assert!(run.stdout.contains("ar_vsd not computed"), "{}", run.stdout);

    // The same by request.
    let tiny = Tiny::new(true);
    tiny.write_truth_as_results("results.csv");
    let json = sixfold(tiny.path(), &format!("{ARGUMENTS} --json --no-vsd")).expect(0).json();
    assert!(json["ar_vsd"].is_null() && json["reasons"]["ar_vsd"].is_string(), "{json}");
}

#[test]
fn a_wrong_pose_lowers_the_scores_of_its_object_only() {
    let tiny = Tiny::new(true);
    tiny.write_truth_as_results("results.csv");
    let file = tiny.path().join("results.csv");
    let text = std::fs::read_to_string(&file).unwrap();
    // One of object 2's three rows is removed.
    let kept: Vec<&str> = text.lines().filter(|l| !l.starts_with("7,4,2,")).collect();
    std::fs::write(&file, kept.join("\n") + "\n").unwrap();
    let json = sixfold(tiny.path(), &format!("{ARGUMENTS} --json scores.json")).expect(0);
    assert!(json.stdout.contains("AR "));
    let json: serde_json::Value =
        serde_json::from_slice(&std::fs::read(tiny.path().join("scores.json")).unwrap()).unwrap();
    assert_eq!(json["add_s_recall"]["1"], 1.0);
    assert!((json["add_s_recall"]["2"].as_f64().unwrap() - 2.0 / 3.0).abs() < 1e-12);
    assert!((json["ar_mssd"].as_f64().unwrap() - 5.0 / 6.0).abs() < 1e-12);
}

#[test]
fn no_estimate_is_exit_status_1() {
    let tiny = Tiny::new(true);
    std::fs::write(tiny.path().join("results.csv"), "scene_id,im_id,obj_id,score,R,t,time\n").unwrap();
    let json = sixfold(tiny.path(), &format!("{ARGUMENTS} --json")).expect(1).json();
    assert_eq!(json["ar"], 0.0);
}

#[test]
fn lenient_reports_broken_rows_and_scores_the_rest() {
    let tiny = Tiny::new(true);
    tiny.write_truth_as_results("results.csv");
    let file = tiny.path().join("results.csv");
    replace(&file, "7,4,2,0.9", "7,4,2,NaN");
    fails(tiny.path(), ARGUMENTS, &["results.csv", "line 5", "score", "NaN"]);
    let run = sixfold(tiny.path(), &format!("{ARGUMENTS} --lenient --json")).expect(2);
    assert!(run.stderr.contains("results.csv") && run.stderr.contains("line 5"), "{}", run.stderr);
    assert!((run.json()["ar_mssd"].as_f64().unwrap() - 5.0 / 6.0).abs() < 1e-12);
}

#[test]
fn detections_are_scored_as_coco_does() {
    let tiny = Tiny::new(true);
    let truth = serde_json::json!({
        "images": [{"id": 0, "width": WIDTH, "height": HEIGHT}],
        "categories": [{"id": 1, "name": "1"}],
        "annotations": [{
            "id": 1, "image_id": 0, "category_id": 1, "bbox": [10, 10, 40, 30], "area": 1200, "iscrowd": 0,
            "ignore": false,
        }],
    });
    std::fs::write(tiny.file("test/000007/scene_gt_coco.json"), truth.to_string()).unwrap();
    let detection = |x: f64| {
        serde_json::json!([{
            "scene_id": 7, "image_id": 0, "category_id": 1, "score": 0.5, "bbox": [x, 10.0, 40.0, 30.0],
        }])
    };
    let scores = |x: f64| {
        std::fs::write(tiny.path().join("d.json"), detection(x).to_string()).unwrap();
        sixfold(tiny.path(), "eval --dataset tiny --detections d.json --json").expect(0).json()
    };
    assert_eq!(scores(10.0)["box"]["ap"], 1.0);
    assert_eq!(scores(100.0)["box"]["ap"], 0.0);
    assert!(scores(10.0)["mask"].is_null());
}

#[test]
fn curves_that_cannot_be_plotted_cost_no_scores() {
    let tiny = Tiny::new(false);
    tiny.write_truth_as_results("results.csv");
    std::fs::write(tiny.path().join("taken"), b"").unwrap();
    let run = sixfold(tiny.path(), &format!("{ARGUMENTS} --json --curves taken/curves.png")).expect(2);
    assert_eq!(run.json()["ar_mssd"], 1.0);
    assert!(run.stderr.contains("skipped taken/curves.png"), "{}", run.stderr);
}

/// Many rows, to simulate hours of scoring. The duration depends on the machine, so the first of several moments that falls
/// into the work is used.
#[cfg(unix)]
#[test]
fn an_interrupt_ends_it_at_once() {
    use std::process::{Command, Stdio};
    use std::time::{Duration, Instant};

    let tiny = Tiny::new(false);
    tiny.write_truth_as_results("results.csv");
    let results = tiny.path().join("results.csv");
    let text = std::fs::read_to_string(&results).unwrap();
    let (head, rows) = text.split_once('\n').unwrap();
    std::fs::write(&results, format!("{head}\n{}", rows.repeat(200_000))).unwrap();
    let arguments = format!("{ARGUMENTS} --json");
    for milliseconds in [300, 150, 75, 37, 18] {
        let mut run = Command::new(crate::PROGRAM)
            .args(arguments.split_whitespace())
            .current_dir(tiny.path())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        std::thread::sleep(Duration::from_millis(milliseconds));
        if run.try_wait().unwrap().is_some() {
            continue;
        }
        assert!(Command::new("kill").args(["-INT", &run.id().to_string()]).status().unwrap().success());
        let start = Instant::now();
        while run.try_wait().unwrap().is_none() {
            if start.elapsed() > Duration::from_secs(10) {
                run.kill().unwrap();
                panic!("the interrupt was ignored");
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        let output = run.wait_with_output().unwrap();
        // It had just finished, or had not started yet.
        if output.status.code() != Some(2) {
            continue;
        }
        let json: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(json["error"]["kind"], "interrupt");
        assert!(String::from_utf8_lossy(&output.stderr).contains("error: interrupted"));
        return;
    }
    panic!("no interrupt came in the middle of the work");
}
