//! Every bad input gets a JSON error that names the field, what was found and expected, and what to do: never a 5xx.

use std::io::Write;

use serde_json::Value;

use crate::support::{Form, TestServer, connect, frame, read, search, send};
use sixfold_serve::ServerOptions;

/// A form that is refused: the status, the field, and a word of the message.
struct Case {
    path: &'static str,
    form: Form,
    status: u16,
    field: &'static str,
    word: &'static str,
}

fn check(problem: &Value, case: &Case) {
    let name = format!("{} {}: {problem}", case.field, case.word);
    assert_eq!(problem["field"], case.field, "{name}");
    for part in ["error", "found", "expected", "advice"] {
        assert!(problem[part].as_str().is_some_and(|t| !t.is_empty()), "{part} of {name}");
    }
    let error = problem["error"].as_str().unwrap();
    assert!(error.contains(case.word), "{name}");
    assert!(!error.contains("/tmp") && !error.contains("panicked"), "{name}");
}

fn depth() -> Vec<u8> {
    read("test/000002/depth/000003.png")
}

fn rgb() -> Vec<u8> {
    read("test/000002/rgb/000003.png")
}

fn camera(form: Form) -> Form {
    form.file("camera", "camera.json", &read("camera.json"))
}

/// A PNG whose header states a size, with a right checksum, followed by the rest of another file.
fn png_with_wrong_size(width: u32, height: u32) -> Vec<u8> {
    let mut png = depth();
    png[16..20].copy_from_slice(&width.to_be_bytes());
    png[20..24].copy_from_slice(&height.to_be_bytes());
    let crc = png[12..29].iter().fold(u32::MAX, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |c, _| if c & 1 == 1 { c >> 1 ^ 0xedb8_8320 } else { c >> 1 })
    });
    png[29..33].copy_from_slice(&(!crc).to_be_bytes());
    png
}

/// A 16-bit image of another size.
fn small_depth() -> Vec<u8> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("d.png");
    let image = sixfold_geometry::DepthImage::filled(64, 48, 1.0);
    sixfold_io::write_depth(&path, &image, 1e-3).unwrap();
    std::fs::read(path).unwrap()
}

fn find(form: Form, field: &'static str, word: &'static str) -> Case {
    Case { path: "/v1/find", form: form.text("objects", "duck"), status: 422, field, word }
}

fn of_images() -> Vec<Case> {
    let form = Form::default;
    let zip = [b"PK\x03\x04".as_slice(), &[0; 200]].concat();
    let scaled = |text: &str| text.replace("572.4114", "0.57").into_bytes();
    let camera_text = String::from_utf8(read("camera.json")).unwrap();
    let mut noscale = camera_text.replace(", \"depth_scale\": 1.0", "");
    noscale.truncate(noscale.trim_end().len());
    vec![
        find(
            camera(form().file("rgb", "photo.jpg", b"this is text")).text("method", "views"),
            "rgb",
            "neither PNG nor JPEG",
        ),
        find(camera(form().file("depth", "d.png", b"")), "depth", "neither PNG nor JPEG"),
        find(camera(form().file("depth", "d.png", &zip)), "depth", "neither PNG nor JPEG"),
        find(
            camera(form().file("depth", "d.png", &png_with_wrong_size(30_000, 30_000))),
            "depth",
            "30000x30000",
        ),
        find(
            camera(form().file("depth", "d.png", &png_with_wrong_size(9_000, 9_000))),
            "camera",
            "9000x9000",
        ),
        find(camera(form().file("depth", "d.png", &depth()[..4000])), "depth", "not a readable image"),
        find(camera(form().file("depth", "d.png", &rgb())), "depth", "16 bits"),
        find(camera(form().file("depth", "d.png", &small_depth())), "camera", "640x480"),
        find(
            camera(form().file("depth", "d.png", &depth()).file("rgb", "c.png", &small_depth())),
            "rgb",
            "64x48",
        ),
        find(camera(form()), "depth", "depth image"),
        find(camera(form().file("rgb", "c.png", &rgb())).text("method", "ppf"), "depth", "ppf"),
        find(form().file("depth", "d.png", &depth()), "camera", "nothing"),
        find(
            form().file("depth", "d.png", &depth()).file("camera", "c.json", b"{\"fx\": 5"),
            "camera",
            "camera",
        ),
        find(form().file("depth", "d.png", &depth()).file("camera", "c.json", &rgb()), "camera", "camera"),
        find(
            form().file("depth", "d.png", &depth()).file("camera", "c.json", &scaled(&camera_text)),
            "camera",
            "camera",
        ),
        find(
            form().file("depth", "d.png", &depth()).file("camera", "c.json", noscale.as_bytes()),
            "depth_scale",
            "nothing",
        ),
        find(form().file("depth", "d.png", &depth()).text("fx", "570").text("fy", "570"), "cx", "nothing"),
        find(form().file("depth", "d.png", &depth()).text("fx", "wide"), "fx", "wide"),
        find(
            frame().text("fx", "1").text("fy", "1").text("cx", "1").text("cy", "1"),
            "camera",
            "one of them",
        ),
        find(frame().file("mask", "m.png", &small_depth()), "mask", "64x48"),
        find(frame().file("mask", "m.png", b"nothing"), "mask", "neither PNG nor JPEG"),
        find(frame().text("depth_scale", "-1"), "depth_scale", "-1"),
        find(frame().text("depth_scale", "NaN"), "depth_scale", "NaN"),
    ]
}

fn of_choices() -> Vec<Case> {
    let plain = |status, field, word, form: Form| Case { path: "/v1/find", form, status, field, word };
    let duck = |name: &str, value: &str| frame().text("objects", "duck").text(name, value);
    let with_networks = cfg!(feature = "networks");
    let pix2pose = if with_networks { ("box", "a box or a mask") } else { ("method", "networks") };
    vec![
        plain(404, "objects", "teapot", frame().text("objects", "duck,teapot")),
        plain(400, "objects", "letters", frame().text("objects", "../../etc/passwd")),
        plain(422, "objects", "0 names", frame()),
        plain(422, "method", "guess", duck("method", "guess")),
        plain(422, pix2pose.0, pix2pose.1, duck("method", "pix2pose")),
        plain(422, "instances", "0", duck("instances", "0")),
        plain(422, "instances", "many", duck("instances", "many")),
        plain(422, "min_confidence", "-1", duck("min_confidence", "-1")),
        plain(422, "min_confidence", "NaN", duck("min_confidence", "NaN")),
        plain(422, "box", "1,2,3", duck("box", "1,2,3")),
        plain(422, "box", "640x480", duck("box", "9000,9000,10,10")),
        plain(422, "box", "inf", duck("box", "0,0,inf,10")),
        plain(422, "form", "favourite", duck("favourite", "yes")),
        plain(422, "method", "2 values", duck("method", "ppf").text("method", "mttm")),
        plain(422, "depth", "several files", frame().file("depth", "again.png", &depth())),
        plain(422, "method", "70000 bytes", duck("method", &"x".repeat(70_000))),
        plain(400, "rgb", "../../x.jpg", Form::default().file("rgb", "../../x.jpg", &rgb())),
        plain(400, "rgb", "without /", Form::default().file("rgb", "a\\b.jpg", &rgb())),
        plain(400, "depth", "without /", Form::default().file("depth", "/etc/passwd", &depth())),
    ]
}

fn of_other_paths() -> Vec<Case> {
    let grasp = |status, field, word, form: Form| Case { path: "/v1/grasps", form, status, field, word };
    let object = |status, field, word, form: Form| Case { path: "/v1/objects", form, status, field, word };
    let mesh = read("models/obj_000009.ply");
    let named = |name: &str| Form::default().text("name", name).text("unit", "mm");
    vec![
        grasp(422, "depth", "nothing", camera(Form::default())),
        grasp(422, "gripper", "jaws-140", frame().text("gripper", "claw")),
        grasp(422, "gripper_file", "gripper_file", frame().file("gripper_file", "g.json", b"{}")),
        grasp(422, "number", "0", frame().text("number", "0")),
        object(422, "mesh", "nothing", named("new")),
        object(400, "name", "letters", named("../new").file("mesh", "m.ply", &mesh)),
        object(422, "mesh", ".ply", named("new").file("mesh", "m.exe", &mesh)),
        object(
            422,
            "mesh",
            "mesh",
            named("new").file("mesh", "m.ply", b"ply\nformat ascii 1.0\nelement vertex 4000000000\n"),
        ),
        object(422, "mesh", "mesh", named("new").file("mesh", "m.glb", &mesh)),
        object(422, "unit", "nothing", Form::default().text("name", "new").file("mesh", "m.ply", &mesh)),
        object(
            422,
            "mesh",
            "metres",
            Form::default().text("name", "new").text("unit", "m").file("mesh", "m.ply", &mesh),
        ),
        object(
            422,
            "symmetric_about",
            "w",
            named("new").text("symmetric_about", "w").file("mesh", "m.ply", &mesh),
        ),
        object(409, "name", "exists already", named("duck").file("mesh", "m.ply", &mesh)),
    ]
}

#[test]
fn bad_fields_are_named() {
    let server = TestServer::new();
    for case in of_images().iter().chain(&of_choices()).chain(&of_other_paths()) {
        let reply = server.post(case.path, &case.form);
        check(&reply.json(), case);
        assert_eq!(reply.status, case.status, "{} {}", case.field, case.word);
    }
    // None of them became a job or an object, and the server still works.
    assert_eq!(server.get("/v1/jobs").expect(200).json()["jobs"].as_array().unwrap().len(), 0);
    server.get("/v1/objects/new").expect(404);
    assert!(!server.folder.path().join("new").exists());
    server.result_of("/v1/find", &search("duck")).expect(200);
}

#[test]
fn bodies_that_are_no_form_are_refused() {
    let server = TestServer::with(|o| ServerOptions { max_upload: 1 << 20, ..o });
    let post =
        |headers: &[(&str, &str)], body: &[u8]| send(server.address, "POST", "/v1/find", headers, body);
    assert_eq!(post(&[], b"{}").expect(415).json()["field"], "Content-Type");
    assert_eq!(
        post(&[("Content-Type", "application/json")], b"{}").expect(415).json()["field"],
        "Content-Type"
    );
    let form = [("Content-Type", "multipart/form-data; boundary=b0undary")];
    assert_eq!(post(&form, b"not a form").expect(400).json()["field"], "form");
    let whole = frame().text("objects", "duck").body();
    assert_eq!(post(&form, &whole[..whole.len() / 2]).expect(400).json()["field"], "form");
    let gzip = [form[0], ("Content-Encoding", "gzip")];
    assert_eq!(post(&gzip, b"\x1f\x8b").expect(415).json()["field"], "Content-Encoding");
    let large = Form::default().file("rgb", "large.png", &vec![0; 2 << 20]);
    assert_eq!(large.post(server.address, "/v1/find").expect(413).json()["field"], "form");
    let many = (0..300).fold(Form::default(), |form, _| form.text("objects", "duck"));
    assert_eq!(many.post(server.address, "/v1/find").expect(422).json()["field"], "form");
}

#[test]
fn paths_and_names_reach_no_file() {
    let server = TestServer::new();
    for path in [
        "/v1/objects/..%2F..%2Fetc",
        "/v1/objects/%2e%2e",
        "/v1/objects/..%2F..%2Fetc/mesh.ply",
        "/v1/objects/cat%00/thumbnail.png",
        "/v1/objects/c%C3%A4t",
    ] {
        assert_eq!(server.get(path).expect(400).json()["field"], "name", "{path}");
    }
    for path in [
        "/v1/jobs/..%2F..%2Fobjects",
        "/v1/jobs/%2e%2e/result",
        "/v1/jobs/x/events",
        "/v1/jobs/x/overlay.png",
    ] {
        assert_eq!(server.get(path).expect(404).json()["field"], "id", "{path}");
    }
    for path in ["/static/../Cargo.toml", "/../../etc/passwd", "/static/%2e%2e/app.css", "//v1/health"] {
        server.get(path).expect(404);
    }
    for path in ["/v1/jobs/x/result?wait=a", "/v1/jobs/x/result?wait=1e9", "/v1/jobs/x/result?wait=-1"] {
        assert_eq!(server.get(path).expect(422).json()["field"], "wait", "{path}");
    }
}

#[test]
fn a_full_queue_and_slow_clients_are_told_so() {
    let server = TestServer::with(|o| ServerOptions {
        max_waiting: 2,
        request_timeout: std::time::Duration::from_secs(1),
        ..o
    });
    let form = search("ape,cat,driller,duck");
    let replies: Vec<u16> = (0..6).map(|_| server.post("/v1/find", &form).status).collect();
    assert!(replies.contains(&202) && replies.contains(&429), "{replies:?}");
    // Half a form, then nothing.
    let mut stream = connect(server.address);
    let head = format!(
        "POST /v1/find HTTP/1.1\r\nHost: {}\r\nContent-Length: 1000\r\nConnection: close\r\n\
         Content-Type: multipart/form-data; boundary=b0undary\r\n\r\n--b0undary\r\n",
        server.address
    );
    stream.write_all(head.as_bytes()).unwrap();
    let mut answer = String::new();
    let _ = std::io::Read::read_to_string(&mut stream, &mut answer);
    assert!(answer.starts_with("HTTP/1.1 408"), "{answer}");
}
