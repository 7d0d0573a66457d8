//! Writes a data-set folder: shards of some tens of megabytes and the manifest that lists them.
//!
//! A folder is whole at every moment. A shard gets its name when it is complete and on the disk, and counts once the manifest,
//! replaced last, lists it; a process that is killed loses the episodes since the last [`DatasetWriter::commit`] and nothing
//! else. So a generator resumes with [`DatasetWriter::append`] and asks [`DatasetWriter::contains`] what it need not make again.
//! A conversion that is worth nothing unless it is complete uses [`write_whole`].

use std::{
    collections::HashSet,
    fs::TryLockError,
    path::{Path, PathBuf},
};

use crate::{
    Dataset, DatasetInfo, Episode, Error, Manifest, Result, pending::sync_folder,
    shard::ShardWriter,
};

/// How shards are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WriterOptions {
    /// A shard is closed when it has grown to this many bytes.
    pub shard_bytes: usize,
    /// zstd level, 1 to 22. Measured on 64x64 simulator frames against level 3: 9 takes about twice the processor time and
    /// saves an eighth of the size, 19 takes eighty times as long and saves three tenths.
    pub zstd_level: i32,
}

/// Writes episodes into a folder that no other writer holds.
#[derive(Debug)]
pub struct DatasetWriter {
    dir: PathBuf,
    /// Holds the folder's advisory lock until the writer is dropped.
    _lock: fs_err::File,
    manifest: Manifest,
    /// Episodes of the shards that the manifest lists.
    ids: HashSet<u64>,
    shard: Option<ShardWriter>,
    options: WriterOptions,
}

/// Creates folder `dir` with everything that `fill` writes, or not at all: it is built beside its place and then renamed.
///
/// # Errors
/// Those of [`DatasetWriter::create`] and of `fill`.
pub fn write_whole(
    dir: &Path,
    info: DatasetInfo,
    options: WriterOptions,
    fill: impl FnOnce(&mut DatasetWriter) -> Result<()>,
) -> Result<Manifest> {
    make_whole(dir, |built| {
        let mut writer = DatasetWriter::create(built, info, options)?;
        fill(&mut writer)?;
        writer.finish()
    })
}

/// Creates folder `dir` with everything that `build` puts into the folder it is given, or not at all.
pub(crate) fn make_whole<T>(dir: &Path, build: impl FnOnce(&Path) -> Result<T>) -> Result<T> {
    if dir.exists() {
        is_empty(dir)?;
    }
    let parent = match dir.parent() {
        Some(parent) if parent != Path::new("") => parent,
        _ => Path::new("."),
    };
    fs_err::create_dir_all(parent)?;
    // What is built is a folder inside the temporary one, which only its maker may enter.
    let staging = tempfile::Builder::new().prefix(".gatsbi-episodes-").tempdir_in(parent)?;
    let built = staging.path().join("built");
    fs_err::create_dir(&built)?;
    let made = build(&built)?;
    fs_err::rename(&built, dir)?;
    sync_folder(parent)?;
    Ok(made)
}

impl Default for WriterOptions {
    /// 32 MiB, level 3.
    fn default() -> Self {
        Self { shard_bytes: 32 << 20, zstd_level: 3 }
    }
}

impl DatasetWriter {
    /// Starts an empty data set in `dir`, which is created if it is not there.
    ///
    /// # Errors
    /// [`Error::Description`] for an invalid `info`, [`Error::NotEmpty`] if the folder holds anything, [`Error::Locked`].
    pub fn create(dir: &Path, info: DatasetInfo, options: WriterOptions) -> Result<Self> {
        info.validate()?;
        fs_err::create_dir_all(dir)?;
        let lock = lock(dir)?;
        is_empty(dir)?;
        let manifest = Manifest::new(info);
        manifest.write(dir)?;
        sync_folder(dir)?;
        let (dir, ids) = (dir.to_path_buf(), HashSet::new());
        Ok(Self { dir, _lock: lock, manifest, ids, shard: None, options })
    }

    /// Opens an existing data set to add shards to it.
    ///
    /// # Errors
    /// [`Error::Locked`], and those of [`Dataset::open`].
    pub fn append(dir: &Path, options: WriterOptions) -> Result<Self> {
        let lock = lock(dir)?;
        let manifest = Manifest::read(dir)?;
        let ids = Dataset::open(dir)?.summaries()?.iter().map(|episode| episode.id).collect();
        Ok(Self { dir: dir.to_path_buf(), _lock: lock, manifest, ids, shard: None, options })
    }

    /// The description that all episodes must fit.
    pub fn info(&self) -> &DatasetInfo {
        &self.manifest.dataset
    }

    /// Whether an episode of this id was written, now or before.
    pub fn contains(&self, episode_id: u64) -> bool {
        let open = self.shard.as_ref().is_some_and(|shard| shard.ids().contains(&episode_id));
        open || self.ids.contains(&episode_id)
    }

    /// Adds an episode. It is kept for good once its shard is committed, when that is full or by [`DatasetWriter::commit`].
    ///
    /// # Errors
    /// [`Error::Rejected`] if it does not fit the description, [`Error::Duplicate`] if its id is taken: the data set is as it
    /// was. [`Error::Write`] and [`Error::Io`] if the disk fails: the episodes since the last commit are lost.
    pub fn write(&mut self, episode: &Episode) -> Result<()> {
        let (data, path) = (episode.data(), || self.dir.clone());
        let episode_id = data.episode_id;
        data.check(self.info()).map_err(|source| Error::Rejected {
            path: path(),
            episode_id,
            source,
        })?;
        if self.contains(episode_id) {
            return Err(Error::Duplicate { path: path(), episode_id });
        }
        let mut shard = match self.shard.take() {
            Some(shard) => shard,
            None => ShardWriter::create(&self.next_path(), self.info(), self.options.zstd_level)?,
        };
        shard.write(data)?;
        let full = shard.bytes() >= self.options.shard_bytes;
        self.shard = Some(shard);
        if full { self.commit() } else { Ok(()) }
    }

    /// Closes the shard being written, if there is one, and lists it in the manifest.
    ///
    /// # Errors
    /// [`Error::Write`] or [`Error::Io`] if the disk fails: the episodes since the last commit are lost.
    pub fn commit(&mut self) -> Result<()> {
        let Some(shard) = self.shard.take() else { return Ok(()) };
        let (entry, ids) = shard.commit()?;
        let mut manifest = self.manifest.clone();
        manifest.push(entry);
        sync_folder(&self.dir)?;
        manifest.write(&self.dir)?;
        sync_folder(&self.dir)?;
        self.manifest = manifest;
        self.ids.extend(ids);
        Ok(())
    }

    /// Commits what is open and returns the manifest as it is on the disk. A writer that is dropped instead leaves the data set
    /// as of its last commit.
    ///
    /// # Errors
    /// Those of [`DatasetWriter::commit`].
    pub fn finish(mut self) -> Result<Manifest> {
        self.commit()?;
        Ok(self.manifest)
    }

    fn next_path(&self) -> PathBuf {
        let shards = &self.manifest.shards;
        let unused = |name: &String| shards.iter().all(|shard| shard.file != *name);
        let mut names = (shards.len()..).map(|i| format!("episodes-{i:05}.parquet"));
        self.dir.join(names.find(unused).unwrap_or_default())
    }
}

fn is_empty(dir: &Path) -> Result<()> {
    if fs_err::read_dir(dir)?.next().is_some() {
        return Err(Error::NotEmpty { path: dir.to_path_buf() });
    }
    Ok(())
}

/// Takes the advisory lock of a folder; it ends with the file handle, however the process ends.
fn lock(dir: &Path) -> Result<fs_err::File> {
    let handle = fs_err::File::open(dir)?;
    match handle.file().try_lock() {
        Ok(()) => Ok(handle),
        Err(TryLockError::WouldBlock) => Err(Error::Locked { path: dir.to_path_buf() }),
        Err(TryLockError::Error(source)) => Err(source.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        InvalidEpisode,
        testing::{episode, info},
    };

    const SMALL: WriterOptions = WriterOptions { shard_bytes: 1, zstd_level: 3 };

    fn names(dir: &Path) -> Vec<String> {
        let entries = fs_err::read_dir(dir).unwrap();
        let mut names: Vec<_> =
            entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn shards_roll_over_and_the_manifest_counts_them() {
        let dir = tempfile::tempdir().unwrap();
        let mut writer = DatasetWriter::create(dir.path(), info(), SMALL).unwrap();
        for id in 0..3 {
            writer.write(&episode(id, 4 + id as u32, 2)).unwrap();
        }
        let manifest = writer.finish().unwrap();
        assert_eq!(manifest, Manifest::read(dir.path()).unwrap());
        assert_eq!((manifest.episodes, manifest.frames, manifest.shards.len()), (3, 15, 3));
        assert_eq!(
            names(dir.path()),
            [
                "episodes-00000.parquet",
                "episodes-00001.parquet",
                "episodes-00002.parquet",
                "manifest.json"
            ]
        );
        Dataset::open(dir.path()).unwrap().verify().unwrap();
    }

    #[test]
    fn a_dropped_writer_leaves_what_was_committed_and_append_goes_on() {
        let dir = tempfile::tempdir().unwrap();
        let mut writer =
            DatasetWriter::create(dir.path(), info(), WriterOptions::default()).unwrap();
        writer.write(&episode(7, 4, 2)).unwrap();
        writer.commit().unwrap();
        writer.write(&episode(8, 4, 2)).unwrap();
        assert!(writer.contains(8));
        drop(writer);
        assert_eq!(names(dir.path()), ["episodes-00000.parquet", "manifest.json"]);

        let mut writer = DatasetWriter::append(dir.path(), WriterOptions::default()).unwrap();
        assert!(writer.contains(7) && !writer.contains(8));
        let again = writer.write(&episode(7, 5, 2));
        assert!(matches!(again, Err(Error::Duplicate { episode_id: 7, .. })), "{again:?}");
        writer.write(&episode(8, 5, 2)).unwrap();
        let again = writer.write(&episode(8, 5, 2));
        assert!(matches!(again, Err(Error::Duplicate { episode_id: 8, .. })), "{again:?}");
        assert_eq!(writer.finish().unwrap().frames, 9);
        assert_eq!(Dataset::open(dir.path()).unwrap().read(1).unwrap().id(), 8);
    }

    #[test]
    fn what_a_killed_process_left_does_not_count() {
        let dir = tempfile::tempdir().unwrap();
        let mut writer = DatasetWriter::create(dir.path(), info(), SMALL).unwrap();
        writer.write(&episode(0, 4, 2)).unwrap();
        drop(writer);
        // Killed while writing the next shard, or after naming it but before the manifest listed it.
        for leftover in [".episodes-00001.parquet.partial", "episodes-00001.parquet"] {
            fs_err::write(dir.path().join(leftover), "half a file").unwrap();
        }
        assert_eq!(Dataset::open(dir.path()).unwrap().len(), 1);
        let mut writer = DatasetWriter::append(dir.path(), SMALL).unwrap();
        writer.write(&episode(1, 4, 2)).unwrap();
        writer.finish().unwrap();
        assert_eq!(
            names(dir.path()),
            ["episodes-00000.parquet", "episodes-00001.parquet", "manifest.json"]
        );
        assert_eq!(Dataset::open(dir.path()).unwrap().read(1).unwrap().id(), 1);
    }

    #[test]
    fn one_writer_at_a_time() {
        let dir = tempfile::tempdir().unwrap();
        let writer = DatasetWriter::create(dir.path(), info(), SMALL).unwrap();
        let second = DatasetWriter::append(dir.path(), SMALL);
        assert!(matches!(second, Err(Error::Locked { .. })), "{second:?}");
        drop(writer);
        DatasetWriter::append(dir.path(), SMALL).unwrap();
        let anew = DatasetWriter::create(dir.path(), info(), SMALL);
        assert!(matches!(anew, Err(Error::NotEmpty { .. })), "{anew:?}");
    }

    #[test]
    fn an_episode_of_another_data_set_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let mut wide = info();
        wide.width = 5;
        let mut writer = DatasetWriter::create(dir.path(), wide, SMALL).unwrap();
        match writer.write(&episode(3, 4, 2)) {
            Err(Error::Rejected { episode_id: 3, source, .. }) => assert!(
                matches!(source, InvalidEpisode::Length { column: "rgb", .. }),
                "{source:?}"
            ),
            other => panic!("{other:?}"),
        }
        assert_eq!(writer.finish().unwrap().episodes, 0);
        assert!(Dataset::open(dir.path()).unwrap().is_empty());
    }

    #[test]
    fn write_whole_is_all_or_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("a/b");
        let failed = write_whole(&out, info(), SMALL, |writer| {
            writer.write(&episode(0, 4, 2))?;
            writer.write(&episode(0, 4, 2))
        });
        assert!(matches!(failed, Err(Error::Duplicate { .. })), "{failed:?}");
        assert_eq!(names(&dir.path().join("a")), [""; 0]);

        let fill = |writer: &mut DatasetWriter| writer.write(&episode(0, 4, 2));
        assert_eq!(write_whole(&out, info(), SMALL, fill).unwrap().episodes, 1);
        assert_eq!(names(&dir.path().join("a")), ["b"]);
        assert_eq!(names(&out), ["episodes-00000.parquet", "manifest.json"]);
        let again = write_whole(&out, info(), SMALL, fill);
        assert!(matches!(again, Err(Error::NotEmpty { .. })), "{again:?}");
    }
}
