//! Teaching without a board and with a mesh over HTTP: the scale, settings that change later, a restart, and what is refused.

use serde_json::{Value, json};
use sixfold_geometry::{Camera, Pose, RgbImage, Vec3};
use sixfold_mesh::{Mesh, PlyFormat, Unit, write_ply};
use sixfold_teach::simulation::{SimulatedCapture, SimulationOptions, patterned};

use crate::support::{Form, TestServer};
use crate::teach::{COUNT, body, decoded, form, id_of, mask_png, photographs, png, post, put, written};

const PHOTOGRAPHS: usize = 12;

/// Photographs without anything in them.
fn plain() -> Form {
    (0..4u8).fold(Form::default().text("name", "plain"), |form, i| {
        form.file("photographs", &format!("{i}.png"), &png(&RgbImage::filled(96, 64, [40 * i; 3])))
    })
}

fn ends(all: &[(&str, [Value; 2])]) -> String {
    let all: Vec<Value> = all.iter().map(|(name, p)| json!({ "photograph": name, "points": p })).collect();
    json!(all).to_string()
}

/// Both ends in two photographs.
fn two() -> String {
    ends(&[("0.png", [json!([1, 2]), json!([30, 4])]), ("1.png", [json!([1.5, 2]), json!([30, 40])])])
}

fn ply(mesh: &Mesh) -> Vec<u8> {
    written(|path| write_ply(path, mesh, Unit::Millimetre, PlyFormat::BinaryLittleEndian).unwrap())
}

#[test]
fn invalid_scales_and_meshes_are_refused_with_advice() {
    let server = TestServer::new();
    let bare = || plain().text("without_board", "true");
    let scaled = |length: &str, ends: &str| bare().text("length", length).text("ends", ends);
    let one = ends(&[("0.png", [json!([1, 2]), json!([30, 4])])]);
    let unknown =
        ends(&[("7.png", [json!([1, 2]), json!([30, 4])]), ("1.png", [json!([1, 2]), json!([3, 4])])]);
    let outside =
        ends(&[("0.png", [json!([1, 2]), json!([300, 4])]), ("1.png", [json!([1, 2]), json!([3, 4])])]);
    let half = ends(&[("0.png", [json!([1, 2]), json!([30, 4])]), ("1.png", [json!([1, 2]), Value::Null])]);
    let twice =
        ends(&[("0.png", [json!([1, 2]), json!([30, 4])]), ("0.png", [json!([1, 2]), json!([3, 4])])]);
    let beyond = r#"[{"photograph": 4, "points": [[1, 2], [3, 4]]}]"#;
    let mesh = ply(&body());
    let with_mesh = || plain().file("mesh", "body.ply", &mesh);
    for (form, field, word) in [
        (bare(), "length", "neither a length nor depth"),
        (bare().text("length", "0.2"), "ends", "nothing"),
        (bare().text("ends", &two()), "length", "nothing"),
        (scaled("0.2", &one), "ends", "the first point is marked in 1 photographs, expected at least 2"),
        (scaled("0.2", &half), "ends", "the second point is marked in 1 photographs"),
        (scaled("0.2", &unknown), "ends", "found 7.png, expected the name of one of the 4 photographs"),
        (scaled("0.2", beyond), "ends", "found photograph 4"),
        (scaled("0.2", &outside), "ends", "0.png: found 300,4, the photograph has 96x64 pixels"),
        (scaled("0.2", &twice), "ends", "0.png twice"),
        (scaled("0.2", "0.png:1,2:3,4"), "ends", "expected a list like"),
        (scaled("0.2", "[{\"photograph\": 0, \"points\": [[1, 2]]}]"), "ends", "expected a list like"),
        (scaled("120", &two()), "length", "metres, 0.005 to 5"),
        (scaled("0.2", &two()).text("ruler", "100"), "ruler", "without a board"),
        (plain().text("length", "0.2").text("ends", &two()), "length", "without_board=true"),
        (plain().text("ends", &two()), "ends", "without_board=true"),
        (plain().text("without_board", "maybe"), "without_board", "true or false"),
        (with_mesh(), "unit", "nothing"),
        (plain().text("unit", "mm"), "unit", "without a mesh"),
        (with_mesh().text("unit", "yards"), "unit", "m, cm, mm, in"),
        (with_mesh().text("unit", "m"), "mesh", "140 mm if the file is in millimetres: give unit=mm"),
        (with_mesh().text("unit", "mm").text("hull_only", "true"), "hull_only", "with a mesh"),
        (plain().file("mesh", "body.step", &mesh).text("unit", "mm"), "mesh", ".ply, .obj"),
        (plain().file("mesh", "body.ply", b"text").text("unit", "mm"), "mesh", "mesh: "),
    ] {
        let problem = server.post("/v1/teachings", &form).expect(422).json();
        assert_eq!(problem["field"], field, "{problem}");
        assert!(problem["error"].as_str().unwrap().contains(word), "{word}: {problem}");
        assert!(!problem["error"].as_str().unwrap().contains("--"), "{problem}");
    }
    let folder = server.folder.path().join("data/teachings");
    assert_eq!(std::fs::read_dir(folder).unwrap().count(), 0, "nothing is left of what was refused");
}

#[test]
fn the_scale_is_given_after_the_photographs_and_survives_a_restart() {
    let server = TestServer::new();
    let all = plain().text("without_board", "true").text("start", "false");
    let teaching = server.post("/v1/teachings", &all).expect(201).json();
    assert_eq!((&teaching["without_board"], &teaching["length"]), (&json!(true), &Value::Null));
    assert_eq!((&teaching["ends"], &teaching["state"]), (&json!([]), &json!("ready")));
    let path = format!("/v1/teachings/{}", id_of(&teaching));
    let refused = post(&server, &format!("{path}/run")).expect(409).json();
    assert_eq!(refused["field"], "length", "{refused}");
    let change = |server: &TestServer, form: &Form| server.post(&format!("{path}/photographs"), form);
    let scale = Form::default().text("length", "0.2");
    assert_eq!(change(&server, &scale).expect(422).json()["field"], "ends");
    let marked = json!([
        { "photograph": 3, "points": [null, [95.5, 63]] },
        { "photograph": "0.png", "points": [[1, 2], [30, 4]] },
        { "photograph": "1.png", "points": [[1, 2], null] },
    ]);
    let after = change(&server, &scale.clone().text("ends", &marked.to_string())).expect(200).json();
    assert_eq!(after["length"], 0.2);
    let kept = json!([
        { "photograph": 3, "points": [null, [95.5, 63.0]] },
        { "photograph": 0, "points": [[1.0, 2.0], [30.0, 4.0]] },
        { "photograph": 1, "points": [[1.0, 2.0], null] },
    ]);
    assert_eq!(after["ends"], kept);
    // One of them alone changes.
    change(&server, &Form::default().text("length", "0.25")).expect(200);
    let server = TestServer::within(server.end(), |o| o);
    let after = server.get(&path).expect(200).json();
    assert_eq!((&after["length"], &after["ends"]), (&json!(0.25), &kept), "{after}");
    assert_eq!(after["without_board"], true);
    // A ruler belongs to the board; the length is kept while the board is tried.
    let ruler = Form::default().text("ruler", "141");
    assert_eq!(change(&server, &ruler).expect(422).json()["field"], "ruler");
    let on_board = change(&server, &ruler.text("without_board", "false")).expect(200).json();
    assert_eq!((&on_board["without_board"], &on_board["ruler"]), (&json!(false), &json!(141.0)));
    assert_eq!(change(&server, &scale).expect(422).json()["field"], "length");
    let back = change(&server, &Form::default().text("without_board", "true")).expect(200).json();
    assert_eq!((&back["length"], &back["ends"]), (&json!(0.25), &kept));
    // The marks of a photograph that is replaced are gone; an equal one changes nothing.
    let same = Form::default().file("photographs", "1.png", &png(&RgbImage::filled(96, 64, [40; 3])));
    assert_eq!(change(&server, &same).expect(200).json()["ends"], kept);
    let other = Form::default().file("photographs", "1.png", &png(&RgbImage::filled(96, 64, [41; 3])));
    assert_eq!(change(&server, &other).expect(200).json()["ends"].as_array().unwrap().len(), 2);
    let failed = |server: &TestServer| {
        let job = post(server, &format!("{path}/run")).expect(202).json();
        let problem = server.result(&id_of(&job)).expect(422).json();
        let now = server.get(&path).expect(200).json();
        assert_eq!((&now["state"], &now["problem"]), (&json!("failed"), &problem));
        problem
    };
    // Points that are marked in too few photographs, and photographs that show nothing.
    let problem = failed(&server);
    assert_eq!(problem["field"], "ends", "{problem}");
    change(&server, &Form::default().text("ends", &two())).expect(200);
    let problem = failed(&server);
    assert_eq!(problem["field"], "photographs", "{problem}");
    assert!(problem["error"].as_str().unwrap().contains("texture"), "{problem}");
    let removed = change(&server, &Form::default().text("ends", "[]")).expect(200).json();
    assert_eq!((&removed["length"], &removed["ends"]), (&Value::Null, &json!([])));
    post(&server, &format!("{path}/run")).expect(409);
}

fn camera() -> Camera {
    Camera { fx: 620.0, fy: 620.0, cx: 322.0, cy: 238.0, width: 640, height: 480, distortion: None }
}

#[test]
fn an_object_is_taught_without_a_board() {
    let (mesh, cloth, table) = (body(), patterned(1024, 2), RgbImage::filled(8, 8, [110, 105, 95]));
    let options = SimulationOptions {
        photographs: PHOTOGRAPHS,
        camera: camera(),
        distance: [0.4, 0.48],
        motion: 0.5,
        blur: 0.5,
        ..SimulationOptions::default()
    };
    let capture = SimulatedCapture::without_board(&mesh, (&cloth, 0.5), &table, &options, 5);
    let server = TestServer::new();
    let settings = [("name", "block"), ("hull_only", "true"), ("without_board", "true"), ("start", "false")];
    let form = settings.iter().fold(Form::default(), |form, (name, value)| form.text(name, value));
    let all = (0..PHOTOGRAPHS).fold(form, |form, i| {
        form.file("photographs", &format!("{i:02}.png"), &png(&capture.photograph(i).unwrap()))
    });
    let teaching = server.post("/v1/teachings", &all).expect(201).json();
    let path = format!("/v1/teachings/{}", id_of(&teaching));
    let marked = |pose: &Pose, x: f64| {
        let p = camera().project(&pose.transform_point(&Vec3::new(x, 0.08, 0.0))).unwrap();
        json!([p.x, p.y])
    };
    let ends: Vec<Value> = [0, 3, 6]
        .map(|i| {
            let pose = &capture.camera_from_board[i];
            json!({ "photograph": format!("{i:02}.png"), "points": [marked(pose, -0.1), marked(pose, 0.1)] })
        })
        .to_vec();
    let scale = Form::default().text("length", "0.2").text("ends", &json!(ends).to_string());
    server.post(&format!("{path}/photographs"), &scale).expect(200);
    // Masks by a person, so that no network for masks runs.
    for i in 0..PHOTOGRAPHS {
        let mask = mask_png(&capture.mask(i).unwrap());
        put(&server, &format!("{path}/photographs/{i}/mask"), &mask).expect(200);
    }
    // Another process takes over what was given.
    let server = TestServer::within(server.end(), |o| o);
    let job = post(&server, &format!("{path}/run")).expect(202).json();
    let done = server.result(&id_of(&job)).expect(200).json();
    assert_eq!((&done["photographs"], &done["left_out"]), (&json!(PHOTOGRAPHS), &json!([])), "{done}");
    let ratio = done["mesh"]["diameter"].as_f64().unwrap() / mesh.diameter();
    assert!((ratio - 1.0).abs() < 0.06, "{ratio}: {done}");
    let taught = server.get(&path).expect(200).json();
    assert_eq!((&taught["state"], &taught["board"]), (&json!("taught"), &Value::Null));
    assert!(taught["floor"].as_f64().is_some_and(f64::is_finite), "{taught}");
    // The image in which ends are marked is the photograph itself.
    let image = |query: &str| {
        decoded(&server.get(&format!("{path}/photographs/2/image.jpg?side=640{query}")).expect(200))
    };
    let original = capture.photograph(2).unwrap();
    let difference = |image: &RgbImage| {
        let pairs = image.as_slice().iter().flatten().zip(original.as_slice().iter().flatten());
        pairs.map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / (3.0 * original.as_slice().len() as f64)
    };
    let (taken, straight) = (difference(&image("&as_taken=true")), difference(&image("")));
    assert!(taken < 4.0 && taken < straight, "{taken} and {straight} levels");
    // Another scale: the poses are found again, of an object twice as large.
    let double = Form::default().text("length", "0.4");
    let changed = server.post(&format!("{path}/photographs"), &double).expect(200).json();
    assert_eq!((&changed["state"], &changed["rms"]), (&json!("ready"), &Value::Null));
}

#[test]
fn a_mesh_is_aligned_replaced_and_forgotten() {
    let truth = photographs();
    let server = TestServer::new();
    let all = form("given", COUNT).text("start", "false");
    let teaching = server.post("/v1/teachings", &all).expect(201).json();
    assert_eq!((&teaching["given_mesh"], &teaching["hull_only"]), (&json!(false), &json!(true)));
    let path = format!("/v1/teachings/{}", id_of(&teaching));
    for (i, mask) in truth.masks.iter().enumerate() {
        put(&server, &format!("{path}/photographs/{i}/mask"), &mask_png(mask)).expect(200);
    }
    let change = |server: &TestServer, form: &Form| server.post(&format!("{path}/photographs"), form);
    let run = |server: &TestServer| {
        let job = post(server, &format!("{path}/run")).expect(202).json();
        server.result(&id_of(&job))
    };
    let mesh = Form::default().file("mesh", "body.ply", &ply(&body())).text("unit", "mm");
    assert_eq!(change(&server, &mesh).expect(422).json()["field"], "hull_only");
    let given = change(&server, &mesh.clone().text("hull_only", "false")).expect(200).json();
    assert_eq!((&given["given_mesh"], &given["hull_only"]), (&json!(true), &json!(false)));
    let hull = Form::default().text("hull_only", "true");
    assert_eq!(change(&server, &hull).expect(422).json()["field"], "hull_only");
    // Settings are kept.
    let server = TestServer::within(server.end(), |o| o);
    let done = run(&server).expect(200).json();
    assert!((done["mesh"]["diameter"].as_f64().unwrap() - body().diameter()).abs() < 1e-6, "{done}");
    assert_eq!(done["mesh"]["vertices"], body().vertices().len(), "{done}");
    // A mesh of another size is refused, with the fields of the request.
    let huge = Form::default().file("mesh", "body.ply", &ply(&body())).text("unit", "cm");
    change(&server, &huge).expect(200);
    let problem = run(&server).expect(422).json();
    assert_eq!(problem["field"], "mesh", "{problem}");
    assert!(problem["error"].as_str().unwrap().starts_with("mesh: found a mesh of 14"), "{problem}");
    let both = mesh.text("remove_mesh", "true");
    assert_eq!(change(&server, &both).expect(422).json()["field"], "remove_mesh");
    let forgotten = change(&server, &hull.text("remove_mesh", "true")).expect(200).json();
    assert_eq!((&forgotten["given_mesh"], &forgotten["hull_only"]), (&json!(false), &json!(true)));
    assert_eq!(forgotten["photographs"][0]["mask_by"], "person");
    let made = run(&server).expect(200).json();
    assert!(made["mesh"]["vertices"].as_u64().unwrap() > 100, "{made}");
    // Another way to make the mesh: only the mesh is outdated.
    let stereo = change(&server, &Form::default().text("hull_only", "false")).expect(200).json();
    assert_eq!((&stereo["state"], &stereo["mesh"]["is_current"]), (&json!("ready"), &json!(false)));
    assert!(stereo["rms"].is_number() && stereo["hull_only"] == false, "{stereo}");
    let unchanged = change(&server, &Form::default().text("hull_only", "false")).expect(200).json();
    assert_eq!(unchanged["hull_only"], false);
}
