//! The two skins over [`crate::service`]: gRPC and REST. Neither decides anything.

pub mod admin;
pub(crate) mod call;
mod counted;
mod form;
pub mod grpc;
pub mod json;
pub mod openapi;
pub mod problem;
pub mod rest;
