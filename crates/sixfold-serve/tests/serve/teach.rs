//! Teaching over HTTP: from simulated photographs to a stored object, with corrections, a killed server and bad input.

use std::sync::OnceLock;

use serde_json::{Value, json};
use sixfold_board::{Board, Paper};
use sixfold_geometry::{Camera, DepthImage, Image, Mask, Pose, RgbImage, Vec3};
use sixfold_mesh::Mesh;
use sixfold_teach::simulation::{SimulatedCapture, SimulationOptions};

use crate::restart::to_be_killed;
use crate::support::{Form, Reply, TestServer, events, result, send};

pub const COUNT: usize = 6;

/// A red block with a narrower blue one on it, off centre.
pub fn body() -> Mesh {
    let block = |low: [f64; 3], high: [f64; 3], color: [u8; 3]| {
        let corner = |i: usize| {
            let pick = |k: usize| if (i >> k) & 1 == 0 { low[k] } else { high[k] };
            Vec3::new(pick(0), pick(1), pick(2))
        };
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let faces = quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
        Mesh::new((0..8).map(corner).collect(), faces).unwrap().with_colors(vec![color; 8]).unwrap()
    };
    Mesh::merged(&[
        block([-0.045, -0.03, 0.0], [0.045, 0.03, 0.045], [190, 60, 40]),
        block([-0.01, -0.02, 0.045], [0.04, 0.02, 0.1], [40, 110, 170]),
    ])
    .unwrap()
}

fn camera() -> Camera {
    Camera::new(470.0, 470.0, 240.0, 180.0, 480, 360).unwrap()
}

pub struct Photographs {
    files: Vec<Vec<u8>>,
    depth: Vec<Vec<u8>>,
    pub masks: Vec<Mask>,
    camera_from_board: Vec<Pose>,
}

pub fn photographs() -> &'static Photographs {
    static ONCE: OnceLock<Photographs> = OnceLock::new();
    ONCE.get_or_init(|| {
        let options = SimulationOptions {
            photographs: COUNT,
            camera: camera(),
            motion: 0.0,
            blur: 0.4,
            ..SimulationOptions::default()
        };
        let ground = Image::from_fn(64, 64, |x, y| [90 + 30 * ((x / 8 + y / 8) % 2) as u8, 85, 70]);
        let mesh = body();
        let capture = SimulatedCapture::new(&mesh, &Board::new(Paper::A4), &ground, &options, 3);
        Photographs {
            files: (0..COUNT).map(|i| png(&capture.photograph(i).unwrap())).collect(),
            depth: (0..COUNT).map(|i| depth_png(&capture.depth(i).unwrap())).collect(),
            masks: (0..COUNT).map(|i| capture.mask(i).unwrap()).collect(),
            camera_from_board: capture.camera_from_board.clone(),
        }
    })
}

/// The bytes of a file that a function of `sixfold-io` writes.
pub fn written(write: impl FnOnce(&std::path::Path)) -> Vec<u8> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("image.png");
    write(&path);
    std::fs::read(path).unwrap()
}

pub fn png(image: &RgbImage) -> Vec<u8> {
    written(|path| sixfold_io::write_rgb(path, image).unwrap())
}

fn depth_png(depth: &DepthImage) -> Vec<u8> {
    written(|path| sixfold_io::write_depth(path, depth, 1e-3).unwrap())
}

pub fn mask_png(mask: &Mask) -> Vec<u8> {
    written(|path| sixfold_io::write_mask(path, mask).unwrap())
}

fn with_camera(form: Form) -> Form {
    let c = camera();
    let text =
        json!({ "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "width": c.width, "height": c.height });
    form.file("camera", "camera.json", text.to_string().as_bytes())
}

/// The first photographs as a form.
pub fn form(name: &str, count: usize) -> Form {
    let form = with_camera(Form::default().text("name", name).text("hull_only", "true"));
    let files = photographs().files.iter().take(count).enumerate();
    files.fold(form, |form, (i, file)| form.file("photographs", &format!("{i}.png"), file))
}

pub fn put(server: &TestServer, path: &str, body: &[u8]) -> Reply {
    send(server.address, "PUT", path, &[], body)
}

pub fn post(server: &TestServer, path: &str) -> Reply {
    send(server.address, "POST", path, &[], b"")
}

pub fn id_of(value: &Value) -> String {
    value["id"].as_str().unwrap().to_owned()
}

fn job_of(teaching: &Value) -> String {
    id_of(&teaching["job"])
}

pub fn decoded(reply: &Reply) -> RgbImage {
    sixfold_io::ImageFile::of_bytes(std::path::Path::new("image"), &reply.body).rgb().unwrap()
}

fn rows(pose: &Pose) -> Value {
    let m = pose.to_matrix();
    json!((0..4).map(|i| (0..4).map(|j| m[(i, j)]).collect()).collect::<Vec<Vec<f64>>>())
}

#[test]
fn an_object_is_taught_corrected_accepted_and_kept() {
    let server = TestServer::new();
    let teaching = server.post("/v1/teachings", &form("body", COUNT)).expect(201).json();
    let path = format!("/v1/teachings/{}", id_of(&teaching));
    let show = || server.get(&path).expect(200).json();
    // Readers can access it while the job has the folder; nothing else changes it then.
    let mut seen = vec![];
    let ended = events(server.address, &job_of(&teaching), |event| {
        assert_eq!(show()["photographs"].as_array().unwrap().len(), COUNT);
        if event["state"] == "running" {
            seen.push(event["progress"]["step"].as_str().unwrap().to_owned());
            send(server.address, "DELETE", &path, &[], b"").expect(409);
        }
    });
    assert_eq!(ended.last().unwrap()["state"], "done", "{}", ended.last().unwrap());
    assert!(seen.iter().any(|step| step == "finding the object"), "{seen:?}");
    let taught = show();
    assert_eq!(taught["state"], "taught");
    assert!(taught["photographs"].as_array().unwrap().iter().all(|p| p["state"] == "used"), "{taught}");
    let diameter = taught["mesh"]["diameter"].as_f64().unwrap();
    assert!((diameter - 0.147).abs() < 0.015, "{diameter}");
    let image =
        |kind: &str| decoded(&server.get(&format!("{path}/photographs/2/{kind}.jpg?side=240")).expect(200));
    let (plain, overlay) = (image("image"), image("overlay"));
    assert_eq!(overlay.size(), (240, 180));
    let far = |(a, b): &(&[u8; 3], &[u8; 3])| (0..3).any(|c| a[c].abs_diff(b[c]) > 60);
    let lines = plain.as_slice().iter().zip(overlay.as_slice()).filter(far).count();
    assert!((100..3000).contains(&lines), "border and outline: {lines} pixels");
    server.get(&format!("{path}/photographs/2/mask.png")).expect(200);
    server.get(&format!("{path}/mesh.ply?faces=500")).expect(200);
    corrected(&server, &path);
    // Only the mesh is made again, which needs no network.
    let job = post(&server, &format!("{path}/run")).expect(202).json();
    let done = server.result(&id_of(&job)).expect(200).json();
    assert_eq!((&done["photographs"], &done["left_out"][0]["photograph"]), (&json!(5), &json!("4.png")));
    let accepted = post(&server, &format!("{path}/accept")).expect(202).json();
    let stored = server.result(&id_of(&accepted)).expect(200).json();
    assert_eq!((&stored["object"], &stored["photographs"]), (&json!("/v1/objects/body"), &json!(5)));
    server.get("/v1/objects/body/thumbnail.png").expect(200);
    let files = server.get("/v1/objects/body").expect(200).json()["files"].to_string();
    assert!(files.contains("ppf.bin") && files.contains("views"), "{files}");
    // Everything is there after a restart. The teaching may replace the object that it stored itself, but not another one.
    let server = TestServer::within(server.end(), |o| o);
    let after = server.get(&path).expect(200).json();
    assert_eq!((&after["state"], &after["object"]), (&json!("accepted"), &json!("body")));
    assert_eq!(after["photographs"][1]["mask_by"], "person");
    send(server.address, "POST", &format!("{path}/accept"), &[], b"{\"name\": \"duck\"}").expect(409);
    assert_eq!(server.post("/v1/teachings", &form("body", COUNT)).expect(409).json()["field"], "name");
    let list = server.get("/v1/teachings").expect(200).json();
    assert_eq!(list["teachings"].as_array().unwrap().len(), 1);
    send(server.address, "DELETE", &path, &[], b"").expect(204);
    server.get(&path).expect(404);
    server.get("/v1/objects/body").expect(200);
}

/// Corrects a mask, a pose by matrix and by points, and leaves a photograph out; then removes the corrections that would
/// change all masks.
fn corrected(server: &TestServer, path: &str) {
    let truth = photographs();
    let photograph = |number: usize, what: &str| format!("{path}/photographs/{number}/{what}");
    let after = put(server, &photograph(1, "mask"), &mask_png(&truth.masks[1])).expect(200).json();
    assert_eq!((&after["state"], &after["mesh"]["is_current"]), (&json!("ready"), &json!(false)));
    assert_eq!(after["photographs"][1]["mask_by"], "person");
    assert_eq!(after["photographs"][0]["mask_by"], "program", "other masks stay");
    server.get(&format!("{path}/mesh.ply?faces=500")).expect(200);
    // A mask of the size in which images are sent.
    let half = Image::from_fn(240, 180, |x, y| truth.masks[1][(2 * x, 2 * y)]);
    put(server, &photograph(1, "mask"), &mask_png(&half)).expect(200);
    let after = put(server, &photograph(4, "left_out"), b"{\"left_out\": true}").expect(200).json();
    assert_eq!(after["photographs"][4]["state"], "left_out_by_person");
    for (what, body, status, field) in [
        ("mask", mask_png(&Image::filled(30, 30, true)), 422, "mask"),
        ("mask", mask_png(&Image::filled(480, 360, false)), 422, "mask"),
        ("mask", b"text".to_vec(), 422, "mask"),
        ("pose", b"{}".to_vec(), 422, "camera_from_board"),
        ("pose", b"{\"pairs\": []}".to_vec(), 422, "pairs"),
        (
            "pose",
            br#"{"camera_from_board": [[2,0,0,0],[0,1,0,0],[0,0,1,0.5],[0,0,0,1]]}"#.to_vec(),
            422,
            "camera_from_board",
        ),
        (
            "pose",
            br#"{"camera_from_board": [[1,0,0,0],[0,1,0,0],[0,0,1,500],[0,0,0,1]]}"#.to_vec(),
            422,
            "camera_from_board",
        ),
        ("left_out", b"yes".to_vec(), 422, "body"),
    ] {
        let problem = put(server, &photograph(1, what), &body).expect(status).json();
        assert_eq!(problem["field"], field, "{problem}");
    }
    put(server, &photograph(99, "left_out"), b"{\"left_out\": true}").expect(404);
    put(server, &photograph(0, "left_out"), b"{\"left_out\": false}").expect(200);
}

#[test]
fn a_pose_is_given_by_a_matrix_or_by_points() {
    let truth = photographs();
    let server = TestServer::new();
    let all = form("posed", COUNT).text("start", "false");
    let teaching = server.post("/v1/teachings", &all).expect(201).json();
    assert_eq!((&teaching["state"], &teaching["job"]), (&json!("ready"), &Value::Null));
    let path = format!("/v1/teachings/{}", id_of(&teaching));
    let pose = format!("{path}/photographs/3/pose");
    let matrix = json!({ "camera_from_board": rows(&truth.camera_from_board[3]) }).to_string();
    assert_eq!(put(&server, &pose, matrix.as_bytes()).expect(409).json()["field"], Value::Null);
    // Masks by a person, so that no network runs.
    for (i, mask) in truth.masks.iter().enumerate() {
        put(&server, &format!("{path}/photographs/{i}/mask"), &mask_png(mask)).expect(200);
    }
    let job = post(&server, &format!("{path}/run")).expect(202).json();
    server.result(&id_of(&job)).expect(200);
    let after = put(&server, &pose, matrix.as_bytes()).expect(200).json();
    assert_eq!(after["photographs"][3]["pose_by"], "person");
    let points = [[0.0, 0.0, 0.0], [0.07, 0.01, 0.0], [-0.02, 0.06, 0.05]];
    let seen = |pose: &Pose, p: [f64; 3]| camera().project(&pose.transform_point(&Vec3::from(p))).unwrap();
    let pairs = |count: usize| {
        let pair = |p: &[f64; 3]| {
            let pixel = seen(&truth.camera_from_board[3], *p);
            json!({ "point": p, "pixel": [pixel.x, pixel.y] })
        };
        json!({ "pairs": points[..count].iter().map(pair).collect::<Vec<_>>() }).to_string()
    };
    assert_eq!(put(&server, &pose, pairs(2).as_bytes()).expect(422).json()["field"], "pairs");
    let after = put(&server, &pose, pairs(3).as_bytes()).expect(200).json();
    let found = after["photographs"][3]["camera_from_board"][2][3].as_f64().unwrap();
    assert!((found - truth.camera_from_board[3].translation().z).abs() < 1e-6);
    let after = send(server.address, "DELETE", &format!("{path}/photographs/3/corrections"), &[], b"");
    assert_eq!(after.expect(200).json()["photographs"][3]["pose_by"], Value::Null);
}

#[test]
fn depth_images_belong_to_the_photographs_by_their_names() {
    let truth = photographs();
    let server = TestServer::new();
    // Sent in a different order from their names.
    let all = (0..3).rev().fold(with_camera(Form::default().text("name", "deep")), |form, i| {
        form.file("photographs", &format!("{i}.png"), &truth.files[i])
    });
    let all = all.text("start", "false").text("depth_scale", "1");
    let files = [1, 0, 2].into_iter();
    let whole = files.fold(all.clone(), |form, i| form.file("depth", &format!("d{i}.png"), &truth.depth[i]));
    let few = all.file("depth", "d0.png", &truth.depth[0]);
    assert_eq!(server.post("/v1/teachings", &few).expect(422).json()["field"], "depth");
    let teaching = server.post("/v1/teachings", &whole).expect(201).json();
    assert!(teaching["photographs"].as_array().unwrap().iter().all(|p| p["has_depth"] == true), "{teaching}");
    let path = format!("/v1/teachings/{}", id_of(&teaching));
    for (i, mask) in truth.masks.iter().take(3).enumerate() {
        put(&server, &format!("{path}/photographs/{i}/mask"), &mask_png(mask)).expect(200);
    }
    let job = post(&server, &format!("{path}/run")).expect(202).json();
    let done = server.result(&id_of(&job)).expect(200).json();
    assert!(done["with_depth"].as_f64().unwrap() > 0.9, "{done}");
    // Depth of another photograph would contradict the masks and carve the object away.
    let diameter = done["mesh"]["diameter"].as_f64().unwrap();
    assert!((diameter - 0.147).abs() < 0.02, "{done}");
}

#[test]
fn one_photograph_with_depth_needs_no_board() {
    let truth = photographs();
    let server = TestServer::new();
    let one = |depth: &[u8]| {
        with_camera(Form::default().text("name", "one").text("without_board", "true"))
            .text("depth_scale", "1")
            .file("photographs", "0.png", &truth.files[0])
            .file("depth", "0.png", depth)
    };
    let teaching = server.post("/v1/teachings", &one(&truth.depth[0])).expect(201).json();
    let done = server.result(&job_of(&teaching)).expect(200).json();
    assert_eq!(done["photographs"], 1, "{done}");
    let diameter = done["mesh"]["diameter"].as_f64().unwrap();
    assert!((diameter - 0.147).abs() < 0.02 && done["unseen"].as_f64().unwrap() > 0.3, "{done}");
    let noise =
        Image::from_fn(480, 360, |x, y| 0.5 + 0.4 * ((x * 7919 + y * 104_729) % 1000) as f32 / 1000.0);
    let (_, problem) = failed(&server, &one(&depth_png(&noise)));
    assert_eq!(problem["field"], "depth", "{problem}");
    assert!(problem["error"].as_str().unwrap().contains("no table"), "{problem}");
}

#[test]
fn a_teaching_survives_a_kill_and_a_cancelled_one_resumes() {
    let folder = tempfile::tempdir().unwrap();
    let (mut process, address) = to_be_killed(folder.path());
    let teaching = form("body", COUNT).post(address, "/v1/teachings").expect(201).json();
    let job = job_of(&teaching);
    let mut killed = false;
    events(address, &job, |event| {
        if event["progress"]["step"] == "finding the object" && !killed {
            process.kill().unwrap();
            killed = true;
        }
    });
    process.wait().unwrap();
    assert!(killed);
    let server = TestServer::within(folder, |o| o);
    let path = format!("/v1/teachings/{}", id_of(&teaching));
    // The job runs again automatically; after cancelling, finished steps are kept.
    let mut cancelled = false;
    let ended = events(server.address, &job, |event| {
        if event["progress"]["step"] == "finding the object" && !cancelled {
            cancelled = true;
            post(&server, &format!("/v1/jobs/{job}/cancel")).expect(200);
        }
    });
    assert_eq!(ended.last().unwrap()["state"], "cancelled");
    let now = server.get(&path).expect(200).json();
    assert_eq!(now["state"], "ready");
    assert!(now["photographs"][0]["camera_from_board"].is_array(), "poses were found already: {now}");
    let again = post(&server, &format!("{path}/run")).expect(202).json();
    result(server.address, &id_of(&again)).expect(200);
    assert_eq!(server.get(&path).expect(200).json()["state"], "taught");
}

#[test]
fn invalid_teachings_are_refused_with_advice() {
    let truth = photographs();
    let server = TestServer::new();
    let named = |name: &str| Form::default().text("name", name);
    let photograph = |form: Form| form.file("photographs", "0.png", &truth.files[0]);
    let zip = [b"PK\x03\x04".as_slice(), &[0; 200]].concat();
    for (form, status, field, word) in [
        (named("a"), 422, "photographs", "nothing"),
        (photograph(Form::default()), 422, "name", "nothing"),
        (photograph(named("../a")), 400, "name", "letters"),
        (photograph(named("duck")), 409, "name", "exists already"),
        (named("a").file("photographs", "a.jpg", b"text"), 422, "photographs", "a.jpg: "),
        (named("a").file("photographs", "a.zip", &zip), 422, "photographs", "neither PNG nor JPEG"),
        (named("a").file("photographs", "../../a.png", &truth.files[0]), 400, "photographs", "../../a.png"),
        (photograph(photograph(named("a"))), 422, "photographs", "different names"),
        (photograph(named("a")).text("ruler", "5"), 422, "ruler", "10 to 1000"),
        (photograph(named("a")).file("depth", "d.png", &truth.files[0]), 422, "depth_scale", "nothing"),
        (
            photograph(named("a")).file("depth", "d.png", &truth.files[0]).text("depth_scale", "1"),
            422,
            "depth",
            "16 bits",
        ),
        (photograph(named("a")).file("camera", "c.json", b"{}"), 422, "camera", "camera"),
        (photograph(named("a")).text("start", "maybe"), 422, "start", "true or false"),
    ] {
        let problem = server.post("/v1/teachings", &form).expect(status).json();
        assert_eq!(problem["field"], field, "{problem}");
        assert!(problem["error"].as_str().unwrap().contains(word), "{word}: {problem}");
        assert!(!problem["error"].as_str().unwrap().contains("/tmp"), "{problem}");
    }
    let none = server.get("/v1/teachings").expect(200).json();
    assert_eq!(none["teachings"], json!([]));
    let folder = server.folder.path().join("data/teachings");
    assert_eq!(std::fs::read_dir(folder).unwrap().count(), 0, "nothing is left of what was refused");
    for path in [
        "/v1/teachings/..%2F..%2Fobjects",
        "/v1/teachings/x/mesh.ply",
        "/v1/teachings/x/photographs/0/image.jpg",
    ] {
        assert_eq!(server.get(path).expect(404).json()["field"], "id", "{path}");
    }
}

/// The state of a teaching after its job has failed.
fn failed(server: &TestServer, form: &Form) -> (String, Value) {
    let teaching = server.post("/v1/teachings", form).expect(201).json();
    let problem = server.result(&job_of(&teaching)).expect(422).json();
    let path = format!("/v1/teachings/{}", id_of(&teaching));
    let now = server.get(&path).expect(200).json();
    assert_eq!((&now["state"], &now["problem"]), (&json!("failed"), &problem));
    (path, problem)
}

#[test]
fn photographs_that_do_not_do_are_kept_and_more_of_them_help() {
    let truth = photographs();
    let server = TestServer::new();
    let (path, problem) = failed(&server, &form("few", 2));
    assert!(problem["error"].as_str().unwrap().contains("found 2 photographs"), "{problem}");
    assert!(problem["advice"].as_str().unwrap().contains("add photographs"), "{problem}");
    post(&server, &format!("{path}/accept")).expect(409);
    // One of another size is left out, with the reason.
    let small = png(&Image::from_fn(240, 180, |x, y| [x as u8, y as u8, 0]));
    let more = (2..COUNT)
        .fold(Form::default(), |form, i| form.file("photographs", &format!("{i}.png"), &truth.files[i]));
    let bad = more.clone().file("photographs", "text.jpg", b"text");
    server.post(&format!("{path}/photographs"), &bad).expect(422);
    assert_eq!(
        server.get(&path).expect(200).json()["photographs"].as_array().unwrap().len(),
        2,
        "all or none"
    );
    let more = more.file("photographs", "small.png", &small);
    server.post(&format!("{path}/photographs"), &more).expect(200);
    server.post(&format!("{path}/photographs"), &Form::default()).expect(422);
    for (i, mask) in truth.masks.iter().enumerate() {
        put(&server, &format!("{path}/photographs/{i}/mask"), &mask_png(mask)).expect(200);
    }
    let job = post(&server, &format!("{path}/run")).expect(202).json();
    let done = server.result(&id_of(&job)).expect(200).json();
    assert_eq!(done["left_out"][0]["photograph"], "small.png", "{done}");
    assert!(done["left_out"][0]["reason"].as_str().unwrap().contains("240x180"), "{done}");
    let back =
        put(&server, &format!("{path}/photographs/6/left_out"), b"{\"left_out\": false}").expect(409).json();
    assert!(back["error"].as_str().unwrap().contains("small.png is left out"), "{back}");
    // Photographs without the board.
    let plain = png(&Image::from_fn(480, 360, |x, y| [x as u8, y as u8, 90]));
    let without = (0..4).fold(with_camera(Form::default().text("name", "none")), |form, i| {
        form.file("photographs", &format!("{i}.png"), &plain)
    });
    let (_, problem) = failed(&server, &without);
    assert!(problem["error"].as_str().unwrap().contains("no photograph shows a board"), "{problem}");
    assert!(problem["advice"].as_str().unwrap().contains("sixfold board"), "{problem}");
}
