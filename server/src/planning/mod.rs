//! Planning: which actions are best. Pure functions, without engine or wire traffic, usable in-process.
//!
//! [`cost`] reads a cost program and measures imagined steps, [`search`] proposes actions and learns from their costs,
//! [`noise`] is what it draws. The use cases over them are in [`crate::service`].

pub mod cost;
pub mod noise;
pub mod search;
