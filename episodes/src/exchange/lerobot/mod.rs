//! LeRobotDataset v3.0: tables of frames, many episodes to a file, with pictures in the table or in videos beside it.
//!
//! | what | where |
//! |---|---|
//! | frame rate, features, paths | `meta/info.json`, an [`Info`] |
//! | where each episode is | `meta/episodes/chunk-000/file-000.parquet` |
//! | one row a frame | `data/chunk-000/file-000.parquet` |
//! | videos | `videos/KEY/chunk-000/file-000.mp4` |
//!
//! The action of a row is the command given at its frame, held until the next: our convention. An exported data set has a
//! file of its own besides, `meta/gatsbi.json`, a [`Sidecar`] that makes the way back exact; LeRobot does not look at it.

mod export;
mod import;
mod rows;
mod statistics;
mod video;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::{ActionDimension, DatasetInfo, Result, exchange::ImportProblem};

pub use export::export_lerobot;
pub use import::{LerobotSource, import_lerobot};

/// Features that every data set has, and that are no data of a robot.
const BOOKKEEPING: [&str; 5] = ["timestamp", "frame_index", "episode_index", "index", "task_index"];
const ACTION: &str = "action";
const IMAGE: &str = "observation.images.main";
const STATE: &str = "observation.state";
const EE_POSE: &str = "observation.ee_pose";

/// `meta/info.json`, as far as it matters here.
#[derive(Debug, Serialize, Deserialize)]
struct Info {
    codebase_version: String,
    fps: f64,
    features: BTreeMap<String, Feature>,
    #[serde(default = "default_data_path")]
    data_path: String,
    #[serde(default)]
    video_path: Option<String>,
    #[serde(flatten)]
    other: BTreeMap<String, Value>,
}

/// One column of the frames.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Feature {
    dtype: String,
    shape: Vec<u64>,
    /// A list of names, or lists of them by group.
    #[serde(default)]
    names: Value,
}

/// `meta/gatsbi.json`
#[derive(Debug, Serialize, Deserialize)]
struct Sidecar {
    dataset: DatasetInfo,
    episode_ids: Vec<u64>,
}

impl Info {
    fn read(root: &Path) -> Result<Self> {
        let path = root.join("meta/info.json");
        let info: Self = read_json(&path)?;
        let wrong = |what, found: String, expected: &str| {
            let expected = expected.into();
            Err(ImportProblem::Layout { what, found, expected }.at(&path, None, None))
        };
        if !info.codebase_version.starts_with("v3.") {
            let found = info.codebase_version.clone();
            return wrong(
                "`codebase_version`",
                found,
                "v3.x: convert older data sets with lerobot's own converter",
            );
        }
        if !(info.fps.is_finite() && info.fps > 0.0) {
            return wrong("`fps`", info.fps.to_string(), "a positive number");
        }
        Ok(info)
    }
}

impl Feature {
    fn is_picture(&self) -> bool {
        matches!(self.dtype.as_str(), "image" | "video")
    }

    fn is_vector(&self) -> bool {
        self.shape.len() == 1 && !self.is_picture() && self.dtype != "string"
    }

    /// Names of a vector's dimensions, where it has one for each.
    fn dimensions(&self) -> Vec<ActionDimension> {
        let mut names = Vec::new();
        collect(&self.names, &mut names);
        names.into_iter().map(|name| ActionDimension { name, unit: "unknown".into() }).collect()
    }

    /// Width and height: `[H,W,C]` in LeRobot's own data sets, `[C,H,W]` in some, told apart by their names.
    fn sides(&self) -> Option<(u32, u32)> {
        let &[a, b, c] = self.shape.as_slice() else { return None };
        let first_is_channels = match self.names.get(0).and_then(Value::as_str) {
            Some(name) => name.starts_with("channel") || name == "c",
            None => a == 3 && c != 3,
        };
        let (height, width) = if first_is_channels { (b, c) } else { (a, b) };
        Some((u32::try_from(width).ok()?, u32::try_from(height).ok()?))
    }
}

fn collect(names: &Value, found: &mut Vec<String>) {
    match names {
        Value::String(name) => found.push(name.clone()),
        Value::Array(parts) => parts.iter().for_each(|part| collect(part, found)),
        Value::Object(groups) => groups.values().for_each(|part| collect(part, found)),
        _ => {}
    }
}

fn default_data_path() -> String {
    "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet".into()
}

/// Fills a path template of `meta/info.json`.
fn fill(root: &Path, template: &str, key: &str, chunk: u64, file: u64) -> PathBuf {
    let numbered = [("chunk_index", chunk), ("file_index", file)].iter().fold(
        template.replace("{video_key}", key),
        |path, (name, value)| {
            path.replace(&format!("{{{name}:03d}}"), &format!("{value:03}"))
                .replace(&format!("{{{name}}}"), &value.to_string())
        },
    );
    root.join(numbered)
}

fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T> {
    let bytes = match fs_err::read(path) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
            let (what, expected) = ("such file".into(), "expected a LeRobotDataset v3".into());
            return Err(ImportProblem::Missing { what, expected }.at(path, None, None));
        }
        read => read?,
    };
    serde_json::from_slice(&bytes)
        .map_err(|e| ImportProblem::damaged("its JSON", e).at(path, None, None))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn sides_and_names_of_both_conventions() {
        let feature = |shape: &[u64], names: Value| Feature {
            dtype: "video".into(),
            shape: shape.to_vec(),
            names,
        };
        let last = feature(&[480, 640, 3], json!(["height", "width", "channels"]));
        assert_eq!(last.sides(), Some((640, 480)));
        let first = feature(&[3, 480, 640], json!(["channels", "height", "width"]));
        assert_eq!(first.sides(), Some((640, 480)));
        assert_eq!(feature(&[3, 480, 640], Value::Null).sides(), Some((640, 480)));
        let named = feature(&[2], json!({"motors": ["pan", "tilt"]}));
        let names: Vec<_> = named.dimensions().into_iter().map(|d| d.name).collect();
        assert_eq!(names, ["pan", "tilt"]);
    }

    #[test]
    fn paths_are_filled() {
        let template = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4";
        let path = fill(Path::new("root"), template, "observation.images.top", 1, 12);
        assert_eq!(path, Path::new("root/videos/observation.images.top/chunk-001/file-012.mp4"));
    }
}
