//! Serves a scene to another program over two streams: lines of JSON, pictures as raw bytes after their line.
//!
//! The first line is written unasked: `{"protocol": 1, "spec": {...}}` with the [`crate::SceneSpec`]. Then each line that
//! is read is a request, and each request has one answer, in order:
//!
//! | request | answer |
//! |---|---|
//! | `{"op": "reset", "seed": 7}` | observation |
//! | `{"op": "step", "action": [0.1, ...]}` | observation |
//! | `{"op": "set_goal", "objects": [[0.5, 0.1], null, ...]}` | observation: how it would look |
//! | `{"op": "scripted_action"}` | `{"action": [...]}` |
//! | `{"op": "futures", "candidates": [[[0.1, ...], ...], ...]}` | `{"futures": [...]}`: objects by candidate and action |
//! | `{"op": "hand_moves", "candidates": [[[0.02, 0.0], ...], ...]}` | `{"moves": [...]}`: actions and hands, likewise |
//!
//! An observation is `{"state": {...}, "rgb": [H, W, 3], "mask": [H, W]}` with the [`crate::State`], a line feed, and then
//! as many bytes as the shapes say: the frame, then the labels. A request that cannot be fulfilled is answered with
//! `{"error": "..."}`, changes nothing and ends nothing. The end of the input ends the service.

use std::{
    error::Error as _,
    io::{self, BufRead, Write},
};

use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::{Environment, Error, Goal, HandMove, ObjectState, Observation};

/// Raised when a program that knows the one before would not understand.
pub const PROTOCOL: u32 = 1;

#[derive(Debug, Deserialize)]
#[serde(tag = "op", rename_all = "snake_case", deny_unknown_fields)]
enum Request {
    Reset { seed: u64 },
    Step { action: Vec<f32> },
    SetGoal(Goal),
    ScriptedAction,
    Futures { candidates: Vec<Vec<Vec<f32>>> },
    HandMoves { candidates: Vec<Vec<[f64; 2]>> },
}

enum Answer {
    Seen(Box<Observation>),
    Action(Vec<f32>),
    Futures(Vec<Vec<Vec<ObjectState>>>),
    Moves(Vec<Vec<HandMove>>),
}

/// Answers requests until the input ends.
///
/// # Errors
/// Those of the two streams.
pub fn serve(
    scene: &mut dyn Environment,
    input: impl BufRead,
    mut output: impl Write,
) -> io::Result<()> {
    let size = scene.spec().size;
    line(&mut output, &json!({ "protocol": PROTOCOL, "spec": scene.spec() }))?;
    for request in input.lines() {
        let answer = serde_json::from_str(&request?)
            .map_err(|error| format!("this is no request: {error}"))
            .and_then(|request| answer(scene, request).map_err(|error| chain(&error)));
        match answer {
            Ok(Answer::Seen(seen)) => {
                let Observation { rgb, mask, state } = *seen;
                let (frame, labels) = ([size, size, 3], [size, size]);
                let seen = json!({ "state": state, "rgb": frame, "mask": labels });
                line_and(&mut output, &seen, &[&rgb, &mask])?;
            }
            Ok(Answer::Action(action)) => line(&mut output, &json!({ "action": action }))?,
            Ok(Answer::Futures(futures)) => line(&mut output, &json!({ "futures": futures }))?,
            Ok(Answer::Moves(moves)) => line(&mut output, &json!({ "moves": moves }))?,
            Err(error) => line(&mut output, &json!({ "error": error }))?,
        }
    }
    Ok(())
}

fn answer(scene: &mut dyn Environment, request: Request) -> Result<Answer, Error> {
    match request {
        Request::Reset { seed } => scene.reset(seed).map(seen),
        Request::Step { action } => scene.step(&action).map(seen),
        Request::SetGoal(goal) => scene.set_goal(&goal).map(seen),
        Request::ScriptedAction => scene.scripted_action().map(Answer::Action),
        Request::Futures { candidates } => scene.futures(&candidates).map(Answer::Futures),
        Request::HandMoves { candidates } => scene.hand_moves(&candidates).map(Answer::Moves),
    }
}

fn seen(observation: Observation) -> Answer {
    Answer::Seen(Box::new(observation))
}

fn line(output: &mut impl Write, value: &impl Serialize) -> io::Result<()> {
    line_and(output, value, &[])
}

fn line_and(output: &mut impl Write, value: &impl Serialize, pictures: &[&[u8]]) -> io::Result<()> {
    serde_json::to_writer(&mut *output, value)?;
    output.write_all(b"\n")?;
    for picture in pictures {
        output.write_all(picture)?;
    }
    output.flush()
}

/// An error with its causes.
fn chain(error: &Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        text += &format!(": {cause}");
        source = cause.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;
    use crate::Scene;

    #[test]
    fn every_line_has_its_answer() {
        let mut scene = Scene::Balls3.open(16).unwrap();
        let requests = [
            r#"{"op": "scripted_action"}"#,
            r#"{"op": "reset", "seed": 18446744073709551615}"#,
            r#"{"op": "scripted_action"}"#,
            "{",
            r#"{"op": "fly"}"#,
            r#"{"op": "step", "action": []}"#,
        ];
        let mut output = Vec::new();
        serve(scene.as_mut(), requests.join("\n").as_bytes(), &mut output).unwrap();

        let mut rest = output.as_slice();
        let mut next = || -> Value {
            let mut line = Vec::new();
            rest.read_until(b'\n', &mut line).unwrap();
            let answer: Value = serde_json::from_slice(&line).unwrap();
            if answer.get("rgb").is_some() {
                rest = &rest[16 * 16 * 3 + 16 * 16..];
            }
            answer
        };
        let hello = next();
        assert_eq!((&hello["protocol"], &hello["spec"]["scene"]), (&1.into(), &"balls3".into()));
        assert_eq!(next()["error"], "the scene was not reset yet");
        assert_eq!(next()["state"]["step"], 0);
        assert_eq!(next()["action"], json!([]));
        for _ in 0..2 {
            let error = next()["error"].to_string();
            assert!(error.starts_with("\"this is no request: "), "{error}");
        }
        assert_eq!(next()["state"]["step"], 1);
        assert!(rest.is_empty());
    }
}
