//! What models there are.

use std::{collections::BTreeMap, sync::Arc};

use gatsbi_models::world_model::{ActionDimension, Preprocess};
use gatsbi_proto::v1;
use parking_lot::RwLock;

use super::Service;
use crate::{engine::models::ModelEntry, error::Error};

/// The models that new sessions can have, by name. Sessions may be on others that went by the same name before.
#[derive(Debug)]
pub(super) struct Catalogue {
    models: RwLock<BTreeMap<String, Arc<ModelEntry>>>,
}

impl Catalogue {
    pub(super) fn new(models: Vec<Arc<ModelEntry>>) -> Self {
        let models = models.into_iter().map(|model| (model.spec.name.clone(), model)).collect();
        Self { models: RwLock::new(models) }
    }

    /// A model by name; without a name the only one.
    pub(super) fn get(&self, name: &str) -> Result<Arc<ModelEntry>, Error> {
        let models = self.models.read();
        if let (true, 1, Some(model)) = (name.is_empty(), models.len(), models.values().next()) {
            return Ok(Arc::clone(model));
        }
        let served = || models.keys().cloned().collect::<Vec<_>>();
        if name.is_empty() {
            let expected = match models.len() {
                0 => "the name of a model: none is served now".to_owned(),
                _ => format!("one of {}", served().join(", ")),
            };
            return Err(Error::invalid("model", "empty", expected));
        }
        models.get(name).cloned().ok_or_else(|| {
            let name = name.chars().take(128).collect();
            Error::UnknownModel { name, served: served() }
        })
    }

    /// Adds a model, in place of one with the same name.
    pub(super) fn put(&self, model: Arc<ModelEntry>) {
        self.models.write().insert(model.spec.name.clone(), model);
    }

    /// Takes a model out.
    pub(super) fn remove(&self, name: &str) {
        self.models.write().remove(name);
    }

    /// The models, by name.
    pub(super) fn all(&self) -> Vec<Arc<ModelEntry>> {
        self.models.read().values().cloned().collect()
    }
}

impl Service {
    /// All models.
    pub fn list_models(&self) -> v1::ListModelsResponse {
        let models = self.catalogue.all();
        let models = models.iter().map(|model| self.describe(model)).collect();
        v1::ListModelsResponse { models }
    }

    /// One model.
    ///
    /// # Errors
    /// If it is not served.
    pub fn get_model(&self, request: &v1::GetModelRequest) -> Result<v1::GetModelResponse, Error> {
        let model = self.describe(&*self.catalogue.get(&request.model)?);
        Ok(v1::GetModelResponse { model: Some(model) })
    }

    pub(super) fn describe(&self, model: &ModelEntry) -> v1::Model {
        let spec = &model.spec;
        let action = |action: &ActionDimension| v1::ActionDimension {
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
}
