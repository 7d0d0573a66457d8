//! What can be wrong with a file of another format. Where it is wrong says [`crate::Error::Import`].

use std::path::Path;

use crate::{Error, InvalidEpisode};

/// Why something cannot be imported.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ImportProblem {
    /// Something that is needed is not there.
    #[error("there is no {what}; {expected}")]
    Missing {
        /// What was looked for.
        what: String,
        /// What there is instead, or what was expected.
        expected: String,
    },
    /// Something is not of the kind that is needed.
    #[error("{what} is {found}, expected {expected}")]
    Layout {
        /// What it is about.
        what: &'static str,
        /// As in the file.
        found: String,
        /// As the import needs it.
        expected: String,
    },
    /// The file is damaged, truncated or something else than its name says.
    #[error("{what} cannot be read")]
    Damaged {
        /// The part of it.
        what: &'static str,
        /// What the reader found.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// What was read makes no valid episode.
    #[error(transparent)]
    Episode(#[from] InvalidEpisode),
    /// Videos need a program that is not there.
    #[error(
        "videos are decoded by the program `{program}`, which cannot be started: install the package ffmpeg (Debian and \
         Ubuntu: apt install ffmpeg; Python: pip install imageio-ffmpeg), or name the program in GATSBI_FFMPEG"
    )]
    NoFfmpeg {
        /// What was tried.
        program: String,
        /// Why it did not start.
        source: std::io::Error,
    },
}

impl ImportProblem {
    /// Something unreadable, with the reader's own error.
    pub(crate) fn damaged(
        what: &'static str,
        source: impl Into<Box<dyn std::error::Error + Send + Sync>>,
    ) -> Self {
        Self::Damaged { what, source: source.into() }
    }

    /// The problem in its place.
    pub(crate) fn at(self, path: &Path, row: Option<u64>, column: Option<&str>) -> Error {
        let column = column.map(str::to_owned);
        Error::Import { path: path.to_path_buf(), row, column, source: self }
    }
}
