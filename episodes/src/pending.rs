//! A file that appears under its name only when it is complete: written beside it, flushed to the disk, then renamed.

use std::{
    io::{self, Write},
    path::{Path, PathBuf},
};

use fs_err as fs;

/// A file being written. Dropping it without [`PendingFile::commit`] removes it.
#[derive(Debug)]
pub(crate) struct PendingFile {
    file: fs::File,
    partial: PathBuf,
    target: PathBuf,
}

impl PendingFile {
    /// Starts writing `target` as the hidden file `.NAME.partial` of the same folder. One that a killed process left is replaced.
    pub(crate) fn create(target: &Path) -> io::Result<Self> {
        let name = target.file_name().unwrap_or_default().to_string_lossy();
        let partial = target.with_file_name(format!(".{name}.partial"));
        Ok(Self { file: fs::File::create(&partial)?, partial, target: target.to_path_buf() })
    }

    /// Makes the file durable and gives it its name, replacing a file that had it.
    pub(crate) fn commit(self) -> io::Result<()> {
        self.file.sync_all()?;
        fs::rename(&self.partial, &self.target)
    }
}

impl Write for PendingFile {
    fn write(&mut self, buf: &[u8]) -> io::Result<usize> {
        self.file.write(buf)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl Drop for PendingFile {
    fn drop(&mut self) {
        // After a commit there is nothing under this name; a failure leaves a hidden file that the next writer replaces.
        fs::remove_file(&self.partial).ok();
    }
}

/// Makes the names in folder `dir` durable.
pub(crate) fn sync_folder(dir: &Path) -> io::Result<()> {
    fs::File::open(dir)?.sync_all()
}
