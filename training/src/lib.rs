//! Training and evaluation of GATSBI world models.

pub mod ablation;
pub mod adam;
pub mod agent_slot;
pub mod clips;
pub mod dynamics;
pub mod evaluation;
pub mod events;
pub mod journal;
pub mod objective;
pub mod recipe;
pub mod saved;
pub mod trainer;
pub mod untrained;
pub mod variant;
