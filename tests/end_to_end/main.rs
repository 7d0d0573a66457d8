//! The whole: the server's own process, the Rust client, the command line and plain HTTP, each as its users have it.
//!
//! What the server answers to whom is tested in its own crate, without a process; here is what only shows when programs
//! meet: [`episode`] (every way in gives the same), [`ending`] (restarts and shutdowns), [`mistakes`] (bad input through
//! every door), [`access`] (keys and certificates), [`command_line`]. [`programs`] builds and starts them; nothing here measures time.

#![expect(clippy::unwrap_used, reason = "what fails here fails the test")]

mod access;
mod command_line;
mod ending;
mod episode;
mod mistakes;
mod programs;
mod recording;
