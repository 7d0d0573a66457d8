//! Observing: one step of a session, once and in order.

use std::{sync::Arc, time::Instant};

use gatsbi_models::scene::Output;
use gatsbi_proto::v1;
use prost::Message as _;
use sha2::{Digest as _, Sha256};
use tokio::time::timeout_at;

use super::{
    Call, Service, answer, aside,
    fields::{self, Selection, Steps},
    show,
};
use crate::{
    engine::{
        commands::{Observe, Urgency, Value, Wanted},
        models::ModelEntry,
    },
    error::Error,
    media::{self, Fitted, Target},
    sessions::{
        live::Shown,
        session::{Answer, Position, Seen, Session},
    },
    telemetry,
};

impl Service {
    /// Absorbs one observation.
    ///
    /// # Errors
    /// If the request is wrong, or the step does not follow, or the model cannot answer in time. The belief has then
    /// not moved.
    pub async fn observe(
        &self,
        request: v1::ObserveRequest,
        call: Call,
    ) -> Result<v1::ObserveResponse, Error> {
        let belief = self.observe_unless(false, request, call).await?;
        Ok(v1::ObserveResponse { belief: Some(belief) })
    }

    /// Absorbs one observation, without its image if that is to be skipped; the first image never is.
    ///
    /// # Errors
    /// As [`Self::observe`].
    pub async fn observe_unless(
        &self,
        skip_image: bool,
        request: v1::ObserveRequest,
        call: Call,
    ) -> Result<v1::Belief, Error> {
        let session = self.session(&request.session_id)?;
        let deadline = fields::deadline(request.timeout_millis, call.deadline)?;
        let outputs = request.outputs.unwrap_or_default();
        let observation = request.observation.unwrap_or_default();
        let absorbing = self.absorb(&session, (observation, skip_image), &outputs, deadline);
        match deadline {
            None => absorbing.await,
            // Dropped, it commits nothing.
            Some(at) => {
                timeout_at(at.into(), absorbing).await.unwrap_or(Err(Error::DeadlineExceeded))
            }
        }
    }

    async fn absorb(
        &self,
        session: &Session,
        (observation, skip_image): (v1::Observation, bool),
        outputs: &v1::OutputSelection,
        deadline: Option<Instant>,
    ) -> Result<v1::Belief, Error> {
        let Some(step) = observation.step else {
            return Err(Error::invalid("observation.step", "absent", "the number of the step"));
        };
        let digest = digest(&observation, outputs);

        let _turn = session.turn.lock().await;
        let Position { model, draws, next_step, state, image } = session.position();
        let selection = fields::selection(outputs, Steps::Observed, &model.spec)?;
        if step != next_step {
            return repeated(session, step, next_step, digest);
        }
        let field = "observation.action";
        let action = fields::action(&observation.action, field, step == 0, &model.spec)?;
        let began = Instant::now();
        let image_skipped = skip_image && step > 0 && observation.image.is_some();
        let fitted = match observation.image.filter(|_| !image_skipped) {
            Some(image) => Some(self.fit(image, "observation.image", &model).await?),
            None if step == 0 => {
                let expected = "an image: a session's first observation needs one";
                return Err(Error::invalid("observation.image", "absent", expected));
            }
            None => None,
        };
        let decoding = began.elapsed();
        let image = fitted.as_ref().map_or(image, |fitted| fitted.sent);
        let frame = fitted.map(|fitted| fitted.frame);
        let seen = Seen { step, frame: frame.clone(), action: action.clone(), image };
        let wanted = Wanted { spread: Self::besides(session, &model.spec), ..selection.wanted };
        let observed = self
            .engine
            .observe(Observe {
                model: Arc::clone(&model),
                state,
                frame,
                action,
                noise: draws.noise(step),
                lane: draws.seed,
                wanted,
                deadline,
                urgency: Urgency::Live,
            })
            .await?;
        telemetry::waited(telemetry::Kind::Observe, observed.spent.queue);
        if image_skipped {
            telemetry::image_skipped();
        }
        let besides = observed.besides;
        let began = Instant::now();
        let objects = answer::objects(&observed.values, image, model.spec.preprocess);
        let outputs = self.outputs(observed.values, selection).await?;
        let belief = v1::Belief {
            session_id: session.id.to_string(),
            step,
            model_hash: model.spec.hash.clone(),
            predicted: seen.frame.is_none(),
            repeated: false,
            image_skipped,
            outputs,
            objects,
            timing: Some(answer::timing(observed.spent, decoding + began.elapsed())),
        };
        let shown = (!besides.is_empty()).then(|| {
            let (seen, timing) = (seen.clone(), belief.timing.unwrap_or_default());
            Arc::new(Shown { image_skipped, ..show::shown(&model.spec, seen, besides, timing) })
        });
        let position = Position { model, draws, next_step: step + 1, state: observed.state, image };
        session.commit(position, Answer { digest, belief: belief.clone() }, seen);
        if let Some(shown) = shown {
            session.live.show(shown);
        }
        let v1::Timing { queue_micros, compute_micros, encode_micros } =
            belief.timing.unwrap_or_default();
        tracing::debug!(
            session = %session.id, step, queue_micros, compute_micros, encode_micros, "observed"
        );
        Ok(belief)
    }

    /// Decodes and fits an image, where it keeps nobody waiting.
    pub(super) async fn fit(
        &self,
        image: v1::Image,
        field: &str,
        model: &ModelEntry,
    ) -> Result<Fitted, Error> {
        let target = Target {
            size: model.spec.image_size as u32,
            preprocess: model.spec.preprocess,
            max_side: self.limits.max_image_side,
        };
        let slow = media::is_slow(&image, target);
        let field = field.to_owned();
        let fit = move || media::fit(&image, &field, target);
        if slow { aside(fit).await? } else { fit() }
    }

    /// Outputs of one row, without the object table.
    async fn outputs(
        &self,
        values: Vec<Value>,
        selection: Selection,
    ) -> Result<Vec<v1::OutputValue>, Error> {
        let values: Vec<Value> =
            values.into_iter().filter(|value| value.output != Output::Objects).collect();
        let encode = move || answer::outputs(values, &[], selection.png);
        if selection.png { aside(encode).await } else { Ok(encode()) }
    }
}

/// The stored answer to an equal observation, or why there is none.
fn repeated(
    session: &Session,
    step: u64,
    expected: u64,
    digest: [u8; 32],
) -> Result<v1::Belief, Error> {
    match session.answer() {
        Some(answer) if answer.belief.step == step && answer.digest == digest => {
            Ok(v1::Belief { repeated: true, ..answer.belief })
        }
        Some(answer) if answer.belief.step == step => Err(Error::StepConflict { step }),
        _ => Err(Error::StepGap { step, expected }),
    }
}

/// What makes two observations of a step the same.
fn digest(observation: &v1::Observation, outputs: &v1::OutputSelection) -> [u8; 32] {
    let mut hash = Sha256::new();
    hash.update(observation.encode_length_delimited_to_vec());
    hash.update(outputs.encode_to_vec());
    hash.finalize().into()
}
