//! Predictions in bulk: many rollouts from many starts, as they come and as there is room.

use std::{pin::pin, sync::Arc};

use futures_util::{Stream, StreamExt as _, stream::unfold};
use gatsbi_proto::v1;
use tokio::{
    sync::{Semaphore, mpsc},
    task::JoinSet,
};
use tokio_util::task::AbortOnDropHandle;

use super::{Call, Service, imagine::Asked, rollout::Rollout};
use crate::{
    engine::commands::{Tenant, Urgency},
    error::Error,
};

/// Predictions of one stream that are under way together.
const TOGETHER: usize = 64;

/// A part of the answer to one prediction.
#[derive(Debug)]
pub struct Prediction {
    /// The client's number for it.
    pub key: u64,
    /// A chunk, or why there are no more.
    pub chunk: Result<v1::RolloutChunk, Error>,
}

impl Service {
    /// Predicts for every request, in any order. Dropped, what is under way ends.
    pub fn predict_batch<E, R>(
        self: &Arc<Self>,
        requests: R,
        call: Call,
    ) -> impl Stream<Item = Result<Prediction, E>> + Send + use<E, R>
    where
        E: Send + 'static,
        R: Stream<Item = Result<v1::PredictBatchRequest, E>> + Send + 'static,
    {
        let (answers, received) = mpsc::channel(TOGETHER);
        // A stream shares the model as one, whatever its predictions start from.
        let tenant = call.tenant.unwrap_or_else(|| Tenant(rand::random()));
        let driver = drive(Arc::clone(self), requests, tenant, answers);
        let driver = AbortOnDropHandle::new(tokio::spawn(driver));
        unfold((received, driver), |(mut received, driver)| async move {
            let answer = received.recv().await?;
            Some((answer, (received, driver)))
        })
    }

    /// Starts one prediction.
    async fn predict(
        &self,
        request: v1::PredictBatchRequest,
        tenant: Tenant,
    ) -> Result<Rollout, Error> {
        let position = self.begin(request.start, "start").await?;
        let asked = Asked {
            actions: request.actions,
            sampling: request.sampling,
            outputs: request.outputs,
            costs: request.costs,
        };
        let plan = self.plan(asked, &position.model.spec)?;
        let (rows, bytes) = self.engine.bulk_limit();
        if plan.rows() > rows {
            let expected = format!("at most {rows} rows in a batch");
            return Err(Error::invalid("actions", format!("{} rows", plan.rows()), expected));
        }
        if plan.output_bytes > bytes {
            let expected = format!("at most {bytes} bytes in a batch");
            return Err(Error::invalid(
                "outputs",
                format!("{} bytes", plan.output_bytes),
                expected,
            ));
        }
        self.roll_out(plan, &position, (tenant, Urgency::Bulk), None).await
    }
}

/// Takes requests as there is room for them, and works on some together.
async fn drive<E: Send + 'static>(
    service: Arc<Service>,
    requests: impl Stream<Item = Result<v1::PredictBatchRequest, E>> + Send,
    tenant: Tenant,
    answers: mpsc::Sender<Result<Prediction, E>>,
) {
    let mut requests = pin!(requests);
    let room = Arc::new(Semaphore::new(TOGETHER));
    let mut under_way = JoinSet::new();
    let (mut outputs, mut costs) = (None, None);
    loop {
        let Ok(permit) = Arc::clone(&room).acquire_owned().await else { return };
        let request = tokio::select! {
            request = requests.next() => request,
            () = answers.closed() => return,
            () = service.stop.cancelled() => None,
        };
        let mut request = match request {
            Some(Ok(request)) => request,
            Some(Err(error)) => {
                answers.send(Err(error)).await.ok();
                break;
            }
            None => break,
        };
        outputs = request.outputs.take().or(outputs);
        costs = request.costs.take().or(costs);
        let request =
            v1::PredictBatchRequest { outputs: outputs.clone(), costs: costs.clone(), ..request };
        let (service, answers) = (Arc::clone(&service), answers.clone());
        under_way.spawn(async move {
            let _permit = permit;
            answer(&service, request, tenant, &answers).await;
        });
        while under_way.try_join_next().is_some() {}
    }
    while under_way.join_next().await.is_some() {}
}

/// Sends the answers to one request, unless the client goes away.
async fn answer<E>(
    service: &Service,
    request: v1::PredictBatchRequest,
    tenant: Tenant,
    answers: &mpsc::Sender<Result<Prediction, E>>,
) {
    let key = request.key;
    let mut rollout = match service.predict(request, tenant).await {
        Ok(rollout) => rollout,
        Err(error) => {
            answers.send(Ok(Prediction { key, chunk: Err(error) })).await.ok();
            return;
        }
    };
    while let Some(chunk) = rollout.next().await {
        if answers.send(Ok(Prediction { key, chunk })).await.is_err() {
            return;
        }
    }
}
