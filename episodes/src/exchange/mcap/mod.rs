//! MCAP: a log of messages by topic, one file a recording, as ROS 2 and Foxglove keep them.
//!
//! Written are frames as `foxglove.CompressedImage` (protobuf, PNG) on `/camera` and actions as JSON on `/action`; Foxglove
//! and Rerun show both. The frames' channel carries the description of the data set and the id of the episode in its
//! metadata, which makes the way back exact. Read are those, `foxglove.RawImage`, and ROS 2's images and commands
//! ([`message`]).

mod cdr;
mod container;
mod import;
mod message;
mod writer;

use serde::{Deserialize, Serialize};

pub use import::{McapSource, import_mcap};
pub use writer::{McapWriter, export_mcap};

const CAMERA_TOPIC: &str = "/camera";
const ACTION_TOPIC: &str = "/action";
/// Keys of the frames' channel metadata: a [`crate::DatasetInfo`] as JSON, and a number.
const DATASET_KEY: &str = "gatsbi.dataset";
const EPISODE_KEY: &str = "gatsbi.episode_id";

/// A message on the topic of actions.
#[derive(Debug, Serialize, Deserialize)]
struct Action {
    /// In the units of the description.
    values: Vec<f32>,
}
