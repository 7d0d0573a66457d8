//! The contract between a world model and whoever serves it.

use serde::{Deserialize, Serialize};
use tch::{Device, Tensor};

use crate::{
    noise::Noise,
    scene::{Outputs, Scene},
    state::{State, StateLayout},
};

/// A recurrent, action-conditioned model of a scene.
///
/// Steps are pure functions of their arguments: no hidden state, no global random numbers, no shape that
/// depends on data, and no row of a batch depends on another.
pub trait WorldModel: Send + Sync {
    /// What the model takes and gives.
    fn spec(&self) -> &ModelSpec;

    /// How a session's state is laid out.
    fn layout(&self) -> &StateLayout;

    /// Where the model computes.
    fn device(&self) -> Device;

    /// The state of `batch` sessions that have seen nothing.
    fn initial_state(&self, batch: i64) -> State;

    /// Absorbs a frame, or passes over one that did not come.
    ///
    /// # Shapes
    /// `frame [B, 3, H, W]` in [0, 1], absent for all rows or none; `action [B, A]` in raw units, the one that
    /// led to the frame ([`ModelSpec::neutral_action`] where there is none).
    fn observe(
        &self,
        state: &State,
        frame: Option<&Tensor>,
        action: &Tensor,
        noise: &dyn Noise,
        wanted: Outputs,
    ) -> (State, Scene);

    /// Predicts a step under `action [B, A]` in raw units.
    fn imagine(
        &self,
        state: &State,
        action: &Tensor,
        noise: &dyn Noise,
        wanted: Outputs,
    ) -> (State, Scene);
}

/// What a model takes and gives.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelSpec {
    /// Name from the checkpoint.
    pub name: String,
    /// SHA-256 of the checkpoint, hexadecimal.
    pub hash: String,
    /// Height and width of frames in pixels.
    pub image_size: i64,
    /// How frames of another size are fitted.
    pub preprocess: Preprocess,
    /// Seconds between frames in the data it learned from.
    pub frame_period: Option<f64>,
    /// Dimensions of an action, in order.
    pub actions: Vec<ActionDimension>,
    /// Mixture slots K.
    pub slots: i64,
    /// Slot of the agent; absent in scenes without one.
    pub agent_slot: Option<i64>,
    /// Object slots.
    pub max_objects: i64,
    /// Keypoints of the detector; absent without one.
    pub keypoints: Option<i64>,
    /// Width of the latents output.
    pub latents: i64,
    /// Optimiser steps it was trained for; 0 means untrained.
    pub trained_steps: u64,
    /// Where it comes from, as JSON.
    pub provenance: String,
}

impl ModelSpec {
    /// The action that stands for "none": it scales to zero.
    pub fn neutral_action(&self) -> Vec<f32> {
        self.actions.iter().map(|dimension| dimension.offset as f32).collect()
    }
}

/// One dimension of an action: `network input = (raw - offset) / scale`.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ActionDimension {
    /// What it moves.
    pub name: String,
    /// Unit of the raw number.
    pub unit: String,
    /// Raw number that the network sees as 0.
    pub offset: f64,
    /// Raw difference that the network sees as 1.
    pub scale: f64,
}

/// How a frame of another size is fitted to the model's, antialiased.
#[derive(Clone, Copy, Debug, Deserialize, Eq, PartialEq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Preprocess {
    /// Both sides to the model's size.
    Stretch,
    /// The largest centred square, then to the model's size.
    CentreCrop,
}
