//! What requests must be beyond their types, as keywords of JSON Schema.
//!
//! Only what holds for every model and every server is said. The numbers are those that the service checks
//! ([`crate::bounds`]), and `tests/api/document.rs` tries them.

use std::ops::Bound;

use serde_json::{Value as Json, json};

use crate::bounds::{
    EVERY_MILLIS, FORKS, ITERATIONS, LABEL, NOT_ALL, NOT_NEGATIVE, Numbers, ONE_OR_MORE, OVERVIEW,
    PAGE_SIZE, POSITIVE, SCALE, SHARE, SOME, SPECTRUM, TERMS, TWO_OR_MORE,
};

const U8: &str = "DATA_TYPE_U8";
const F32: &str = "DATA_TYPE_F32";

/// Members that a message must have, and not as null.
pub(super) fn required(message: &str) -> &'static [&'static str] {
    match message {
        "Between" | "Overlap" => &["a", "b"],
        "Constraint" => &["term"],
        "Context" => &["frames"],
        "CostProgram" => &["terms"],
        "ImagineRequest" => &["actions"],
        "ImportSessionRequest" => &["snapshot"],
        "MaskGoal" => &["masks"],
        "Observation" => &["step"],
        "ObserveRequest" => &["observation"],
        "PlanRequest" => &["horizon", "costs"],
        "PredictBatchRequest" => &["start", "actions"],
        "Region" => &["subject", "box"],
        "RewindSessionRequest" => &["to_step"],
        "ScoreRequest" => &["actions", "costs"],
        "SpreadPenalty" => &["subject"],
        "Tensor" => &["dtype"],
        "ToTarget" => &["subject", "target"],
        _ => &[],
    }
}

/// Which of a oneof's members are needed: those messages that are nothing without one.
pub(super) fn needs_a_choice(message: &str) -> bool {
    ["CostTerm", "Image", "Start", "Subject"].contains(&message)
}

/// Whether a message with nothing in it is refused.
pub(super) fn needs_anything(message: &str) -> bool {
    !required(message).is_empty() || message == "PutGoalRequest"
}

/// What holds for a field beside its type.
pub(super) fn field(message: &str, field: &str) -> Json {
    match (message, field) {
        // The path says it.
        (request, "session_id") if request.ends_with("Request") => json!({ "maxLength": 0 }),
        ("CreateSessionRequest" | "ForkSessionRequest" | "ImportSessionRequest", "label") => {
            json!({ "maxLength": LABEL })
        }
        ("ForkSessionRequest", "count") => within(FORKS),
        ("ObserveRequest", "outputs") => observed_outputs(),
        ("ImagineRequest" | "PlanRequest" | "PredictBatchRequest", "outputs") => imagined_outputs(),
        // Not in this version.
        ("ImagineRequest" | "PredictBatchRequest", "costs") => json!({ "type": "null" }),
        ("ImagineRequest" | "ScoreRequest" | "PredictBatchRequest", "sampling") => {
            json!({ "if": mean(), "then": { "properties": {
                "seed": { "type": "null" },
                "samples": { "enum": [1, null] },
            } } })
        }
        ("PlanRequest", "sampling") => {
            json!({ "if": mean(), "then": { "properties": { "samples": { "enum": [1, null] } } } })
        }
        ("ImagineRequest" | "ScoreRequest" | "PredictBatchRequest", "actions") => {
            tensor(&[F32], 2, 3)
        }
        ("Context" | "WarmStart", "actions") => tensor(&[F32], 2, 2),
        ("Context", "frames") => tensor(&[U8], 4, 4),
        ("Image", "pixels") => tensor(&[U8, F32], 3, 3),
        ("MaskGoal", "masks") => tensor(&[U8, F32], 2, 3),
        // Costs are sums without bounds, and JSON has no infinity.
        ("PlanResponse", "cost" | "violation") => overflowing(&["number", "string", "null"]),
        ("PlanResponse", "best_costs") => json!({ "items": overflowing(&["number", "string"]) }),
        ("Subject", "agent" | "all_objects") => json!({ "enum": [true, null] }),
        ("CostProgram", "terms") => json!({ "minItems": 1, "maxItems": TERMS }),
        ("CostProgram", "constraints") => json!({ "maxItems": TERMS }),
        ("CostProgram", "discount" | "worst_share") => within(SOME),
        ("CostProgram", "missing_distance")
        | ("ToTarget", "tolerance")
        | ("Between", "target_distance")
        | ("Cem", "min_std") => within(NOT_NEGATIVE),
        (_, "timeout_millis" | "budget_millis" | "every_k" | "samples")
        | ("PlanRequest", "horizon" | "action_repeat")
        | ("RandomShooting" | "Mppi", "candidates")
        | ("Cem", "elites")
        | ("Icem", "decay") => within(ONE_OR_MORE),
        ("Cem", "candidates") => within(TWO_OR_MORE),
        ("Cem" | "Mppi", "iterations") => within(ITERATIONS),
        ("Cem", "initial_std") | ("Mppi", "temperature" | "noise_std") => within(POSITIVE),
        ("Cem", "momentum") => within(NOT_ALL),
        ("Icem", "keep_elites") => within(SHARE),
        ("Icem" | "Mppi", "noise_beta") => within(SPECTRUM),
        _ => json!({}),
    }
}

/// What holds for a message beside its fields.
pub(super) fn whole(message: &str) -> Json {
    match message {
        "Observation" => first_image("object"),
        "OutputSelection" => json!({
            "if": { "properties": { "last_only": { "const": true } }, "required": ["last_only"] },
            "then": { "properties": { "every_k": { "type": "null" } } },
        }),
        "PutGoalRequest" => json!({ "anyOf": [
            { "required": ["image"], "properties": { "image": { "type": "object" } } },
            { "required": ["masks"], "properties": { "masks": { "type": "array", "minItems": 1 } } },
        ] }),
        _ => json!({}),
    }
}

/// What holds for the body of an operation beside its message.
pub(super) fn body(operation: &str) -> Json {
    match operation {
        "Imagine" => {
            json!({ "required": ["outputs"], "properties": { "outputs": { "type": "object" } } })
        }
        // Frames are painted.
        "RolloutPicture" | "RolloutFilm" => {
            json!({ "properties": { "outputs": { "type": "null" } } })
        }
        // The session is open, and stays as it was opened.
        "ReplaceSession" => json!({ "properties": {
            "label": { "maxLength": 0 },
            "ttl": { "type": "null" },
            "keep_steps": { "maximum": 0 },
            "keep_frames": { "maximum": 0 },
            "latest_wins": { "enum": [false, null] },
        } }),
        _ => json!({}),
    }
}

/// The schema of a query parameter.
pub(super) fn parameter(name: &str, kind: &str) -> Json {
    let mut schema = json!({ "type": kind });
    let more = match name {
        "at_step" | "seed" => json!({ "minimum": 0, "maximum": u64::MAX }),
        "page_size" => within(PAGE_SIZE),
        "scale" => within(SCALE),
        "every_millis" => within(EVERY_MILLIS),
        "sessions" => within(OVERVIEW),
        "every" | "horizon" | "random" => {
            json!({ "minimum": 1, "maximum": u32::MAX })
        }
        "page_token" => json!({ "pattern": "^([0-9A-Fa-f]{32})?$" }),
        "of" => json!({ "enum": ["camera", "belief"] }),
        "pictures" => {
            json!({ "pattern": "^(camera|belief|masks)?(,(camera|belief|masks)?)*$" })
        }
        "hold" => json!({ "pattern": format!("^{HELD}(;{HELD})*$") }),
        _ => json!({}),
    };
    add(&mut schema, more);
    schema
}

/// Numbers separated by commas.
const HELD: &str = "-?[0-9]{1,9}(\\.[0-9]{1,9})?(,-?[0-9]{1,9}(\\.[0-9]{1,9})?)*";

/// An observation as a form, for people with curl.
pub(super) fn form() -> Json {
    let names = |all: &[&str]| all.join("|").to_lowercase();
    let (outputs, encodings) = (names(&OBSERVED), "f32|f16|u8|png");
    let mut form = json!({
        "type": "object",
        "required": ["step"],
        "additionalProperties": false,
        "properties": {
            "step": {
                "type": "integer",
                "minimum": 0,
                "maximum": u64::MAX,
                "description": "Number of the step.",
            },
            "image": {
                "type": "string",
                "contentMediaType": "image/*",
                "description": "A PNG, JPEG or WebP file.",
            },
            "action": {
                "type": "string",
                "pattern": format!("^({HELD})?$"),
                "description": "Numbers separated by commas.",
            },
            "outputs": {
                "type": "string",
                "pattern": format!("^(({outputs})(,({outputs}))*)?$"),
                "description": "Names of outputs separated by commas, such as frame,objects.",
            },
            "encoding": {
                "type": "string",
                "pattern": format!("^({encodings})$"),
                "description": "Name of an encoding, such as png.",
            },
            "timeout_millis": {
                "type": "integer",
                "minimum": 1,
                "maximum": u32::MAX,
                "description": "Milliseconds within which an answer is of use.",
            },
        },
    });
    add(&mut form, first_image("string"));
    form
}

/// A session's first observation needs an image.
fn first_image(kind: &str) -> Json {
    json!({
        "if": { "properties": { "step": { "const": 0 } } },
        "then": { "required": ["image"], "properties": { "image": { "type": kind } } },
    })
}

/// Puts keywords into a schema.
pub(super) fn add(schema: &mut Json, keywords: Json) {
    if let (Json::Object(schema), Json::Object(keywords)) = (schema, keywords) {
        schema.extend(keywords);
    }
}

/// Outputs that observed steps have.
const OBSERVED: [&str; 10] = [
    "FRAME",
    "AGENT_MASK",
    "SLOT_MASKS",
    "OBJECT_MASKS",
    "BACKGROUND",
    "OBJECTS",
    "LATENTS",
    "SURPRISE",
    "LOG_LIKELIHOOD",
    "KEYPOINTS",
];

/// How many of these imagined steps have too, and what they have besides.
const IMAGINED: usize = 7;
const OVER_SAMPLES: [&str; 2] = ["SPREAD", "OBJECT_SPREAD"];

fn observed_outputs() -> Json {
    json!({ "properties": {
        "outputs": { "items": { "enum": outputs(&OBSERVED) } },
        "every_k": { "type": "null" },
        "last_only": { "enum": [false, null] },
    } })
}

fn imagined_outputs() -> Json {
    let names = [&OBSERVED[..IMAGINED], &OVER_SAMPLES].concat();
    json!({
        "required": ["outputs"],
        "properties": {
            "outputs": { "type": "array", "minItems": 1, "items": { "enum": outputs(&names) } },
        },
    })
}

fn outputs(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| format!("OUTPUT_{name}")).collect()
}

/// Sampling that draws nothing.
fn mean() -> Json {
    json!({ "properties": { "mode": { "const": "MODE_MEAN" } }, "required": ["mode"] })
}

fn tensor(types: &[&str], least: usize, most: usize) -> Json {
    json!({
        "required": ["shape"],
        "properties": {
            "dtype": { "enum": types },
            "shape": { "type": "array", "minItems": least, "maxItems": most },
        },
    })
}

/// Numbers that may be infinite, as the JSON of protobuf writes them.
fn overflowing(types: &[&str]) -> Json {
    json!({ "type": types, "pattern": "^(NaN|-?Infinity)$" })
}

fn within(Numbers { least, most }: Numbers) -> Json {
    // Whole numbers without a point.
    let number = |x: f64| if x.fract() == 0.0 { json!(x as i64) } else { json!(x) };
    // Messages hold single precision: what is nearer to an excluded bound than to its neighbour is that bound.
    let halfway = |bound: f64, neighbour: f32| json!(f64::midpoint(bound, neighbour.into()));
    let mut keywords = json!({});
    match least {
        Bound::Included(least) => keywords["minimum"] = number(least),
        Bound::Excluded(least) => {
            keywords["exclusiveMinimum"] = halfway(least, (least as f32).next_up());
        }
        Bound::Unbounded => {}
    }
    match most {
        Bound::Included(most) => keywords["maximum"] = number(most),
        Bound::Excluded(most) => {
            keywords["exclusiveMaximum"] = halfway(most, (most as f32).next_down());
        }
        Bound::Unbounded => {}
    }
    keywords
}
