//! The whole model: mixture, agent and objects as one step.
//!
//! [`Gatsbi`] works on scaled actions and typed state and keeps gradients; training uses it directly, and
//! [`super::world::GatsbiWorld`] puts the serving contract around it.

use tch::{Device, Kind, Tensor};

use super::{
    action::ActionEnhancer,
    keypoint::Detector,
    mixture::{Mixture, MixtureState, MixtureStep},
    objects::{Agent, Discover, ObjectModule, ObjectState, ObjectStep, Rendering, Scenery},
};
use crate::{
    config::{AgentHistory, GatsbiConfig, Tracking},
    nn::{ParamStore, Path},
    noise::Noise,
};

/// Recurrent state of a batch of sessions.
#[derive(Debug)]
pub struct GatsbiState {
    /// Agent and background.
    pub mixture: MixtureState,
    /// Objects.
    pub objects: ObjectState,
    /// Steps that the mixture has absorbed, `[B]` int64.
    pub step: Tensor,
}

impl GatsbiState {
    /// Another handle on the same tensors.
    #[must_use]
    pub fn shallow_clone(&self) -> Self {
        Self {
            mixture: self.mixture.shallow_clone(),
            objects: self.objects.shallow_clone(),
            step: self.step.shallow_clone(),
        }
    }

    /// Rows that have absorbed nothing, `[B]` bool.
    pub fn first(&self) -> Tensor {
        self.step.eq(0)
    }
}

/// Where gradients of the object module stop (decisions rows 2 and 3).
#[expect(clippy::struct_excessive_bools, reason = "four independent switches of one kind")]
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct GradientStops {
    /// Before the agent slot's latent, history and action.
    pub agent: bool,
    /// Before `mu_mix` in the difference that discovery sees.
    pub residual: bool,
    /// Before `mu_mix` in the environment crops.
    pub environment: bool,
    /// Before `mu_mix` in the composite image.
    pub composite: bool,
}

impl Default for GradientStops {
    fn default() -> Self {
        Self { agent: true, residual: false, environment: false, composite: false }
    }
}

/// How a frame is observed.
#[derive(Debug)]
pub struct Observing {
    /// Batch statistics in batch norms.
    pub train: bool,
    /// Compute the priors of the mixture's latents, for the KL.
    pub priors: bool,
    /// Run the object module. Without it the objects stay as they were.
    pub objects: bool,
    /// Who looks for new objects.
    pub discover: Discover,
    /// How objects are tracked.
    pub tracking: Tracking,
    /// Where gradients stop.
    pub stops: GradientStops,
}

impl Observing {
    /// As a server observes, without what is asked for besides: with objects, of which all rows look for new ones.
    pub fn serving(tracking: Tracking) -> Self {
        Self {
            train: false,
            priors: false,
            objects: true,
            discover: Discover::All,
            tracking,
            stops: GradientStops::default(),
        }
    }
}

/// What a step gives besides the state.
#[derive(Debug)]
pub struct GatsbiStep {
    /// Agent and background.
    pub mixture: MixtureStep,
    /// Objects, while observing with the object module on.
    pub objects: Option<ObjectStep>,
    /// The agent as the objects saw it; absent in scenes without one, and with the object module off.
    pub agent: Option<Agent>,
}

/// GATSBI with all parameters.
#[derive(Debug)]
pub struct Gatsbi {
    action: ActionEnhancer,
    mixture: Mixture,
    detector: Option<Detector>,
    objects: ObjectModule,
    agent_slot: Option<i64>,
    config: GatsbiConfig,
}

impl Gatsbi {
    /// Creates the parameters `action.*`, `mixture.*`, `detector.*`, `objects.*`. `agent_slot` is the slot whose
    /// mask is the agent's; `None` in scenes without one.
    pub fn new(path: &Path<'_>, config: &GatsbiConfig, agent_slot: Option<i64>) -> Self {
        let image_size = config.image_size;
        let action = config.action.enhanced;
        Self {
            action: ActionEnhancer::new(&path.sub("action"), &config.action, config.mixture.init),
            mixture: Mixture::new(&path.sub("mixture"), &config.mixture, action, image_size),
            detector: config
                .detector
                .as_ref()
                .map(|detector| Detector::new(&path.sub("detector"), detector, image_size)),
            objects: ObjectModule::new(&path.sub("objects"), config),
            agent_slot,
            config: config.clone(),
        }
    }

    /// A model with untrained parameters and their store.
    pub fn untrained(
        config: &GatsbiConfig,
        agent_slot: Option<i64>,
        seed: u64,
        device: Device,
    ) -> (Self, ParamStore) {
        let mut store = ParamStore::new(seed, device);
        let model = store.build(|root| Self::new(root, config, agent_slot));
        (model, store)
    }

    /// The configuration it was built from.
    pub fn config(&self) -> &GatsbiConfig {
        &self.config
    }

    /// The slot whose mask is the agent's.
    pub fn agent_slot(&self) -> Option<i64> {
        self.agent_slot
    }

    /// The keypoint detector.
    pub fn detector(&self) -> Option<&Detector> {
        self.detector.as_ref()
    }

    /// The mixture module.
    pub fn mixture(&self) -> &Mixture {
        &self.mixture
    }

    /// The enhanced action of scaled actions `[B, A]`.
    pub fn enhance(&self, action: &Tensor) -> Tensor {
        self.action.forward(action)
    }

    /// The state before any frame.
    pub fn initial_state(&self, batch: i64) -> GatsbiState {
        let mixture = self.mixture.initial_state(batch);
        let step = Tensor::zeros([batch], (Kind::Int64, mixture.z_mask.device()));
        GatsbiState { mixture, objects: self.objects.initial_state(batch), step }
    }

    /// Absorbs a frame.
    ///
    /// # Shapes
    /// `frame [B, 3, H, W]` in [0, 1]; `action [B, A]`, scaled, the one that led to the frame.
    pub fn observe(
        &self,
        state: GatsbiState,
        frame: &Tensor,
        action: &Tensor,
        noise: &dyn Noise,
        how: Observing,
    ) -> (GatsbiState, GatsbiStep) {
        let Observing { train, priors, objects, discover, tracking, stops } = how;
        let first = state.first();
        let action = self.enhance(action);
        let before = &state.mixture;
        let (mixture, step) =
            self.mixture.observe(before, frame, &action, &first, noise, priors, train);
        if !objects {
            let state = GatsbiState { mixture, objects: state.objects, step: state.step + 1 };
            return (state, GatsbiStep { mixture: step, objects: None, agent: None });
        }
        let agent = self.agent(before, &mixture, &action, stops.agent);
        let [residual_mix, environment_mix] = [stops.residual, stops.environment]
            .map(|stop| if stop { step.mu_mix.detach() } else { step.mu_mix.shallow_clone() });
        let scenery = Scenery {
            frame,
            residual_mix: &residual_mix,
            environment_mix: &environment_mix,
            agent: agent.as_ref(),
        };
        let (objects, object_step) =
            self.objects.observe(&state.objects, &scenery, discover, noise, &tracking, train);
        let state = GatsbiState { mixture, objects, step: state.step + 1 };
        (state, GatsbiStep { mixture: step, objects: Some(object_step), agent })
    }

    /// Predicts a step under an action.
    ///
    /// # Shapes
    /// `action [B, A]`, scaled.
    pub fn imagine(
        &self,
        state: GatsbiState,
        action: &Tensor,
        noise: &dyn Noise,
        tracking: &Tracking,
    ) -> (GatsbiState, GatsbiStep) {
        let first = state.first();
        let action = self.enhance(action);
        let (mixture, step) = self.mixture.imagine(&state.mixture, &action, &first, noise);
        let agent = self.agent(&state.mixture, &mixture, &action, true);
        let objects =
            self.objects.imagine(&state.objects, &step.mu_mix, agent.as_ref(), noise, tracking);
        let state = GatsbiState { mixture, objects, step: state.step + 1 };
        (state, GatsbiStep { mixture: step, objects: None, agent })
    }

    /// Passes over a frame that never came: predicted like [`Gatsbi::imagine`], and what was predicted is
    /// remembered as if it had been seen.
    pub fn skip(
        &self,
        state: GatsbiState,
        action: &Tensor,
        noise: &dyn Noise,
        tracking: &Tracking,
    ) -> (GatsbiState, GatsbiStep) {
        let first = state.first();
        let action = self.enhance(action);
        let (mixture, step) = self.mixture.skip(&state.mixture, &action, &first, noise);
        let agent = self.agent(&state.mixture, &mixture, &action, true);
        let objects =
            self.objects.skip(&state.objects, &step.mu_mix, agent.as_ref(), noise, tracking);
        let state = GatsbiState { mixture, objects, step: state.step + 1 };
        (state, GatsbiStep { mixture: step, objects: None, agent })
    }

    /// Known objects followed into a frame that the mixture has absorbed in the step from `before` to `after`, wherever
    /// their boxes are thought to be; nothing new is looked for.
    ///
    /// # Shapes
    /// Those of [`Gatsbi::observe`].
    pub fn follow(
        &self,
        objects: &ObjectState,
        (before, after): (&MixtureState, &MixtureState),
        seen: &MixtureStep,
        (frame, action): (&Tensor, &Tensor),
        noise: &dyn Noise,
        tracking: &Tracking,
    ) -> ObjectState {
        let agent = self.agent(before, after, &self.enhance(action), true);
        let scenery = Scenery {
            frame,
            residual_mix: &seen.mu_mix,
            environment_mix: &seen.mu_mix,
            agent: agent.as_ref(),
        };
        self.objects.observe(objects, &scenery, Discover::None, noise, tracking, false).0
    }

    /// The object module.
    pub fn objects(&self) -> &ObjectModule {
        &self.objects
    }

    /// Draws the objects of a state.
    pub fn render(&self, state: &GatsbiState) -> Rendering {
        self.objects.render(&state.objects.z)
    }

    /// Makes the exact inference forms (folded norms, precomputed constants). The model no longer follows
    /// changes of its parameters; gradients must be off from here on.
    pub fn freeze(&mut self) {
        self.mixture.freeze();
        self.objects.freeze();
    }

    /// The agent as the objects see it after the mixture's step from `before` to `after`.
    fn agent(
        &self,
        before: &MixtureState,
        after: &MixtureState,
        action: &Tensor,
        stop: bool,
    ) -> Option<Agent> {
        let slot = self.agent_slot?;
        let history = match self.config.objects.agent_history {
            AgentHistory::After => &after.mask_prior.h,
            AgentHistory::Before => &before.mask_prior.h,
        };
        let part = |x: Tensor| if stop { x.detach() } else { x };
        Some(Agent {
            latent: part(after.z_mask.select(1, slot)),
            history: part(history.select(1, slot)),
            action: part(action.shallow_clone()),
        })
    }
}
