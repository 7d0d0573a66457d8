//! The frame around each record: its length and two checksums, all little-endian.

use std::{
    io::{self, BufRead as _, BufReader, Read as _, Seek as _, SeekFrom},
    path::{Path, PathBuf},
};

use crate::{
    InvalidEpisode, Result,
    exchange::ImportProblem,
    schema::{MAX_COLUMN_BYTES, column},
};

const LENGTH: usize = 8;
const CHECKSUM: usize = 4;

/// The records of a file, one after the other.
pub(super) struct Records {
    pub(super) path: PathBuf,
    file: BufReader<fs_err::File>,
    /// Of the record that comes next.
    pub(super) number: u64,
}

/// How many records a file has. Their contents are not looked at, but a file that ends within one is found.
pub(super) fn count(path: &Path) -> Result<usize> {
    let mut records = Records::open(path)?;
    let end = records.file.get_ref().metadata()?.len();
    let mut count = 0;
    let mut at = 0_u64;
    while let Some(length) = records.length()? {
        at = at.saturating_add((LENGTH + 2 * CHECKSUM) as u64).saturating_add(length);
        if at > end {
            return Err(records.ends_early());
        }
        records.file.seek(SeekFrom::Start(at))?;
        records.number += 1;
        count += 1;
    }
    Ok(count)
}

impl Records {
    pub(super) fn open(path: &Path) -> Result<Self> {
        let file = BufReader::new(fs_err::File::open(path)?);
        Ok(Self { path: path.to_path_buf(), file, number: 0 })
    }

    /// The contents of the next record, `None` after the last.
    pub(super) fn next(&mut self) -> Result<Option<Vec<u8>>> {
        let Some(length) = self.length()? else { return Ok(None) };
        let mut data = vec![0; length as usize];
        self.fill(&mut data)?;
        let mut sum = [0; CHECKSUM];
        self.fill(&mut sum)?;
        self.compare("the checksum of its contents", &data, sum)?;
        self.number += 1;
        Ok(Some(data))
    }

    fn length(&mut self) -> Result<Option<u64>> {
        let mut length = [0; LENGTH];
        if self.file.fill_buf()?.is_empty() {
            return Ok(None);
        }
        self.fill(&mut length)?;
        let mut sum = [0; CHECKSUM];
        self.fill(&mut sum)?;
        self.compare("the checksum of its length", &length, sum)?;
        let length = u64::from_le_bytes(length);
        if length > MAX_COLUMN_BYTES as u64 {
            let (bytes, limit) = (length as usize, MAX_COLUMN_BYTES);
            let problem = InvalidEpisode::TooLarge { column: column::RGB, bytes, limit };
            return Err(ImportProblem::from(problem).at(&self.path, Some(self.number), None));
        }
        Ok(Some(length))
    }

    fn fill(&mut self, bytes: &mut [u8]) -> Result<()> {
        match self.file.read_exact(bytes) {
            Err(e) if e.kind() == io::ErrorKind::UnexpectedEof => Err(self.ends_early()),
            read => Ok(read?),
        }
    }

    fn compare(&self, what: &'static str, bytes: &[u8], sum: [u8; CHECKSUM]) -> Result<()> {
        let (found, expected) = (masked(crc32c::crc32c(bytes)), u32::from_le_bytes(sum));
        if found == expected {
            return Ok(());
        }
        let found = format!("{found:08x}");
        let expected = format!("{expected:08x}: the file is damaged, compressed or no TFRecord");
        let problem = ImportProblem::Layout { what, found, expected };
        Err(problem.at(&self.path, Some(self.number), None))
    }

    fn ends_early(&self) -> crate::Error {
        let why = "the file ends within it".to_owned();
        ImportProblem::damaged("the record", why).at(&self.path, Some(self.number), None)
    }
}

/// TFRecord rotates its checksums and adds a constant, so that a record within a record is no surprise.
fn masked(sum: u32) -> u32 {
    sum.rotate_right(15).wrapping_add(0xa282_ead8)
}
