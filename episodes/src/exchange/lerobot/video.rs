//! Frames of a video file, decoded by the program `ffmpeg`.
//!
//! LeRobot writes AV1, and older data sets are H.264; no Rust library that is kept up decodes both, and a program apart
//! also keeps damaged videos out of this process. Frames come through a pipe as PPM files, which say their own sizes.

use std::{
    env,
    io::{BufRead, BufReader, Read as _, Seek as _, SeekFrom},
    path::{Path, PathBuf},
    process::{Child, ChildStdout, Command, Stdio},
};

use crate::exchange::{ImportProblem, picture::Picture};

/// A video being decoded from its beginning on.
pub(super) struct Video {
    pub(super) path: PathBuf,
    child: Child,
    frames: BufReader<ChildStdout>,
    messages: fs_err::File,
    /// Number of the frame that comes next.
    next: u64,
    _folder: tempfile::TempDir,
}

impl Video {
    pub(super) fn open(path: &Path) -> Result<Self, ImportProblem> {
        let program = env::var("GATSBI_FFMPEG").unwrap_or_else(|_| "ffmpeg".into());
        // A pipe for messages too would fill up while frames are read.
        let lost = |e: std::io::Error| ImportProblem::damaged("the decoder's messages", e);
        let folder = tempfile::tempdir().map_err(lost)?;
        let name = folder.path().join("messages");
        let messages = fs_err::File::create(&name).map_err(lost)?.into_parts().0;
        let mut child = Command::new(&program)
            .args(["-nostdin", "-v", "error", "-threads", "1", "-i"])
            .arg(path)
            .args(["-map", "0:v:0", "-fps_mode", "passthrough"])
            .args(["-f", "image2pipe", "-c:v", "ppm", "-pix_fmt", "rgb24", "-"])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(messages)
            .spawn()
            .map_err(|source| ImportProblem::NoFfmpeg { program, source })?;
        let out = child.stdout.take().ok_or_else(|| {
            ImportProblem::damaged("the decoder's pipe", "the program has none".to_owned())
        })?;
        Ok(Self {
            path: path.to_path_buf(),
            child,
            frames: BufReader::new(out),
            messages: fs_err::File::open(name).map_err(lost)?,
            next: 0,
            _folder: folder,
        })
    }

    /// Frame `number`, or `None` if it has gone by: the video must be opened anew.
    pub(super) fn frame(&mut self, number: u64) -> Result<Option<Picture>, ImportProblem> {
        if number < self.next {
            return Ok(None);
        }
        loop {
            let picture = self.read()?;
            self.next += 1;
            if self.next > number {
                return Ok(Some(picture));
            }
        }
    }

    fn read(&mut self) -> Result<Picture, ImportProblem> {
        let mut header = || -> Option<[u32; 2]> {
            let mut line = || {
                let mut line = String::new();
                self.frames.read_line(&mut line).ok()?;
                Some(line.trim_end().to_owned())
            };
            let (magic, sides, depth) = (line()?, line()?, line()?);
            let (width, height) = sides.split_once(' ')?;
            let sides = [width.parse().ok()?, height.parse().ok()?];
            (magic == "P6" && depth == "255").then_some(sides)
        };
        let Some([width, height]) = header() else { return Err(self.ended()) };
        if width.max(height) > crate::exchange::picture::MAX_SIDE {
            return Picture::raw(width, height, Vec::new());
        }
        let mut rgb = vec![0; width as usize * height as usize * 3];
        if self.frames.read_exact(&mut rgb).is_err() {
            return Err(self.ended());
        }
        Picture::raw(width, height, rgb)
    }

    /// The video has no such frame, or the decoder gave up: its own words say more.
    fn ended(&mut self) -> ImportProblem {
        // Its messages are complete once it has ended.
        self.child.wait().ok();
        let mut said = String::new();
        self.messages.seek(SeekFrom::Start(0)).ok();
        self.messages.read_to_string(&mut said).ok();
        let said = said.lines().next().unwrap_or("the video ends there").to_owned();
        ImportProblem::damaged("the video", format!("frame {}: {said}", self.next))
    }
}

impl Drop for Video {
    fn drop(&mut self) {
        // It may have ended by itself.
        self.child.kill().ok();
        self.child.wait().ok();
    }
}
