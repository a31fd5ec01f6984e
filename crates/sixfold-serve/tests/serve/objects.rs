//! Objects: listed, rendered, added from an uploaded mesh, found by what was added, removed.

use serde_json::json;

use crate::support::{Form, OBJECTS, TestServer, read, search, send};

#[test]
fn objects_are_listed_and_rendered() {
    let server = TestServer::new();
    let list = server.get("/v1/objects").expect(200).json();
    let names: Vec<&str> =
        list["objects"].as_array().unwrap().iter().map(|o| o["name"].as_str().unwrap()).collect();
    assert_eq!(names, OBJECTS.map(|o| o.0));
    let cat = server.get("/v1/objects/cat").expect(200).json();
    assert!((cat["diameter"].as_f64().unwrap() - 0.1545).abs() < 1e-3, "{cat}");
    // Clients do not get the folders of this machine.
    assert_eq!(cat["source"], "obj_000006.ply");
    let png = server.get("/v1/objects/cat/thumbnail.png").expect(200).body;
    let image = sixfold_io::ImageFile::of_bytes(std::path::Path::new("thumbnail"), &png).rgb().unwrap();
    assert_eq!(image.size(), (320, 320));
    let ground = image[(0, 0)];
    let seen = image.as_slice().iter().filter(|p| **p != ground).count();
    assert!((5_000..90_000).contains(&seen), "{seen} pixels of the cat");
    let ply = server.get("/v1/objects/cat/mesh.ply?faces=1000").expect(200).body;
    let mesh = sixfold_mesh::parse_ply(&ply, "mesh", sixfold_mesh::Unit::Metre, &sixfold_mesh::no_resources);
    let mesh = mesh.unwrap();
    assert!(mesh.faces().len() <= 1000 && (mesh.diameter() - 0.1545).abs() < 5e-3);
    server.get("/v1/objects/cat/mesh.ply?faces=1").expect(422);
}

#[test]
fn an_uploaded_mesh_is_stored_found_replaced_and_removed() {
    let server = TestServer::new();
    let mesh = read("models/obj_000009.ply");
    let form = Form::default().text("name", "my-duck").text("unit", "mm").file("mesh", "Duck.PLY", &mesh);
    let stored = server.result_of("/v1/objects", &form).expect(200).json();
    assert_eq!(stored["name"], "my-duck");
    assert_eq!(stored["record"]["source"], "Duck.PLY");
    let files = server.get("/v1/objects/my-duck").expect(200).json()["files"].to_string();
    assert!(files.contains("ppf.bin"), "{files}");
    let found = server.result_of("/v1/find", &search("my-duck")).expect(200).json();
    assert_eq!(found["poses"][0]["object"], "my-duck");
    let problem = server.post("/v1/objects", &form).expect(409).json();
    assert_eq!(problem["field"], "name");
    // After it was replaced by another mesh, the next request uses the new one.
    let other = read("models/obj_000008.ply");
    let form = Form::default()
        .text("name", "my-duck")
        .text("unit", "mm")
        .text("symmetric_about", "z")
        .text("replace", "true")
        .file("mesh", "driller.ply", &other);
    let stored = server.result_of("/v1/objects", &form).expect(200).json();
    assert_eq!(stored["record"]["symmetries_continuous"].as_array().unwrap().len(), 1);
    let found = server.result_of("/v1/find", &search("my-duck,driller")).expect(200).json();
    let at = |i: usize| found["poses"][i]["camera_from_object"][2][3].as_f64().unwrap();
    assert!((at(0) - at(1)).abs() < 0.03, "{found}");
    let remove = || send(server.address, "DELETE", "/v1/objects/my-duck", &[], b"");
    remove().expect(204);
    remove().expect(404);
    server.get("/v1/objects/my-duck/thumbnail.png").expect(404);
}

#[test]
fn sure_symmetries_of_an_uploaded_mesh_are_stored() {
    let server = TestServer::new();
    // A cuboid of three different sides: three half turns map it onto itself.
    let corner = |i: usize| format!("v {} {} {}\n", 40 * (i & 1), 60 * (i >> 1 & 1), 100 * (i >> 2));
    let faces = "f 1 3 4 2\nf 5 6 8 7\nf 1 2 6 5\nf 3 7 8 4\nf 1 5 7 3\nf 2 4 8 6\n";
    let mesh = (0..8).map(corner).collect::<String>() + faces;
    let form = |name: &str| {
        Form::default().text("name", name).text("unit", "mm").file("mesh", "box.obj", mesh.as_bytes())
    };
    let stored = |form: &Form| server.result_of("/v1/objects", form).expect(200).json();
    let plain = stored(&form("plain"));
    assert_eq!(plain["record"]["symmetries_discrete"], json!([]));
    let found = stored(&form("found").text("find_symmetries", "colors").text("noise", "0.1"));
    assert_eq!(found["record"]["symmetries_discrete"].as_array().unwrap().len(), 3, "{found}");
    assert!(found["symmetries"].as_array().unwrap().iter().all(|s| s["sure"] == true), "{found}");
    for (name, value) in [("find_symmetries", "guess"), ("noise", "-1")] {
        let problem = server.post("/v1/objects", &form("other").text(name, value)).expect(422).json();
        assert_eq!(problem["field"], name);
    }
    let both = form("other").text("find_symmetries", "shape").text("symmetric_about", "z");
    assert_eq!(server.post("/v1/objects", &both).expect(422).json()["field"], "find_symmetries");
}

#[test]
fn materials_and_textures_come_as_resources_and_from_nowhere_else() {
    let server = TestServer::new();
    let obj = "mtllib my.mtl\nusemtl a\nv 0 0 0\nv 100 0 0\nv 0 100 0\nv 0 0 50\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n";
    let mtl = "newmtl a\nKd 1 0 0\n";
    let form = |file: &str| {
        Form::default().text("name", "wedge").text("unit", "mm").file(
            "mesh",
            "wedge.obj",
            obj.replace("my.mtl", file).as_bytes(),
        )
    };
    for path in ["my.mtl", "../../objects/cat/object.json", "/etc/passwd"] {
        let problem = server.post("/v1/objects", &form(path)).expect(422).json();
        assert_eq!(problem["field"], "mesh", "{problem}");
    }
    let with = form("my.mtl").file("resource", "my.mtl", mtl.as_bytes());
    let stored = server.result_of("/v1/objects", &with).expect(200).json();
    assert_eq!(stored["record"]["faces"], json!(4));
}
