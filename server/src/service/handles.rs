//! Handles: rows that a policy outside steps, all of them together, one action each.
//!
//! A set of handles is opened at some starts and belongs to whoever knows its id. Its rows are states like any other;
//! a step brings them to the engine and takes the next ones along, so that a step that fails has moved none.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use bytes::BytesMut;
use futures_util::{StreamExt as _, TryStreamExt as _, stream::iter};
use gatsbi_models::{noise::RowNoise, state::StateRow};
use gatsbi_proto::v1;
use parking_lot::{Mutex, RwLock};
use prost::Message as _;
use sha2::{Digest as _, Sha256};
use tokio::time::timeout_at;

use super::{
    Call, Service, answer, aside,
    fields::{self, Selection, Steps},
    imagine::row_bytes,
};
use crate::{
    access::tenants::Owner,
    engine::{
        commands::{Chunk, Depths, Imagine, RowStart, Spent, Tenant, Urgency, Value},
        models::ModelEntry,
    },
    error::Error,
    sessions::{
        registry::Room,
        session::{Position, bits, shortened},
    },
    tensor,
};

/// Starts that are looked up or observed together.
const TOGETHER: usize = 64;

/// The open handles.
#[derive(Debug, Default)]
pub(super) struct Opened {
    sets: RwLock<BTreeMap<u128, Arc<Handles>>>,
}

#[derive(Debug)]
struct Handles {
    id: u128,
    owner: Owner,
    model: Arc<ModelEntry>,
    ttl: Duration,
    /// Held by the step that is being taken.
    turn: tokio::sync::Mutex<()>,
    current: Mutex<Current>,
    _room: Room,
}

#[derive(Debug)]
struct Current {
    rows: Vec<Row>,
    stepped: u64,
    answer: Option<([u8; 32], v1::StepHandlesResponse)>,
    used: Instant,
}

#[derive(Clone, Debug)]
struct Row {
    start: RowStart,
    state: Arc<StateRow>,
    /// Steps since the start.
    taken: u64,
}

impl Row {
    fn new(start: RowStart) -> Self {
        Self { state: Arc::clone(&start.state), start, taken: 0 }
    }

    /// Where its next step begins.
    fn begins(&self) -> RowStart {
        let noise = match self.start.noise {
            RowNoise::Mean => RowNoise::Mean,
            RowNoise::Sample { seed, sample, step } => {
                RowNoise::Sample { seed, sample, step: step + self.taken }
            }
        };
        RowStart { state: Arc::clone(&self.state), noise, lane: self.start.lane }
    }
}

impl Opened {
    fn get(&self, id: &str, viewer: &Owner) -> Result<Arc<Handles>, Error> {
        let found = bits(id).and_then(|key| self.sets.read().get(&key).cloned());
        let found = found
            .filter(|handles| handles.expires() > Instant::now() && viewer.sees(&handles.owner));
        let handles = found.ok_or_else(|| Error::UnknownHandles { id: shortened(id) })?;
        handles.current.lock().used = Instant::now();
        Ok(handles)
    }

    /// Gives back what has expired.
    pub(super) fn sweep(&self, now: Instant) {
        self.sets.write().retain(|_, handles| handles.expires() > now);
    }
}

impl Handles {
    fn expires(&self) -> Instant {
        self.current.lock().used + self.ttl
    }
}

impl Service {
    /// Opens rows for a policy outside.
    ///
    /// # Errors
    /// If the request is wrong, or so many rows cannot be kept.
    pub async fn open_handles(
        &self,
        request: v1::OpenHandlesRequest,
    ) -> Result<v1::OpenHandlesResponse, Error> {
        let ttl = self.ttl(request.ttl)?;
        let draws = self.draws(request.sampling.unwrap_or_default())?;
        let rows = request.starts.len() as u64 * u64::from(draws.samples);
        let most = self.limits.max_rows;
        if !(1..=u64::from(most)).contains(&rows) {
            let found = format!("{} starts x {} samples", request.starts.len(), draws.samples);
            return Err(Error::invalid("starts", found, format!("1 to {most} rows")));
        }
        let positions: Vec<Position> =
            iter(request.starts.into_iter().enumerate())
                .map(|(at, start)| async move {
                    self.begin(Some(start), &format!("starts[{at}]")).await
                })
                .buffered(TOGETHER)
                .try_collect()
                .await?;
        let model = Arc::clone(&positions[0].model);
        if let Some(at) = positions.iter().position(|position| position.model.id != model.id) {
            let found = format!("of model {}", positions[at].model.spec.hash);
            let expected = format!("all on one model, as starts[0] on {}", model.spec.hash);
            return Err(Error::invalid(format!("starts[{at}]"), found, expected));
        }
        let room = self.registry.reserve(rows * model.row_bytes as u64, &self.owner)?;
        let start = |row: u32| {
            let (at, sample) = (row / draws.samples, row % draws.samples);
            Row::new(draws.start(&positions[at as usize], row, (at, sample)))
        };
        let now = Instant::now();
        let current = Current {
            rows: (0..rows as u32).map(start).collect(),
            stepped: 0,
            answer: None,
            used: now,
        };
        let handles = Handles {
            id: rand::random(),
            owner: self.owner.clone(),
            ttl,
            turn: tokio::sync::Mutex::new(()),
            current: Mutex::new(current),
            _room: room,
            model,
        };
        let answer = v1::OpenHandlesResponse {
            handles_id: format!("{:032x}", handles.id),
            rows: rows as u32,
            model_hash: handles.model.spec.hash.clone(),
            seed: draws.seed.unwrap_or(0),
            expires_at: Some((SystemTime::now() + ttl).into()),
        };
        self.handles.sets.write().insert(handles.id, Arc::new(handles));
        tracing::info!(handles = answer.handles_id, rows, "handles opened");
        Ok(answer)
    }

    /// Steps rows together.
    ///
    /// # Errors
    /// If the request is wrong, there is too much to do, or the model fails. No row has moved then.
    pub async fn step_handles(
        &self,
        request: v1::StepHandlesRequest,
        call: Call,
    ) -> Result<v1::StepHandlesResponse, Error> {
        let handles = self.handles.get(&request.handles_id, &self.owner)?;
        let deadline = fields::deadline(request.timeout_millis, call.deadline)?;
        let tenant = call.tenant.unwrap_or(Tenant(handles.id));
        let stepping = self.step(&handles, request, tenant, deadline);
        match deadline {
            None => stepping.await,
            // Dropped, it commits nothing.
            Some(at) => {
                timeout_at(at.into(), stepping).await.unwrap_or(Err(Error::DeadlineExceeded))
            }
        }
    }

    /// Gives rows back.
    ///
    /// # Errors
    /// If there are none.
    pub fn close_handles(
        &self,
        request: &v1::CloseHandlesRequest,
    ) -> Result<v1::CloseHandlesResponse, Error> {
        let handles = self.handles.get(&request.handles_id, &self.owner)?;
        self.handles.sets.write().remove(&handles.id);
        tracing::info!(handles = request.handles_id, "handles closed");
        Ok(v1::CloseHandlesResponse {})
    }

    async fn step(
        &self,
        handles: &Handles,
        request: v1::StepHandlesRequest,
        tenant: Tenant,
        deadline: Option<Instant>,
    ) -> Result<v1::StepHandlesResponse, Error> {
        let digest: [u8; 32] = {
            let lasting = v1::StepHandlesRequest { timeout_millis: None, ..request.clone() };
            Sha256::digest(lasting.encode_to_vec()).into()
        };
        let _turn = handles.turn.lock().await;
        let (all, stepped) = {
            let current = handles.current.lock();
            if let Some(step) = request.step.filter(|step| *step != current.stepped) {
                let repeated = current.answer.as_ref().filter(|(asked, _)| *asked == digest);
                return match repeated {
                    Some((_, answer)) if step + 1 == current.stepped => Ok(answer.clone()),
                    _ => Err(Error::HandlesMoved { step, stepped: current.stepped }),
                };
            }
            (current.rows.clone(), current.stepped)
        };
        let spec = &handles.model.spec;
        let outputs = request.outputs.unwrap_or_default();
        let selection = fields::selection(&outputs, Steps::Stepped, spec)?;
        let mut stepping = stepping(&request.rows, &request.restart, &all)?;
        let actions = actions(request.actions, stepping.len(), spec.actions.len())?;
        let bytes = row_bytes(selection.wanted.outputs, selection.wanted.form, spec)
            * stepping.len() as u64;
        if bytes > self.limits.max_output_bytes {
            let expected = format!("at most {} bytes", self.limits.max_output_bytes);
            return Err(Error::invalid("outputs", format!("{bytes} bytes"), expected));
        }
        let job = Imagine {
            model: Arc::clone(&handles.model),
            tenant,
            starts: stepping.iter().map(|(_, row)| row.begins()).collect(),
            actions: actions.into(),
            candidates: stepping.len() as u32,
            horizon: 1,
            wanted: selection.wanted,
            depths: Depths::Last,
            states: true,
            deadline,
            urgency: Urgency::Live,
        };
        let mut chunks = self.roll(job, bytes).await?;
        let mut gathered = Gathered::new(stepping.len());
        loop {
            let chunk = chunks.next().await.unwrap_or(Err(Error::ShuttingDown))?;
            let first = chunk.first_candidate as usize;
            for ((_, row), state) in stepping[first..].iter_mut().zip(&chunk.states) {
                row.state = Arc::new(state.clone());
                row.taken += 1;
            }
            gathered.add(&chunk);
            if chunk.last {
                break;
            }
        }
        let answer = v1::StepHandlesResponse {
            step: stepped + 1,
            model_hash: spec.hash.clone(),
            ..gathered.answer(selection).await?
        };
        let current = &mut *handles.current.lock();
        for (at, row) in stepping {
            current.rows[at] = row;
        }
        current.stepped = answer.step;
        current.answer = Some((digest, answer.clone()));
        Ok(answer)
    }
}

/// The rows that step, with their numbers, some of them back at their start.
fn stepping(asked: &[u32], restart: &[u32], all: &[Row]) -> Result<Vec<(usize, Row)>, Error> {
    let asked: Vec<u32> =
        if asked.is_empty() { (0..all.len() as u32).collect() } else { asked.to_vec() };
    let mut seen = BTreeSet::new();
    for (at, row) in asked.iter().enumerate() {
        if *row as usize >= all.len() || !seen.insert(*row) {
            let expected = format!("each once, 0 to {}", all.len() - 1);
            return Err(Error::invalid(format!("rows[{at}]"), row, expected));
        }
    }
    if let Some(at) = restart.iter().position(|row| !seen.contains(row)) {
        let expected = "a row that steps";
        return Err(Error::invalid(format!("restart[{at}]"), restart[at], expected));
    }
    let back: BTreeSet<u32> = restart.iter().copied().collect();
    let row = |at: u32| {
        let row = &all[at as usize];
        let row = if back.contains(&at) { Row::new(row.start.clone()) } else { row.clone() };
        (at as usize, row)
    };
    Ok(asked.into_iter().map(row).collect())
}

fn actions(actions: Option<v1::Tensor>, rows: usize, width: usize) -> Result<Vec<f32>, Error> {
    let expected = format!("[{rows}, {width}]");
    let Some(actions) = actions else {
        return Err(Error::invalid("actions", "absent", expected));
    };
    if actions.shape != [rows as u32, width as u32] {
        let found = format!("{:?}", actions.shape);
        return Err(Error::invalid("actions.shape", found, expected));
    }
    tensor::floats(&actions, "actions")
}

/// Outputs of rows that arrive in parts, in the order of the rows.
struct Gathered {
    rows: usize,
    values: Vec<(Value, BytesMut)>,
    spent: Spent,
}

impl Gathered {
    fn new(rows: usize) -> Self {
        Self { rows, values: Vec::new(), spent: Spent::default() }
    }

    fn add(&mut self, chunk: &Chunk) {
        self.spent.queue = self.spent.queue.max(chunk.spent.queue);
        self.spent.compute = self.spent.compute.max(chunk.spent.compute);
        self.spent.encode = self.spent.encode.max(chunk.spent.encode);
        for value in &chunk.values {
            let row = value.data.len() / chunk.candidates as usize;
            // The object table has two, told apart by their numbers.
            let same = |(known, _): &&mut (Value, BytesMut)| {
                (known.output, known.numbers) == (value.output, value.numbers)
            };
            let at = chunk.first_candidate as usize * row;
            if let Some((_, bytes)) = self.values.iter_mut().find(same) {
                bytes[at..at + value.data.len()].copy_from_slice(&value.data);
            } else {
                let mut bytes = BytesMut::zeroed(self.rows * row);
                bytes[at..at + value.data.len()].copy_from_slice(&value.data);
                self.values.push((value.clone(), bytes));
            }
        }
    }

    async fn answer(self, selection: Selection) -> Result<v1::StepHandlesResponse, Error> {
        let began = Instant::now();
        let values =
            self.values.into_iter().map(|(value, bytes)| Value { data: bytes.freeze(), ..value });
        let (values, leading): (Vec<Value>, _) = (values.collect(), [self.rows as u32]);
        let encode = move || answer::outputs(values, &leading, selection.png);
        let outputs = if selection.png { aside(encode).await? } else { encode() };
        let timing = Some(answer::timing(self.spent, began.elapsed()));
        Ok(v1::StepHandlesResponse { outputs, timing, ..Default::default() })
    }
}
