//! Where predictions start: at a session's belief, at a snapshot's, or at what a model believes after some frames.

use std::sync::Arc;

use gatsbi_models::scene::Outputs;
use gatsbi_proto::v1::{self, DataType, image::Content, start::From};

use super::Service;
use crate::{
    engine::commands::{Form, Observe, Urgency, Wanted},
    error::Error,
    frame::Frame,
    sessions::session::{Draws, Position},
    tensor,
};

impl Service {
    /// Where a start is, whose path in the request is `field`. Frames are observed as bulk work.
    ///
    /// # Errors
    /// If the start is none, or the model fails on its frames.
    pub(super) async fn begin(
        &self,
        start: Option<v1::Start>,
        field: &str,
    ) -> Result<Position, Error> {
        match start.and_then(|start| start.from) {
            Some(From::Session(v1::SessionStart { session_id, at_step })) => {
                let session = self.session(&session_id)?;
                let position = session.position();
                position.last(at_step)?;
                Ok(position)
            }
            Some(From::Snapshot(bytes)) => {
                let position = self.position_of(&bytes, &format!("{field}.snapshot"))?;
                position.last(None)?;
                Ok(position)
            }
            Some(From::Context(context)) => {
                self.observed(context, &format!("{field}.context")).await
            }
            None => Err(Error::invalid(field, "absent", "a session, a snapshot or a context")),
        }
    }

    async fn observed(&self, context: v1::Context, field: &str) -> Result<Position, Error> {
        let (frames_field, actions_field) = (format!("{field}.frames"), format!("{field}.actions"));
        let model = self.catalogue.get(&context.model)?;
        let width = model.spec.actions.len();
        let frames = context.frames.unwrap_or_default();
        let [count, height, image_width, 3] = *frames.shape.as_slice() else {
            let (field, found) = (format!("{frames_field}.shape"), format!("{:?}", frames.shape));
            return Err(Error::invalid(field, found, "[T, height, width, 3]"));
        };
        let most = self.limits.max_horizon;
        if !(1..=most).contains(&count) {
            let expected = format!("1 to {most} frames");
            return Err(Error::invalid(format!("{frames_field}.shape"), count, expected));
        }
        if frames.dtype() != DataType::U8 {
            let found = frames.dtype().as_str_name();
            return Err(Error::invalid(format!("{frames_field}.dtype"), found, "DATA_TYPE_U8"));
        }
        tensor::bytes(&frames, &frames_field)?;
        let actions = match context.actions {
            None if width == 0 => v1::Tensor { shape: vec![count, 0], ..f32_tensor() },
            actions => actions.unwrap_or_default(),
        };
        let given = match *actions.shape.as_slice() {
            [given, found] if found as usize == width && (given == count || given + 1 == count) => {
                given
            }
            _ => {
                let expected = format!("[{count}, {width}] or [{}, {width}]", count - 1);
                let (field, found) =
                    (format!("{actions_field}.shape"), format!("{:?}", actions.shape));
                return Err(Error::invalid(field, found, expected));
            }
        };
        let numbers = tensor::floats(&actions, &actions_field)?;
        let draws = Draws { sample: context.seed.is_some(), seed: context.seed.unwrap_or(0) };
        let state = Arc::clone(&model.initial);
        let mut position = Position { model, draws, next_step: 0, state, image: (0, 0) };
        let bytes = frames.data.len() / count as usize;
        for step in 0..u64::from(count) {
            let at = step as usize;
            let pixels = v1::Tensor {
                dtype: DataType::U8.into(),
                shape: vec![height, image_width, 3],
                data: frames.data.slice(at * bytes..(at + 1) * bytes),
                values: Vec::new(),
            };
            let image = v1::Image { content: Some(Content::Pixels(pixels)) };
            let fitted = self.fit(image, &frames_field, &position.model).await?;
            // Without an action to the first frame, the second's comes first.
            let action = match (at + given as usize).checked_sub(count as usize) {
                None => position.model.spec.neutral_action(),
                Some(at) => numbers[at * width..][..width].to_vec(),
            };
            position = self.replayed(position, Some(fitted.frame), action).await?;
            position.image = fitted.sent;
        }
        Ok(position)
    }

    /// Where a session would be after one more observation, as bulk work.
    pub(super) async fn replayed(
        &self,
        position: Position,
        frame: Option<Frame>,
        action: Vec<f32>,
    ) -> Result<Position, Error> {
        let Position { model, draws, next_step, state, image } = position;
        let nothing = Outputs::default();
        let observed = self
            .engine
            .observe(Observe {
                model: Arc::clone(&model),
                state,
                frame,
                action,
                noise: draws.noise(next_step),
                lane: draws.seed,
                wanted: Wanted { outputs: nothing, form: Form::F32, spread: nothing },
                deadline: None,
                urgency: Urgency::Bulk,
            })
            .await?;
        Ok(Position { model, draws, next_step: next_step + 1, state: observed.state, image })
    }
}

fn f32_tensor() -> v1::Tensor {
    v1::Tensor { dtype: DataType::F32.into(), ..v1::Tensor::default() }
}
