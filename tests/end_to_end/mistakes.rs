//! Bad input through every door: the same field, value and expectation, and a session that has not moved.

use std::fs;

use base64::{Engine as _, prelude::BASE64_STANDARD};
use gatsbi_client::{Actions, Error, Image, Imagination, Observation, Session};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::{
    episode::wanted,
    programs::Server,
    recording::{SIZE, Told, episode, observation},
};

/// Dimensions of the model's actions.
const ACTION: usize = 7;

/// Steps that the session has observed.
const OBSERVED: usize = 2;

/// A PNG file of 30000 x 30000 pixels up to where they begin.
const HUGE: &[u8] = b"\x89PNG\r\n\x1a\n\
    \0\0\0\rIHDR\0\0\x75\x30\0\0\x75\x30\x08\x02\0\0\0\xe9\x45\x6f\xed\
    \0\0\0\x0cIDAT\x78\x9c";

/// An observation or a rollout that nobody should send, and what the server says to it.
struct Mistake<T> {
    name: &'static str,
    sent: T,
    field: &'static str,
    /// Value and expectation.
    says: &'static str,
}

/// An image file and the action that led to it.
struct Seen {
    image: Vec<u8>,
    action: Vec<f32>,
}

/// Candidates, `[candidates, horizon, dimension]`.
struct Imagined {
    shape: [usize; 3],
    numbers: Vec<f32>,
}

/// A session, and what goes with it.
struct Place {
    server: Server,
    session: Session,
    folder: TempDir,
}

impl Place {
    async fn new() -> Self {
        let server = Server::start();
        let session = server.session(3).await;
        for t in 0..OBSERVED {
            session.observe(observation(&episode(), t), &wanted()).await.unwrap();
        }
        Self { server, session, folder: tempfile::tempdir().unwrap() }
    }

    /// Checks that the session has not moved, and goes on as if nothing had been.
    async fn check_unmoved(mut self) {
        let episode = episode();
        assert_eq!(self.session.refresh().await.unwrap().next_step, OBSERVED as u64);
        let twin = self.server.session(3).await;
        let mut expected = None;
        for t in 0..=OBSERVED {
            expected = Some(twin.observe(observation(&episode, t), &wanted()).await.unwrap());
        }
        let belief = self.session.observe(observation(&episode, OBSERVED), &wanted()).await;
        assert_eq!(Some(Told::from(&belief.unwrap())), expected.as_ref().map(Told::from));
        self.server.terminate();
        let (status, log) = self.server.wait().await;
        assert!(status.success() && !log.contains("ERROR") && !log.contains("panic"), "{log}");
    }

    /// Writes a file for the command line; returns its path.
    fn file(&self, name: &str, content: impl AsRef<[u8]>) -> String {
        let path = self.folder.path().join(name);
        fs::write(&path, content).unwrap();
        path.to_str().unwrap().to_owned()
    }
}

#[tokio::test]
async fn bad_observations_are_refused_at_every_door() {
    let place = Place::new().await;
    let picture = || {
        let path = place.folder.path().join("frame.png");
        let pixels = episode().frame(OBSERVED).to_vec();
        image::RgbImage::from_raw(SIZE, SIZE, pixels).unwrap().save(&path).unwrap();
        fs::read(path).unwrap()
    };
    let action = || vec![0.1; ACTION];
    let with = |at: usize, number| {
        let mut action = action();
        action[at] = number;
        action
    };
    let seen = |image, action| Seen { image, action };
    let mistakes = [
        Mistake {
            name: "short action",
            sent: seen(picture(), vec![0.1; 6]),
            field: "observation.action",
            says: "is 6 numbers, expected 7 numbers",
        },
        Mistake {
            name: "no action",
            sent: seen(picture(), Vec::new()),
            field: "observation.action",
            says: "is 0 numbers, expected 7 numbers",
        },
        Mistake {
            name: "not a number",
            sent: seen(picture(), with(2, f32::NAN)),
            field: "observation.action[2]",
            says: "is NaN, expected a finite number",
        },
        Mistake {
            name: "infinite",
            sent: seen(picture(), with(6, f32::INFINITY)),
            field: "observation.action[6]",
            says: "is inf, expected a finite number",
        },
        Mistake {
            name: "half a file",
            sent: seen(picture()[..400].to_vec(), action()),
            field: "observation.image.encoded",
            says: "expected ",
        },
        Mistake {
            name: "no picture",
            sent: seen(b"a text of some length".to_vec(), action()),
            field: "observation.image.encoded",
            says: "PNG, JPEG or WebP",
        },
        Mistake {
            name: "huge picture",
            sent: seen(HUGE.to_vec(), action()),
            field: "observation.image.encoded",
            says: "is 30000 x 30000 pixels, expected width and height of 1 to 4096",
        },
    ];
    for mistake in mistakes {
        let Seen { image, action } = &mistake.sent;
        let file = place.file("image", image);
        let numbers = action.iter().map(ToString::to_string).collect::<Vec<_>>().join(",");
        let mut arguments =
            vec!["observe", "--session", place.session.id(), "--image", file.as_str()];
        if !action.is_empty() {
            arguments.extend(["--action", &numbers]);
        }
        mistake.check_typed(&place.server, &arguments);

        let (step, image_sent) = (OBSERVED as u64, Some(Image::file(image.clone())));
        let sent = Observation { step, image: image_sent, action: action.clone() };
        mistake.check_error(&place.session.observe(sent, &wanted()).await.unwrap_err());

        let body = json!({ "observation": {
            "step": OBSERVED,
            "image": { "encoded": BASE64_STANDARD.encode(image) },
            "action": action.iter().copied().map(number).collect::<Vec<_>>(),
        } });
        let path = format!("/v1/sessions/{}/observations", place.session.id());
        mistake.check_document(&place.server.post(&path, &body).await);
    }
    place.check_unmoved().await;
}

#[tokio::test]
async fn bad_rollouts_are_refused_at_every_door() {
    let place = Place::new().await;
    let still = |shape: [usize; 3]| Imagined { shape, numbers: vec![0.0; shape.iter().product()] };
    let mut odd = still([2, 3, ACTION]);
    odd.numbers[ACTION + 1] = f32::NAN;
    let mistakes = [
        Mistake {
            name: "other dimension",
            sent: still([2, 3, 6]),
            field: "actions.shape",
            says: "is [2, 3, 6], expected [candidates, horizon, 7]",
        },
        Mistake {
            name: "far horizon",
            sent: still([1, 257, ACTION]),
            field: "actions.shape",
            says: "is 257, expected 1 to 256 steps of horizon",
        },
        Mistake {
            name: "many candidates",
            sent: still([4097, 1, ACTION]),
            field: "actions.shape",
            says: "is 4097, expected 1 to 4096 candidates",
        },
        Mistake {
            name: "not a number",
            sent: odd,
            field: "actions.data[8]",
            says: "is NaN, expected a finite number",
        },
    ];
    for mistake in mistakes {
        let Imagined { shape, numbers } = &mistake.sent;
        let file = place.file("actions.csv", csv(numbers, shape[1], shape[2]));
        let arguments = ["imagine", "--session", place.session.id(), "--actions", file.as_str()];
        mistake.check_typed(&place.server, &arguments);

        let actions = Actions::new(*shape, numbers.clone()).unwrap();
        let refused = place.session.imagine(Imagination::of(actions, wanted())).await;
        mistake.check_error(&refused.err().unwrap());

        let data: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        let data = BASE64_STANDARD.encode(data);
        let body = json!({
            "actions": { "dtype": "DATA_TYPE_F32", "shape": shape, "data": data },
            "outputs": { "outputs": ["OUTPUT_FRAME"] },
        });
        let path = format!("/v1/sessions/{}/rollouts", place.session.id());
        mistake.check_document(&place.server.post(&path, &body).await);
    }
    place.check_unmoved().await;
}

#[tokio::test]
async fn sessions_that_are_not_there_are_named() {
    let server = Server::start();
    let nobody = "0123456789abcdef".repeat(2);
    let error = server.client().await.session(&nobody).await.unwrap_err();
    assert_eq!(error.problem().unwrap().reason, "UNKNOWN_SESSION");
    assert!(error.to_string().contains(&nobody), "{error}");

    let path = format!("/v1/sessions/{nobody}/rollouts");
    let (status, document) = server.post(&path, &json!({})).await;
    assert_eq!((status, &document["reason"]), (404, &"UNKNOWN_SESSION".into()));
    assert!(document["detail"].as_str().unwrap().contains(&nobody), "{document}");

    for command in [
        &["session", "show", nobody.as_str()][..],
        &["observe", "--dropped", "--session", nobody.as_str()],
        &["imagine", "--random", "2", "--horizon", "2", "--session", nobody.as_str()],
    ] {
        let error = server.gatsbi(&[command, &["--json"]].concat()).error();
        assert_eq!((&error["reason"], &error["exit_code"]), (&"UNKNOWN_SESSION".into(), &3.into()));
        assert!(error["message"].as_str().unwrap().contains(&nobody), "{error}");
    }
}

#[tokio::test]
async fn what_no_server_could_take_is_found_before_it_is_sent() {
    let error = Image::rgb(SIZE, SIZE, vec![0; 5]).unwrap_err();
    assert_eq!(error.to_string(), "pixels is 5 bytes, expected 3 * 64 * 64 bytes");
    assert!(matches!(error, Error::Input { field: "pixels", .. }));
    let error = Actions::new([2, 3, ACTION], vec![0.0; 6]).unwrap_err();
    assert_eq!(
        error.to_string(),
        "actions is 6 numbers, expected 2 candidates x 3 steps x 7 numbers"
    );
}

impl<T> Mistake<T> {
    /// The command line refuses it: exit code, sentence for people, fields for machines.
    #[track_caller]
    fn check_typed(&self, server: &Server, arguments: &[&str]) {
        let name = self.name;
        let answer = server.gatsbi(arguments);
        assert_eq!(answer.code, Some(3), "{name}: {answer:?}");
        assert!(answer.err.starts_with("error: ") && answer.err.contains(self.field), "{answer:?}");
        let error = server.gatsbi(&[arguments, &["--json"]].concat()).error();
        assert_eq!(error["reason"], "INVALID_FIELDS", "{name}: {error}");
        let fields = error["fields"].as_array().unwrap();
        let found = fields.iter().find(|field| field["field"] == self.field);
        let found = found.unwrap_or_else(|| panic!("{name}: {error}"));
        assert!(found["description"].as_str().unwrap().contains(self.says), "{name}: {found}");
    }

    /// The Rust client refuses it.
    #[track_caller]
    fn check_error(&self, error: &Error) {
        let name = self.name;
        let problem = error.problem().unwrap_or_else(|| panic!("{name}: {error:?}"));
        assert_eq!(problem.reason, "INVALID_FIELDS", "{name}: {problem:?}");
        let found = problem.fields.iter().find(|field| field.field == self.field);
        let found = found.unwrap_or_else(|| panic!("{name}: {problem:?}"));
        assert!(found.description.contains(self.says), "{name}: {found:?}");
    }

    /// The REST API refuses it.
    #[track_caller]
    fn check_document(&self, (status, document): &(u16, Value)) {
        let name = self.name;
        let reason = document["reason"].as_str();
        assert_eq!((*status, reason), (400, Some("INVALID_FIELDS")), "{name}: {document}");
        let fields = document["fields"].as_array().unwrap();
        let found = fields.iter().find(|field| field["field"] == self.field);
        let found = found.unwrap_or_else(|| panic!("{name}: {document}"));
        let text = |key: &str| found[key].as_str().unwrap();
        let text = format!("is {}, expected {}", text("value"), text("expected"));
        assert!(text.contains(self.says), "{name}: {text}");
    }
}

/// A number as protobuf's JSON writes it.
fn number(number: f32) -> Value {
    match number {
        number if number.is_nan() => "NaN".into(),
        number if number.is_infinite() => "Infinity".into(),
        number => number.into(),
    }
}

/// Candidates as the command line reads them: a step a line, an empty line between candidates.
fn csv(numbers: &[f32], horizon: usize, dimension: usize) -> String {
    let line = |step: &[f32]| step.iter().map(ToString::to_string).collect::<Vec<_>>().join(",");
    let candidate =
        |steps: &[f32]| steps.chunks(dimension).map(line).collect::<Vec<_>>().join("\n");
    numbers.chunks(horizon * dimension).map(candidate).collect::<Vec<_>>().join("\n\n")
}
