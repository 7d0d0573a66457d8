//! Neural world models on libtorch: GATSBI, its state, its noise and its checkpoints.
//!
//! A world model is a pair of pure functions: [`world_model::WorldModel::observe`] absorbs a frame and the
//! action that led to it into a session's state, [`world_model::WorldModel::imagine`] predicts the next step
//! under an action. Both return the new [`state::State`] and a [`scene::Scene`], the decomposition into agent,
//! background and objects, computed only as far as asked for.
//!
//! Start with [`world_model`], then [`gatsbi::world`], which puts the contract around [`gatsbi::model`].
//! Sizes and switches are data ([`config`]) and travel with the weights ([`checkpoint`]); random numbers are
//! arguments ([`noise`]). Nothing here knows of servers, protocols or training schedules.

pub mod checkpoint;
pub mod config;
pub mod gatsbi;
pub mod idle;
mod kernels;
pub mod nn;
pub mod noise;
pub mod scene;
pub mod state;
pub mod world_model;
