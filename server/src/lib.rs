//! The service: sessions of robots, batched onto one model thread, over gRPC and REST.
//!
//! A request comes in through [`api`], becomes a use case of [`service`], finds its session in [`sessions`], and is
//! computed by [`engine`]. [`app`] puts it all together, [`config`] says with which sizes, [`error`] what can go
//! wrong, [`telemetry`] what is counted; [`access`] who may do what, [`listener`] and [`tls`] how they come in. People look
//! through [`dashboard`] and [`pictures`]. Read [`service`] first, then [`engine`].
//!
//! What models compute is not known here, only that they observe and imagine ([`gatsbi_models::world_model`]).

pub mod access;
pub mod api;
pub mod app;
pub mod bounds;
pub mod checkpoints;
pub mod config;
pub mod dashboard;
pub mod engine;
pub mod error;
pub mod frame;
pub mod listener;
pub mod logs;
pub mod media;
pub mod pictures;
pub mod planning;
pub mod reload;
pub mod service;
pub mod sessions;
pub mod telemetry;
pub mod tensor;
pub mod tls;
