//! The use cases. gRPC and REST are thin skins over this, and tests may call it directly.
//!
//! Requests and answers are the messages of the wire; whatever is wrong with them comes back as [`Error`]. A file a
//! use case: [`models`], [`sessions`] and [`snapshots`], then [`observe`], [`imagine`] and [`planning`],
//! and [`show`] for people.

mod administration;
mod answer;
mod fields;
mod goals;
mod handles;
mod imagine;
mod models;
mod observe;
mod planning;
pub mod predict;
mod programs;
pub mod rollout;
mod sessions;
pub mod show;
mod snapshots;
mod spread;
mod start;

use std::{
    ops::Deref,
    sync::{Arc, atomic::AtomicU64},
    time::{Duration, Instant},
};

use gatsbi_proto::v1;
use sha2::{Digest as _, Sha256};
use tokio_util::sync::CancellationToken;

use self::{handles::Opened, models::Catalogue};
use crate::{
    access::tenants::{Amount, Owner},
    checkpoints::Checkpoints,
    config::Config,
    engine::{
        Chunks, Engine,
        commands::{Imagine, Tenant, Urgency},
        models::ModelEntry,
    },
    error::Error,
    sessions::{
        registry::{Limits, Registry},
        session::Session,
    },
};

/// The use cases, as one owner may use them: it sees what is its own, and all if it is the operator.
#[derive(Debug)]
pub struct Service {
    shared: Arc<Shared>,
    owner: Owner,
}

/// What the use cases of all owners share.
#[derive(Debug)]
pub struct Shared {
    engine: Engine,
    catalogue: Catalogue,
    registry: Registry,
    /// Seeds that were drawn for sessions.
    seeds: AtomicU64,
    handles: Opened,
    goals: goals::Kept,
    limits: v1::Limits,
    kept: Limits,
    ttl: Duration,
    checkpoints: Checkpoints,
    /// Held by whatever changes the models: one after the other.
    changing: tokio::sync::Mutex<()>,
    stop: CancellationToken,
}

/// What a call says about itself beside its request.
#[derive(Clone, Copy, Debug, Default)]
pub struct Call {
    /// When an answer is of no use any more.
    pub deadline: Option<Instant>,
    /// Whose it is; the session's own if absent.
    pub tenant: Option<Tenant>,
}

impl Call {
    /// The tenant of a name that a client gives itself.
    pub fn tenant_named(name: &[u8]) -> Tenant {
        let digest = Sha256::digest(name);
        Tenant(digest.iter().take(16).fold(0, |bits, byte| bits << 8 | u128::from(*byte)))
    }
}

impl Service {
    /// The use cases over an engine and the models that it serves; streams end when `stop` is cancelled.
    pub fn new(
        engine: Engine,
        models: Vec<Arc<ModelEntry>>,
        config: &Config,
        stop: CancellationToken,
    ) -> Self {
        let limits = v1::Limits {
            max_candidates: config.max_candidates,
            max_horizon: config.max_horizon,
            max_samples: config.max_samples,
            max_rows: config.max_request_rows,
            max_output_bytes: config.max_request_output_mib << 20,
            max_image_side: config.max_image_side,
            max_request_bytes: (config.max_request_mib << 20) as u32,
        };
        let kept = Limits { sessions: config.max_sessions, kept_bytes: config.max_kept_mib << 20 };
        let shared = Shared {
            engine,
            catalogue: Catalogue::new(models),
            registry: Registry::new(kept),
            seeds: AtomicU64::default(),
            handles: Opened::default(),
            goals: goals::Kept::default(),
            limits,
            kept,
            ttl: Duration::from_secs(config.session_ttl_seconds),
            checkpoints: config.checkpoints(),
            changing: tokio::sync::Mutex::new(()),
            stop,
        };
        Self { shared: Arc::new(shared), owner: Owner::default() }
    }

    /// The same use cases for somebody else.
    #[must_use]
    pub fn of(&self, owner: Owner) -> Self {
        Self { shared: Arc::clone(&self.shared), owner }
    }

    /// Cancelled when the server goes down.
    pub fn stop(&self) -> &CancellationToken {
        &self.stop
    }

    /// What one request may ask for.
    pub fn limits(&self) -> &v1::Limits {
        &self.limits
    }

    /// Closes what has expired; returns how many sessions are left, and their bytes.
    pub fn sweep(&self, now: Instant) -> (usize, usize) {
        self.handles.sweep(now);
        self.goals.sweep(now);
        self.registry.sweep(now)
    }

    /// A session, which counts as used.
    ///
    /// # Errors
    /// If there is none.
    pub fn session(&self, id: &str) -> Result<Arc<Session>, Error> {
        self.registry.get(id, &self.owner, Instant::now())
    }

    /// Starts a rollout within what the owner may have under way. Bulk work waits for its turn.
    async fn roll(&self, job: Imagine, output_bytes: u64) -> Result<Chunks, Error> {
        let amount = Amount::rows(job.rows());
        let share = match job.urgency {
            Urgency::Live => self.owner.take(amount)?,
            Urgency::Bulk => self.owner.take_when_free(amount).await?,
        };
        self.engine.imagine(job, output_bytes, share).await
    }
}

impl Deref for Service {
    type Target = Shared;

    fn deref(&self) -> &Shared {
        &self.shared
    }
}

/// Runs what takes long where it keeps nobody waiting.
pub(crate) async fn aside<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Error> {
    let span = tracing::Span::current();
    let work = tokio::task::spawn_blocking(move || span.in_scope(work));
    // It can only fail to run when the process goes down, or by a panic, which is a bug of ours.
    work.await.map_err(|error| {
        tracing::error!(%error, "work aside was lost");
        Error::ShuttingDown
    })
}
