//! The object module: passive objects as a set of latent vectors that are discovered, tracked and imagined
//! (object spec; a G-SWM object module with GATSBI's background, graph and surroundings).
//!
//! Read [`ObjectModule::observe`] first. Parameters carry the names of G-SWM's checkpoints.

mod discovery;
mod glimpse;
mod handover;
mod image_encoder;
mod latents;
mod memory;
#[cfg(test)]
mod parity;
mod propagation;
mod relation;
mod render;
mod surroundings;

use tch::{Kind, Tensor};

pub use self::{
    latents::Latents,
    relation::gather_rows,
    render::{Placed, Rendering},
    surroundings::Agent,
};

use self::{
    discovery::{Discovered, Discovery},
    glimpse::GlimpseDecoder,
    handover::{Known, different},
    latents::{Layout, SHIFT, absent, place, presence, shift},
    memory::ObjectMemory,
    propagation::{Propagated, Propagation},
    surroundings::Surroundings,
};
use super::mixture::Memory;
use crate::{
    config::{AgentFeature, DiscoveryPrior, GatsbiConfig, IdRule, Tracking},
    nn::{Normal, Path, spatial_transformer::iou},
    noise::{Noise, PhiloxNoise},
};

/// The objects of a batch of sessions, always MAX slots, empty ones with presence 0.
#[derive(Debug)]
pub struct ObjectState {
    /// Latent vectors, `[B, MAX, Z]`.
    pub z: Tensor,
    /// Posterior memory, `[B, MAX, hidden]`.
    pub post: Memory,
    /// Prior memory, `[B, MAX, hidden]`.
    pub prior: Memory,
    /// Identities, `[B, MAX]` int64, -1 in slots never filled.
    pub ids: Tensor,
    /// Next identity to give, `[B]` int64.
    pub next_id: Tensor,
}

impl ObjectState {
    /// Another handle on the same tensors.
    #[must_use]
    pub fn shallow_clone(&self) -> Self {
        Self {
            z: self.z.shallow_clone(),
            post: self.post.shallow_clone(),
            prior: self.prior.shallow_clone(),
            ids: self.ids.shallow_clone(),
            next_id: self.next_id.shallow_clone(),
        }
    }

    /// The same objects, without gradients, with their boxes moved by `jolts [B, MAX, 2]`, in units of the image's half side.
    #[must_use]
    pub fn jolted(&self, jolts: &Tensor) -> Self {
        let part = |from: i64, width: i64| self.z.narrow(-1, from, width);
        let after = SHIFT + 2;
        let rest = part(after, self.z.size()[2] - after);
        let z = Tensor::cat(&[part(0, SHIFT), shift(&self.z) + jolts, rest], -1);
        let detached = |memory: &Memory| Memory { h: memory.h.detach(), c: memory.c.detach() };
        Self {
            z: z.detach(),
            post: detached(&self.post),
            prior: detached(&self.prior),
            ..self.shallow_clone()
        }
    }
}

/// Frame and mixture of a step, as the objects see them.
#[derive(Debug)]
pub struct Scenery<'a> {
    /// Observed frame in [0, 1], `[B, 3, H, W]`.
    pub frame: &'a Tensor,
    /// `mu_mix`, `[B, 3, H, W]`, for the difference that discovery sees.
    pub residual_mix: &'a Tensor,
    /// `mu_mix` again, for the environment crops.
    pub environment_mix: &'a Tensor,
    /// The agent; absent in scenes without one.
    pub agent: Option<&'a Agent>,
}

/// Which rows of a batch look for new objects.
#[derive(Debug)]
pub enum Discover {
    /// All of them.
    All,
    /// None; discovery is not computed.
    None,
    /// Those where this `[B]` bool tensor is true.
    Rows(Tensor),
}

/// What one observed step of the objects gives.
#[derive(Debug)]
pub struct ObjectStep {
    /// Window each kept object was looked for in, `[B, MAX, 4]`; a new object's own box.
    pub proposal: Tensor,
    /// Slots that held an object before the step, `[B, MAX, 1]`, 1 or 0.
    filled: Tensor,
    propagated: Propagated,
    discovered: Option<Discovered>,
    discover: Discover,
}

/// KL terms of the objects, per row `[B]`, summed over slots and cells (object spec 3.3 and 3.4).
#[derive(Debug)]
pub struct ObjectKl {
    /// Presence.
    pub pres: Tensor,
    /// Depth.
    pub depth: Tensor,
    /// Where.
    pub place: Tensor,
    /// What.
    pub what: Tensor,
    /// Dynamics.
    pub dyna: Tensor,
}

impl ObjectKl {
    /// All terms together, `[B]`.
    pub fn total(&self) -> Tensor {
        &self.pres + &self.depth + &self.place + &self.what + &self.dyna
    }

    fn plus(&self, other: &Self) -> Self {
        Self {
            pres: &self.pres + &other.pres,
            depth: &self.depth + &other.depth,
            place: &self.place + &other.place,
            what: &self.what + &other.what,
            dyna: &self.dyna + &other.dyna,
        }
    }
}

/// Sum over everything but the batch, `[B]`.
fn sum_per_row(x: &Tensor) -> Tensor {
    x.flatten(1, -1).sum_dim_intlist(1, false, Kind::Float)
}

/// The object module.
#[derive(Debug)]
pub struct ObjectModule {
    propagation: Propagation,
    discovery: Discovery,
    surroundings: Surroundings,
    post: ObjectMemory,
    prior: ObjectMemory,
    decoder: GlimpseDecoder,
    layout: Layout,
    agent_feature: AgentFeature,
    rejection: Option<f64>,
    max_objects: i64,
    image_size: i64,
}

impl ObjectModule {
    /// Creates the parameters under `path`.
    pub fn new(path: &Path<'_>, config: &GatsbiConfig) -> Self {
        let objects = &config.objects;
        let layout = Layout { what: objects.z_what, dyna: objects.z_dyna };
        let memory = |which: &str| ObjectMemory::new(path, which, config, layout.width());
        Self {
            propagation: Propagation::new(path, objects, layout),
            discovery: Discovery::new(path, objects, layout, config.image_size),
            surroundings: Surroundings::new(path, config),
            post: memory("post"),
            prior: memory("prior"),
            decoder: GlimpseDecoder::new(&path.sub("glimpse_decoder"), objects),
            layout,
            agent_feature: objects.agent_feature,
            rejection: objects.rejection,
            max_objects: objects.max_objects,
            image_size: config.image_size,
        }
    }

    /// The state of sessions that have seen nothing.
    pub fn initial_state(&self, batch: i64) -> ObjectState {
        let count = self.max_objects;
        let post = self.post.initial(batch, count);
        let device = post.h.device();
        ObjectState {
            z: Tensor::zeros([batch, count, self.layout.width()], (Kind::Float, device)),
            prior: self.prior.initial(batch, count),
            post,
            ids: Tensor::full([batch, count], -1, (Kind::Int64, device)),
            next_id: Tensor::zeros([batch], (Kind::Int64, device)),
        }
    }

    /// Tracks known objects into a frame and discovers new ones (object spec 3.2).
    ///
    /// Of all candidates only those that are kept get a memory; which are kept depends on presence alone.
    pub fn observe(
        &self,
        state: &ObjectState,
        scenery: &Scenery<'_>,
        discover: Discover,
        noise: &dyn Noise,
        tracking: &Tracking,
        train: bool,
    ) -> (ObjectState, ObjectStep) {
        let memories = [&state.post, &state.prior];
        let track = |[post, prior]: [&Memory; 2]| {
            self.propagation.posterior(&state.z, &post.h, &prior.h, scenery.frame, noise, tracking)
        };
        let (mut propagated, [post, prior]) = match self.agent_feature {
            AgentFeature::Current => {
                let propagated = track(memories);
                let memories = self.remember(&propagated.z, memories, scenery, None);
                (propagated, memories)
            }
            AgentFeature::Next => {
                let memories = self.remember(&state.z, memories, scenery, None);
                (track(memories.each_ref()), memories)
            }
        };
        if tracking.handover.is_some() {
            // What is gone is kept in mind as it was.
            propagated.z = state.z.where_self(&presence(&state.z).le(0.5), &propagated.z);
        }
        let discovered = (!matches!(discover, Discover::None))
            .then(|| self.discover(&mut propagated, state, scenery, noise, tracking, train));
        let tracked = Tracked { post, prior };
        let (next, proposal) = match &discovered {
            None => keep_present(state, &tracked, &propagated),
            Some(candidates) => {
                self.select(state, &tracked, &propagated, candidates, scenery, &discover, tracking)
            }
        };
        let next = match tracking.merge {
            Some(threshold) => {
                let unlike = tracking
                    .unlike
                    .map(|unlike| different(&render::colour(&self.looks(&next.z)), unlike));
                merged(next, threshold, unlike.as_ref())
            }
            None => next,
        };
        let filled = state.ids.ge(0).to_kind(Kind::Float).unsqueeze(-1);
        (next, ObjectStep { proposal, filled, propagated, discovered, discover })
    }

    /// Carries objects on without a frame; only the prior memory moves (object spec 3.10).
    pub fn imagine(
        &self,
        state: &ObjectState,
        mu_mix: &Tensor,
        agent: Option<&Agent>,
        noise: &dyn Noise,
        tracking: &Tracking,
    ) -> ObjectState {
        let remember = |z: &Tensor| {
            let environment = self.surroundings.environment(mu_mix, &place(z));
            self.advance(&self.prior, z, &state.prior, &environment, agent, None)
        };
        let carry_on =
            |memory: &Memory| self.propagation.generate(&state.z, &memory.h, noise, tracking);
        let (z, prior) = match self.agent_feature {
            AgentFeature::Current => {
                let z = carry_on(&state.prior);
                let prior = remember(&z);
                (z, prior)
            }
            AgentFeature::Next => {
                let prior = remember(&state.z);
                (carry_on(&prior), prior)
            }
        };
        ObjectState {
            z,
            post: state.post.shallow_clone(),
            prior,
            ids: state.ids.shallow_clone(),
            next_id: state.next_id.shallow_clone(),
        }
    }

    /// Carries objects over a frame that never came; both memories are fed the prior's latents.
    pub fn skip(
        &self,
        state: &ObjectState,
        mu_mix: &Tensor,
        agent: Option<&Agent>,
        noise: &dyn Noise,
        tracking: &Tracking,
    ) -> ObjectState {
        let next = self.imagine(state, mu_mix, agent, noise, tracking);
        let z = match self.agent_feature {
            AgentFeature::Current => &next.z,
            AgentFeature::Next => &state.z,
        };
        let environment = self.surroundings.environment(mu_mix, &place(z));
        let post = self.advance(&self.post, z, &state.post, &environment, agent, None);
        ObjectState { post, ..next }
    }

    /// What discovery finds in a frame if nothing is known yet: latent vectors `[B, G², Z]` at their means, of which the
    /// present ones are objects.
    pub fn detect(&self, frame: &Tensor, mu_mix: &Tensor) -> Tensor {
        let batch = frame.size()[0];
        let nothing = self.initial_state(batch).z;
        let noise = PhiloxNoise::mean(batch, frame.device());
        self.discovery.posterior(&discovery::input(frame, mu_mix), &nothing, &noise, false).z
    }

    /// The parts of latent vectors `z [..., Z]`.
    pub fn latents(&self, z: &Tensor) -> Latents {
        self.layout.split(z)
    }

    /// The prior that the dynamics latents of an imagined step were drawn from, `[B, MAX, dyna]`.
    pub fn dynamics_prior(&self, before: &ObjectState, after: &ObjectState) -> Normal {
        let memory = match self.agent_feature {
            AgentFeature::Current => &before.prior,
            AgentFeature::Next => &after.prior,
        };
        self.propagation.dynamics_prior(&memory.h)
    }

    /// Where objects `z [B, N, Z]` are.
    pub fn placed(&self, z: &Tensor) -> Placed {
        render::placed(&self.decoder, z, self.layout)
    }

    /// Draws objects `z [B, N, Z]` into images.
    pub fn render(&self, z: &Tensor) -> Rendering {
        render::render(&self.decoder, z, self.layout, self.image_size)
    }

    /// Makes the exact inference forms; gradients must be off from here on.
    pub fn freeze(&mut self) {
        self.propagation.freeze();
        self.surroundings.freeze();
        self.discovery.freeze();
        self.post.freeze();
        self.prior.freeze();
    }

    fn advance(
        &self,
        which: &ObjectMemory,
        z: &Tensor,
        memory: &Memory,
        environment: &Tensor,
        agent: Option<&Agent>,
        rows: Option<&Tensor>,
    ) -> Memory {
        let pick = |x: &Tensor| rows.map_or_else(|| x.shallow_clone(), |rows| gather_rows(x, rows));
        let surroundings = self.surroundings.effect(environment, agent, &pick(z), &pick(&memory.h));
        which.advance(z, memory, &surroundings, rows)
    }

    /// Both memories after a step, of all objects or of `rows`.
    fn remember(
        &self,
        z: &Tensor,
        [post, prior]: [&Memory; 2],
        scenery: &Scenery<'_>,
        rows: Option<&Tensor>,
    ) -> [Memory; 2] {
        let kept = rows.map_or_else(|| z.shallow_clone(), |rows| gather_rows(z, rows));
        let environment = self.surroundings.environment(scenery.environment_mix, &place(&kept));
        let agent = scenery.agent;
        [
            self.advance(&self.post, z, post, &environment, agent, rows),
            self.advance(&self.prior, z, prior, &environment, agent, rows),
        ]
    }

    /// What the boxes of objects `z [B, N, Z]` show, `[B, N, 4, s, s]`.
    fn looks(&self, z: &Tensor) -> Tensor {
        self.decoder.forward(&self.latents(z).what)
    }

    /// New objects of a frame. With [`Tracking::handover`] known ones that are lost become what is found of them.
    fn discover(
        &self,
        propagated: &mut Propagated,
        state: &ObjectState,
        scenery: &Scenery<'_>,
        noise: &dyn Noise,
        tracking: &Tracking,
        train: bool,
    ) -> Discovered {
        let (frame, mu_mix) = (scenery.frame, scenery.residual_mix);
        let z = propagated.z.shallow_clone();
        let known = tracking.unlike.map(|unlike| {
            let looks = self.looks(&state.z);
            let own = render::colour(&looks);
            (Known { z: &z, before: &state.z, ids: &state.ids, own, frame, unlike }, looks)
        });
        let handover = known.as_ref().zip(tracking.handover);
        let (seen, rest) = match handover {
            Some(((known, looks), _)) => {
                let seen = known.seen();
                // What is known is explained, so that what is beside it shows as if it were alone.
                let covered = render::covered(looks, &seen, self.layout, self.image_size);
                (seen, frame + (mu_mix - frame) * covered)
            }
            None => (z.shallow_clone(), frame.shallow_clone()),
        };
        let input = discovery::input(&rest, mu_mix);
        let mut found = self.discovery.posterior(&input, &seen, noise, train);
        if let Some(threshold) = self.rejection {
            let same = discovery::overlapped(&found.place(), &seen, threshold);
            let same = match &known {
                Some((known, _)) => same.logical_and(&known.alike(&found.z)),
                None => same,
            };
            found.z = absent(&found.z, &same.any_dim(-1, false));
        }
        if let Some(((known, _), reach)) = handover {
            found.z = absent(&found.z, &known.nothing_at(&found.z, mu_mix));
            (propagated.z, found.z) = known.recognised(&found.z, &seen, reach);
        }
        found
    }

    /// Keeps the MAX most present of candidates and propagated objects (object spec 3.6).
    #[expect(clippy::too_many_arguments, reason = "the two sets and what is known of them")]
    fn select(
        &self,
        state: &ObjectState,
        tracked: &Tracked,
        propagated: &Propagated,
        candidates: &Discovered,
        scenery: &Scenery<'_>,
        discover: &Discover,
        tracking: &Tracking,
    ) -> (ObjectState, Tensor) {
        let cells = candidates.z.size()[1];
        let key = match discover {
            Discover::Rows(rows) => {
                presence(&candidates.z).masked_fill(&rows.logical_not().view([-1, 1, 1]), -1.0)
            }
            _ => presence(&candidates.z),
        };
        let key = match tracking.handover {
            // What is absent does not take the place of what is kept in mind.
            Some(_) => key.masked_fill(&key.le(0.5), -1.0),
            None => key,
        };
        let keys = Tensor::cat(&[key, presence(&propagated.z)], 1).squeeze_dim(-1);
        let (_, order) = keys.sort_stable(true, 1, true);
        let order = order.narrow(1, 0, self.max_objects); // [B, MAX] into [candidates, propagated]
        let is_new = order.lt(cells);
        let cell_rows = order.clamp_max(cells - 1);
        let slot_rows = (&order - cells).clamp_min(0);

        let batch = candidates.z.size()[0];
        let [new_post, new_prior] = match self.agent_feature {
            AgentFeature::Current => {
                let fresh = [&self.post.initial(batch, cells), &self.prior.initial(batch, cells)];
                self.remember(&candidates.z, fresh, scenery, Some(&cell_rows))
            }
            AgentFeature::Next => {
                [&self.post, &self.prior].map(|memory| memory.initial(batch, self.max_objects))
            }
        };
        let mask = is_new.unsqueeze(-1);
        let old = |x: &Tensor| gather_rows(x, &slot_rows);
        let merge = |new: &Memory, known: &Memory| Memory {
            h: new.h.where_self(&mask, &old(&known.h)),
            c: new.c.where_self(&mask, &old(&known.c)),
        };
        let choose = |new: &Tensor, known: &Tensor| {
            gather_rows(new, &cell_rows).where_self(&mask, &old(known))
        };
        let (ids, next_id) = match tracking.ids {
            IdRule::Monotone => monotone_ids(state, &is_new, &slot_rows),
            IdRule::Original => original_ids(state, &is_new, &cell_rows, &slot_rows),
        };
        let next = ObjectState {
            z: choose(&candidates.z, &propagated.z),
            post: merge(&new_post, &tracked.post),
            prior: merge(&new_prior, &tracked.prior),
            ids,
            next_id,
        };
        (next, choose(&candidates.place(), &propagated.proposal))
    }
}

/// Memories of the propagated objects after the step.
struct Tracked {
    post: Memory,
    prior: Memory,
}

/// Keeps all propagated objects, most present first.
fn keep_present(
    state: &ObjectState,
    tracked: &Tracked,
    propagated: &Propagated,
) -> (ObjectState, Tensor) {
    let (_, order) = presence(&propagated.z).squeeze_dim(-1).sort_stable(true, 1, true);
    let pick = |x: &Tensor| gather_rows(x, &order);
    let pick_memory = |memory: &Memory| Memory { h: pick(&memory.h), c: pick(&memory.c) };
    let next = ObjectState {
        z: pick(&propagated.z),
        post: pick_memory(&tracked.post),
        prior: pick_memory(&tracked.prior),
        ids: state.ids.gather(1, &order, false),
        next_id: state.next_id.shallow_clone(),
    };
    (next, pick(&propagated.proposal))
}

/// Takes the presence from boxes that overlap a present one of an earlier identity by more than `threshold`.
/// Those that are `unlike [B, MAX, MAX]` stay.
fn merged(state: ObjectState, threshold: f64, unlike: Option<&Tensor>) -> ObjectState {
    let boxes = place(&state.z).detach();
    let overlap = iou(&boxes, &boxes).gt(threshold); // [B, MAX, MAX]
    let overlap = match unlike {
        Some(unlike) => overlap.logical_and(&unlike.logical_not()),
        None => overlap,
    };
    let earlier = state.ids.unsqueeze(1).less_tensor(&state.ids.unsqueeze(2)); // [b, i, j]: j is known longer than i
    let present = presence(&state.z).gt(0.5).transpose(1, 2); // [B, 1, MAX]
    let again = overlap.logical_and(&earlier).logical_and(&present).any_dim(-1, false);
    ObjectState { z: absent(&state.z, &again), ..state }
}

/// New objects are numbered in slot order from the session's counter.
fn monotone_ids(state: &ObjectState, is_new: &Tensor, slot_rows: &Tensor) -> (Tensor, Tensor) {
    let new = is_new.to_kind(Kind::Int64);
    let fresh = new.cumsum(1, Kind::Int64) - 1 + state.next_id.unsqueeze(1);
    let ids = fresh.where_self(is_new, &state.ids.gather(1, slot_rows, false));
    (ids, &state.next_id + new.sum_dim_intlist(1, false, Kind::Int64))
}

/// New objects are numbered by their cell from one more than the largest number kept.
fn original_ids(
    state: &ObjectState,
    is_new: &Tensor,
    cell_rows: &Tensor,
    slot_rows: &Tensor,
) -> (Tensor, Tensor) {
    let fresh = cell_rows + state.next_id.unsqueeze(1);
    let ids = fresh.where_self(is_new, &state.ids.gather(1, slot_rows, false));
    let next = ids.amax(1, false) + 1;
    (ids, next)
}

impl ObjectStep {
    /// KL terms of propagation and discovery per row. Slots never filled do not count.
    pub fn kl(&self, prior: &DiscoveryPrior, aux_presence: bool) -> ObjectKl {
        let propagated = self.propagated.kl(&self.filled, aux_presence.then_some(prior.presence));
        let Some(discovered) = &self.discovered else { return propagated };
        let active = match &self.discover {
            Discover::Rows(rows) => rows.to_kind(Kind::Float).view([-1, 1, 1]),
            _ => Tensor::ones([self.filled.size()[0], 1, 1], (Kind::Float, self.filled.device())),
        };
        propagated.plus(&discovered.kl(&active, prior))
    }

    /// Posterior of the dynamics latents, `[B, MAX, dyna]`, of the objects in the order in which they were before.
    pub fn dynamics(&self) -> &Normal {
        &self.propagated.dyna
    }

    /// How unexpectedly the tracked objects moved: KL of their dynamics to the prior, each weighted by its
    /// presence, `[B]`.
    pub fn surprise(&self) -> Tensor {
        let Propagated { z, dyna, dyna_prior, .. } = &self.propagated;
        sum_per_row(&(dyna.kl(dyna_prior) * presence(z)))
    }
}
