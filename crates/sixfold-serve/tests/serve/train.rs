//! Training a network for a taught object over HTTP: beside other jobs, cancelled, resumed, and used.

use serde_json::{Value, json};

use crate::support::{Reply, TestServer, events, frame, search, send};
use crate::teach::{COUNT, form, id_of, mask_png, photographs, post, put};

/// Stores the object `body` from photographs with given masks, which needs no network.
fn taught(server: &TestServer) {
    let all = form("body", COUNT).text("start", "false");
    let teaching = server.post("/v1/teachings", &all).expect(201).json();
    let path = format!("/v1/teachings/{}", id_of(&teaching));
    for (i, mask) in photographs().masks.iter().enumerate() {
        put(server, &format!("{path}/photographs/{i}/mask"), &mask_png(mask)).expect(200);
    }
    for step in ["run", "accept"] {
        let job = post(server, &format!("{path}/{step}")).expect(202).json();
        server.result(&id_of(&job)).expect(200);
    }
}

fn train(server: &TestServer, object: &str, body: &Value) -> Reply {
    let path = format!("/v1/objects/{object}/training");
    send(server.address, "POST", &path, &[], body.to_string().as_bytes())
}

fn object(server: &TestServer) -> Value {
    server.get("/v1/objects/body").expect(200).json()
}

#[test]
fn a_network_is_trained_beside_other_jobs_resumed_and_used() {
    let server = TestServer::new();
    taught(&server);
    assert_eq!(
        (&object(&server)["has_photographs"], &object(&server)["has_weights"]),
        (&json!(true), &json!(false))
    );
    for (name, body, status, field) in [
        ("duck", json!({}), 422, json!("name")),
        ("nothing", json!({}), 404, json!("name")),
        ("body", json!({ "steps": 0 }), 422, json!("steps")),
        ("body", json!({ "view_step": 0.5 }), 422, json!("view_step")),
        ("body", json!({ "epochs": 3 }), 422, json!("body")),
    ] {
        let problem = train(&server, name, &body).expect(status).json();
        assert_eq!(problem["field"], field, "{problem}");
    }
    // A long training: other jobs do not wait for it, and a second one of the object is refused.
    let long = json!({ "steps": 5000, "view_step": 60 });
    let job = train(&server, "body", &long).expect(202).json();
    assert_eq!((&job["kind"], &job["object"]), (&json!("train"), &json!("body")));
    let problem = train(&server, "body", &long).expect(409).json();
    assert!(problem["error"].as_str().unwrap().contains("waits or runs"), "{problem}");
    server.result_of("/v1/find", &search("duck")).expect(200);
    let state = server.get(&format!("/v1/jobs/{}", id_of(&job))).expect(200).json();
    assert_eq!(state["state"], "running", "{state}");
    // It resumes on the next server, until it is cancelled.
    let server = TestServer::within(server.end(), |o| o);
    let mut cancelled = false;
    let ended = events(server.address, &id_of(&job), |event| {
        if event["state"] == "running" && !cancelled {
            cancelled = true;
            post(&server, &format!("/v1/jobs/{}/cancel", id_of(&job))).expect(200);
        }
    });
    assert_eq!(ended.last().unwrap()["state"], "cancelled");
    // A short one ends, and its weights are used. The views are not made again.
    let short = json!({ "steps": 2, "view_step": 60 });
    let job = train(&server, "body", &short).expect(202).json();
    let result = server.result(&id_of(&job)).expect(200).json();
    assert_eq!((&result["steps"], &result["photographs"]), (&json!(2), &json!(COUNT)), "{result}");
    assert!(result["synthesized"].as_u64().unwrap() > 0, "{result}");
    assert_eq!(object(&server)["has_weights"], true);
    assert!(!server.folder.path().join("data/trainings/body").exists(), "nothing is left in the data folder");
    train(&server, "body", &short).expect(409);
    let find = |objects: &str| {
        frame().text("objects", objects).text("method", "pix2pose").text("box", "100,100,200,200")
    };
    server.result_of("/v1/find", &find("body")).expect(200);
    let refused = server.result_of("/v1/find", &find("duck")).expect(422).json();
    assert!(refused["error"].as_str().unwrap().contains("weights of its own"), "{refused}");
}
