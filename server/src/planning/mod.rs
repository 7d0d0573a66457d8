//! Planning: which actions are best. Pure functions, without engine or wire traffic, usable in-process.
//!
//! A [`cost`] program is applied to imagined steps by [`measure`] and to rollouts by [`scores`]; [`search`] proposes actions and learns from their costs,
//! [`noise`] is what it draws. The use cases over them are in [`crate::service`].

pub mod cost;
pub mod measure;
pub mod noise;
pub mod scores;
pub mod search;
