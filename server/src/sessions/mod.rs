//! Sessions: one robot's stream of observations each ([`session`]), those that are open ([`registry`]), and a belief
//! as bytes ([`snapshot`]).

pub mod live;
pub mod registry;
pub mod session;
pub mod snapshot;
