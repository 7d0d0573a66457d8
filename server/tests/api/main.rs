//! The service through its two APIs: a real server with a real, untrained model, and real clients.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

mod access;
mod document;
mod errors;
mod failures;
mod forks;
mod handles;
mod invariance;
mod knock;
mod leases;
mod load;
mod metrics;
mod mixes;
mod models;
mod observe;
mod pictures;
mod planning;
mod predictions;
mod quotas;
mod rollouts;
mod sessions;
mod snapshots;
mod support;
mod tls;
mod watching;
