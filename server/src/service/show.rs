//! Showing: what a session's newest step looks like, to whoever asks once or watches.
//!
//! While somebody watches, the steps of a session compute on their way what is shown ([`Service::besides`]). For who
//! asks when nobody watched, the newest step is made once more from where it began, as bulk work: it keeps no
//! observation waiting, and being a pure function it is the same step.

use std::{
    sync::{Arc, Weak},
    time::{Duration, Instant, SystemTime},
};

use gatsbi_models::{
    scene::{Output, Outputs},
    world_model::ModelSpec,
};

use gatsbi_proto::v1;

use super::{Service, answer};
use crate::{
    engine::{
        Reading,
        commands::{Form, Observe, Observed, Urgency, Value, Wanted},
    },
    error::Error,
    sessions::{
        live::{Last, Shown, Watcher},
        session::{Seen, Session},
    },
};

/// A session that is watched; dropped, it costs nothing any more.
#[derive(Debug)]
pub struct Watching {
    service: Arc<Service>,
    session: Weak<Session>,
    watcher: Watcher,
    begun: bool,
}

/// What the whole server does at one moment.
#[derive(Debug)]
pub struct Overview {
    /// What the engine has done, and what waits.
    pub engine: Reading,
    /// Models that are served.
    pub models: usize,
    /// Open sessions, those that are not told about too.
    pub open: usize,
    /// The sessions that were used last.
    pub sessions: Vec<Told>,
}

/// What an overview tells about a session.
#[derive(Debug)]
pub struct Told {
    /// The session.
    pub session: Arc<Session>,
    /// Its model.
    pub model: String,
    /// Observations absorbed.
    pub next_step: u64,
    /// How long ago it was used.
    pub idle: Duration,
}

impl Service {
    /// A session's newest step with all that is shown of it.
    ///
    /// # Errors
    /// If there is no such session, nothing to show, or the model fails.
    pub async fn shown(&self, session_id: &str) -> Result<Arc<Shown>, Error> {
        let session = self.session(session_id)?;
        self.show(&session).await
    }

    /// What a session saw last, for which nothing is computed.
    ///
    /// # Errors
    /// If there is no such session, or nothing to show.
    pub fn seen(&self, session_id: &str) -> Result<Arc<Last>, Error> {
        newest(&*self.session(session_id)?)
    }

    /// Watches a session.
    ///
    /// # Errors
    /// If there is no such session.
    pub fn watch(self: &Arc<Self>, session_id: &str) -> Result<Watching, Error> {
        let session = self.session(session_id)?;
        let (service, watcher) = (Arc::clone(self), session.live.watch());
        Ok(Watching { service, session: Arc::downgrade(&session), watcher, begun: false })
    }

    /// What the server does now, with up to `most` sessions.
    pub fn overview(&self, most: usize) -> Overview {
        let now = Instant::now();
        let mut sessions = self.registry.list(&self.owner, None, usize::MAX, now, |_| true);
        let open = sessions.len();
        sessions.sort_by_cached_key(|session| std::cmp::Reverse(session.used()));
        sessions.truncate(most);
        let told = sessions.into_iter().map(|session| {
            let position = session.position();
            let idle = now.saturating_duration_since(session.used());
            let (model, next_step) = (position.model.spec.name.clone(), position.next_step);
            Told { session, model, next_step, idle }
        });
        let models = self.catalogue.all().len();
        Overview { engine: self.engine.reading(), models, open, sessions: told.collect() }
    }

    /// What a step of a session computes besides for those who watch it.
    pub(super) fn besides(session: &Session, spec: &ModelSpec) -> Outputs {
        if session.live.is_watched() { outputs(spec) } else { Outputs::default() }
    }

    async fn show(&self, session: &Session) -> Result<Arc<Shown>, Error> {
        let last = newest(session)?;
        if let Some(shown) = session.live.newest().filter(|shown| shown.step == last.seen.step) {
            return Ok(shown);
        }
        let Last { before, seen } = &*last;
        let nothing = Outputs::default();
        let observed = self.engine.observe(Observe {
            model: Arc::clone(&before.model),
            state: Arc::clone(&before.state),
            frame: seen.frame.clone(),
            action: seen.action.clone(),
            noise: before.draws.noise(seen.step),
            lane: before.draws.seed,
            wanted: Wanted {
                outputs: nothing,
                form: Form::F32,
                spread: outputs(&before.model.spec),
            },
            deadline: None,
            urgency: Urgency::Bulk,
        });
        let Observed { besides, spent, .. } = observed.await?;
        let timing = answer::timing(spent, Duration::ZERO);
        Ok(Arc::new(shown(&before.model.spec, seen.clone(), besides, timing)))
    }
}

impl Watching {
    /// The next step, or the newest one if there were more meanwhile, and first the one that is there already.
    /// Nothing once the session is closed or the server goes down.
    pub async fn next(&mut self) -> Option<Arc<Shown>> {
        if !std::mem::replace(&mut self.begun, true) {
            let session = self.session.upgrade()?;
            if let Ok(shown) = self.service.show(&session).await {
                return Some(shown);
            }
        }
        let stop = self.service.stop();
        tokio::select! {
            shown = self.watcher.next() => shown,
            () = stop.cancelled() => None,
        }
    }

    /// Whether it ends because the server goes down: the session may be there again when the server is.
    pub fn is_stopped(&self) -> bool {
        self.service.stop().is_cancelled()
    }
}

/// A step as it is shown.
pub(super) fn shown(spec: &ModelSpec, seen: Seen, values: Vec<Value>, timing: v1::Timing) -> Shown {
    Shown {
        step: seen.step,
        model_hash: spec.hash.clone(),
        image_size: spec.image_size as u32,
        image_skipped: false,
        objects: answer::objects(&values, seen.image, spec.preprocess),
        values,
        timing,
        at: SystemTime::now(),
        seen,
    }
}

/// All that is shown of a model's steps.
fn outputs(spec: &ModelSpec) -> Outputs {
    let all = [
        Some(Output::Frame),
        spec.agent_slot.map(|_| Output::AgentMask),
        Some(Output::ObjectMasks),
        Some(Output::Objects),
        Some(Output::Surprise),
        spec.keypoints.map(|_| Output::Keypoints),
    ];
    all.into_iter().flatten().collect()
}

fn newest(session: &Session) -> Result<Arc<Last>, Error> {
    session.last().ok_or_else(|| match session.position().next_step.checked_sub(1) {
        Some(last) => Error::NothingToShow { last },
        None => Error::NothingObserved,
    })
}
