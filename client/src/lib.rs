//! The Rust client of the world-model service: typed calls over gRPC, repeated where that is safe.
//!
//! It knows the wire (`gatsbi-proto`) and nothing of models or servers, and links no torch. The same crate holds the
//! command line `gatsbi`, behind the feature `cli`, which is on by default.
//!
//! Where to start:
//! - [`Client`]: a connection; models, and sessions to open, find and list. [`Options`]: waiting and repeating.
//! - [`Session`]: observe, imagine, delete. [`ObserveStream`]: the same as a control loop over one stream.
//! - [`Belief`], [`Rollout`], [`Outputs`]: what comes back, in buffers of its own.
//! - [`Error`] and [`Problem`]: what was wrong, in which field, and whether trying again may help.
//!
//! What has no method here yet (forks, scores, plans) can be called through [`proto`].
//!
//! ```no_run
//! use gatsbi_client::{Actions, Client, Image, Imagination, NewSession, Observation, Output, Selection};
//!
//! # async fn camera(_: u64) -> Vec<u8> { vec![0; 64 * 64 * 3] }
//! # async fn example() -> gatsbi_client::Result<()> {
//! let client = Client::connect("http://127.0.0.1:50051").await?;
//! let session = client.create_session(NewSession::default()).await?;
//! let dimension = client.model(&session.info().model).await?.actions.len();
//!
//! // Each tick of the control loop: what the camera sees, and the action that led to it.
//! let mut stream = session.observe_stream(&Selection::of([Output::Objects]));
//! let mut action = Vec::new(); // nothing led to the first frame
//! for step in 0..50 {
//!     let image = Some(Image::rgb(64, 64, camera(step).await)?);
//!     let belief = stream.observe(Observation { step, image, action }).await?;
//!     for object in belief.present() {
//!         println!("object {} is at {:.2}, {:.2}", object.id, object.x, object.y);
//!     }
//!
//!     // What will happen if: two candidates, ten steps ahead.
//!     let candidates = [vec![vec![0.0; dimension]; 10], vec![vec![0.1; dimension]; 10]];
//!     let what_if = Imagination::of(
//!         Actions::nested(&candidates)?,
//!         Selection::of([Output::Objects]).last_only(),
//!     );
//!     let rollout = session.imagine(what_if).await?.gather().await?;
//!     let tracks = rollout.outputs.tracks().expect("objects were asked for");
//!     assert_eq!(tracks.values.shape()[..3], [1, 2, 1]); // samples, candidates, depths
//!     action = candidates[0][0].clone();
//! }
//! session.delete().await
//! # }
//! ```

mod access;
mod belief;
mod client;
mod error;
mod output;
mod request;
mod rollout;
mod session;
mod stream;

pub use access::{ApiKey, Tls};
pub use belief::Belief;
pub use client::{Client, NewSession, Options, Retries};
pub use error::{Code, Error, FieldProblem, Problem, Result};
/// The messages themselves.
pub use gatsbi_proto::v1 as proto;
pub use gatsbi_proto::v1::{
    ActionDimension, Encoding, Mode, Model, Object, Output, Session as SessionInfo, Timing,
};
pub use output::{Array, Numbers, Outputs, Pngs, Tracks, Value};
pub use request::{Actions, Image, Imagination, Observation, Sampling, Selection};
pub use rollout::{Rollout, RolloutChunk, RolloutStream};
pub use session::Session;
pub use stream::ObserveStream;
