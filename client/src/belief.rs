//! What a session believes after a step.

use gatsbi_proto::v1;

use crate::{Object, Timing, error::Error, output::Outputs};

/// The belief after a step.
#[derive(Clone, Debug, PartialEq)]
pub struct Belief {
    /// The session.
    pub session_id: String,
    /// The step.
    pub step: u64,
    /// SHA-256 of the checkpoint that computed it, hexadecimal.
    pub model_hash: String,
    /// Whether the step came without an image, so that the belief is a prediction.
    pub predicted: bool,
    /// Whether this is the stored answer to an equal request that was made before.
    pub repeated: bool,
    /// The objects, if they were asked for: every slot that holds or has held one. Look at the presence.
    pub objects: Vec<Object>,
    /// The other outputs that were asked for, each with the shape of one step, such as `[H, W]` for the agent's mask.
    pub outputs: Outputs,
    /// Where the time went.
    pub timing: Timing,
}

impl Belief {
    /// The objects that are there more surely than not.
    pub fn present(&self) -> impl Iterator<Item = &Object> {
        self.objects.iter().filter(|object| object.presence > 0.5)
    }
}

impl TryFrom<v1::Belief> for Belief {
    type Error = Error;

    fn try_from(belief: v1::Belief) -> Result<Self, Error> {
        Ok(Self {
            session_id: belief.session_id,
            step: belief.step,
            model_hash: belief.model_hash,
            predicted: belief.predicted,
            repeated: belief.repeated,
            objects: belief.objects,
            outputs: belief.outputs.try_into()?,
            timing: belief.timing.unwrap_or_default(),
        })
    }
}
