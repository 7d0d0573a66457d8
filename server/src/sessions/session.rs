//! A session: where it is, what it answered last, and what it keeps of its past.
//!
//! A belief is a row of numbers that never changes, behind an [`Arc`]: the next observation puts another one in its
//! place. So whatever keeps a belief (a fork, a rollout, a step to return to) shares it.

use std::{
    collections::VecDeque,
    fmt,
    str::FromStr,
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use gatsbi_models::{noise::RowNoise, state::StateRow};
use gatsbi_proto::v1;
use parking_lot::Mutex;
use prost::Message as _;

use super::{
    live::{Last, Live},
    registry::Room,
};
use crate::{access::tenants::Owner, engine::models::ModelEntry, error::Error, frame::Frame};

/// 128 random bits, written as 32 hexadecimal digits.
#[derive(Clone, Copy, Debug, Eq, Ord, PartialEq, PartialOrd)]
pub struct SessionId(pub(super) u128);

impl SessionId {
    /// The bits.
    pub fn bits(self) -> u128 {
        self.0
    }
}

impl fmt::Display for SessionId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:032x}", self.0)
    }
}

impl FromStr for SessionId {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self, Error> {
        match bits(text) {
            Some(number) => Ok(Self(number)),
            None => Err(Error::UnknownSession { id: shortened(text) }),
        }
    }
}

/// The number that 32 hexadecimal digits are.
pub fn bits(text: &str) -> Option<u128> {
    let digits = text.len() == 32 && text.bytes().all(|byte| byte.is_ascii_hexdigit());
    digits.then(|| u128::from_str_radix(text, 16).ok()).flatten()
}

/// What a client gave as an id, in a length that fits an answer.
pub fn shortened(text: &str) -> String {
    let mut shortened: String = text.chars().take(64).collect();
    if shortened.len() < text.len() {
        shortened.push_str("...");
    }
    shortened
}

/// What stays as it is while a session is open.
#[derive(Clone, Debug)]
pub struct Terms {
    /// Whose it is.
    pub owner: Owner,
    /// The client's name for it.
    pub label: String,
    /// How long it may lie unused.
    pub ttl: Duration,
    /// Earlier steps that it keeps to return to.
    pub keep_steps: u32,
    /// Observations that it keeps to replay on another model.
    pub keep_frames: u32,
    /// Whether its control loop passes over images for newer ones.
    pub latest_wins: bool,
}

/// How observing draws.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct Draws {
    /// Whether it draws; means otherwise.
    pub sample: bool,
    /// Seed of the random numbers.
    pub seed: u64,
}

impl Draws {
    /// How the observation of a step draws.
    pub fn noise(self, step: u64) -> RowNoise {
        match self {
            Self { sample: true, seed } => RowNoise::Sample { seed, sample: 0, step },
            Self { sample: false, .. } => RowNoise::Mean,
        }
    }
}

/// Where a session is, and all that its next step follows from.
#[derive(Clone, Debug)]
pub struct Position {
    /// Its model.
    pub model: Arc<ModelEntry>,
    /// How it draws.
    pub draws: Draws,
    /// Observations absorbed: the number of the next one.
    pub next_step: u64,
    /// The belief after them.
    pub state: Arc<StateRow>,
    /// Width and height of the last image that came.
    pub image: (u32, u32),
}

impl Position {
    /// The last step observed.
    ///
    /// # Errors
    /// If there is none, or it is not the one that a client expects.
    pub fn last(&self, at_step: Option<u64>) -> Result<u64, Error> {
        let last = self.next_step.checked_sub(1).ok_or(Error::NothingObserved)?;
        match at_step.filter(|at_step| *at_step != last) {
            Some(at_step) => Err(Error::SessionMoved { at_step, last }),
            None => Ok(last),
        }
    }
}

/// The answer to the last observation, for whoever lost it.
#[derive(Clone, Debug)]
pub struct Answer {
    /// Digest of the observation and the selection of outputs.
    pub digest: [u8; 32],
    /// What was answered.
    pub belief: v1::Belief,
}

/// An observation as the model saw it.
#[derive(Clone, Debug)]
pub struct Seen {
    /// Its step.
    pub step: u64,
    /// Its image; absent for a dropped frame.
    pub frame: Option<Frame>,
    /// The action that led to it, in raw units.
    pub action: Vec<f32>,
    /// Width and height of the last image that came.
    pub image: (u32, u32),
}

/// What a session keeps of its past.
#[derive(Clone, Debug, Default)]
pub struct History {
    /// Where it was, oldest first.
    positions: VecDeque<Position>,
    /// What it saw, oldest first.
    seen: VecDeque<Seen>,
    /// Its newest step, to be shown; absent where the session came to its belief otherwise than by observing.
    last: Option<Arc<Last>>,
}

/// The actions that were planned last.
#[derive(Clone, Debug)]
pub struct Planned {
    /// The last step observed when they were.
    pub at_step: u64,
    /// `[H, A]` in raw units.
    pub actions: Arc<[f32]>,
}

/// A session.
#[derive(Debug)]
pub struct Session {
    /// Its id.
    pub id: SessionId,
    /// What stays as it is.
    pub terms: Terms,
    /// When it was opened.
    pub created_at: SystemTime,
    /// Held by whatever moves it: one after the other.
    pub turn: tokio::sync::Mutex<()>,
    /// Where it is watched.
    pub live: Live,
    current: Mutex<Current>,
    /// Room for what it keeps.
    _room: Room,
}

#[derive(Debug)]
struct Current {
    position: Position,
    answer: Option<Answer>,
    history: History,
    planned: Option<Planned>,
    used: Instant,
}

impl Session {
    pub(super) fn new(
        id: SessionId,
        terms: Terms,
        (position, history): (Position, History),
        room: Room,
        now: Instant,
    ) -> Self {
        let current = Current { position, answer: None, history, planned: None, used: now };
        Self {
            id,
            terms,
            created_at: SystemTime::now(),
            turn: tokio::sync::Mutex::new(()),
            live: Live::default(),
            current: Mutex::new(current),
            _room: room,
        }
    }

    /// Where it is.
    pub fn position(&self) -> Position {
        self.current.lock().position.clone()
    }

    /// Where it is, and its past.
    pub fn past(&self) -> (Position, History) {
        let current = self.current.lock();
        (current.position.clone(), current.history.clone())
    }

    /// The answer to the last observation.
    pub fn answer(&self) -> Option<Answer> {
        self.current.lock().answer.clone()
    }

    /// The newest step, if the session came to its belief by observing.
    pub fn last(&self) -> Option<Arc<Last>> {
        self.current.lock().history.last.clone()
    }

    /// What was planned last.
    pub fn planned(&self) -> Option<Planned> {
        self.current.lock().planned.clone()
    }

    /// Keeps what was planned, for the next plan to start from.
    pub fn plan(&self, planned: Planned) {
        self.current.lock().planned = Some(planned);
    }

    /// The earliest step that it can return to, if there is one.
    pub fn oldest_step(&self) -> Option<u64> {
        self.current.lock().history.positions.front().map(|position| position.next_step - 1)
    }

    /// Moves on by an observation.
    pub fn commit(&self, position: Position, answer: Answer, seen: Seen) {
        let current = &mut *self.current.lock();
        let before = std::mem::replace(&mut current.position, position);
        current.answer = Some(answer);
        let History { positions, seen: kept, last } = &mut current.history;
        *last = Some(Arc::new(Last { before: before.clone(), seen: seen.clone() }));
        if before.next_step > 0 {
            keep(positions, before, self.terms.keep_steps);
        }
        keep(kept, seen, self.terms.keep_frames);
    }

    /// Returns to an earlier step, which becomes the last one observed.
    ///
    /// # Errors
    /// If it was not kept.
    pub fn rewind(&self, to_step: u64) -> Result<(), Error> {
        let current = &mut *self.current.lock();
        let last = current.position.next_step.checked_sub(1).ok_or(Error::NothingObserved)?;
        if to_step == last {
            return Ok(());
        }
        let History { positions, seen, last: newest } = &mut current.history;
        let oldest = positions.front().map(|position| position.next_step - 1);
        let at = positions.iter().position(|kept| kept.next_step.checked_sub(1) == Some(to_step));
        let at = at.ok_or(Error::StepNotKept { to_step, oldest, last })?;
        if let Some(position) = positions.drain(at..).next() {
            current.position = position;
        }
        seen.retain(|seen| seen.step <= to_step);
        *newest = None;
        current.answer = None;
        Ok(())
    }

    /// Becomes another belief, without a past.
    pub fn replace(&self, position: Position) {
        let current = &mut *self.current.lock();
        current.position = position;
        current.answer = None;
        current.history = History::default();
    }

    /// Goes over to another model, on which what it saw was replayed.
    pub fn migrate(&self, position: Position) {
        let current = &mut *self.current.lock();
        current.position = position;
        current.answer = None;
        current.history.positions.clear();
        current.history.last = None;
    }

    /// When it was last used.
    pub fn used(&self) -> Instant {
        self.current.lock().used
    }

    pub(super) fn use_at(&self, now: Instant) {
        self.current.lock().used = now;
    }

    pub(super) fn expires(&self) -> Instant {
        self.used() + self.terms.ttl
    }

    /// Memory that it holds, in bytes; what it shares with forks counts for each.
    pub fn bytes(&self) -> usize {
        let current = self.current.lock();
        let Current { position, answer, history, planned, .. } = &*current;
        // What the newest step came from is kept once, whether or not it is also kept to return to or to replay.
        let last = history.last.as_ref();
        let rows = 1 + history.positions.len().max(last.iter().len());
        let frames = match (last, history.seen.is_empty()) {
            (Some(last), true) => last.seen.bytes(),
            _ => history.seen.iter().map(Seen::bytes).sum(),
        };
        let answer = answer.as_ref().map_or(0, |answer| answer.belief.encoded_len());
        let planned = planned.as_ref().map_or(0, |planned| size_of_val(&*planned.actions));
        rows * position.model.row_bytes + frames + answer + planned
    }
}

impl History {
    /// What can be seen again, oldest first: from the first image on, since what came before says nothing without it.
    pub fn replayable(self) -> Vec<Seen> {
        self.seen.into_iter().skip_while(|seen| seen.frame.is_none()).collect()
    }

    /// The same past, drawn otherwise from now on.
    #[must_use]
    pub fn drawing(mut self, draws: Draws) -> Self {
        for position in &mut self.positions {
            position.draws = draws;
        }
        self
    }
}

impl Seen {
    fn bytes(&self) -> usize {
        self.frame.as_ref().map_or(0, Frame::bytes) + size_of_val(&*self.action)
    }
}

/// Puts the newest thing last, and forgets the oldest where there are too many.
fn keep<T>(kept: &mut VecDeque<T>, newest: T, most: u32) {
    if most == 0 {
        return;
    }
    if kept.len() == most as usize {
        kept.pop_front();
    }
    kept.push_back(newest);
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::engine::models::made_up;

    /// A session's terms in tests.
    pub(in crate::sessions) fn terms(label: &str, ttl: u64, keep: (u32, u32)) -> Terms {
        Terms {
            owner: Owner::default(),
            label: label.to_owned(),
            ttl: Duration::from_secs(ttl),
            keep_steps: keep.0,
            keep_frames: keep.1,
            latest_wins: false,
        }
    }

    /// Where a session of a made-up model is.
    pub(in crate::sessions) fn at(next_step: u64) -> Position {
        let state = StateRow { floats: vec![next_step as f32; 4].into(), ints: [7, 8].into() };
        Position {
            model: made_up(&"0a".repeat(32), 4, 2),
            draws: Draws { sample: true, seed: 7 },
            next_step,
            state: Arc::new(state),
            image: (4, 3),
        }
    }

    fn session(keep: (u32, u32)) -> Session {
        let room = Room::for_test();
        let beginning = (at(0), History::default());
        Session::new(SessionId(1), terms("", 10, keep), beginning, room, Instant::now())
    }

    /// Lets a session absorb steps up to `last`.
    fn absorb(session: &Session, last: u64) {
        for step in session.position().next_step..=last {
            let belief = v1::Belief { step, ..Default::default() };
            let frame = (step != 6).then(|| Frame::Bytes([128; 12].into()));
            let seen = Seen { step, frame, action: vec![step as f32], image: (4, 3) };
            session.commit(at(step + 1), Answer { digest: [0; 32], belief }, seen);
        }
    }

    fn seen(session: &Session) -> Vec<u64> {
        session.past().1.replayable().iter().map(|seen| seen.step).collect()
    }

    #[test]
    fn a_session_returns_to_steps_that_it_kept() {
        let session = session((3, 4));
        assert_eq!(session.rewind(0).unwrap_err(), Error::NothingObserved);
        absorb(&session, 9);
        assert_eq!(
            (session.oldest_step(), session.bytes()),
            (Some(6), 4 * 32 + 4 * 4 + 3 * 12 + 2)
        );
        assert_eq!(seen(&session), [7, 8, 9], "6 came without an image");
        let refused = Error::StepNotKept { to_step: 5, oldest: Some(6), last: 9 };
        assert_eq!(session.rewind(5).unwrap_err(), refused);
        session.rewind(9).unwrap();
        assert!(session.answer().is_some(), "it was there already");
        session.rewind(7).unwrap();
        let position = session.position();
        assert_eq!((position.next_step, position.state.floats[0]), (8, 8.0));
        assert_eq!((session.oldest_step(), seen(&session)), (Some(6), vec![7]));
        assert!(session.answer().is_none());
        assert!(matches!(session.rewind(8), Err(Error::StepNotKept { .. })), "it was forgotten");
        absorb(&session, 8);
        assert_eq!(session.oldest_step(), Some(6));
    }

    #[test]
    fn what_is_not_asked_for_is_not_kept() {
        let session = session((0, 0));
        absorb(&session, 4);
        assert_eq!((session.oldest_step(), seen(&session)), (None, vec![]));
        let refused = session.rewind(3).unwrap_err();
        assert_eq!(refused, Error::StepNotKept { to_step: 3, oldest: None, last: 4 });
    }

    #[test]
    fn a_fork_shares_the_past_and_may_draw_otherwise() {
        let session = session((3, 0));
        absorb(&session, 4);
        let (position, history) = session.past();
        let other = Draws { seed: 9, ..position.draws };
        let room = Room::for_test();
        let beginning = (position, history.drawing(other));
        let fork =
            Session::new(SessionId(2), terms("", 9, (3, 0)), beginning, room, Instant::now());
        fork.rewind(2).unwrap();
        assert_eq!(fork.position().draws, other);
        session.rewind(2).unwrap();
        assert!(Arc::ptr_eq(&fork.position().state, &session.position().state));
        assert_ne!(fork.position().draws.noise(3), session.position().draws.noise(3));
    }

    #[test]
    fn ids_are_checked_before_they_are_looked_up() {
        for bad in ["", "7", &"g".repeat(32), &"0".repeat(33), &"+".repeat(32)] {
            assert!(matches!(bad.parse::<SessionId>(), Err(Error::UnknownSession { .. })));
        }
        let id = SessionId(0xab);
        assert_eq!(id.to_string().parse::<SessionId>().unwrap(), id);
        assert_eq!(shortened(&"x".repeat(100)), "x".repeat(64) + "...");
    }
}
