//! Feeds for people: what they tell, that watching changes nothing, and how they end.

use std::time::{Duration, Instant};

use base64::{Engine as _, prelude::BASE64_STANDARD};
use gatsbi_proto::v1;
use serde_json::Value as Json;

use crate::support::{TestServer, floats, observation, outputs, picture, tensor};

/// A feed on its way.
pub(crate) struct Feed {
    response: reqwest::Response,
    text: String,
}

impl Feed {
    async fn open(server: &TestServer, path: &str) -> Self {
        Self::of(server.get(path).send().await.unwrap())
    }

    /// What came of asking for one.
    pub(crate) fn of(response: reqwest::Response) -> Self {
        assert_eq!(response.status(), 200, "{}", response.url());
        assert_eq!(response.headers()["content-type"], "text/event-stream");
        assert_eq!(response.headers()["cache-control"], "no-store");
        Self { response, text: String::new() }
    }

    /// The next event, its name and what it tells; nothing at the end.
    pub(crate) async fn next(&mut self) -> Option<(String, Json)> {
        loop {
            while let Some(end) = self.text.find("\n\n") {
                let event: String = self.text.drain(..end + 2).collect();
                let field = |name: &str| event.lines().find_map(|line| line.strip_prefix(name));
                let told = field("event: ").map(|name| {
                    (name.to_owned(), serde_json::from_str(field("data: ").unwrap()).unwrap())
                });
                if told.is_some() {
                    return told;
                }
            }
            let chunk = self.response.chunk().await.unwrap()?;
            self.text.push_str(str::from_utf8(&chunk).unwrap());
        }
    }

    async fn belief(&mut self) -> Json {
        let (name, told) = self.next().await.unwrap();
        assert_eq!(name, "belief");
        told
    }
}

fn pixels(base64: &Json) -> Vec<u8> {
    let file = BASE64_STANDARD.decode(base64.as_str().unwrap()).unwrap();
    image::load_from_memory(&file).unwrap().into_rgb8().into_raw()
}

/// The made-up observation of a step with what feeds show of it.
fn everything(session: &v1::Session, step: u64) -> v1::ObserveRequest {
    let wanted = [v1::Output::Frame, v1::Output::Objects, v1::Output::Surprise];
    let outputs = Some(outputs(&wanted, v1::Encoding::U8));
    v1::ObserveRequest { outputs, ..observation(session, step) }
}

/// A number of a feed is the very number of an answer.
fn same(told: &Json, number: f32) {
    assert_eq!((told.as_f64().unwrap() as f32).to_bits(), number.to_bits());
}

#[track_caller]
fn near(told: &Json, number: f32) {
    let told = told.as_f64().unwrap() as f32;
    assert!((told - number).abs() <= 1e-3 * number.abs().max(1.0), "{told}, expected {number}");
}

fn same_objects(told: &Json, belief: &v1::Belief) {
    let objects = told["objects"].as_array().unwrap();
    assert_eq!(objects.len(), belief.objects.len());
    for (told, object) in objects.iter().zip(&belief.objects) {
        assert_eq!(told["id"], object.id);
        same(&told["x"], object.x);
        same(&told["pixel_y"], object.pixel_y);
    }
}

#[tokio::test]
async fn a_watcher_sees_every_step_and_watching_changes_nothing() {
    let server = TestServer::start().await;
    let (watched, alone) = (server.session(4).await, server.session(4).await);
    let path = format!("/v1/sessions/{}/live?pictures=camera,belief,masks", watched.id);
    let mut feed = Feed::open(&server, &path).await;
    for step in 0..3 {
        let belief = server.observe(everything(&watched, step)).await.unwrap();
        let unwatched = server.observe(everything(&alone, step)).await.unwrap();
        assert_eq!(belief.outputs, unwatched.outputs);
        assert_eq!(belief.objects, unwatched.objects);

        let told = feed.belief().await;
        assert_eq!(told["step"], step);
        assert_eq!((&told["predicted"], &told["image_size"]), (&false.into(), &64.into()));
        assert_eq!(pixels(&told["camera"]), picture(4, step));
        let frame = tensor(&belief.outputs, v1::Output::Frame);
        assert_eq!(pixels(&told["belief"]), frame.data);
        same_objects(&told, &belief);
        let surprise = floats(tensor(&belief.outputs, v1::Output::Surprise))[0];
        same(&told["surprise"], surprise);
        assert_eq!(told["keypoints"].as_array().unwrap()[0].as_array().unwrap().len(), 3);
        let order = told["masks"]["order"].as_array().unwrap();
        assert_eq!(order[0], "agent");
        assert_eq!(pixels(&told["masks"]["png"]).len(), order.len() * 64 * 64 * 3);
        assert_eq!(told["action"].as_array().unwrap().len(), 7);
        let timing = belief.timing.unwrap();
        assert_eq!(told["timing"]["compute_micros"], timing.compute_micros);
    }
    server.app.shutdown().await;
}

#[tokio::test]
async fn who_comes_late_is_shown_the_same_newest_step() {
    let server = TestServer::start().await;
    let session = server.session(5).await;
    let mut last = v1::Belief::default();
    for step in 0..3 {
        last = server.observe(everything(&session, step)).await.unwrap();
    }
    let mut feed =
        Feed::open(&server, &format!("/v1/sessions/{}/live?pictures=belief", session.id)).await;
    let told = feed.belief().await;
    assert_eq!((&told["step"], &told["camera"]), (&2.into(), &Json::Null));
    // It was made once more, by the same model from the same belief, but in a block of bulk work: as equal as blocks of
    // different sizes are.
    let shown = pixels(&told["belief"]);
    let seen = &tensor(&last.outputs, v1::Output::Frame).data;
    let off = shown.iter().zip(seen).map(|(a, b)| a.abs_diff(*b)).max();
    assert_eq!((shown.len(), off <= Some(1)), (seen.len(), true), "{off:?}");
    for (told, object) in told["objects"].as_array().unwrap().iter().zip(&last.objects) {
        assert_eq!(told["id"], object.id);
        near(&told["x"], object.x);
    }
    near(&told["surprise"], floats(tensor(&last.outputs, v1::Output::Surprise))[0]);

    let dropped = v1::ObserveRequest {
        observation: Some(v1::Observation {
            image: None,
            ..everything(&session, 3).observation.unwrap()
        }),
        outputs: None,
        ..everything(&session, 3)
    };
    server.observe(dropped).await.unwrap();
    let told = feed.belief().await;
    assert_eq!((&told["step"], &told["predicted"]), (&3.into(), &true.into()));
    assert_eq!(pixels(&told["belief"]).len(), 64 * 64 * 3);
    server.app.shutdown().await;
}

#[tokio::test]
async fn a_feed_ends_with_its_session_and_with_the_server() {
    let server = TestServer::start().await;
    let (closed, open) = (server.session(1).await, server.seasoned(2, 1).await);
    let mut ending = Feed::open(&server, &format!("/v1/sessions/{}/live", closed.id)).await;
    let mut staying = Feed::open(&server, &format!("/v1/sessions/{}/live", open.id)).await;
    let mut overview = Feed::open(&server, "/v1/live").await;
    staying.belief().await;
    let answer = server.delete(&format!("/v1/sessions/{}", closed.id)).send().await.unwrap();
    assert_eq!(answer.status(), 200);
    assert_eq!(ending.next().await.unwrap().0, "closed");
    assert!(ending.next().await.is_none());
    assert_eq!(overview.next().await.unwrap().0, "overview");

    let began = Instant::now();
    let TestServer { app, .. } = server;
    app.shutdown().await;
    assert!(
        began.elapsed() < Duration::from_secs(5),
        "feeds kept the server: {:?}",
        began.elapsed()
    );
    assert!(overview.next().await.is_none());
    assert!(staying.next().await.is_none(), "the session was not closed");
}

#[tokio::test]
async fn the_overview_tells_what_the_engine_does() {
    let server = TestServer::start().await;
    let session = server.seasoned(3, 2).await;
    let mut feed = Feed::open(&server, "/v1/live?every_millis=100&thumbnails=true").await;
    let (_, first) = feed.next().await.unwrap();
    let engine = &first["engine"];
    assert_eq!((&engine["observe"]["rows"], &engine["imagine"]["rows"]), (&2.into(), &0.into()));
    assert_eq!((&first["open_sessions"], &first["models"]), (&1.into(), &1.into()));
    let told = &first["sessions"][0];
    assert_eq!((&told["id"], &told["next_step"]), (&session.id.clone().into(), &2.into()));
    assert_eq!(pixels(&told["thumbnail"]), picture(3, 1));

    let (_, second) = feed.next().await.unwrap();
    assert_eq!(second["sessions"][0]["thumbnail"], Json::Null, "it has not moved");
    server.observe(observation(&session, 2)).await.unwrap();
    server.imagine(crate::support::rollout(&session, 3, 4)).await.unwrap();
    let later = loop {
        let (_, told) = feed.next().await.unwrap();
        if told["engine"]["imagine"]["rows"] == 12 {
            break told;
        }
    };
    assert_eq!(later["engine"]["observe"]["rows"], 3);
    assert_eq!(later["engine"]["imagine"]["lanes"], 4 * 8);
    assert_eq!(later["engine"]["waiting"]["rows"], 0);
    assert!(later["engine"]["imagine"]["micros"].as_u64().unwrap() > 0);
    server.app.shutdown().await;
}

#[tokio::test]
async fn feeds_that_cannot_be_are_refused_by_field() {
    let server = TestServer::start().await;
    let session = server.session(1).await.id;
    for (path, status, field) in [
        ("/v1/sessions/7/live".to_owned(), 404, "session_id"),
        (format!("/v1/sessions/{session}/live?pictures=camera,x"), 400, "pictures"),
        ("/v1/live?every_millis=5".to_owned(), 400, "every_millis"),
        ("/v1/live?sessions=5000".to_owned(), 400, "sessions"),
    ] {
        let answer = server.get(&path).send().await.unwrap();
        assert_eq!(answer.status(), status, "{path}");
        let problem: Json = answer.json().await.unwrap();
        assert_eq!(problem["fields"][0]["field"], field, "{path}");
    }
    for path in ["/v1/live?evry_millis=5".to_owned(), format!("/v1/sessions/{session}/live?x=1")] {
        let problem: Json = server.get(&path).send().await.unwrap().json().await.unwrap();
        assert_eq!(problem["reason"], "MALFORMED_BODY", "{path}");
    }
    server.app.shutdown().await;
}
