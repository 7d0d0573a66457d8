//! `gatsbi observe`: recorded frames over the stream of the control loop, or one image.

use std::{
    path::{Path, PathBuf},
    time::{SystemTime, UNIX_EPOCH},
};

use anyhow::Context as _;
use clap::Args;
use gatsbi_client::{
    Belief, Encoding, Image, Observation, Output, Selection, Session, SessionInfo,
};
use gatsbi_episodes::exchange::McapWriter;
use gatsbi_pictures::enlarge;
use image::RgbImage;
use serde_json::json;

use crate::{
    Shared,
    failure::{Misuse, misuse},
    models::short,
    picture::{
        ENLARGED, image,
        scene::{cut_out, scene},
        sheet::{Row, Sheet, Tile},
    },
    print::{self, bar, print, print_json, table},
    recording::{Frames, Recording},
};

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
    /// Frames A up to B, without B; by default from the session's next step to the end
    #[arg(long, value_name = "A..B", requires = "episode")]
    frames: Option<Frames>,
    /// The action that led to the image, in the model's raw units; left out in a session's first step
    #[arg(
        long,
        value_name = "a,b,...",
        value_delimiter = ',',
        allow_hyphen_values = true,
        conflicts_with = "episode"
    )]
    action: Vec<f32>,
    /// Number of the step; the session's next one by default
    #[arg(long, conflicts_with = "episode")]
    step: Option<u64>,
    /// Folder for a picture of each step: what the camera saw, the agent, the objects
    #[arg(long, value_name = "DIR")]
    png: Option<PathBuf>,
    /// MCAP file for the frames that are sent and the actions that led to them, with the times of sending
    #[arg(long, value_name = "FILE", conflicts_with_all = ["image", "dropped"])]
    record: Option<PathBuf>,
}

#[derive(Debug, Args)]
#[group(required = true, multiple = false)]
struct Source {
    /// Episode file: its frames, with the actions that led to them
    #[arg(long, value_name = "FILE")]
    episode: Option<PathBuf>,
    /// Image file (PNG, JPEG, WebP)
    #[arg(long, value_name = "FILE")]
    image: Option<PathBuf>,
    /// No image: the camera dropped a frame, and the belief advances by the model's prediction
    #[arg(long)]
    dropped: bool,
}

pub(crate) async fn run(shared: &Shared, arguments: Arguments) -> anyhow::Result<()> {
    // Files first: a wrong one is found without a server.
    let recording = match &arguments.source.episode {
        Some(path) => Some(Recording::open(path, arguments.index)?),
        None => None,
    };
    let image = match &arguments.source.image {
        Some(path) => {
            let bytes = fs_err::read(path).map_err(|error| Misuse(format!("--image: {error}")))?;
            Some(Image::file(bytes))
        }
        None => None,
    };
    let client = shared.client().await?;
    let session = client.session(&arguments.session).await?;
    let selection = match &arguments.png {
        None => Selection::of([Output::Objects]),
        Some(folder) => {
            fs_err::create_dir_all(folder)?;
            let model = client.model(&session.info().model).await?;
            let agent = model.agent_slot.map(|_| Output::AgentMask);
            let outputs = [Output::Objects, Output::ObjectMasks, Output::Frame];
            Selection::of(outputs.into_iter().chain(agent)).encoding(Encoding::U8)
        }
    };
    let mut shown = Shown { shared, png: arguments.png.as_deref(), beliefs: Vec::new() };
    let done = if let Some(recording) = recording {
        let mut log = match &arguments.record {
            Some(path) => Some(Log::create(path, &recording)?),
            None => None,
        };
        let frames = arguments.frames;
        let done =
            episode(&session, &selection, &recording, frames, log.as_mut(), &mut shown).await;
        // What was sent before a failure is recorded as well.
        log.map_or(Ok(()), Log::finish).and(done)
    } else {
        let step = arguments.step.unwrap_or(session.info().next_step);
        let observation = Observation { step, image, action: arguments.action };
        async { shown.add(session.observe(observation, &selection).await?, None) }.await
    };
    // What was observed before a failure is shown as well.
    shown.finish(session.info())?;
    done
}

async fn episode(
    session: &Session,
    selection: &Selection,
    recording: &Recording,
    frames: Option<Frames>,
    mut log: Option<&mut Log>,
    shown: &mut Shown<'_>,
) -> anyhow::Result<()> {
    let next = session.info().next_step;
    let default = usize::try_from(next).unwrap_or(usize::MAX);
    let Frames { start, end } = frames.unwrap_or(Frames { start: None, end: None });
    let (start, end) = (start.unwrap_or(default), end.unwrap_or(recording.episode.length()));
    if frames.is_none() && start >= end {
        misuse!("the session has observed {next} steps, and {}", recording.described());
    }
    let frames = recording.frames(start..end)?;
    if frames.start == 0 && next > 0 {
        misuse!(
            "--frames begins with 0, expected 1 or more: the session has observed {next} steps, and no action led to \
             frame 0"
        );
    }
    let size = (recording.info.width, recording.info.height);
    let mut stream = session.observe_stream(selection);
    let bar = bar(frames.len(), "frames", shown.shared.json);
    for (frame, step) in frames.zip(next..) {
        if let Some(log) = &mut log {
            log.add(recording, frame)?;
        }
        let belief = stream.observe(recording.observation(frame, step)?).await?;
        let pixels = recording.episode.frame(frame).to_vec();
        shown.add(belief, RgbImage::from_raw(size.0, size.1, pixels))?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    Ok(())
}

/// A recording of what is sent.
struct Log {
    writer: McapWriter,
    /// Nanoseconds.
    last: u64,
}

impl Log {
    fn create(path: &Path, recording: &Recording) -> anyhow::Result<Self> {
        let writer = McapWriter::create(path, &recording.info, None)?;
        Ok(Self { writer, last: 0 })
    }

    /// The action lies a nanosecond before its frame: it is what held since the frame before.
    fn add(&mut self, recording: &Recording, frame: usize) -> anyhow::Result<()> {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let now = u64::try_from(now.as_nanos()).unwrap_or(u64::MAX).max(self.last + 2);
        if let Some(before) = frame.checked_sub(1) {
            self.writer.action(now - 1, recording.episode.action(before))?;
        }
        let info = &recording.info;
        self.writer.rgb(now, info.width, info.height, recording.episode.frame(frame))?;
        self.last = now;
        Ok(())
    }

    fn finish(self) -> anyhow::Result<()> {
        Ok(self.writer.finish()?)
    }
}

/// Beliefs on their way to the terminal, and their pictures.
struct Shown<'a> {
    shared: &'a Shared,
    png: Option<&'a Path>,
    beliefs: Vec<Belief>,
}

impl Shown<'_> {
    /// Machines get each belief as it comes.
    fn add(&mut self, mut belief: Belief, sent: Option<RgbImage>) -> anyhow::Result<()> {
        if let Some(folder) = self.png {
            picture(&belief, sent, folder)?;
        }
        belief.outputs = gatsbi_client::Outputs::default();
        if self.shared.json {
            print_json(&record(&belief)?)?;
        }
        self.beliefs.push(belief);
        Ok(())
    }

    /// People get a table of all, and the objects of the last.
    fn finish(&self, session: &SessionInfo) -> anyhow::Result<()> {
        let Some(last) = self.beliefs.last().filter(|_| !self.shared.json) else { return Ok(()) };
        let titles = ["step", "objects", "<ids", "queue ms", "compute ms", "encode ms", "<"];
        let rows = self.beliefs.iter().map(|belief| {
            let ids: Vec<String> = belief.present().map(|object| object.id.to_string()).collect();
            let mut row = vec![belief.step.to_string(), ids.len().to_string(), ids.join(" ")];
            row.extend(print::timing(&belief.timing));
            let mut notes = Vec::new();
            notes.extend(belief.predicted.then_some("predicted without an image"));
            notes.extend(belief.repeated.then_some("stored answer"));
            row.push(notes.join(", "));
            row
        });
        let mut text = format!(
            "session {} on {}, checkpoint {}\n",
            session.id,
            session.model,
            short(&last.model_hash)
        );
        text.push_str(&table(&titles, rows));
        if last.present().next().is_some() {
            text += &format!("\nobjects after step {}\n", last.step);
            text += &print::objects(last.present());
        }
        if let Some(folder) = self.png {
            text += &format!("\npictures in {}\n", folder.display());
        }
        print(&text)
    }
}

/// A belief with the names of the wire, without masks and images.
fn record(belief: &Belief) -> anyhow::Result<serde_json::Value> {
    let objects: Vec<_> = belief.objects.iter().map(print::json).collect::<Result<_, _>>()?;
    Ok(json!({
        "session_id": belief.session_id,
        "step": belief.step,
        "model_hash": belief.model_hash,
        "predicted": belief.predicted,
        "repeated": belief.repeated,
        "objects": objects,
        "timing": print::json(&belief.timing)?,
    }))
}

/// Writes `step-NNNN.png`. Masks lie over what was sent, if it has the model's size, else over the model's own image.
fn picture(belief: &Belief, sent: Option<RgbImage>, folder: &Path) -> anyhow::Result<()> {
    let outputs = &belief.outputs;
    let frame = outputs.array(Output::Frame).and_then(image).context("no frame came")?;
    let masks = outputs.array(Output::ObjectMasks).context("no object masks came")?;
    let camera = sent.filter(|sent| sent.dimensions() == frame.dimensions());
    let mut tiles = Vec::new();
    if let Some(camera) = &camera {
        tiles.push(Tile::new(enlarge(camera, ENLARGED), &["camera"]));
    }
    tiles.push(Tile::new(enlarge(&frame, ENLARGED), &["rebuilt by the model"]));
    let ground = camera.unwrap_or(frame);
    let scene = scene(ground, outputs.array(Output::AgentMask), masks, &belief.objects);
    if let Some(agent) = &scene.agent {
        tiles.push(Tile::new(enlarge(&cut_out(&scene.picture, agent), ENLARGED), &["agent"]));
    }
    tiles.push(Tile::new(enlarge(&scene.objects_alone(), ENLARGED), &["objects"]));
    tiles.push(Tile::new(scene.overlay(ENLARGED), &["overlay: boxes with ids"]));
    let title = format!("step {}", belief.step);
    let sheet = Sheet { title, rows: vec![Row { heading: String::new(), tiles }] };
    sheet.save(&folder.join(format!("step-{:04}.png", belief.step)))
}
