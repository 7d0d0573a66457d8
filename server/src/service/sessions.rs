//! Sessions: opened, told about, forked, rewound and closed.

use std::{
    sync::{Arc, atomic::Ordering},
    time::{Duration, Instant, SystemTime},
};

use gatsbi_proto::v1;

use super::{Service, fields};
use crate::{
    bounds::{FORKS, LABEL, PAGE_SIZE},
    error::Error,
    sessions::{
        registry::kept_bytes,
        session::{Draws, History, Position, Session, SessionId, Terms},
    },
};

/// More lanes than blocks have.
const LANES: u64 = 1 << 12;

impl Service {
    /// Opens a session.
    ///
    /// # Errors
    /// If the request is wrong, or there are too many.
    pub fn create_session(
        &self,
        request: v1::CreateSessionRequest,
    ) -> Result<v1::CreateSessionResponse, Error> {
        let model = self.catalogue.get(&request.model)?;
        let position = Position {
            draws: Draws {
                sample: fields::samples(request.mode, "mode")?,
                seed: request.seed.unwrap_or_else(|| self.next_seed()),
            },
            next_step: 0,
            state: Arc::clone(&model.initial),
            image: (0, 0),
            model,
        };
        let terms = Terms {
            owner: self.owner.clone(),
            label: request.label,
            ttl: self.ttl(request.ttl)?,
            keep_steps: request.keep_steps,
            keep_frames: request.keep_frames,
            latest_wins: request.latest_wins,
        };
        let session = self.open(&terms, position)?;
        Ok(v1::CreateSessionResponse { session: Some(session) })
    }

    /// A seed for a session that brings none. A row's lane in its block follows from the seed, so the last bits count:
    /// sessions that were opened one after the other fill a block.
    fn next_seed(&self) -> u64 {
        let lane = self.seeds.fetch_add(1, Ordering::Relaxed) % LANES;
        fields::random_seed() / LANES * LANES + lane
    }

    /// Tells about a session.
    ///
    /// # Errors
    /// If there is none.
    pub fn get_session(
        &self,
        request: &v1::GetSessionRequest,
    ) -> Result<v1::GetSessionResponse, Error> {
        let session = self.session(&request.session_id)?;
        Ok(v1::GetSessionResponse { session: Some(tell(&session)) })
    }

    /// Tells about sessions, page by page.
    ///
    /// # Errors
    /// If the page is not one.
    pub fn list_sessions(
        &self,
        request: &v1::ListSessionsRequest,
    ) -> Result<v1::ListSessionsResponse, Error> {
        let size = PAGE_SIZE.check(request.page_size.unwrap_or(100), "page_size")?;
        let token = request.page_token.as_str();
        let after = if token.is_empty() { None } else { Some(token.parse::<SessionId>()) };
        let Ok(after) = after.transpose() else {
            let expected = "next_page_token of a previous page";
            return Err(Error::invalid("page_token", format!("{token:.64?}"), expected));
        };
        let matches =
            |session: &Session| request.label.is_empty() || session.terms.label == request.label;
        // One more than asked for tells whether there is another page.
        let mut page =
            self.registry.list(&self.owner, after, size as usize + 1, Instant::now(), matches);
        let more = page.len() > size as usize;
        page.truncate(size as usize);
        let last = page.last().filter(|_| more).map(|session| session.id.to_string());
        Ok(v1::ListSessionsResponse {
            sessions: page.iter().map(|session| tell(session)).collect(),
            next_page_token: last.unwrap_or_default(),
        })
    }

    /// Closes a session.
    ///
    /// # Errors
    /// If there is none.
    pub fn delete_session(
        &self,
        request: &v1::DeleteSessionRequest,
    ) -> Result<v1::DeleteSessionResponse, Error> {
        self.registry.delete(&request.session_id, &self.owner, Instant::now())?;
        tracing::info!(session = request.session_id, "session closed");
        Ok(v1::DeleteSessionResponse {})
    }

    /// Opens sessions that share another one's belief and what it keeps of its past.
    ///
    /// # Errors
    /// If there is no such session, it has moved, or there are too many.
    pub fn fork_session(
        &self,
        request: v1::ForkSessionRequest,
    ) -> Result<v1::ForkSessionResponse, Error> {
        let session = self.session(&request.session_id)?;
        let (mut position, mut history) = session.past();
        if request.at_step.is_some() {
            position.last(request.at_step)?;
        }
        let count = FORKS.check(request.count.unwrap_or(1), "count")?;
        if let Some(seed) = request.seed {
            position.draws.seed = seed;
            history = history.drawing(position.draws);
        }
        let label = request.label.unwrap_or_else(|| session.terms.label.clone());
        let terms = Terms { label, ..session.terms.clone() };
        self.check(&terms, &position)?;
        let beginnings = vec![(position, history); count as usize];
        let forks = self.registry.open(&terms, beginnings, Instant::now())?;
        tracing::info!(session = %session.id, count, "session forked");
        Ok(v1::ForkSessionResponse { sessions: forks.iter().map(|fork| tell(fork)).collect() })
    }

    /// Returns to an earlier step.
    ///
    /// # Errors
    /// If there is no such session, or it has not kept the step.
    pub async fn rewind_session(
        &self,
        request: v1::RewindSessionRequest,
    ) -> Result<v1::RewindSessionResponse, Error> {
        let session = self.session(&request.session_id)?;
        let Some(to_step) = request.to_step else {
            return Err(Error::invalid("to_step", "absent", "a step that was observed and kept"));
        };
        let _turn = session.turn.lock().await;
        session.rewind(to_step)?;
        tracing::info!(session = %session.id, to_step, "session rewound");
        Ok(v1::RewindSessionResponse { session: Some(tell(&session)) })
    }

    /// Opens one session.
    pub(super) fn open(&self, terms: &Terms, position: Position) -> Result<v1::Session, Error> {
        self.check(terms, &position)?;
        let beginnings = vec![(position, History::default())];
        let mut opened = self.registry.open(terms, beginnings, Instant::now())?;
        let session = opened.remove(0);
        let model = &session.position().model.spec.name;
        tracing::info!(session = %session.id, model, "session opened");
        Ok(tell(&session))
    }

    /// How long something may lie unused.
    pub(super) fn ttl(&self, ttl: Option<prost_types::Duration>) -> Result<Duration, Error> {
        let Some(asked) = ttl else { return Ok(self.ttl) };
        match Duration::try_from(asked) {
            Ok(ttl) if !ttl.is_zero() && ttl <= self.ttl => Ok(ttl),
            _ => {
                let longest = format!("more than 0 and at most {} s", self.ttl.as_secs());
                Err(Error::invalid("ttl", format!("{} s", asked.seconds), longest))
            }
        }
    }

    fn check(&self, terms: &Terms, position: &Position) -> Result<(), Error> {
        let label = terms.label.chars().count();
        let (kept, most) = (kept_bytes(terms, position), self.kept.kept_bytes);
        let expected = format!("at most {most} bytes for all sessions together");
        fields::all(vec![
            fields::unless(
                label <= LABEL,
                "label",
                format!("{label} characters"),
                format!("at most {LABEL}"),
            ),
            fields::unless(
                kept <= most || terms.keep_steps == 0,
                "keep_steps",
                format!("{} steps, with frames {kept} bytes", terms.keep_steps),
                expected.clone(),
            ),
            fields::unless(
                kept <= most || terms.keep_frames == 0,
                "keep_frames",
                format!("{} frames, with steps {kept} bytes", terms.keep_frames),
                expected,
            ),
        ])
    }
}

/// What is told about a session.
pub(super) fn tell(session: &Session) -> v1::Session {
    let Position { model, draws, next_step, .. } = session.position();
    let mode = if draws.sample { v1::Mode::Sample } else { v1::Mode::Mean };
    let used_at = SystemTime::now() - session.used().elapsed();
    v1::Session {
        id: session.id.to_string(),
        label: session.terms.label.clone(),
        model: model.spec.name.clone(),
        model_hash: model.spec.hash.clone(),
        next_step,
        mode: mode.into(),
        seed: draws.seed,
        created_at: Some(session.created_at.into()),
        used_at: Some(used_at.into()),
        expires_at: Some((used_at + session.terms.ttl).into()),
        bytes: session.bytes() as u64,
        keep_steps: session.terms.keep_steps,
        keep_frames: session.terms.keep_frames,
        oldest_step: session.oldest_step(),
        latest_wins: session.terms.latest_wins,
    }
}
