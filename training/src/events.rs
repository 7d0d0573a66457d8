//! TensorBoard event files: scalars and pictures over steps.
//!
//! A file is a sequence of TFRecords (length, its checksum, payload, its checksum), each payload an `Event`
//! message. The few messages are written by hand; nothing else here needs protocol buffers.

use std::{
    io::{BufWriter, Write as _},
    path::Path,
    time::{SystemTime, UNIX_EPOCH},
};

/// An event file that is being written.
#[derive(Debug)]
pub struct Events {
    file: BufWriter<fs_err::File>,
}

impl Events {
    /// Starts a new event file in `folder`.
    ///
    /// # Errors
    /// Of the file system.
    pub fn create(folder: &Path) -> std::io::Result<Self> {
        fs_err::create_dir_all(folder)?;
        let now = now();
        let name = format!("events.out.tfevents.{:.0}.gatsbi.{}", now, std::process::id());
        let mut events = Self { file: BufWriter::new(fs_err::File::create(folder.join(name))?) };
        let mut event = Message::default();
        event.double(1, now);
        event.bytes(3, b"brain.Event:2");
        events.record(&event.0)?;
        Ok(events)
    }

    /// Writes scalars of a step.
    ///
    /// # Errors
    /// Of the file system.
    pub fn scalars<'a>(
        &mut self,
        step: u64,
        scalars: impl IntoIterator<Item = (&'a str, f64)>,
    ) -> std::io::Result<()> {
        let mut summary = Message::default();
        for (tag, value) in scalars {
            let mut entry = Message::default();
            entry.bytes(1, tag.as_bytes());
            entry.float(2, value as f32);
            summary.bytes(1, &entry.0);
        }
        self.event(step, &summary)
    }

    /// Writes a PNG picture of a step.
    ///
    /// # Errors
    /// Of the file system.
    pub fn picture(
        &mut self,
        step: u64,
        tag: &str,
        png: &[u8],
        size: [u32; 2],
    ) -> std::io::Result<()> {
        const RGB: u64 = 3;
        let mut image = Message::default();
        image.varint(1, u64::from(size[0]));
        image.varint(2, u64::from(size[1]));
        image.varint(3, RGB);
        image.bytes(4, png);
        let mut entry = Message::default();
        entry.bytes(1, tag.as_bytes());
        entry.bytes(4, &image.0);
        let mut summary = Message::default();
        summary.bytes(1, &entry.0);
        self.event(step, &summary)
    }

    fn event(&mut self, step: u64, summary: &Message) -> std::io::Result<()> {
        let mut event = Message::default();
        event.double(1, now());
        event.varint(2, step);
        event.bytes(5, &summary.0);
        self.record(&event.0)?;
        self.file.flush()
    }

    fn record(&mut self, payload: &[u8]) -> std::io::Result<()> {
        let length = (payload.len() as u64).to_le_bytes();
        self.file.write_all(&length)?;
        self.file.write_all(&masked(crc32c::crc32c(&length)).to_le_bytes())?;
        self.file.write_all(payload)?;
        self.file.write_all(&masked(crc32c::crc32c(payload)).to_le_bytes())
    }
}

/// The masking of checksums in TFRecords.
fn masked(checksum: u32) -> u32 {
    checksum.rotate_right(15).wrapping_add(0xa282_ead8)
}

fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}

/// A protocol-buffer message in the making.
#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn raw_varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    fn varint(&mut self, field: u64, value: u64) {
        self.raw_varint(field << 3);
        self.raw_varint(value);
    }

    fn double(&mut self, field: u64, value: f64) {
        self.raw_varint(field << 3 | 1);
        self.0.extend(value.to_le_bytes());
    }

    fn bytes(&mut self, field: u64, value: &[u8]) {
        self.raw_varint(field << 3 | 2);
        self.raw_varint(value.len() as u64);
        self.0.extend(value);
    }

    fn float(&mut self, field: u64, value: f32) {
        self.raw_varint(field << 3 | 5);
        self.0.extend(value.to_le_bytes());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_are_framed_and_checked() {
        let folder = tempfile::tempdir().unwrap();
        let mut events = Events::create(folder.path()).unwrap();
        events.scalars(300, [("loss", 1.5)]).unwrap();
        drop(events);
        let file = std::fs::read_dir(folder.path()).unwrap().next().unwrap().unwrap().path();
        let bytes = std::fs::read(file).unwrap();
        let mut at = 0;
        let mut payloads = Vec::new();
        while at < bytes.len() {
            let length = u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()) as usize;
            let check = |range: std::ops::Range<usize>, at: usize| {
                let stored = u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
                assert_eq!(stored, masked(crc32c::crc32c(&bytes[range])));
            };
            check(at..at + 8, at + 8);
            check(at + 12..at + 12 + length, at + 12 + length);
            payloads.push(&bytes[at + 12..at + 12 + length]);
            at += 16 + length;
        }
        assert_eq!(payloads.len(), 2);
        assert!(payloads[0].ends_with(b"brain.Event:2"));
        // Step 300 as a varint, then the summary with tag "loss" and 1.5 as a float.
        assert_eq!(payloads[1][9..12], [0x10, 0xac, 0x02]);
        assert!(payloads[1].ends_with(&[0x0a, 4, b'l', b'o', b's', b's', 0x15, 0, 0, 0xc0, 0x3f]));
    }
}
