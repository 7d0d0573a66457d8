//! What a step can tell about a scene, computed only as far as asked for.

use serde::{Deserialize, Serialize};
use tch::Tensor;

/// One thing that can be asked for.
#[derive(Clone, Copy, Debug, Deserialize, Eq, Hash, Ord, PartialEq, PartialOrd, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Output {
    /// The whole image.
    Frame,
    /// Visible pixels of the agent.
    AgentMask,
    /// Visible pixels of each mixture slot.
    SlotMasks,
    /// Visible pixels of each object.
    ObjectMasks,
    /// The image without agent and objects.
    Background,
    /// Table of objects.
    Objects,
    /// All latent vectors.
    Latents,
    /// How unexpected the frame was; observed frames only.
    Surprise,
    /// Log likelihood of the frame; observed frames only.
    LogLikelihood,
    /// Keypoints; observed frames only, and only if the model has a detector.
    Keypoints,
}

impl Output {
    /// All outputs in order.
    pub const ALL: [Self; 10] = [
        Self::Frame,
        Self::AgentMask,
        Self::SlotMasks,
        Self::ObjectMasks,
        Self::Background,
        Self::Objects,
        Self::Latents,
        Self::Surprise,
        Self::LogLikelihood,
        Self::Keypoints,
    ];

    /// Whether it compares a prediction with a frame, and so does not exist for imagined steps.
    pub fn needs_frame(self) -> bool {
        matches!(self, Self::Surprise | Self::LogLikelihood | Self::Keypoints)
    }
}

/// A set of [`Output`]s.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Outputs(u16);

impl Outputs {
    /// Whether `output` is asked for.
    pub fn contains(self, output: Output) -> bool {
        self.0 & (1 << output as u16) != 0
    }

    /// Whether any of `outputs` is asked for.
    pub fn contains_any(self, outputs: &[Output]) -> bool {
        outputs.iter().any(|output| self.contains(*output))
    }

    /// What is asked for here or there.
    #[must_use]
    pub fn union(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// The outputs in order.
    pub fn iter(self) -> impl Iterator<Item = Output> {
        Output::ALL.into_iter().filter(move |output| self.contains(*output))
    }
}

impl FromIterator<Output> for Outputs {
    fn from_iter<I: IntoIterator<Item = Output>>(outputs: I) -> Self {
        Self(outputs.into_iter().fold(0, |bits, output| bits | 1 << output as u16))
    }
}

/// Objects of a batch, one slot each; empty slots have presence near 0.
#[derive(Debug)]
pub struct ObjectTable {
    /// Identities, `[B, MAX]` int64; -1 in slots never filled.
    pub ids: Tensor,
    /// `(presence, x, y, width, height, depth)`, `[B, MAX, 6]`: presence in [0, 1]; x right and y down in
    /// [-1, 1]; sizes as fractions of the image; depth without unit, smaller is nearer.
    pub values: Tensor,
}

/// The decomposition of a batch of scenes; what was not asked for is absent.
///
/// Slot and object masks are shares of the image: over all slots and objects they sum to one at every pixel.
#[derive(Debug, Default)]
pub struct Scene {
    /// `mu_t`, the whole image in [0, 1], `[B, 3, H, W]`.
    pub frame: Option<Tensor>,
    /// `(1 - alpha) π^r`, `[B, H, W]`.
    pub agent_mask: Option<Tensor>,
    /// `(1 - alpha) π_k`, `[B, K, H, W]`.
    pub slot_masks: Option<Tensor>,
    /// Each object's share of alpha, `[B, MAX, H, W]`.
    pub object_masks: Option<Tensor>,
    /// Slots other than the agent's, weighted by their masks, in [0, 1], `[B, 3, H, W]`.
    pub background: Option<Tensor>,
    /// Objects.
    pub objects: Option<ObjectTable>,
    /// Mask, component and object latents, `[B, K z_mask + K z_comp + MAX Z]`.
    pub latents: Option<Tensor>,
    /// KL from posterior to prior of mixture latents and of the dynamics of present objects, in nats, `[B]`.
    pub surprise: Option<Tensor>,
    /// log N(frame | `mu_t`, 0.1²) in nats, `[B]`.
    pub log_likelihood: Option<Tensor>,
    /// `(x, y, strength)`, x right and y down in [-1, 1], strength in [0, 1], `[B, N, 3]`.
    pub keypoints: Option<Tensor>,
}

impl Scene {
    /// The tensors of the scene by output; the object table is given by its values.
    pub fn tensors(&self) -> impl Iterator<Item = (Output, &Tensor)> {
        [
            (Output::Frame, &self.frame),
            (Output::AgentMask, &self.agent_mask),
            (Output::SlotMasks, &self.slot_masks),
            (Output::ObjectMasks, &self.object_masks),
            (Output::Background, &self.background),
            (Output::Latents, &self.latents),
            (Output::Surprise, &self.surprise),
            (Output::LogLikelihood, &self.log_likelihood),
            (Output::Keypoints, &self.keypoints),
        ]
        .into_iter()
        .filter_map(|(output, tensor)| Some((output, tensor.as_ref()?)))
        .chain(self.objects.as_ref().map(|table| (Output::Objects, &table.values)))
    }
}
