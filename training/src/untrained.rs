//! Checkpoints with untrained weights: for trying the service, for tests, and as the start of training.

use gatsbi_models::{
    checkpoint::{AgentSlot, FirstAction, Header, Provenance},
    config::GatsbiConfig,
    world_model::{ActionDimension, Preprocess},
};

/// The header of an untrained model called `name`. Scenes with an agent get slot 0 for it, the only slot that
/// sees the action directly (decisions row 4).
pub fn header(name: &str, model: GatsbiConfig, actions: Vec<ActionDimension>, seed: u64) -> Header {
    let has_agent = model.action.dim > 0;
    Header {
        name: name.to_owned(),
        agent_slot: has_agent.then_some(AgentSlot { index: 0, score: None }),
        actions,
        preprocess: Preprocess::Stretch,
        frame_period: None,
        first_action: FirstAction::Neutral,
        provenance: Provenance { seed, ..Provenance::default() },
        model,
    }
}

/// Actions of `dim` dimensions without names, units or scaling.
pub fn plain_actions(dim: i64) -> Vec<ActionDimension> {
    (0..dim)
        .map(|i| ActionDimension {
            name: format!("a{i}"),
            unit: String::new(),
            offset: 0.0,
            scale: 1.0,
        })
        .collect()
}
