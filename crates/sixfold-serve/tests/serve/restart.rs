//! A server that is killed: results stay, and running or waiting jobs are processed by the next server.

use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::AtomicBool;

use crate::support::{TestServer, events, expected, fill, options, result, search};
use sixfold_serve::Server;

const FOLDER: &str = "SIXFOLD_SERVE_TEST_FOLDER";

/// Not a test: the server that [`accepted_requests_survive_a_kill`] starts as a separate process and kills.
#[test]
#[ignore = "started by another test"]
fn serve_until_killed() {
    let Some(folder) = std::env::var_os(FOLDER) else { return };
    let server = Server::start(options(folder.as_ref())).unwrap();
    println!("address {}", server.address());
    server.run_until(&AtomicBool::new(false));
}

/// A server in a separate process, and its address.
pub fn to_be_killed(folder: &Path) -> (Child, SocketAddr) {
    let mut process = Command::new(std::env::current_exe().unwrap())
        .args(["restart::serve_until_killed", "--exact", "--ignored", "--nocapture"])
        .env(FOLDER, folder)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let lines = BufReader::new(process.stdout.take().unwrap()).lines().map_while(Result::ok);
    // The test harness may have started the line.
    let address = lines.filter_map(|l| l.split_once("address ").map(|(_, a)| a.parse().unwrap())).next();
    (process, address.expect("the server prints its address"))
}

#[test]
fn accepted_requests_survive_a_kill() {
    let folder = tempfile::tempdir().unwrap();
    fill(&folder.path().join("objects"));
    let (mut process, address) = to_be_killed(folder.path());
    let post = |objects: &str| {
        let job = search(objects).post(address, "/v1/find").expect(202).json();
        job["id"].as_str().unwrap().to_owned()
    };
    let done = post("duck");
    let before = result(address, &done).expect(200).json();
    let (running, waiting) = (post("driller,cat"), post("duck"));
    let mut killed = false;
    events(address, &running, |event| {
        if event["progress"]["step"] == "cat" && !killed {
            process.kill().unwrap();
            killed = true;
        }
    });
    process.wait().unwrap();
    assert!(killed);
    let server = TestServer::within(folder, |o| o);
    assert_eq!(server.result(&done).expect(200).json(), before);
    server.get(&format!("/v1/jobs/{done}/overlay.png")).expect(200);
    let again = server.result(&running).expect(200).json();
    assert_eq!(again["poses"][0]["camera_from_object"], expected("driller"));
    assert_eq!(
        server.result(&waiting).expect(200).json()["poses"][0]["camera_from_object"],
        expected("duck")
    );
    // Nothing is lost after an orderly shutdown either.
    let id = search("ape,duck").post(server.address, "/v1/find").expect(202).json();
    let folder = server.end();
    let server = TestServer::within(folder, |o| o);
    let found = server.result(id["id"].as_str().unwrap()).expect(200).json();
    assert_eq!(found["poses"].as_array().unwrap().len() + found["not_found"].as_array().unwrap().len(), 2);
}
