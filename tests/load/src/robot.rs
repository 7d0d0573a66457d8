//! A robot of the service: a session that observes made-up frames and imagines made-up actions.

use std::time::Duration;

use anyhow::{Context as _, Result};
use gatsbi_client::{
    Actions, Client, Code, Error, Image, Imagination, NewSession, Observation, ObserveStream,
    Options, Output, Retries, Selection, Session,
};
use tokio::time::Instant;

use crate::open::Dealt;

/// Frames that a robot sees, again and again.
const FRAMES: u64 = 16;

/// A connection, and what its model takes.
#[derive(Clone, Debug)]
pub(crate) struct Service {
    client: Client,
    side: u32,
    actions: usize,
}

/// A session that observes.
#[derive(Debug)]
pub(crate) struct Robot {
    session: Session,
    stream: Option<ObserveStream>,
    frames: Vec<Image>,
    action: Vec<f32>,
    step: u64,
}

/// Candidates and steps of the futures that are imagined after each observation.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Futures {
    pub(crate) candidates: usize,
    pub(crate) horizon: usize,
}

impl Service {
    /// Connects. Nothing is repeated: what is refused is told.
    pub(crate) async fn connect(url: &str) -> Result<Self> {
        let retries = Retries { most: 0, ..Retries::default() };
        let options = Options { retries, timeout: Duration::from_mins(1), ..Options::default() };
        let client = Client::connect_with(url, options).await?;
        let model = client.models().await?.into_iter().next().context("no model is served")?;
        Ok(Self { client, side: model.image_size, actions: model.actions.len() })
    }

    /// A robot; with `stream` it observes over one stream.
    pub(crate) async fn robot(&self, number: u64, stream: bool) -> Result<Robot> {
        let label = format!("load {number}");
        let session =
            self.client.create_session(NewSession { label, ..Default::default() }).await?;
        let frames = (0..FRAMES).map(|frame| {
            Ok(Image::rgb(self.side, self.side, picture(self.side, number * FRAMES + frame))?)
        });
        Ok(Robot {
            stream: stream.then(|| session.observe_stream(&objects())),
            session,
            frames: frames.collect::<Result<_>>()?,
            action: vec![0.1; self.actions],
            step: 0,
        })
    }
}

impl Robot {
    /// Has the next frame observed.
    pub(crate) async fn observe(&mut self) -> Result<(), Error> {
        let image = self.frames[(self.step % FRAMES) as usize].clone();
        let action = self.action.clone();
        let observation = Observation { step: self.step, image: Some(image), action };
        match &mut self.stream {
            Some(stream) => stream.observe(observation).await?,
            None => self.session.observe(observation, &objects()).await?,
        };
        self.step += 1;
        Ok(())
    }

    /// Has futures imagined, and waits for the last of them.
    pub(crate) async fn imagine(
        &self,
        Futures { candidates, horizon }: Futures,
    ) -> Result<(), Error> {
        let shape = [candidates, horizon, self.action.len()];
        let values = (0..shape.iter().product()).map(|i: usize| (i as f32 * 0.37).sin()).collect();
        let imagination = Imagination::of(Actions::new(shape, values)?, objects());
        let mut chunks = self.session.imagine(imagination).await?;
        while let Some(chunk) = chunks.next().await {
            chunk?;
        }
        Ok(())
    }

    /// Deals with a frame: observes it, then imagines.
    pub(crate) async fn deal(&mut self, futures: Option<Futures>) -> Result<Dealt> {
        let all = async {
            self.observe().await?;
            let observed = Instant::now();
            if let Some(futures) = futures {
                self.imagine(futures).await?;
            }
            Ok(Dealt::Done { observed, done: Instant::now() })
        };
        match all.await {
            Err(Error::Refused(problem)) if problem.code == Code::ResourceExhausted => {
                Ok(Dealt::Refused)
            }
            dealt => Ok(dealt?),
        }
    }

    /// Closes the session.
    pub(crate) async fn leave(self) -> Result<()> {
        Ok(self.session.delete().await?)
    }
}

fn objects() -> Selection {
    Selection::of([Output::Objects])
}

/// A made-up picture, `[side, side, 3]`.
pub(crate) fn picture(side: u32, seed: u64) -> Vec<u8> {
    let wave = |i: u32| ((f64::from(i) * 0.013 + seed as f64).sin() * 0.5 + 0.5) * 255.0;
    (0..side * side * 3).map(|i| wave(i) as u8).collect()
}
