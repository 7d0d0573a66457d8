//! Feeds for people: what a session believes, step by step, and what the server does, as server-sent events.
//!
//! A watcher that is slow gets fewer events, never older ones, and nobody waits for it.

use std::{
    collections::BTreeMap,
    convert::Infallible,
    sync::Arc,
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use axum::{
    Router,
    extract::{Path, Query, State, rejection::QueryRejection},
    http::header,
    response::{
        IntoResponse as _, Response,
        sse::{Event, KeepAlive, Sse},
    },
    routing::get,
};
use base64::{Engine as _, prelude::BASE64_STANDARD};
use bytes::Bytes;
use futures_util::{Stream, StreamExt as _, stream::unfold};
use gatsbi_models::scene::Output;
use gatsbi_pictures::scene::PRESENT;
use gatsbi_proto::v1;
use serde::Deserialize;
use serde_json::{Value as Json, json};
use tokio::time::{Interval, MissedTickBehavior, interval};

use super::{App, answer};
use crate::{
    api::counted,
    bounds::{EVERY_MILLIS, OVERVIEW},
    engine::{Computed, Reading},
    error::Error,
    media,
    pictures::{
        self, byte,
        scene::{self, Of},
    },
    service::{
        Service, aside,
        show::{Overview, Told},
    },
    sessions::live::Shown,
};

/// Sessions that an overview tells about unless it is asked otherwise.
const SESSIONS: u32 = 60;
/// Milliseconds between two overviews unless it is asked otherwise.
const EVERY: u32 = 500;
/// Thumbnails of one overview.
const THUMBNAILS: usize = 24;

/// All paths.
pub(super) fn routes() -> Router<Arc<Service>> {
    Router::new().route("/v1/live", get(server)).route("/v1/sessions/{id}/live", get(session))
}

/// Which pictures of a step are wanted.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Watch {
    #[serde(default)]
    pictures: String,
}

/// Which pictures come with each step.
#[derive(Clone, Copy, Debug, Default)]
struct With {
    camera: bool,
    belief: bool,
    masks: bool,
}

async fn session(
    State(service): App,
    Path(id): Path<String>,
    watch: Result<Query<Watch>, QueryRejection>,
) -> Result<Response, Error> {
    let start = answer("WatchSession", async {
        let Query(Watch { pictures }) = watch.map_err(|error| malformed(&error))?;
        Ok((with(&pictures)?, service.watch(&id)?))
    });
    let (with, watching) = start.await?;
    let events = unfold(Some(watching), move |watching| async move {
        let mut watching = watching?;
        let Some(shown) = watching.next().await else {
            if watching.is_stopped() {
                return None;
            }
            let closed = Event::default().event("closed").data("{}");
            return Some((closed, None));
        };
        let told = aside(move || tell(&shown, with)).await.ok()?;
        Some((event("belief", &told), Some(watching)))
    });
    Ok(stream("SessionFeed", events))
}

/// How the overview is wanted.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Look {
    every_millis: Option<u32>,
    sessions: Option<u32>,
    #[serde(default)]
    thumbnails: bool,
}

/// An overview feed on its way.
struct Feed {
    service: Arc<Service>,
    ticks: Interval,
    sessions: usize,
    thumbnails: bool,
    /// The steps whose thumbnails were sent, by session.
    sent: BTreeMap<String, u64>,
}

async fn server(
    State(service): App,
    look: Result<Query<Look>, QueryRejection>,
) -> Result<Response, Error> {
    let start = answer("WatchServer", async {
        let Query(Look { every_millis, sessions, thumbnails }) =
            look.map_err(|error| malformed(&error))?;
        let every = EVERY_MILLIS.check(every_millis.unwrap_or(EVERY), "every_millis")?;
        let sessions = OVERVIEW.check(sessions.unwrap_or(SESSIONS), "sessions")? as usize;
        let mut ticks = interval(Duration::from_millis(every.into()));
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        Ok(Feed { service, ticks, sessions, thumbnails, sent: BTreeMap::new() })
    });
    let events = unfold(start.await?, |mut feed| async move {
        let stop = feed.service.stop().clone();
        tokio::select! {
            _ = feed.ticks.tick() => {}
            () = stop.cancelled() => return None,
        }
        let overview = feed.overview().await?;
        Some((event("overview", &overview), feed))
    });
    Ok(stream("ServerFeed", events))
}

impl Feed {
    async fn overview(&mut self) -> Option<Json> {
        let Overview { engine, models, open, sessions } = self.service.overview(self.sessions);
        let mut seen = Vec::new();
        for Told { session, next_step, .. } in sessions.iter().take(THUMBNAILS) {
            let id = session.id.to_string();
            if self.thumbnails && self.sent.get(&id) != Some(next_step) {
                seen.extend(session.last().map(|last| (id, *next_step, last)));
            }
        }
        let thumbnails = aside(move || {
            let paint = seen.into_iter().filter_map(|(id, next_step, last)| {
                let colours = last.seen.frame.as_ref()?;
                let size = last.before.model.spec.image_size as u32;
                Some((id, next_step, base64(&pictures::png(&scene::camera(colours, size)))))
            });
            paint.collect::<Vec<_>>()
        });
        let thumbnails = thumbnails.await.ok()?;
        let open_ids: Vec<String> =
            sessions.iter().map(|told| told.session.id.to_string()).collect();
        self.sent.retain(|id, _| open_ids.contains(id));
        self.sent.extend(thumbnails.iter().map(|(id, next_step, _)| (id.clone(), *next_step)));
        let told = |Told { session, model, next_step, idle }: &Told| {
            let id = session.id.to_string();
            let thumbnail = thumbnails.iter().find(|(of, _, _)| *of == id);
            let thumbnail = thumbnail.map(|(_, _, picture)| picture);
            json!({
                "id": id,
                "label": session.terms.label,
                "model": model,
                "next_step": next_step,
                "idle_millis": idle.as_millis() as u64,
                "watched": session.live.is_watched(),
                "thumbnail": thumbnail,
            })
        };
        Some(json!({
            "at": millis(SystemTime::now()),
            "engine": read(&engine),
            "models": models,
            "open_sessions": open,
            "sessions": sessions.iter().map(told).collect::<Vec<_>>(),
        }))
    }
}

fn read(engine: &Reading) -> Json {
    let kind = |computed: &Computed| {
        json!({
            "blocks": computed.blocks,
            "rows": computed.rows,
            "lanes": computed.lanes,
            "micros": computed.time.as_micros() as u64,
        })
    };
    json!({
        "ticks": engine.ticks,
        "refused": engine.refused,
        "observe": kind(&engine.observe),
        "imagine": kind(&engine.imagine),
        "waiting": {
            "observations": engine.waiting.observes,
            "rows": engine.waiting.rows,
            "predicted_micros": engine.waiting.time.as_micros() as u64,
        },
    })
}

/// What is told about a step.
fn tell(shown: &Shown, with: With) -> Json {
    let object = |object: &v1::Object| {
        json!({
            "id": object.id,
            "slot": object.slot,
            "presence": object.presence,
            "x": object.x,
            "y": object.y,
            "width": object.width,
            "height": object.height,
            "depth": object.depth,
            "pixel_x": object.pixel_x,
            "pixel_y": object.pixel_y,
        })
    };
    let keypoints = shown
        .floats(Output::Keypoints)
        .map(|numbers| numbers.chunks(3).map(<[f32]>::to_vec).collect::<Vec<_>>());
    let mut told = json!({
        "step": shown.step,
        "at": millis(shown.at),
        "model_hash": shown.model_hash,
        "image_size": shown.image_size,
        "predicted": shown.seen.frame.is_none(),
        "image_skipped": shown.image_skipped,
        "action": shown.seen.action,
        "objects": shown.objects.iter().map(object).collect::<Vec<_>>(),
        "surprise": shown.number(Output::Surprise),
        "keypoints": keypoints,
        "timing": {
            "queue_micros": shown.timing.queue_micros,
            "compute_micros": shown.timing.compute_micros,
            "encode_micros": shown.timing.encode_micros,
        },
    });
    if let (true, Some(colours)) = (with.camera, &shown.seen.frame) {
        let camera = scene::camera(colours, shown.image_size);
        told["camera"] = base64(&pictures::png(&camera)).into();
    }
    if with.belief {
        told["belief"] = base64(&pictures::png(&scene::picture(shown, Of::Belief))).into();
    }
    if with.masks {
        let (order, png) = masks(shown);
        told["masks"] = json!({ "order": order, "png": base64(&png) });
    }
    told
}

/// The masks of agent and objects that are there, in grey, one below the other, and whose they are.
fn masks(shown: &Shown) -> (Vec<Json>, Bytes) {
    let pixels = (shown.image_size * shown.image_size) as usize;
    let mut order: Vec<Json> = Vec::new();
    let mut rows: Vec<u8> = Vec::new();
    if let Some(agent) = shown.floats(Output::AgentMask) {
        order.push("agent".into());
        rows.extend(agent.into_iter().map(byte));
    }
    let all = shown.floats(Output::ObjectMasks).unwrap_or_default();
    for object in shown.objects.iter().filter(|object| object.presence > PRESENT) {
        let mask = all.get(object.slot as usize * pixels..).and_then(|rest| rest.get(..pixels));
        if let Some(mask) = mask {
            order.push(object.id.into());
            rows.extend(mask.iter().copied().map(byte));
        }
    }
    if order.is_empty() {
        order.push(Json::Null);
        rows.resize(pixels, 0);
    }
    let size = (shown.image_size, shown.image_size * order.len() as u32);
    (order, media::png(&rows, size, 1))
}

fn with(pictures: &str) -> Result<With, Error> {
    let mut with = With::default();
    for name in pictures.split(',').filter(|name| !name.is_empty()) {
        match name {
            "camera" => with.camera = true,
            "belief" => with.belief = true,
            "masks" => with.masks = true,
            other => {
                let expected = "camera, belief and masks, separated by commas";
                return Err(Error::invalid("pictures", format!("{other:.64}"), expected));
            }
        }
    }
    Ok(with)
}

/// Events as an answer that nothing on the way keeps back.
fn stream(method: &'static str, events: impl Stream<Item = Event> + Send + 'static) -> Response {
    let events = counted::stream("rest", method, events).map(Ok::<_, Infallible>);
    let events = Sse::new(events).keep_alive(KeepAlive::new().interval(Duration::from_secs(10)));
    (
        [
            (header::CACHE_CONTROL, "no-store"),
            (header::HeaderName::from_static("x-accel-buffering"), "no"),
        ],
        events,
    )
        .into_response()
}

fn event(name: &str, told: &Json) -> Event {
    Event::default().event(name).data(told.to_string())
}

fn base64(bytes: &[u8]) -> String {
    BASE64_STANDARD.encode(bytes)
}

fn millis(at: SystemTime) -> f64 {
    at.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs_f64() * 1000.0
}

fn malformed(rejection: &QueryRejection) -> Error {
    Error::Malformed { message: "query".to_owned(), reason: rejection.body_text() }
}
