//! `gatsbi imagine`: what will happen under candidate actions.

use std::{path::PathBuf, time::Instant};

use clap::Args;
use gatsbi_client::{
    Actions, Client, Imagination, Object, Output, Rollout, Sampling, Selection, Session,
};
use serde_json::json;

use crate::{
    Shared, candidates,
    failure::misuse,
    print::{bar, print, print_json, table},
    recording::Recording,
};

/// Futures that are shown to people; machines get all.
const SHOWN: usize = 16;

#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// The session
    #[arg(long, value_name = "ID")]
    session: String,
    #[command(flatten)]
    source: Source,
    /// Episode in the file, from 0
    #[arg(long, value_name = "I", default_value_t = 0, requires = "episode")]
    index: usize,
    /// Frame of the episode whose action is the first; by default the one that the session observed last
    #[arg(long, value_name = "T", requires = "episode")]
    from: Option<usize>,
    /// Steps to imagine; by default the rest of the episode
    #[arg(long, value_name = "H", conflicts_with = "actions", required_unless_present_any = ["episode", "actions"])]
    horizon: Option<usize>,
    /// Futures of each candidate
    #[arg(long, value_name = "S", default_value_t = 1, conflicts_with = "mean")]
    samples: u32,
    /// Seed of the futures and of --random
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,
    /// Mean futures instead of drawn ones
    #[arg(long)]
    mean: bool,
    /// Fail if the session's last observed step is another one
    #[arg(long, value_name = "T")]
    at_step: Option<u64>,
    /// Depths K, 2K, 3K... only
    #[arg(long, value_name = "K", conflicts_with = "last_only")]
    every: Option<u32>,
    /// The last depth only
    #[arg(long)]
    last_only: bool,
}

#[derive(Debug, Args)]
#[group(required = true, multiple = false)]
struct Source {
    /// Episode file: the recorded actions are the candidate
    #[arg(long, value_name = "FILE")]
    episode: Option<PathBuf>,
    /// Candidates in a file: JSON, `[H][A]` or `[N][H][A]` numbers, or CSV, a step a line and an empty line between candidates
    #[arg(long, value_name = "FILE")]
    actions: Option<PathBuf>,
    /// So many candidates, drawn from the actions that the model was trained on
    #[arg(long, value_name = "N")]
    random: Option<usize>,
}

pub(crate) async fn run(shared: &Shared, arguments: Arguments) -> anyhow::Result<()> {
    // Files first: a wrong one is found without a server.
    let recording = match &arguments.source.episode {
        Some(path) => Some(Recording::open(path, arguments.index)?),
        None => None,
    };
    let read = arguments.source.actions.as_deref().map(candidates::read).transpose()?;
    let client = shared.client().await?;
    let session = client.session(&arguments.session).await?;
    let actions = match (&recording, read) {
        (Some(recording), _) => recorded(recording, &session, &arguments)?,
        (None, Some(actions)) => actions,
        (None, None) => drawn(&client, &session, &arguments).await?,
    };
    let mut outputs = Selection::of([Output::Objects]);
    if let Some(k) = arguments.every {
        outputs = outputs.every(k);
    }
    if arguments.last_only {
        outputs = outputs.last_only();
    }
    let Arguments { samples, seed, mean, at_step, .. } = arguments;
    let sampling = if mean {
        Sampling::Mean
    } else {
        Sampling::Sample { seed: Some(seed), samples, independent_candidates: false }
    };
    let rows = actions.candidates() * sampling.samples() as usize;
    let row_steps = rows * actions.horizon();
    let imagination = Imagination { sampling, at_step, ..Imagination::of(actions, outputs) };

    let began = Instant::now();
    let spinner = bar(0, "imagining", shared.json);
    let rollout = session.imagine(imagination).await?.gather().await?;
    spinner.finish_and_clear();
    if shared.json {
        return records(&session, &rollout);
    }
    let seconds = began.elapsed().as_secs_f64();
    print(&described(&rollout, rows, row_steps, seconds))
}

fn recorded(
    recording: &Recording,
    session: &Session,
    arguments: &Arguments,
) -> anyhow::Result<Actions> {
    let last = session.info().next_step.saturating_sub(1);
    let from = arguments.from.unwrap_or(usize::try_from(last).unwrap_or(usize::MAX));
    Ok(Actions::nested(&[recording.actions(from, arguments.horizon)?])?)
}

async fn drawn(
    client: &Client,
    session: &Session,
    arguments: &Arguments,
) -> anyhow::Result<Actions> {
    let (n, horizon) = (arguments.source.random.unwrap_or(0), arguments.horizon.unwrap_or(0));
    let model = client.model(&session.info().model).await?;
    let most = model.limits.unwrap_or_default();
    for (flag, found, most) in
        [("--random", n, most.max_candidates), ("--horizon", horizon, most.max_horizon)]
    {
        if !(1..=most as usize).contains(&found) {
            misuse!("{flag} is {found}, expected 1 to {most}");
        }
    }
    Ok(candidates::draw(&model.actions, n, horizon, arguments.seed)?)
}

/// Objects of each imagined step, a line each.
fn records(session: &Session, rollout: &Rollout) -> anyhow::Result<()> {
    for (sample, candidate) in futures(rollout) {
        for (at, depth) in rollout.depths.iter().enumerate() {
            let objects = objects(rollout, [sample, candidate, at]);
            let objects: Vec<_> = objects.iter().map(record).collect();
            print_json(&json!({
                "session_id": session.id(),
                "at_step": rollout.at_step,
                "model_hash": rollout.model_hash,
                "seed": rollout.seed,
                "sample": sample,
                "candidate": candidate,
                "depth": depth,
                "objects": objects,
            }))?;
        }
    }
    Ok(())
}

fn record(object: &Object) -> serde_json::Value {
    let Object { id, slot, presence, x, y, width, height, depth, .. } = object;
    json!({
        "id": id, "slot": slot, "presence": presence, "x": x, "y": y, "width": width,
        "height": height, "depth": depth,
    })
}

fn described(rollout: &Rollout, rows: usize, row_steps: usize, seconds: f64) -> String {
    let Rollout { candidates, samples, at_step, seed, .. } = rollout;
    let drawn = if *seed == 0 && *samples == 1 { String::new() } else { format!(", seed {seed}") };
    let mut text = format!(
        "from step {at_step}: {candidates} candidates x {samples} samples x {} steps{drawn}, in {seconds:.2} s ({:.0} \
         steps a second)\n",
        row_steps / rows.max(1),
        row_steps as f64 / seconds
    );
    let (Some(first), Some(last)) = (rollout.depths.first(), rollout.depths.last()) else {
        return text;
    };
    let from = format!("<x, y at depth {first}");
    let to = format!("<x, y at depth {last}");
    let titles = ["candidate", "sample", "object", &from, &to, "moved", "presence"];
    let mut lines = Vec::new();
    for (sample, candidate) in futures(rollout).take(SHOWN) {
        let before = objects(rollout, [sample, candidate, 0]);
        for object in objects(rollout, [sample, candidate, rollout.depths.len() - 1]) {
            let was = before.iter().find(|before| before.id == object.id);
            // What was not there at either end has nothing to tell.
            if object.presence.max(was.map_or(0.0, |was| was.presence)) <= 0.5 {
                continue;
            }
            let moved = was.map(|was| (object.x - was.x).hypot(object.y - was.y));
            lines.push(vec![
                candidate.to_string(),
                sample.to_string(),
                object.id.to_string(),
                was.map_or_else(|| "-".into(), place),
                place(&object),
                moved.map_or_else(|| "-".into(), |moved| format!("{moved:.2}")),
                format!("{:.2}", object.presence),
            ]);
        }
    }
    if lines.is_empty() {
        text.push_str("no objects\n");
    } else {
        text.push_str(&table(&titles, lines));
    }
    if rows > SHOWN {
        text += &format!("... and {} more futures; --json gives all\n", rows - SHOWN);
    }
    text
}

fn place(object: &Object) -> String {
    format!("{:.2}, {:.2}", object.x, object.y)
}

/// Samples and candidates, those of a candidate together.
fn futures(rollout: &Rollout) -> impl Iterator<Item = (usize, usize)> + use<> {
    let samples = rollout.samples;
    (0..rollout.candidates).flat_map(move |candidate| (0..samples).map(move |s| (s, candidate)))
}

fn objects(rollout: &Rollout, index: [usize; 3]) -> Vec<Object> {
    rollout.outputs.tracks().map(|tracks| tracks.objects(&index)).unwrap_or_default()
}
