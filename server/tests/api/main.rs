//! The service through its two APIs: a real server with a real, untrained model, and real clients.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

mod errors;
mod failures;
mod invariance;
mod load;
mod observe;
mod rollouts;
mod sessions;
mod support;
