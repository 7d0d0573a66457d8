//! Writes recordings: an episode at once, or a session as it happens.

use std::{
    collections::BTreeMap,
    fmt,
    io::Write as _,
    path::{Path, PathBuf},
};

use prost::Message as _;
use prost_types::{
    DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet,
    field_descriptor_proto::{Label, Type},
};
use serde_json::json;

use super::{
    ACTION_TOPIC, Action, CAMERA_TOPIC, DATASET_KEY, EPISODE_KEY,
    container::{MAGIC, opcode},
    message::{COMPRESSED_IMAGE, CompressedImage},
};
use crate::{
    Dataset, DatasetInfo, Error, Result,
    exchange::{Skipped, picture::png},
    pending::PendingFile,
    writer::make_whole,
};

/// A chunk is closed when its records have grown to this many bytes.
const CHUNK_BYTES: usize = 1 << 20;
const CAMERA: u16 = 1;
const ACTION: u16 = 2;

/// A recording being written. The file has its name once [`McapWriter::finish`] was called; dropped before, it is gone.
///
/// Messages lie in chunks that are not compressed, for pictures are, with an index that tools need to jump in time.
pub struct McapWriter {
    path: PathBuf,
    file: PendingFile,
    /// Bytes written.
    offset: u64,
    /// Schemas and channels, which stand at the beginning and again in the summary.
    definitions: Vec<u8>,
    chunk: Chunk,
    /// The index of each chunk.
    indexes: Vec<u8>,
    chunks: u32,
    /// Messages of the two channels.
    counts: [u64; 2],
    first_time: u64,
    last_time: u64,
}

/// The records that are to be written next.
#[derive(Default)]
struct Chunk {
    records: Vec<u8>,
    /// Times of the messages of the two channels, and their places.
    index: [Vec<(u64, u64)>; 2],
}

impl fmt::Debug for McapWriter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { path, counts, .. } = self;
        f.debug_struct("McapWriter")
            .field("path", path)
            .field("counts", counts)
            .finish_non_exhaustive()
    }
}

/// Writes `dataset` to folder `dir`, one file an episode; the folder appears only when all of it is there. Says what was left
/// out: everything but frames and actions. `progress` is told the number of episodes done and of all.
///
/// # Errors
/// Those of reading, [`Error::NotEmpty`], [`Error::Io`].
pub fn export_mcap(
    dataset: &Dataset,
    dir: &Path,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Vec<Skipped>> {
    let info = dataset.info();
    make_whole(dir, |folder| {
        for index in 0..dataset.len() {
            let episode = dataset.read(index)?;
            let path = folder.join(format!("episode-{:06}.mcap", episode.id()));
            let mut writer = McapWriter::create(&path, info, Some(episode.id()))?;
            for t in 0..episode.length() {
                let time = (t as f64 * info.frame_period_seconds * 1e9).round() as u64;
                writer.frame(time, "png", png(episode.frame(t), info.width, info.height))?;
                writer.action(time, episode.action(t))?;
            }
            writer.finish()?;
            progress(index + 1, dataset.len());
        }
        Ok(())
    })?;
    let why = "frames and actions are exported";
    Ok(vec![Skipped::new("masks, objects, poses, joints, contacts, seeds", why)])
}

impl McapWriter {
    /// Starts a recording of the cameras and actions that `info` describes.
    ///
    /// # Errors
    /// [`Error::Io`] and [`Error::Io`].
    pub fn create(path: &Path, info: &DatasetInfo, episode_id: Option<u64>) -> Result<Self> {
        let malformed = |source| Error::Metadata {
            path: path.to_path_buf(),
            what: "description of the data set",
            source,
        };
        let mut metadata = BTreeMap::from([(
            DATASET_KEY.to_owned(),
            serde_json::to_string(info).map_err(malformed)?,
        )]);
        if let Some(id) = episode_id {
            metadata.insert(EPISODE_KEY.to_owned(), id.to_string());
        }
        let actions = action_schema(info).to_string();
        let mut definitions = Vec::new();
        push(&mut definitions, opcode::SCHEMA, |r| {
            r.u16(CAMERA).text(COMPRESSED_IMAGE).text("protobuf").sized(&image_schema());
        });
        push(&mut definitions, opcode::SCHEMA, |r| {
            r.u16(ACTION).text("gatsbi.Action").text("jsonschema").sized(actions.as_bytes());
        });
        push(&mut definitions, opcode::CHANNEL, |r| {
            r.u16(CAMERA).u16(CAMERA).text(CAMERA_TOPIC).text("protobuf").map(&metadata);
        });
        push(&mut definitions, opcode::CHANNEL, |r| {
            r.u16(ACTION).u16(ACTION).text(ACTION_TOPIC).text("json").map(&BTreeMap::new());
        });
        let mut writer = Self {
            path: path.to_path_buf(),
            file: PendingFile::create(path)?,
            offset: 0,
            definitions: Vec::new(),
            chunk: Chunk::default(),
            indexes: Vec::new(),
            chunks: 0,
            counts: [0; 2],
            first_time: u64::MAX,
            last_time: 0,
        };
        let mut head = MAGIC.to_vec();
        push(&mut head, opcode::HEADER, |r| {
            r.text("").text(concat!("gatsbi-episodes ", env!("CARGO_PKG_VERSION")));
        });
        head.extend_from_slice(&definitions);
        writer.append(&head)?;
        writer.definitions = definitions;
        Ok(writer)
    }

    /// Adds a frame, seen at `time` in nanoseconds: a PNG, JPEG or WebP file, `format` says which.
    ///
    /// # Errors
    /// [`Error::Io`]
    pub fn frame(&mut self, time: u64, format: &str, file: Vec<u8>) -> Result<()> {
        let image = CompressedImage {
            timestamp: Some(prost_types::Timestamp {
                seconds: (time / 1_000_000_000) as i64,
                nanos: (time % 1_000_000_000) as i32,
            }),
            frame_id: "camera".into(),
            data: file,
            format: format.into(),
        };
        self.write(CAMERA, time, &image.encode_to_vec())
    }

    /// Adds a frame of raw bytes `[H,W,3]`, as a PNG. Panics if they are not as many as the sides say.
    ///
    /// # Errors
    /// [`Error::Io`]
    pub fn rgb(&mut self, time: u64, width: u32, height: u32, rgb: &[u8]) -> Result<()> {
        self.frame(time, "png", png(rgb, width, height))
    }

    /// Adds the command that holds from `time` on.
    ///
    /// # Errors
    /// [`Error::Io`]
    pub fn action(&mut self, time: u64, values: &[f32]) -> Result<()> {
        let text = serde_json::to_vec(&Action { values: values.to_vec() }).map_err(|source| {
            Error::Metadata { path: self.path.clone(), what: "action", source }
        })?;
        self.write(ACTION, time, &text)
    }

    /// Completes the file and gives it its name.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn finish(mut self) -> Result<()> {
        self.close_chunk()?;
        let mut end = Vec::new();
        push(&mut end, opcode::DATA_END, |r| {
            r.u32(0);
        });
        let summary = self.offset + end.len() as u64;
        end.extend_from_slice(&self.definitions);
        end.extend_from_slice(&self.indexes);
        let messages = self.counts.iter().sum();
        let first = if messages == 0 { 0 } else { self.first_time };
        let counts: Vec<_> = [CAMERA, ACTION].into_iter().zip(self.counts).collect();
        push(&mut end, opcode::STATISTICS, |r| {
            r.u64(messages).u16(2).u32(2).u32(0).u32(0).u32(self.chunks);
            r.u64(first).u64(self.last_time).numbers(&counts);
        });
        // No offsets by kind, no checksum.
        push(&mut end, opcode::FOOTER, |r| {
            r.u64(summary).u64(0).u32(0);
        });
        end.extend_from_slice(MAGIC);
        self.append(&end)?;
        Ok(self.file.commit()?)
    }

    fn write(&mut self, channel: u16, time: u64, data: &[u8]) -> Result<()> {
        let number = usize::from(channel - CAMERA);
        let sequence = self.counts[number] as u32;
        self.counts[number] += 1;
        self.first_time = self.first_time.min(time);
        self.last_time = self.last_time.max(time);
        self.chunk.index[number].push((time, self.chunk.records.len() as u64));
        push(&mut self.chunk.records, opcode::MESSAGE, |r| {
            r.u16(channel).u32(sequence).u64(time).u64(time).bytes(data);
        });
        if self.chunk.records.len() >= CHUNK_BYTES { self.close_chunk() } else { Ok(()) }
    }

    fn close_chunk(&mut self) -> Result<()> {
        let Chunk { records, index } = std::mem::take(&mut self.chunk);
        if records.is_empty() {
            return Ok(());
        }
        let times = || index.iter().flatten().map(|(time, _)| *time);
        let (first, last) = (times().min().unwrap_or(0), times().max().unwrap_or(0));
        let size = records.len() as u64;
        let start = self.offset;
        let mut written = Vec::with_capacity(records.len() + 256);
        push(&mut written, opcode::CHUNK, |r| {
            r.u64(first).u64(last).u64(size).u32(crc32fast::hash(&records)).text("");
            r.u64(size).bytes(&records);
        });
        let length = written.len() as u64;
        let mut places = Vec::new();
        for (channel, messages) in [CAMERA, ACTION].into_iter().zip(&index) {
            places.push((channel, start + written.len() as u64));
            push(&mut written, opcode::MESSAGE_INDEX, |r| {
                r.u16(channel).u32(messages.len() as u32 * 16);
                for (time, place) in messages {
                    r.u64(*time).u64(*place);
                }
            });
        }
        push(&mut self.indexes, opcode::CHUNK_INDEX, |r| {
            r.u64(first).u64(last).u64(start).u64(length).numbers(&places);
            r.u64(written.len() as u64 - length).text("").u64(size).u64(size);
        });
        self.chunks += 1;
        self.append(&written)
    }

    fn append(&mut self, bytes: &[u8]) -> Result<()> {
        self.offset += bytes.len() as u64;
        Ok(self.file.write_all(bytes)?)
    }
}

/// Adds a record with the fields that `fill` writes.
fn push(out: &mut Vec<u8>, opcode: u8, fill: impl FnOnce(&mut Record<'_>)) {
    out.push(opcode);
    let at = out.len();
    out.extend_from_slice(&[0; 8]);
    fill(&mut Record(out));
    let length = (out.len() - at - 8) as u64;
    out[at..at + 8].copy_from_slice(&length.to_le_bytes());
}

/// The fields of a record being written.
struct Record<'a>(&'a mut Vec<u8>);

impl Record<'_> {
    fn u16(&mut self, value: u16) -> &mut Self {
        self.bytes(&value.to_le_bytes())
    }

    fn u32(&mut self, value: u32) -> &mut Self {
        self.bytes(&value.to_le_bytes())
    }

    fn u64(&mut self, value: u64) -> &mut Self {
        self.bytes(&value.to_le_bytes())
    }

    fn text(&mut self, text: &str) -> &mut Self {
        self.sized(text.as_bytes())
    }

    fn sized(&mut self, bytes: &[u8]) -> &mut Self {
        self.u32(bytes.len() as u32).bytes(bytes)
    }

    fn map(&mut self, pairs: &BTreeMap<String, String>) -> &mut Self {
        let mut bytes = Vec::new();
        for (key, value) in pairs {
            Record(&mut bytes).text(key).text(value);
        }
        self.sized(&bytes)
    }

    fn numbers(&mut self, pairs: &[(u16, u64)]) -> &mut Self {
        self.u32(pairs.len() as u32 * 10);
        for (key, value) in pairs {
            self.u16(*key).u64(*value);
        }
        self
    }

    fn bytes(&mut self, bytes: &[u8]) -> &mut Self {
        self.0.extend_from_slice(bytes);
        self
    }
}

/// `foxglove/CompressedImage.proto` with what it imports, for readers that know neither.
fn image_schema() -> Vec<u8> {
    const TIMESTAMP: &str = "google/protobuf/timestamp.proto";
    let field = |name: &str, number, kind: Type, of: Option<&str>| FieldDescriptorProto {
        name: Some(name.into()),
        number: Some(number),
        label: Some(Label::Optional.into()),
        r#type: Some(kind.into()),
        type_name: of.map(str::to_owned),
        ..FieldDescriptorProto::default()
    };
    let file = |name: &str, package: &str, message: &str, field, imports: &[&str]| {
        let message =
            DescriptorProto { name: Some(message.into()), field, ..DescriptorProto::default() };
        FileDescriptorProto {
            name: Some(name.into()),
            package: Some(package.into()),
            dependency: imports.iter().map(|import| (*import).to_owned()).collect(),
            message_type: vec![message],
            syntax: Some("proto3".into()),
            ..FileDescriptorProto::default()
        }
    };
    let timestamp =
        vec![field("seconds", 1, Type::Int64, None), field("nanos", 2, Type::Int32, None)];
    let image = vec![
        field("timestamp", 1, Type::Message, Some(".google.protobuf.Timestamp")),
        field("frame_id", 4, Type::String, None),
        field("data", 2, Type::Bytes, None),
        field("format", 3, Type::String, None),
    ];
    let files = vec![
        file(TIMESTAMP, "google.protobuf", "Timestamp", timestamp, &[]),
        file("foxglove/CompressedImage.proto", "foxglove", "CompressedImage", image, &[TIMESTAMP]),
    ];
    FileDescriptorSet { file: files }.encode_to_vec()
}

fn action_schema(info: &DatasetInfo) -> serde_json::Value {
    let dimensions: Vec<_> =
        info.actions.iter().map(|action| format!("{} ({})", action.name, action.unit)).collect();
    json!({
        "title": "gatsbi.Action",
        "type": "object",
        "properties": {"values": {
            "type": "array",
            "items": {"type": "number"},
            "description": dimensions.join(", "),
        }},
    })
}
