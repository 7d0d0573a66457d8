//! Checkpoint files: from a path to a model that can be served.

use std::path::{Path, PathBuf};

use gatsbi_models::{
    checkpoint::CheckpointError, gatsbi::world::GatsbiWorld, world_model::WorldModel as _,
};
use tch::Device;

use crate::engine::models::LoadedModel;

/// Extension of checkpoint files.
const EXTENSION: &str = "safetensors";

/// Where checkpoints come from, and where they go.
#[derive(Clone, Debug)]
pub struct Checkpoints {
    /// Where relative paths start; the working directory if absent.
    pub folder: Option<PathBuf>,
    /// Where models compute.
    pub device: Device,
}

impl Checkpoints {
    /// Loads a checkpoint with the card beside it, under a name or its own.
    ///
    /// # Errors
    /// [`CheckpointError`] says what is wrong with the file.
    pub fn load(&self, path: &Path, name: Option<&str>) -> Result<LoadedModel, CheckpointError> {
        let path = match &self.folder {
            Some(folder) => folder.join(path),
            None => path.to_owned(),
        };
        let world = GatsbiWorld::load(&path, self.device)?;
        let spec = world.spec();
        let name = name.map_or_else(|| spec.name.clone(), str::to_owned);
        tracing::info!(model = name, hash = spec.hash, steps = spec.trained_steps, "model loaded");
        let card = fs_err::read_to_string(path.with_extension("md")).unwrap_or_default();
        Ok(LoadedModel { world: Box::new(world), name, card })
    }

    /// The checkpoints in the folder, by name; none without a folder.
    ///
    /// # Errors
    /// If the folder cannot be read.
    pub fn found(&self) -> std::io::Result<Vec<PathBuf>> {
        let Some(folder) = &self.folder else { return Ok(Vec::new()) };
        let entries = fs_err::read_dir(folder)?;
        let paths: std::io::Result<Vec<PathBuf>> =
            entries.map(|entry| Ok(entry?.file_name().into())).collect();
        let mut paths = paths?;
        paths.retain(|path| path.extension().is_some_and(|extension| extension == EXTENSION));
        paths.sort();
        Ok(paths)
    }
}
