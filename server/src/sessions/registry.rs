//! The open sessions, in memory. Time comes as an argument, so nothing here waits.

use std::{
    collections::BTreeMap,
    ops::Bound,
    sync::Arc,
    time::{Duration, Instant},
};

use parking_lot::RwLock;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::session::{History, Position, Session, SessionId, Terms, shortened};
use crate::{
    access::tenants::{Amount, Owner, Share},
    error::Error,
};

/// How much sessions may keep.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Sessions.
    pub sessions: usize,
    /// Bytes of earlier steps and frames, of all sessions together.
    pub kept_bytes: u64,
}

/// Room for something that is kept, of the server's and of its owner's.
#[derive(Debug)]
pub struct Room {
    _server: OwnedSemaphorePermit,
    _owner: Share,
}

/// The open sessions.
#[derive(Debug)]
pub struct Registry {
    sessions: RwLock<BTreeMap<SessionId, Arc<Session>>>,
    /// Room for what sessions keep, in KiB; reserved when they are opened.
    room: Arc<Semaphore>,
    limits: Limits,
}

impl Registry {
    /// A registry with room for so much.
    pub fn new(limits: Limits) -> Self {
        let room = Arc::new(Semaphore::new(limits.kept_bytes.div_ceil(1024) as usize));
        Self { sessions: RwLock::new(BTreeMap::new()), room, limits }
    }

    /// Opens as many sessions as there are beginnings, or none.
    ///
    /// # Errors
    /// If there are too many, or they would keep too much.
    pub fn open(
        &self,
        terms: &Terms,
        beginnings: Vec<(Position, History)>,
        now: Instant,
    ) -> Result<Vec<Arc<Session>>, Error> {
        let count = beginnings.len();
        let mut sessions = self.sessions.write();
        if sessions.len() + count > self.limits.sessions {
            sessions.retain(|_, session| session.expires() > now);
        }
        let next = || sessions.values().map(|session| session.expires()).min();
        let retry_after = || next().map_or(Duration::ZERO, |next| next.duration_since(now));
        if sessions.len() + count > self.limits.sessions {
            let limit = self.limits.sessions;
            return Err(Error::TooManySessions { limit, retry_after: retry_after() });
        }
        let mut opened = Vec::with_capacity(count);
        for beginning in beginnings {
            let bytes = kept_bytes(terms, &beginning.0);
            let share = terms.owner.take(Amount::session(bytes))?;
            let kib = bytes.div_ceil(1024);
            let room = u32::try_from(kib)
                .ok()
                .and_then(|kib| Arc::clone(&self.room).try_acquire_many_owned(kib).ok());
            let Some(room) = room else {
                let limit_bytes = self.limits.kept_bytes;
                return Err(Error::TooMuchKept { limit_bytes, retry_after: retry_after() });
            };
            let room = Room { _server: room, _owner: share };
            let id = SessionId(rand::random());
            opened.push(Arc::new(Session::new(id, terms.clone(), beginning, room, now)));
        }
        sessions.extend(opened.iter().map(|session| (session.id, Arc::clone(session))));
        Ok(opened)
    }

    /// Room for so much else that is kept for an owner.
    ///
    /// # Errors
    /// If there is none.
    pub fn reserve(&self, bytes: u64, owner: &Owner) -> Result<Room, Error> {
        let share = owner.take(Amount::kept(bytes))?;
        let kib = u32::try_from(bytes.div_ceil(1024)).unwrap_or(u32::MAX);
        let room = Arc::clone(&self.room).try_acquire_many_owned(kib).map_err(|_full| {
            let now = Instant::now();
            let next = self.sessions.read().values().map(|session| session.expires()).min();
            let retry_after = next.map_or(Duration::from_secs(1), |next| next.duration_since(now));
            Error::TooMuchKept { limit_bytes: self.limits.kept_bytes, retry_after }
        })?;
        Ok(Room { _server: room, _owner: share })
    }

    /// A session that `viewer` sees, which counts as used at `now`.
    ///
    /// # Errors
    /// If there is none, or it has expired.
    pub fn get(&self, id: &str, viewer: &Owner, now: Instant) -> Result<Arc<Session>, Error> {
        let key: SessionId = id.parse()?;
        let session = self.sessions.read().get(&key).cloned();
        let session =
            session.filter(|session| session.expires() > now && viewer.sees(&session.terms.owner));
        let session = session.ok_or_else(|| Error::UnknownSession { id: shortened(id) })?;
        session.use_at(now);
        Ok(session)
    }

    /// Up to `count` sessions after `after`, by id, that `viewer` sees and `matches` holds for; using none of them.
    pub fn list(
        &self,
        viewer: &Owner,
        after: Option<SessionId>,
        count: usize,
        now: Instant,
        matches: impl Fn(&Session) -> bool,
    ) -> Vec<Arc<Session>> {
        let start = after.map_or(Bound::Unbounded, Bound::Excluded);
        let sessions = self.sessions.read();
        let open = sessions.range((start, Bound::Unbounded)).map(|(_, session)| session);
        let seen = |session: &Session| viewer.sees(&session.terms.owner) && matches(session);
        open.filter(|session| session.expires() > now && seen(session))
            .take(count)
            .cloned()
            .collect()
    }

    /// Closes a session.
    ///
    /// # Errors
    /// If there is none.
    pub fn delete(&self, id: &str, viewer: &Owner, now: Instant) -> Result<(), Error> {
        let session = self.get(id, viewer, now)?;
        self.close(session.id);
        Ok(())
    }

    /// Closes a session, if it is open; returns whether it was.
    pub fn close(&self, id: SessionId) -> bool {
        self.sessions.write().remove(&id).is_some()
    }

    /// Closes sessions that have expired; returns how many are left, and their bytes.
    pub fn sweep(&self, now: Instant) -> (usize, usize) {
        let mut sessions = self.sessions.write();
        sessions.retain(|_, session| session.expires() > now);
        (sessions.len(), sessions.values().map(|session| session.bytes()).sum())
    }
}

#[cfg(test)]
impl Room {
    /// Room that nobody else needs.
    pub(super) fn for_test() -> Self {
        let room = Arc::new(Semaphore::new(1)).try_acquire_owned().expect("it is free");
        Self { _server: room, _owner: Share::default() }
    }
}

/// The most that a session will keep of its past, in bytes: frames may come as floats.
pub fn kept_bytes(terms: &Terms, position: &Position) -> u64 {
    let spec = &position.model.spec;
    let frame = (3 * spec.image_size * spec.image_size) as u64 * 4 + spec.actions.len() as u64 * 4;
    let steps = u64::from(terms.keep_steps) * position.model.row_bytes as u64;
    steps + u64::from(terms.keep_frames) * frame
}

#[cfg(test)]
mod tests {
    use super::{
        super::session::tests::{at, terms},
        *,
    };

    fn registry(sessions: usize) -> Registry {
        Registry::new(Limits { sessions, kept_bytes: 4096 })
    }

    fn opened(
        registry: &Registry,
        label: &str,
        ttl: u64,
        now: Instant,
    ) -> Result<Arc<Session>, Error> {
        let beginnings = vec![(at(0), History::default())];
        Ok(registry.open(&terms(label, ttl, (0, 0)), beginnings, now)?.remove(0))
    }

    #[test]
    fn sessions_expire_unless_they_are_used() {
        let (registry, start) = (registry(10), Instant::now());
        let after = |seconds| start + Duration::from_secs(seconds);
        let used = opened(&registry, "used", 10, start).unwrap().id.to_string();
        let unused = opened(&registry, "unused", 10, start).unwrap().id.to_string();
        registry.get(&used, &Owner::default(), after(8)).unwrap();
        assert!(registry.get(&used, &Owner::default(), after(15)).is_ok());
        assert_eq!(
            registry.get(&unused, &Owner::default(), after(15)).unwrap_err(),
            Error::UnknownSession { id: unused.clone() }
        );
        assert_eq!(registry.list(&Owner::default(), None, 10, after(15), |_| true).len(), 1);
        assert_eq!(registry.sweep(after(15)), (1, 32));
        assert_eq!(registry.sweep(after(26)), (0, 0));
    }

    #[test]
    fn full_means_full_until_one_expires() {
        let (registry, start) = (registry(1), Instant::now());
        opened(&registry, "first", 10, start).unwrap();
        let later = start + Duration::from_secs(4);
        let error = opened(&registry, "second", 10, later).unwrap_err();
        assert_eq!(error.retry_after(), Some(Duration::from_secs(6)));
        opened(&registry, "second", 10, start + Duration::from_secs(10)).unwrap();
    }

    #[test]
    fn forks_are_opened_together_or_not_at_all() {
        let (registry, now) = (registry(3), Instant::now());
        opened(&registry, "one", 10, now).unwrap();
        let many = |count: usize| vec![(at(1), History::default()); count];
        let refused = registry.open(&terms("", 10, (0, 0)), many(3), now).unwrap_err();
        assert!(matches!(refused, Error::TooManySessions { .. }));
        assert_eq!(registry.sweep(now).0, 1);
        assert_eq!(registry.open(&terms("", 10, (0, 0)), many(2), now).unwrap().len(), 2);
    }

    #[test]
    fn what_sessions_may_keep_is_reserved_when_they_are_opened() {
        let (registry, now) = (registry(9), Instant::now());
        // 32 bytes a step and 48 a frame: 40 and 20 of them take 3 of 4 KiB.
        let keeping = terms("", 10, (40, 20));
        assert_eq!(kept_bytes(&keeping, &at(0)), 40 * 32 + 20 * 48);
        let beginnings = |count: usize| vec![(at(0), History::default()); count];
        let refused = registry.open(&keeping, beginnings(2), now).unwrap_err();
        assert!(matches!(refused, Error::TooMuchKept { limit_bytes: 4096, .. }), "{refused}");
        let first = registry.open(&keeping, beginnings(1), now).unwrap().remove(0);
        assert!(registry.open(&keeping, beginnings(1), now).is_err());
        registry.delete(&first.id.to_string(), &Owner::default(), now).unwrap();
        drop(first);
        registry.open(&keeping, beginnings(1), now).unwrap();
    }

    #[test]
    fn pages_follow_each_other() {
        let (registry, now) = (registry(10), Instant::now());
        for label in ["a", "b", "a", "a"] {
            opened(&registry, label, 10, now).unwrap();
        }
        let only_a = |session: &Session| session.terms.label == "a";
        let first = registry.list(&Owner::default(), None, 2, now, only_a);
        let second = registry.list(&Owner::default(), Some(first[1].id), 2, now, only_a);
        assert_eq!((first.len(), second.len()), (2, 1));
        assert!(first[0].id < first[1].id && first[1].id < second[0].id);
    }
}
