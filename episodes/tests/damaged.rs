//! Files that are broken, foreign or edited are refused with an error that says where.
#![expect(clippy::unwrap_used, reason = "helpers of tests")]

use std::{
    error::Error as _,
    num::NonZeroUsize,
    path::{Path, PathBuf},
    sync::Arc,
};

use arrow_array::{
    Array as _, ArrayRef, BinaryArray, Float64Array, RecordBatch, UInt32Array, UInt64Array,
    builder::{Float32Builder, ListBuilder},
};
use arrow_schema::{DataType, Field, Schema};
use gatsbi_episodes::{
    ActionDimension, Dataset, DatasetInfo, DatasetWriter, Episode, EpisodeData, Error,
    InvalidEpisode, LabelLegend, Prefetch, PrefetchOptions, WriterOptions,
};
use parquet::{
    arrow::ArrowWriter,
    file::{metadata::KeyValue, properties::WriterProperties},
};
use tempfile::TempDir;

const SHARD: &str = "episodes-00000.parquet";

fn info() -> DatasetInfo {
    let action = |name: &str| ActionDimension { name: name.into(), unit: "m/s".into() };
    DatasetInfo {
        name: "damaged".into(),
        height: 8,
        width: 8,
        channels: 3,
        frame_period_seconds: 0.1,
        actions: vec![action("x"), action("y")],
        labels: Some(LabelLegend::default()),
        provenance: None,
    }
}

/// Frames of noise, which zstd cannot shrink: a damaged byte is then a damaged pixel page, not a footer.
fn episode(episode_id: u64) -> Episode {
    let mut state = episode_id + 1;
    let mut noise = || {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 56) as u8
    };
    let data = EpisodeData {
        episode_id,
        length: 4,
        rgb: (0..4 * 8 * 8 * 3).map(|_| noise()).collect(),
        actions: (0..8_u8).map(f32::from).collect(),
        mask: Some((0..4 * 8 * 8).map(|_| noise() % 4).collect()),
        object_count: Some(2),
        ..EpisodeData::default()
    };
    Episode::new(data, &info()).unwrap()
}

/// A folder with one shard of three episodes.
fn folder() -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let mut writer = DatasetWriter::create(dir.path(), info(), WriterOptions::default()).unwrap();
    for id in 0..3 {
        writer.write(&episode(id)).unwrap();
    }
    writer.finish().unwrap();
    dir
}

fn shard(dir: &TempDir) -> PathBuf {
    dir.path().join(SHARD)
}

fn edit(path: &Path, change: impl FnOnce(&mut Vec<u8>)) {
    let mut bytes = fs_err::read(path).unwrap();
    change(&mut bytes);
    fs_err::write(path, bytes).unwrap();
}

/// Position of the second frame of episode `id` in the file: noise is stored as it is.
fn pixels_in(path: &Path, id: u64) -> usize {
    let (bytes, episode) = (fs_err::read(path).unwrap(), episode(id));
    bytes.windows(64).position(|window| *window == episode.frame(1)[..64]).unwrap()
}

// === whole files ===

#[test]
fn a_truncated_file_is_refused_wherever_it_ends() {
    let dir = folder();
    let whole = fs_err::read(shard(&dir)).unwrap();
    let file = dir.path().join("cut.parquet");
    for length in (0..whole.len()).step_by(97).chain([whole.len() - 1]) {
        fs_err::write(&file, &whole[..length]).unwrap();
        match Dataset::open(&file) {
            Err(Error::NotParquet { path, .. }) => assert_eq!(path, file),
            other => panic!("{length} of {} bytes: {other:?}", whole.len()),
        }
    }
}

#[test]
fn a_truncated_shard_disagrees_with_its_manifest() {
    let dir = folder();
    edit(&shard(&dir), |bytes| bytes.truncate(1000));
    match Dataset::open(dir.path()) {
        Err(Error::ShardChanged { path, found, .. }) => {
            assert_eq!((path, found.as_str()), (shard(&dir), "1000"));
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_missing_shard_is_named() {
    let dir = folder();
    fs_err::remove_file(shard(&dir)).unwrap();
    match Dataset::open(dir.path()) {
        Err(Error::Io(e)) => assert!(e.to_string().contains(SHARD), "{e}"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_folder_that_is_no_data_set_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    assert!(matches!(Dataset::open(dir.path()), Err(Error::NoManifest { .. })));
    let missing = dir.path().join("missing");
    assert!(matches!(Dataset::open(missing), Err(Error::Io(_))));
}

#[test]
fn a_damaged_page_fails_its_own_row_only() {
    let dir = folder();
    // Before the first frame lie its length and the header of the compressed page.
    let first_frame = pixels_in(&shard(&dir), 1) - info().frame_bytes();
    edit(&shard(&dir), |bytes| bytes[first_frame - 12..first_frame - 4].fill(0xff));
    let dataset = Dataset::open(dir.path()).unwrap();
    dataset.read(0).unwrap();
    dataset.read(2).unwrap();
    match dataset.read(1) {
        Err(Error::Decode { path, row: 1, column: "rgb", .. }) => assert_eq!(path, shard(&dir)),
        other => panic!("{other:?}"),
    }
    assert!(matches!(dataset.verify(), Err(Error::ShardChanged { what: "the SHA-256", .. })));

    let threads = NonZeroUsize::new(2).unwrap();
    let options =
        PrefetchOptions { shuffle: false, epochs: Some(2), threads, ..PrefetchOptions::default() };
    let good: Vec<_> =
        Prefetch::start(&Arc::new(dataset), options).unwrap().map(|clip| clip.is_ok()).collect();
    assert_eq!(good, [true, false, true, true, false, true]);
}

#[test]
fn a_damaged_page_of_a_listing_is_located() {
    let dir = folder();
    // The actions follow the pixels; these bytes are too few to be compressed.
    let (file, actions) = (shard(&dir), [4.0_f32, 5.0, 6.0, 7.0].map(f32::to_le_bytes));
    let bytes = fs_err::read(&file).unwrap();
    let hits: Vec<_> =
        (0..bytes.len() - 16).filter(|&at| bytes[at..at + 16] == *actions.as_flattened()).collect();
    assert_eq!(hits.len(), 3);
    edit(&file, |bytes| bytes[hits[2] - 30..hits[2] - 16].fill(0xff));
    let dataset = Dataset::open(dir.path()).unwrap();
    dataset.summaries().unwrap();
    match dataset.action_statistics() {
        Err(Error::Decode { row: 2, column: "actions", .. }) => {}
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_changed_pixel_is_found_by_its_checksum() {
    let dir = folder();
    let at = pixels_in(&shard(&dir), 1);
    edit(&shard(&dir), |bytes| bytes[at] ^= 1);
    let dataset = Dataset::open(dir.path()).unwrap();
    match dataset.verify() {
        Err(Error::ShardChanged { path, what: "the SHA-256", .. }) => assert_eq!(path, shard(&dir)),
        other => panic!("{other:?}"),
    }
}

#[test]
fn no_damaged_byte_makes_the_reader_panic() {
    let dir = folder();
    let whole = fs_err::read(shard(&dir)).unwrap();
    let file = dir.path().join("flipped.parquet");
    let (mut refused, mut read) = (0, 0);
    for at in (0..whole.len()).step_by(13) {
        let mut bytes = whole.clone();
        bytes[at] ^= [0x01, 0x80, 0xff][at % 9 / 3];
        fs_err::write(&file, &bytes).unwrap();
        let all = Dataset::open(&file).and_then(|dataset| {
            dataset.summaries()?;
            dataset.action_statistics()?;
            dataset.verify()
        });
        *if all.is_ok() { &mut read } else { &mut refused } += 1;
    }
    assert!(refused > 100 && read > 100, "{refused} refused, {read} read");
}

// === foreign and edited tables ===

/// A table as another program might write it: columns, then metadata.
struct Table {
    columns: Vec<(&'static str, ArrayRef)>,
    metadata: Vec<(&'static str, String)>,
}

fn list(values: &[Option<f32>]) -> ArrayRef {
    let mut list = ListBuilder::new(Float32Builder::new());
    list.append_value(values.iter().copied());
    Arc::new(list.finish())
}

impl Table {
    /// Valid, with none of the optional columns, and with small differences in types that Parquet does not store.
    fn valid() -> Self {
        let frame = vec![7_u8; 2 * info().frame_bytes()];
        Self {
            columns: vec![
                ("episode_id", Arc::new(UInt64Array::from(vec![5]))),
                ("length", Arc::new(UInt32Array::from(vec![2]))),
                ("rgb", Arc::new(BinaryArray::from(vec![frame.as_slice()]))),
                ("actions", list(&[Some(0.1), Some(0.2), Some(0.3), Some(0.4)])),
            ],
            metadata: vec![
                ("gatsbi.format", "gatsbi.episodes".into()),
                ("gatsbi.format_version", "1".into()),
                ("gatsbi.dataset", serde_json::to_string(&info()).unwrap()),
            ],
        }
    }

    fn with(mut self, name: &'static str, column: ArrayRef) -> Self {
        self.columns.retain(|(other, _)| *other != name);
        self.columns.push((name, column));
        self
    }

    fn without(mut self, name: &str) -> Self {
        self.columns.retain(|(other, _)| *other != name);
        self
    }

    fn with_metadata(mut self, key: &'static str, value: &str) -> Self {
        self.metadata.retain(|(other, _)| *other != key);
        self.metadata.push((key, value.into()));
        self
    }

    fn read(self) -> Result<Episode, Error> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("foreign.parquet");
        let entries =
            self.metadata.into_iter().map(|(key, value)| KeyValue::new(key.into(), value));
        let properties =
            WriterProperties::builder().set_key_value_metadata(Some(entries.collect())).build();
        let field =
            |(name, column): &(&str, ArrayRef)| Field::new(*name, column.data_type().clone(), true);
        let schema = Arc::new(Schema::new(self.columns.iter().map(field).collect::<Vec<_>>()));
        let columns = self.columns.into_iter().map(|(_, column)| column).collect();
        let batch = RecordBatch::try_new(Arc::clone(&schema), columns).unwrap();
        let file = fs_err::File::create(&path).unwrap();
        let mut writer = ArrowWriter::try_new(file, schema, Some(properties)).unwrap();
        writer.write(&batch).unwrap();
        writer.close().unwrap();
        Dataset::open(&path)?.read(0)
    }

    #[track_caller]
    fn expect_invalid(self, expected: &InvalidEpisode) {
        match self.read() {
            Err(Error::Row { path, row: 0, source }) => {
                assert!(path.ends_with("foreign.parquet"));
                assert_eq!(source, *expected);
            }
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn a_table_of_another_writer_is_read() {
    let episode = Table::valid().read().unwrap();
    assert_eq!((episode.id(), episode.length(), episode.action(1)), (5, 2, &[0.3, 0.4][..]));
    assert_eq!((episode.mask(0), episode.object_count()), (None, None));
    let with_more = Table::valid().with("reward", Arc::new(Float64Array::from(vec![1.0])));
    with_more.read().unwrap();
}

#[test]
fn a_parquet_file_of_something_else_is_foreign() {
    let mut table = Table::valid();
    table.metadata.clear();
    assert!(matches!(table.read(), Err(Error::Foreign { key: "gatsbi.format", .. })));
    let other = Table::valid().with_metadata("gatsbi.format", "something else");
    assert!(matches!(other.read(), Err(Error::Foreign { .. })));
}

#[test]
fn a_newer_version_is_refused() {
    let newer = Table::valid().with_metadata("gatsbi.format_version", "2").without("rgb");
    assert!(matches!(newer.read(), Err(Error::NewerVersion { found: 2, supported: 1, .. })));
}

#[test]
fn malformed_metadata_is_refused() {
    for (key, value) in [("gatsbi.format_version", "one"), ("gatsbi.dataset", "{\"name\": 3}")] {
        let table = Table::valid().with_metadata(key, value);
        let refused = table.read().unwrap_err();
        assert!(matches!(refused, Error::Metadata { .. }), "{refused:?}");
        assert!(refused.source().is_some());
    }
    let mut gray = info();
    gray.channels = 1;
    let gray = serde_json::to_string(&gray).unwrap();
    let refused = Table::valid().with_metadata("gatsbi.dataset", &gray).read();
    assert!(matches!(refused, Err(Error::Description { field: "channels", .. })), "{refused:?}");
}

#[test]
fn a_missing_column_is_named() {
    for name in ["episode_id", "length", "rgb", "actions"] {
        match Table::valid().without(name).read() {
            Err(Error::MissingColumn { column, .. }) => assert_eq!(column, name),
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn a_column_of_another_type_is_named() {
    let wrong: [(&str, ArrayRef); 4] = [
        ("length", Arc::new(UInt64Array::from(vec![2]))),
        ("actions", Arc::new(Float64Array::from(vec![0.1]))),
        ("mask", list(&[Some(0.0)])),
        ("object_positions", Arc::new(BinaryArray::from(vec![b"xyz".as_slice()]))),
    ];
    for (name, array) in wrong {
        let found_type: DataType = array.data_type().clone();
        match Table::valid().with(name, array).read() {
            Err(Error::ColumnType { column, found, expected, .. }) => {
                assert_eq!(column, name);
                assert_ne!(found, expected);
                assert!(found_type.is_nested() || found == found_type.to_string(), "{found}");
            }
            other => panic!("{name}: {other:?}"),
        }
    }
}

#[test]
fn a_null_is_named() {
    let null = InvalidEpisode::Null { column: "length" };
    Table::valid().with("length", Arc::new(UInt32Array::from(vec![None]))).expect_invalid(&null);
    let null = InvalidEpisode::Null { column: "actions" };
    Table::valid()
        .with("actions", list(&[Some(0.1), None, Some(0.3), Some(0.4)]))
        .expect_invalid(&null);
}

#[test]
fn an_episode_without_frames_is_refused() {
    let empty = Table::valid()
        .with("length", Arc::new(UInt32Array::from(vec![0])))
        .with("rgb", Arc::new(BinaryArray::from(vec![b"".as_slice()])))
        .with("actions", list(&[]));
    empty.expect_invalid(&InvalidEpisode::Empty);
}

#[test]
fn columns_that_disagree_about_the_length_are_refused() {
    let length = |column, found, expected, formula| InvalidEpisode::Length {
        column,
        found,
        expected,
        formula,
    };
    Table::valid()
        .with("length", Arc::new(UInt32Array::from(vec![3])))
        .expect_invalid(&length("rgb", 384, 576, "T*H*W*C"));
    Table::valid()
        .with("actions", list(&[Some(0.1), Some(0.2), Some(0.3)]))
        .expect_invalid(&length("actions", 3, 4, "T*A"));
    // A claim so large that its product must not overflow.
    Table::valid()
        .with("length", Arc::new(UInt32Array::from(vec![u32::MAX])))
        .expect_invalid(&length("rgb", 384, 192 * u32::MAX as usize, "T*H*W*C"));
}

#[test]
fn an_action_that_is_not_finite_is_refused() {
    let infinite = [Some(0.1), Some(0.2), Some(0.3), Some(f32::INFINITY)];
    Table::valid().with("actions", list(&infinite)).expect_invalid(&InvalidEpisode::NonFinite {
        column: "actions",
        frame: 1,
        dimension: 1,
        value: f32::INFINITY,
    });
}

#[test]
fn messages_name_file_row_and_column_once() {
    let actions = list(&[Some(0.1), Some(0.2), Some(0.3), Some(f32::INFINITY)]);
    let error = Table::valid().with("actions", actions).read().unwrap_err();
    assert!(error.to_string().ends_with("foreign.parquet, row 0: not a valid episode"), "{error}");
    let source = error.source().unwrap().to_string();
    assert_eq!(source, "column `actions`, frame 1, dimension 1: inf is not a finite number");
}
