//! The paths that show things to people: feeds and pictures, which are no methods of the wire.

use serde_json::{Value as Json, json};

use super::{
    JSON, PROTOBUF, path_parameters, problem_answer, query_parameters, request_body, requirements,
    schemas::reference,
};

/// Feeds of server-sent events.
const EVENTS: &str = "text/event-stream";
const PNG: &str = "image/png";
const GIF: &str = "image/gif";

/// A path that shows something.
#[derive(Debug)]
pub(super) struct Showing {
    /// Its name in the document.
    id: &'static str,
    pub(super) method: &'static str,
    pub(super) path: &'static str,
    summary: &'static str,
    media: &'static str,
    /// What the answer is.
    answer: &'static str,
    /// Names, types and meanings of query parameters.
    query: &'static [(&'static str, &'static str, &'static str)],
    /// Names of the events, if the answer is a feed.
    events: &'static [&'static str],
    /// Whether the body says what is imagined.
    body: bool,
}

type Query = (&'static str, &'static str, &'static str);

const OF: Query = (
    "of",
    "string",
    "`camera`, what was observed, or `belief`, what the model makes of it; `camera` by default, and `belief` for a step without an image.",
);
const SCALE: Query = (
    "scale",
    "integer",
    "Pixels of the picture for one of the model; 4 by default, 2 for rollouts.",
);
const EVERY: Query = ("every", "integer", "Shows every k-th step only.");
const OVERLAY: Query =
    ("overlay", "boolean", "Whether masks, boxes and identities are painted over.");
const DRAWN: [Query; 7] = [
    (
        "hold",
        "string",
        "Actions that are held, in raw units: numbers separated by commas, candidates by semicolons. Without `hold` and `random` the robot rests.",
    ),
    (
        "random",
        "integer",
        "Candidates to draw uniformly, at each step, from offset - 2 scale to offset + 2 scale of each dimension.",
    ),
    ("seed", "integer", "Seed of what is drawn; means are taken of the future without one."),
    ("horizon", "integer", "Steps to imagine; 15 by default."),
    EVERY,
    OVERLAY,
    SCALE,
];

const fn picture(
    id: &'static str,
    path: &'static str,
    summary: &'static str,
    answer: &'static str,
    query: &'static [Query],
) -> Showing {
    Showing {
        id,
        method: "get",
        path,
        summary,
        media: PNG,
        answer,
        query,
        events: &[],
        body: false,
    }
}

const STRIP: Showing = picture(
    "DrawnRolloutPicture",
    "/v1/sessions/{id}/rollout.png",
    "What the session imagines under held or random actions, as a strip.",
    "A row for each candidate, a column for each step.",
    &DRAWN,
);

const FILM: Showing = Showing {
    media: GIF,
    ..picture(
        "DrawnRolloutFilm",
        "/v1/sessions/{id}/rollout.gif",
        "What the session imagines under held or random actions, as an animation.",
        "The candidates side by side, at the model's own pace.",
        &DRAWN,
    )
};

/// All of them.
pub(super) const SHOWINGS: &[Showing] = &[
    Showing {
        media: EVENTS,
        events: &["overview"],
        ..picture(
            "WatchServer",
            "/v1/live",
            "Follows what the server does.",
            "Events `overview`: what the engine has computed since it started, what waits, and the sessions used last.",
            &[
                ("every_millis", "integer", "Milliseconds between two events; 500 by default."),
                ("sessions", "integer", "Sessions to tell about; 60 by default."),
                (
                    "thumbnails",
                    "boolean",
                    "Whether sessions that moved come with what they saw last, PNG in base64; of 24 sessions at most.",
                ),
            ],
        )
    },
    Showing {
        media: EVENTS,
        events: &["belief", "closed"],
        ..picture(
            "WatchSession",
            "/v1/sessions/{id}/live",
            "Follows a session's belief. A slow reader gets fewer events, never older ones.",
            "Events `belief`: step, objects, surprise, keypoints, action, timing, and the pictures that were asked for. An event `closed` when the session is closed.",
            &[(
                "pictures",
                "string",
                "Pictures that come with each step, PNG in base64: `camera`, `belief`, `masks` (agent and objects that are there, one below the other), separated by commas.",
            )],
        )
    },
    picture(
        "FramePicture",
        "/v1/sessions/{id}/frame.png",
        "The session's newest step as a picture.",
        "The picture.",
        &[OF, SCALE],
    ),
    picture(
        "OverlayPicture",
        "/v1/sessions/{id}/overlay.png",
        "The session's newest step with tinted masks, and the boxes and identities of its objects.",
        "The picture.",
        &[OF, SCALE],
    ),
    picture(
        "MasksPicture",
        "/v1/sessions/{id}/masks.png",
        "The session's newest step taken apart: agent, background, and every object.",
        "A sheet of all masks.",
        &[SCALE],
    ),
    STRIP,
    Showing {
        id: "RolloutPicture",
        method: "post",
        summary: "What the session imagines under given actions, as a strip.",
        query: &[EVERY, OVERLAY, SCALE],
        body: true,
        ..STRIP
    },
    FILM,
    Showing {
        id: "RolloutFilm",
        method: "post",
        summary: "What the session imagines under given actions, as an animation.",
        query: &[EVERY, OVERLAY, SCALE],
        body: true,
        ..FILM
    },
];

/// One event of a feed: before 3.2, which tells events from their whole, readers of `OpenAPI` take the schema of a feed
/// for that of an event. A feed whose key is withdrawn ends with a problem.
fn event(names: &[&str]) -> Json {
    let names = [names, &["problem"]].concat();
    json!({
        "type": "object",
        "required": ["event", "data"],
        "properties": {
            "event": { "enum": names },
            "data": { "type": "string", "contentMediaType": JSON },
        },
    })
}

/// A path as the document has it.
pub(super) fn describe(showing: &Showing) -> Json {
    let schema = match showing.media {
        EVENTS => json!({ "schema": event(showing.events) }),
        media => json!({ "schema": { "type": "string", "contentMediaType": media } }),
    };
    let parameters: Vec<Json> =
        path_parameters(showing.path).chain(query_parameters(showing.query)).collect();
    let mut described = json!({
        "operationId": showing.id,
        "tags": ["People"],
        "summary": showing.summary,
        "parameters": parameters,
        "responses": {
            "200": { "description": showing.answer, "content": { showing.media: schema } },
            "default": problem_answer(),
        },
    });
    if showing.body {
        let mut message = reference(".gatsbi.v1.ImagineRequest");
        requirements::add(&mut message, requirements::body(showing.id));
        let content = json!({ JSON: { "schema": message }, PROTOBUF: {} });
        described["requestBody"] = request_body(".gatsbi.v1.ImagineRequest", &content);
    }
    described
}
