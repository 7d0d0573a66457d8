//! A run of consecutive frames of one episode together with the actions that led to them: what a model is trained on.
//!
//! An episode stores the action that *follows* each frame. A model that observes frame `t` wants the action that *led* to it,
//! `a_{t-1}`. A clip of `T` frames from frame `s` therefore pairs frames `s..s+T` with actions `a_{s-1}..a_{s+T-2}`; at `s = 0`
//! nothing led to the first frame, and [`Clip::leading_action`] is `None`.

use crate::{Episode, InvalidEpisode};

/// Frames `start..start + T` of an episode, and the action before the first of them.
#[derive(Clone, Debug)]
pub struct Clip {
    start: usize,
    leading_action: Option<Vec<f32>>,
    frames: Episode,
}

impl Clip {
    /// Cuts `length` frames from `start` out of an episode.
    ///
    /// # Errors
    /// [`InvalidEpisode::Range`] if the episode does not have these frames or `length` is 0.
    pub fn cut(episode: &Episode, start: usize, length: usize) -> Result<Self, InvalidEpisode> {
        let frames = episode.slice(start, length)?;
        let leading_action = start.checked_sub(1).map(|before| episode.action(before).to_vec());
        Ok(Self { start, leading_action, frames })
    }

    /// The whole episode as one clip.
    pub fn whole(episode: Episode) -> Self {
        Self { start: 0, leading_action: None, frames: episode }
    }

    /// Index in the episode of the clip's first frame.
    pub fn start(&self) -> usize {
        self.start
    }

    /// The action that led to the first frame, `[A]`; `None` at the start of an episode.
    pub fn leading_action(&self) -> Option<&[f32]> {
        self.leading_action.as_deref()
    }

    /// The clip's frames as an episode of their own: frames, masks, objects, and the actions *after* each frame.
    pub fn frames(&self) -> &Episode {
        &self.frames
    }

    /// The actions that led to each frame, `[T,A]`. Where nothing led to the first one its row is zeros, and
    /// [`Clip::leading_action`] is the flag that says so.
    pub fn actions_before(&self) -> Vec<f32> {
        let actions = &self.frames.data().actions;
        let width = actions.len() / self.frames.length();
        let mut before = Vec::with_capacity(actions.len());
        match &self.leading_action {
            Some(action) => before.extend_from_slice(action),
            None => before.resize(width, 0.0),
        }
        before.extend_from_slice(&actions[..actions.len() - width]);
        before
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::episode;

    #[test]
    fn a_clip_pairs_each_frame_with_the_action_that_led_to_it() {
        let episode = episode(5, 9, 2);
        for (start, length) in [(1, 1), (1, 8), (3, 4), (8, 1)] {
            let clip = Clip::cut(&episode, start, length).unwrap();
            let before = clip.actions_before();
            assert_eq!(before.len(), length * 2);
            for k in 0..length {
                assert_eq!(clip.frames().frame(k), episode.frame(start + k));
                assert_eq!(clip.frames().mask(k), episode.mask(start + k));
                assert_eq!(
                    before[k * 2..][..2],
                    *episode.action(start + k - 1),
                    "frame {k} of {start}"
                );
                assert_eq!(clip.frames().action(k), episode.action(start + k));
                assert_eq!(
                    clip.frames().object_position(k, 1),
                    episode.object_position(start + k, 1)
                );
            }
            assert_eq!(clip.leading_action(), Some(episode.action(start - 1)));
        }
    }

    #[test]
    fn nothing_leads_to_the_first_frame_of_an_episode() {
        let episode = episode(5, 9, 2);
        let whole = Clip::whole(episode.clone());
        for clip in [Clip::cut(&episode, 0, 9).unwrap(), whole] {
            assert_eq!(clip.leading_action(), None);
            let before = clip.actions_before();
            assert_eq!(before[..2], [0.0, 0.0]);
            assert_eq!(before[2..], episode.data().actions[..16]);
        }
    }

    #[test]
    fn the_state_hash_stays_with_the_whole_episode() {
        let episode = episode(5, 9, 2);
        assert!(Clip::cut(&episode, 0, 9).unwrap().frames().data().state_hash.is_some());
        assert!(Clip::cut(&episode, 0, 8).unwrap().frames().data().state_hash.is_none());
    }

    #[test]
    fn frames_that_are_not_there_are_refused() {
        let episode = episode(5, 9, 2);
        for (start, length) in [(0_usize, 0), (0, 10), (9, 1), (4, usize::MAX)] {
            let end = start.saturating_add(length);
            let expected = InvalidEpisode::Range { start, end, frames: 9 };
            assert_eq!(Clip::cut(&episode, start, length).unwrap_err(), expected);
        }
    }
}
