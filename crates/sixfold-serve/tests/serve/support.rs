//! What the tests share: a server with the demo's objects, a small HTTP client, and the demo's frame as a form.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use serde_json::Value;
use sixfold_estimator::{NewObject, ObjectRecord, ObjectStore};
use sixfold_mesh::{ModelInfo, ModelsInfo, Unit, read_mesh};
use sixfold_serve::{Server, ServerOptions};
use tempfile::TempDir;

/// Objects of the demo's models with their names here.
pub const OBJECTS: [(&str, u32); 4] = [("ape", 1), ("cat", 6), ("driller", 8), ("duck", 9)];

pub fn demo(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data/demo").join(path)
}

pub fn read(path: &str) -> Vec<u8> {
    std::fs::read(demo(path)).unwrap()
}

/// Fills a store with [`OBJECTS`] and their symmetries, without derived data.
pub fn fill(store: &Path) {
    let infos = ModelsInfo::read(demo("models/models_info.json")).unwrap();
    for (name, id) in OBJECTS {
        let file = demo(&format!("models/obj_{id:06}.ply"));
        let mesh = read_mesh(&file, Unit::Millimetre).unwrap();
        let of_file = &infos.0[&id];
        let info = ModelInfo {
            symmetries_discrete: of_file.symmetries_discrete.clone(),
            symmetries_continuous: of_file.symmetries_continuous.clone(),
            ..ModelInfo::of_mesh(&mesh)
        };
        let record = ObjectRecord::of_mesh(&file, Unit::Millimetre, &mesh, &info);
        let new = NewObject { mesh: Some(&mesh), record: &record, replace: false };
        ObjectStore::new(store).add(name, new, |_| Ok(())).unwrap();
    }
}

/// A server with its own folders.
pub struct TestServer {
    pub address: SocketAddr,
    pub folder: TempDir,
    server: Option<Server>,
}

pub fn options(folder: &Path) -> ServerOptions {
    ServerOptions { port: 0, ..ServerOptions::new(folder.join("objects"), folder.join("data")) }
}

impl TestServer {
    /// A server with the demo's objects.
    pub fn new() -> TestServer {
        TestServer::with(|options| options)
    }

    pub fn with(change: impl FnOnce(ServerOptions) -> ServerOptions) -> TestServer {
        let folder = tempfile::tempdir().unwrap();
        fill(&folder.path().join("objects"));
        TestServer::within(folder, change)
    }

    /// A server in a folder that another server may have used before.
    pub fn within(folder: TempDir, change: impl FnOnce(ServerOptions) -> ServerOptions) -> TestServer {
        let server = Server::start(change(options(folder.path()))).unwrap();
        TestServer { address: server.address(), folder, server: Some(server) }
    }

    /// Stops the server and keeps its folder.
    pub fn end(mut self) -> TempDir {
        drop(self.server.take());
        std::mem::replace(&mut self.folder, tempfile::tempdir().unwrap())
    }

    pub fn get(&self, path: &str) -> Reply {
        send(self.address, "GET", path, &[], b"")
    }

    pub fn post(&self, path: &str, form: &Form) -> Reply {
        form.post(self.address, path)
    }

    /// Sends a form that becomes a job, and waits for its result.
    pub fn result_of(&self, path: &str, form: &Form) -> Reply {
        let job = self.post(path, form).expect(202).json();
        self.result(job["id"].as_str().unwrap())
    }

    pub fn result(&self, id: &str) -> Reply {
        result(self.address, id)
    }
}

/// Waits for the result of a job.
pub fn result(address: SocketAddr, id: &str) -> Reply {
    let began = Instant::now();
    loop {
        let reply = send(address, "GET", &format!("/v1/jobs/{id}/result?wait=30"), &[], b"");
        if reply.status != 202 {
            return reply;
        }
        assert!(began.elapsed() < Duration::from_secs(300), "job {id} takes too long");
    }
}

/// An answer.
#[derive(Debug)]
pub struct Reply {
    pub status: u16,
    pub head: String,
    pub body: Vec<u8>,
}

impl Reply {
    pub fn expect(self, status: u16) -> Reply {
        assert_eq!(self.status, status, "{}\n{}", self.head, String::from_utf8_lossy(&self.body));
        self
    }

    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body)
            .unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&self.body)))
    }
}

/// Sends one request on a new connection.
pub fn send(address: SocketAddr, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Reply {
    let mut stream = connect(address);
    let mut head =
        format!("{method} {path} HTTP/1.1\r\nConnection: close\r\nContent-Length: {}\r\n", body.len());
    if !headers.iter().any(|(name, _)| name.eq_ignore_ascii_case("host")) {
        head += &format!("Host: {address}\r\n");
    }
    for (name, value) in headers {
        head += &format!("{name}: {value}\r\n");
    }
    head += "\r\n";
    stream.write_all(head.as_bytes()).unwrap();
    // A server that refuses a request by its head may close the connection before it has read everything.
    let _ = stream.write_all(body);
    let mut bytes = vec![];
    let _ = stream.read_to_end(&mut bytes);
    let end = bytes.windows(4).position(|w| w == b"\r\n\r\n").unwrap_or_else(|| panic!("no head: {bytes:?}"));
    let head = String::from_utf8(bytes[..end].to_vec()).unwrap();
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    Reply { status, head, body: bytes[end + 4..].to_vec() }
}

pub fn connect(address: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(120))).unwrap();
    stream
}

/// The data of all server-sent events of a job until the server ends the stream; `each` is called with every event as it
/// arrives.
pub fn events(address: SocketAddr, id: &str, mut each: impl FnMut(&Value)) -> Vec<Value> {
    let mut stream = connect(address);
    let head = format!("GET /v1/jobs/{id}/events HTTP/1.1\r\nConnection: close\r\nHost: {address}\r\n\r\n");
    stream.write_all(head.as_bytes()).unwrap();
    let mut all = vec![];
    for line in BufReader::new(stream).lines() {
        let line = line.unwrap();
        if let Some(data) = line.strip_prefix("data: ") {
            let event = serde_json::from_str(data).unwrap();
            each(&event);
            all.push(event);
        }
    }
    all
}

const BOUNDARY: &str = "b0undary";

/// A multipart form.
#[derive(Default, Clone)]
pub struct Form(Vec<u8>);

impl Form {
    pub fn text(mut self, name: &str, value: &str) -> Form {
        let part =
            format!("--{BOUNDARY}\r\nContent-Disposition: form-data; name=\"{name}\"\r\n\r\n{value}\r\n");
        self.0.extend(part.as_bytes());
        self
    }

    pub fn file(mut self, name: &str, file_name: &str, bytes: &[u8]) -> Form {
        let head = format!(
            "--{BOUNDARY}\r\nContent-Disposition: form-data; name=\"{name}\"; filename=\"{file_name}\"\r\n\
             Content-Type: application/octet-stream\r\n\r\n"
        );
        self.0.extend(head.as_bytes());
        self.0.extend(bytes);
        self.0.extend(b"\r\n");
        self
    }

    /// The bytes of the body.
    pub fn body(&self) -> Vec<u8> {
        [self.0.as_slice(), format!("--{BOUNDARY}--\r\n").as_bytes()].concat()
    }

    pub fn post(&self, address: SocketAddr, path: &str) -> Reply {
        self.post_with(address, path, &[])
    }

    pub fn post_with(&self, address: SocketAddr, path: &str, headers: &[(&str, &str)]) -> Reply {
        let kind = format!("multipart/form-data; boundary={BOUNDARY}");
        let headers = [headers, &[("Content-Type", kind.as_str())]].concat();
        send(address, "POST", path, &headers, &self.body())
    }
}

/// The demo's frame 3 with its depth and camera.
pub fn frame() -> Form {
    Form::default()
        .file("depth", "000003.png", &read("test/000002/depth/000003.png"))
        .file("rgb", "000003.png", &read("test/000002/rgb/000003.png"))
        .file("camera", "camera.json", &read("camera.json"))
}

/// The same with objects to search by point pair features, the fastest method.
pub fn search(objects: &str) -> Form {
    frame().text("objects", objects).text("method", "ppf")
}

/// The pose of an object in the demo's frame 3, as the library finds it without a server.
pub fn expected(name: &str) -> Value {
    static POSES: OnceLock<Value> = OnceLock::new();
    POSES.get_or_init(found_without_a_server)[name].clone()
}

fn found_without_a_server() -> Value {
    use sixfold_align::PreparedDepth;
    use sixfold_estimator::{PoseEstimator, Query};
    let folder = tempfile::tempdir().unwrap();
    fill(folder.path());
    let estimator = sixfold_ppf::PpfEstimator::default();
    let file = sixfold_io::CameraFile::read(&demo("camera.json")).unwrap();
    let depth = demo("test/000002/depth/000003.png");
    let depth = sixfold_io::read_depth(&depth, file.depth_scale.unwrap() / 1000.0).unwrap();
    let camera = file.for_image(depth.width(), depth.height(), Path::new("camera.json")).unwrap();
    let prepared = PreparedDepth::new(&depth, &camera, &estimator.depth_options()).unwrap();
    let min_confidence = estimator.min_confidence().image;
    let query = Query { depth: Some(&prepared), min_confidence, ..Query::new(&camera) };
    let run = sixfold_runner::ImageRun { estimator: &estimator, query };
    let store = ObjectStore::new(folder.path());
    // Written and read again, as the numbers of the server are.
    let written =
        |report: &_| -> Value { serde_json::from_slice(&serde_json::to_vec(report).unwrap()).unwrap() };
    let mut poses = serde_json::Map::new();
    for (name, _) in OBJECTS {
        let found = run.find(&store.load(name).unwrap()).unwrap();
        let report = written(&run.report(&[found]));
        poses.insert(name.to_owned(), report["poses"][0]["camera_from_object"].clone());
    }
    poses.into()
}
