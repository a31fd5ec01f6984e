//! Access control: tokens, names of other machines, pages of other origins; and the pages themselves.

use sixfold_serve::{Server, ServerOptions};

use crate::support::{Form, TestServer, frame, options, send};

const TOKEN: &str = "0123456789abcdef";

#[test]
fn a_token_is_asked_for_and_its_cookie_does() {
    let server = TestServer::with(|o| ServerOptions { token: Some(TOKEN.into()), ..o });
    let get = |headers: &[(&str, &str)]| send(server.address, "GET", "/v1/objects", headers, b"");
    let problem = get(&[]).expect(401).json();
    assert!(problem["advice"].as_str().unwrap().contains("Bearer"), "{problem}");
    get(&[("Authorization", "Bearer 0123456789abcdeX")]).expect(401);
    get(&[("Authorization", "Bearer 0123456789abcdef")]).expect(200);
    frame().text("objects", "duck").post(server.address, "/v1/find").expect(401);
    // Pages and health need no token.
    for path in ["/", "/find", "/v1/health", "/static/app.css"] {
        server.get(path).expect(200);
    }
    let session = |body: &str| send(server.address, "POST", "/v1/session", &[], body.as_bytes());
    session(r#"{"token": "another"}"#).expect(401);
    session("token").expect(422);
    let reply = session(&format!(r#"{{"token": "{TOKEN}"}}"#)).expect(200);
    let line = reply.head.lines().find(|l| l.to_ascii_lowercase().starts_with("set-cookie: ")).unwrap();
    assert!(line.contains("HttpOnly") && line.contains("SameSite=Strict") && !line.contains(TOKEN), "{line}");
    let cookie = line.split_once(' ').unwrap().1.split(';').next().unwrap();
    get(&[("Cookie", cookie)]).expect(200);
    // With a token, the server can be addressed by any name.
    get(&[("Cookie", cookie), ("Host", "robot.example")]).expect(200);
}

#[test]
fn another_address_than_loopback_needs_a_token() {
    let folder = tempfile::tempdir().unwrap();
    let open = ServerOptions { host: "0.0.0.0".parse().unwrap(), ..options(folder.path()) };
    let message = Server::start(open).err().unwrap().to_string();
    assert!(message.contains("--token") && message.contains("0.0.0.0"), "{message}");
}

#[test]
fn a_port_and_a_data_folder_serve_one_server() {
    let server = TestServer::new();
    let other = tempfile::tempdir().unwrap();
    let taken = ServerOptions { port: server.address.port(), ..options(other.path()) };
    let message = Server::start(taken).err().unwrap().to_string();
    assert!(message.contains("--port"), "{message}");
    let message = Server::start(options(server.folder.path())).err().unwrap().to_string();
    assert!(message.contains("--data"), "{message}");
}

#[test]
fn foreign_names_and_foreign_pages_are_refused() {
    let server = TestServer::new();
    let get = |host: &str| send(server.address, "GET", "/v1/objects", &[("Host", host)], b"");
    assert_eq!(get("evil.example").expect(403).json()["field"], "Host");
    get(&format!("localhost:{}", server.address.port())).expect(200);
    let own = format!("http://{}", server.address);
    for (origin, status) in [("http://evil.example", 403), ("null", 403), (own.as_str(), 404)] {
        let headers = [("Origin", origin)];
        send(server.address, "DELETE", "/v1/objects/none", &headers, b"").expect(status);
        Form::default().post_with(server.address, "/v1/jobs/none/cancel", &headers).expect(status);
    }
    server.get("/v1/objects/cat").expect(200);
}

#[test]
fn pages_allow_nothing_from_elsewhere() {
    let server = TestServer::new();
    for path in ["/", "/find", "/grasp"] {
        let reply = server.get(path).expect(200);
        assert!(reply.head.contains("default-src 'self'"), "{}", reply.head);
        assert!(String::from_utf8(reply.body).unwrap().contains("</html>"));
    }
    let unknown = server.get("/nothing").expect(404).json();
    assert!(unknown["error"].is_string());
    send(server.address, "DELETE", "/v1/health", &[], b"").expect(405).json();
    let description = server.get("/v1/openapi.json").expect(200).json();
    assert!(description["openapi"].as_str().unwrap().starts_with("3.1"));
}
