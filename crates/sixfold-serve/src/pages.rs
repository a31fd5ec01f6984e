//! The web pages: plain HTML, CSS and ES modules, built into the program. They ask nothing of any other machine.

use axum::Router;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::http::{HeaderName, HeaderValue};
use axum::response::IntoResponse;
use axum::routing::get;

/// What a page may load: from here alone.
const POLICY: &str = "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; \
                      form-action 'none'; frame-ancestors 'none'";

const HTML: &str = "text/html; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";

/// Path, content type and content of each file.
macro_rules! assets {
    ($($path:literal, $kind:expr, $file:literal;)*) => {
        &[$(($path, $kind, include_bytes!(concat!("../assets/", $file)))),*]
    };
}

const ASSETS: &[(&str, &str, &[u8])] = assets! {
    "/", HTML, "index.html";
    "/find", HTML, "find.html";
    "/grasp", HTML, "grasp.html";
    "/teach", HTML, "teach.html";
    "/static/app.css", "text/css; charset=utf-8", "app.css";
    "/static/icon.svg", "image/svg+xml", "icon.svg";
    "/static/api.js", SCRIPT, "api.js";
    "/static/form.js", SCRIPT, "form.js";
    "/static/objects.js", SCRIPT, "objects.js";
    "/static/find.js", SCRIPT, "find.js";
    "/static/grasp.js", SCRIPT, "grasp.js";
    "/static/teach.js", SCRIPT, "teach.js";
    "/static/editor.js", SCRIPT, "editor.js";
    "/static/pose.js", SCRIPT, "pose.js";
    "/static/viewer.js", SCRIPT, "viewer.js";
    "/static/vendor/three.min.js", SCRIPT, "vendor/three.min.js";
    "/static/vendor/three.LICENSE.txt", "text/plain; charset=utf-8", "vendor/three.LICENSE.txt";
};

/// Routes to all pages and what they load.
pub(crate) fn routes<S: Clone + Send + Sync + 'static>() -> Router<S> {
    ASSETS.iter().fold(Router::new(), |router, &(path, kind, bytes)| {
        router.route(path, get(move || async move { page(kind, bytes) }))
    })
}

fn page(kind: &'static str, bytes: &'static [u8]) -> impl IntoResponse {
    let headers: [(HeaderName, HeaderValue); 5] = [
        (CONTENT_TYPE, HeaderValue::from_static(kind)),
        // Another version of the program has other pages under the same names.
        (CACHE_CONTROL, HeaderValue::from_static("no-cache")),
        (HeaderName::from_static("content-security-policy"), HeaderValue::from_static(POLICY)),
        (HeaderName::from_static("x-content-type-options"), HeaderValue::from_static("nosniff")),
        (HeaderName::from_static("referrer-policy"), HeaderValue::from_static("no-referrer")),
    ];
    (headers, bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pages_load_only_what_is_here() {
        for (path, kind, bytes) in ASSETS.iter().filter(|a| a.1 == HTML || a.1 == SCRIPT) {
            if path.contains("vendor") {
                continue;
            }
            let text = std::str::from_utf8(bytes).unwrap();
            assert!(!text.contains("https://") && !text.contains("http://"), "{path} ({kind})");
            let quoted = text.split('"').filter(|part| part.starts_with("/static/"));
            for file in quoted {
                assert!(ASSETS.iter().any(|a| a.0 == file), "{path}: {file}");
            }
        }
    }
}
