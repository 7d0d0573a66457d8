//! The container: records of an opcode, a length and fields, little-endian, some of them together in compressed chunks.
//!
//! Our own because it is small: the crate `mcap` brings three derive macros, three containers and two compressors in C for
//! it, and what is read and written here is checked against the reference library for Python.

use std::{
    collections::BTreeMap,
    io::{self, BufReader, Read},
    path::Path,
    rc::Rc,
};

use crate::{Result, exchange::ImportProblem};

pub(super) const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";
/// Largest record, and largest chunk when decompressed.
const MAX_RECORD: u64 = 1 << 30;

/// The first byte of a record.
pub(super) mod opcode {
    pub(in super::super) const HEADER: u8 = 1;
    pub(in super::super) const FOOTER: u8 = 2;
    pub(in super::super) const SCHEMA: u8 = 3;
    pub(in super::super) const CHANNEL: u8 = 4;
    pub(in super::super) const MESSAGE: u8 = 5;
    pub(in super::super) const CHUNK: u8 = 6;
    pub(in super::super) const MESSAGE_INDEX: u8 = 7;
    pub(in super::super) const CHUNK_INDEX: u8 = 8;
    pub(in super::super) const STATISTICS: u8 = 11;
    pub(in super::super) const DATA_END: u8 = 15;
}

/// What messages are sent on.
#[derive(Debug, Default)]
pub(super) struct Channel {
    pub(super) topic: String,
    pub(super) encoding: String,
    pub(super) schema: String,
    pub(super) metadata: BTreeMap<String, String>,
}

/// One message.
#[derive(Debug)]
pub(super) struct Message {
    pub(super) channel: Rc<Channel>,
    /// Nanoseconds.
    pub(super) log_time: u64,
    pub(super) data: Vec<u8>,
}

/// The messages of a file in its order. After an error there are no more.
pub(super) struct Messages {
    file: BufReader<fs_err::File>,
    schemas: BTreeMap<u16, String>,
    channels: BTreeMap<u16, Rc<Channel>>,
    /// The chunk that is being read, and the place in it.
    chunk: Vec<u8>,
    at: usize,
    is_over: bool,
}

impl Messages {
    pub(super) fn open(path: &Path) -> Result<Self> {
        let mut file = BufReader::new(fs_err::File::open(path)?);
        let mut magic = [0; MAGIC.len()];
        let is_mcap = file.read_exact(&mut magic).is_ok() && magic == *MAGIC;
        if !is_mcap {
            let (what, found) = ("the beginning", format!("{magic:02x?}"));
            let expected = "the mark of an MCAP file".into();
            return Err(ImportProblem::Layout { what, found, expected }.at(path, None, None));
        }
        let (schemas, channels) = (BTreeMap::new(), BTreeMap::new());
        Ok(Self { file, schemas, channels, chunk: Vec::new(), at: 0, is_over: false })
    }

    fn read(&mut self) -> Result<Option<Message>, ImportProblem> {
        loop {
            while self.at < self.chunk.len() {
                let rest = &self.chunk[self.at..];
                let (head, body) = rest.split_first_chunk::<9>().ok_or_else(within)?;
                let (opcode, length) = head_of(head);
                let body = body.get(..length as usize).ok_or_else(within)?;
                self.at += head.len() + body.len();
                let record = take(opcode, body, &mut self.schemas, &mut self.channels)?;
                if record.is_some() {
                    return Ok(record);
                }
            }
            let mut head = [0; 9];
            self.file.read_exact(&mut head).map_err(ended)?;
            let (opcode, length) = head_of(&head);
            if length > MAX_RECORD {
                return Err(too_large(length));
            }
            let mut body = vec![0; length as usize];
            self.file.read_exact(&mut body).map_err(ended)?;
            match opcode {
                // What follows repeats what was read.
                opcode::DATA_END | opcode::FOOTER => return Ok(None),
                opcode::CHUNK => (self.chunk, self.at) = (unpack(&body)?, 0),
                _ => {
                    let record = take(opcode, &body, &mut self.schemas, &mut self.channels)?;
                    if record.is_some() {
                        return Ok(record);
                    }
                }
            }
        }
    }
}

impl Iterator for Messages {
    type Item = Result<Message, ImportProblem>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.is_over {
            return None;
        }
        let read = self.read();
        self.is_over = !matches!(read, Ok(Some(_)));
        read.transpose()
    }
}

/// Keeps a schema or channel, returns a message, and leaves out everything else.
fn take(
    opcode: u8,
    body: &[u8],
    schemas: &mut BTreeMap<u16, String>,
    channels: &mut BTreeMap<u16, Rc<Channel>>,
) -> Result<Option<Message>, ImportProblem> {
    let mut fields = Fields(body);
    match opcode {
        opcode::SCHEMA => {
            schemas.insert(fields.u16()?, fields.string()?);
        }
        opcode::CHANNEL => {
            let (id, schema) = (fields.u16()?, fields.u16()?);
            let (topic, encoding) = (fields.string()?, fields.string()?);
            let mut pairs = Fields(fields.sized()?);
            let mut metadata = BTreeMap::new();
            while !pairs.0.is_empty() {
                metadata.insert(pairs.string()?, pairs.string()?);
            }
            let schema = schemas.get(&schema).cloned().unwrap_or_default();
            channels.insert(id, Rc::new(Channel { topic, encoding, schema, metadata }));
        }
        opcode::MESSAGE => {
            let id = fields.u16()?;
            fields.u32()?;
            let log_time = fields.u64()?;
            fields.u64()?;
            let channel = channels.get(&id).ok_or_else(|| ImportProblem::Missing {
                what: format!("channel {id}"),
                expected: "a message names it".into(),
            })?;
            let (channel, data) = (Rc::clone(channel), fields.0.to_vec());
            return Ok(Some(Message { channel, log_time, data }));
        }
        _ => {}
    }
    Ok(None)
}

/// The records of a chunk.
fn unpack(body: &[u8]) -> Result<Vec<u8>, ImportProblem> {
    let mut fields = Fields(body);
    fields.u64()?;
    fields.u64()?;
    let size = fields.u64()?;
    let sum = fields.u32()?;
    let compression = fields.string()?;
    let length = fields.u64()?;
    let packed = fields.take(length)?;
    if size > MAX_RECORD {
        return Err(too_large(size));
    }
    let read = |decoder: &mut dyn Read| {
        let mut records = Vec::new();
        // One byte more than it may be shows that it is too long.
        decoder.take(size + 1).read_to_end(&mut records).map(|_| records)
    };
    let records = match compression.as_str() {
        "" => Ok(packed.to_vec()),
        "lz4" => read(&mut lz4_flex::frame::FrameDecoder::new(packed)),
        "zstd" => zstd::Decoder::new(packed).and_then(|mut decoder| read(&mut decoder)),
        other => {
            let (found, expected) = (format!("`{other}`"), "lz4, zstd or none".into());
            return Err(ImportProblem::Layout { what: "the compression", found, expected });
        }
    };
    let records = records.map_err(|e| ImportProblem::damaged("a chunk", e))?;
    let is_whole = records.len() as u64 == size && (sum == 0 || crc32fast::hash(&records) == sum);
    if !is_whole {
        let why = "its size or checksum is not what it says".to_owned();
        return Err(ImportProblem::damaged("a chunk", why));
    }
    Ok(records)
}

fn head_of(&[opcode, ref length @ ..]: &[u8; 9]) -> (u8, u64) {
    (opcode, u64::from_le_bytes(*length))
}

fn ended(e: io::Error) -> ImportProblem {
    if e.kind() == io::ErrorKind::UnexpectedEof {
        let why = "the file ends before its end mark: the recording was interrupted or cut";
        return ImportProblem::damaged("the log", why.to_owned());
    }
    ImportProblem::damaged("the log", e)
}

fn within() -> ImportProblem {
    ImportProblem::damaged("a record", "it ends before its last field".to_owned())
}

fn too_large(bytes: u64) -> ImportProblem {
    ImportProblem::Layout {
        what: "a record",
        found: format!("{bytes} bytes"),
        expected: format!("{MAX_RECORD} at most"),
    }
}

/// The fields of a record that are left.
struct Fields<'a>(&'a [u8]);

impl<'a> Fields<'a> {
    fn u16(&mut self) -> Result<u16, ImportProblem> {
        self.array().map(u16::from_le_bytes)
    }

    fn u32(&mut self) -> Result<u32, ImportProblem> {
        self.array().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, ImportProblem> {
        self.array().map(u64::from_le_bytes)
    }

    fn string(&mut self) -> Result<String, ImportProblem> {
        let bytes = self.sized()?;
        let text = std::str::from_utf8(bytes).map_err(|e| ImportProblem::damaged("a text", e))?;
        Ok(text.to_owned())
    }

    /// Bytes with their number before them.
    fn sized(&mut self) -> Result<&'a [u8], ImportProblem> {
        let length = self.u32()?;
        self.take(length.into())
    }

    fn take(&mut self, length: u64) -> Result<&'a [u8], ImportProblem> {
        let length = usize::try_from(length).unwrap_or(usize::MAX);
        let (taken, rest) = self.0.split_at_checked(length).ok_or_else(within)?;
        self.0 = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], ImportProblem> {
        let (taken, rest) = self.0.split_first_chunk().ok_or_else(within)?;
        self.0 = rest;
        Ok(*taken)
    }
}
