//! Sessions: who is there, what each believes, and for how long it is kept.

pub mod registry;
