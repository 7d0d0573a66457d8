//! Training and evaluation of GATSBI world models.

pub mod untrained;
