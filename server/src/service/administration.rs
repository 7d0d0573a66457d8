//! Administration: models loaded, unloaded, and put in place of others while the server runs.

use std::{path::PathBuf, sync::Arc, time::Instant};

use futures_util::{StreamExt as _, stream::iter};
use gatsbi_models::world_model::ModelSpec;
use gatsbi_proto::v1::{self, SwapPolicy};

use super::{Service, aside};
use crate::{
    checkpoints::Checkpoints,
    engine::models::ModelEntry,
    error::{Error, told},
    sessions::session::{Position, Session},
};

/// Sessions that move to another model together.
const TOGETHER: usize = 16;

/// Characters of a model's name.
const NAME: usize = 128;

impl Service {
    /// Loads a checkpoint under a new name.
    ///
    /// # Errors
    /// If it cannot be served, or the name is taken. What is served stays as it is.
    pub async fn load_model(
        &self,
        request: v1::LoadModelRequest,
    ) -> Result<v1::LoadModelResponse, Error> {
        let _change = self.changing.lock().await;
        let name = (!request.name.is_empty()).then_some(request.name);
        let length = name.as_ref().map_or(0, |name| name.chars().count());
        if length > NAME {
            return Err(Error::invalid("name", format!("{length} characters"), "at most 128"));
        }
        if let Some(name) = &name {
            self.is_free(name)?;
        }
        let model = self.serve(request.path, name).await?;
        self.is_free(&model.spec.name)?;
        self.catalogue.put(Arc::clone(&model));
        Ok(v1::LoadModelResponse { model: Some(self.describe(&model)) })
    }

    /// Stops serving a model.
    ///
    /// # Errors
    /// If there is none, or it has sessions that are not to be closed.
    pub async fn unload_model(
        &self,
        request: v1::UnloadModelRequest,
    ) -> Result<v1::UnloadModelResponse, Error> {
        let _change = self.changing.lock().await;
        let name = self.catalogue.get(&request.model)?.spec.name.clone();
        let sessions = self.sessions_of(&name);
        if !sessions.is_empty() && !request.close_sessions {
            return Err(Error::ModelInUse { name, sessions: sessions.len() });
        }
        self.catalogue.remove(&name);
        let closed = sessions.iter().filter(|session| self.registry.close(session.id)).count();
        tracing::info!(model = name, closed, "model unloaded");
        Ok(v1::UnloadModelResponse { closed_sessions: closed as u32 })
    }

    /// Puts another checkpoint under a name, with the sessions that it has.
    ///
    /// # Errors
    /// If there is no such model, or the other one cannot be served, or does not take what the sessions saw. Nothing
    /// has changed then.
    pub async fn swap_model(
        &self,
        request: v1::SwapModelRequest,
    ) -> Result<v1::SwapModelResponse, Error> {
        let _change = self.changing.lock().await;
        let policy = SwapPolicy::try_from(request.policy)
            .map_err(|_unknown| Error::invalid("policy", request.policy, "a known policy"))?;
        let old = self.catalogue.get(&request.model)?;
        let path = request.path.clone();
        let new = self.serve(request.path, Some(old.spec.name.clone())).await?;
        if let SwapPolicy::Unspecified | SwapPolicy::Replay = policy {
            same_interface(&path, &old.spec, &new.spec)?;
        }
        self.catalogue.put(Arc::clone(&new));
        let sessions = match policy {
            SwapPolicy::Drain => Vec::new(),
            _ => self.sessions_of(&new.spec.name),
        };
        let (mut moved, mut closed) = (0, 0);
        let mut moving = iter(sessions)
            .map(|session| {
                let (new, close) = (Arc::clone(&new), policy == SwapPolicy::Close);
                async move { (session.id, !close && self.migrate(&session, new).await) }
            })
            .buffer_unordered(TOGETHER);
        while let Some((id, has_moved)) = moving.next().await {
            if has_moved {
                moved += 1;
            } else if self.registry.close(id) {
                closed += 1;
            }
        }
        let (model, hash) = (&new.spec.name, &new.spec.hash);
        tracing::info!(model, hash, moved, closed, "model swapped");
        Ok(v1::SwapModelResponse {
            model: Some(self.describe(&new)),
            moved_sessions: moved,
            closed_sessions: closed,
        })
    }

    /// Serves a checkpoint file if it is another than the one that is served under its name; sessions that are open
    /// keep theirs. Returns whether it is.
    ///
    /// # Errors
    /// If it cannot be served. What is served stays as it is.
    pub async fn refresh_model(
        &self,
        checkpoints: Checkpoints,
        path: PathBuf,
        name: Option<String>,
    ) -> Result<bool, Error> {
        let _change = self.changing.lock().await;
        let (engine, served, shown) = (self.engine.clone(), self.catalogue.all(), path.clone());
        let fresh = aside(move || {
            let model = checkpoints.load(&path, name.as_deref()).map_err(|error| told(&error))?;
            let hash = model.world.spec().hash.clone();
            let same = |it: &Arc<ModelEntry>| it.spec.name == model.name && it.spec.hash == hash;
            if served.iter().any(same) {
                return Ok(None);
            }
            engine.serve(model).map(Some).map_err(|error| told(&error))
        });
        let fresh = fresh.await?.map_err(|reason: String| Error::BadCheckpoint {
            path: shown.display().to_string(),
            reason,
        })?;
        let changed = fresh.is_some();
        if let Some(model) = fresh {
            self.catalogue.put(model);
        }
        Ok(changed)
    }

    fn is_free(&self, name: &str) -> Result<(), Error> {
        if self.catalogue.all().iter().any(|model| model.spec.name == name) {
            return Err(Error::ModelExists { name: name.to_owned() });
        }
        Ok(())
    }

    /// Loads a checkpoint and makes its first steps, where that keeps nobody waiting.
    async fn serve(&self, path: String, name: Option<String>) -> Result<Arc<ModelEntry>, Error> {
        let (checkpoints, engine) = (self.checkpoints.clone(), self.engine.clone());
        let file = PathBuf::from(&path);
        let served = aside(move || {
            let model = checkpoints.load(&file, name.as_deref()).map_err(|error| told(&error))?;
            engine.serve(model).map_err(|error| told(&error))
        });
        served.await?.map_err(|reason| Error::BadCheckpoint { path, reason })
    }

    /// Sessions of all models that go or went by a name.
    fn sessions_of(&self, name: &str) -> Vec<Arc<Session>> {
        let of = |session: &Session| session.position().model.spec.name == name;
        self.registry.list(&self.owner, None, usize::MAX, Instant::now(), of)
    }

    /// Lets a model see what a session saw, and the session go over to it; false if that cannot be.
    async fn migrate(&self, session: &Session, model: Arc<ModelEntry>) -> bool {
        let _turn = session.turn.lock().await;
        let (before, history) = session.past();
        if before.model.id == model.id {
            return true;
        }
        let state = Arc::clone(&model.initial);
        let mut position = Position { model, state, ..before };
        let seen = history.replayable();
        match seen.first() {
            Some(first) => position.next_step = first.step,
            None if before.next_step > 0 => return false,
            None => {}
        }
        for seen in seen {
            match self.replayed(position, seen.frame, seen.action).await {
                Ok(next) => position = next,
                Err(error) => {
                    tracing::warn!(session = %session.id, %error, "session could not be replayed");
                    return false;
                }
            }
        }
        session.migrate(position);
        true
    }
}

/// Whether a model takes the images and actions of another.
fn same_interface(path: &str, old: &ModelSpec, new: &ModelSpec) -> Result<(), Error> {
    let told = |spec: &ModelSpec| {
        let actions: Vec<String> =
            spec.actions.iter().map(|action| format!("{} {}", action.name, action.unit)).collect();
        let (size, fitted) = (spec.image_size, spec.preprocess);
        format!("{size} x {size} pixels, {fitted:?}, actions [{}]", actions.join(", "))
    };
    let (found, expected) = (told(new), told(old));
    if found == expected {
        return Ok(());
    }
    let found = format!("{path}, a model of {found}");
    let expected = format!("a model of {expected}, or another policy");
    Err(Error::invalid("path", found, expected))
}
