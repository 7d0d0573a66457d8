//! A checkpoint for the program.

use std::path::{Path, PathBuf};

use gatsbi_models::{
    checkpoint::{AgentSlot, Checkpoint, FirstAction, Header, Precision, Provenance},
    config::presets,
    world_model::{ActionDimension, Preprocess},
};

/// Writes one with untrained weights of this seed into a folder.
pub(crate) fn checkpoint(folder: &Path, seed: u64) -> PathBuf {
    let action = |i: i32| ActionDimension {
        name: format!("a{i}"),
        unit: String::new(),
        offset: 0.0,
        scale: 1.0,
    };
    let header = Header {
        name: "tiny".to_owned(),
        model: presets::tiny(),
        agent_slot: Some(AgentSlot { index: 0, score: None }),
        actions: (0..7).map(action).collect(),
        preprocess: Preprocess::Stretch,
        frame_period: None,
        first_action: FirstAction::Neutral,
        provenance: Provenance { seed, ..Provenance::default() },
    };
    let path = folder.join("tiny.safetensors");
    Checkpoint::untrained(header, tch::Device::Cpu).save(&path, Precision::Half).unwrap();
    path
}
