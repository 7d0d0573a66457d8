//! The live page: files that are part of the program, and the paths they lie at.
//!
//! The page shows what the REST API says, and knows nothing that the API does not tell. It needs nothing from
//! elsewhere, and holds nothing that is anybody's: what it shows it asks for, with a key where the server wants one.
//! Start reading at `page/app.js`.

use axum::{
    Router,
    http::header::{self, HeaderName},
    response::IntoResponse,
    routing::get,
};

/// What the page may do: scripts, styles and data from this server alone.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; \
    connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
const SVG: &str = "image/svg+xml";

/// The files by path, with their types.
const FILES: &[(&str, &str, &str)] = &[
    ("/", HTML, include_str!("page/index.html")),
    ("/page/style.css", CSS, include_str!("page/style.css")),
    ("/page/parts.css", CSS, include_str!("page/parts.css")),
    ("/page/icon.svg", SVG, include_str!("page/icon.svg")),
    ("/page/app.js", SCRIPT, include_str!("page/app.js")),
    ("/page/api.js", SCRIPT, include_str!("page/api.js")),
    ("/page/candidates.js", SCRIPT, include_str!("page/candidates.js")),
    ("/page/chart.js", SCRIPT, include_str!("page/chart.js")),
    ("/page/compare.js", SCRIPT, include_str!("page/compare.js")),
    ("/page/dom.js", SCRIPT, include_str!("page/dom.js")),
    ("/page/engine.js", SCRIPT, include_str!("page/engine.js")),
    ("/page/imagine.js", SCRIPT, include_str!("page/imagine.js")),
    ("/page/markdown.js", SCRIPT, include_str!("page/markdown.js")),
    ("/page/models.js", SCRIPT, include_str!("page/models.js")),
    ("/page/palette.js", SCRIPT, include_str!("page/palette.js")),
    ("/page/scene.js", SCRIPT, include_str!("page/scene.js")),
    ("/page/session.js", SCRIPT, include_str!("page/session.js")),
    ("/page/sessions.js", SCRIPT, include_str!("page/sessions.js")),
];

/// All paths, which are anybody's, whatever else a router serves.
pub fn routes<S: Clone + Send + Sync + 'static>() -> Router<S> {
    FILES.iter().fold(Router::new(), |router, (path, media, text)| {
        router.route(path, get(async || file(media, text)))
    })
}

fn file(media: &'static str, text: &'static str) -> impl IntoResponse {
    let headers = [
        (header::CONTENT_TYPE, media),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        // Another version of the server has another page.
        (header::CACHE_CONTROL, "no-cache"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    ];
    (headers, text)
}
