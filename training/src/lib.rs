//! Training and evaluation of GATSBI world models.

pub mod adam;
pub mod clips;
pub mod evaluation;
pub mod events;
pub mod journal;
pub mod objective;
pub mod recipe;
pub mod saved;
pub mod trainer;
pub mod untrained;
