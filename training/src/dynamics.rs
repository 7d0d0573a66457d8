//! The objects' dynamics, learned from what the model remembers of its data.
//!
//! Most of a training step goes into seeing, and pushes are rare. Once every frame has been seen, a sequence costs only what
//! is imagined of its objects, so that many times as many can be learned from.
//!
//! What the objects are foreseen by is the agent as it was imagined: where an object is pushed, what is observed of the agent
//! and the background tells where it went. Where there is no agent, what surrounds the objects is taken as it was observed: it
//! stays as it is, and imagining it would cost several times what seeing does.

use std::path::Path;

use anyhow::Context as _;
use gatsbi_models::{
    config::Tracking,
    gatsbi::{
        loss,
        mixture::Memory,
        model::{Gatsbi, GatsbiStep, Observing},
        objects::{Agent, ObjectState, gather_rows},
    },
    nn::Normal,
    noise::{PhiloxNoise, philox4x32_10},
};
use tch::{Device, Kind, Tensor};

use crate::{
    clips::Clips,
    objective::{LENIENT, Moment, Objective, Terms, pixels},
    recipe::{DynamicsRecipe, Ramp},
};

/// Episodes that are seen at once.
const AT_ONCE: usize = 32;

/// Frames in which the prior's memory forms before anything is foreseen.
const FORMING: i64 = 3;

/// Frames between those from which the agent is imagined.
const EVERY: i64 = 4;

/// Frames for which it is imagined.
pub const HORIZON: i64 = 15;

/// Frames that an episode must have more of.
pub const SHORTEST: i64 = FORMING + HORIZON;

/// What the model made of episodes, frame by frame: all that is needed to imagine their objects from any frame on.
///
/// An object has one slot for as long as it keeps its identity.
#[derive(Debug)]
pub struct Remembered {
    /// Frames of an episode.
    length: i64,
    /// Tensors of `[E T, ...]`, and of `[E S HORIZON, ...]` for what was imagined from each of S frames, by the names below.
    parts: Vec<(String, Tensor)>,
}

/// Frames of an episode of `length` from which the agent is imagined, in order.
fn beginnings(length: i64) -> impl Iterator<Item = i64> {
    (FORMING..length - HORIZON).step_by(EVERY as usize)
}

/// Names of the parts of a [`Remembered`].
mod part {
    /// `mu_mix` and the fields of [`gatsbi_models::gatsbi::objects::Agent`], which are absent in scenes without one:
    /// `[E T, 3, H, W]` u8 and `[E T, ...]`.
    pub(super) const OBSERVED: [&str; 4] =
        ["mu_mix", "agent.latent", "agent.history", "agent.action"];
    /// The same, imagined; only in scenes with an agent.
    pub(super) const IMAGINED: [&str; 4] = [
        "imagined.mu_mix",
        "imagined.agent.latent",
        "imagined.agent.history",
        "imagined.agent.action",
    ];
    /// Latent vectors, `[E T, N, Z]`.
    pub(super) const Z: &str = "z";
    /// How surely objects are where they are thought to be, `[E T, N]` in [0, 1] ([`gatsbi_models::gatsbi::loss::confirmed`]).
    pub(super) const SURE: &str = "sure";
    /// Identities, `[E T, N]` int64.
    pub(super) const IDS: &str = "ids";
    /// Prior memory, `[E T, N, hidden]`.
    pub(super) const PRIOR: [&str; 2] = ["prior.h", "prior.c"];
    /// Posterior of the dynamics latents of the step into the frame, `[E T, N, dyna]`.
    pub(super) const DYNAMICS: [&str; 2] = ["dynamics.loc", "dynamics.scale"];
}

impl Remembered {
    /// Sees all of the data once by the rules of `tracking`; `progress` is told how many episodes have been.
    pub fn by(
        model: &Gatsbi,
        tracking: Tracking,
        clips: &Clips,
        device: Device,
        mut progress: impl FnMut(usize),
    ) -> Self {
        let _no_grad = tch::no_grad_guard();
        let length = clips.shortest();
        let mut seen: Vec<Vec<(String, Tensor)>> = Vec::new();
        for from in (0..clips.len()).step_by(AT_ONCE) {
            let until = clips.len().min(from + AT_ONCE);
            seen.push(see((model, tracking), clips, from..until, length, device));
            progress(until);
        }
        let names: Vec<String> =
            seen.first().into_iter().flatten().map(|(name, _)| name.clone()).collect();
        let whole = |at: usize| {
            let chunks: Vec<&Tensor> = seen.iter().map(|parts| &parts[at].1).collect();
            Tensor::cat(&chunks, 0)
        };
        let parts = names.into_iter().enumerate().map(|(at, name)| (name, whole(at))).collect();
        Self { length, parts }
    }

    /// What was written to a file.
    ///
    /// # Errors
    /// If it cannot be read or is of other episodes.
    pub fn read(path: &Path, clips: &Clips) -> anyhow::Result<Self> {
        let parts = Tensor::read_safetensors(path)?;
        let remembered = Self { length: clips.shortest(), parts };
        let whole = remembered.episodes() == Some(clips.len() as i64);
        anyhow::ensure!(whole, "{} remembers other episodes", path.display());
        Ok(remembered)
    }

    /// Writes it to a file, whole or not at all.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn write(&self, path: &Path) -> anyhow::Result<()> {
        let unfinished = path.with_extension("unfinished");
        Tensor::write_safetensors(&self.parts, &unfinished)
            .with_context(|| format!("{} cannot be written", unfinished.display()))?;
        Ok(fs_err::rename(unfinished, path)?)
    }

    fn episodes(&self) -> Option<i64> {
        let (_, ids) = self.parts.iter().find(|(name, _)| name == part::IDS)?;
        Some(ids.size()[0] / self.length)
    }

    /// Rows `rows [B]` of a part, if there is one.
    fn find(&self, name: &str, rows: &Tensor) -> Option<Tensor> {
        let (_, part) = self.parts.iter().find(|(known, _)| known == name)?;
        Some(part.index_select(0, &rows.to_device(part.device())).to_device(rows.device()))
    }

    fn get(&self, name: &str, rows: &Tensor) -> Tensor {
        self.find(name, rows).expect("every model has it")
    }

    /// `mu_mix` and the agent, by the names of those that were observed or imagined.
    fn surroundings(&self, names: [&str; 4], rows: &Tensor) -> (Tensor, Option<Agent>) {
        let [mu_mix, agent @ ..] = names;
        let mu_mix = self.get(mu_mix, rows).to_kind(Kind::Float) / 255.0;
        let [latent, history, action] = agent.map(|name| self.find(name, rows));
        let agent = latent.zip(history).zip(action);
        (mu_mix, agent.map(|((latent, history), action)| Agent { latent, history, action }))
    }

    /// What surrounds the objects `k` frames after the frames `start [B]`, of which the first one imagined is `future [B]`.
    fn surroundings_ahead(
        &self,
        (start, future): (&Tensor, &Tensor),
        k: i64,
    ) -> (Tensor, Option<Agent>) {
        let [mu_mix, ..] = part::IMAGINED;
        if self.parts.iter().any(|(name, _)| name == mu_mix) {
            self.surroundings(part::IMAGINED, &(future + k - 1))
        } else {
            self.surroundings(part::OBSERVED, &(start + k))
        }
    }

    fn prior(&self, rows: &Tensor) -> Memory {
        let [h, c] = part::PRIOR.map(|name| self.get(name, rows));
        Memory { h, c }
    }

    fn dynamics(&self, rows: &Tensor) -> Normal {
        let [loc, scale] = part::DYNAMICS.map(|name| self.get(name, rows));
        Normal { loc, scale }
    }
}

/// All parts of some episodes.
fn see(
    (model, tracking): (&Gatsbi, Tracking),
    clips: &Clips,
    episodes: std::ops::Range<usize>,
    length: i64,
    device: Device,
) -> Vec<(String, Tensor)> {
    let batch = clips.beginnings(episodes, length, device);
    let rows = batch.frames[0].size()[0];
    let noise = PhiloxNoise::mean(rows, device);
    let mut state = model.initial_state(rows);
    let mut slots = Slots::new(&state.objects.ids);
    let (mut observed, mut imagined) = (Frames::default(), Frames::default());
    for t in 0..length {
        let frame = &batch.frames[t as usize];
        let how = Observing::serving(tracking);
        let (next, seen) = model.observe(state, frame, &batch.actions[t as usize], &noise, how);
        state = next;
        let objects = &state.objects;
        let step = seen.objects.as_ref().expect("objects were observed");
        let Normal { loc, scale } = step.dynamics();
        // The step into the frame is that of the objects as they were before it.
        observed.add(part::DYNAMICS, [slots.pick(loc), slots.pick(scale)]);
        slots.follow(&objects.ids);
        let Memory { h, c } = &objects.prior;
        observed.add(part::PRIOR, [slots.pick(h), slots.pick(c)]);
        let placed = |z: &Tensor| model.objects().placed(z);
        let found = placed(&model.objects().detect(frame, &seen.mixture.mu_mix));
        let near = LENIENT / pixels(model);
        let sure = loss::confirmed(&placed(&objects.z), &found, near, near);
        let one = |x: &Tensor| slots.pick(&x.unsqueeze(-1)).squeeze_dim(-1);
        let names = [part::SURE, part::Z, part::IDS];
        observed.add(names, [one(&sure), slots.pick(&objects.z), one(&objects.ids)]);
        observed.add_surroundings(part::OBSERVED, seen);
        if model.agent_slot().is_some() && beginnings(length).any(|from| from == t) {
            let mut future = state.shallow_clone();
            for action in &batch.actions[t as usize + 1..][..HORIZON as usize] {
                let (next, seen) = model.imagine(future, action, &noise, &tracking);
                future = next;
                imagined.add_surroundings(part::IMAGINED, seen);
            }
        }
    }
    observed.0.into_iter().chain(imagined.0).map(|(name, frames)| stacked(name, &frames)).collect()
}

/// Parts of the episodes by name, frame by frame.
#[derive(Default)]
struct Frames(Vec<(&'static str, Vec<Tensor>)>);

impl Frames {
    fn add<const N: usize>(&mut self, names: [&'static str; N], parts: [Tensor; N]) {
        for (name, part) in names.into_iter().zip(parts) {
            match self.0.iter_mut().find(|(known, _)| *known == name) {
                Some((_, frames)) => frames.push(part),
                None => self.0.push((name, vec![part])),
            }
        }
    }

    fn add_surroundings(&mut self, [mu_mix, agent @ ..]: [&'static str; 4], step: GatsbiStep) {
        let levels = (step.mixture.mu_mix.clamp(0.0, 1.0) * 255.0).round();
        self.add([mu_mix], [levels.to_kind(Kind::Uint8)]);
        if let Some(Agent { latent, history, action }) = step.agent {
            self.add(agent, [latent, history, action]);
        }
    }
}

/// Frames `[E, ...]` of a part, episode by episode.
fn stacked(name: &str, frames: &[Tensor]) -> (String, Tensor) {
    (name.to_owned(), Tensor::stack(frames, 1).flatten(0, 1).to_device(Device::Cpu))
}

/// Which object of a state is in which slot: one that keeps its identity keeps its slot.
struct Slots {
    ids: Vec<Vec<i64>>,
    /// Where each slot's object is in the state, `[B, N]`.
    order: Tensor,
}

impl Slots {
    fn new(ids: &Tensor) -> Self {
        let count = ids.size()[1];
        let order = Tensor::arange(count, (Kind::Int64, ids.device()));
        let ids = Vec::<Vec<i64>>::try_from(ids).expect("a table of identities");
        Self { order: order.expand([ids.len() as i64, count], true).contiguous(), ids }
    }

    /// Gives the objects `ids [B, N]` of the next state their slots.
    fn follow(&mut self, ids: &Tensor) {
        let next = Vec::<Vec<i64>>::try_from(ids).expect("a table of identities");
        let mut order = Vec::new();
        for (slots, next) in self.ids.iter_mut().zip(&next) {
            let mut new: Vec<usize> = (0..next.len()).filter(|&i| !kept(slots, next[i])).collect();
            for slot in slots.iter_mut() {
                let at = match next.iter().position(|id| *id == *slot && *slot >= 0) {
                    Some(at) => at,
                    None => new.pop().expect("as many objects as slots"),
                };
                *slot = next[at];
                order.push(at as i64);
            }
        }
        self.order = Tensor::from_slice(&order).view_as(&self.order).to_device(ids.device());
    }

    /// A part `[B, N, D]` of the state, slot by slot.
    fn pick(&self, part: &Tensor) -> Tensor {
        gather_rows(part, &self.order)
    }
}

/// Whether an object of the next state had a slot before.
fn kept(slots: &[i64], id: i64) -> bool {
    id >= 0 && slots.contains(&id)
}

/// How well objects of remembered sequences are foreseen, each frame from what was imagined of the one before. Mean over
/// sequences, summed over time.
pub fn objective(
    model: &Gatsbi,
    remembered: &Remembered,
    recipe: &DynamicsRecipe,
    moment: Moment,
    device: Device,
) -> Objective {
    let step = moment.step;
    let (mean, tracking) = (PhiloxNoise::mean(recipe.batch, device), model.config().tracking);
    let (objects, pixels) = (model.objects(), pixels(model));
    let (start, future) = sequences(remembered, recipe.batch, moment);
    let (start, future) = (start.to_device(device), future.to_device(device));
    let mut state = formed(model, remembered, &start, &mean);
    let sure_at_first = remembered.get(part::SURE, &start);
    let mut terms = Terms::default();
    for k in 1..=recipe.length.at(step) as i64 {
        let (mu_mix, agent) = remembered.surroundings_ahead((&start, &future), k);
        let next = objects.imagine(&state, &mu_mix, agent.as_ref(), &mean, &tracking);
        let rows = &start + k;
        let [z, ids, sure] =
            [part::Z, part::IDS, part::SURE].map(|name| remembered.get(name, &rows));
        let same = state.ids.eq_tensor(&ids).logical_and(&ids.ge(0)).to_kind(Kind::Float);
        let (imagined, seen) = (objects.latents(&next.z), objects.latents(&z));
        let both = (&seen.pres * imagined.pres.detach()).squeeze_dim(-1);
        let known = both * &sure_at_first * sure * same; // [B, N]
        let mut add = |name, value: Tensor, weight: &Ramp| {
            let sum = (value * &known).sum_dim_intlist(-1, false, Kind::Float);
            terms.add(name, sum, weight.at(step));
        };
        let distance: Tensor = [0, 2]
            .map(|from| {
                let half = |x: &Tensor| x.narrow(-1, from, 2);
                loss::displacement(&half(&imagined.place), &half(&seen.place), LENIENT / pixels)
            })
            .into_iter()
            .sum();
        add("place", distance * pixels.powi(2), &recipe.place);
        let difference = (&imagined.what - &seen.what).square();
        add("what", difference.sum_dim_intlist(-1, false, Kind::Float), &recipe.what);
        if k == 1 {
            // Later posteriors began from what was seen, not from what was imagined.
            let kl = remembered.dynamics(&rows).kl(&objects.dynamics_prior(&state, &next));
            add("kl_dyna", kl.sum_dim_intlist(-1, false, Kind::Float), &recipe.kl);
        }
        state = next;
    }
    terms.finish(&start)
}

/// Objects as they were seen in frames `start [B]`, with the memory that the prior forms of them in the frames before.
fn formed(
    model: &Gatsbi,
    remembered: &Remembered,
    start: &Tensor,
    noise: &PhiloxNoise,
) -> ObjectState {
    let seen = |rows: &Tensor| ObjectState {
        z: remembered.get(part::Z, rows),
        post: remembered.prior(rows),
        prior: remembered.prior(rows),
        ids: remembered.get(part::IDS, rows),
        next_id: start.zeros_like(),
    };
    let mut state = seen(&(start - FORMING));
    for k in 1 - FORMING..=0 {
        let rows = start + k;
        let (mu_mix, agent) = remembered.surroundings(part::OBSERVED, &rows);
        let tracking = model.config().tracking;
        let next = model.objects().imagine(&state, &mu_mix, agent.as_ref(), noise, &tracking);
        let met = seen(&rows);
        // What was not there before is remembered as it was met.
        let same = state.ids.eq_tensor(&met.ids).logical_and(&met.ids.ge(0)).unsqueeze(-1);
        let prior = met.prior.replaced(&same, &next.prior);
        state = ObjectState { prior, ..met };
    }
    state
}

/// A step's sequences: rows of the last frames observed and of the first ones imagined, `[B]` each.
fn sequences(
    remembered: &Remembered,
    batch: i64,
    Moment { seed, step }: Moment,
) -> (Tensor, Tensor) {
    let key = [seed as u32, (seed >> 32) as u32];
    let episodes = remembered.episodes().expect("identities are remembered");
    let from: Vec<i64> = beginnings(remembered.length).collect();
    let row = |row| {
        let counter = [row as u32, 0x6479_6e61, step as u32, (step >> 32) as u32];
        let [episode, at, ..] = philox4x32_10(counter, key);
        let (episode, at) = (i64::from(episode) % episodes, at as usize % from.len());
        let future = (episode * from.len() as i64 + at as i64) * HORIZON;
        (episode * remembered.length + from[at], future)
    };
    let (start, future): (Vec<i64>, Vec<i64>) = (0..batch).map(row).unzip();
    (Tensor::from_slice(&start), Tensor::from_slice(&future))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_object_keeps_its_slot_for_as_long_as_its_identity() {
        let ids = |ids: [i64; 4]| Tensor::from_slice(&ids).view([1, 4]);
        let mut slots = Slots::new(&ids([-1; 4]));
        let mut seen = |now: [i64; 4]| {
            slots.follow(&ids(now));
            let picked = slots.pick(&ids(now).unsqueeze(-1)).flatten(0, -1);
            Vec::<i64>::try_from(picked).expect("a row of identities")
        };
        let first = seen([5, 3, -1, -1]);
        let at = |row: &[i64], id| row.iter().position(|known| *known == id);
        let second = seen([3, 7, 5, -1]);
        for id in [3, 5] {
            assert_eq!(at(&first, id), at(&second, id), "{first:?} {second:?}");
        }
        // 5 has been let go; 9 takes its slot or an empty one.
        let third = seen([9, 7, 3, -1]);
        for id in [3, 7] {
            assert_eq!(at(&second, id), at(&third, id), "{second:?} {third:?}");
        }
        let mut all = third.clone();
        all.sort_unstable();
        assert_eq!(all, [-1, 3, 7, 9]);
    }
}
