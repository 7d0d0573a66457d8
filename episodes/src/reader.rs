//! Reads a data set: one Parquet file, or a folder with its manifest.
//!
//! [`Dataset::read`] decodes one row group and nothing else; [`Dataset::summaries`] and [`Dataset::action_statistics`] never touch
//! pixels. A data set can be shared by threads. For training there is [`crate::Prefetch`], which reads ahead in the background.

use std::path::{Path, PathBuf};

use crate::{
    DatasetInfo, Episode, Error, InvalidEpisode, Manifest, Result,
    schema::{COLUMNS, column as c},
    shard::{Shard, hex, sha256_of},
    table::Rows,
};

/// An open data set: the footers of its files, and where each episode is.
#[derive(Debug)]
pub struct Dataset {
    path: PathBuf,
    info: DatasetInfo,
    manifest: Option<Manifest>,
    shards: Vec<Shard>,
    /// Index of each shard's first episode, and the number of episodes at the end.
    starts: Vec<usize>,
}

/// What is known of an episode without decoding it.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct EpisodeSummary {
    /// Position in the data set.
    pub index: usize,
    /// Id.
    pub id: u64,
    /// `T`
    pub length: usize,
    /// `N`, where it is recorded.
    pub object_count: Option<u32>,
    /// The generator's seed, where it is recorded.
    pub seed: Option<u64>,
    /// Hash of the simulator's states in hexadecimal, where it is recorded.
    pub state_hash: Option<String>,
}

impl Dataset {
    /// Opens a `.parquet` file or a data-set folder: reads all footers, no rows.
    ///
    /// # Errors
    /// Says which file is truncated, foreign, newer than this build, without a column or with one of another type; for a folder
    /// also [`Error::NoManifest`], and [`Error::ShardChanged`] if a shard is not as the manifest says.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        if !fs_err::metadata(path)?.is_dir() {
            let shard = Shard::open(path)?;
            return Ok(Self::of(path, shard.info().clone(), None, vec![shard]));
        }
        let manifest = Manifest::read(path)?;
        let mut shards = Vec::new();
        for entry in &manifest.shards {
            let file = path.join(&entry.file);
            agrees(&file, "the size in bytes", &fs_err::metadata(&file)?.len(), &entry.bytes)?;
            let shard = Shard::open(&file)?;
            agrees(&file, "the number of episodes", &(shard.rows() as u64), &entry.episodes)?;
            if *shard.info() != manifest.dataset {
                let [found, expected] = [shard.info(), &manifest.dataset].map(|i| format!("{i:?}"));
                let what = "the data-set description";
                return Err(Error::ShardChanged { path: file, what, found, expected });
            }
            shards.push(shard);
        }
        let (info, episodes) = (manifest.dataset.clone(), manifest.episodes);
        let dataset = Self::of(path, info, Some(manifest), shards);
        agrees(path, "the total of episodes", &(dataset.len() as u64), &episodes)?;
        Ok(dataset)
    }

    /// The file or folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The description of the data set.
    pub fn info(&self) -> &DatasetInfo {
        &self.info
    }

    /// The manifest of a folder; `None` for a single file.
    pub fn manifest(&self) -> Option<&Manifest> {
        self.manifest.as_ref()
    }

    /// Number of episodes.
    pub fn len(&self) -> usize {
        self.starts[self.starts.len() - 1]
    }

    /// Whether there are no episodes.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Reads the episode at `index`, counted from 0 in writing order.
    ///
    /// # Errors
    /// [`Error::OutOfRange`], [`Error::Decode`] for a damaged page, [`Error::Row`] for a row that is no valid episode.
    pub fn read(&self, index: usize) -> Result<Episode> {
        let len = self.len();
        if index >= len {
            return Err(Error::OutOfRange { index, len });
        }
        let (shard, row) = self.locate(index);
        Episode::new(shard.read(row)?, &self.info).map_err(|source| self.row_error(index, source))
    }

    /// All episodes in order, each read when it is asked for.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = Result<Episode>> {
        (0..self.len()).map(|index| self.read(index))
    }

    /// Ids, lengths and object counts of all episodes, without decoding pixels or actions.
    ///
    /// # Errors
    /// [`Error::Decode`] for a damaged page, [`Error::Row`] for a null.
    pub fn summaries(&self) -> Result<Vec<EpisodeSummary>> {
        let mut summaries = Vec::new();
        let columns = [c::EPISODE_ID, c::LENGTH, c::OBJECT_COUNT, c::STATE_HASH, c::SEED];
        self.scan(&columns, |cells, row| {
            let null = |column| InvalidEpisode::Null { column };
            summaries.push(EpisodeSummary {
                index: summaries.len(),
                id: cells.u64(c::EPISODE_ID, row).ok_or_else(|| null(c::EPISODE_ID))?,
                length: cells.u32(c::LENGTH, row).ok_or_else(|| null(c::LENGTH))? as usize,
                object_count: cells.u32(c::OBJECT_COUNT, row),
                seed: cells.u64(c::SEED, row),
                state_hash: cells.hash(c::STATE_HASH, row).map(|hash| hex(&hash)),
            });
            Ok(())
        })?;
        Ok(summaries)
    }

    /// Compressed bytes of each column in the files, in the order of the schema; columns that hold nothing are left out.
    pub fn column_bytes(&self) -> Vec<(&'static str, u64)> {
        let mut total = COLUMNS.map(|column| (column.name, 0));
        for shard in &self.shards {
            for ((_, sum), bytes) in total.iter_mut().zip(shard.column_bytes()) {
                *sum = bytes.saturating_add(*sum);
            }
        }
        total.into_iter().filter(|&(_, bytes)| bytes > 0).collect()
    }

    /// Reads every byte: compares the checksums and totals of a folder with its manifest and decodes all episodes.
    ///
    /// # Errors
    /// The first difference or damage found.
    pub fn verify(&self) -> Result<()> {
        let entries = self.manifest.iter().flat_map(|manifest| &manifest.shards);
        for (shard, entry) in self.shards.iter().zip(entries) {
            let found = sha256_of(shard.path())?;
            agrees(shard.path(), "the SHA-256", &found, &entry.sha256)?;
        }
        let mut frames = 0;
        for episode in self.iter() {
            frames += episode?.length() as u64;
        }
        match &self.manifest {
            Some(manifest) => agrees(&self.path, "the total of frames", &frames, &manifest.frames),
            None => Ok(()),
        }
    }

    /// Hands each row of all shards to `visit`, with only the named columns decoded.
    pub(crate) fn scan(
        &self,
        columns: &[&'static str],
        mut visit: impl FnMut(&Rows<'_>, usize) -> Result<(), InvalidEpisode>,
    ) -> Result<()> {
        for shard in &self.shards {
            let mut rows = 0;
            for batch in shard.scan(columns)? {
                for row in 0..batch.num_rows() {
                    visit(&Rows(&batch), row).map_err(|source| Error::Row {
                        path: shard.path().to_path_buf(),
                        row: rows + row,
                        source,
                    })?;
                }
                rows += batch.num_rows();
            }
        }
        Ok(())
    }

    /// Says where an invalid episode is. `index` must be in range.
    pub(crate) fn row_error(&self, index: usize, source: InvalidEpisode) -> Error {
        let (shard, row) = self.locate(index);
        Error::Row { path: shard.path().to_path_buf(), row, source }
    }

    fn locate(&self, index: usize) -> (&Shard, usize) {
        let number = self.starts.partition_point(|&start| start <= index) - 1;
        (&self.shards[number], index - self.starts[number])
    }

    fn of(path: &Path, info: DatasetInfo, manifest: Option<Manifest>, shards: Vec<Shard>) -> Self {
        let mut starts = vec![0_usize];
        for shard in &shards {
            starts.push(starts[starts.len() - 1].saturating_add(shard.rows()));
        }
        Self { path: path.to_path_buf(), info, manifest, shards, starts }
    }
}

fn agrees<T: PartialEq + ToString>(
    path: &Path,
    what: &'static str,
    found: &T,
    expected: &T,
) -> Result<()> {
    if found == expected {
        return Ok(());
    }
    let (found, expected) = (found.to_string(), expected.to_string());
    Err(Error::ShardChanged { path: path.to_path_buf(), what, found, expected })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        DatasetWriter, WriterOptions,
        testing::{episode, info},
    };

    fn written(lengths: &[u32], shard_bytes: usize) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        let options = WriterOptions { shard_bytes, zstd_level: 3 };
        let mut writer = DatasetWriter::create(dir.path(), info(), options).unwrap();
        for (id, &length) in lengths.iter().enumerate() {
            writer.write(&episode(id as u64 + 10, length, id as u32 % 3)).unwrap();
        }
        writer.finish().unwrap();
        dir
    }

    #[test]
    fn episodes_are_found_by_index_across_shards() {
        // One shard of all, shards of one, and shards of a few.
        for shard_bytes in [1 << 20, 1, 8000] {
            let dir = written(&[3, 1, 4, 1, 5], shard_bytes);
            let dataset = Dataset::open(dir.path()).unwrap();
            assert_eq!(*dataset.info(), info());
            assert_eq!(dataset.len(), 5);
            for index in [4, 0, 2, 3, 1] {
                let read = dataset.read(index).unwrap();
                let expected = episode(index as u64 + 10, [3, 1, 4, 1, 5][index], index as u32 % 3);
                assert_eq!(format!("{read:?}"), format!("{expected:?}"));
            }
            let ids: Vec<_> = dataset.iter().map(|episode| episode.unwrap().id()).collect();
            assert_eq!(ids, [10, 11, 12, 13, 14]);
            let out_of_range = dataset.read(5);
            assert!(matches!(out_of_range, Err(Error::OutOfRange { index: 5, len: 5 })));
            dataset.verify().unwrap();
        }
    }

    #[test]
    fn summaries_agree_with_the_episodes() {
        let dir = written(&[3, 1, 4, 1, 5], 8000);
        let dataset = Dataset::open(dir.path()).unwrap();
        for summary in dataset.summaries().unwrap() {
            let episode = dataset.read(summary.index).unwrap();
            assert_eq!((summary.id, summary.length), (episode.id(), episode.length()));
            assert_eq!(summary.object_count, episode.data().object_count);
            assert_eq!(summary.seed, episode.data().seed);
        }
    }

    #[test]
    fn a_shard_is_a_data_set_of_its_own() {
        let dir = written(&[3, 1], 1);
        let dataset = Dataset::open(dir.path().join("episodes-00001.parquet")).unwrap();
        assert_eq!((dataset.len(), dataset.read(0).unwrap().id()), (1, 11));
        assert!(dataset.manifest().is_none());
        dataset.verify().unwrap();
    }

    #[test]
    fn all_columns_have_bytes() {
        let dir = written(&[3, 1], 1);
        let bytes = Dataset::open(dir.path()).unwrap().column_bytes();
        assert_eq!(bytes.len(), COLUMNS.len(), "{bytes:?}");
    }
}
