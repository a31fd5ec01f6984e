//! The web pages: plain HTML, CSS and ES modules, built into the program. They load nothing from other machines.

use axum::Router;
use axum::body::Bytes;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::http::{HeaderName, HeaderValue};
use axum::response::IntoResponse;
use axum::routing::get;

/// The content security policy: pages load only from this server.
const POLICY: &str = "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; \
                      form-action 'none'; frame-ancestors 'none'";

const HTML: &str = "text/html; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";

/// A page: its path, its title (also of its link), its script and its content.
type Page = (&'static str, &'static str, &'static str, &'static str);

const PAGES: [Page; 4] = [
    ("/", "Objects", "objects.js", include_str!("../assets/index.html")),
    ("/teach", "Teach", "teach.js", include_str!("../assets/teach.html")),
    ("/find", "Find", "find.js", include_str!("../assets/find.html")),
    ("/grasp", "Grasp", "grasp.js", include_str!("../assets/grasp.html")),
];

/// Parts that pages share, with their placeholders in double braces.
const PARTS: [(&str, &str); 3] = [
    ("inputs", include_str!("../assets/parts/inputs.html")),
    ("job", include_str!("../assets/parts/job.html")),
    ("result", include_str!("../assets/parts/result.html")),
];

/// Path, content type and content of each file.
macro_rules! assets {
    ($($path:literal, $kind:expr, $file:literal;)*) => {
        &[$(($path, $kind, include_bytes!(concat!("../assets/", $file)))),*]
    };
}

const ASSETS: &[(&str, &str, &[u8])] = assets! {
    "/static/app.css", "text/css; charset=utf-8", "app.css";
    "/static/icon.svg", "image/svg+xml", "icon.svg";
    "/static/api.js", SCRIPT, "api.js";
    "/static/form.js", SCRIPT, "form.js";
    "/static/objects.js", SCRIPT, "objects.js";
    "/static/find.js", SCRIPT, "find.js";
    "/static/grasp.js", SCRIPT, "grasp.js";
    "/static/teach.js", SCRIPT, "teach.js";
    "/static/editor.js", SCRIPT, "editor.js";
    "/static/ends.js", SCRIPT, "ends.js";
    "/static/pose.js", SCRIPT, "pose.js";
    "/static/viewer.js", SCRIPT, "viewer.js";
    "/static/vendor/three.min.js", SCRIPT, "vendor/three.min.js";
    "/static/vendor/three.LICENSE.txt", "text/plain; charset=utf-8", "vendor/three.LICENSE.txt";
};

/// Routes to all pages and the files that they load.
pub(crate) fn routes<S: Clone + Send + Sync + 'static>() -> Router<S> {
    let pages = PAGES.iter().map(|page| (page.0, HTML, Bytes::from(html(page))));
    let files = ASSETS.iter().map(|&(path, kind, bytes)| (path, kind, Bytes::from_static(bytes)));
    pages.chain(files).fold(Router::new(), |router, (path, kind, bytes)| {
        router.route(path, get(move || async move { sent(kind, bytes) }))
    })
}

/// A whole page.
fn html((path, title, script, body): &Page) -> String {
    let link = |(to, name, ..): &Page| {
        let current = if to == path { " aria-current=\"page\"" } else { "" };
        format!("    <a href=\"{to}\"{current}>{name}</a>\n")
    };
    let nav: String = PAGES.iter().map(link).collect();
    let whole = include_str!("../assets/parts/page.html").replace("{{body}}", body);
    let parts = PARTS.iter().fold(whole, |text, (name, part)| text.replace(&format!("{{{{{name}}}}}"), part));
    parts.replace("{{title}}", title).replace("{{script}}", script).replace("{{nav}}", &nav)
}

fn sent(kind: &'static str, bytes: Bytes) -> impl IntoResponse {
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
    fn pages_load_only_from_this_server() {
        let scripts = ASSETS.iter().filter(|a| a.1 == SCRIPT && !a.0.contains("vendor"));
        let scripts = scripts.map(|(path, _, bytes)| (*path, String::from_utf8(bytes.to_vec()).unwrap()));
        for (path, text) in PAGES.iter().map(|page| (page.0, html(page))).chain(scripts) {
            assert!(!text.contains("https://") && !text.contains("http://"), "{path}");
            assert!(!text.contains("{{") || path.ends_with(".js"), "{path}");
            let quoted = text.split('"').filter(|part| part.starts_with("/static/"));
            for file in quoted {
                assert!(ASSETS.iter().any(|a| a.0 == file), "{path}: {file}");
            }
        }
    }
}
