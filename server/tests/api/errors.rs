//! Bad input: the same typed error on both APIs, with field, value and expectation, and a session that stays put.

use base64::{Engine as _, prelude::BASE64_STANDARD};
use gatsbi_proto::v1::{self, Encoding, Mode, Output, image::Content};
use prost::Message as _;
use serde_json::Value as Json;
use tonic::{Code, Status};
use tonic_types::StatusExt as _;

use crate::support::{
    ACTION, TestServer, actions, balls, config, f32_tensor, observation, outputs, rollout, u8_image,
};

/// What both APIs should say.
struct Expected {
    reason: &'static str,
    code: Code,
    http: u16,
    field: &'static str,
    /// A part of value or expectation.
    says: &'static str,
}

const fn invalid(field: &'static str, says: &'static str) -> Expected {
    let (code, http) = (Code::InvalidArgument, 400);
    Expected { reason: "INVALID_FIELDS", code, http, field, says }
}

const fn unavailable(field: &'static str, says: &'static str) -> Expected {
    let (code, http) = (Code::FailedPrecondition, 400);
    Expected { reason: "OUTPUT_UNAVAILABLE", code, http, field, says }
}

fn check_status(name: &str, status: &Status, expected: &Expected) {
    assert_eq!(status.code(), expected.code, "{name}: {status:?}");
    let details = status.get_error_details();
    assert_eq!(details.error_info().unwrap().reason, expected.reason, "{name}");
    let violations = &details.bad_request().unwrap().field_violations;
    let found = violations.iter().find(|violation| violation.field == expected.field);
    let found = found.unwrap_or_else(|| panic!("{name}: {} not in {violations:?}", expected.field));
    assert!(found.description.contains(expected.says), "{name}: {}", found.description);
}

fn check_document(name: &str, (http, document): &(u16, Json), expected: &Expected) {
    assert_eq!(*http, expected.http, "{name}: {document}");
    assert_eq!(document["reason"], expected.reason, "{name}");
    assert_eq!(document["status"], expected.http, "{name}");
    let fields = document["fields"].as_array().unwrap();
    let found = fields.iter().find(|field| field["field"] == expected.field);
    let found = found.unwrap_or_else(|| panic!("{name}: {} not in {document}", expected.field));
    let text = format!(
        "is {}, expected {}",
        found["value"].as_str().unwrap(),
        found["expected"].as_str().unwrap()
    );
    assert!(text.contains(expected.says), "{name}: {text}");
}

/// Sends a message over REST as protobuf, whose errors are those of JSON.
async fn post(server: &TestServer, path: &str, body: Vec<u8>) -> (u16, Json) {
    let request = server.post(path).header("content-type", "application/x-protobuf").body(body);
    let response = request.send().await.unwrap();
    let status = response.status().as_u16();
    let media = response.headers()["content-type"].to_str().unwrap().to_owned();
    assert_eq!(media, "application/problem+json", "{path}");
    (status, response.json().await.unwrap())
}

#[tokio::test]
async fn bad_observations_are_refused_by_field() {
    type Spoil = fn(&mut v1::ObserveRequest);
    fn seen(request: &mut v1::ObserveRequest) -> &mut v1::Observation {
        request.observation.as_mut().unwrap()
    }
    fn asked(request: &mut v1::ObserveRequest) -> &mut v1::OutputSelection {
        request.outputs.as_mut().unwrap()
    }

    let server = TestServer::start().await;
    let session = server.seasoned(4, 2).await;
    let cases: Vec<(&str, Spoil, Expected)> = vec![
        ("no step", |r| seen(r).step = None, invalid("observation.step", "absent")),
        (
            "short action",
            |r| seen(r).action.truncate(3),
            invalid("observation.action", "is 3 numbers, expected 7 numbers (joint 0, "),
        ),
        ("no action", |r| seen(r).action.clear(), invalid("observation.action", "is 0 numbers")),
        ("nan", |r| seen(r).action[2] = f32::NAN, invalid("observation.action[2]", "NaN")),
        (
            "infinite",
            |r| seen(r).action[6] = f32::INFINITY,
            invalid("observation.action[6]", "inf"),
        ),
        (
            "too few bytes",
            |r| seen(r).image = Some(u8_image(64, 64, vec![0; 100])),
            invalid("observation.image.pixels.data", "is 100 bytes, expected 12288 bytes"),
        ),
        (
            "grey pixels",
            |r| {
                let pixels = f32_tensor(&[64, 64, 1], &[0.0; 4096]);
                seen(r).image = Some(v1::Image { content: Some(Content::Pixels(pixels)) });
            },
            invalid("observation.image.pixels.shape", "[height, width, 3]"),
        ),
        (
            "bright pixels",
            |r| {
                let pixels = f32_tensor(&[1, 1, 3], &[0.0, 1.5, 0.0]);
                seen(r).image = Some(v1::Image { content: Some(Content::Pixels(pixels)) });
            },
            invalid("observation.image.pixels.data[1]", "1.5"),
        ),
        (
            "huge picture",
            |r| seen(r).image = Some(u8_image(1, 5000, vec![0; 15_000])),
            invalid(
                "observation.image.pixels",
                "is 5000 x 1 pixels, expected width and height of 1 to 4096",
            ),
        ),
        (
            "no picture",
            |r| {
                let content = Some(Content::Encoded(b"BM not a picture".as_slice().into()));
                seen(r).image = Some(v1::Image { content });
            },
            invalid("observation.image.encoded", "PNG, JPEG or WebP"),
        ),
        ("unknown output", |r| asked(r).outputs.push(99), invalid("outputs.outputs[2]", "is 99")),
        ("unknown encoding", |r| asked(r).encoding = 9, invalid("outputs.encoding", "is 9")),
        (
            "steps of a single step",
            |r| asked(r).every_k = Some(2),
            invalid("outputs.every_k", "single step"),
        ),
        ("no time", |r| r.timeout_millis = Some(0), invalid("timeout_millis", "1 or more")),
    ];
    let path = format!("/v1/sessions/{}/observations", session.id);
    for (name, spoil, expected) in cases {
        let mut request = observation(&session, 2);
        spoil(&mut request);
        let status = server.observe(request.clone()).await.unwrap_err();
        check_status(name, &status, &expected);
        check_document(name, &post(&server, &path, request.encode_to_vec()).await, &expected);
    }
    let fresh = server.session(5).await;
    let mut blind = observation(&fresh, 0);
    blind.observation.as_mut().unwrap().image = None;
    let status = server.observe(blind).await.unwrap_err();
    check_status("blind start", &status, &invalid("observation.image", "first observation"));

    // Nothing of this has moved the session.
    assert_eq!(server.next_step(&session).await, 2);
    let twin = server.seasoned(4, 2).await;
    let mut expected = observation(&session, 2);
    expected.session_id = twin.id;
    let expected = server.observe(expected).await.unwrap();
    let belief = server.observe(observation(&session, 2)).await.unwrap();
    assert_eq!(belief.outputs, expected.outputs);
    server.app.shutdown().await;
}

#[tokio::test]
async fn bad_rollouts_are_refused_by_field() {
    type Spoil = fn(&mut v1::ImagineRequest);
    fn sampling(request: &mut v1::ImagineRequest) -> &mut v1::Sampling {
        request.sampling.as_mut().unwrap()
    }
    fn asked(request: &mut v1::ImagineRequest) -> &mut v1::OutputSelection {
        request.outputs.as_mut().unwrap()
    }
    const ONE: usize = ACTION;

    let server = TestServer::start().await;
    let session = server.seasoned(4, 2).await;
    let cases: Vec<(&str, Spoil, Expected)> = vec![
        ("no actions", |r| r.actions = None, invalid("actions", "absent")),
        (
            "other actions",
            |r| r.actions = Some(f32_tensor(&[1, 1, 6], &[0.0; 6])),
            invalid("actions.shape", "is [1, 1, 6], expected [candidates, horizon, 7]"),
        ),
        (
            "no candidates",
            |r| r.actions = Some(f32_tensor(&[0, 3, 7], &[])),
            invalid("actions.shape", "1 to 4096 candidates"),
        ),
        (
            "far horizon",
            |r| r.actions = Some(f32_tensor(&[257, 7], &vec![0.0; 257 * ONE])),
            invalid("actions.shape", "is 257, expected 1 to 256 steps"),
        ),
        (
            "many candidates",
            |r| r.actions = Some(f32_tensor(&[4097, 1, 7], &vec![0.0; 4097 * ONE])),
            invalid("actions.shape", "is 4097, expected 1 to 4096 candidates"),
        ),
        (
            "nan",
            |r| {
                let mut numbers = actions(1, 1, 0);
                numbers[4] = f32::NAN;
                r.actions = Some(f32_tensor(&[1, 1, 7], &numbers));
            },
            invalid("actions.data[4]", "finite"),
        ),
        (
            "half the bytes",
            |r| r.actions.as_mut().unwrap().shape[0] = 6,
            invalid("actions.data", "expected 504 bytes"),
        ),
        (
            "bytes as actions",
            |r| r.actions.as_mut().unwrap().dtype = v1::DataType::U8.into(),
            invalid("actions.dtype", "DATA_TYPE_F32"),
        ),
        ("no samples", |r| sampling(r).samples = Some(0), invalid("sampling.samples", "1 to 256")),
        (
            "many samples",
            |r| sampling(r).samples = Some(300),
            invalid("sampling.samples", "is 300"),
        ),
        (
            "sampled means",
            |r| {
                *sampling(r) =
                    v1::Sampling { mode: Mode::Mean.into(), samples: Some(2), ..Default::default() }
            },
            invalid("sampling.samples", "MODE_MEAN"),
        ),
        ("unknown mode", |r| sampling(r).mode = 7, invalid("sampling.mode", "is 7")),
        ("no outputs", |r| asked(r).outputs.clear(), invalid("outputs.outputs", "at least one")),
        (
            "rare steps",
            |r| asked(r).every_k = Some(4),
            invalid("outputs.every_k", "1 to 3, the horizon"),
        ),
        (
            "surprise of what was not seen",
            |r| asked(r).outputs.push(Output::Surprise.into()),
            unavailable("outputs.outputs[1]", "OUTPUT_SURPRISE"),
        ),
        (
            "keypoints of what was not seen",
            |r| asked(r).outputs.push(Output::Keypoints.into()),
            unavailable("outputs.outputs[1]", "compares a step with its image"),
        ),
        (
            "another step",
            |r| r.at_step = Some(0),
            Expected {
                reason: "SESSION_MOVED",
                code: Code::FailedPrecondition,
                http: 409,
                field: "at_step",
                says: "is 0, expected 1",
            },
        ),
        (
            "many bytes",
            |r| {
                r.actions = Some(f32_tensor(&[1024, 4, 7], &vec![0.0; 4096 * ONE]));
                *asked(r) = outputs(&[Output::ObjectMasks], Encoding::F32);
            },
            invalid("outputs", "at most 268435456 bytes"),
        ),
    ];
    let path = format!("/v1/sessions/{}/rollouts", session.id);
    for (name, spoil, expected) in cases {
        let mut request = rollout(&session, 3, 3);
        spoil(&mut request);
        let status = server.imagine(request.clone()).await.unwrap_err();
        check_status(name, &status, &expected);
        check_document(name, &post(&server, &path, request.encode_to_vec()).await, &expected);
    }
    let fresh = server.session(5).await;
    let status = server.imagine(rollout(&fresh, 1, 1)).await.unwrap_err();
    assert_eq!(status.code(), Code::FailedPrecondition);
    assert_eq!(status.message(), "the session has observed nothing yet");
    server.app.shutdown().await;
}

#[tokio::test]
async fn what_a_model_does_not_have_cannot_be_had() {
    let server = TestServer::serving(config(), |_| Ok(vec![balls()])).await;
    let session = server.session(1).await;
    for (output, says) in [(Output::AgentMask, "no agent"), (Output::Keypoints, "no detector")] {
        let mut request = observation(&session, 0);
        request.observation.as_mut().unwrap().action.clear();
        request.outputs = Some(outputs(&[output], Encoding::U8));
        let expected = unavailable("outputs.outputs[0]", says);
        let status = server.observe(request.clone()).await.unwrap_err();
        check_status(says, &status, &expected);
        let path = format!("/v1/sessions/{}/observations", session.id);
        check_document(says, &post(&server, &path, request.encode_to_vec()).await, &expected);
    }
    server.app.shutdown().await;
}

#[tokio::test]
async fn bodies_that_are_no_messages_are_refused() {
    let server = TestServer::start().await;
    let session = server.session(1).await;
    let path = format!("/v1/sessions/{}/observations", session.id);
    let send = async |media: &'static str, body: Vec<u8>| {
        let response =
            server.post(&path).header("content-type", media).body(body).send().await.unwrap();
        let status = response.status().as_u16();
        let document: Json = response.json().await.unwrap();
        (status, document["reason"].as_str().unwrap().to_owned(), document["detail"].to_string())
    };
    let (status, reason, detail) =
        send("application/json", br#"{"observatoin": {}}"#.to_vec()).await;
    assert_eq!((status, reason.as_str()), (400, "MALFORMED_BODY"));
    assert!(detail.contains("observatoin"), "{detail}");
    let (status, reason, _) = send("application/json", b"{".to_vec()).await;
    assert_eq!((status, reason.as_str()), (400, "MALFORMED_BODY"));
    let (status, reason, _) = send("application/x-protobuf", vec![0xff; 9]).await;
    assert_eq!((status, reason.as_str()), (400, "MALFORMED_BODY"));
    let (status, reason, _) = send("text/plain", b"hello".to_vec()).await;
    assert_eq!((status, reason.as_str()), (415, "MEDIA_TYPE"));
    let large = BASE64_STANDARD.encode(vec![0; 13 << 20]).into_bytes();
    let (status, reason, detail) = send("application/json", large).await;
    assert_eq!((status, reason.as_str()), (413, "BODY_TOO_LARGE"));
    assert!(detail.contains("16777216"), "{detail}");

    for (name, text, field) in [
        ("step", "three", "observation.step"),
        ("action", "0.5,x", "observation.action[1]"),
        ("outputs", "frame,soul", "outputs.outputs[1]"),
        ("encoding", "bmp", "outputs.encoding"),
        ("colour", "red", "colour"),
    ] {
        let form = reqwest::multipart::Form::new().text(name, text);
        let response = server.post(&path).multipart(form).send().await.unwrap();
        assert_eq!(response.status(), 400, "{name}");
        let document: Json = response.json().await.unwrap();
        assert_eq!(document["fields"][0]["field"], field);
    }

    let response = server.get("/v1/robots").send().await.unwrap();
    assert_eq!(response.status(), 404);
    assert_eq!(response.json::<Json>().await.unwrap()["reason"], "UNKNOWN_PATH");
    let response = server.delete("/v1/models").send().await.unwrap();
    assert_eq!(response.status(), 405);
    assert_eq!(response.json::<Json>().await.unwrap()["reason"], "UNKNOWN_METHOD");
    for path in ["/v1/sessions/7", "/v1/sessions?page_size=0", "/v1/sessions?pages=1"] {
        let response = server.get(path).send().await.unwrap();
        assert!([400, 404].contains(&response.status().as_u16()), "{path}");
        assert!(response.json::<Json>().await.unwrap()["reason"].is_string());
    }
    assert_eq!(server.next_step(&session).await, 0);
    server.app.shutdown().await;
}
