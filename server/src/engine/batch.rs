//! One batch through the model: rows to tensors, the step, and outputs to bytes on the host.
//!
//! Everything that touches tensors and may panic is behind [`compute`].

use std::{
    ops::Range,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::Arc,
    time::{Duration, Instant},
};

use bytes::Bytes;
use gatsbi_models::{
    idle::asking_for,
    noise::{PhiloxNoise, RowNoise},
    scene::{Output, Outputs, Scene},
    state::{State, StateRow},
    world_model::WorldModel,
};
use tch::{Device, Kind, Tensor};

use super::{
    arena::Arena,
    commands::{Form, Imagine, NumberType, Observe, Spent, Value, Wanted},
    scheduler::RowStep,
};
use crate::frame::Frame;

/// The rows of a block as a model takes them. Empty lanes hold copies of a taken one.
pub(super) struct Batch {
    states: States,
    frames: Option<Vec<Frame>>,
    actions: Vec<f32>,
    noise: Vec<RowNoise>,
    wanted: Vec<Wanted>,
    /// Lanes that are taken.
    taken: Vec<bool>,
    imagine: bool,
}

enum States {
    Host(Vec<Arc<StateRow>>),
    Device(State),
}

/// What came of a batch, lane by lane.
pub(super) struct Computed {
    /// The new states on the host, if they are wanted there.
    pub(super) rows: Option<Vec<StateRow>>,
    /// Whether all numbers of a lane are finite.
    pub(super) finite: Vec<bool>,
    state: State,
    values: Vec<(Form, Value)>,
    compute: Duration,
    encode: Duration,
}

impl Batch {
    /// A batch of observes, all with an image or all without.
    pub(super) fn observe(lanes: &[Option<&Observe>]) -> Self {
        let padded = padded(lanes);
        let frames = padded.iter().map(|observe| observe.frame.clone()).collect();
        Self {
            states: States::Host(padded.iter().map(|observe| Arc::clone(&observe.state)).collect()),
            frames,
            actions: padded.iter().flat_map(|observe| &observe.action).copied().collect(),
            noise: padded.iter().map(|observe| observe.noise).collect(),
            wanted: lanes.iter().flatten().map(|observe| observe.wanted).collect(),
            taken: lanes.iter().map(Option::is_some).collect(),
            imagine: false,
        }
    }

    /// A batch of steps of rollouts, whose states lie in the arena.
    pub(super) fn imagine(lanes: &[Option<(&Imagine, RowStep)>], arena: &Arena) -> Self {
        let padded = padded(lanes);
        let slots: Vec<u32> = padded.iter().map(|(_, step)| step.slot).collect();
        let actions = padded.iter().flat_map(|(job, step)| job.action(step.row, step.depth));
        let wanted = lanes.iter().flatten().filter(|(job, step)| job.wants(step.depth));
        Self {
            states: States::Device(arena.take(&slots)),
            frames: None,
            actions: actions.copied().collect(),
            noise: padded.iter().map(|(job, step)| job.noise(step.row, step.depth)).collect(),
            wanted: wanted.map(|(job, _)| job.wanted).collect(),
            taken: lanes.iter().map(Option::is_some).collect(),
            imagine: true,
        }
    }

    /// Rows that are not padding.
    pub(super) fn rows(&self) -> usize {
        self.taken.iter().filter(|taken| **taken).count()
    }
}

impl Computed {
    /// States of some lanes.
    pub(super) fn gather(&self, lanes: &[i64]) -> State {
        self.state.gather(&Tensor::from_slice(lanes).to_device(self.state.floats.device()))
    }

    /// States of neighbouring lanes, on the host.
    pub(super) fn states(&self, lanes: &Range<usize>) -> Vec<StateRow> {
        let (start, length) = (lanes.start as i64, lanes.len() as i64);
        let part = |rows: &Tensor| rows.narrow(0, start, length);
        State { floats: part(&self.state.floats), ints: part(&self.state.ints) }.to_rows()
    }

    /// What is wanted of neighbouring lanes.
    pub(super) fn values(&self, lanes: Range<usize>, wanted: Wanted) -> Vec<Value> {
        self.wanted(wanted).map(|value| self.part(value, &lanes)).collect()
    }

    /// What is wanted of neighbouring lanes for the spread over samples.
    pub(super) fn spread(&self, lanes: Range<usize>, wanted: Wanted) -> Vec<Value> {
        self.in_form(wanted.spread, Form::F32).map(|value| self.part(value, &lanes)).collect()
    }

    fn part(&self, value: &Value, lanes: &Range<usize>) -> Value {
        let row = value.data.len() / self.finite.len();
        let data = value.data.slice(lanes.start * row..lanes.end * row);
        Value { data, shape: value.shape.clone(), ..*value }
    }

    /// What is wanted of one lane, in memory of its own: sessions keep it, and should not keep the batch.
    pub(super) fn row_values(&self, lane: usize, wanted: Wanted) -> Vec<Value> {
        let mut values = self.values(lane..lane + 1, wanted);
        for value in &mut values {
            value.data = Bytes::copy_from_slice(&value.data);
        }
        values
    }

    /// Bytes of what is wanted of one lane.
    pub(super) fn row_bytes(&self, wanted: Wanted) -> usize {
        self.wanted(wanted).map(|value| value.data.len() / self.finite.len()).sum()
    }

    /// Where the time of a request went that waited before.
    pub(super) fn spent(&self, queue: Duration) -> Spent {
        Spent { queue, compute: self.compute, encode: self.encode }
    }

    fn wanted(&self, wanted: Wanted) -> impl Iterator<Item = &Value> {
        self.in_form(wanted.outputs, wanted.form)
    }

    fn in_form(&self, outputs: Outputs, form: Form) -> impl Iterator<Item = &Value> {
        let values = self.values.iter();
        let values = values
            .filter(move |(as_form, value)| *as_form == form && outputs.contains(value.output));
        values.map(|(_, value)| value)
    }
}

/// What became of a batch, and how long it took. A panic comes back as its message.
pub(super) struct Outcome {
    pub(super) computed: Result<Computed, String>,
    pub(super) started: Instant,
    pub(super) elapsed: Duration,
}

/// Runs batches through the model, all at the same time.
pub(super) fn compute(world: &dyn WorldModel, batches: Vec<Batch>) -> Vec<Outcome> {
    let mut batches = batches.into_iter();
    let Some(first) = batches.next() else { return Vec::new() };
    let (span, threads) = (tracing::Span::current(), tch::get_num_threads());
    std::thread::scope(|scope| {
        let worker = |batch| {
            // Products of matrices ask the thread that they are called on how many it may use.
            tch::set_num_threads(threads);
            span.in_scope(|| compute_one(world, batch))
        };
        let others: Vec<_> = batches.map(|batch| scope.spawn(move || worker(batch))).collect();
        let first = compute_one(world, first);
        let others = others.into_iter().map(|other| other.join().expect("panics are caught"));
        std::iter::once(first).chain(others).collect()
    })
}

fn compute_one(world: &dyn WorldModel, batch: Batch) -> Outcome {
    let started = Instant::now();
    let (rows, lanes) = (batch.rows(), batch.taken.len());
    let kind = if batch.imagine { "imagine" } else { "observe" };
    let _entered = tracing::debug_span!("batch", kind, rows, lanes).entered();
    let taken = batch.taken.clone();
    let step = || asking_for(&taken, || step(world, batch));
    let computed = catch_unwind(AssertUnwindSafe(step)).map_err(|panic| {
        let text = panic.downcast_ref::<String>().map(String::as_str);
        text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("a panic").to_owned()
    });
    Outcome { computed, started, elapsed: started.elapsed() }
}

fn step(world: &dyn WorldModel, batch: Batch) -> Computed {
    let _no_grad = tch::no_grad_guard();
    let started = Instant::now();
    let device = world.device();
    let lanes = batch.noise.len();
    let all = |all: Outputs, one: &Wanted| all.union(one.outputs).union(one.spread);
    let outputs = batch.wanted.iter().fold(Outputs::default(), all);
    let host = matches!(batch.states, States::Host(_));
    let state = match batch.states {
        States::Host(rows) => State::from_rows(rows.iter().map(AsRef::as_ref), device),
        States::Device(state) => state,
    };
    let tensor = |numbers: &[f32]| Tensor::from_slice(numbers).to_device(device);
    let action = tensor(&batch.actions).view([lanes as i64, world.spec().actions.len() as i64]);
    let noise = PhiloxNoise::new(batch.noise, device);
    let (state, scene) = if batch.imagine {
        world.imagine(&state, &action, &noise, outputs)
    } else {
        let frame = batch.frames.map(|frames| {
            let size = world.spec().image_size;
            let mut numbers = Vec::with_capacity(lanes * 3 * (size * size) as usize);
            for frame in frames {
                frame.append_to(&mut numbers);
            }
            tensor(&numbers).view([lanes as i64, 3, size, size])
        });
        world.observe(&state, frame.as_ref(), &action, &noise, outputs)
    };
    let mut finite = finite(&state.floats);
    for (_, tensor) in scene.tensors() {
        finite = finite.logical_and(&self::finite(tensor));
    }
    // Reading the result waits for the device, so it is here that the step has ended.
    let finite: Vec<bool> = finite.try_into().expect("one truth value per lane");
    let rows = host.then(|| state.to_rows());
    let compute = started.elapsed();
    let started = Instant::now();
    let values = values(&scene, &batch.wanted);
    Computed { rows, finite, state, values, compute, encode: started.elapsed() }
}

/// Brings every output to the host once in each form in which it is wanted.
fn values(scene: &Scene, wanted: &[Wanted]) -> Vec<(Form, Value)> {
    let mut values = Vec::new();
    for form in [Form::F32, Form::F16, Form::U8] {
        let of_form = wanted.iter().map(|one| match (one.form == form, form) {
            (true, Form::F32) => one.outputs.union(one.spread),
            (true, _) => one.outputs,
            (false, Form::F32) => one.spread,
            (false, _) => Outputs::default(),
        });
        let outputs = of_form.fold(Outputs::default(), Outputs::union);
        for (output, tensor) in scene.tensors().filter(|(output, _)| outputs.contains(*output)) {
            values.push((form, value(output, tensor, numbers(output, form))));
        }
        if let (Some(objects), true) = (&scene.objects, outputs.contains(Output::Objects)) {
            values.push((form, value(Output::Objects, &objects.ids, NumberType::I64)));
        }
    }
    values
}

/// In which type an output is given.
fn numbers(output: Output, form: Form) -> NumberType {
    let picture = match output {
        Output::Frame
        | Output::AgentMask
        | Output::SlotMasks
        | Output::ObjectMasks
        | Output::Background => true,
        Output::Latents | Output::Keypoints => false,
        Output::Objects | Output::Surprise | Output::LogLikelihood => return NumberType::F32,
    };
    match form {
        Form::U8 if picture => NumberType::U8,
        Form::F16 => NumberType::F16,
        Form::F32 | Form::U8 => NumberType::F32,
    }
}

fn value(output: Output, tensor: &Tensor, numbers: NumberType) -> Value {
    let tensor = match output {
        Output::Frame | Output::Background => tensor.permute([0, 2, 3, 1]),
        _ => tensor.shallow_clone(),
    };
    let tensor = match numbers {
        NumberType::U8 => (tensor.clamp(0.0, 1.0) * 255.0).round().to_kind(Kind::Uint8),
        NumberType::F16 => tensor.to_kind(Kind::Half),
        NumberType::F32 => tensor.to_kind(Kind::Float),
        NumberType::I64 => tensor.to_kind(Kind::Int64),
    };
    let tensor = tensor.to_device(Device::Cpu).contiguous();
    let shape = tensor.size()[1..].iter().map(|size| *size as usize).collect();
    let mut data = vec![0; tensor.numel() * tensor.kind().elt_size_in_bytes()];
    tensor.copy_data_u8(&mut data, tensor.numel());
    Value { output, numbers, shape, data: Bytes::from(data) }
}

/// Whether all numbers of each row are finite, `[B]`.
fn finite(tensor: &Tensor) -> Tensor {
    tensor.isfinite().reshape([tensor.size()[0], -1]).all_dim(1, false)
}

/// All lanes, empty ones filled with the first taken one.
fn padded<T: Copy>(lanes: &[Option<T>]) -> Vec<T> {
    let first = lanes.iter().flatten().next().expect("a block has at least one row");
    lanes.iter().map(|lane| lane.unwrap_or(*first)).collect()
}
