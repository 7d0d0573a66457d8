//! The open sessions, in memory.
//!
//! A session's belief is a row of numbers behind an [`Arc`]: a rollout pins it by holding on to it, and the next
//! observation puts another one in its place. Time comes as an argument, so nothing here waits.

use std::{
    collections::BTreeMap,
    fmt,
    ops::Bound,
    str::FromStr,
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use gatsbi_models::{noise::RowNoise, state::StateRow};
use gatsbi_proto::v1;
use parking_lot::{Mutex, RwLock};

use crate::{engine::commands::ModelId, error::Error};

/// 128 random bits, written as 32 hexadecimal digits.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub struct SessionId(u128);

impl fmt::Display for SessionId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:032x}", self.0)
    }
}

impl FromStr for SessionId {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self, Error> {
        let digits = text.len() == 32 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
        let number = digits.then(|| u128::from_str_radix(text, 16).ok()).flatten();
        number.map(Self).ok_or_else(|| Error::UnknownSession { id: shortened(text) })
    }
}

/// How a session is opened.
#[derive(Clone, Debug)]
pub struct NewSession {
    /// The client's name for it.
    pub label: String,
    /// Its model.
    pub model: ModelId,
    /// Whether observing draws; means otherwise.
    pub sample: bool,
    /// Seed of its random numbers.
    pub seed: u64,
    /// How long it may lie unused.
    pub ttl: Duration,
    /// The state of a session that has seen nothing.
    pub state: Arc<StateRow>,
}

/// A session.
#[derive(Debug)]
pub struct Session {
    /// Its id.
    pub id: SessionId,
    /// How it was opened.
    pub opened: NewSession,
    /// When it was opened.
    pub created_at: SystemTime,
    /// Held by the observation that is being absorbed: one after the other.
    pub turn: tokio::sync::Mutex<()>,
    current: Mutex<Current>,
}

#[derive(Debug)]
struct Current {
    position: Position,
    answer: Option<Answer>,
    used: Instant,
}

/// Where a session is.
#[derive(Clone, Debug)]
pub struct Position {
    /// Observations absorbed: the number of the next one.
    pub next_step: u64,
    /// The belief after them.
    pub state: Arc<StateRow>,
    /// Width and height of the last image that came.
    pub image: (u32, u32),
}

/// The answer to the last observation, for whoever lost it.
#[derive(Clone, Debug)]
pub struct Answer {
    /// Digest of the observation and the selection of outputs.
    pub digest: [u8; 32],
    /// What was answered.
    pub belief: v1::Belief,
}

impl Session {
    /// Where it is.
    pub fn position(&self) -> Position {
        self.current.lock().position.clone()
    }

    /// The answer to the last observation.
    pub fn answer(&self) -> Option<Answer> {
        self.current.lock().answer.clone()
    }

    /// Moves on.
    pub fn commit(&self, position: Position, answer: Answer) {
        let mut current = self.current.lock();
        current.position = position;
        current.answer = Some(answer);
    }

    /// How the next observation draws.
    pub fn noise(&self, step: u64) -> RowNoise {
        match self.opened {
            NewSession { sample: true, seed, .. } => RowNoise::Sample { seed, sample: 0, step },
            NewSession { sample: false, .. } => RowNoise::Mean,
        }
    }

    /// When it was last used.
    pub fn used(&self) -> Instant {
        self.current.lock().used
    }

    /// Memory that it holds, in bytes.
    pub fn bytes(&self) -> usize {
        let current = self.current.lock();
        let StateRow { floats, ints } = current.position.state.as_ref();
        let answer = current.answer.as_ref();
        let answer = answer.map_or(0, |answer| prost::Message::encoded_len(&answer.belief));
        floats.len() * 4 + ints.len() * 8 + answer
    }

    fn expires(&self) -> Instant {
        self.used() + self.opened.ttl
    }
}

/// The open sessions.
#[derive(Debug)]
pub struct Registry {
    sessions: RwLock<BTreeMap<SessionId, Arc<Session>>>,
    limit: usize,
}

impl Registry {
    /// A registry of at most `limit` sessions.
    pub fn new(limit: usize) -> Self {
        Self { sessions: RwLock::new(BTreeMap::new()), limit }
    }

    /// Opens a session.
    ///
    /// # Errors
    /// If there are too many.
    pub fn create(&self, opened: NewSession, now: Instant) -> Result<Arc<Session>, Error> {
        let id = SessionId(rand::random());
        let position = Position { next_step: 0, state: Arc::clone(&opened.state), image: (0, 0) };
        let session = Arc::new(Session {
            id,
            opened,
            created_at: SystemTime::now(),
            turn: tokio::sync::Mutex::new(()),
            current: Mutex::new(Current { position, answer: None, used: now }),
        });
        let mut sessions = self.sessions.write();
        if sessions.len() >= self.limit {
            sessions.retain(|_, session| session.expires() > now);
        }
        if sessions.len() >= self.limit {
            let next = sessions.values().map(|session| session.expires()).min();
            let retry_after = next.map_or(Duration::ZERO, |next| next - now);
            return Err(Error::TooManySessions { limit: self.limit, retry_after });
        }
        sessions.insert(id, Arc::clone(&session));
        Ok(session)
    }

    /// A session, which counts as used at `now`.
    ///
    /// # Errors
    /// If there is none, or it has expired.
    pub fn get(&self, id: &str, now: Instant) -> Result<Arc<Session>, Error> {
        let key: SessionId = id.parse()?;
        let session = self.sessions.read().get(&key).cloned();
        let session = session.filter(|session| session.expires() > now);
        let session = session.ok_or_else(|| Error::UnknownSession { id: shortened(id) })?;
        session.current.lock().used = now;
        Ok(session)
    }

    /// Up to `count` sessions after `after`, by id, that `matches` holds for; using none of them.
    pub fn list(
        &self,
        after: Option<SessionId>,
        count: usize,
        now: Instant,
        matches: impl Fn(&Session) -> bool,
    ) -> Vec<Arc<Session>> {
        let start = after.map_or(Bound::Unbounded, Bound::Excluded);
        let sessions = self.sessions.read();
        let open = sessions.range((start, Bound::Unbounded)).map(|(_, session)| session);
        open.filter(|session| session.expires() > now && matches(session))
            .take(count)
            .cloned()
            .collect()
    }

    /// Closes a session.
    ///
    /// # Errors
    /// If there is none.
    pub fn delete(&self, id: &str, now: Instant) -> Result<(), Error> {
        self.get(id, now)?;
        self.sessions.write().remove(&id.parse()?);
        Ok(())
    }

    /// Closes sessions that have expired; returns how many are left, and their bytes.
    pub fn sweep(&self, now: Instant) -> (usize, usize) {
        let mut sessions = self.sessions.write();
        sessions.retain(|_, session| session.expires() > now);
        (sessions.len(), sessions.values().map(|session| session.bytes()).sum())
    }
}

/// What a client gave as an id, in a length that fits an answer.
fn shortened(text: &str) -> String {
    let mut shortened: String = text.chars().take(64).collect();
    if shortened.len() < text.len() {
        shortened.push_str("...");
    }
    shortened
}

#[cfg(test)]
mod tests {
    use super::*;

    fn opened(label: &str, ttl: u64) -> NewSession {
        NewSession {
            label: label.to_owned(),
            model: ModelId(0),
            sample: true,
            seed: 7,
            ttl: Duration::from_secs(ttl),
            state: Arc::new(StateRow { floats: [0.0; 4].into(), ints: [0; 2].into() }),
        }
    }

    #[test]
    fn sessions_expire_unless_they_are_used() {
        let (registry, start) = (Registry::new(10), Instant::now());
        let at = |seconds| start + Duration::from_secs(seconds);
        let used = registry.create(opened("used", 10), start).unwrap().id.to_string();
        let unused = registry.create(opened("unused", 10), start).unwrap().id.to_string();
        registry.get(&used, at(8)).unwrap();
        assert!(registry.get(&used, at(15)).is_ok());
        assert_eq!(
            registry.get(&unused, at(15)).unwrap_err(),
            Error::UnknownSession { id: unused.clone() }
        );
        assert_eq!(registry.list(None, 10, at(15), |_| true).len(), 1);
        assert_eq!(registry.sweep(at(15)), (1, 32));
        assert_eq!(registry.sweep(at(26)), (0, 0));
    }

    #[test]
    fn full_means_full_until_one_expires() {
        let (registry, start) = (Registry::new(1), Instant::now());
        registry.create(opened("first", 10), start).unwrap();
        let later = start + Duration::from_secs(4);
        let error = registry.create(opened("second", 10), later).unwrap_err();
        assert_eq!(error.retry_after(), Some(Duration::from_secs(6)));
        registry.create(opened("second", 10), start + Duration::from_secs(10)).unwrap();
    }

    #[test]
    fn pages_follow_each_other() {
        let (registry, now) = (Registry::new(10), Instant::now());
        for label in ["a", "b", "a", "a"] {
            registry.create(opened(label, 10), now).unwrap();
        }
        let only_a = |session: &Session| session.opened.label == "a";
        let first = registry.list(None, 2, now, only_a);
        let second = registry.list(Some(first[1].id), 2, now, only_a);
        assert_eq!((first.len(), second.len()), (2, 1));
        assert!(first[0].id < first[1].id && first[1].id < second[0].id);
    }

    #[test]
    fn ids_are_checked_before_they_are_looked_up() {
        let registry = Registry::new(1);
        for bad in ["", "7", &"g".repeat(32), &"0".repeat(33), &"+".repeat(32)] {
            assert!(matches!(registry.get(bad, Instant::now()), Err(Error::UnknownSession { .. })));
        }
        assert_eq!(shortened(&"x".repeat(100)), "x".repeat(64) + "...");
    }
}
