//! One Parquet file of episodes: written with one row group per episode, read one row at a time.
//!
//! Files are opened anew for each read: descriptors share their offset when cloned, and prefetching threads read the same
//! shard at once. The footer is parsed once, when the shard is opened.

use std::{
    collections::HashSet,
    fmt::Write as _,
    io::{self, Write},
    ops::Range,
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
};

use arrow_array::RecordBatch;
use parquet::{
    arrow::{
        ArrowWriter, ProjectionMask,
        arrow_reader::{ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReaderBuilder},
    },
    basic::{Compression, ZstdLevel},
    errors::ParquetError,
    file::{
        metadata::KeyValue,
        properties::{EnabledStatistics, WriterProperties},
    },
    schema::types::ColumnPath,
};
use sha2::{Digest as _, Sha256};

use crate::{
    DatasetInfo, EpisodeData, Error, Result,
    manifest::ShardEntry,
    pending::PendingFile,
    schema::{
        ACTION_CONVENTION, COLUMNS, FORMAT, FORMAT_VERSION, arrow_schema, column, is_read_type,
        key, read_type,
    },
    table::{decode, encode},
};

/// A shard being written; it has no name until [`ShardWriter::commit`].
#[derive(Debug)]
pub(crate) struct ShardWriter {
    path: PathBuf,
    writer: ArrowWriter<Hashed>,
    ids: HashSet<u64>,
    frames: u64,
}

/// A shard that can be read.
#[derive(Debug)]
pub(crate) struct Shard {
    path: PathBuf,
    metadata: ArrowReaderMetadata,
    info: DatasetInfo,
    /// Index of each row group's first row, and the number of rows at the end.
    row_starts: Vec<usize>,
}

/// Hexadecimal SHA-256 of a file.
pub(crate) fn sha256_of(path: &Path) -> io::Result<String> {
    let mut hasher = Sha256::new();
    io::copy(&mut fs_err::File::open(path)?, &mut HashOnly(&mut hasher))?;
    Ok(hex(&hasher.finalize()))
}

// === impl ShardWriter ===

impl ShardWriter {
    pub(crate) fn create(path: &Path, info: &DatasetInfo, zstd_level: i32) -> Result<Self> {
        let failed = |source| Error::Write { path: path.to_path_buf(), source };
        let properties = properties(info, zstd_level).map_err(failed)?;
        let file = Hashed { file: PendingFile::create(path)?, hasher: Sha256::new(), bytes: 0 };
        let writer =
            ArrowWriter::try_new(file, arrow_schema(), Some(properties)).map_err(failed)?;
        Ok(Self { path: path.to_path_buf(), writer, ids: HashSet::new(), frames: 0 })
    }

    /// Appends a row, which becomes a row group of its own.
    pub(crate) fn write(&mut self, episode: &EpisodeData) -> Result<()> {
        let batch = encode(episode).map_err(ParquetError::from);
        batch
            .and_then(|batch| self.writer.write(&batch))
            .map_err(|source| Error::Write { path: self.path.clone(), source })?;
        self.ids.insert(episode.episode_id);
        self.frames += u64::from(episode.length);
        Ok(())
    }

    pub(crate) fn ids(&self) -> &HashSet<u64> {
        &self.ids
    }

    pub(crate) fn bytes(&self) -> usize {
        self.writer.bytes_written()
    }

    /// Completes the file and gives it its name.
    pub(crate) fn commit(self) -> Result<(ShardEntry, HashSet<u64>)> {
        let Self { path, writer, ids, frames } = self;
        let done = writer.into_inner();
        let done = done.map_err(|source| Error::Write { path: path.clone(), source })?;
        let Hashed { file, hasher, bytes } = done;
        file.commit()?;
        let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let entry = ShardEntry {
            file,
            episodes: ids.len() as u64,
            frames,
            bytes,
            sha256: hex(&hasher.finalize()),
        };
        Ok((entry, ids))
    }
}

fn properties(info: &DatasetInfo, zstd_level: i32) -> Result<WriterProperties, ParquetError> {
    let description = serde_json::to_string(info).map_err(|e| ParquetError::External(e.into()))?;
    let entry = |key: &str, value: String| KeyValue::new(key.to_owned(), value);
    // Statistics are useful for finding an episode, and only bytes to carry for pixels and floats.
    Ok(WriterProperties::builder()
        .set_compression(Compression::ZSTD(ZstdLevel::try_new(zstd_level)?))
        .set_dictionary_enabled(false)
        .set_max_row_group_row_count(Some(1))
        .set_statistics_enabled(EnabledStatistics::None)
        .set_column_statistics_enabled(
            ColumnPath::from(column::EPISODE_ID),
            EnabledStatistics::Chunk,
        )
        .set_key_value_metadata(Some(vec![
            entry(key::FORMAT, FORMAT.to_owned()),
            entry(key::FORMAT_VERSION, FORMAT_VERSION.to_string()),
            entry(key::ACTION_CONVENTION, ACTION_CONVENTION.to_owned()),
            entry(key::DATASET, description),
        ]))
        .build())
}

// === impl Shard ===

impl Shard {
    /// Reads the footer and checks that the file is one of this format.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let file = fs_err::File::open(path)?;
        let options = ArrowReaderOptions::new().with_skip_arrow_metadata(true);
        let metadata = guarded(|| ArrowReaderMetadata::load(file.file(), options))
            .map_err(|source| Error::NotParquet { path: path.to_path_buf(), source })?;
        let info = read_info(path, &metadata)?;
        check_columns(path, &metadata)?;
        let mut row_starts = vec![0_usize];
        for group in metadata.metadata().row_groups() {
            // A damaged footer may claim any number of rows.
            let start = row_starts[row_starts.len() - 1];
            row_starts.push(start.saturating_add(group.num_rows().max(0) as usize));
        }
        Ok(Self { path: path.to_path_buf(), metadata, info, row_starts })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    pub(crate) fn info(&self) -> &DatasetInfo {
        &self.info
    }

    pub(crate) fn rows(&self) -> usize {
        self.row_starts[self.row_starts.len() - 1]
    }

    /// Compressed bytes of each column of the format, in column order; 0 for a column that is not there.
    pub(crate) fn column_bytes(&self) -> [u64; COLUMNS.len()] {
        let mut bytes = [0_u64; COLUMNS.len()];
        for group in self.metadata.metadata().row_groups() {
            for chunk in group.columns() {
                let root = chunk.column_path().parts().first();
                if let Some(i) = COLUMNS.iter().position(|c| root.is_some_and(|r| r == c.name)) {
                    bytes[i] = bytes[i].saturating_add(chunk.compressed_size().max(0) as u64);
                }
            }
        }
        bytes
    }

    /// Reads row `row`, which must be there: one row group of the file at most.
    pub(crate) fn read(&self, row: usize) -> Result<EpisodeData> {
        let names = COLUMNS.map(|c| c.name);
        let batch = self.decode(row, &names).map_err(|e| self.blame(row..row + 1, &names, e))?;
        decode(&batch, 0).map_err(|source| Error::Row { path: self.path.clone(), row, source })
    }

    /// Reads some columns of all rows.
    pub(crate) fn scan(&self, names: &[&'static str]) -> Result<Vec<RecordBatch>> {
        let builder = self.builder(names)?;
        let batches = guarded(|| Ok(builder.build()?.collect::<Result<_, _>>()?));
        batches.map_err(|source| {
            self.blame(0..self.rows(), names, self.decode_error(0, names, source))
        })
    }

    fn decode(&self, row: usize, names: &[&'static str]) -> Result<RecordBatch> {
        let group = self.row_starts.partition_point(|&start| start <= row) - 1;
        let builder = self
            .builder(names)?
            .with_row_groups(vec![group])
            .with_offset(row - self.row_starts[group])
            .with_limit(1);
        let batch = guarded(|| match builder.build()?.next() {
            Some(batch) => Ok(batch?),
            None => Err(ParquetError::EOF("the row group has fewer rows than stated".into())),
        });
        batch.map_err(|source| self.decode_error(row, names, source))
    }

    fn decode_error(&self, row: usize, names: &[&'static str], source: ParquetError) -> Error {
        Error::Decode { path: self.path.clone(), row, column: names[0], source }
    }

    /// The first cell that cannot be decoded by itself: reading many together fails without saying which.
    fn blame(&self, mut rows: Range<usize>, names: &[&'static str], error: Error) -> Error {
        rows.find_map(|row| names.iter().find_map(|&name| self.decode(row, &[name]).err()))
            .unwrap_or(error)
    }

    fn builder(&self, names: &[&str]) -> Result<ParquetRecordBatchReaderBuilder<std::fs::File>> {
        let file = fs_err::File::open(&self.path)?.into_file();
        let columns = self.metadata.parquet_schema();
        let mask = ProjectionMask::columns(columns, names.iter().copied());
        Ok(ParquetRecordBatchReaderBuilder::new_with_metadata(file, self.metadata.clone())
            .with_projection(mask))
    }
}

/// Runs a part of the Parquet reader, which panics on some damaged pages, and makes that an error like the others. The panic
/// hook still reports it.
pub(crate) fn guarded<T>(
    read: impl FnOnce() -> Result<T, ParquetError>,
) -> Result<T, ParquetError> {
    catch_unwind(AssertUnwindSafe(read)).unwrap_or_else(|panic| {
        let text = panic.downcast::<String>().map_or_else(
            |panic| panic.downcast::<&str>().map_or_else(|_| String::new(), |s| s.to_string()),
            |text| *text,
        );
        Err(ParquetError::General(format!("the reader panicked: {text}")))
    })
}

fn read_info(path: &Path, metadata: &ArrowReaderMetadata) -> Result<DatasetInfo> {
    let entries = metadata.metadata().file_metadata().key_value_metadata();
    let value = |key: &'static str| {
        let entry = entries.into_iter().flatten().find(|entry| entry.key == key);
        let value = entry.and_then(|entry| entry.value.as_deref());
        value.ok_or_else(|| Error::Foreign { path: path.to_path_buf(), key })
    };
    let malformed = |what| move |source| Error::Metadata { path: path.to_path_buf(), what, source };
    if value(key::FORMAT)? != FORMAT {
        return Err(Error::Foreign { path: path.to_path_buf(), key: key::FORMAT });
    }
    let version = value(key::FORMAT_VERSION)?;
    let found: u64 = serde_json::from_str(version).map_err(malformed("format version"))?;
    if found > FORMAT_VERSION {
        let path = path.to_path_buf();
        return Err(Error::NewerVersion { path, found, supported: FORMAT_VERSION });
    }
    let info: DatasetInfo =
        serde_json::from_str(value(key::DATASET)?).map_err(malformed("data-set description"))?;
    info.validate()?;
    Ok(info)
}

fn check_columns(path: &Path, metadata: &ArrowReaderMetadata) -> Result<()> {
    for column in COLUMNS {
        match metadata.schema().field_with_name(column.name) {
            Ok(field) if is_read_type(column.kind, field.data_type()) => {}
            Ok(field) => {
                let (found, expected) = (field.data_type().to_string(), read_type(column.kind));
                let (path, expected) = (path.to_path_buf(), expected.to_string());
                return Err(Error::ColumnType { path, column: column.name, found, expected });
            }
            Err(_) if column.required => {
                let path = path.to_path_buf();
                return Err(Error::MissingColumn { path, column: column.name });
            }
            Err(_) => {}
        }
    }
    Ok(())
}

// === hashing ===

/// Counts and hashes what goes into the file, so that it need not be read again.
#[derive(Debug)]
struct Hashed {
    file: PendingFile,
    hasher: Sha256,
    bytes: u64,
}

impl Write for Hashed {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        let written = self.file.write(buf)?;
        self.hasher.update(&buf[..written]);
        self.bytes += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

struct HashOnly<'a>(&'a mut Sha256);

impl Write for HashOnly<'_> {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        self.0.update(buf);
        Ok(buf.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Bytes as two lower-case digits each.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        write!(text, "{byte:02x}").ok();
        text
    })
}
