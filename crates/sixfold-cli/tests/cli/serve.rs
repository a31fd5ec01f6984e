//! `sixfold serve`: refused with the name of its feature if that is off; otherwise, invalid options are
//! refused at the start.

use crate::support::*;

#[cfg(not(feature = "serve"))]
#[test]
fn without_its_feature_the_server_names_it() {
    let folder = tempfile::tempdir().unwrap();
    for command in ["serve", "serve --port 8640 --store objects", "serve --help"] {
        fails(folder.path(), command, &["without the feature serve", "--features serve"]);
    }
    let help = sixfold(folder.path(), "--help").expect(0).stdout;
    assert!(!help.contains("HTTP"), "{help}");
}

#[cfg(feature = "serve")]
#[test]
fn a_server_that_could_not_be_used_safely_does_not_start() {
    let folder = tempfile::tempdir().unwrap();
    fails(folder.path(), "serve --host 0.0.0.0", &["0.0.0.0", "--token"]);
    fails(folder.path(), "serve --host 0.0.0.0 --token short", &["--token", "5 characters", "openssl"]);
    fails(folder.path(), "serve --workers 0", &["--workers"]);
    fails(folder.path(), "serve --port 70000", &["--port"]);
    fails(folder.path(), "serve --port 0 --pix2pose none.safetensors", &["none.safetensors"]);
    assert!(!folder.path().join("sixfold-objects").exists());
}
