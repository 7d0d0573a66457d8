//! The use cases. gRPC and REST are thin skins over this, and tests may call it directly.
//!
//! Requests and answers are the messages of the wire; whatever is wrong with them comes back as [`Error`]. What
//! models there are and which sessions are open is answered here; observing is in [`observe`], imagining in
//! [`imagine`].

mod answer;
mod fields;
pub mod imagine;
pub mod observe;

use std::{
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use gatsbi_models::world_model::Preprocess;
use gatsbi_proto::v1;
use tokio_util::sync::CancellationToken;

use crate::{
    config::Config,
    engine::{Engine, commands::ModelEntry},
    error::Error,
    sessions::registry::{NewSession, Registry, Session, SessionId},
};

/// Characters of a label.
const LABEL: usize = 128;

/// The use cases.
#[derive(Debug)]
pub struct Service {
    engine: Engine,
    registry: Registry,
    limits: v1::Limits,
    ttl: Duration,
    stop: CancellationToken,
}

impl Service {
    /// The use cases over an engine; streams end when `stop` is cancelled.
    pub fn new(engine: Engine, config: &Config, stop: CancellationToken) -> Self {
        let limits = v1::Limits {
            max_candidates: config.max_candidates,
            max_horizon: config.max_horizon,
            max_samples: config.max_samples,
            max_rows: config.max_request_rows,
            max_output_bytes: config.max_request_output_mib << 20,
            max_image_side: config.max_image_side,
            max_request_bytes: (config.max_request_mib << 20) as u32,
        };
        let ttl = Duration::from_secs(config.session_ttl_seconds);
        Self { engine, registry: Registry::new(config.max_sessions), limits, ttl, stop }
    }

    /// Cancelled when the server goes down.
    pub fn stop(&self) -> &CancellationToken {
        &self.stop
    }

    /// What one request may ask for.
    pub fn limits(&self) -> &v1::Limits {
        &self.limits
    }

    /// The open sessions.
    pub fn registry(&self) -> &Registry {
        &self.registry
    }

    /// All models.
    pub fn list_models(&self) -> v1::ListModelsResponse {
        let mut models: Vec<v1::Model> =
            self.engine.models().iter().map(|model| self.describe(model)).collect();
        models.sort_by(|a, b| a.name.cmp(&b.name));
        v1::ListModelsResponse { models }
    }

    /// One model.
    ///
    /// # Errors
    /// If it is not served.
    pub fn get_model(&self, request: &v1::GetModelRequest) -> Result<v1::GetModelResponse, Error> {
        let model = self.describe(self.model(&request.model)?);
        Ok(v1::GetModelResponse { model: Some(model) })
    }

    /// Opens a session.
    ///
    /// # Errors
    /// If the request is wrong, or there are too many.
    pub fn create_session(
        &self,
        request: v1::CreateSessionRequest,
    ) -> Result<v1::CreateSessionResponse, Error> {
        let model = self.model(&request.model)?;
        let label = request.label.chars().count();
        let ttl = request.ttl.map(Duration::try_from);
        let ttl = match ttl {
            None => Some(self.ttl),
            Some(ttl) => ttl.ok().filter(|ttl| !ttl.is_zero() && *ttl <= self.ttl),
        };
        let given = request.ttl.map(|ttl| format!("{} s", ttl.seconds)).unwrap_or_default();
        let longest = format!("more than 0 and at most {} s", self.ttl.as_secs());
        fields::all(vec![
            fields::unless(label <= LABEL, "label", format!("{label} characters"), "at most 128"),
            fields::unless(ttl.is_some(), "ttl", given, longest),
        ])?;
        if request.keep_steps > 0 {
            return Err(Error::Unimplemented { what: "keeping steps (keep_steps)" });
        }
        if request.keep_frames > 0 {
            return Err(Error::Unimplemented { what: "keeping frames (keep_frames)" });
        }
        let opened = NewSession {
            label: request.label,
            model: model.id,
            sample: fields::samples(request.mode, "mode")?,
            seed: request.seed.unwrap_or_else(fields::random_seed),
            ttl: ttl.unwrap_or(self.ttl),
            state: Arc::clone(&model.initial),
        };
        let session = self.registry.create(opened, Instant::now())?;
        tracing::info!(session = %session.id, model = model.spec.name, "session opened");
        Ok(v1::CreateSessionResponse { session: Some(self.tell(&session)) })
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
        Ok(v1::GetSessionResponse { session: Some(self.tell(&session)) })
    }

    /// Tells about sessions, page by page.
    ///
    /// # Errors
    /// If the page is not one.
    pub fn list_sessions(
        &self,
        request: &v1::ListSessionsRequest,
    ) -> Result<v1::ListSessionsResponse, Error> {
        let size = request.page_size.unwrap_or(100);
        if !(1..=1000).contains(&size) {
            return Err(Error::invalid("page_size", size, "1 to 1000"));
        }
        let token = request.page_token.as_str();
        let after = if token.is_empty() { None } else { Some(token.parse::<SessionId>()) };
        let Ok(after) = after.transpose() else {
            let expected = "next_page_token of a previous page";
            return Err(Error::invalid("page_token", format!("{token:.64?}"), expected));
        };
        let matches =
            |session: &Session| request.label.is_empty() || session.opened.label == request.label;
        // One more than asked for tells whether there is another page.
        let mut page = self.registry.list(after, size as usize + 1, Instant::now(), matches);
        let more = page.len() > size as usize;
        page.truncate(size as usize);
        let last = page.last().filter(|_| more).map(|session| session.id.to_string());
        Ok(v1::ListSessionsResponse {
            sessions: page.iter().map(|session| self.tell(session)).collect(),
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
        self.registry.delete(&request.session_id, Instant::now())?;
        tracing::info!(session = request.session_id, "session closed");
        Ok(v1::DeleteSessionResponse {})
    }

    /// A session, which counts as used.
    ///
    /// # Errors
    /// If there is none.
    pub fn session(&self, id: &str) -> Result<Arc<Session>, Error> {
        self.registry.get(id, Instant::now())
    }

    /// A model by name; without a name the only one.
    fn model(&self, name: &str) -> Result<&ModelEntry, Error> {
        let models = self.engine.models();
        if let ([model], true) = (models, name.is_empty()) {
            return Ok(model);
        }
        let served = || models.iter().map(|model| model.spec.name.clone()).collect::<Vec<_>>();
        if name.is_empty() {
            let expected = format!("one of {}", served().join(", "));
            return Err(Error::invalid("model", "empty", expected));
        }
        let model = models.iter().find(|model| model.spec.name == name);
        model.ok_or_else(|| {
            let name = name.chars().take(128).collect();
            Error::UnknownModel { name, served: served() }
        })
    }

    fn describe(&self, model: &ModelEntry) -> v1::Model {
        let spec = &model.spec;
        let action = |action: &gatsbi_models::world_model::ActionDimension| v1::ActionDimension {
            name: action.name.clone(),
            unit: action.unit.clone(),
            offset: action.offset,
            scale: action.scale,
        };
        let preprocess = match spec.preprocess {
            Preprocess::Stretch => v1::Preprocess::Stretch,
            Preprocess::CentreCrop => v1::Preprocess::CentreCrop,
        };
        v1::Model {
            name: spec.name.clone(),
            hash: spec.hash.clone(),
            image_size: spec.image_size as u32,
            preprocess: preprocess.into(),
            frame_period_seconds: spec.frame_period,
            actions: spec.actions.iter().map(action).collect(),
            slots: spec.slots as u32,
            agent_slot: spec.agent_slot.map(|slot| slot as u32),
            max_objects: spec.max_objects as u32,
            keypoints: spec.keypoints.map(|keypoints| keypoints as u32),
            latents: spec.latents as u32,
            trained_steps: spec.trained_steps,
            provenance: spec.provenance.clone(),
            card: model.card.clone(),
            state_bytes: model.row_bytes as u32,
            device: model.device.clone(),
            limits: Some(self.limits),
        }
    }

    fn tell(&self, session: &Session) -> v1::Session {
        let spec = &self.engine.model(session.opened.model).spec;
        let mode = if session.opened.sample { v1::Mode::Sample } else { v1::Mode::Mean };
        let used_at = SystemTime::now() - session.used().elapsed();
        v1::Session {
            id: session.id.to_string(),
            label: session.opened.label.clone(),
            model: spec.name.clone(),
            model_hash: spec.hash.clone(),
            next_step: session.position().next_step,
            mode: mode.into(),
            seed: session.opened.seed,
            created_at: Some(session.created_at.into()),
            used_at: Some(used_at.into()),
            expires_at: Some((used_at + session.opened.ttl).into()),
            bytes: session.bytes() as u64,
            keep_steps: 0,
            keep_frames: 0,
            oldest_step: None,
        }
    }
}

/// Runs what takes long where it keeps nobody waiting.
async fn aside<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, Error> {
    let span = tracing::Span::current();
    let work = tokio::task::spawn_blocking(move || span.in_scope(work));
    // It can only fail to run when the process goes down, or by a panic, which is a bug of ours.
    work.await.map_err(|error| {
        tracing::error!(%error, "work aside was lost");
        Error::ShuttingDown
    })
}
