//! Beliefs as bytes: exported, and imported into a new session or one that is open.

use std::sync::Arc;

use bytes::Bytes;
use gatsbi_proto::v1;

use super::{Service, sessions::tell};
use crate::{
    engine::models::ModelEntry,
    error::Error,
    sessions::{
        session::{Position, Terms},
        snapshot::{self, Snapshot},
    },
};

impl Service {
    /// Gives a belief as bytes.
    ///
    /// # Errors
    /// If there is no such session, or it has moved.
    pub fn export_session(
        &self,
        request: &v1::ExportSessionRequest,
    ) -> Result<v1::ExportSessionResponse, Error> {
        let session = self.session(&request.session_id)?;
        let position = session.position();
        if request.at_step.is_some() {
            position.last(request.at_step)?;
        }
        let told = v1::Session { next_step: position.next_step, ..tell(&session) };
        Ok(v1::ExportSessionResponse { session: Some(told), snapshot: snapshot::write(&position) })
    }

    /// Restores a belief, with the step that it is at and the way it draws.
    ///
    /// # Errors
    /// If the bytes are no snapshot, or of a checkpoint that is not served or not the session's.
    pub async fn import_session(
        &self,
        request: v1::ImportSessionRequest,
    ) -> Result<v1::ImportSessionResponse, Error> {
        let snapshot = snapshot::read(&request.snapshot, "snapshot")?;
        let session = if request.session_id.is_empty() {
            let mut position =
                snapshot.position(self.model_of(&snapshot, "snapshot")?, "snapshot")?;
            position.draws.seed = request.seed.unwrap_or(position.draws.seed);
            let terms = Terms {
                owner: self.owner.clone(),
                label: request.label,
                ttl: self.ttl(request.ttl)?,
                keep_steps: request.keep_steps,
                keep_frames: request.keep_frames,
                latest_wins: request.latest_wins,
            };
            self.open(&terms, position)?
        } else {
            self.replace(request, snapshot).await?
        };
        Ok(v1::ImportSessionResponse { session: Some(session) })
    }

    /// Where a snapshot in a request is.
    pub(super) fn position_of(&self, bytes: &Bytes, field: &str) -> Result<Position, Error> {
        let snapshot = snapshot::read(bytes, field)?;
        snapshot.position(self.model_of(&snapshot, field)?, field)
    }

    async fn replace(
        &self,
        request: v1::ImportSessionRequest,
        snapshot: Snapshot,
    ) -> Result<v1::Session, Error> {
        for (given, field) in [
            (!request.label.is_empty(), "label"),
            (request.ttl.is_some(), "ttl"),
            (request.keep_steps > 0, "keep_steps"),
            (request.keep_frames > 0, "keep_frames"),
            (request.latest_wins, "latest_wins"),
        ] {
            if given {
                let expected = "absent: it replaces the belief of a session that is open";
                return Err(Error::invalid(field, "given", expected));
            }
        }
        let session = self.session(&request.session_id)?;
        let _turn = session.turn.lock().await;
        let model = session.position().model;
        if !snapshot.is_of(&model) {
            let expected = format!("the session is of {}", model.spec.hash);
            let field = "snapshot".to_owned();
            return Err(Error::ForeignSnapshot { field, found: snapshot.model_hash(), expected });
        }
        let mut position = snapshot.position(model, "snapshot")?;
        position.draws.seed = request.seed.unwrap_or(position.draws.seed);
        session.replace(position);
        tracing::info!(session = %session.id, "session replaced by a snapshot");
        Ok(tell(&session))
    }

    /// The model of a snapshot, whatever its name.
    fn model_of(&self, snapshot: &Snapshot, field: &str) -> Result<Arc<ModelEntry>, Error> {
        let models = self.catalogue.all();
        let model = models.into_iter().find(|model| snapshot.is_of(model));
        model.ok_or_else(|| Error::ForeignSnapshot {
            field: field.to_owned(),
            found: snapshot.model_hash(),
            expected: "which is not served here".to_owned(),
        })
    }
}
