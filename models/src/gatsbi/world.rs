//! GATSBI behind the serving contract: raw actions, packed state, scenes as far as asked for.

use tch::{Device, Kind, Tensor};

use super::{
    loss::{gaussian_log_likelihood, mixture_kl},
    mixture::{Memory, MixtureState, MixtureStep},
    model::{Gatsbi, GatsbiState, GatsbiStep, Observing},
    objects::{Discover, ObjectState, ObjectStep},
};
use crate::{
    checkpoint::{Checkpoint, CheckpointError},
    config::{DiscoveryPolicy, GatsbiConfig, Tracking},
    noise::Noise,
    scene::{ObjectTable, Output, Outputs, Scene},
    state::{Packer, State, StateLayout, Unpacker},
    world_model::{ModelSpec, WorldModel},
};

/// Standard deviation of the image likelihood (paper, all data sets).
const SIGMA: f64 = 0.1;

/// Magnitude of a mixture latent from which on a belief has drifted. Residual updates are sums over a session's frames: past
/// the frames of a training sequence some latents leave the range they were trained in (up to 25 in `push1-tiny`), and what
/// drifts feeds on itself.
const DRIFTED: f64 = 32.0;

/// Largest magnitude of a latent that is carried on, for rollouts, which no frame brings back.
const LATENT_BOUND: f64 = 3.0 * DRIFTED;

/// Outputs that need the objects drawn.
const DRAWN: [Output; 5] = [
    Output::Frame,
    Output::AgentMask,
    Output::SlotMasks,
    Output::ObjectMasks,
    Output::LogLikelihood,
];

/// A frozen GATSBI model that serves.
#[derive(Debug)]
pub struct GatsbiWorld {
    model: Gatsbi,
    spec: ModelSpec,
    layout: StateLayout,
    offset: Tensor,
    scale: Tensor,
    tracking: Tracking,
    device: Device,
}

impl GatsbiWorld {
    /// Loads a checkpoint for serving.
    ///
    /// # Errors
    /// [`CheckpointError`] says what is wrong with the file.
    pub fn load(path: &std::path::Path, device: Device) -> Result<Self, CheckpointError> {
        Ok(Self::new(Checkpoint::load(path, device)?))
    }

    /// Freezes a loaded checkpoint for serving.
    pub fn new(checkpoint: Checkpoint) -> Self {
        let _no_grad = tch::no_grad_guard();
        let spec = checkpoint.spec();
        let Checkpoint { mut model, mut store, .. } = checkpoint;
        store.stop_gradients();
        model.freeze();
        let device = store.device();
        let vector = |values: Vec<f32>| Tensor::from_slice(&values).to_device(device);
        let layout = pack(&model.initial_state(1)).1;
        Self {
            offset: vector(spec.actions.iter().map(|a| a.offset as f32).collect()),
            scale: vector(spec.actions.iter().map(|a| a.scale as f32).collect()),
            tracking: model.config().tracking,
            model,
            spec,
            layout,
            device,
        }
    }

    /// The same model tracking objects by other rules.
    #[must_use]
    pub fn with_tracking(self, tracking: Tracking) -> Self {
        Self { tracking, ..self }
    }

    /// The configuration of the model.
    pub fn config(&self) -> &GatsbiConfig {
        self.model.config()
    }

    fn scaled(&self, action: &Tensor) -> Tensor {
        (action - &self.offset) / &self.scale
    }

    /// The state with mixtures that have drifted begun anew: the next frame is the first that they see. Objects stay.
    fn renewed(&self, state: GatsbiState) -> GatsbiState {
        let GatsbiState { mixture, objects, step } = state;
        let largest = |z: &Tensor| z.abs().amax([1i64, 2].as_slice(), false);
        let drifted = largest(&mixture.z_mask).maximum(&largest(&mixture.z_comp)).gt(DRIFTED);
        let fresh = self.model.initial_state(step.size()[0]);
        GatsbiState {
            mixture: mixture.replaced(&drifted, &fresh.mixture),
            objects,
            step: fresh.step.where_self(&drifted, &step),
        }
    }

    fn scene(
        &self,
        state: &GatsbiState,
        step: &GatsbiStep,
        frame: Option<&Tensor>,
        wanted: Outputs,
    ) -> Scene {
        let mut scene = Scene::default();
        let mixture = &step.mixture;
        if wanted.contains_any(&DRAWN) {
            let rendering = self.model.render(state);
            let image = rendering.over(&mixture.mu_mix);
            let visible: Tensor = 1.0 - &rendering.alpha; // [B, 1, H, W]
            let slots = mixture.log_masks.squeeze_dim(2).exp() * visible;
            if let (Some(frame), true) = (frame, wanted.contains(Output::LogLikelihood)) {
                scene.log_likelihood = Some(gaussian_log_likelihood(frame, &image, SIGMA));
            }
            if let (Some(slot), true) = (self.spec.agent_slot, wanted.contains(Output::AgentMask)) {
                scene.agent_mask = Some(slots.select(1, slot));
            }
            scene.frame = wanted.contains(Output::Frame).then_some(image);
            scene.slot_masks = wanted.contains(Output::SlotMasks).then_some(slots);
            scene.object_masks = wanted.contains(Output::ObjectMasks).then_some(rendering.masks);
        }
        if wanted.contains(Output::Background) {
            scene.background = Some(background(mixture, self.spec.agent_slot));
        }
        if wanted.contains(Output::Objects) {
            scene.objects = Some(object_table(&state.objects));
        }
        if wanted.contains(Output::Latents) {
            let parts = [&state.mixture.z_mask, &state.mixture.z_comp, &state.objects.z];
            scene.latents = Some(Tensor::cat(&parts.map(|z| z.flatten(1, -1)), 1));
        }
        if let Some(frame) = frame {
            if wanted.contains(Output::Surprise) {
                let (mask, comp) = mixture_kl(mixture);
                let objects = step.objects.as_ref().map(ObjectStep::surprise);
                let total = mask + comp;
                scene.surprise = Some(match objects {
                    Some(objects) => total + objects,
                    None => total,
                });
            }
            if let (Some(detector), true) =
                (self.model.detector(), wanted.contains(Output::Keypoints))
            {
                let down = Tensor::from_slice(&[1.0f32, -1.0, 1.0]).to_device(self.device);
                scene.keypoints = Some(detector.forward(frame).points * down);
            }
        }
        scene
    }
}

#[expect(unsafe_code, reason = "tch lets nobody read a tensor from two threads")]
// SAFETY: steps only read what the world holds, libtorch's tensors may be read by many threads at once, and their counts
// of holders are atomic.
unsafe impl Sync for GatsbiWorld {}

impl WorldModel for GatsbiWorld {
    fn spec(&self) -> &ModelSpec {
        &self.spec
    }

    fn layout(&self) -> &StateLayout {
        &self.layout
    }

    fn device(&self) -> Device {
        self.device
    }

    fn initial_state(&self, batch: i64) -> State {
        let _no_grad = tch::no_grad_guard();
        pack(&self.model.initial_state(batch)).0
    }

    fn observe(
        &self,
        state: &State,
        frame: Option<&Tensor>,
        action: &Tensor,
        noise: &dyn Noise,
        wanted: Outputs,
    ) -> (State, Scene) {
        let _no_grad = tch::no_grad_guard();
        let state = unpack(state, &self.layout);
        let action = self.scaled(action);
        let (state, step) = match frame {
            None => self.model.skip(state, &action, noise, &self.tracking),
            Some(frame) => {
                let discover = match self.tracking.discovery {
                    DiscoveryPolicy::EveryFrame => Discover::All,
                    DiscoveryPolicy::FirstFrame => Discover::Rows(state.first()),
                };
                let priors = wanted.contains(Output::Surprise);
                let how = Observing { priors, discover, ..Observing::serving(self.tracking) };
                self.model.observe(self.renewed(state), frame, &action, noise, how)
            }
        };
        let scene = self.scene(&state, &step, frame, wanted);
        (pack(&bounded(state)).0, scene)
    }

    fn imagine(
        &self,
        state: &State,
        action: &Tensor,
        noise: &dyn Noise,
        wanted: Outputs,
    ) -> (State, Scene) {
        let _no_grad = tch::no_grad_guard();
        let state = unpack(state, &self.layout);
        let (state, step) = self.model.imagine(state, &self.scaled(action), noise, &self.tracking);
        let scene = self.scene(&state, &step, None, wanted);
        (pack(&bounded(state)).0, scene)
    }
}

/// The state with latents that further steps are sound with.
fn bounded(mut state: GatsbiState) -> GatsbiState {
    let GatsbiState { mixture, objects, .. } = &mut state;
    for latents in [&mut mixture.z_mask, &mut mixture.z_comp, &mut objects.z] {
        *latents = latents.clamp(-LATENT_BOUND, LATENT_BOUND);
    }
    state
}

/// Slots other than the agent's, renormalised where it covers them.
fn background(mixture: &MixtureStep, agent_slot: Option<i64>) -> Tensor {
    let Some(agent) = agent_slot else { return mixture.mu_mix.shallow_clone() };
    let others: Vec<i64> = (0..mixture.log_masks.size()[1]).filter(|slot| *slot != agent).collect();
    let others = Tensor::from_slice(&others).to_device(mixture.log_masks.device());
    // The softmax renormalises in log space, so it holds where the agent's mask is 1 to rounding.
    let masks = mixture.log_masks.index_select(1, &others).softmax(1, Kind::Float);
    let components = mixture.components.index_select(1, &others);
    (masks * components).sum_dim_intlist(1, false, Kind::Float)
}

/// The object table of a state: presence, centre, size, depth.
fn object_table(objects: &ObjectState) -> ObjectTable {
    // Columns of z: presence, depth, s_x, s_y, t_x, t_y.
    let columns = Tensor::from_slice(&[0i64, 4, 5, 2, 3, 1]).to_device(objects.z.device());
    ObjectTable { ids: objects.ids.shallow_clone(), values: objects.z.index_select(-1, &columns) }
}

/// Typed state to rows. The order is that of the layout, and [`unpack`] reads in the same order.
fn pack(state: &GatsbiState) -> (State, StateLayout) {
    let mut packer = Packer::default();
    let GatsbiState { mixture, objects, step } = state;
    packer.push("mixture.z_mask", &mixture.z_mask);
    packer.push("mixture.z_comp", &mixture.z_comp);
    let mut memory = |h: &'static str, c: &'static str, memory: &Memory| {
        packer.push(h, &memory.h);
        packer.push(c, &memory.c);
    };
    memory("mixture.mask_post.h", "mixture.mask_post.c", &mixture.mask_post);
    memory("mixture.mask_prior.h", "mixture.mask_prior.c", &mixture.mask_prior);
    memory("mixture.comp_post.h", "mixture.comp_post.c", &mixture.comp_post);
    memory("mixture.comp_prior.h", "mixture.comp_prior.c", &mixture.comp_prior);
    memory("objects.post.h", "objects.post.c", &objects.post);
    memory("objects.prior.h", "objects.prior.c", &objects.prior);
    packer.push("objects.z", &objects.z);
    packer.push("objects.ids", &objects.ids);
    packer.push("objects.next_id", &objects.next_id);
    packer.push("step", step);
    packer.finish()
}

/// Rows to typed state, as views.
fn unpack(state: &State, layout: &StateLayout) -> GatsbiState {
    let mut unpacker = Unpacker::new(state, layout);
    let mut take = || unpacker.take();
    let (z_mask, z_comp) = (take(), take());
    let mut memory = || Memory { h: take(), c: take() };
    let mixture = MixtureState {
        z_mask,
        z_comp,
        mask_post: memory(),
        mask_prior: memory(),
        comp_post: memory(),
        comp_prior: memory(),
    };
    let (post, prior) = (memory(), memory());
    let objects = ObjectState { post, prior, z: take(), ids: take(), next_id: take() };
    GatsbiState { mixture, objects, step: take() }
}
