//! Several clients at once: every answer belongs to its request.

use std::time::{Duration, Instant};

use crate::support::{OBJECTS, TestServer, expected, search};

/// Minimum time during which clients send requests.
const LONG_ENOUGH: Duration = Duration::from_secs(4);

#[test]
fn eight_clients_at_once_get_their_own_answers() {
    let server = TestServer::with(|o| sixfold_serve::ServerOptions {
        workers: std::num::NonZeroUsize::new(2).unwrap(),
        ..o
    });
    let began = Instant::now();
    let answers: usize = std::thread::scope(|scope| {
        let client = |i: usize| {
            let server = &server;
            scope.spawn(move || {
                let mut answers = 0;
                while answers == 0 || began.elapsed() < LONG_ENOUGH {
                    let (name, _) = OBJECTS[(i + answers) % OBJECTS.len()];
                    let form = search(name);
                    let result = server.result_of("/v1/find", &form).expect(200).json();
                    assert_eq!(result["poses"][0]["object"], name);
                    assert_eq!(result["poses"][0]["camera_from_object"], expected(name), "{name}");
                    answers += 1;
                }
                answers
            })
        };
        let clients: Vec<_> = (0..8).map(client).collect();
        clients.into_iter().map(|c| c.join().unwrap()).sum()
    });
    assert!(answers >= 8);
    let jobs = server.get("/v1/jobs").expect(200).json();
    let jobs = jobs["jobs"].as_array().unwrap();
    assert_eq!(jobs.len(), answers);
    assert!(jobs.iter().all(|job| job["state"] == "done"));
}
