//! An episode as what a robot would have sent: frames, and the actions that led to them.

use std::{
    ops::Range,
    path::{Path, PathBuf},
};

use anyhow::Context as _;
use gatsbi_client::{Image, Observation};
use gatsbi_episodes::{Dataset, DatasetInfo, Episode};

use crate::failure::misuse;

/// One recorded episode.
#[derive(Debug)]
pub(crate) struct Recording {
    pub(crate) path: PathBuf,
    pub(crate) index: usize,
    /// Episodes in the file.
    pub(crate) of: usize,
    pub(crate) info: DatasetInfo,
    pub(crate) episode: Episode,
}

impl Recording {
    pub(crate) fn open(path: &Path, index: usize) -> anyhow::Result<Self> {
        let dataset = Dataset::open(path).with_context(|| format!("{}", path.display()))?;
        if index >= dataset.len() {
            misuse!(
                "--index is {index}, expected 0 to {}: {} has {} episodes",
                dataset.len().saturating_sub(1),
                path.display(),
                dataset.len()
            );
        }
        let episode = dataset.read(index).with_context(|| format!("{}", path.display()))?;
        let (info, of) = (dataset.info().clone(), dataset.len());
        Ok(Self { path: path.to_owned(), index, of, info, episode })
    }

    /// Frame `t` as observation `step`, with the action that led to it; nothing led to frame 0.
    pub(crate) fn observation(&self, t: usize, step: u64) -> anyhow::Result<Observation> {
        let pixels = self.episode.frame(t).to_vec();
        let image = Image::rgb(self.info.width, self.info.height, pixels)?;
        let action = t.checked_sub(1).map(|before| self.episode.action(before).to_vec());
        Ok(Observation { step, image: Some(image), action: action.unwrap_or_default() })
    }

    /// The actions that followed frame `from`, as many as `horizon` says or all that led to a recorded frame.
    pub(crate) fn actions(
        &self,
        from: usize,
        horizon: Option<usize>,
    ) -> anyhow::Result<Vec<Vec<f32>>> {
        let left = (self.episode.length() - 1).saturating_sub(from);
        if left == 0 {
            misuse!("no recorded frame follows frame {from}: {}", self.described());
        }
        let horizon = horizon.unwrap_or(left);
        if horizon > left {
            misuse!("--horizon is {horizon}, expected 1 to {left}: {}", self.described());
        }
        Ok((from..from + horizon).map(|t| self.episode.action(t).to_vec()).collect())
    }

    /// The episode in words.
    pub(crate) fn described(&self) -> String {
        format!(
            "episode {} (--index {}) of {} has {} frames",
            self.episode.id(),
            self.index,
            self.path.display(),
            self.episode.length()
        )
    }

    /// Checks that frames are in the episode.
    pub(crate) fn frames(&self, wanted: Range<usize>) -> anyhow::Result<Range<usize>> {
        if wanted.is_empty() || wanted.end > self.episode.length() {
            misuse!(
                "--frames is {}..{}, expected A..B with A < B <= {}: {}",
                wanted.start,
                wanted.end,
                self.episode.length(),
                self.described()
            );
        }
        Ok(wanted)
    }
}

/// Frames of an episode: `A..B` without B; either end may be left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Frames {
    pub(crate) start: Option<usize>,
    pub(crate) end: Option<usize>,
}

impl std::str::FromStr for Frames {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || "expected A..B, A.. or ..B, counted from 0 and without B".to_owned();
        let (start, end) = text.split_once("..").ok_or_else(wrong)?;
        let bound = |text: &str| match text {
            "" => Ok(None),
            text => text.parse().ok().ok_or_else(wrong).map(Some),
        };
        Ok(Self { start: bound(start)?, end: bound(end)? })
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// The first sample episode.
    pub(crate) fn sample() -> Recording {
        let path =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../episodes/samples/push1-heldout.parquet");
        Recording::open(&path, 0).unwrap()
    }

    #[test]
    fn frames_may_be_open_at_either_end() {
        let parse = |text: &str| text.parse::<Frames>();
        assert_eq!(parse("2..5"), Ok(Frames { start: Some(2), end: Some(5) }));
        assert_eq!(parse("..5"), Ok(Frames { start: None, end: Some(5) }));
        assert_eq!(parse("2.."), Ok(Frames { start: Some(2), end: None }));
        for wrong in ["", "5", "a..b", "-1..2", "1..2..3"] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_frame_goes_with_the_action_that_led_to_it() {
        let recording = sample();
        assert!(recording.observation(0, 0).unwrap().action.is_empty());
        let observation = recording.observation(3, 8).unwrap();
        assert_eq!(observation.step, 8);
        assert_eq!(observation.action, recording.episode.action(2));
        let actions = recording.actions(3, Some(2)).unwrap();
        assert_eq!(actions, [recording.episode.action(3), recording.episode.action(4)]);
    }

    #[test]
    fn what_was_not_recorded_is_refused() {
        let recording = sample();
        let length = recording.episode.length();
        assert_eq!(recording.actions(length - 2, None).unwrap().len(), 1);
        for error in [
            recording.actions(length - 1, None).unwrap_err(),
            recording.actions(0, Some(length)).unwrap_err(),
            recording.frames(0..length + 1).unwrap_err(),
            recording.frames(4..4).unwrap_err(),
            Recording::open(&recording.path, recording.of).unwrap_err(),
        ] {
            let sentence = error.to_string();
            assert!(sentence.contains(&recording.path.display().to_string()), "{sentence}");
        }
    }
}
