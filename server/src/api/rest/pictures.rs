//! Paths of pictures: what a session sees and imagines as files, for curl, notebooks and slides.

use std::{sync::Arc, time::Duration};

use axum::{
    Router,
    extract::{Path, Query, State, rejection::QueryRejection},
    http::header,
    response::{IntoResponse as _, Response},
    routing::get,
};
use bytes::Bytes;
use gatsbi_models::world_model::ModelSpec;
use gatsbi_pictures::enlarge;
use gatsbi_proto::v1;
use serde::Deserialize;

use super::{App, answer, body::In, name_session};
use crate::{
    api::call::Of as Called,
    bounds::{ONE_OR_MORE, SCALE},
    error::Error,
    pictures::{
        self,
        rollout::Pictures,
        scene::{self, Of},
    },
    planning::noise::Draws,
    service::{Call, Service, aside},
};

const PNG: &str = "image/png";
const GIF: &str = "image/gif";

/// Pixels of a picture of a rollout.
const MAX_PIXELS: u64 = 16 << 20;
/// How long a depth of a film is shown where the model does not say.
const PERIOD: Duration = Duration::from_millis(200);

/// All paths.
pub(super) fn routes() -> Router<Arc<Service>> {
    Router::new()
        .route("/v1/sessions/{id}/frame.png", get(frame))
        .route("/v1/sessions/{id}/overlay.png", get(overlay))
        .route("/v1/sessions/{id}/masks.png", get(masks))
        .route("/v1/sessions/{id}/rollout.png", get(drawn_strip).post(strip))
        .route("/v1/sessions/{id}/rollout.gif", get(drawn_film).post(film))
}

/// How a step is to be shown.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Look {
    of: Option<String>,
    scale: Option<u32>,
}

/// How a rollout is to be shown.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RolloutLook {
    scale: Option<u32>,
    every: Option<u32>,
    overlay: Option<bool>,
}

/// How a rollout is to be shown, and which.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Drawn {
    scale: Option<u32>,
    every: Option<u32>,
    overlay: Option<bool>,
    horizon: Option<u32>,
    hold: Option<String>,
    random: Option<u32>,
    seed: Option<u64>,
}

type Asked<T> = Result<Query<T>, QueryRejection>;

async fn frame(
    State(service): App,
    Path(id): Path<String>,
    look: Asked<Look>,
) -> Result<Response, Error> {
    let answer = answer("FramePicture", async {
        let (of, scale) = read(look)?;
        if of == Of::Camera {
            let last = service.seen(&id)?;
            if let Some(colours) = &last.seen.frame {
                let size = last.before.model.spec.image_size as u32;
                return Ok(enlarge(&scene::camera(colours, size), scale));
            }
        }
        Ok(enlarge(&scene::picture(&*service.shown(&id).await?, of), scale))
    });
    let picture = answer.await?;
    painted(move || pictures::png(&picture)).await
}

async fn overlay(
    State(service): App,
    Path(id): Path<String>,
    look: Asked<Look>,
) -> Result<Response, Error> {
    let answer = answer("OverlayPicture", async {
        let (of, scale) = read(look)?;
        Ok((service.shown(&id).await?, of, scale))
    });
    let (shown, of, scale) = answer.await?;
    painted(move || pictures::png(&scene::scene(&shown, of).overlay(scale))).await
}

async fn masks(
    State(service): App,
    Path(id): Path<String>,
    look: Asked<Look>,
) -> Result<Response, Error> {
    let answer = answer("MasksPicture", async {
        if let Ok(Query(Look { of: Some(of), .. })) = &look {
            return Err(Error::invalid("of", format!("{of:.64}"), "absent: both are shown"));
        }
        let (_, scale) = read(look)?;
        Ok((service.shown(&id).await?, scale))
    });
    let (shown, scale) = answer.await?;
    painted(move || pictures::png(&scene::masks(&shown, scale))).await
}

async fn strip(
    State(service): App,
    Path(id): Path<String>,
    Called(call): Called,
    look: Asked<RolloutLook>,
    body: Result<In<v1::ImagineRequest>, Error>,
) -> Result<Response, Error> {
    let asked = asked(id, look, body);
    let (pictures, _) = rollout("RolloutPicture", &service, asked, call).await?;
    painted(move || pictures::png(&pictures.strip())).await
}

async fn film(
    State(service): App,
    Path(id): Path<String>,
    Called(call): Called,
    look: Asked<RolloutLook>,
    body: Result<In<v1::ImagineRequest>, Error>,
) -> Result<Response, Error> {
    let asked = asked(id, look, body);
    played(rollout("RolloutFilm", &service, asked, call).await?).await
}

async fn drawn_strip(
    State(service): App,
    Path(id): Path<String>,
    Called(call): Called,
    drawn: Asked<Drawn>,
) -> Result<Response, Error> {
    let asked = drawn_request(&service, id, drawn);
    let (pictures, _) = rollout("RolloutPicture", &service, asked, call).await?;
    painted(move || pictures::png(&pictures.strip())).await
}

async fn drawn_film(
    State(service): App,
    Path(id): Path<String>,
    Called(call): Called,
    drawn: Asked<Drawn>,
) -> Result<Response, Error> {
    let asked = drawn_request(&service, id, drawn);
    played(rollout("RolloutFilm", &service, asked, call).await?).await
}

/// A rollout from a body.
fn asked(
    id: String,
    look: Asked<RolloutLook>,
    body: Result<In<v1::ImagineRequest>, Error>,
) -> Result<(v1::ImagineRequest, RolloutLook), Error> {
    let Query(look) = look.map_err(|error| malformed(&error))?;
    let mut request = body?.0;
    if request.outputs.is_some() {
        return Err(Error::invalid("outputs", "given", "absent: frames are painted"));
    }
    name_session(&mut request.session_id, id)?;
    Ok((request, look))
}

/// A rollout from a query: actions that are held, or drawn from the range that the model has seen.
fn drawn_request(
    service: &Service,
    session_id: String,
    drawn: Asked<Drawn>,
) -> Result<(v1::ImagineRequest, RolloutLook), Error> {
    let Query(drawn) = drawn.map_err(|error| malformed(&error))?;
    let position = service.session(&session_id)?.position();
    let spec = &position.model.spec;
    let horizon = drawn.horizon.unwrap_or(15);
    let most = service.limits().max_horizon;
    if !(1..=most).contains(&horizon) {
        return Err(Error::invalid("horizon", horizon, format!("1 to {most}")));
    }
    let candidates = match (drawn.hold, drawn.random) {
        (Some(_), Some(random)) => {
            return Err(Error::invalid("random", random, "absent: hold is given"));
        }
        (Some(hold), None) => {
            let held = hold.split(';').map(|action| held(action, spec));
            let held = held.collect::<Result<Vec<Vec<f32>>, Error>>()?;
            held.into_iter().map(|action| action.repeat(horizon as usize)).collect()
        }
        (None, Some(random)) => {
            let most = service.limits().max_candidates;
            if !(1..=most).contains(&random) {
                return Err(Error::invalid("random", random, format!("1 to {most}")));
            }
            let draws = Draws { seed: drawn.seed.unwrap_or(0), iteration: 0 };
            (0..random).map(|candidate| uniform(draws, candidate, horizon, spec)).collect()
        }
        (None, None) => vec![spec.neutral_action().repeat(horizon as usize)],
    };
    let sampling = v1::Sampling {
        mode: if drawn.seed.is_some() { v1::Mode::Sample } else { v1::Mode::Mean }.into(),
        seed: drawn.seed,
        ..v1::Sampling::default()
    };
    let actions = v1::Tensor {
        dtype: v1::DataType::F32.into(),
        shape: vec![candidates.len() as u32, horizon, spec.actions.len() as u32],
        data: Bytes::new(),
        values: candidates.concat(),
    };
    let request = v1::ImagineRequest {
        session_id,
        actions: Some(actions),
        sampling: Some(sampling),
        ..v1::ImagineRequest::default()
    };
    let Drawn { scale, every, overlay, .. } = drawn;
    Ok((request, RolloutLook { scale, every, overlay }))
}

/// An action as numbers separated by commas.
fn held(action: &str, spec: &ModelSpec) -> Result<Vec<f32>, Error> {
    let names: Vec<&str> = spec.actions.iter().map(|action| action.name.as_str()).collect();
    let expected = || format!("{} numbers ({}); actions end with ;", names.len(), names.join(","));
    let numbers: Result<Vec<f32>, _> = action.split(',').map(|text| text.trim().parse()).collect();
    let numbers = numbers.ok().filter(|numbers| numbers.len() == names.len());
    let finite = numbers.filter(|numbers| numbers.iter().all(|number| number.is_finite()));
    finite.ok_or_else(|| Error::invalid("hold", format!("{action:.64}"), expected()))
}

/// Actions from offset and twice the scale to both sides, as searches draw them.
fn uniform(draws: Draws, candidate: u32, horizon: u32, spec: &ModelSpec) -> Vec<f32> {
    let steps = (0..horizon).flat_map(|step| {
        spec.actions.iter().zip(0..).map(move |(dimension, at)| {
            let share = 4.0 * draws.uniform(candidate, at, step) - 2.0;
            (dimension.offset + share * dimension.scale) as f32
        })
    });
    steps.collect()
}

/// The pictures of a rollout, and how long the model's step lasts.
async fn rollout(
    method: &'static str,
    service: &Service,
    asked: Result<(v1::ImagineRequest, RolloutLook), Error>,
    call: Call,
) -> Result<(Pictures, Duration), Error> {
    answer(method, async {
        let (mut request, look) = asked?;
        let scale = scale(look.scale, 2)?;
        let every = ONE_OR_MORE.check(look.every.unwrap_or(1), "every")?;
        let position = service.session(&request.session_id)?.position();
        let spec = &position.model.spec;
        let outputs = match look.overlay {
            Some(true) => [
                Some(v1::Output::ObjectMasks),
                Some(v1::Output::Objects),
                spec.agent_slot.map(|_| v1::Output::AgentMask),
            ],
            _ => [None; 3],
        };
        let outputs = outputs.into_iter().flatten().chain([v1::Output::Frame]);
        request.outputs = Some(v1::OutputSelection {
            outputs: outputs.map(Into::into).collect(),
            encoding: v1::Encoding::U8.into(),
            every_k: look.every,
            ..v1::OutputSelection::default()
        });
        check_size(&request, every, (scale * spec.image_size as u32).into())?;
        let mut rollout = service.imagine(request, call).await?;
        let mut pictures = Pictures::default();
        while let Some(chunk) = rollout.next().await {
            pictures.add(&chunk?, scale);
        }
        Ok((pictures, spec.frame_period.map_or(PERIOD, Duration::from_secs_f64)))
    })
    .await
}

/// Refuses what nobody could look at.
fn check_size(request: &v1::ImagineRequest, every: u32, side: u64) -> Result<(), Error> {
    let shape = request.actions.as_ref().map_or(&[][..], |actions| &actions.shape);
    let rows = if let [candidates, _, _] = shape { u64::from(*candidates) } else { 1 };
    let horizon = shape.iter().rev().nth(1).copied().unwrap_or(1);
    let factors = [rows, (horizon / every).into(), side, side];
    let pixels = factors.into_iter().fold(1, u64::saturating_mul);
    if pixels > MAX_PIXELS {
        let expected = format!("at most {MAX_PIXELS} pixels: fewer candidates, every, or scale");
        return Err(Error::invalid("actions", format!("{pixels} pixels"), expected));
    }
    Ok(())
}

fn read(look: Asked<Look>) -> Result<(Of, u32), Error> {
    let Query(Look { of, scale: times }) = look.map_err(|error| malformed(&error))?;
    let of = match of.as_deref() {
        None | Some("camera") => Of::Camera,
        Some("belief") => Of::Belief,
        Some(other) => {
            return Err(Error::invalid("of", format!("{other:.64}"), "camera or belief"));
        }
    };
    Ok((of, scale(times, 4)?))
}

fn scale(asked: Option<u32>, default: u32) -> Result<u32, Error> {
    SCALE.check(asked.unwrap_or(default), "scale")
}

fn malformed(rejection: &QueryRejection) -> Error {
    Error::Malformed { message: "query".to_owned(), reason: rejection.body_text() }
}

async fn played((pictures, period): (Pictures, Duration)) -> Result<Response, Error> {
    Ok(file(GIF, aside(move || pictures.film(period)).await?.into()))
}

/// A PNG file, painted where it keeps nobody waiting.
async fn painted(paint: impl FnOnce() -> Bytes + Send + 'static) -> Result<Response, Error> {
    Ok(file(PNG, aside(paint).await?))
}

/// A file that is another one after the next step.
fn file(media: &'static str, bytes: Bytes) -> Response {
    ([(header::CONTENT_TYPE, media), (header::CACHE_CONTROL, "no-store")], bytes).into_response()
}
