//! `gatsbi demo`: what the whole service is for, on one recorded episode.
//!
//! It observes the first frames, imagines the rest under the recorded actions and under others, and compares with what
//! was recorded. [`measure`] has the numbers, [`pictures`] the pictures; a model that is untrained shows as much in both.

mod measure;
mod pictures;

use std::{
    fmt::Write as _,
    path::PathBuf,
    time::{Duration, Instant},
};

use anyhow::Context as _;
use clap::Args;
use gatsbi_client::{
    Actions, Belief, Client, Encoding, Imagination, Mode, Model, NewSession, Output, Rollout,
    Selection, Session,
};
use serde_json::json;

use crate::{
    Shared,
    failure::misuse,
    models::{short, trained},
    print::{bar, print, print_json, table},
    recording::Recording,
};
use measure::{Errors, Found};

#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// Episode file
    #[arg(long, value_name = "FILE")]
    episodes: PathBuf,
    /// Episode in the file, from 0
    #[arg(long, value_name = "I", default_value_t = 0)]
    index: usize,
    /// Folder for the pictures
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Name of the model; may be left out where the server has one only
    #[arg(long)]
    model: Option<String>,
    /// Frames to observe before imagining the rest
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u16).range(1..))]
    observe: u16,
}

/// A future under candidate actions.
struct Candidate {
    /// What is done, in words.
    name: String,
    actions: Vec<Vec<f32>>,
}

/// What the server answered.
struct Story {
    model: Model,
    recording: Recording,
    /// One for each observed frame.
    beliefs: Vec<Belief>,
    candidates: Vec<Candidate>,
    rollout: Rollout,
    observing: Duration,
    imagining: Duration,
}

pub(crate) async fn run(shared: &Shared, arguments: Arguments) -> anyhow::Result<()> {
    let recording = Recording::open(&arguments.episodes, arguments.index)?;
    let observed = usize::from(arguments.observe);
    let candidates = candidates(&recording, observed)?;
    fs_err::create_dir_all(&arguments.out)?;

    let client = shared.client().await?;
    let model = model(&client, arguments.model.as_deref()).await?;
    fits(&model, &recording)?;
    let new = NewSession {
        model: model.name.clone(),
        label: "gatsbi demo".to_owned(),
        mode: Mode::Mean,
        ..NewSession::default()
    };
    let session = client.create_session(new).await?;
    let story = experience(shared, &session, model, recording, candidates, observed).await;
    // The session goes, whatever came of it.
    let closed = session.delete().await;
    let story = story?;
    closed?;

    let found = Found::of(&story);
    let errors = Errors::of(&story)?;
    let files = pictures::write(&story, &errors, &arguments.out)?;
    if shared.json {
        let files: Vec<_> = files.iter().map(|file| file.display().to_string()).collect();
        return print_json(&json!({
            "model": story.model.name,
            "model_hash": story.model.hash,
            "trained_steps": story.model.trained_steps,
            "episode_id": story.recording.episode.id(),
            "observed": observed,
            "found": found.record(),
            "imagined": errors.record(),
            "pictures": files,
        }));
    }
    let mut text = described(&story);
    text.push_str(&found.described());
    text.push_str(&errors.described());
    writeln!(text, "\npictures, in the order to look at them:")?;
    for file in files {
        writeln!(text, "  {}", file.display())?;
    }
    print(&text)
}

async fn experience(
    shared: &Shared,
    session: &Session,
    model: Model,
    recording: Recording,
    candidates: Vec<Candidate>,
    observed: usize,
) -> anyhow::Result<Story> {
    let agent = model.agent_slot.map(|_| Output::AgentMask);
    let wanted = [Output::Frame, Output::ObjectMasks, Output::Objects];
    let seen = [Output::SlotMasks, Output::Background];
    let bytes = |outputs: Vec<Output>| Selection::of(outputs).encoding(Encoding::U8);

    let began = Instant::now();
    let outputs = bytes(wanted.into_iter().chain(seen).chain(agent).collect());
    let mut stream = session.observe_stream(&outputs);
    let bar = bar(observed, "frames", shared.json);
    let mut beliefs = Vec::new();
    for t in 0..observed {
        beliefs.push(stream.observe(recording.observation(t, t as u64)?).await?);
        bar.inc(1);
    }
    bar.finish_and_clear();
    let observing = began.elapsed();

    let began = Instant::now();
    let actions: Vec<_> = candidates.iter().map(|candidate| candidate.actions.clone()).collect();
    let outputs = bytes(wanted.into_iter().chain(agent).collect());
    let imagination = Imagination {
        at_step: Some(observed as u64 - 1),
        ..Imagination::of(Actions::nested(&actions)?, outputs)
    };
    let rollout = session.imagine(imagination).await?.gather().await?;
    let imagining = began.elapsed();
    Ok(Story { model, recording, beliefs, candidates, rollout, observing, imagining })
}

/// The recorded actions, and two others to compare with.
fn candidates(recording: &Recording, observed: usize) -> anyhow::Result<Vec<Candidate>> {
    let recorded = recording.actions(observed - 1, None)?;
    let horizon = recorded.len();
    let still = recorded.iter().map(|action| vec![0.0; action.len()]).collect();
    let other = Recording::open(&recording.path, (recording.index + 1) % recording.of)?;
    let other = if other.index != recording.index && other.episode.length() >= observed + horizon {
        let name = format!("the actions of episode {} instead", other.episode.id());
        Candidate { name, actions: other.actions(observed - 1, Some(horizon))? }
    } else {
        let negated = |action: &Vec<f32>| action.iter().map(|value| -value).collect();
        let actions = recorded.iter().map(negated).collect();
        Candidate { name: "the recorded actions with the sign changed".to_owned(), actions }
    };
    Ok(vec![
        Candidate { name: "the recorded actions".to_owned(), actions: recorded },
        Candidate {
            name: "zero actions: the robot is told to stand still".to_owned(),
            actions: still,
        },
        other,
    ])
}

async fn model(client: &Client, name: Option<&str>) -> anyhow::Result<Model> {
    if let Some(name) = name {
        return Ok(client.model(name).await?);
    }
    let mut models = client.models().await?;
    if models.len() > 1 {
        let names: Vec<_> = models.iter().map(|model| model.name.as_str()).collect();
        misuse!("--model is missing: the server has {}", names.join(", "));
    }
    models.pop().context("the server has no model")
}

/// Pixels are compared one by one and actions sent as they are, so both must be the model's own.
fn fits(model: &Model, recording: &Recording) -> anyhow::Result<()> {
    let (info, size) = (&recording.info, model.image_size);
    if (info.width, info.height) != (size, size) {
        misuse!(
            "--episodes has frames of {}x{}, expected {size}x{size}, the size of {}",
            info.width,
            info.height,
            model.name
        );
    }
    if info.action_dimension() != model.actions.len() {
        misuse!(
            "--episodes has actions of {} numbers, expected {}, as {} takes them",
            info.action_dimension(),
            model.actions.len(),
            model.name
        );
    }
    Ok(())
}

fn described(story: &Story) -> String {
    let Story { model, recording, beliefs, rollout, .. } = story;
    let compute: u64 = beliefs.iter().map(|b| u64::from(b.timing.compute_micros)).sum();
    let row_steps = rollout.candidates * rollout.depths.len();
    let seconds = story.imagining.as_secs_f64();
    let rows = [
        [
            "model".into(),
            format!(
                "{} ({}) on {}, checkpoint {}",
                model.name,
                trained(model),
                model.device,
                short(&model.hash)
            ),
        ],
        [
            "episode".into(),
            format!(
                "{} of {}: {} frames, one every {} s",
                recording.episode.id(),
                recording.info.name,
                recording.episode.length(),
                recording.info.frame_period_seconds
            ),
        ],
        [
            "observed".into(),
            format!(
                "{} frames in {:.2} s; the model took {:.0} ms for each",
                beliefs.len(),
                story.observing.as_secs_f64(),
                compute as f64 / 1e3 / beliefs.len() as f64
            ),
        ],
        [
            "imagined".into(),
            format!(
                "{} candidates x {} steps in {seconds:.2} s ({:.0} steps a second)",
                rollout.candidates,
                rollout.depths.len(),
                row_steps as f64 / seconds
            ),
        ],
    ];
    let mut text = table(&["<", "<"], rows.map(Vec::from));
    // The line of titles is empty.
    text.remove(0);
    text
}
