//! The format: its version, the description of a data set that every file carries, and the columns of the table.
//!
//! One row is one episode, one row group holds one row, so that reading an episode touches nothing else. Pixels are raw `u8`
//! in zstd pages, lossless: measured on 64x64 simulator frames they are as small as any other lossless container and open in
//! pandas, Polars and `DuckDB` without a plugin.
//!
//! Letters: `T` frames, `H` height, `W` width, `C` = 3 channels (red, green, blue), `A` action dimensions (0 where nobody acts), `N` objects,
//! `J` joints. All arrays are row-major with the last axis fastest. Lengths are metres, world frame; quaternions are w, x, y, z.
//!
//! | column | Parquet / Arrow type | null | contents |
//! |---|---|---|---|
//! | `episode_id` | `uint64` | no | unique within the data set, kept by `split`, given anew by `join` |
//! | `length` | `uint32` | no | `T` >= 1 |
//! | `rgb` | `large_binary` | no | `[T,H,W,C]` u8 |
//! | `actions` | `list<float32>` | no | `[T,A]`, finite, units in the description; [`ACTION_CONVENTION`] |
//! | `mask` | `large_binary` | yes | `[T,H,W]` u8 label map, see [`LabelLegend`] |
//! | `object_count` | `uint32` | yes | `N`; required by the `object_*` and `contacts_*` columns |
//! | `object_positions` | `list<float32>` | yes | `[T,N,3]` metres, NaN = not in the scene |
//! | `object_pixels` | `list<float32>` | yes | `[T,N,2]` x right, y down; 0 is the centre of the first pixel, NaN = not in the scene |
//! | `object_poses` | `list<float32>` | yes | `[T,N,4]` orientation quaternion, NaN = not in the scene |
//! | `ee_pose` | `list<float32>` | yes | `[T,7]` end effector: position, then quaternion |
//! | `joint_positions` | `list<float32>` | yes | `[T,J]` radians (metres where the joint slides) |
//! | `contacts_agent` | `large_binary` | yes | `[T,N]` 0 or 1: the agent touched the object after the previous frame, up to this one |
//! | `contacts_objects` | `large_binary` | yes | `[T,N,N]` 0 or 1, the same between two objects |
//! | `state_hash` | `fixed_size_binary(32)` | yes | hash of the simulator's states, to compare runs across machines |
//! | `seed` | `uint64` | yes | what the generator needs to make the episode again |
//!
//! Key-value metadata of the file: `gatsbi.format` = `gatsbi.episodes`, `gatsbi.format_version` = `1`,
//! `gatsbi.action_convention`, and `gatsbi.dataset`, a [`DatasetInfo`] as JSON. A reader ignores columns and JSON fields it does
//! not know, so both may be added within a version; anything else raises the version, and a newer version is refused.

use std::{collections::BTreeMap, sync::Arc};

use arrow_schema::{DataType, Field, Schema};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::{Error, Result};

/// Value of the metadata key `gatsbi.format`.
pub const FORMAT: &str = "gatsbi.episodes";
/// Version that is written, and the newest that is read.
pub const FORMAT_VERSION: u64 = 1;
/// What the rows of `actions` mean, also written into every file.
pub const ACTION_CONVENTION: &str =
    "action t is the command held between frame t and frame t+1, in the physical units stated";
/// Largest byte size of one column of one episode: a Parquet page counts its bytes in 31 bits.
pub const MAX_COLUMN_BYTES: usize = 1 << 30;

/// Largest height and width in pixels.
const MAX_SIDE: u32 = 8192;

/// Description of a data set, the same in all its files.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DatasetInfo {
    /// Short name, for example `push1`.
    pub name: String,
    /// `H`, pixels.
    pub height: u32,
    /// `W`, pixels.
    pub width: u32,
    /// `C`; version 1 of the format stores RGB, 3.
    pub channels: u32,
    /// Seconds between two frames.
    pub frame_period_seconds: f64,
    /// The `A` dimensions of an action, in order; none where nobody acts.
    pub actions: Vec<ActionDimension>,
    /// What the values of `mask` stand for; `None` where they are not described.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub labels: Option<LabelLegend>,
    /// Where the data came from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub provenance: Option<Provenance>,
}

/// One dimension of an action.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ActionDimension {
    /// For example `panda_joint1`.
    pub name: String,
    /// Physical unit, for example `rad/s`.
    pub unit: String,
}

/// Values of the label map: object `i` of the episode has label `first_object + i`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LabelLegend {
    /// Everything that never moves by itself or by the robot, the robot's fixed base included.
    pub background: u8,
    /// The robot's moving links and gripper.
    pub agent: u8,
    /// The first object.
    pub first_object: u8,
}

/// What made the data, as far as it is known.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Program, simulator or robot.
    pub generator: String,
    /// Its version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub version: Option<String>,
    /// The file it was imported from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<String>,
    /// Anything else worth keeping: generator configuration, checksums.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub parameters: BTreeMap<String, serde_json::Value>,
}

impl Default for LabelLegend {
    /// Background 0, agent 1, objects from 2.
    fn default() -> Self {
        Self { background: 0, agent: 1, first_object: 2 }
    }
}

impl LabelLegend {
    /// Most objects that labels of one byte can tell apart.
    pub fn max_objects(&self) -> u32 {
        256 - u32::from(self.first_object)
    }
}

impl DatasetInfo {
    /// Bytes of one frame, `H*W*C`.
    pub fn frame_bytes(&self) -> usize {
        self.pixels() * self.channels as usize
    }

    /// Pixels of one frame, `H*W`.
    pub fn pixels(&self) -> usize {
        self.height as usize * self.width as usize
    }

    /// `A`, the dimension of an action.
    pub fn action_dimension(&self) -> usize {
        self.actions.len()
    }

    /// The first part in which this description is not `other`: its name, its value here and there, as JSON.
    pub fn difference(&self, other: &Self) -> Option<(String, String, String)> {
        let [a, b] = [self, other].map(|info| serde_json::to_value(info).unwrap_or_default());
        (a != b).then(|| first_difference("description", &a, &b))
    }

    /// Checks that the description is one the format can hold.
    ///
    /// # Errors
    /// [`Error::Description`] with the first field that is not.
    pub fn validate(&self) -> Result<()> {
        let fail =
            |field, found: String, expected| Err(Error::Description { field, found, expected });
        if self.name.is_empty() {
            return fail("name", "empty".into(), "a short name");
        }
        for (field, side) in [("height", self.height), ("width", self.width)] {
            if !(1..=MAX_SIDE).contains(&side) {
                return fail(field, side.to_string(), "1 to 8192 pixels");
            }
        }
        if self.channels != 3 {
            return fail("channels", self.channels.to_string(), "3 (red, green, blue)");
        }
        if !(self.frame_period_seconds.is_finite() && self.frame_period_seconds > 0.0) {
            let found = self.frame_period_seconds.to_string();
            return fail("frame_period_seconds", found, "a positive number of seconds");
        }
        if let Some(labels) = self.labels
            && (labels.background == labels.agent
                || labels.first_object <= labels.background.max(labels.agent))
        {
            let found = format!("{labels:?}");
            return fail("labels", found, "two different labels below the first object's");
        }
        Ok(())
    }
}

/// Names of the columns.
pub mod column {
    /// `episode_id`
    pub const EPISODE_ID: &str = "episode_id";
    /// `length`
    pub const LENGTH: &str = "length";
    /// `rgb`
    pub const RGB: &str = "rgb";
    /// `actions`
    pub const ACTIONS: &str = "actions";
    /// `mask`
    pub const MASK: &str = "mask";
    /// `object_count`
    pub const OBJECT_COUNT: &str = "object_count";
    /// `object_positions`
    pub const OBJECT_POSITIONS: &str = "object_positions";
    /// `object_pixels`
    pub const OBJECT_PIXELS: &str = "object_pixels";
    /// `object_poses`
    pub const OBJECT_POSES: &str = "object_poses";
    /// `ee_pose`
    pub const EE_POSE: &str = "ee_pose";
    /// `joint_positions`
    pub const JOINT_POSITIONS: &str = "joint_positions";
    /// `contacts_agent`
    pub const CONTACTS_AGENT: &str = "contacts_agent";
    /// `contacts_objects`
    pub const CONTACTS_OBJECTS: &str = "contacts_objects";
    /// `state_hash`
    pub const STATE_HASH: &str = "state_hash";
    /// `seed`
    pub const SEED: &str = "seed";
}

/// Metadata keys of a file.
pub(crate) mod key {
    pub(crate) const FORMAT: &str = "gatsbi.format";
    pub(crate) const FORMAT_VERSION: &str = "gatsbi.format_version";
    pub(crate) const ACTION_CONVENTION: &str = "gatsbi.action_convention";
    pub(crate) const DATASET: &str = "gatsbi.dataset";
}

/// How a column is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    U64,
    U32,
    /// Raw bytes.
    Bytes,
    /// A list of 32-bit floats.
    Floats,
    /// 32 bytes.
    Hash,
}

/// One column of the table.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Column {
    pub(crate) name: &'static str,
    pub(crate) kind: Kind,
    pub(crate) required: bool,
}

/// The columns in file order.
pub(crate) const COLUMNS: [Column; 15] = {
    use column as c;
    const fn required(name: &'static str, kind: Kind) -> Column {
        Column { name, kind, required: true }
    }
    const fn nullable(name: &'static str, kind: Kind) -> Column {
        Column { name, kind, required: false }
    }
    [
        required(c::EPISODE_ID, Kind::U64),
        required(c::LENGTH, Kind::U32),
        required(c::RGB, Kind::Bytes),
        required(c::ACTIONS, Kind::Floats),
        nullable(c::MASK, Kind::Bytes),
        nullable(c::OBJECT_COUNT, Kind::U32),
        nullable(c::OBJECT_POSITIONS, Kind::Floats),
        nullable(c::OBJECT_PIXELS, Kind::Floats),
        nullable(c::OBJECT_POSES, Kind::Floats),
        nullable(c::EE_POSE, Kind::Floats),
        nullable(c::JOINT_POSITIONS, Kind::Floats),
        nullable(c::CONTACTS_AGENT, Kind::Bytes),
        nullable(c::CONTACTS_OBJECTS, Kind::Bytes),
        nullable(c::STATE_HASH, Kind::Hash),
        nullable(c::SEED, Kind::U64),
    ]
};

/// The Arrow schema that is written.
pub(crate) fn arrow_schema() -> Arc<Schema> {
    let field = |c: &Column| Field::new(c.name, written_type(c.kind), !c.required);
    Arc::new(Schema::new(COLUMNS.iter().map(field).collect::<Vec<_>>()))
}

/// The item of a float list, named as the Parquet specification names it.
pub(crate) fn float_item() -> Arc<Field> {
    Arc::new(Field::new("element", DataType::Float32, false))
}

/// Whether a column read without Arrow hints has the type of the format. Only what Parquet itself stores counts, so that files
/// of other writers are read too: the names and nullability of list items do not matter.
pub(crate) fn is_read_type(kind: Kind, found: &DataType) -> bool {
    match (kind, found) {
        (Kind::Floats, DataType::List(item)) => *item.data_type() == DataType::Float32,
        (Kind::Floats, _) => false,
        _ => *found == read_type(kind),
    }
}

/// The type a column is expected to have when read without Arrow hints.
pub(crate) fn read_type(kind: Kind) -> DataType {
    match kind {
        Kind::Bytes => DataType::Binary,
        kind => written_type(kind),
    }
}

fn written_type(kind: Kind) -> DataType {
    match kind {
        Kind::U64 => DataType::UInt64,
        Kind::U32 => DataType::UInt32,
        Kind::Bytes => DataType::LargeBinary,
        Kind::Floats => DataType::List(float_item()),
        Kind::Hash => DataType::FixedSizeBinary(32),
    }
}

fn first_difference(name: &str, a: &Value, b: &Value) -> (String, String, String) {
    if let (Value::Object(a), Value::Object(b)) = (a, b) {
        let names = a.keys().chain(b.keys());
        let null = Value::Null;
        let values = |name| (a.get(name).unwrap_or(&null), b.get(name).unwrap_or(&null));
        for name in names {
            let (a, b) = values(name);
            if a != b {
                return first_difference(name, a, b);
            }
        }
    }
    (name.into(), a.to_string(), b.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::info;

    #[track_caller]
    fn rejects(change: impl FnOnce(&mut DatasetInfo), expected_field: &str) {
        let mut info = info();
        change(&mut info);
        match info.validate() {
            Err(Error::Description { field, .. }) => assert_eq!(field, expected_field),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn descriptions_are_checked() {
        info().validate().unwrap();
        rejects(|i| i.name.clear(), "name");
        rejects(|i| i.height = 0, "height");
        rejects(|i| i.width = 9000, "width");
        rejects(|i| i.channels = 1, "channels");
        rejects(|i| i.frame_period_seconds = f64::NAN, "frame_period_seconds");
        rejects(|i| i.frame_period_seconds = 0.0, "frame_period_seconds");
        rejects(|i| i.labels.as_mut().unwrap().agent = 0, "labels");
        rejects(|i| i.labels.as_mut().unwrap().first_object = 1, "labels");
    }

    #[test]
    fn unknown_description_fields_are_ignored() {
        let mut json = serde_json::to_value(info()).unwrap();
        json["camera"] = "front".into();
        assert_eq!(serde_json::from_value::<DatasetInfo>(json).unwrap(), info());
    }
}
