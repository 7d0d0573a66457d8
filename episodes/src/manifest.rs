//! `manifest.json` of a data-set folder: which shards belong to it and what they must contain.
//!
//! The manifest is what makes a folder a data set: it is replaced as the last step of every change, so a shard that it does not
//! list does not exist, whatever lies in the folder after a crash.

use std::{io::Write as _, path::Path};

use serde::{Deserialize, Deserializer, Serialize, de::Error as _};

use crate::{
    DatasetInfo, Error, Result,
    pending::PendingFile,
    schema::{FORMAT, FORMAT_VERSION, key},
};

/// Name of the manifest in its folder.
pub(crate) const FILE_NAME: &str = "manifest.json";

/// Contents of `manifest.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Always [`FORMAT`].
    pub format: String,
    /// Version of the format of all shards.
    pub format_version: u64,
    /// The description that every shard repeats.
    pub dataset: DatasetInfo,
    /// Episodes in all shards.
    pub episodes: u64,
    /// Frames in all shards.
    pub frames: u64,
    /// The shards in reading order.
    pub shards: Vec<ShardEntry>,
}

/// What a shard must be for the folder to be whole.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ShardEntry {
    /// Plain file name, for example `episodes-00000.parquet`.
    #[serde(deserialize_with = "plain_file_name")]
    pub file: String,
    /// Rows.
    pub episodes: u64,
    /// Sum of the rows' lengths.
    pub frames: u64,
    /// File size.
    pub bytes: u64,
    /// SHA-256 of the file, hexadecimal.
    pub sha256: String,
}

impl Manifest {
    /// An empty data set.
    pub(crate) fn new(dataset: DatasetInfo) -> Self {
        Self {
            format: FORMAT.into(),
            format_version: FORMAT_VERSION,
            dataset,
            episodes: 0,
            frames: 0,
            shards: Vec::new(),
        }
    }

    /// Reads the manifest of folder `dir`.
    ///
    /// # Errors
    /// [`Error::NoManifest`], [`Error::NewerVersion`], [`Error::Foreign`], or [`Error::Metadata`] for malformed JSON.
    pub fn read(dir: &Path) -> Result<Self> {
        #[derive(Deserialize)]
        struct Header {
            format: String,
            format_version: u64,
        }
        let path = dir.join(FILE_NAME);
        let text = match fs_err::read(&path) {
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
                return Err(Error::NoManifest { path: dir.to_path_buf() });
            }
            text => text?,
        };
        let malformed = |source| Error::Metadata { path: path.clone(), what: "manifest", source };
        let header: Header = serde_json::from_slice(&text).map_err(malformed)?;
        if header.format != FORMAT {
            return Err(Error::Foreign { path, key: key::FORMAT });
        }
        if header.format_version > FORMAT_VERSION {
            let (found, supported) = (header.format_version, FORMAT_VERSION);
            return Err(Error::NewerVersion { path, found, supported });
        }
        let manifest: Self = serde_json::from_slice(&text).map_err(malformed)?;
        manifest.dataset.validate()?;
        Ok(manifest)
    }

    /// Adds a shard to the list and the totals.
    pub(crate) fn push(&mut self, shard: ShardEntry) {
        self.episodes = self.episodes.saturating_add(shard.episodes);
        self.frames = self.frames.saturating_add(shard.frames);
        self.shards.push(shard);
    }

    /// Replaces the manifest of folder `dir`.
    pub(crate) fn write(&self, dir: &Path) -> Result<()> {
        let path = dir.join(FILE_NAME);
        let text = serde_json::to_vec_pretty(self).map_err(|source| Error::Metadata {
            path: path.clone(),
            what: "manifest",
            source,
        })?;
        let mut file = PendingFile::create(&path)?;
        file.write_all(&text)?;
        Ok(file.commit()?)
    }
}

/// A manifest from elsewhere must not make the reader leave the folder.
fn plain_file_name<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    let name = String::deserialize(deserializer)?;
    if Path::new(&name).file_name().is_none_or(|plain| plain != name.as_str()) {
        return Err(D::Error::custom(format!("`{name}` is not a plain file name")));
    }
    Ok(name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::info;

    fn write(json: &serde_json::Value) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        fs_err::write(dir.path().join(FILE_NAME), json.to_string()).unwrap();
        dir
    }

    fn valid() -> serde_json::Value {
        let mut manifest = Manifest::new(info());
        let (file, sha256) = ("episodes-00000.parquet".into(), "00".into());
        manifest.push(ShardEntry { file, episodes: 2, frames: 9, bytes: 100, sha256 });
        serde_json::to_value(manifest).unwrap()
    }

    #[test]
    fn a_manifest_survives_the_disk() {
        let dir = tempfile::tempdir().unwrap();
        let manifest: Manifest = serde_json::from_value(valid()).unwrap();
        manifest.write(dir.path()).unwrap();
        assert_eq!(Manifest::read(dir.path()).unwrap(), manifest);
        assert_eq!((manifest.episodes, manifest.frames), (2, 9));
    }

    #[test]
    fn bad_manifests_are_refused() {
        let empty = tempfile::tempdir().unwrap();
        assert!(matches!(Manifest::read(empty.path()), Err(Error::NoManifest { .. })));

        let mut json = valid();
        json["format_version"] = 2.into();
        json["shards"] = "laid out differently".into();
        let newer = Manifest::read(write(&json).path());
        assert!(matches!(newer, Err(Error::NewerVersion { found: 2, supported: 1, .. })));

        let mut json = valid();
        json["format"] = "zarr".into();
        assert!(matches!(Manifest::read(write(&json).path()), Err(Error::Foreign { .. })));

        for name in ["../episodes-00000.parquet", "/etc/passwd", "a/b", "..", ""] {
            let mut json = valid();
            json["shards"][0]["file"] = name.into();
            match Manifest::read(write(&json).path()) {
                Err(Error::Metadata { source, .. }) => {
                    assert!(source.to_string().contains("not a plain file name"), "{source}");
                }
                other => panic!("{name}: {other:?}"),
            }
        }
    }
}
