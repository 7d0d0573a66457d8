//! The wire of the service: package `gatsbi.v1`, the same messages on gRPC and, as proto3 JSON, on REST.
//!
//! Everything here is generated from `gatsbi/v1/*.proto`, whose comments are the reference of the API: start with
//! `session_service.proto` and `imagination_service.proto`. No logic lives here.

/// Version 1 of the API.
#[expect(clippy::allow_attributes, clippy::pedantic, reason = "generated code")]
pub mod v1 {
    tonic::include_proto!("gatsbi.v1");

    /// The descriptors of all files, an encoded `google.protobuf.FileDescriptorSet`.
    pub const FILE_DESCRIPTOR_SET: &[u8] = tonic::include_file_descriptor_set!("gatsbi");
}
