//! Pictures for people, and the page that shows them.

use std::io::Cursor;

use gatsbi_proto::v1;
use image::{AnimationDecoder as _, RgbImage, codecs::gif::GifDecoder};
use serde_json::{Value as Json, json};

use crate::support::{ACTION, TestServer, observation, picture, serving_both, tensor};

async fn file(server: &TestServer, path: &str, media: &str) -> Vec<u8> {
    let answer = server.get(path).send().await.unwrap();
    assert_eq!(answer.status(), 200, "{path}");
    assert_eq!(answer.headers()["content-type"], media, "{path}");
    answer.bytes().await.unwrap().to_vec()
}

async fn png(server: &TestServer, path: &str) -> RgbImage {
    let file = file(server, path, "image/png").await;
    image::load_from_memory(&file).unwrap().into_rgb8()
}

#[tokio::test]
async fn a_step_is_shown_as_it_was_seen_and_as_it_is_believed() {
    let server = TestServer::start().await;
    let session = server.session(6).await;
    server.observe(observation(&session, 0)).await.unwrap();
    let belief = server.observe(observation(&session, 1)).await.unwrap();
    let at = |file: &str| format!("/v1/sessions/{}/{file}", session.id);

    let frame = png(&server, &at("frame.png?scale=1")).await;
    assert_eq!(frame.into_raw(), picture(6, 1));
    let believed = png(&server, &at("frame.png?of=belief&scale=1")).await;
    assert_eq!(believed.into_raw(), tensor(&belief.outputs, v1::Output::Frame).data);
    assert_eq!(png(&server, &at("frame.png")).await.dimensions(), (256, 256));
    assert_eq!(png(&server, &at("overlay.png?scale=2")).await.dimensions(), (128, 128));
    let masks = png(&server, &at("masks.png?scale=1")).await;
    assert!(masks.width() >= 5 * 64 && masks.height() > 64, "{:?}", masks.dimensions());
    server.app.shutdown().await;
}

#[tokio::test]
async fn rollouts_are_shown_as_strip_and_film() {
    let server = TestServer::start().await;
    let session = server.seasoned(7, 2).await;
    let at = |file: &str| format!("/v1/sessions/{}/{file}", session.id);
    let (tile, row) = (128 + 6, 128 + 14);
    let strip = png(&server, &at("rollout.png?random=3&horizon=4&seed=5&overlay=true")).await;
    assert_eq!(strip.dimensions(), (6 + 4 * tile, 6 + 3 * row));
    let every = png(&server, &at("rollout.png?random=3&horizon=4&every=2&scale=1")).await;
    assert_eq!(every.dimensions(), (6 + 2 * 70, 6 + 3 * 78));

    let film = file(&server, &at("rollout.gif?horizon=3"), "image/gif").await;
    let frames = GifDecoder::new(Cursor::new(film)).unwrap().into_frames();
    let frames = frames.collect_frames().unwrap();
    assert_eq!(frames.len(), 3);
    // The model's frame period is a fifth of a second.
    assert_eq!(frames[0].delay().numer_denom_ms(), (200, 1));

    let action = "0.25,0,0.1,0,0,0,-1";
    let held = png(&server, &at(&format!("rollout.png?hold={action}&horizon=2"))).await;
    let values: Vec<f32> = action.split(',').map(|number| number.parse().unwrap()).collect();
    let body = json!({
        "actions": { "dtype": "DATA_TYPE_F32", "shape": [1, 2, ACTION], "values": values.repeat(2) },
        "sampling": { "mode": "MODE_MEAN" },
    });
    let sent = server.post(&at("rollout.png")).json(&body).send().await.unwrap();
    assert_eq!(sent.status(), 200);
    let sent = image::load_from_memory(&sent.bytes().await.unwrap()).unwrap().into_rgb8();
    assert_eq!(sent, held);
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_model_without_agent_and_actions_is_shown_too() {
    let server = serving_both().await;
    let session = server.session_on("balls", 3).await;
    let mut request = observation(&session, 0);
    request.observation.as_mut().unwrap().action = Vec::new();
    server.observe(request).await.unwrap();
    for name in ["frame.png", "overlay.png", "masks.png", "rollout.png?horizon=2&overlay=true"] {
        let shown = png(&server, &format!("/v1/sessions/{}/{name}", session.id)).await;
        assert!(shown.width() > 100, "{name}");
    }
    server.app.shutdown().await;
}

#[tokio::test]
async fn what_cannot_be_shown_is_refused_with_its_reason() {
    let server = TestServer::start().await;
    let request = v1::CreateSessionRequest { keep_steps: 2, ..Default::default() };
    let created = server.sessions.clone().create_session(request).await.unwrap().into_inner();
    let session = created.session.unwrap();
    let at = |file: &str| format!("/v1/sessions/{}/{file}", session.id);
    let refused = async |path: String| {
        let answer = server.get(&path).send().await.unwrap();
        let status = answer.status().as_u16();
        let problem: Json = answer.json().await.unwrap();
        let field = problem["fields"][0]["field"].as_str().unwrap_or_default().to_owned();
        (status, problem["reason"].as_str().unwrap().to_owned(), field)
    };
    for name in ["frame.png", "overlay.png", "masks.png", "rollout.png", "rollout.gif"] {
        assert_eq!(refused(at(name)).await, (409, "NOTHING_OBSERVED".into(), String::new()));
        let unknown = refused(format!("/v1/sessions/7/{name}")).await;
        assert_eq!(unknown, (404, "UNKNOWN_SESSION".into(), "session_id".into()));
    }
    for step in 0..3 {
        server.observe(observation(&session, step)).await.unwrap();
    }
    for (name, field) in [
        ("frame.png?scale=17", "scale"),
        ("overlay.png?of=me", "of"),
        ("masks.png?of=belief", "of"),
        ("rollout.png?hold=1,2", "hold"),
        ("rollout.png?hold=1,2,3,4,5,6,NaN", "hold"),
        ("rollout.png?hold=1&random=3", "random"),
        ("rollout.png?random=0", "random"),
        ("rollout.gif?horizon=9999", "horizon"),
        ("rollout.png?horizon=4&every=5", "outputs.every_k"),
        ("rollout.png?random=4000&horizon=200", "actions"),
    ] {
        assert_eq!(refused(at(name)).await, (400, "INVALID_FIELDS".into(), field.into()), "{name}");
    }
    assert_eq!(refused(at("frame.png?scal=2")).await.1, "MALFORMED_BODY");
    let shape = json!([u32::MAX, u32::MAX, 7]);
    let actions = json!({ "actions": { "dtype": "DATA_TYPE_F32", "shape": shape } });
    let (status, problem) = server.post_json(&at("rollout.png"), &actions).await;
    assert_eq!((status, &problem["fields"][0]["field"]), (400, &json!("actions")), "{problem}");

    let (status, _) = server.post_json(&at("rewind"), &json!({ "to_step": 1 })).await;
    assert_eq!(status, 200);
    assert_eq!(refused(at("overlay.png")).await, (409, "NOTHING_TO_SHOW".into(), String::new()));
    server.observe(observation(&session, 2)).await.unwrap();
    assert_eq!(png(&server, &at("overlay.png")).await.dimensions(), (256, 256));
    server.app.shutdown().await;
}

#[tokio::test]
async fn the_live_page_needs_nothing_from_elsewhere() {
    let server = TestServer::start().await;
    let page = server.get("/").send().await.unwrap();
    assert_eq!(page.headers()["content-type"], "text/html; charset=utf-8");
    assert_eq!(page.headers()["x-content-type-options"], "nosniff");
    let policy = page.headers()["content-security-policy"].to_str().unwrap();
    assert!(policy.starts_with("default-src 'none'; script-src 'self'; style-src 'self'"));
    let page = page.text().await.unwrap();
    for inline in ["<style", "style=", "<script>", "onclick="] {
        assert!(!page.contains(inline), "{inline} does not get past the policy");
    }
    let quoted = |text: &str, before: &str| -> Vec<String> {
        let rest = text.split(before).skip(1);
        rest.filter_map(|rest| rest.split('"').next()).map(str::to_owned).collect()
    };
    let mut files: Vec<String> =
        ["src=\"", "href=\""].iter().flat_map(|at| quoted(&page, at)).collect();
    files.retain(|file| !file.starts_with('#'));
    assert!(files.iter().any(|file| file == "/page/app.js"));
    let mut seen = 0;
    while let Some(path) = files.get(seen).cloned() {
        seen += 1;
        assert!(!path.contains("//"), "{path} is elsewhere");
        let answer = server.get(&path).send().await.unwrap();
        assert_eq!(answer.status(), 200, "{path}");
        if answer.headers()["content-type"] == "text/javascript; charset=utf-8" {
            let script = answer.text().await.unwrap();
            for module in quoted(&script, " from \"./") {
                let module = format!("/page/{module}");
                if !files.contains(&module) {
                    files.push(module);
                }
            }
        }
    }
    assert!(seen >= 18, "{files:?}");
    server.app.shutdown().await;
}
