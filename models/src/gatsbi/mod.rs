//! GATSBI (Min et al., CVPR 2021): a scene as active agent, static background and passive objects, and its
//! future under actions.
//!
//! [`model::Gatsbi`] is the whole; read its `observe` and `imagine`, then [`mixture`] (agent and background),
//! [`objects`], and [`keypoint`] (what tells which slot is the agent). [`world::GatsbiWorld`] serves it.

pub mod action;
pub mod keypoint;
pub mod loss;
pub mod mixture;
pub mod model;
pub mod objects;
pub mod world;
