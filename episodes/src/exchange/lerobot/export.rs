//! Exports a data set as a LeRobotDataset v3.0 with its pictures in the table, as PNG: nothing is lost.

use std::{
    collections::{BTreeMap, HashMap},
    path::Path,
    sync::Arc,
};

use arrow_array::{
    ArrayRef, Float32Array, Int64Array, RecordBatch, StringArray, StructArray,
    builder::{BinaryBuilder, FixedSizeListBuilder, Float32Builder, ListBuilder, StringBuilder},
};
use arrow_schema::{ArrowError, DataType, Field, Fields, Schema};
use parquet::{
    arrow::ArrowWriter, basic::Compression, errors::ParquetError,
    file::properties::WriterProperties,
};
use serde_json::{Value, json};

use super::{ACTION, EE_POSE, Feature, IMAGE, Info, STATE, Sidecar, statistics::Statistics};
use crate::{
    Dataset, DatasetInfo, Episode, Error, Result,
    exchange::{Skipped, picture::png},
    writer::make_whole,
};

/// A table is closed when it has grown to this many bytes, as LeRobot's own are.
const TABLE_BYTES: usize = 100 << 20;
/// Files in a folder.
const CHUNK: usize = 1000;
const TASK: &str = "unspecified";

/// Writes `dataset` to folder `dir`, which appears only when all of it is there, and says what was left out: masks, objects
/// and contacts have no place in the format. `progress` is told the number of episodes done and of all.
///
/// # Errors
/// Those of reading, [`Error::NotEmpty`], [`Error::Write`] and [`Error::Io`].
pub fn export_lerobot(
    dataset: &Dataset,
    dir: &Path,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<Skipped>> {
    make_whole(dir, |root| {
        let mut export = Export::new(dataset.info().clone(), root);
        for index in 0..dataset.len() {
            let episode = dataset.read(index)?;
            export.add(&episode)?;
            progress(index + 1, dataset.len());
        }
        export.finish()
    })
}

struct Export<'a> {
    root: &'a Path,
    info: DatasetInfo,
    table: Option<ArrowWriter<fs_err::File>>,
    tables: usize,
    frames: usize,
    ids: Vec<u64>,
    places: Vec<Place>,
    statistics: BTreeMap<&'static str, Statistics>,
    /// Dimension of the joints, if all episodes so far have them.
    joints: Option<usize>,
    ee_pose: bool,
    skipped: BTreeMap<&'static str, usize>,
}

/// Where an episode went.
struct Place {
    length: usize,
    table: usize,
    first: usize,
}

impl<'a> Export<'a> {
    fn new(info: DatasetInfo, root: &'a Path) -> Self {
        Self {
            root,
            info,
            table: None,
            tables: 0,
            frames: 0,
            ids: Vec::new(),
            places: Vec::new(),
            statistics: BTreeMap::new(),
            joints: None,
            ee_pose: false,
            skipped: BTreeMap::new(),
        }
    }

    fn add(&mut self, episode: &Episode) -> Result<()> {
        let (data, length) = (episode.data(), episode.length());
        if self.ids.is_empty() {
            // The first episode says which features there are.
            self.joints = data.joint_positions.as_ref().map(|joints| joints.len() / length);
            self.ee_pose = data.ee_pose.is_some();
        }
        let batch = self.batch(episode).map_err(ParquetError::from);
        let path = self.root.join(name("data", self.tables));
        let failed = |source| Error::Write { path: path.clone(), source };
        let batch = batch.map_err(failed)?;
        let mut table = match self.table.take() {
            Some(table) => table,
            None => create(&path, &batch.schema())?,
        };
        table.write(&batch).and_then(|()| table.flush()).map_err(failed)?;
        self.places.push(Place { length, table: self.tables, first: self.frames });
        if table.bytes_written() >= TABLE_BYTES {
            table.close().map_err(failed)?;
            self.tables += 1;
        } else {
            self.table = Some(table);
        }
        self.frames += length;
        self.ids.push(episode.id());
        self.count(episode);
        Ok(())
    }

    /// Counts what the format has no place for, and gathers statistics.
    fn count(&mut self, episode: &Episode) {
        let data = episode.data();
        let left_out = [
            ("mask", data.mask.is_some()),
            ("object_positions", data.object_positions.is_some()),
            ("object_pixels", data.object_pixels.is_some()),
            ("object_poses", data.object_poses.is_some()),
            ("contacts_agent", data.contacts_agent.is_some()),
            ("contacts_objects", data.contacts_objects.is_some()),
            ("state_hash", data.state_hash.is_some()),
            ("seed", data.seed.is_some()),
        ];
        for (column, there) in left_out {
            if there {
                *self.skipped.entry(column).or_default() += 1;
            }
        }
        let floats = |values: &[f32]| values.iter().copied().map(f64::from).collect::<Vec<_>>();
        let mut add = |key, values: Vec<f64>, dimension| {
            self.statistics.entry(key).or_default().add(values, dimension);
        };
        add(IMAGE, data.rgb.iter().map(|&byte| f64::from(byte) / 255.0).collect(), 3);
        if self.info.action_dimension() > 0 {
            add(ACTION, floats(&data.actions), self.info.action_dimension());
        }
        if let (Some(joints), Some(dimension)) = (&data.joint_positions, self.joints) {
            add(STATE, floats(joints), dimension);
        }
        if let (Some(pose), true) = (&data.ee_pose, self.ee_pose) {
            add(EE_POSE, floats(pose), 7);
        }
    }

    /// The rows of an episode.
    fn batch(&self, episode: &Episode) -> Result<RecordBatch, ArrowError> {
        let (data, length) = (episode.data(), episode.length());
        let rows = 0..length as i64;
        let number = self.ids.len() as i64;
        let mut columns: Vec<(&str, ArrayRef)> = Vec::new();
        let mut vector = |name: &'static str, values: Option<&[f32]>, dimension: usize| {
            let values = values.filter(|values| values.len() == length * dimension);
            let values = values.ok_or_else(|| {
                let id = episode.id();
                ArrowError::SchemaError(format!("episode {id} has no {name} of {dimension} values"))
            })?;
            columns.push((name, vectors(values, dimension)));
            Ok::<_, ArrowError>(())
        };
        if self.info.action_dimension() > 0 {
            vector(ACTION, Some(&data.actions), self.info.action_dimension())?;
        }
        if let Some(joints) = self.joints {
            vector(STATE, data.joint_positions.as_deref(), joints)?;
        }
        if self.ee_pose {
            vector(EE_POSE, data.ee_pose.as_deref(), 7)?;
        }
        columns.push((IMAGE, self.pictures(episode)));
        let seconds = |t: i64| (t as f64 * self.info.frame_period_seconds) as f32;
        let timestamps: Float32Array = rows.clone().map(seconds).collect::<Vec<_>>().into();
        columns.push(("timestamp", Arc::new(timestamps)));
        columns.push(("frame_index", integers(rows.clone())));
        columns.push(("episode_index", integers(rows.clone().map(|_| number))));
        columns.push(("index", integers(rows.clone().map(|t| t + self.frames as i64))));
        columns.push(("task_index", integers(rows.map(|_| 0))));
        RecordBatch::try_from_iter(columns)
    }

    fn pictures(&self, episode: &Episode) -> ArrayRef {
        let (width, height) = (self.info.width, self.info.height);
        let (mut bytes, mut paths) = (BinaryBuilder::new(), StringBuilder::new());
        for t in 0..episode.length() {
            bytes.append_value(png(episode.frame(t), width, height));
            paths.append_value(format!("frame-{t:06}.png"));
        }
        let fields = Fields::from(vec![
            Field::new("bytes", DataType::Binary, true),
            Field::new("path", DataType::Utf8, true),
        ]);
        let columns: Vec<ArrayRef> = vec![Arc::new(bytes.finish()), Arc::new(paths.finish())];
        Arc::new(StructArray::new(fields, columns, None))
    }

    /// The tables of episodes and tasks, and the descriptions.
    fn finish(mut self) -> Result<Vec<Skipped>> {
        if let Some(table) = self.table.take() {
            let path = self.root.join(name("data", self.tables));
            table.close().map_err(|source| Error::Write { path, source })?;
        }
        let episodes = self.episodes().map_err(ParquetError::from);
        self.write("meta/episodes/chunk-000/file-000.parquet", episodes)?;
        let tasks = RecordBatch::try_from_iter([
            ("task_index", integers([0])),
            ("__index_level_0__", Arc::new(StringArray::from(vec![TASK])) as ArrayRef),
        ]);
        // LeRobot reads this one with pandas and looks tasks up by the index.
        let pandas = json!({
            "index_columns": ["__index_level_0__"],
            "column_indexes": [],
            "columns": [
                {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64", "metadata": null},
                {"name": null, "field_name": "__index_level_0__", "pandas_type": "unicode", "numpy_type": "object", "metadata": null},
            ],
        });
        let tasks = tasks.and_then(|tasks| {
            let metadata = HashMap::from([("pandas".to_owned(), pandas.to_string())]);
            let schema = tasks.schema().as_ref().clone().with_metadata(metadata);
            tasks.with_schema(Arc::new(schema))
        });
        self.write("meta/tasks.parquet", tasks.map_err(ParquetError::from))?;
        let statistics: serde_json::Map<String, Value> = self
            .statistics
            .iter()
            .map(|(key, of)| {
                let frames = (*key == IMAGE).then_some(self.frames as u64);
                ((*key).to_owned(), of.json(frames))
            })
            .collect();
        self.write_json("meta/stats.json", &statistics)?;
        self.write_json("meta/info.json", &self.description())?;
        let sidecar = Sidecar { dataset: self.info.clone(), episode_ids: self.ids.clone() };
        self.write_json("meta/gatsbi.json", &sidecar)?;
        let skipped = self.skipped.iter().map(|(column, episodes)| {
            let what = format!("{column} of {episodes} episodes");
            Skipped::new(what, "the format has no place for it")
        });
        Ok(skipped.collect())
    }

    fn episodes(&self) -> Result<RecordBatch, ArrowError> {
        let column = |value: &dyn Fn(&Place) -> usize| -> ArrayRef {
            integers(self.places.iter().map(|place| value(place) as i64))
        };
        let mut tasks = ListBuilder::new(StringBuilder::new());
        for _ in &self.places {
            tasks.values().append_value(TASK);
            tasks.append(true);
        }
        let none = || column(&|_| 0);
        RecordBatch::try_from_iter([
            ("episode_index", integers(0..self.places.len() as i64)),
            ("tasks", Arc::new(tasks.finish())),
            ("length", column(&|place| place.length)),
            ("data/chunk_index", column(&|place| place.table / CHUNK)),
            ("data/file_index", column(&|place| place.table % CHUNK)),
            ("dataset_from_index", column(&|place| place.first)),
            ("dataset_to_index", column(&|place| place.first + place.length)),
            ("meta/episodes/chunk_index", none()),
            ("meta/episodes/file_index", none()),
        ])
    }

    fn description(&self) -> Info {
        let names = |names: &[String]| json!(names);
        let feature =
            |dtype: &str, shape: Vec<u64>, names| Feature { dtype: dtype.into(), shape, names };
        let actions: Vec<_> = self.info.actions.iter().map(|action| action.name.clone()).collect();
        let sides = vec![u64::from(self.info.height), u64::from(self.info.width), 3];
        let axes = ["height", "width", "channels"].map(String::from);
        let mut features = BTreeMap::from([
            (IMAGE.to_owned(), feature("image", sides, names(&axes))),
            ("timestamp".to_owned(), feature("float32", vec![1], Value::Null)),
        ]);
        for key in ["frame_index", "episode_index", "index", "task_index"] {
            features.insert(key.to_owned(), feature("int64", vec![1], Value::Null));
        }
        if !actions.is_empty() {
            let shape = vec![actions.len() as u64];
            features.insert(ACTION.to_owned(), feature("float32", shape, names(&actions)));
        }
        if let Some(joints) = self.joints {
            let each: Vec<_> = (0..joints).map(|joint| format!("joint_{joint}")).collect();
            let state = feature("float32", vec![joints as u64], names(&each));
            features.insert(STATE.to_owned(), state);
        }
        if self.ee_pose {
            let parts = ["x", "y", "z", "qw", "qx", "qy", "qz"].map(String::from);
            features.insert(EE_POSE.to_owned(), feature("float32", vec![7], names(&parts)));
        }
        let other = json!({
            "robot_type": null,
            "total_episodes": self.places.len(),
            "total_frames": self.frames,
            "total_tasks": 1,
            "chunks_size": CHUNK,
            "data_files_size_in_mb": TABLE_BYTES >> 20,
            "video_files_size_in_mb": 200,
            "splits": {"train": format!("0:{}", self.places.len())},
        });
        let other = other.as_object().cloned().unwrap_or_default().into_iter().collect();
        Info {
            codebase_version: "v3.0".into(),
            fps: 1.0 / self.info.frame_period_seconds,
            features,
            data_path: super::default_data_path(),
            video_path: None,
            other,
        }
    }

    fn write(&self, name: &str, batch: Result<RecordBatch, ParquetError>) -> Result<()> {
        let path = self.root.join(name);
        let failed = |source| Error::Write { path: path.clone(), source };
        let batch = batch.map_err(failed)?;
        let mut table = create(&path, &batch.schema())?;
        table.write(&batch).map_err(failed)?;
        table.close().map_err(failed)?;
        Ok(())
    }

    fn write_json(&self, name: &str, value: &impl serde::Serialize) -> Result<()> {
        let path = self.root.join(name);
        let malformed = |source| Error::Metadata { path: path.clone(), what: "JSON", source };
        let mut value = serde_json::to_value(value).map_err(malformed)?;
        // LeRobot wants a whole number where it can be one.
        if let Some(fps) = value.get_mut("fps")
            && let Some(rate) = fps.as_f64()
            && (rate - rate.round()).abs() < 1e-9
        {
            *fps = json!(rate.round() as u64);
        }
        let text = serde_json::to_vec_pretty(&value).map_err(malformed)?;
        Ok(fs_err::write(&path, text)?)
    }
}

fn name(folder: &str, table: usize) -> String {
    format!("{folder}/chunk-{:03}/file-{:03}.parquet", table / CHUNK, table % CHUNK)
}

fn create(path: &Path, schema: &Arc<Schema>) -> Result<ArrowWriter<fs_err::File>> {
    if let Some(folder) = path.parent() {
        fs_err::create_dir_all(folder)?;
    }
    // Pictures are compressed already.
    let properties = WriterProperties::builder()
        .set_compression(Compression::UNCOMPRESSED)
        .set_dictionary_enabled(false)
        .build();
    let file = fs_err::File::create(path)?;
    ArrowWriter::try_new(file, Arc::clone(schema), Some(properties))
        .map_err(|source| Error::Write { path: path.to_path_buf(), source })
}

fn integers(values: impl IntoIterator<Item = i64>) -> ArrayRef {
    Arc::new(Int64Array::from_iter_values(values))
}

fn vectors(values: &[f32], dimension: usize) -> ArrayRef {
    let mut list = FixedSizeListBuilder::new(Float32Builder::new(), dimension as i32);
    for row in values.chunks(dimension.max(1)) {
        list.values().append_slice(row);
        list.append(true);
    }
    Arc::new(list.finish())
}
