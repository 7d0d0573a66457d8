//! Puts what an episode shows, frame by frame, into the columns of a data set.

use gatsbi_episodes::EpisodeData;
use sha2::{Digest as _, Sha256};

use crate::Observation;

/// An episode that is being recorded.
pub(crate) struct Recorder {
    data: EpisodeData,
    mask: Vec<u8>,
    positions: Vec<f32>,
    pixels: Vec<f32>,
    poses: Vec<f32>,
    ee_pose: Vec<f32>,
    joints: Vec<f32>,
    contacts_agent: Vec<u8>,
    contacts_objects: Vec<u8>,
    states: Sha256,
}

impl Recorder {
    pub(crate) fn new(episode_id: u64, seed: u64) -> Self {
        Self {
            data: EpisodeData { episode_id, seed: Some(seed), ..EpisodeData::default() },
            mask: Vec::new(),
            positions: Vec::new(),
            pixels: Vec::new(),
            poses: Vec::new(),
            ee_pose: Vec::new(),
            joints: Vec::new(),
            contacts_agent: Vec::new(),
            contacts_objects: Vec::new(),
            states: Sha256::new(),
        }
    }

    /// Adds a frame and the action that is held after it.
    pub(crate) fn add(&mut self, seen: &Observation, action: &[f32]) {
        let state = &seen.state;
        self.data.length += 1;
        self.data.object_count = Some(state.objects.len() as u32);
        self.data.rgb.extend_from_slice(&seen.rgb);
        self.data.actions.extend_from_slice(action);
        self.mask.extend_from_slice(&seen.mask);
        for object in &state.objects {
            self.positions.extend(object.position.map(|value| value as f32));
            self.pixels.extend(object.pixel.map(|value| value as f32));
            self.poses.extend(object.quaternion.map(|value| value as f32));
        }
        self.ee_pose.extend(state.ee_pose.iter().flatten().map(|&value| value as f32));
        self.joints.extend(state.joint_positions.iter().map(|&value| value as f32));
        self.contacts_agent.extend(state.contacts_agent.iter().copied().map(u8::from));
        self.contacts_objects.extend(state.contacts_objects.iter().copied().map(u8::from));
        for value in &state.full {
            self.states.update(value.to_le_bytes());
        }
        for value in action {
            self.states.update(value.to_le_bytes());
        }
    }

    /// The row of the data set. The hash is over the states and actions of all frames as they are computed, in little
    /// endian, f64 and f32.
    pub(crate) fn finish(self) -> EpisodeData {
        let acts = !self.ee_pose.is_empty();
        EpisodeData {
            mask: Some(self.mask),
            object_positions: Some(self.positions),
            object_pixels: Some(self.pixels),
            object_poses: Some(self.poses),
            ee_pose: acts.then_some(self.ee_pose),
            joint_positions: acts.then_some(self.joints),
            contacts_agent: acts.then_some(self.contacts_agent),
            contacts_objects: Some(self.contacts_objects),
            state_hash: Some(self.states.finalize().into()),
            ..self.data
        }
    }
}
